"""Wrong plants and damaged recordings: found by the checks, named rightly, or not named with confidence.

`python -m tests.checks.wrong_plants [NAME ...]` (make wrong-plants) prints two tables; without names it writes them into
docs/proof/wrong-plants.md, too. Wrong is only a finding that says with a probability above CONFIDENT that the rig has physics
which it lacks.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

from tests.checks.rigs import PLANTS, rig
from tests.checks.test_checks import DAMAGES, WRONG
from thermoctl.checks import checks
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.relabelled import relabelled
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant, loads
from thermoctl.recording.table import Table

CONFIDENT = 0.9
RIG = "two blocks"
LINK = "  between: {from: one, into: two, rate: G_12 * (one - two), unit: W}\n"
CAPACITY = "C_1: {value: 6, unit: J/K, range: [2, 14]}"
CONDUCTANCE = "G_2: {value: 0.05, unit: W/K, range: [0.015, 0.15]}"
CONDUCTANCE_WARMS = {"natural_convection", "radiation", "temperature_dependent_conductance"}
LOSS = "rate: G_1 * (one - air)"
SENSOR = "temperature_1: {value: one,"
PLANTS_WRONG: Mapping[str, tuple[list[tuple[str, str]], set[str]]] = {  # replacements, right names
    **{k: ([(old, new)], {"wrong_storage"}) for k, (old, new, *_) in WRONG.items()},
    "no link": ([(LINK, ""), ("  G_12: {value: 0.02, unit: W/K, range: [0.004, 0.08]}\n", "")], {"missing_link"}),
    "link of the wrong sign": ([("G_12 * (one - two)", "G_12 * (two - one)")], {"missing_link"}),
    "heat into the other block": ([("power: {into: one", "power: {into: two")], {"heat_split"}),
    "sensors exchanged": ([("{value: one,", "{value: @,"), ("{value: two,", "{value: one,"), ("@", "two")], set()),
    "capacity fixed ten times too large": ([(CAPACITY, "C_1: {value: 60, unit: J/K}")], {"wrong_storage"}),
    "capacity fixed ten times too small": ([(CAPACITY, "C_1: {value: 0.6, unit: J/K}")], {"wrong_storage"}),
    "capacity fixed, in kJ/K": ([(CAPACITY, "C_1: {value: 0.006, unit: J/K}")], {"wrong_storage"}),
    "loss fixed ten times too large": ([(CONDUCTANCE, "G_2: {value: 0.5, unit: W/K}")], {"wrong_rate"}),
    "loss fixed ten times too small": ([(CONDUCTANCE, "G_2: {value: 0.005, unit: W/K}")], {"wrong_rate"}),
    "heat in kW": ([("rate: heat,", "rate: 1000 * heat,")], {"sensor_gain"}),
    "half of the heat": ([("rate: heat,", "rate: 0.5 * heat,")], {"sensor_gain"}),
    "sensor in degF": ([(SENSOR, "temperature_1: {value: 1.8 * one + 32,")], set()),
    "sensor with a gain": ([(SENSOR, "temperature_1: {value: 1.1 * one,")], {"sensor_gain", "cold_junction_drift"}),
    "sensor with an offset": ([(SENSOR, "temperature_1: {value: one + 5,")], {"wrong_offset"}),
    "late sensor": ([(SENSOR, 'temperature_1: {value: "delay(one, 60)",')], {"sensor_lag", "sensor_delay"}),
    "loss as the square": ([(LOSS, "rate: 0.1 * G_1 * (one - air) * abs(one - air)")], CONDUCTANCE_WARMS),
    "start 20 K too warm": ([("one: {unit: degC, storage: C_1, initial: air,", "one: {unit: degC, storage: C_1, initial: air + 20,")], set()),
    "noise of a hundredth": ([("noise: 0.1", "noise: 0.001")], set()),
}  # fmt: skip
# A reading that is held for four samples comes 1.5 samples late on average.
DAMAGES_RIGHT: Mapping[str, set[str]] = {"held": {"sensor_delay"}}


PAGE = Path(__file__).parents[2] / "docs/proof/wrong-plants.md"
TEXT = """# Wrong plants and damaged recordings

`make wrong-plants` diagnoses sound recordings with wrong plants, and damaged recordings with sound plants.

| outcome | meaning |
|---|---|
| refused | the plant file cannot be read, or too little was measured |
| found | a severe finding of the checks, before any refit, or a wrong column that explains more than physics |
| right | the mistake, or physics that is equal to it, is named with a probability above 0.9 |
| unsure | nothing is named with a probability above 0.9 |
| WRONG | physics that the rig lacks is named with a probability above 0.9 |
"""


def plant_result(name: str) -> tuple[str, str]:
    """Return (outcome, what was found) of a wrong plant."""
    changes, right = PLANTS_WRONG[name]
    text = PLANTS[RIG]
    for old, new in changes:
        assert old in text, f"{name}: '{old}' is not in the plant"
        text = text.replace(old, new)
    try:
        plant = loads(text)
    except InputError as e:
        return "refused", str(e)[:90]
    return judged(plant, rig(RIG)[1], right)


def damage_result(name: str) -> tuple[str, str]:
    """Return (outcome, what was found) of a damaged recording."""
    of, damage, *_ = DAMAGES[name]
    plant, table = rig(of)
    return judged(plant, damage(table), DAMAGES_RIGHT.get(name, set()))


def judged(plant: Plant, table: Table, right: set[str]) -> tuple[str, str]:
    """Return (outcome, what was found); `right`: the names that describe the mistake."""
    severe = [f for f in checks(plant, [table]) if f.severe]
    if severe:
        return "found", f"{severe[0].kind}: {severe[0].what}"[:90]
    try:
        done = diagnose(plant, [table], catalogue((CATALOGUE,)), limits())
        if wrong := relabelled(done, limits()):
            return "found", f"{wrong[0].kind}: {wrong[0].what}"[:90]
        found = contract(done)
    except InputError as e:
        return "refused", str(e)[:90]
    named = {f["effect"]: f["probability"] for f in found["findings"]}
    text = f"{found['verdict']}: " + ", ".join(f"{e} {p:.2f}" for e, p in named.items())
    sure = {e for e, p in named.items() if p > CONFIDENT}
    return ("WRONG" if sure - right else "right" if sure else "unsure"), text.removesuffix(": ")


TABLES = (("wrong plant", PLANTS_WRONG, plant_result), ("damaged recording", DAMAGES, damage_result))


def main(names: list[str]) -> int:
    """Print the tables; return 1 where something was named wrongly with confidence."""
    wrong, lines = 0, []
    for title, cases, result in TABLES:
        chosen = [n for n in cases if not names or n in names]
        outcomes = []
        lines += ["", f"| {title} | outcome | what was found |", "|---|---|---|"]
        for name in chosen:
            outcome, text = result(name)
            outcomes.append(outcome)
            lines.append(f"| {name} | {outcome} | {text} |")
            print(lines[-1], flush=True)
        counted = ", ".join(f"{outcomes.count(o)} {o}" for o in dict.fromkeys(outcomes))
        lines += ["", f"{len(chosen)}: {counted}."]
        print(lines[-1], flush=True)
        wrong += outcomes.count("WRONG")
    if not names:
        PAGE.write_text(TEXT + "\n".join(lines) + "\n")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
