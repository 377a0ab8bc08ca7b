"""The tick in simulated time: determinism, replay to the bit, faults, arming and reload as a whole."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import thermoctl
from tests.daemon.conftest import make_model
from tests.simulated import run_simulated
from thermoctl.control import arming, faults
from thermoctl.control.law import OUTPUTS
from thermoctl.daemon.offline.replay import replay
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.daemon.recorder import LAW_VERSION, law_metadata, read_law_metadata
from thermoctl.daemon.tick.assemble import law_parameters
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.channels import CHANNELS, DEFAULT
from thermoctl.rig.signals import INDEX, NAMES, SIGNALS
from thermoctl_hal.base.backend import ERROR, OK, ROLE, ROLES, STALE


def column(rows, name):
    return rows[:, INDEX[name]]


def test_one_list_of_names():
    """Signals, law, back ends and settings name the same things in the same order."""
    first, state = INDEX["position_raw_um"], INDEX["state"]
    assert CHANNELS == ROLES
    assert NAMES[first : first + len(ROLES)] == tuple(DEFAULT.signal.values())
    assert NAMES[state:first] == OUTPUTS


def test_the_tick_is_the_block_diagram():
    source = (
        Path(thermoctl.__file__).parent / "daemon/tick/loop.py"
    ).read_text()  # the module that runs is compiled
    lines = [
        line.strip()
        for line in source[source.index("    def tick(") : source.index("    def sample(")].splitlines()
    ]
    stages = [
        stage
        for line in lines
        for stage in ("sample", "estimate", "compensate", "control", "protect", "actuate", "publish")
        if f".{stage}(" in line
    ]
    assert stages == ["sample", "estimate", "compensate", "control", "protect", "actuate", "publish"]


class Broken:
    """A back end whose readings can be spoilt: {role: status or value}."""

    def __init__(self, inner):
        self.inner, self.spoilt, self.written = inner, {}, []

    def read(self, now_s):
        sample = self.inner.read(now_s)
        for role, how in self.spoilt.items():
            k = ROLE[role]
            if isinstance(how, float):
                sample.value[k] = how
            else:
                sample.status[k], sample.fresh[k] = how, False
        return sample

    def write(self, drive, enable):
        self.written.append((drive, enable))
        self.inner.write(drive, enable)

    def close(self):
        self.inner.close()


class Session(Simulation):
    """A simulation that keeps its rows and can spoil its readings."""

    def __init__(self, settings, **changes):
        self.rows_list = []
        model, self.parameters = make_model(), dataclasses.replace(law_parameters(settings), **changes)
        super().__init__(settings, model, self.parameters, lambda row: self.rows_list.append(row.copy()))
        self.metadata = law_metadata(model, self.parameters, self.period_s, 0, 0, None)
        self.rig.backend = self.broken = Broken(self.backend)

    @property
    def rows(self):
        return np.array(self.rows_list)

    @property
    def state(self):
        return arming.STATES[int(self.row[INDEX["state"]])]

    @property
    def faults(self):
        return {f.name for f in faults.decode(self.row[INDEX["fault_bits"]])}


@pytest.fixture
def session(quiet):
    s = Session(quiet)
    yield s
    s.close()


def test_the_loop_closes_and_holds_the_compensated_position(session):
    session.arm()
    session.command("setpoint", 8.0)
    session.tick(2500)
    rows = session.rows[-1000:]
    assert session.state == "ARMED" and not session.faults
    assert abs(column(rows, "compensated_um") - 8.0).max() < 0.2
    np.testing.assert_allclose(
        column(rows, "compensated_um"), column(rows, "position_um") + column(rows, "compensation_um")
    )
    speed = np.diff(column(session.rows, "reference_um")) / session.period_s
    assert abs(speed[200:]).max() <= 1000 / 60 * (1 + 1e-9)


def test_the_same_seed_gives_the_same_bits(quiet):
    schedule = [(0.3, "arm"), (0.5, "setpoint", 3.0), (0.9, "disarm")]
    one, two, other = (run_simulated(quiet, schedule, 1.0, seed, model=make_model()) for seed in (7, 7, 8))
    assert one.tobytes() == two.tobytes() and one.tobytes() != other.tobytes()
    assert column(one, "state")[-1] == arming.READY and (column(one, "enable") == 1).sum() == 600


def busy_session(session):
    """Arming, motion, a fault of each kind, recovery, reload of gains: what a replay has to go through."""
    session.arm()
    session.command("setpoint", 5.0)
    session.tick(400)
    session.reload(dataclasses.replace(session.parameters, kp=0.015, moving_average=7.0))
    session.tick(300)
    session.broken.spoilt = {"coil_c": ERROR}
    session.tick(150)
    assert session.state == "FAULT" and "coil_error" in session.faults
    session.broken.spoilt = {}
    session.tick(200)
    session.command("disarm")
    session.tick(5)
    session.arm()
    session.tick(100)
    session.broken.spoilt = {"position_um": float("nan")}
    session.tick(20)
    session.broken.spoilt = {}
    session.tick(20)
    assert session.state == "FAULT"


def test_replay_gives_the_recorded_bits(session):
    """A whole session, replayed from its rows: up to the reload from the start, after it from a kept state."""
    busy_session(session)
    rows = session.rows
    reload_at = int(np.flatnonzero(column(rows, "generation") == 1)[0])
    before = replay(rows[:reload_at], session.metadata)
    assert before.ticks == reload_at and not before.differences
    with_old_gains = replay(rows, session.metadata)
    assert "control_v" in with_old_gains.differences  # the comparison can fail


def test_replay_from_a_kept_state(quiet):
    """State boxes: at the reload, and every thousand ticks; each is a place where a replay may start."""
    session = Session(quiet)
    kept = []
    session.rig.state_box = type("Box", (), {"put": staticmethod(lambda numbers: kept.append(numbers))})()
    busy_session(session)
    session.close()
    rows, parameters = session.rows, dataclasses.replace(session.parameters, kp=0.015, moving_average=7.0)
    assert [int(k[1]) for k in kept] == [0, 1, 1]
    for numbers in kept:
        generation = int(numbers[1])
        gains = parameters if generation else session.parameters
        text = law_metadata(make_model(), gains, 1e-3, generation, int(numbers[0]), numbers[2:])
        part = rows[column(rows, "generation") == generation]
        result = replay(part, text)
        assert result.ticks > 100 and not result.differences
        assert result.ticks + result.skipped == len(part)


def test_replay_refuses_what_it_cannot_replay(session):
    session.tick(50)
    rows = session.rows
    with pytest.raises(InputError, match="ticks are missing after tick 10"):
        replay(np.delete(rows, 10, axis=0), session.metadata, "x.arrow")
    with pytest.raises(InputError, match="a replay cannot start"):
        replay(rows[3:], session.metadata)
    for text in ("{}", "nonsense", '{"version": 2}'):
        with pytest.raises(InputError, match="no usable law"):
            replay(rows, text)
    old = session.metadata.replace(f'"version": {LAW_VERSION}', '"version": 1')
    with pytest.raises(
        InputError, match=f"law version 1, this program has version {LAW_VERSION}.*that recorded it"
    ):
        replay(rows, old)


def test_law_metadata_comes_back_exact(session):
    found = read_law_metadata(session.metadata)
    assert found["parameters"].pack().tobytes() == session.parameters.pack().tobytes()
    assert found["model"].A_minus_I.tobytes() == make_model().A_minus_I.tobytes() and found["state"] is None


@pytest.mark.parametrize(
    "role,how,fault",
    [
        ("position_um", STALE, "position_stale"),
        ("position_um", ERROR, "position_error"),
        ("position_um", float("nan"), "position_range"),
        ("position_um", 380.0, "position_rate"),
        ("coil_c", ERROR, "coil_error"),
        ("coil_c", 900.0, "coil_range"),
        ("voltage_v", ERROR, "voltage_error"),
        ("current_a", float("inf"), "current_range"),
        ("air_c", ERROR, "air_error"),
        ("amplifier_state", 3.0, "amplifier_fault"),
    ],
)
def test_a_pulled_sensor_disables_the_amplifier_within_two_ticks(session, role, how, fault):
    session.arm()
    session.command("setpoint", 2.0)
    session.tick(300)
    session.broken.written.clear()
    compensation = session.row[INDEX["compensation_um"]]
    session.broken.spoilt = {role: how}
    session.tick(1 if role not in ("coil_c", "air_c") or how == ERROR else 101)
    assert session.state == "FAULT" and fault in session.faults
    assert session.broken.written[-1] == (0.0, False)
    enabled_after = [enable for _, enable in session.broken.written if enable]
    assert len(enabled_after) <= (0 if role not in ("coil_c", "air_c") or how == ERROR else 100)
    if role in ("coil_c", "voltage_v", "air_c") and how == ERROR:
        session.tick(300)
        assert session.row[INDEX["compensation_um"]] == compensation
    session.broken.spoilt = {}
    session.tick(150)
    session.command("arm")
    session.tick(2)
    assert session.state == "FAULT"  # latched: arming does not acknowledge
    session.command("disarm")
    session.tick(3)
    before = session.row[INDEX["compensated_um"]]
    session.command("arm")
    session.tick(5)
    assert session.state == "ARMED" and abs(session.row[INDEX["setpoint_um"]] - before) < 0.1


def test_a_write_that_fails_is_a_fault_of_the_next_tick(session):
    session.arm()

    def refuse(drive, enable):
        raise OSError("bus off")

    session.broken.write = refuse
    session.tick(2)
    assert session.state == "FAULT" and "amplifier_write" in session.faults


def test_rows_are_complete(session):
    session.arm()
    session.tick(10)
    row = session.row
    assert len(row) == len(SIGNALS)
    missing = {name for name in NAMES if not np.isfinite(row[INDEX[name]])}
    assert missing == {"supply_v"}
    assert row[INDEX["tick"]] == session.ticks and row[INDEX["t_s"]] == pytest.approx(session.ticks * 1e-3)
    k = ROLE["supply_v"]
    assert int(row[INDEX["status_bits"]]) >> (2 * k) & 3 == 3 and int(row[INDEX["status_bits"]]) & 3 == OK


@pytest.mark.parametrize(
    "name,value",
    [
        ("command", np.nan),
        ("command", 1e300),
        ("external_bits", 0.5),
        ("fresh_bits", np.inf),
        ("status_bits", -1e99),
    ],
)
def test_a_damaged_row_is_not_replayed(session, name, value):
    session.arm()
    rows = session.rows
    rows[5, INDEX[name]] = value
    with pytest.raises(InputError, match="tick 6 has a command, or bits"):
        replay(rows, session.metadata)
