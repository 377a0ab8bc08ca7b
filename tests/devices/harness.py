"""A device under test at one end of a wire, bytes made by the test at the other."""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Callable
from pathlib import Path

from thermoctl.files import yamlfile
from thermoctl_hal.base.backend import ROLE, STATUS_NAMES, Sample
from thermoctl_hal.base.device import Device
from thermoctl_hal.profiles.bind import bind, check_rig
from thermoctl_hal.rig.devices import DevicesBackend
from thermoctl_hal.rig.make import driver

HEAD = "format: thermoctl-device/1\nvendor: test\nmodel: test\n"
POSITION = "unit: um, range: [-1e9, 1e9], rate_hz: 10, stale_after_s: 5"


class Line:
    """A pseudo-terminal: the test's end is `master`, the driver opens `path`."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self.slave)

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def read(self) -> bytes:
        try:
            return os.read(self.master, 4096)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        os.close(self.master)
        os.close(self.slave)


def make(
    folder: Path, profile: str, port: str, roles: str = "{position: position_um}", more: str = ""
) -> Device:
    """Return the driver of a profile given as text, not connected."""
    folder.joinpath("device.yaml").write_text(profile)
    node = f"{{name: device, profile: device.yaml, port: '{port}', roles: {roles}{more}}}"
    return driver(check_rig([bind(yamlfile.loads(node), folder)])[0])


def wait(
    condition: Callable[[], bool], step: Callable[[], object], what: str = "", limit_s: float = 30.0
) -> None:
    """Call `step` until `condition` holds."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, f"not within {limit_s} s {what}"
        step()
        time.sleep(0.0005)  # the pace of a loop, not a wait


class Rig:
    """Devices behind the real back end, ticked by `until`."""

    def __init__(self, folder: Path, text: str, required: tuple[str, ...] = ()) -> None:
        """text: the items of hal.devices; profiles are relative to `folder`."""
        bindings = check_rig([bind(n, folder) for n in yamlfile.loads(text).value])
        self.devices = [driver(b) for b in bindings]
        fast, slow = [d for d in self.devices if not d.slow], [d for d in self.devices if d.slow]
        self.backend = DevicesBackend(fast, slow, None, required)
        self.drive, self.enable = 0.0, False
        self.sample = Sample()

    def tick(self) -> None:
        self.sample = self.backend.read(time.monotonic())
        self.backend.write(self.drive, self.enable)

    def until(self, condition: Callable[[], bool], what: str = "", limit_s: float = 30.0) -> None:
        try:
            wait(condition, self.tick, what, limit_s)
        except AssertionError as e:
            found = {
                r: (STATUS_NAMES[self.sample.status[i]], self.sample.value[i], self.backend.problem(r))
                for r, i in ROLE.items()
                if i in self.backend._owner
            }
            raise AssertionError(f"{e}: {found}") from None

    def value(self, role: str) -> float:
        return float(self.sample.value[ROLE[role]])

    def status(self, role: str) -> str:
        return STATUS_NAMES[self.sample.status[ROLE[role]]]

    def __enter__(self) -> Rig:
        self.backend.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.backend.close()
