"""Twenty wrong plants of a sound recording: found by the checks, named rightly, or not named with confidence.

`python -m tests.checks.wrong_plants [NAME ...]` (make wrong-plants) prints a table. Wrong is only a finding that says with a
probability above CONFIDENT that the rig has physics which it lacks.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

from tests.checks.rigs import PLANTS, rig
from tests.checks.test_checks import WRONG
from thermoctl.checks import checks
from thermoctl.diagnose.catalogue import CATALOGUE, catalogue
from thermoctl.diagnose.diagnosis import diagnose
from thermoctl.diagnose.limits import limits
from thermoctl.diagnose.result import contract
from thermoctl.plant import loads
from thermoctl.yamlfile import InputError

CONFIDENT = 0.9
RIG = "two blocks"
LINK = "  between: {from: one, into: two, rate: G_12 * (one - two), unit: W}\n"
CAPACITY = "C_1: {value: 6, unit: J/K, range: [2, 14]}"
LOSS = "rate: G_1 * (one - air)"
SENSOR = "temperature_1: {value: one,"
PLANTS_WRONG: Mapping[str, tuple[list[tuple[str, str]], set[str]]] = {  # replacements, right names
    **{k: ([(old, new)], set()) for k, (old, new, *_) in WRONG.items()},
    "no link": ([(LINK, ""), ("  G_12: {value: 0.02, unit: W/K, range: [0.004, 0.08]}\n", "")], {"missing_link"}),
    "link of the wrong sign": ([("G_12 * (one - two)", "G_12 * (two - one)")], {"missing_link"}),
    "heat into the other block": ([("power: {into: one", "power: {into: two")], {"heat_split"}),
    "sensors exchanged": ([("{value: one,", "{value: @,"), ("{value: two,", "{value: one,"), ("@", "two")], set()),
    "capacity fixed ten times too large": ([(CAPACITY, "C_1: {value: 60, unit: J/K}")], set()),
    "capacity fixed ten times too small": ([(CAPACITY, "C_1: {value: 0.6, unit: J/K}")], set()),
    "heat in kW": ([("rate: heat,", "rate: 1000 * heat,")], {"sensor_gain"}),
    "half of the heat": ([("rate: heat,", "rate: 0.5 * heat,")], {"sensor_gain"}),
    "sensor in degF": ([(SENSOR, "temperature_1: {value: 1.8 * one + 32,")], set()),
    "sensor with a gain": ([(SENSOR, "temperature_1: {value: 1.1 * one,")], {"sensor_gain", "cold_junction_drift"}),
    "sensor with an offset": ([(SENSOR, "temperature_1: {value: one + 5,")], {"sensor_offset_step", "second_ambient"}),
    "late sensor": ([(SENSOR, 'temperature_1: {value: "delay(one, 60)",')], {"sensor_lag", "sensor_delay"}),
    "loss as the square": ([(LOSS, "rate: 0.1 * G_1 * (one - air) * abs(one - air)")], {"natural_convection", "radiation"}),
    "start 20 K too warm": ([("one: {unit: degC, storage: C_1, initial: air,", "one: {unit: degC, storage: C_1, initial: air + 20,")], set()),
    "noise of a hundredth": ([("noise: 0.1", "noise: 0.001")], set()),
}  # fmt: skip


def result(name: str) -> tuple[str, str]:
    """Return (outcome, what was found): refused, found, right, unsure or WRONG."""
    changes, right = PLANTS_WRONG[name]
    text = PLANTS[RIG]
    for old, new in changes:
        assert old in text, f"{name}: '{old}' is not in the plant"
        text = text.replace(old, new)
    _, table = rig(RIG)
    try:
        plant = loads(text)
    except InputError as e:
        return "refused", str(e)[:60]
    severe = [f for f in checks(plant, [table]) if f.severe]
    if severe:
        return "found", f"{severe[0].kind}: {severe[0].what}"[:90]
    found = contract(diagnose(plant, [table], catalogue((CATALOGUE,)), limits()))
    named = {f["effect"]: f["probability"] for f in found["findings"]}
    text = f"{found['verdict']}: " + ", ".join(f"{e} {p:.2f}" for e, p in named.items())
    sure = {e for e, p in named.items() if p > CONFIDENT}
    return ("WRONG" if sure - right else "right" if sure else "unsure"), text


def main(names: list[str]) -> int:
    """Print the table; return 1 where a plant led to a wrong name with confidence."""
    wrong = 0
    print("| wrong plant | outcome | what was found |\n|---|---|---|")
    for name in names or PLANTS_WRONG:
        outcome, text = result(name)
        wrong += outcome == "WRONG"
        print(f"| {name} | {outcome} | {text} |", flush=True)
    print(f"named wrongly with confidence: {wrong} of {len(names or PLANTS_WRONG)}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
