"""The whole diagnosis in five sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from thermoctl.diagnose.case import Budget, Case, case
from thermoctl.diagnose.catalogue import Effect, contained
from thermoctl.diagnose.decide import Facts, decide
from thermoctl.diagnose.fit import as_refitted, with_residuals
from thermoctl.diagnose.held_out import split, worth
from thermoctl.diagnose.law.find import find_law
from thermoctl.diagnose.law.smooth import missing_flow
from thermoctl.diagnose.levels import remainder
from thermoctl.diagnose.limits import Limits
from thermoctl.diagnose.memory import NOTHING, Memory
from thermoctl.diagnose.misfit import energies, standing, supported
from thermoctl.diagnose.result import Diagnosis
from thermoctl.diagnose.search import Searched, search
from thermoctl.diagnose.threads import one_thread
from thermoctl.diagnose.unknown import left, reached
from thermoctl.diagnose.unknown_flow import flow_missing
from thermoctl.diagnose.unknown_law import missing_law, weigh_laws
from thermoctl.plant.language import Plant
from thermoctl.recording.table import Table

WITHOUT_REMAINDER = ("consistent", "explained")  # verdicts that leave nothing for a law


@one_thread()
def diagnose(
    plant: Plant,
    tables: Sequence[Table],
    entries: Mapping[str, Effect],
    numbers: Limits,
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
    say("refitting the plant's own parameters")
    chosen_on, reserve = split(tables, held_out)
    known = case(plant, chosen_on, entries, Budget(numbers.fits, say, stopped), memory)
    searched = search(known, numbers)
    say("measuring what the findings are worth")
    found = _decided(known, searched, numbers, reserve, stopped() and bool(known.budget.untried))
    if found.decision.verdict != "consistent" and not found.shown and found.before.node:
        found = replace(found, missing_flow=missing_flow(known, found.null, found.before.node))
    if (
        found.decision.verdict not in WITHOUT_REMAINDER
        and not stopped()
        and max(found.remainder.over_noise.values()) > numbers.clean
    ):
        found = replace(found, law=find_law(known, found.final, numbers, reserve, say))
    return found


def _decided(
    known: Case, searched: Searched, numbers: Limits, reserve: Sequence[Table], unsure: bool
) -> Diagnosis:
    """Return what a search says: posterior, findings and their worth, remainder, verdict.

    `unsure`: an untried hypothesis may be likelier, so that nothing is named."""
    energy = energies(known, searched, numbers)
    dims = {e.key: len(e.own) for w in searched.tried for e in w.fitted.hypothesis.effects}
    physics = standing(energy, dims, contained(known.catalogue), numbers)
    tried = {w.fitted.hypothesis.keys: w for w in searched.tried}
    fits = {keys: w.fitted for keys, w in tried.items()}
    posterior, laws, signals = weigh_laws(known, tried, physics, numbers)
    best = null = with_residuals(known, as_refitted(known, fits[frozenset()]))
    if posterior.something >= numbers.name and 2 * posterior.known >= posterior.something:
        likeliest = next(keys for keys in posterior.hypotheses if keys)
        stand = supported(likeliest, physics)  # the other effects are part of the remainder
        best = with_residuals(known, fits.get(stand, fits[likeliest]))
    reach = reached(known)
    after, before = left(known, best, reach), left(known, null, reach)
    value = worth(known, null, best, reserve)
    keys = () if unsure else (e.key for e in best.hypothesis.effects)
    named = tuple(key for key in keys if posterior.effects[key] >= numbers.name)
    # data that took part in the choice cannot speak against it
    told = bool(best.hypothesis.effects) and value.reserved
    ratio, worse = (_ratio(value.after, value.refit_only), value.worse) if told else (1.0, 0.0)
    remains = remainder(known, fits[best.hypothesis.keys])
    unknown = missing_law(posterior, searched.tried, signals)
    if remains < numbers.name and unknown.probability < numbers.name:
        flow = flow_missing(known, fits[best.hypothesis.keys], reach.nodes, numbers)
        unknown = max(unknown, flow, key=lambda missing: missing.probability)
    if unknown.probability >= numbers.name:
        after = replace(after, node=unknown.node or after.node)
        before = before if best.hypothesis.effects else after
    facts = Facts(
        posterior.something,
        posterior.known,
        named,
        max(after.over_noise.values()),
        ratio,
        remains,
        worse,
        unknown.probability,
    )
    decision = decide(posterior, facts, numbers)
    doubt = unknown.told(decision.verdict, numbers)
    return Diagnosis(
        known, searched, posterior, best, null, after, before, value, decision, energy, physics, doubt, laws
    )


def _ratio(after: Mapping[str, float], before: Mapping[str, float]) -> float:
    """Return the root of the outputs' mean ratio of mean squares; infinite if a simulation failed."""
    pairs = [(after.get(o, float("inf")), before[o]) for o in before if before[o] > 0]
    return (sum((a / b) ** 2 for a, b in pairs) / max(len(pairs), 1)) ** 0.5
