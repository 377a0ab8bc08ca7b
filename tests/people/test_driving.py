"""Commands that drive a rig: what they say and ask first, and that the amplifier is off whatever happens meanwhile.

Judged by what the back end received tick by tick. The rig is ticked in this process; its command socket is the daemon's own."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.process import LIMIT_S, Daemon, patient, wait
from thermoctl import cli
from thermoctl.calibration import drive
from thermoctl.calibration.commands import record
from thermoctl.calibration.schedules import forecast
from thermoctl.calibration.simulated_rig import SimulatedRig
from thermoctl.configuration.settings import load_settings
from thermoctl.control import arming
from thermoctl.daemon.answers.snapshot import status
from thermoctl.daemon.control_socket import Connection, ask
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.experiments import Schedule
from thermoctl.rig.signals import INDEX
from thermoctl_hal.base.backend import ROLE
from thermoctl_hal.simulated.faulty import Fault, FaultInjector

STATE, COMMAND = INDEX["state"], INDEX["command"]
EXPERIMENT = """\
format: thermoctl-experiments/1
rate_um_s: 16.6667
experiments:
  move: {title: Up and down, parts: [{hold: [[1, 0], [8, 20], [60, 0]]}]}
"""
COMMANDS = {
    "tune": ["tune", "--config", "rig.yaml", "--yes"],
    "experiment": ["experiment", "move", "--config", "rig.yaml", "--out", "move.parquet", "--yes"],
}
HAZARDS = {
    "NaN position": Fault("nan", (ROLE["position_um"],), 0.0, math.inf, 0.0),
    "stale position": Fault("drop", (ROLE["position_um"],), 0.0, math.inf, 0.0, stale_after_s=0.01),
    "encoder gone": Fault("disconnect", (ROLE["position_um"],), 0.0, math.inf, 0.0),
    "drive gone": Fault("disconnect", (ROLE["amplifier_state"],), 0.0, math.inf, 0.0),
    "SIGTERM": signal.SIGTERM,
    "a closed terminal": signal.SIGHUP,
}


class Watched:
    """The rig's back end, with what it was sent: (enable) of each tick, and a hazard 200 ticks after arming."""

    def __init__(self, running, hazard=None):
        self.running, self.rows, self.enabled, self.hazard = running, [], [], hazard
        self.injector = running.rig.backend = FaultInjector(running.backend, [], seed=1)
        self.at = None
        inner = running.backend.write

        def write(value, enable):
            self.enabled.append(bool(enable))
            inner(value, enable)

        running.backend.write = write
        running.record = self.record
        running.until(lambda row: row[STATE] == arming.READY, "READY")
        running.run()

    def record(self, row):
        self.rows.append(row.copy())
        armed = sum(self.enabled[-201:])
        if self.at is None and armed > 200 and self.hazard is not None:
            self.at = len(self.rows)
            if isinstance(self.hazard, Fault):
                self.injector.faults.append(self.hazard)
            else:
                self.hazard()

    def off_after(self, first):
        """Ticks from index `first` until the amplifier was sent a disable."""
        return self.enabled[first:].index(False)


@pytest.fixture
def folder(settings, monkeypatch):
    place = Path(settings.path).parent
    (place / "experiments.yaml").write_text(EXPERIMENT)
    monkeypatch.chdir(place)
    return place


@pytest.fixture
def terminal():
    """A closed terminal matters, also where the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("hazard", HAZARDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_hazard_while_driving_disables_the_amplifier(command, hazard, folder, running, capsys):
    what = HAZARDS[hazard]
    watched = Watched(running, what if isinstance(what, Fault) else lambda: os.kill(os.getpid(), what))
    assert cli.main(COMMANDS[command]) == (3 if isinstance(what, Fault) else 130)
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "the amplifier is disabled" in err, err
    rows = np.array(watched.rows)
    if not isinstance(what, Fault):
        first = int(np.flatnonzero(rows[:, COMMAND] == arming.DISARM)[0])
    else:  # the tick in which the law names it: for a stale reading, protection.stale_s after the last good one
        first = int(np.flatnonzero(rows[:, STATE] == arming.FAULT)[0])
        stale = running.settings.protection.stale_s["position_um"] / running.settings.loop.period_s
        late_s = running.settings.protection.amplifier_s if hazard == "drive gone" else 0.0
        limit = (stale if hazard == "stale position" else 0) + late_s / running.settings.loop.period_s + 2
        assert first - watched.at <= limit, (first, watched.at)
    assert watched.off_after(first) <= 2
    assert not any(watched.enabled[first + 2 :]), "and it stays off"
    if isinstance(what, Fault):
        assert status(running.shared)["state"] == "FAULT", "the fault stays for the person to read"
    elif command == "experiment":
        kept = Path("move.parquet").read_bytes()
        assert cli.main(COMMANDS[command]) == 2 and "never overwritten" in capsys.readouterr().err
        assert Path("move.parquet").read_bytes() == kept


@pytest.mark.parametrize("command", COMMANDS)
def test_kill_9_of_the_command_disarms(command, folder, running):
    """The kernel closes its connection, and the daemon disarms in the next tick it commands."""
    watched = Watched(running)
    process = subprocess.Popen(
        [sys.executable, "-m", "thermoctl.cli", *COMMANDS[command]],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    watched.hazard = process.kill
    process.wait(60)
    deadline = time.monotonic() + 60
    while status(running.shared)["state"] == "ARMED":
        assert time.monotonic() < deadline
        time.sleep(0.01)  # how often we look, not a wait
    rows = np.array(watched.rows)
    first = int(np.flatnonzero(rows[:, COMMAND] == arming.DISARM)[0])
    assert watched.off_after(first) <= 2
    print(f"{command}: {first - watched.at} ticks from kill -9 to the disarm command")


@pytest.mark.parametrize(
    ("command", "event"), [("tune", "SIGTERM of the daemon"), ("experiment", "SIGKILL of the loop")]
)
def test_the_command_ends_with_its_daemon(command, event, folder):
    """Exit status 3 and one line. That the drive is off is judged at the wire, in the last test of this file.

    Both commands drive through `calibration.daemon_rig.DaemonRig.run`: each event needs one of them."""
    daemon = Daemon(patient(folder / "rig.yaml"))
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", *COMMANDS[command]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        wait(lambda: daemon.ask("status")["state"] == "ARMED", "ARMED")
        if event == "SIGTERM of the daemon":
            daemon.process.terminate()
        else:
            os.kill(daemon.child("loop"), signal.SIGKILL)
        _, err = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 3 and err.count("\n") == 1 and "ended after" in err, err
        assert daemon.process.wait(LIMIT_S) == (0 if event == "SIGTERM of the daemon" else 1)
    finally:
        daemon.kill()


def test_the_rig_without_its_daemon_is_not_driven(folder, capsys):
    """A rig of devices is driven only through the daemon: nothing is opened, one line, status 3."""
    text = Path("rig.yaml").read_text()
    root = Path(__file__).resolve().parents[2]
    Path("rig.yaml").write_text(
        text.replace(
            "backend: simulated",
            f"backend: devices\n  devices: [{{name: encoder, port: /dev/not-there, "
            f"profile: {root}/config/devices/encoder-serial.yaml, roles: {{position: position_um}}}}]",
        )
    )
    for command in (*COMMANDS.values(), ["calibrate", "--config", "rig.yaml", "--yes"]):
        assert cli.main(command) == 3
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and "only through the daemon" in err


def test_nobody_is_moved_without_a_yes(folder, running, capsys, monkeypatch):
    """Without a terminal and without --yes: refused; at a terminal: which rig, how far, how long, how warm, and a question."""
    watched = Watched(running)
    for command in (*COMMANDS.values(), ["calibrate", "--config", "rig.yaml", "--yes"]):
        if command[0] == "calibrate":
            (folder / "experiments.yaml").write_text(
                EXPERIMENT.replace("move:", "test_1:")
                + "".join(
                    f"  {n}: {{title: a, parts: [{{hold: [[9, 100]]}}]}}\n" for n in ("test_2", "test_3")
                )
                + "".join(
                    f"  {n}: {{title: a, parts: [{{hold: [[9, 100]]}}]}}\n" for n in ("test_4a", "test_4b")
                )
            )
        assert cli.main(command[:-1]) == 2
        said, err = capsys.readouterr()
        assert "--yes" in err and err.count("\n") == 1
        assert (
            "rig 'simulated' (rig.yaml)" in said and f"the daemon at {running.settings.socket.path}" in said
        )
        assert " um, " in said and "degC predicted, the protection trips at 80 degC" in said
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr("builtins.input", lambda question: "no")
        assert cli.main(command[:-1]) == 1
        monkeypatch.undo()
        monkeypatch.chdir(folder)
    assert not any(watched.enabled)


def test_an_experiment_of_a_diagnosis_that_is_declined_never_began(folder, running, monkeypatch):
    """`diagnose --resolve` said of it that it had not come to its end, and named a recording that there was not."""
    watched = Watched(running)
    Path("next.yaml").write_text(
        "format: thermoctl-experiments/1\nexperiments:\n  next:\n    title: next\n    sample_s: 1\n    inputs:\n"
        "      setpoint_um: {corners: [[0, 0], [6, 20]]}\n"
    )
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: "no")
    with pytest.raises(InputError, match="next.yaml: not run, the answer was not `go`"):
        record(Path("next.yaml"), Path("round_1.csv"), "rig.yaml", None)
    assert not any(watched.enabled) and not Path("round_1.csv").exists()


def test_a_rig_that_somebody_uses_is_left_alone(folder, running, capsys):
    """ARMED by a person: nothing moves, nothing is disarmed; in FAULT: the fault stays latched."""
    watched = Watched(running)
    path = running.settings.socket.path
    assert ask(path, {"command": "arm"})["ok"]
    for command in COMMANDS.values():
        assert cli.main(command) == 3
        assert "is ARMED" in capsys.readouterr().err
    with Connection(path) as other:  # beside the question before: the daemon itself refuses
        assert not other.ask({"command": "arm", "held": True})["ok"]
    now = status(running.shared)
    armed = [r[INDEX["setpoint_um"]] for r in watched.rows if r[INDEX["state"]] == arming.ARMED]
    assert now["state"] == "ARMED" and np.ptp(armed) == 0
    watched.injector.faults.append(HAZARDS["NaN position"])
    while status(running.shared)["state"] != "FAULT":
        time.sleep(0.01)  # how often we look, not a wait
    watched.injector.faults.clear()
    for command in COMMANDS.values():
        assert cli.main(command) == 3
        assert "is FAULT" in capsys.readouterr().err
    assert status(running.shared)["state"] == "FAULT"


def test_a_connection_that_ends_disarms_only_what_it_armed(folder, running):
    Watched(running)
    path = running.settings.socket.path
    with Connection(path) as one:
        assert one.ask({"command": "arm", "held": True})["ok"]
        assert one.ask({"command": "disarm"})["ok"]
        assert ask(path, {"command": "arm"})["ok"]  # a person, since
    with Connection(path) as other:
        assert other.ask({"command": "status"})["state"] == "ARMED", "asked after the first one's end"
    assert ask(path, {"command": "disarm"})["ok"]
    while ask(path, {"command": "status"})["state"] != "READY":
        time.sleep(0.01)  # how often we look, not a wait
    with Connection(path) as one:
        assert one.ask({"command": "arm", "held": True})["ok"]
    deadline = time.monotonic() + 60
    while ask(path, {"command": "status"})["state"] == "ARMED":
        assert time.monotonic() < deadline
        time.sleep(0.01)  # how often we look, not a wait


@pytest.mark.parametrize("kind", ["nan", "drop", "disconnect"])
def test_the_simulated_rig_runs_the_same_law(kind, folder, capsys, monkeypatch):
    """Without a daemon, in simulated time: a hazard trips the law there, too."""
    from thermoctl_hal.simulated.rig import SimulatedBackend

    sent, write = [], SimulatedBackend.write
    monkeypatch.setattr(
        SimulatedBackend,
        "write",
        lambda self, value, enable: (sent.append(enable), write(self, value, enable))[1],
    )
    begin = SimulatedBackend.open
    monkeypatch.setattr(SimulatedBackend, "open", lambda self: (sent.clear(), begin(self))[1])
    text = Path("rig.yaml").read_text()
    Path("rig.yaml").write_text(
        text.replace(
            "  backend: simulated",
            f"  backend: simulated\n  faults: [{{kind: {kind}, role: position_um, at_s: 3, for_s: 100}}]",
        )
    )
    for command in COMMANDS.values():
        assert cli.main(command) == 3
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and "position_" in err
        armed = np.flatnonzero(
            sent
        )  # ticks of 1 ms; the first reading is at 1 ms, and a dropped one is stale after 50
        assert 3000 <= armed[-1] + 1 <= 3002 + (50 if kind == "drop" else 0)


def test_a_coil_that_would_become_too_hot_is_not_driven(settings):
    """From the plant file: 250 um take 3.3 W; the model says how warm that is."""
    rig = SimulatedRig(settings)
    t = np.array([0.0, 15.0, 7200.0])
    schedule = Schedule("hold", "hold", t, np.array([0.0, 250.0, 250.0]), 7200.0)
    power, peak = forecast(settings, schedule, 22.0)
    assert power[-1] == pytest.approx(5.0 * (250 / 307.7) ** 2 * (1 + 0.00393 * (peak - 20.0)), rel=0.01)
    assert 30.0 < peak < 80.0
    assert drive.agreed(rig, [schedule], False), "nothing real moves"
    cool = load_settings(settings.path)
    cool.protection.__dict__["coil_limit_c"] = peak - 1.0
    rig.settings = cool
    with pytest.raises(InputError, match="coil_limit_c"):
        drive.agreed(rig, [schedule], True)


@pytest.mark.slow  # two programs and wires in real time, 1 minute
def test_the_drive_itself_is_off_whatever_is_killed(tmp_path):
    """At the wire, judged by the emulated drive: 100 samples a second of whether it is enabled, by the machine's own clock.

    Killing a process is answered by the daemon or by the drive's own watchdog; either way within ten watchdog times on a busy
    machine, and what was measured is printed."""
    from tests.hal.test_wire_daemon import CLI, Chain

    (tmp_path / "experiments.yaml").write_text(EXPERIMENT)
    chain = Chain(tmp_path)
    watchdog_s = 0.2  # of the drive, in config/wire.yaml

    def enabled():
        table = chain.reference()
        return table.t, table.columns["enabled"] == 1

    def scenario(command, what, event):
        begin = time.monotonic()
        while chain.status().get("state") != "READY":
            chain.ask("disarm")
            assert time.monotonic() - begin < 60, chain.status()
            time.sleep(0.05)  # how often we ask, not a wait
        arguments = [a.replace("rig.yaml", str(chain.config)) for a in COMMANDS[command]]
        process = subprocess.Popen([*CLI, *arguments], stderr=subprocess.PIPE, cwd=tmp_path, text=True)
        chain.until(lambda s: s.get("state") == "ARMED" and s.get("uptime_s", 0) > 0, 60)
        while not enabled()[1][-1]:
            assert time.monotonic() - begin < 60, (command, what)
        at = time.monotonic()
        event(process)
        _, err = process.communicate(timeout=60)
        while (seen := enabled())[1][-1] or seen[0][-1] < at + 2 * watchdog_s:
            assert time.monotonic() - at < 60, (command, what)
        seconds = max(float(seen[0][seen[1]][-1]) - at, 0.0)  # the last sample in which it was driven
        print(f"{command}, {what}: driven for {1e3 * seconds:.0f} ms after it")
        assert seconds < 10 * watchdog_s, (command, what)
        if what != "kill -9 of the command":
            status = 130 if what == "SIGTERM of the command" else 3
            assert process.returncode == status and err.count("\n") == 1, err

    try:
        for command in COMMANDS:
            scenario(command, "encoder unplugged", lambda p: chain.tell("encoder unplug"))
            chain.tell("encoder plug")
            scenario(command, "SIGTERM of the command", lambda p: p.terminate())
            scenario(command, "kill -9 of the command", lambda p: p.kill())
            for what, status in (("kill -9 of the loop", 1), ("SIGTERM of the daemon", 0)):
                pid = int(_loop_pid(chain)) if status else chain.daemon.pid
                number = signal.SIGKILL if status else signal.SIGTERM
                scenario(command, what, lambda p, pid=pid, number=number: os.kill(pid, number))
                assert chain.daemon.wait(60) == status
                chain.daemon = subprocess.Popen(
                    [*CLI, "run", "--config", str(chain.config)], stderr=subprocess.DEVNULL
                )
                chain.until(lambda s: s.get("state") == "READY", 60)
    finally:
        chain.stop()


def _loop_pid(chain):
    from thermoctl.daemon.tick.assemble import shared_name
    from thermoctl.daemon.tick.shared import LOOP_PID, Shared

    return Shared.attach(shared_name(load_settings(chain.config))).counters[LOOP_PID]
