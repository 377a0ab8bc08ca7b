"""A Debian rootfs with this checkout installed, booted by systemd-nspawn: systemd as it runs on a rig, in a directory.

The rootfs is made once by mmdebstrap from Debian's packages and kept under build/ (24 s and 650 MB; it holds the kernel that
`make test-qemu` boots). The checkout and the packages of its .venv are mounted read-only; the program itself runs on Debian's
own python3 from /opt/thermoctl, as an installation would.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from thermoctl.daemon.control_socket import ask
from thermoctl.files.yamlfile import InputError

ROOT = Path(__file__).resolve().parents[2]
ROOTFS = ROOT / "build/systemd/rootfs"
PACKAGES = (
    "systemd,systemd-sysv,udev,dbus,python3,python3-distutils,libpython3.11,kmod,iproute2,procps,can-utils,gcc,libc6-dev,"
    "linux-image-amd64"
)
CHECKOUT = "/srv/thermoctl"
PROGRAM = """#!/usr/bin/python3
import sys
sys.path[:0] = ["{checkout}", "{checkout}/hal", "{checkout}/.venv/lib/python{version}/site-packages"]
from thermoctl.cli import main
sys.exit(main())
"""


def missing() -> str:
    """Why the test cannot run here, or ''."""
    if os.geteuid() != 0:
        return "needs root"
    for program, package in (
        ("systemd-nspawn", "systemd-container"),
        ("mmdebstrap", "mmdebstrap"),
        ("nsenter", "util-linux"),
    ):
        if shutil.which(program) is None:
            return f"needs {program} (apt-get install {package})"
    if sys.version_info[:2] != (3, 11):
        return "needs Python 3.11, as the rootfs (Debian 12) has it: the compiled parts are shared"
    return ""


def may_raise_limits() -> bool:
    """Whether LimitRTPRIO= and LimitMEMLOCK= can work here: systemd needs CAP_SYS_RESOURCE for them (bit 24)."""
    status = Path("/proc/self/status").read_text()
    return bool(int(status.split("CapBnd:")[1].split()[0], 16) >> 24 & 1)


def make_rootfs() -> Path:
    """The cached rootfs; made where it is missing."""
    if not (ROOTFS / "etc/debian_version").exists():
        ROOTFS.parent.mkdir(parents=True, exist_ok=True)
        part = ROOTFS.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        subprocess.run(
            ["mmdebstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(part)], check=True
        )
        part.rename(ROOTFS)
    program = ROOTFS / "opt/thermoctl/bin/thermoctl"
    program.parent.mkdir(parents=True, exist_ok=True)
    program.write_text(
        PROGRAM.format(checkout=CHECKOUT, version=f"{sys.version_info[0]}.{sys.version_info[1]}")
    )
    program.chmod(0o755)
    (ROOTFS / CHECKOUT.lstrip("/")).mkdir(parents=True, exist_ok=True)
    return ROOTFS


class Container:
    """A booted copy of the rootfs (changes go to a directory of its own); `run` runs a command inside."""

    def __init__(self, work: Path) -> None:
        self.work = work
        self.process: subprocess.Popen | None = None
        self.pid = 0
        for name in ("upper", "work", "root"):
            (work / name).mkdir()
        self.root = work / "root"
        subprocess.run(
            [
                "mount",
                "-t",
                "overlay",
                "overlay",
                "-o",
                f"lowerdir={make_rootfs()},upperdir={work}/upper,workdir={work}/work",
                str(self.root),
            ],
            check=True,
        )

    def boot(self, limit_s: float = 90.0) -> float:
        """Boot it; returns the seconds until systemd says that it runs."""
        begin = time.monotonic()
        log = open(self.work / "boot.log", "ab")  # noqa: SIM115 - nspawn writes to it as long as it lives
        self.process = subprocess.Popen(
            [
                "systemd-nspawn",
                "-q",
                "-D",
                str(self.root),
                "-b",
                "--register=no",
                "--keep-unit",
                "--private-network",
                "--capability=CAP_IPC_LOCK,CAP_SYS_NICE",
                f"--bind-ro={ROOT}:{CHECKOUT}",
                "--console=pipe",
            ],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
        while time.monotonic() < begin + limit_s:
            if self.process.poll() is not None:
                raise RuntimeError("systemd-nspawn ended: " + (self.work / "boot.log").read_text()[-2000:])
            children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
            for pid in children:
                if Path(f"/proc/{pid}/comm").read_text().strip() == "systemd":
                    self.pid = int(pid)
            if self.pid and self.run("systemctl", "is-system-running", check=False).strip() in (
                "running",
                "degraded",
            ):
                return time.monotonic() - begin
            time.sleep(0.05)
        raise RuntimeError("systemd did not come up: " + (self.work / "boot.log").read_text()[-2000:])

    def run(self, *command: str, check: bool = True) -> str:
        """A command inside; its output (stdout and stderr). Raises AssertionError when it fails and `check`."""
        done = subprocess.run(
            ["nsenter", "-t", str(self.pid), "-m", "-u", "-i", "-n", "-p", "-r", "-w", "--", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        assert not check or done.returncode == 0, (
            f"{' '.join(command)}: exit {done.returncode}: {done.stdout[-1500:]}"
        )
        return done.stdout

    def thermoctl(self, *arguments: str, check: bool = True) -> str:
        return self.run("/opt/thermoctl/bin/thermoctl", *arguments, check=check)

    def file(self, path: str) -> Path:
        """A file as the container sees it (also in its tmpfs), from outside."""
        return Path(f"/proc/{self.pid}/root{path}")

    def ask(self, command: str, value: float | None = None) -> dict:
        """A request on the daemon's command socket; {} when nobody answers."""
        try:
            return ask(str(self.file("/run/thermoctl/rig.sock")), {"command": command, "value": value})
        except InputError:
            return {}

    def status(self) -> dict:
        return self.ask("status")

    def unit(self, *properties: str, unit: str = "thermoctl.service") -> list[str]:
        """Properties of a unit as systemctl shows them."""
        text = self.run("systemctl", "show", unit, *(f"--property={p}" for p in properties))
        found = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
        return [found.get(p, "") for p in properties]

    def shut_down(self) -> None:
        """Power off, as a rig is: every unit is stopped in order."""
        if self.process is not None and self.process.poll() is None:
            self.run("systemctl", "poweroff", check=False)
            try:
                self.process.wait(60)
            except subprocess.TimeoutExpired:
                self.process.terminate()
                self.process.wait(30)
        self.process, self.pid = None, 0

    def remove(self) -> None:
        self.shut_down()
        subprocess.run(["umount", str(self.root)], check=False)
