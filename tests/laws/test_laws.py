"""A concealed law is found, written and found again by name; where nothing is missing, none is claimed."""

import json
from dataclasses import replace

import pytest
import yaml

from tests.laws.prove import EQUAL, difference
from tests.laws.rigs import LAWS, make
from thermoctl.cli import main
from thermoctl.diagnose.candidates import candidates
from thermoctl.diagnose.case import Budget, case
from thermoctl.diagnose.catalogue import catalogue
from thermoctl.diagnose.fit import fitted
from thermoctl.diagnose.law import FEWEST_REFITS, REFITS, SIMPLER, affordable, find_law
from thermoctl.diagnose.law_result import law_entry, law_section
from thermoctl.diagnose.limits import limits
from thermoctl.diagnose.rig import Rig
from thermoctl.plant import load, save

ENTROPIC = next(law for law in LAWS if law.name == "entropic heat")


def look(made):
    """The law that the plant's refit leaves, without the catalogue."""
    known = case(made.plant, made.tables[:2], {}, Budget(80))
    first = fitted(known, known.plant, (), known.null)
    return known, find_law(known, first, limits(), made.tables[2:3])


@pytest.fixture(scope="module")
def found():
    made = make(ENTROPIC, "reactor", "middle", "closed", 7)
    return made, *look(made)


def test_a_law_has_its_place_its_variable_and_the_flow_of_the_truth(found):
    made, _, law = found
    assert law is not None
    assert law.proposal.place.where == "broth"
    assert {s.label for t in law.proposal.terms for s in t.signals} == {"current"}
    assert difference(law.fitted.plant, made) < EQUAL
    assert law.closed > 0.9


def test_the_entry_holds_units_and_the_report_draws_the_curve(found):
    _, _, law = found
    entry = json.loads(json.dumps(law_entry(law)))
    assert entry["into"] == "broth" and entry["parameters"]["A1"]["unit"] == "W"
    page = law_section(law)
    assert "<svg" in page and "95 %" in page


def test_the_extended_plant_is_a_plant_file(found, tmp_path):
    _, _, law = found
    save(law.fitted.plant, tmp_path / "plant.yaml", note="with a law")
    assert load(tmp_path / "plant.yaml").flows.keys() == law.fitted.plant.flows.keys()


def test_a_saved_law_is_an_effect_that_finds_its_place(found, tmp_path, capsys):
    made, known, law = found
    result = {"decision": {}, "hypotheses": [], "lost": [], "remainder": {"law": law_entry(law)}}
    (tmp_path / "diagnosis.json").write_text(json.dumps(result))
    own = tmp_path / "own"
    assert main(["effects", "save", str(tmp_path), "peltier", "--effects", str(own)]) == 0
    assert yaml.safe_load((own / "peltier.yaml").read_text())["effect"] == "peltier"
    rig = Rig(made.plant, known.drives(known.null.model), [t.columns for t in known.tables])
    entries = catalogue([own])
    assert [c.key for c in candidates(rig, entries)] == [("peltier", "broth")]
    save(made.plant, tmp_path / "plant.yaml")
    assert main(["effects", "check", str(own), "--plant", str(tmp_path / "plant.yaml")]) == 0
    assert main(["effects", "save", str(tmp_path), "peltier", "--effects", str(own)]) != 0
    assert "exists already" in capsys.readouterr().err


def test_a_larger_plant_gets_fewer_refits_of_laws(found):
    _, known, law = found
    once = affordable(known, law.fitted)
    often = affordable(replace(known, tables=known.tables * 2000), law.fitted)
    assert once == REFITS + SIMPLER and often == FEWEST_REFITS


def test_no_law_is_claimed_where_nothing_is_missing():
    assert look(make(None, "stage", "small", "closed", 3))[1] is None
