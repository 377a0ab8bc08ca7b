"""The unit in a booted systemd, the virtual rig behind its wires: after everything that can happen to the daemon, what was the
amplifier told? (issue 7). Slow: `make test-systemd`.

The amplifier's own record is the virtual rig's reference.csv (CLOCK_MONOTONIC, shared with the container): `enabled` is the
drive's state, 100 rows a second. Every scenario's figures are printed in one table at the end.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from tests.systemd.container import ROOT, Container, may_raise_limits, missing
from thermoctl.recording.files import read_table

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing())]
CONFIG = "/etc/thermoctl/rig.yaml"
RIG_UNIT = f"""[Unit]
Description=The virtual rig: the other end of the wires
[Service]
User=thermoctl
LimitRTPRIO=90
LimitMEMLOCK=infinity
RuntimeDirectory=wire
CacheDirectory=rig
AmbientCapabilities=CAP_SYS_NICE CAP_IPC_LOCK
Environment=XDG_CACHE_HOME=/var/cache/rig OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1
ExecStart=/opt/thermoctl/bin/thermoctl virtual-rig --config {CONFIG}
[Install]
WantedBy=multi-user.target
"""
# Where the test itself may not raise limits (a sandbox without CAP_SYS_RESOURCE), the unit gets the two rights another way.
DROP_IN = """[Service]
CapabilityBoundingSet=CAP_SYS_NICE CAP_IPC_LOCK
AmbientCapabilities=CAP_SYS_NICE CAP_IPC_LOCK
PrivateUsers=no
"""
WATCHDOG_S = 0.2  # the amplifier's own: the limit where nobody is left to tell it anything
TABLE: list[tuple[str, str, str, str]] = []


class Booted(Container):
    """The container with the product installed in it, and questions about its amplifier."""

    def install(self) -> None:
        etc = self.root / "etc/thermoctl"
        shutil.copytree(ROOT / "config", etc)
        text = (
            (etc / "wire.yaml")
            .read_text()
            .replace("../run/wire.sock", "/run/thermoctl/rig.sock\n  group: thermoctl")
        )
        text = text.replace("../run/wire", "/run/wire").replace(
            "../recordings", "/var/lib/thermoctl/recordings"
        )
        (etc / "rig.yaml").write_text(text)
        for path in (etc, *etc.rglob("*")):
            path.chmod(0o755 if path.is_dir() else 0o644)
        (self.root / "etc/systemd/system/virtual-rig.service").write_text(RIG_UNIT)
        if not may_raise_limits():
            drop_in = self.root / "etc/systemd/system/thermoctl.service.d/rights.conf"
            drop_in.parent.mkdir(parents=True)
            drop_in.write_text(DROP_IN)
            TABLE.append(
                ("(no CAP_SYS_RESOURCE here: a drop-in gives FIFO", "and locked", "memory;", "not tested:")
            )
            TABLE.append((" LimitRTPRIO=, LimitMEMLOCK=, PrivateUsers=)", "", "", ""))

    def amplifier(self):
        """What the amplifier was told so far: t, enabled, drive."""
        r = read_table_text(self.file("/run/wire/reference.csv").read_text(), self.work)
        return r.t, r.columns["enabled"] > 0, r.columns["drive"]

    def start_rig(self) -> None:
        """The virtual rig runs and its wires are plugged in."""
        self.run("systemctl", "start", "virtual-rig.service")
        begin = time.monotonic()
        while not self.file("/run/wire/control.sock").exists():
            assert time.monotonic() - begin < 90, self.run(
                "systemctl", "status", "virtual-rig.service", check=False
            )
            time.sleep(0.05)

    def until(self, condition, limit_s: float, what: str):
        """Ask `thermoctl status` until condition(status)."""
        begin = time.monotonic()
        while not condition(s := self.status()):
            assert time.monotonic() - begin < limit_s, (
                what,
                s.get("state"),
                s.get("faults"),
                self.journal()[-1500:],
            )
            time.sleep(0.05)  # how often we ask, not a wait
        return s

    def ready(self, limit_s: float = 60.0):
        return self.until(lambda s: s.get("state") == "READY", limit_s, "READY")

    def arm(self) -> None:
        """Arm and drive away from zero, so that there is something to switch off."""
        if self.unit("ActiveState")[0] != "active":  # after a test that failed
            self.run("systemctl", "reset-failed", "thermoctl.service", check=False)
            self.start_rig()
            self.run("systemctl", "start", "thermoctl.service")
        self.start_rig()
        begin = time.monotonic()
        while not self.ask("arm").get("ok"):
            self.ask("disarm")
            assert time.monotonic() - begin < 30, self.status()
            time.sleep(0.05)
        assert self.ask("setpoint", 20.0)["ok"]
        self.until(lambda s: abs((s.get("position_um") or 0) - 20) < 2, 30, "at the setpoint")

    def main_pid(self) -> int:
        return int(self.unit("MainPID")[0])

    def pids(self) -> dict[str, int]:
        """The daemon's processes inside the container: main and loop."""
        main = self.main_pid()
        children = self.run("ps", "-o", "pid=,rtprio=", "--ppid", str(main)).split("\n")
        loop = [int(c.split()[0]) for c in children if len(c.split()) == 2 and c.split()[1] == "80"]
        assert main > 1 and loop, children
        return {
            "main": main,
            "loop": loop[0],
            **{
                f"child {c.split()[0]}": int(c.split()[0])
                for c in children
                if c.split() and int(c.split()[0]) != loop[0]
            },
        }

    def send(self, number: int, *pids: int) -> float:
        """Signal processes of the container from outside, so that no program's start counts; the time (monotonic s)."""
        outside = {}
        for path in Path("/proc").glob("[0-9]*/status"):
            with contextlib.suppress(OSError):
                inner = re.search(r"NSpid:\s+\d+.*\s(\d+)\n", path.read_text())
                if inner and int(inner[1]) in pids and "thermoctl" in (path.parent / "cgroup").read_text():
                    outside[int(inner[1])] = int(path.parent.name)
        assert len(outside) == len(pids), (outside, pids)
        event = time.monotonic()
        for pid in outside.values():
            with contextlib.suppress(ProcessLookupError):  # the first one's end has ended it already
                os.kill(pid, number)
        return event

    def journal(self) -> str:
        return self.run("journalctl", "-u", "thermoctl", "-o", "cat", "--no-pager", check=False)

    def back(self, restarts: int) -> float:
        """Wait until systemd has started it again and it is READY; the seconds that took."""
        begin = time.monotonic()
        while int(self.unit("NRestarts")[0]) <= restarts or self.unit("ActiveState")[0] != "active":
            assert time.monotonic() - begin < 60, self.unit("ActiveState", "Result", "NRestarts") + [
                self.journal()[-1500:]
            ]
            time.sleep(0.05)
        seconds = time.monotonic() - begin
        self.ready()
        return seconds


def read_table_text(text: str, work):
    """reference.csv up to its last whole row."""
    path = work / "reference.csv"
    path.write_text(text[: text.rfind("\n") + 1])
    return read_table(path)


def off_after(rig: Booted, event: float, limit_s: float, name: str, back_s: float | None = None) -> None:
    """The amplifier was off `limit_s` after `event` and was not driven again since; a row of the table."""
    t, enabled, drive = rig.amplifier()
    assert enabled[t < event].any() and enabled[t < event][-1], (
        "the amplifier was not driven before: the test shows nothing"
    )
    after = t >= event
    still_on = t[after][enabled[after]]
    took = float(still_on[-1] - event) + 0.01 if len(still_on) else 0.0
    late = after & (t > event + limit_s)
    TABLE.append(
        (
            name,
            f"{took * 1e3:.0f} ms",
            f"{limit_s * 1e3:.0f} ms",
            "-" if back_s is None else f"{back_s:.1f} s",
        )
    )
    assert late.any(), "no row after the limit: the rig stands still"
    assert not enabled[late].any() and not drive[late].any(), (
        f"driven {took:.3f} s after {name}; limit {limit_s} s"
    )


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    booted = Booted(tmp_path_factory.mktemp("booted"))
    try:
        booted.install()
        seconds = booted.boot()
        print(f"booted in {seconds:.1f} s: {booted.run('systemctl', '--version').splitlines()[0]}")
        booted.thermoctl("service", "install", "--config", CONFIG)
        booted.run("systemctl", "enable", "virtual-rig.service")
        booted.start_rig()
        yield booted
    finally:
        booted.remove()
        print(
            "\n".join(
                [
                    "",
                    f"{'scenario':44}{'amplifier off after':>20}{'limit':>10}{'active again':>14}",
                    *(f"{a:44}{b:>20}{c:>10}{d:>14}" for a, b, c, d in TABLE),
                ]
            )
        )


def test_install_made_user_directories_and_rules(rig):
    assert "thermoctl" in rig.run("getent", "passwd", "thermoctl") and "thermoctl" in rig.run(
        "getent", "group", "thermoctl"
    )
    assert (
        rig.run("stat", "-c", "%U:%G %a", "/var/lib/thermoctl/recordings").strip()
        == "thermoctl:thermoctl 750"
    )
    rules = rig.run("cat", "/etc/udev/rules.d/99-thermoctl.rules")
    assert "cpu_dma_latency" in rules
    exposure = re.search(
        r"Overall exposure level for own.service: ([\d.]+)",
        rig.run(
            "sh",
            "-c",
            "cp /etc/systemd/system/thermoctl.service /tmp/own.service; "  # without the drop-in
            "systemd-analyze security --offline=true --no-pager /tmp/own.service",
        ),
    )
    assert exposure and float(exposure[1]) <= 2.0
    TABLE.append((f"exposure {exposure[1]} (limit 2.0)", "-", "-", "-"))
    assert "thermoctl.service" not in rig.run(
        "systemd-analyze", "verify", "/etc/systemd/system/thermoctl.service", check=False
    )


def test_start_drives_nothing_and_runs_in_real_time(rig):
    begin = time.monotonic()
    rig.run("systemctl", "enable", "--now", "thermoctl.service")  # Type=notify: returns when it is ready
    rig.ready()
    t, enabled, drive = rig.amplifier()
    assert not enabled[t > begin].any() and not drive[t > begin].any()
    loop = rig.pids()["loop"]
    assert rig.run("ps", "-o", "cls=", "-p", str(loop)).strip() == "FF"
    locked = re.search(r"VmLck:\s+(\d+)", rig.run("cat", f"/proc/{loop}/status"))
    assert locked and int(locked[1]) > 10_000  # kB
    assert rig.run("ps", "-o", "user=", "-p", str(loop)).strip() == "thermoctl"


def test_stop_switches_off_first(rig):
    rig.arm()
    event = time.monotonic()
    rig.run("systemctl", "stop", "thermoctl.service")
    assert rig.unit("ActiveState", "Result") == ["inactive", "success"], rig.run(
        "journalctl", "-u", "thermoctl", "--no-pager", "-n", "20"
    )
    assert rig.main_pid() == 0
    time_row_after(rig, event + 1.0)
    off_after(rig, event, 1.0, "systemctl stop")
    rig.run("systemctl", "start", "thermoctl.service")
    rig.ready()


def time_row_after(rig: Booted, when: float) -> None:
    """Until the amplifier's record reaches `when` (monotonic s)."""
    begin = time.monotonic()
    while rig.amplifier()[0][-1] < when + 0.05:
        assert time.monotonic() - begin < 30
        time.sleep(0.05)


def test_reload_is_taken_without_a_jump_and_nonsense_is_refused(rig):
    rig.arm()
    path = rig.root / "etc/thermoctl/rig.yaml"
    good = path.read_text()
    event = time.monotonic()
    path.write_text(good.replace("bound_um: 40", "bound_um: 41"))
    rig.run("systemctl", "reload", "thermoctl.service")
    rig.until(lambda s: s.get("generation", 0) >= 1, 10, "the reload counts")
    path.write_text(good.replace("bound_um: 40", "bound_um: many"))
    rig.run("systemctl", "reload", "thermoctl.service")
    begin = time.monotonic()
    while not re.search(r"reload.*rig\.yaml:\d+", rig.journal()):
        assert time.monotonic() - begin < 10, rig.journal()[-1500:]
        time.sleep(0.05)
    path.write_text(good)
    assert rig.status()["state"] == "ARMED"
    r = read_table_text(rig.file("/run/wire/reference.csv").read_text(), rig.work)
    during = r.t >= event
    assert (r.columns["enabled"][during] > 0).all()
    jump = float(np.abs(np.diff(r.columns["position_um"][during])).max())
    TABLE.append(("systemctl reload, good and nonsense", f"stays on, {jump:.2f} um", "0.5 um", "-"))
    assert jump < 0.5  # um between two rows, 10 ms


@pytest.mark.parametrize(
    "victim,name,limit_s",
    [
        ("loop", "kill -9 of the loop", WATCHDOG_S + 0.1),
        ("main", "kill -9 of the supervisor", WATCHDOG_S + 0.1),
        ("all", "kill -9 of every process", WATCHDOG_S + 0.1),
    ],
)
def test_kill_9(rig, victim, name, limit_s):
    rig.run("systemctl", "reset-failed", "thermoctl.service", check=False)
    rig.arm()
    restarts = int(rig.unit("NRestarts")[0])
    pids = rig.pids()
    event = rig.send(signal.SIGKILL, *(pids.values() if victim == "all" else [pids[victim]]))
    back = rig.back(restarts)
    time_row_after(rig, event + limit_s + 1.0)
    off_after(rig, event, limit_s, name, back)
    assert rig.status()["state"] == "READY"  # not armed by itself


@pytest.mark.parametrize(
    "victim,name,limit_s",
    [
        ("loop", "SIGSTOP of the loop", WATCHDOG_S + 0.1),
        ("all", "SIGSTOP of every process", WATCHDOG_S + 0.1),
        ("main", "SIGSTOP of the supervisor", 2.0 + 1.5),
    ],
)
def test_stopped_processes_are_ended_and_started_again(rig, victim, name, limit_s):
    """A loop that stands still is ended by the supervisor; a supervisor that stands still by WatchdogSec=2: until then the
    loop goes on controlling."""
    rig.run("systemctl", "reset-failed", "thermoctl.service", check=False)
    rig.arm()
    restarts = int(rig.unit("NRestarts")[0])
    pids = rig.pids()
    event = rig.send(signal.SIGSTOP, *(pids.values() if victim == "all" else [pids[victim]]))
    back = rig.back(restarts)
    time_row_after(rig, event + limit_s + 1.0)
    off_after(rig, event, limit_s, name, back)
    assert rig.status()["state"] == "READY"
    if victim != "loop":
        assert "watchdog" in rig.run("journalctl", "-u", "thermoctl", "--no-pager").lower()


def test_the_rig_lost_and_back_under_a_running_daemon(rig):
    rig.arm()
    rig.run("systemctl", "kill", "-s", "KILL", "virtual-rig.service")
    rig.until(lambda s: s.get("state") == "FAULT", 10, "FAULT")
    rig.start_rig()
    begin = time.monotonic()
    while rig.status().get("state") != "READY":
        rig.ask("disarm")
        time.sleep(0.05)
        assert time.monotonic() - begin < 30
    assert rig.unit("NRestarts", "ActiveState")[1] == "active"
    rig.arm()
    rig.ask("disarm")


def test_an_unusable_configuration_is_not_tried_again_and_too_many_failures_end(rig):
    path = rig.root / "etc/thermoctl/rig.yaml"
    good = path.read_text()
    path.write_text(good.replace("period_s: 1 ms", "period_s: 1 mm"))
    rig.run("systemctl", "stop", "thermoctl.service")
    rig.run("systemctl", "reset-failed", "thermoctl.service", check=False)
    rig.run("systemctl", "start", "thermoctl.service", check=False)
    state, code, restarts = rig.unit("ActiveState", "ExecMainStatus", "NRestarts")
    assert (state, code, restarts) == ("failed", "2", "0")
    assert re.search(r"rig\.yaml:\d+", rig.journal())
    path.write_text(good)
    rig.run("systemctl", "reset-failed", "thermoctl.service")
    rig.run("systemctl", "stop", "virtual-rig.service")  # no devices: every start fails with status 3
    rig.run("systemctl", "start", "--no-block", "thermoctl.service")
    begin = time.monotonic()
    while rig.unit("ActiveState", "SubState")[0] != "failed":
        assert time.monotonic() - begin < 300, rig.unit("ActiveState", "SubState", "NRestarts")
        time.sleep(0.2)
    restarts = int(rig.unit("NRestarts")[0])
    TABLE.append((f"start limit: given up after {restarts + 1} starts", "-", "-", "-"))
    assert 3 <= restarts <= 20
    rig.start_rig()
    rig.run("systemctl", "reset-failed", "thermoctl.service")
    rig.run("systemctl", "start", "thermoctl.service")
    rig.ready()


def test_the_journal_has_the_daemons_lines(rig):
    lines = [
        json.loads(line)
        for line in rig.run("journalctl", "-u", "thermoctl", "-o", "json", "--no-pager").splitlines()
        if line.startswith("{")
    ]
    own = [x for x in lines if x.get("SYSLOG_IDENTIFIER") == "thermoctl"]
    assert any("ready" in str(x["MESSAGE"]) for x in own) and any("state" in str(x["MESSAGE"]) for x in own)
    assert {x.get("_SYSTEMD_UNIT") for x in own} == {"thermoctl.service"}


def test_power_cycle_boots_into_ready_and_drives_nothing(rig):
    rig.arm()
    event = time.monotonic()
    rig.shut_down()
    log = (rig.work / "boot.log").read_text(errors="replace")
    assert "Failed" not in "".join(line for line in log.splitlines() if "thermoctl" in line.lower())
    seconds = rig.boot()
    rig.ready(90)
    t, enabled, drive = rig.amplifier()  # a new record: the rig came up with the machine
    assert t[0] > event and not enabled.any() and not drive.any()
    TABLE.append(("boot: READY by itself, never driven", "-", "-", f"{seconds:.1f} s"))


def test_uninstall_leaves_nothing_of_ours(rig):
    rig.arm()
    rig.thermoctl("service", "uninstall")
    stopping = [
        x
        for x in map(json.loads, rig.run("journalctl", "-o", "json", "UNIT=thermoctl.service").splitlines())
        if str(x["MESSAGE"]).startswith("Stopping")
    ]
    event = int(stopping[-1]["__MONOTONIC_TIMESTAMP"]) * 1e-6  # not when the program began to start
    time_row_after(rig, event + 1.5)
    off_after(rig, event, 1.0, "thermoctl service uninstall")
    assert rig.unit("LoadState", "ActiveState") == ["not-found", "inactive"]
    left = rig.run(
        "sh",
        "-c",
        "ls /etc/systemd/system/thermoctl.service /etc/sysusers.d/thermoctl.conf "
        "/etc/tmpfiles.d/thermoctl.conf /etc/udev/rules.d/99-thermoctl.rules 2>/dev/null",
        check=False,
    )
    assert not left.strip()
    assert "rig.yaml" in rig.run("ls", "/etc/thermoctl")  # configuration and recordings stay
