"""Laws of published systems that faults imitate, that are two at once, and that act in chaos."""

import numpy as np
import pytest

from tests.bench.laws import smoothed
from tests.bench.published import plant_of
from tests.laws.published import SYSTEMS
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant.files import loads


def test_a_law_stands_without_the_names_that_imitate_it():
    """Monod's growth of a reactor, whose first names are two faults of the sensor."""
    system = next(s for s in SYSTEMS if s.name == "bioreactor")
    found = diagnose(loads(system.plant), system.draw(0).tables[:-1], catalogue(), limits())
    assert not found.shown
    assert found.law is not None
    assert [t.form.name for t in found.law.proposal.terms] == ["saturation_product"]


def test_two_laws_missing_at_once_are_found_at_both_places():
    """A saturation and a lag of the sensors were named: each law alone explains less than they do."""
    system = next(s for s in SYSTEMS if "both" in s.name)
    drawn = system.draw(0)
    found = diagnose(plant_of(system, drawn), drawn.tables[:-1], catalogue(), limits())
    assert not found.shown
    assert set(found.decision.named) == {("law", "rabbits"), ("law", "wolves")}
    for node, size in (("rabbits", -0.9), ("wolves", 0.8)):
        q = {k: found.final.plant.parameters[f"{k}1_law_{node}"].value for k in "AZW"}
        assert q["A"] / (q["Z"] * q["W"]) == pytest.approx(size, rel=0.01)


def test_the_peers_get_the_flow_that_is_missing():
    system = next(s for s in SYSTEMS if "one term" in s.name)
    drawn = system.draw(0)
    _, flows = smoothed(plant_of(system, drawn), drawn.tables[:-1], list(system.missing))
    (signals, x, flow), (node, law) = flows["wolves"], next(iter(system.missing.items()))
    true = law(drawn.truth[0], *system.coefficients[node])
    assert [str(s.value.value) for s in signals] == ["wolves", "rabbits"] and x.shape == (len(flow), 2)
    assert np.median(np.abs(flow - true)) < 0.15 * np.ptp(true)


@pytest.mark.slow  # a minute
def test_the_law_of_a_chaotic_system_is_found_in_pieces():
    system = next(s for s in SYSTEMS if s.name == "Lorenz")
    found = diagnose(loads(system.plant), system.draw(0).tables[:1], catalogue(), limits())
    assert not found.shown
    assert [(t.form.name, t.variables) for t in found.law.proposal.terms] == [("power", {"x"})]
    assert found.law.fitted.plant.parameters["n1_law_x"].value == pytest.approx(3, abs=0.1)
