"""docs/reference/diagnosis.md lists every key of a result, and no other."""

import re
from pathlib import Path

import pytest

from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report.words import NEXT
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings

LAW = [
    "where",
    "expression",
    "plain",
    "part",
    "terms",
    "forms",
    "memory",
    "of",
    "parameters",
    "probability",
    "confirmed",
    "gain",
    "rms",
    "share_closed",
    "equivalent",
    "effect",
    "beside",
]
LOST = ("effect", "where", "beside", "probability", "below_best", "reason")
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/reference/diagnosis.md").read_text()
HEATER = ROOT / "docs/examples/heater"


@pytest.fixture(scope="module")
def result():
    plant = load(HEATER / "plant.yaml")
    tables = read_recordings(plant, [HEATER / "run_1.csv", HEATER / "run_2.csv"])
    entries = {k: e for k, e in catalogue().items() if k in ("external_heat_source", "radiation")}
    return contract(diagnose(plant, tables, entries, limits()))


def keys(value, prefix=""):
    """Paths of mappings' keys; those below one that holds names (of outputs, parameters) are left out."""
    for key, item in value.items():
        yield prefix + key
        if isinstance(item, list) and item and isinstance(item[0], dict):
            yield from keys(item[0], f"{prefix}{key}[].")
        elif isinstance(item, dict) and key in ("fit", "remainder"):
            yield from keys(item, f"{prefix}{key}.")


def test_every_key_of_a_result_is_on_the_page(result):
    listed = {
        k
        for row in re.findall(r"^\| (`.*?) \|", PAGE.split("## Keys")[1], re.MULTILINE)
        for k in re.findall(r"`([^`]+)`", row)
    }
    found = set(keys(result)) - {"fit"}
    internal = {k for k in found - listed if k.startswith("hypotheses[].")}
    assert found - internal <= listed, found - internal - listed
    absent = {
        k
        for k in listed - found
        if not k.startswith(("remainder.", "lost[].", "trends", "findings[].members"))
    }
    assert not absent, (
        "this result has no remainder, nothing that lost, no trend, no family, and all other keys"
    )
    assert {k for k in listed if k.startswith("lost[].")} == {f"lost[].{k}" for k in LOST}
    assert {k for k in listed if k.startswith("remainder.")} == {
        f"remainder.{k}"
        for k in ("share_closed", "rms", "over_noise", "node", "follows", "law", *(f"law.{k}" for k in LAW))
    }


def test_every_verdict_is_on_the_page():
    verdicts = PAGE.split("## Verdicts")[1].split("## Keys")[0]
    assert set(re.findall(r"^\| `(\w+)` \| [a-z]", verdicts, re.MULTILINE)) - {"verdict"} == set(NEXT)
