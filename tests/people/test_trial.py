"""Gains on trial in the daemon: however a trial ends, the loop has the configuration's gains, and arming never jumps."""

import time

import numpy as np
import pytest

from thermoctl.control import arming
from thermoctl.daemon.answers.snapshot import status
from thermoctl.daemon.command_server import Commands
from thermoctl.daemon.control_socket import Connection, ask
from thermoctl.rig.signals import INDEX
from thermoctl_hal.base.backend import ROLE
from thermoctl_hal.simulated.faulty import Fault, FaultInjector

TRIED = {"kp": 0.02, "ti_s": 0.008, "td_s": 0.0005}


@pytest.fixture
def rig(running):
    """The running rig, its rows as they are made, and the gains of its configuration."""
    running.rows = []
    running.record = lambda row: running.rows.append(row.copy())
    running.injector = running.rig.backend = FaultInjector(running.backend, [], seed=1)
    running.until(lambda row: row[INDEX["state"]] == arming.READY, "READY")
    running.run()
    c = running.settings.control
    running.own = {"kp": c.kp, "ti_s": c.ti_s, "td_s": c.td_s}
    return running


def in_force(rig):
    p = rig.rig.law.parameters
    return {"kp": p.kp, "ti_s": p.ti_s, "td_s": p.td_s}


def until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)  # how often we look, not a wait


def armed(rig):
    connection = Connection(rig.settings.socket.path)
    assert connection.ask({"command": "arm", "held": True})["ok"]
    return connection


ENDS = {
    "its connection is gone": lambda rig, c: c.socket.close(),
    "disarmed by itself": lambda rig, c: c.ask({"command": "disarm"}),
    "disarmed by another": lambda rig, c: ask(rig.settings.socket.path, {"command": "disarm"}),
    "a fault, then its connection": lambda rig, c: (
        rig.injector.faults.append(Fault("nan", (ROLE["position_um"],), 0.0, float("inf"), 0.0)),
        until(lambda: status(rig.shared)["state"] == "FAULT"),
        c.socket.close(),
    ),
    "the command process is killed": lambda rig, c: Commands(
        rig.shared, rig.settings, lambda now, started: (rig.settings,), lambda *a, **k: None
    ),
}


@pytest.mark.parametrize("end", ENDS)
def test_the_old_gains_are_back_however_a_trial_ends(rig, end):
    connection = armed(rig)
    assert connection.ask({"command": "gains", **TRIED})["ok"] and in_force(rig) == TRIED
    ENDS[end](rig, connection)
    until(lambda: in_force(rig) == rig.own)
    assert status(rig.shared)["state"] != "ARMED"
    connection.socket.close()
    rig.injector.faults.clear()
    until(lambda: ask(rig.settings.socket.path, {"command": "disarm"})["state"] == "READY")
    assert ask(rig.settings.socket.path, {"command": "arm"})["ok"] and in_force(rig) == rig.own


def test_a_change_of_gains_does_not_move_the_drive(rig):
    """No jump at the start of a trial, nor at the arming after it: the drive changes no more than from tick to tick."""
    with armed(rig) as connection:
        connection.ask({"command": "setpoint", "value": 3.0})
        until(lambda: status(rig.shared)["reference_um"] == 3.0)
        until(lambda: len(rig.rows) > 0 and rig.rows[-1][INDEX["generation"]] == 0)
        first = connection.ask({"command": "gains", "kp": 0.012, "ti_s": 0.006, "td_s": 0.001})["generation"]
        until(lambda: rig.rows[-1][INDEX["tick"]] > rig.rows[0][INDEX["tick"]] + 200)
    rows = np.array(rig.rows)
    on = rows[:, INDEX["state"]] == arming.ARMED
    change = np.abs(np.diff(rows[on][:, INDEX["drive"]]))
    generation = rows[on][:, INDEX["generation"]]
    at = np.flatnonzero(np.diff(generation) == 1)[0]
    assert generation[at + 1] == first and change[at : at + 2].max() <= 1.5 * change[:at].max()
    until(lambda: status(rig.shared)["state"] == "READY")
    ask(rig.settings.socket.path, {"command": "arm"})
    until(lambda: rig.rows[-1][INDEX["state"]] == arming.ARMED)
    begin = next(r for r in rig.rows[len(rows) :] if r[INDEX["state"]] == arming.ARMED)
    assert abs(begin[INDEX["drive"]]) <= change.max() and in_force(rig) == rig.own


def test_only_the_session_that_armed_the_rig_tries_gains(rig):
    path = rig.settings.socket.path
    assert ask(path, {"command": "gains"}) == {"ok": True, **rig.own}
    assert "tune --write" in ask(path, {"command": "gains", **TRIED})["error"]
    ask(path, {"command": "arm"})
    assert "only over the connection" in ask(path, {"command": "gains", **TRIED})["error"]
    ask(path, {"command": "disarm"})
    until(lambda: status(rig.shared)["state"] == "READY")
    with armed(rig) as connection:
        for wrong in (
            {"kp": 1.0},
            {**TRIED, "kp": -1.0},
            {**TRIED, "ti_s": "x"},
            {**TRIED, "td_s": float("nan")},
            {**TRIED, "kp": True},
        ):
            answer = connection.ask({"command": "gains", **wrong})
            assert not answer["ok"] and "was expected" in answer["error"]
        assert in_force(rig) == rig.own
