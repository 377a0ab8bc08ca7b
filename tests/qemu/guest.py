"""Runs inside the qemu guest: the daemon's CAN driver on the kernel's own CAN, against the virtual CiA-402 drive.

Prints one line `RESULT {...}` for every scenario: name, ok, seconds or figures, and what went wrong. vcan0 is the kernel's
virtual bus; can0 and can1 are two emulated Kvaser PCI cards (SJA1000 chips) on one emulated wire.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(CHECKOUT), str(CHECKOUT / f".venv/lib/python3.{sys.version_info[1]}/site-packages")]

from thermoctl.files import yamlfile  # noqa: E402
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, ERROR, OK, ROLE  # noqa: E402
from thermoctl_hal.can.bus import LibraryPort, open_can  # noqa: E402
from thermoctl_hal.can.drive import Cia402Device  # noqa: E402
from thermoctl_hal.profiles.bind import bind  # noqa: E402
from thermoctl_hal.rig.devices import DevicesBackend  # noqa: E402
from thermoctl_hal.virtual.drive import DISABLED, ENABLED, Cia402Drive  # noqa: E402

_FRAME = struct.Struct("=IB3x8s")
STATE = ROLE["amplifier_state"]
DRIVE = """
name: drive
profile: devices/drive-cia402.yaml
port: socketcan:{channel}
roles: {{state: amplifier_state, fault: amplifier_fault, supply: supply_v}}
"""


def raw_socket(channel: str) -> socket.socket:
    s = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    s.bind((channel,))
    return s


def send(s: socket.socket, can_id: int, data: bytes) -> None:
    s.send(_FRAME.pack(can_id, len(data), data.ljust(8, b"\0")))


class DriveOn:
    """The virtual drive at the other end of a CAN interface, in a thread."""

    def __init__(self, channel: str) -> None:
        self.drive, self.channel, self.done = Cia402Drive(5), channel, False
        self.thread = threading.Thread(target=self._live, daemon=True)
        self.thread.start()

    def _live(self) -> None:
        s = None
        while not self.done:
            try:
                if s is None:
                    s = raw_socket(self.channel)
                    s.settimeout(0.002)
                try:
                    can_id, size, data = _FRAME.unpack(s.recv(16))
                    if not can_id & 0xE000_0000:
                        self.drive.take((can_id, data[:size]), time.monotonic())
                except TimeoutError:
                    pass
                for can_id, data in self.drive.tick(time.monotonic()):
                    send(s, can_id, data)
            except OSError:  # the interface is down: the wire is dead, the drive lives on
                self.drive.tick(time.monotonic())
                if s is not None:
                    s.close()
                s = None
                time.sleep(0.005)

    def stop(self) -> None:
        self.done = True
        self.thread.join(2)


class Loop:
    """The back end, ticked until a condition holds."""

    def __init__(self, channel: str) -> None:
        node = yamlfile.loads(DRIVE.format(channel=channel), "drive.yaml")
        self.backend = DevicesBackend([Cia402Device(bind(node, CHECKOUT / "config"))], [])
        self.enable, self.drive_a = False, 0.0

    def until(self, condition, limit_s: float = 10.0) -> float:
        begin = time.monotonic()
        while True:
            now = time.monotonic()
            sample = self.backend.read(now)
            self.backend.write(self.drive_a, self.enable)
            if condition(sample):
                return now - begin
            assert now - begin < limit_s, (
                f"not within {limit_s} s: status {sample.status[STATE]}, value "
                f"{sample.value[STATE]}, {self.backend.problem('amplifier_state')}"
            )
            time.sleep(0.001)  # the pace of the loop


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", "set", *arguments], check=True)


def filters_are_in_the_kernel() -> dict:
    """Frames that nobody asked for never reach the process."""
    port = open_can("socketcan:vcan0", (0x085, 0x185, 0x585, 0x705))
    assert isinstance(port, LibraryPort)
    listed = Path("/proc/net/can/rcvlist_sff").read_text() + Path("/proc/net/can/rcvlist_fil").read_text()
    assert all(
        f" {i:x} " in listed.lower().replace("0000", " ") or f"{i:03x}" in listed.lower()
        for i in (0x185, 0x705)
    ), listed
    other = raw_socket("vcan0")
    for k in range(2000):
        send(other, 0x300 + k % 64, b"noise")
    for k in range(5):
        send(other, 0x185, bytes([k]))
    got = []
    begin = time.monotonic()
    while len(got) < 5 and time.monotonic() - begin < 5:
        got += port.receive()
    extra = port.receive()
    port.close()
    other.close()
    assert got == [(0x185, bytes([k])) for k in range(5)] and not extra, got[:10]
    return {"sent": 2005, "received": 5}


def drives_over(channel: str, drive_channel: str) -> dict:
    """Set-up by SDO, enable, command, stop; then the interface goes down and up again."""
    peer = DriveOn(drive_channel)
    loop = Loop(channel)
    try:
        loop.backend.open()
        loop.until(lambda s: s.value[STATE] == AMP_DISABLED and s.status[STATE] == OK)
        loop.enable, loop.drive_a = True, 0.25
        enabled_s = loop.until(lambda s: s.value[STATE] == AMP_ENABLED)
        loop.until(lambda s: peer.drive.command == 250_000)
        assert peer.drive.state == ENABLED
        ip(channel, "down")
        began = time.monotonic()
        lost_s = loop.until(lambda s: s.status[STATE] == ERROR, 2.0)
        problem = loop.backend.problem("amplifier_state")
        loop.until(lambda s: peer.drive.state != ENABLED and peer.drive.command == 0, 2.0)
        off_s = time.monotonic() - began
        loop.enable, loop.drive_a = False, 0.0  # what the law does: FAULT drives nothing
        ip(channel, "up")
        back_s = loop.until(lambda s: s.status[STATE] == OK and s.value[STATE] == AMP_DISABLED, 10.0)
        assert peer.drive.state == DISABLED and peer.drive.command == 0
        loop.enable, loop.drive_a = True, -0.1
        loop.until(lambda s: peer.drive.command == -100_000, 5.0)
        loop.enable = False
        loop.until(lambda s: peer.drive.state != ENABLED)
    finally:
        loop.backend.close()
        peer.stop()
    assert peer.drive.state != ENABLED
    return {
        "enabled_s": enabled_s,
        "down_noticed_s": lost_s,
        "amplifier_off_s": off_s,
        "back_after_up_s": back_s,
        "problem": problem,
    }


def bus_off() -> dict:
    """The controller's bus-off, as the kernel reports it (an error frame): ERROR, the amplifier stops by its own watchdog,
    and the link comes back."""
    peer = DriveOn("vcan0")
    loop = Loop("vcan0")
    try:
        loop.backend.open()
        loop.enable, loop.drive_a = True, 0.25
        loop.until(lambda s: peer.drive.command == 250_000)
        other = raw_socket("vcan0")
        send(other, 0x2000_0000 | 0x40, b"")
        lost_s = loop.until(lambda s: s.status[STATE] == ERROR, 2.0)
        problem = loop.backend.problem("amplifier_state")
        assert "bus-off" in problem, problem
        loop.until(lambda s: peer.drive.command == 0 and peer.drive.state != ENABLED, 2.0)
        loop.enable, loop.drive_a = False, 0.0
        back_s = loop.until(lambda s: s.status[STATE] == OK, 10.0)
        other.close()
    finally:
        loop.backend.close()
        peer.stop()
    return {"noticed_s": lost_s, "back_s": back_s, "problem": problem}


def heartbeat_lost() -> dict:
    """A drive that falls silent is noticed by its missing heartbeat, and comes back by itself."""
    peer = DriveOn("vcan0")
    loop = Loop("vcan0")
    try:
        loop.backend.open()
        loop.until(lambda s: s.value[STATE] == AMP_DISABLED)
        peer.drive.heartbeat = False
        lost_s = loop.until(lambda s: s.status[STATE] == ERROR, 2.0)
        peer.drive.heartbeat = True
        back_s = loop.until(lambda s: s.status[STATE] == OK, 10.0)
    finally:
        loop.backend.close()
        peer.stop()
    return {"noticed_s": lost_s, "back_s": back_s}


def a_missing_interface_is_one_line() -> dict:
    """An interface that is not there, and one that is down: an error that says what to do."""
    from thermoctl_hal.base.backend import HardwareError

    messages = []
    for channel in ("can7", "vcan1"):
        try:
            port = open_can(f"socketcan:{channel}", ())
            port.receive()
            port.send((0x123, b"x"))
            port.close()
            messages.append("")
        except (HardwareError, OSError) as e:
            messages.append(str(e))
    assert "can7" in messages[0] and "ip link set" in messages[0] and "\n" not in messages[0], messages
    assert messages[1], "a frame went out on an interface that is down"
    return {"missing": messages[0], "down": messages[1]}


def main() -> None:
    """All scenarios, each on its own."""
    subprocess.run(["ip", "link", "add", "dev", "vcan0", "type", "vcan"], check=True)
    subprocess.run(["ip", "link", "add", "dev", "vcan1", "type", "vcan"], check=True)
    ip("vcan0", "up")
    scenarios = [
        ("kernel filters", filters_are_in_the_kernel, ()),
        ("drive on vcan, down and up", drives_over, ("vcan0", "vcan0")),
        ("bus-off", bus_off, ()),
        ("heartbeat lost", heartbeat_lost, ()),
        ("missing and down interfaces", a_missing_interface_is_one_line, ()),
    ]
    if Path("/sys/class/net/can1").exists():
        for card in ("can0", "can1"):
            subprocess.run(
                ["ip", "link", "set", card, "type", "can", "bitrate", "1000000", "restart-ms", "100"],
                check=True,
            )
            ip(card, "up")
        scenarios.append(("drive on the emulated card, down and up", drives_over, ("can0", "can1")))
    for name, scenario, arguments in scenarios:
        try:
            result = {"name": name, "ok": True, **scenario(*arguments)}
        except Exception:
            result = {"name": name, "ok": False, "error": traceback.format_exc()[-1500:]}
        print("RESULT " + json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
