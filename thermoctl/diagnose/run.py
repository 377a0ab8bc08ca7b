"""From "simulation and recording disagree" to the physics that was left out, and what adding it is worth.

1 refit the plant's own parameters; 2 ask whether anything is wrong; 3 locate; 4 screen the catalogue and refit the best
entries in full; 5 decide: name, set that cannot be told apart, unknown, or nothing; 6 propose the experiment that would
separate rivals; 7 show on data that took no part what the finding is worth. `diagnose` does it all and writes the result.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.channels import CHANNELS
from thermoctl.diagnose import doubt, experiment_file, locate
from thermoctl.diagnose.design import NONE, Limits
from thermoctl.diagnose.effects import CATALOGUE, Rig, catalogue
from thermoctl.diagnose.evidence import LARGE, white_sigma
from thermoctl.diagnose.explain import Case, Explanation
from thermoctl.diagnose.heldout import held_out, prediction, rms
from thermoctl.diagnose.outcome import Diagnosis, result
from thermoctl.diagnose.page import write_report
from thermoctl.diagnose.propose import propose
from thermoctl.diagnose.remains import REMAINS, energy, remains, smooth
from thermoctl.diagnose.screen import Metric, log_p
from thermoctl.diagnose.search import (
    ACCEPT,
    CLEAN,
    Round,
    compete,
    counts,
    finalists,
    following,
    inflation,
    look,
    prune,
    search,
    threshold,
)
from thermoctl.plant import load, save
from thermoctl.plant.refit import Noise
from thermoctl.plant.simulate import SimulationError
from thermoctl.recording.files import read_table
from thermoctl.signals import NAMES
from thermoctl.yamlfile import InputError

NAME = 0.9  # one explanation is named alone from this probability on
MANY = 3  # effects at once, which one that the catalogue lacks explains better
FAR = 10.0  # residual (in sensor noise) from which a moving rig is also looked at through an observer
TEMPERING = (
    1.9,
    3.0,
)  # how much less the score decides than a perfect likelihood would, in white and in coloured noise


def examine(case: Case, entries: Mapping[str, Any], most: int = 3) -> Diagnosis:
    """Run the whole chain on a case, without writing anything."""
    notes: list[str] = []
    start = _unfitted(case)
    case.progress("refitting the plant's own parameters")
    begun = time.thread_time()
    base = case.explain(case.plant, [], [], iterations=40, tries=0)
    if max(case.excess(base).values(), default=0.0) > 1.5:
        again = case.explain(case.plant, [], [], iterations=40, tries=40)
        if again.score < base.score - 1:
            base = again
    case.patience = max(4.0, 6 * (time.thread_time() - begun))
    _check_noise(case, base, notes)
    base = case.scored(base.plant, [], [], base.fit)
    if quiet := doubt.still(case.drives, case.noise):
        return Diagnosis(
            "consistent",
            base,
            base,
            [],
            [look(case, base, entries)],
            [],
            None,
            held_out(case, base, base),
            [*notes, quiet],
            None,
            start,
        )
    first = look(case, base, entries)
    clock = _clock(case, base, base, first)
    followed = None
    if clock:
        most = 0  # a shifted clock that leaves nothing to explain
    elif (
        max(case.excess(base).values(), default=0.0) > FAR
        and Rig(base.plant, case.drives, [t.columns for t in case.tables]).velocities
    ):
        followed = following(case, base, entries, most)
    if followed:
        current, reference, rivals = followed
        rounds = [first]
        if max(case.excess(current).values()) >= CLEAN and len(current.effects) < most:
            more, others, looks = search(case, base, entries, most, current)
            if len(more.effects) > len(current.effects):
                current = reference = more
                rivals, rounds = others, [*rounds, *looks]
    else:
        current, rivals, rounds = search(case, base, entries, most, first=first)
        reference = current
    left_over = False
    if not clock and not current.effects and first.p_any() < 1e-3:
        # In white noise's metric something stands out, but nothing counts: the residual's own colour decides.
        case.progress("screening in the colour of the residual")
        tinted = look(case, base, entries, coloured=True)
        if tinted.directions:
            best = tinted.directions[0]
            if log_p(best.gain / inflation(tinted.directions), best.dims) + best.elsewhere < threshold(
                tinted
            ):
                tinted.finalists = compete(case, tinted, finalists(tinted.directions))
            if tinted.finalists and counts(case, tinted, tinted.finalists[0], entries):
                left_over = True
                current = reference = tinted.finalists[0]
                rivals = tinted.finalists[1:]
    clock = clock or _clock(case, base, current, first)
    if clock:
        current = reference = base
        rivals = []
    if current.effects:
        case.progress("trying the findings on data that took no part")
        kept = prune(case, base, current, notes)
        if kept is not current:
            current, reference = kept, kept
            rivals = [r for r in rivals if len(r.effects) == len(kept.effects)]
    # That something is missing was proved on data that took no part; which of the rivals it is, all of the data decide, among
    # those that predict better than the plant, too.
    better = [
        e for e in rivals if e.counts and e.score < current.score and len(e.effects) == len(current.effects)
    ]
    if better and current is reference:
        leader = next(
            (e for e in sorted(better, key=lambda e: e.score) if prediction(case, base, e)[0] < 1.0), None
        )
        if leader:
            rivals = [current, *(e for e in rivals if e is not leader)]
            current = reference = leader
    if current.effects and current is reference and remains(case, current):
        # What leaves something is ruled out by what fits about as well and leaves nothing.
        near = sorted(
            (
                e
                for e in rivals
                if len(e.effects) == len(current.effects) and abs(e.score - current.score) < ACCEPT
            ),
            key=lambda e: e.score,
        )
        whole = next((e for e in near if prediction(case, base, e)[2] < 1.0 and not remains(case, e)), None)
        if whole:
            current = reference = whole
            rivals = [e for e in rivals if e.score > whole.score]
    suspects = locate.suspects(first.metric) if first.directions and first.p_any() < 1e-3 else []
    excess = case.excess(current)
    worst = max(excess.values(), default=0.0)
    before_worst = max(case.excess(base).values(), default=0.0)
    case.reprice([base, current, reference, *rivals])
    _weigh(reference, rivals)
    current.probability = reference.probability
    held = held_out(case, base, current)
    if current.effects:
        share = (worst**2 - 1) / max(before_worst**2 - 1, 1e-9)
        explained = worst < CLEAN or (share < 0.02 and worst < LARGE)
        if explained and (left := remains(case, current)):
            verdict = "unexplained"
            if left.gain > base.raw - current.raw:
                current, rivals, worst = base, [], before_worst  # the name explains less than what it leaves
                held = held_out(case, base, current)
            notes.append(
                f"beside what is named, something remains that no entry of the catalogue explains: {left.sentence()}"
            )
        elif explained and len(current.effects) >= MANY:
            verdict = "unexplained"
            notes.append(
                f"{len(current.effects)} entries of the catalogue together fit; so many at once rather stand in for one thing that it lacks"
            )
        elif explained:
            verdict = "explained" if current.probability >= NAME else "ambiguous"
        else:
            verdict = "unexplained"
            if energy(case, current) > 0.55 * energy(case, base):
                current, rivals, worst = (
                    base,
                    [],
                    before_worst,
                )  # what was found explains too little to be named
                held = held_out(case, base, current)
            notes.append(
                f"what remains ({worst:.1f} times the sensor's noise at worst) no entry of the catalogue explains"
                + (f": {left.sentence()}" if (left := remains(case, current)) else "")
            )
    else:
        left = remains(case, current)
        verdict = "unexplained" if before_worst > LARGE or left_over or left else "consistent"
        if left:
            notes.append(f"something is missing that no entry of the catalogue explains: {left.sentence()}")
    if clock:
        verdict, left_over = "unexplained", True
        notes.insert(0, clock)
    elif refused := doubt.other_rig(
        current.fit, [d.y for d in case.drives], excess, LARGE, list(case.plant.parameters)
    ):
        verdict, current, rivals = "unexplained", base, []
        held = held_out(case, base, base)
        notes.insert(0, refused)
    if current.effects and held["data"] == "blocks" and len(case.tables) > 1:
        notes.append(
            "one recording alone does not determine this well enough to predict another; the held-out figures are of blocks "
            "of all recordings, fitted without them"
        )
    notes += [c.effect.caution for c in current.effects if c.effect.caution]
    missing = None
    if verdict != "consistent":
        nodes = [s for s in suspects if s.kind == "node"]
        if nodes:
            at = rounds[0]
            missing = locate.missing_flow(at.metric, nodes[0].name, _signals(case, at))
    final = case.polished(current) if current.effects and verdict != "unexplained" else current
    return Diagnosis(verdict, base, final, rivals, rounds, suspects, missing, held, notes, None, start)


def _clock(case: Case, base: Explanation, found: Explanation, first: Round) -> str | None:
    """Does one channel run ahead of the others, rather than physics being missing? The channel is shifted back, the plant
    refitted, and the score held against that of the best explanation `found`. Where none is, the shift must promise more than
    every entry of the catalogue and leave nothing over."""
    if first.p_any() > 1e-3:
        return None
    guess = doubt.early(first.metric)
    if guess is None or guess.gain < (0.3 if found.effects else 1.0) * first.directions[0].gain:
        return None
    case.progress(f"trying whether {guess.output} runs ahead of the others")
    column = case.plant.outputs[guess.output].column
    step = max(float(np.median(np.diff(t.t))) for t in case.tables)
    best, seconds, after = base, 0.0, case
    ahead = guess.seconds
    for _ in range(5):
        total = round((seconds + ahead) / step) * step
        if total <= 0 or total == seconds:
            break
        shifted = Case(case.plant, [doubt.later(t, column, total) for t in case.tables], case.noise)
        shifted.patience = case.patience
        try:
            e = shifted.explain(base.plant, [], [])
        except SimulationError:
            break
        if e.raw / max(e.fit.samples, 1) >= best.raw / max(best.fit.samples, 1):
            break
        best, seconds, after = e, total, shifted
        again = doubt.early(Metric(e.fit, shifted.drives))
        if again is None or again.output != guess.output:
            break
        ahead = again.seconds
    per_sample = base.fit.samples / max(best.fit.samples, 1)  # the shift takes a few samples away
    better = seconds > 0 and best.raw * per_sample < found.raw - ACCEPT
    if better and (
        found.effects
        or (max(after.excess(best).values()) < CLEAN and smooth(after, best, coloured=True) > REMAINS)
    ):
        return (
            f"{guess.output}: its clock runs about {seconds:.3g} s ahead of the other channels' (shifted back, the residual falls from "
            f"{base.fit.rms()[guess.output]:.3g} to {best.fit.rms()[guess.output]:.3g}); no sensor reads ahead of time. "
            "Put the channels on one clock and diagnose again"
        )
    return None


def _unfitted(case: Case) -> dict[str, float]:
    """Residual rms per output of the plant as it came."""
    parts = []
    for d in case.drives:
        try:
            parts.append(d.y - case.model.run(d).y)
        except SimulationError:
            parts.append(np.full_like(d.y, np.nan))
    return rms(case.model, parts)


def _check_noise(case: Case, base: Explanation, notes: list[str]) -> None:
    """The white part of the residual against what the plant says of its sensors."""
    changed = []
    for j, (o, n) in enumerate(zip(case.plant.outputs.values(), case.noise, strict=True)):
        white = white_sigma([r[:, j] for r in base.fit.residuals])
        if white > 1.3 * n.sigma:
            notes.append(
                f"{o.name}: its white noise is {white:.3g} {o.unit or ''}, more than the plant's {n.sigma:.3g}; "
                "the larger figure is used"
            )
            changed.append(Noise(white))
        else:
            changed.append(n)
    case.noise = tuple(changed)


COMPUTED = set(NAMES) - set(CHANNELS) - {"position_raw_um", "setpoint_um", "reference_um", "drive", "power_w"}
"""The daemon's own counts, bits and estimates: a missing flow that follows one of them follows what it was computed from."""


def _signals(case: Case, seen: Round) -> dict[str, list[np.ndarray]]:
    out: dict[str, list[np.ndarray]] = {}
    rig = seen.rig
    for j, i in enumerate(rig.plant.inputs):
        if i in rig.moving_inputs:
            out[i] = [d.u[:, j] for d in seen.metric.drives]
    for k, n in enumerate(seen.metric.model.states):
        out[n] = [run.x[:, k] for run in seen.metric.runs]
    for c in rig.spare:
        base = c.removesuffix("_min").removesuffix("_max")
        if base in COMPUTED or (base != c and base in case.tables[0].columns):
            continue
        out[c] = [np.nan_to_num(t.columns[c]) for t in case.tables]
    return out


def _weigh(current: Explanation, rivals: Sequence[Explanation]) -> None:
    """Posterior over the explanations that were refitted, tempered; the same effect at the same place counts once."""
    best: dict[tuple[Any, ...], Explanation] = {}
    for e in [current, *rivals]:
        key = tuple(sorted(c.key for c in e.effects))
        if key not in best or e.score < best[key].score:
            best[key] = e
    scores = np.array([e.score for e in best.values()])
    likeliest = min(best.values(), key=lambda e: e.score)
    weights = np.exp(-0.5 * (scores - likeliest.score) / TEMPERING[0 if likeliest.white else 1])
    weights /= weights.sum()
    for e, w in zip(best.values(), weights, strict=True):
        e.probability = float(min(w, 0.995))


def diagnose(
    plant_path: str | Path,
    recording_paths: Sequence[str | Path],
    out_dir: str | Path,
    effects: Sequence[Path] = (),
    progress: Callable[[str], None] | None = None,
    drivable: Sequence[str] = (),
    limits: Limits = NONE,
) -> dict[str, Any]:
    """Diagnose recordings against a plant file and write diagnosis.json, plant.yaml and report.html into `out_dir`, and where
    nothing is decided next_experiment.yaml and .csv, all or nothing. `drivable`: inputs that an experiment may drive (default:
    those that moved and are not the surroundings), `limits` of inputs and outputs that it keeps. Returns the JSON's content.
    Raises InputError for unusable inputs."""
    begun = time.monotonic()
    plant = load(plant_path)
    if not recording_paths:
        raise InputError("no recording was given; one or more were expected")
    tables = [read_table(p) for p in recording_paths]
    names = [t.name for t in tables]
    if len(set(names)) < len(names):
        tables = [dataclasses.replace(t, name=f"{Path(t.path).parent.name}_{t.name}") for t in tables]
    case = Case(plant, tables, progress=progress)
    entries = catalogue((CATALOGUE, *effects))
    try:
        found = examine(case, entries)
    except SimulationError as e:
        raise InputError(f"{plant_path}: the plant cannot follow these recordings at all: {e}") from None
    proposed = propose(case, found, drivable, limits)
    found.next_experiment = proposed[0] if proposed else None
    found.result = result(case, found)
    found.result["seconds"] = round(time.monotonic() - begun, 1)
    out = Path(out_dir)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        part = Path(folder)
        save(
            found.final.plant,
            part / "plant.yaml",
            note=f"{Path(plant_path).name}, refitted"
            + "".join(f"; with {c.effect.name} at {c.place.where}" for c in found.final.effects),
        )
        load(part / "plant.yaml")
        write_report(case, found, part / "report.html")
        (part / "diagnosis.json").write_text(json.dumps(found.result, indent=1, allow_nan=False) + "\n")
        written = experiment_file.write(part, case, *proposed) if proposed else []
        out.mkdir(parents=True, exist_ok=True)
        for stale in experiment_file.FILES:
            (out / stale).unlink(missing_ok=True)
        for name in ("plant.yaml", "report.html", "diagnosis.json", *written):
            shutil.move(str(part / name), str(out / name))
    return found.result
