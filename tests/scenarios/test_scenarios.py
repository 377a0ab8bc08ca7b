"""The quickest fault scenarios at the wire in `make test`; all of them, twice, idle and loaded: `make scenarios`."""

import pytest

from tests.scenarios import run
from tests.scenarios.rigs import Rigs
from tests.scenarios.table import SCENARIOS, Scenario


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    r = Rigs(tmp_path_factory.mktemp("scenarios"))
    yield r
    r.close()


@pytest.mark.parametrize("scenario", [s for s in SCENARIOS if s.quick], ids=lambda s: s.name)
def test_behind_the_wire(rigs: Rigs, scenario: Scenario):
    run.run(scenario, rigs)


def test_every_scenario_has_its_own_name_and_ends_in_seconds():
    assert len({s.name for s in SCENARIOS}) == len(SCENARIOS) >= 35
    assert all(s.within_s + s.hold_s + s.watch_s < 6.0 for s in SCENARIOS)
