"""A law that sensor faults imitate stands without them: Monod's growth of a published reactor, whose first names are two faults."""

from tests.laws.published import SYSTEMS
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant.files import loads


def test_a_law_stands_without_the_names_that_imitate_it():
    system = next(s for s in SYSTEMS if s.name == "bioreactor")
    found = diagnose(loads(system.plant), system.draw(0).tables[:-1], catalogue(), limits())
    assert not found.shown
    assert found.law is not None
    assert [t.form.name for t in found.law.proposal.terms] == ["saturation_product"]
