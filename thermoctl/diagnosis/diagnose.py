"""The whole diagnosis in five sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from thermoctl.checks.hung import without_hung
from thermoctl.diagnosis.data.case import Budget, Case, case
from thermoctl.diagnosis.data.memory import NOTHING, Memory
from thermoctl.diagnosis.data.pieces import in_pieces, with_free_starts
from thermoctl.diagnosis.evidence.between import between
from thermoctl.diagnosis.evidence.fit import closest, with_residuals
from thermoctl.diagnosis.evidence.held_out import cleaned, split, with_values_aside, worth
from thermoctl.diagnosis.evidence.input_noise import with_input_noise
from thermoctl.diagnosis.evidence.levels import only_noise, over_noise, remainder
from thermoctl.diagnosis.evidence.steady import steady
from thermoctl.diagnosis.evidence.unknown import left, reached
from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.diagnosis.hypothesis.catalogue import contained
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.law.contest import with_laws
from thermoctl.diagnosis.law.find import found_laws
from thermoctl.diagnosis.law.forms import LAW
from thermoctl.diagnosis.law.smooth import missing_flow
from thermoctl.diagnosis.limits import Thresholds
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.diagnosis.search.beam import Searched, Weighed, afresh, search, searched
from thermoctl.diagnosis.threads import one_thread
from thermoctl.diagnosis.verdict.coloured import coloured
from thermoctl.diagnosis.verdict.confirm import Confirm, brief, confirmed, timed
from thermoctl.diagnosis.verdict.decide import Facts, Probabilities, decide, weigh
from thermoctl.diagnosis.verdict.families import families
from thermoctl.diagnosis.verdict.misfit import deviations, energies, standing, supported
from thermoctl.diagnosis.verdict.unknown_flow import Missing, flow_missing
from thermoctl.plant.language import Plant
from thermoctl.recording.table import Table


@dataclass(frozen=True)
class Sought:
    """All hypotheses that were tried, before a decision.

    `reserve`: recordings that take no part in any choice. `unsure`: an untried hypothesis may be likelier, so
    that nothing is named."""

    case: Case
    searched: Searched
    reserve: tuple[Table, ...]
    unsure: bool


@one_thread()
def diagnose(
    plant: Plant,
    tables: Sequence[Table],
    entries: Mapping[str, Effect],
    numbers: Thresholds,
    held_out: Sequence[Table] = (),
    progress: Callable[[str], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
    memory: Memory = NOTHING,
) -> Diagnosis:
    """Find the physics that a plant lacks, from recordings. Raises InputError.

    `held_out`: recordings that take no part in any choice. `progress` is called with each stage and refit.
    Once `stopped`, the search ends after the present refit, and no law is looked for. `memory`: the posterior
    of earlier recordings."""
    say = progress or (lambda text: None)

    def found(aside: bool) -> Diagnosis:
        """Search and decide, with the last recording set aside or with all of them."""
        tried = sought(plant, tables, entries, numbers, held_out, say, stopped, memory, aside)
        say("measuring what the findings are worth")
        return decided(tried)

    first = found(True)
    if stopped() or not undecided(first, held_out):
        return first
    say("the recording set aside takes part: the others do not decide")
    return found(False)


def undecided(found: Diagnosis, held_out: Sequence[Any]) -> bool:
    """Return whether a recording that nobody wanted aside may tell what the others cannot.

    Where only there something is missing, it is not followed."""
    if held_out or not found.worth.reserved:
        return False
    verdict = found.decision.verdict
    return verdict == "ambiguous" or verdict == "consistent" and bool(found.worth.not_followed)


def sought(
    plant: Plant,
    tables: Sequence[Table],
    entries: Mapping[str, Effect],
    numbers: Thresholds,
    held_out: Sequence[Table] = (),
    say: Callable[[str], None] = lambda text: None,
    stopped: Callable[[], bool] = lambda: False,
    memory: Memory = NOTHING,
    aside: bool = True,
) -> Sought:
    """Try the hypotheses. The arguments are those of `diagnose`. Raises InputError.

    `aside`: of three or more recordings the last one takes no part in any choice."""
    say("refitting the plant's own parameters")
    given, hung = without_hung(plant, [*tables, *held_out])
    both = given[: len(tables)], given[len(tables) :]
    both = split(*both) if aside else both
    (chosen_on, notes), (reserve, more) = (in_pieces(plant, part) for part in both)
    plant = with_free_starts(plant, [*chosen_on, *reserve]) if notes or more else plant
    chosen_on = [_shared(plant, t, reserve) for t in chosen_on]
    budget = Budget(numbers.fits, say, stopped)

    def made(tables: Sequence[Table], of: Plant = plant) -> Case:
        """Return the case of recordings and a plant."""
        return between(of, lambda p: case(p, tables, entries, budget, memory, numbers))

    def smooth(of: Plant) -> tuple[Case, list[Table], bool]:
        """Return the plant's case and the reserve with inputs that are steady beside `of`; levels, too?"""
        beside = partial(made, of=of)
        found, kept, taken = steady(beside(chosen_on), beside, chosen_on, reserve)
        known = found if of is plant else made(found.tables)
        known, kept = with_input_noise(known, made, kept)
        known.notes.extend([*([taken] if taken else []), *hung, *notes, *more])
        return known, kept, bool(taken)

    known, kept, levels = smooth(plant)
    tried = search(known)
    led = set[Keys]()
    while levels and (keys := tried.best.fitted.hypothesis.keys) and keys not in led and not stopped():
        led.add(keys)  # levels of the plant alone had taken a part of what it lacks
        budget.fits, budget.untried = budget.fits_done + numbers.fits, 0
        known, kept, levels = smooth(tried.best.fitted.rough_plant)
        tried = search(known)
    afresh(with_laws(tried))
    return Sought(known, searched(tried), tuple(kept), stopped() and bool(known.budget.untried))


def _shared(plant: Plant, table: Table, reserve: Sequence[Table]) -> Table:
    """Return a recording without the columns that the plant does not read and a reserve lacks.

    An effect or a law of such a column could not be simulated there."""
    read = {i.column for i in plant.readings()}
    kept = {c for c in table.columns if c in read or all(c in r.columns for r in reserve)}
    return replace(table, columns={c: v for c, v in table.columns.items() if c in kept})


def decided(sought: Sought) -> Diagnosis:
    """Decide a search: posterior, findings and their worth, remainder, verdict, missing flow."""
    known, searched, numbers = sought.case, sought.searched, sought.case.limits
    energy = energies(known, searched)
    dims = {e.key: len(e.own) for w in searched.tried for e in w.fitted.hypothesis.effects}
    physics = standing(energy, dims, contained(known.catalogue), numbers)
    tried = {w.fitted.hypothesis.keys: w for w in searched.tried}
    known, reserve = cleaned(known, tried[frozenset()].fitted, sought.reserve)
    sought = replace(sought, case=known, reserve=reserve)
    chosen, posterior, asked = _chosen(sought, tried, physics)
    null = best = with_residuals(known, closest(known, tried[frozenset()].fitted))
    if chosen:
        best = with_residuals(known, closest(known, tried[chosen].fitted))
        plant = with_values_aside(known, best.plant, reserve)
        best = replace(best, plant=plant, sd=deviations(best, energy, numbers))
    reach = reached(known)
    after, before = left(known, best, reach), left(known, null, reach)
    value = worth(known, null, best, sought.reserve)
    keys = () if sought.unsure else (e.key for e in best.hypothesis.effects)
    named = tuple(key for key in keys if posterior.effects[key] >= numbers.name)
    # data that took part in the choice cannot speak against it
    checked = bool(chosen) and value.reserved
    remains = remainder(known, tried[chosen].fitted)
    unknown, sensors = Missing(), list[str]()
    if remains >= numbers.name and not (chosen or asked):
        sensors = coloured(known, null)
        known = replace(known, notes=[*known.notes, *sensors])
    if remains < numbers.name and not known.noisy:  # noise of an input is such a flow
        unknown = flow_missing(known, tried[chosen].fitted, reach.nodes)
    if unknown.probability >= numbers.name:
        after = replace(after, node=unknown.node or after.node)
        before = before if chosen else after
    facts = Facts(
        something=posterior.something,
        known=posterior.something if chosen or not asked else 0.0,
        named=named,
        over_noise=1.0 if sensors else max(after.over_noise.values()),
        apart=max((rms / value.noise[o] for o, rms in value.after.items()), default=0.0) if checked else 0.0,
        remains=0.0 if sensors else remains,
        worse=value.worse if checked else 0.0,
        flow=unknown.probability,
    )
    decision = decide(posterior, facts, numbers)
    diagnosis = Diagnosis(
        known,
        searched,
        posterior,
        best,
        null,
        after,
        before,
        value,
        decision,
        energy,
        physics,
        unknown.doubt(decision.verdict, numbers),
        asked,
        families=families(posterior, physics, decision.named, known.catalogue, asked, numbers.name),
        laws=tuple(found_laws(known, tried, best, decision.named, posterior.effects, asked)),
    )
    if decision.verdict != "consistent" and not diagnosis.shown and before.node:
        return replace(diagnosis, missing_flow=missing_flow(known, null, before.node))
    return diagnosis


def _chosen(
    sought: Sought, tried: Mapping[Keys, Weighed], physics: Mapping[Keys, Mapping[Key, float]]
) -> tuple[Keys, Probabilities, dict[Key, float]]:
    """Return the effects that stand, the posterior, and the probability that each tested one is confirmed.

    `physics`: by hypothesis, the probability that each effect is physics and no misfit."""
    known, numbers = sought.case, sought.case.limits
    scores = {keys: tried[keys].score for keys in physics}
    posterior = weigh(scores, physics)
    if posterior.something < numbers.name:
        return frozenset(), posterior, {}
    likeliest = next(keys for keys in posterior.hypotheses if keys)
    chosen = supported(likeliest, physics)  # the other effects are part of the remainder
    if chosen not in tried:
        chosen = likeliest
    best = tried[chosen].fitted
    # straight lines between rows know only how late switches are on average: an event may be one late switch.
    # So may one that is over before the next rows.
    late = any(i.linear and not i.stated for i in known.plant.inputs.values())
    late = late or any(brief(best, key) for key in chosen)
    unsure = [key for key in chosen if key[0] == LAW or late and timed(best, key)]
    # beside known physics whose residual is only noise, there is no misfit that it could imitate
    quiet = only_noise(known, best) and not unsure
    if sought.reserve or not quiet:
        fits = {keys: w.fitted for keys, w in tried.items()}
        misfit = late or max(over_noise(known, best)) > numbers.clean
        found = confirmed(posterior, chosen, Confirm(known, fits, sought.reserve, misfit), numbers.name)
        against = min(found[2].values(), default=1.0) <= 1 - numbers.name
        if found[0] == chosen or not quiet or against:
            return found
    # a recording set aside may know too little to confirm them; unconfirmed evidence counts less
    posterior = weigh(scores, physics, numbers.unasked)
    return (chosen if posterior.something >= numbers.name else frozenset()), posterior, {}
