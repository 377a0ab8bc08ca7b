"""The walk through the states of CiA 402 against a drive that is not ours: its state machine is written from the standard.

IEC 61800-7-201, figure of the state machine and its transitions 2 to 16, with quick stop option code 5: the drive stays in
'quick stop active', from where 0x0F leads back to 'operation enabled' (transition 16).
"""

import math

import pytest

from tests.hal.conftest import CONFIG
from thermoctl.files import yamlfile
from thermoctl_hal.base.backend import (
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_OFFLINE,
    AMP_QUICK_STOP,
    ROLE,
    Sample,
)
from thermoctl_hal.base.wire import CanPort
from thermoctl_hal.can.drive import Cia402Device
from thermoctl_hal.profiles.bind import bind

STATE = ROLE["amplifier_state"]
NOT_READY, DISABLED, READY, SWITCHED_ON = 0x0000, 0x0250, 0x0231, 0x0233
ENABLED, QUICK_STOP, FAULT_REACTION, FAULT = (
    0x0237,
    0x0217,
    0x021F,
    0x0218,
)  # status words, remote and voltage on


class ForeignDrive(CanPort):
    """Node 5 on a bus of its own: RPDO 0x205 = control word | target, TPDO 0x185 = status word | ... after each SYNC."""

    def __init__(self, transmit_size):
        self.status, self.control, self.target, self.length, self.sent = DISABLED, 0, 0, transmit_size, []

    def command(self, word):
        rising, self.control = word & ~self.control, word
        if self.status == FAULT:
            if rising & 0x80:  # 15
                self.status = DISABLED
        elif not word & 0x02:  # disable voltage: 7, 9, 10, 12
            if self.status not in (NOT_READY, FAULT_REACTION):
                self.status = DISABLED
        elif not word & 0x04:  # quick stop: 7, 10, 11
            if self.status in (READY, SWITCHED_ON, ENABLED):
                self.status = QUICK_STOP if self.status == ENABLED else DISABLED
        elif not word & 0x01:  # shutdown: 2, 6, 8
            if self.status in (DISABLED, SWITCHED_ON, ENABLED):
                self.status = READY
        elif not word & 0x08:  # switch on: 3; disable operation: 5
            if self.status in (READY, ENABLED):
                self.status = SWITCHED_ON
        elif self.status in (READY, SWITCHED_ON, QUICK_STOP):  # 3 and 4 at once, 4, 16
            self.status = ENABLED

    def tell(self):
        """One TPDO with the status word of now."""
        self.sent.append((0x185, self.status.to_bytes(2, "little").ljust(self.length, b"\0")))

    def flush(self):
        for can_id, data in self.queued():
            if can_id == 0x205:
                self.target = int.from_bytes(data[2:6], "little", signed=True)
                self.command(int.from_bytes(data[:2], "little"))
            elif can_id == 0x080:
                self.tell()
        return 0

    def take(self):
        self.begin()
        sent, self.sent = self.sent, []
        return sum(self.deliver(*frame) for frame in sent)

    def close(self):
        pass

    @property
    def current(self):
        """What flows."""
        return self.target if self.status == ENABLED else 0


class Bus:
    """The driver and the foreign drive; `tick` as the loop does: read, then write."""

    def __init__(self):
        node = yamlfile.loads(
            "{profile: drive-cia402.yaml, port: 'virtual:foreign', roles: {state: amplifier_state}}"
        )
        self.device = Cia402Device(bind(node, CONFIG / "devices"))
        self.drive, self.sample, self.now_s = ForeignDrive(self.device._transmit_size), Sample(), 0.0
        self.device._port = self.drive
        self.device._heard_s = math.inf  # no heartbeats here

    def tick(self, enable, count=1, amperes=0.5):
        for _ in range(count):
            self.now_s += 0.001
            self.device.read(self.sample, self.now_s)
            self.device.write(amperes, enable, self.now_s)
        return self.sample.value[STATE]

    def driving(self):
        self.tick(False, 3)
        assert self.tick(True, 9) == AMP_ENABLED and self.drive.current == 500_000
        return self


@pytest.mark.parametrize(
    "left,shown",
    [
        (QUICK_STOP, AMP_QUICK_STOP),
        (DISABLED, AMP_DISABLED),
        (READY, AMP_DISABLED),
        (SWITCHED_ON, AMP_DISABLED),
        (NOT_READY, AMP_OFFLINE),
        (FAULT_REACTION, AMP_FAULT),
        (FAULT, AMP_FAULT),
    ],
)
def test_a_drive_that_left_is_enabled_again_only_by_a_new_enable(left, shown):
    bus = Bus().driving()
    bus.drive.status = left
    bus.drive.tell()
    assert bus.tick(True) == shown
    for _ in range(600):  # the law goes on asking: nothing
        bus.tick(True)
        assert bus.drive.status != ENABLED and bus.drive.current == 0
    bus.drive.status = {FAULT_REACTION: FAULT, NOT_READY: DISABLED}.get(
        left, bus.drive.status
    )  # transitions 1, 14
    bus.tick(False, 2000)
    assert bus.drive.status == DISABLED and bus.tick(True, 9) == AMP_ENABLED


@pytest.mark.parametrize("left", [QUICK_STOP, DISABLED, SWITCHED_ON, NOT_READY])
def test_a_pulse_between_two_ticks_is_seen_where_the_drive_reports_it(left):
    """Two status words in one tick, the second one enabled again (by its own logic): the first one counts."""
    bus = Bus().driving()
    bus.drive.sent.clear()
    bus.drive.status = left
    bus.drive.tell()
    bus.drive.status = ENABLED
    bus.drive.tell()
    assert bus.tick(True) not in (AMP_ENABLED, AMP_FAULT)
    for _ in range(100):
        assert bus.tick(True) not in (AMP_ENABLED, AMP_FAULT) and bus.drive.current == 0
    assert "left 'operation enabled'" in bus.device.explain(bus.sample, STATE)
    bus.tick(False, 3)
    assert bus.tick(True, 9) == AMP_ENABLED and bus.device.explain(bus.sample, STATE) == ""


def test_an_old_status_word_of_enabled_is_not_a_drive_that_left():
    """Disabled and enabled at once again: the status words of before are still on their way."""
    bus = Bus().driving()
    bus.tick(False)
    bus.drive.status = ENABLED
    bus.drive.tell()
    bus.tick(False)
    assert bus.tick(True, 9) == AMP_ENABLED and bus.drive.current == 500_000


def test_a_drive_lost_while_driving_is_not_enabled_by_its_return():
    bus = Bus().driving()
    bus.device._watch_state(AMP_OFFLINE)  # as connect does
    bus.drive.status = DISABLED
    bus.tick(True, 100)
    assert bus.drive.status == DISABLED
    bus.tick(False, 3)
    assert bus.tick(True, 9) == AMP_ENABLED
