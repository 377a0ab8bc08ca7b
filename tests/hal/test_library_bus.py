"""Interfaces of python-can as they tell bus-off: by a state, an error frame, or an error of their own."""

import queue
import struct
import time

import can
import pytest

from tests.devices.harness import HEAD, Rig
from tests.devices.test_drives import AXIS_DBC
from tests.rigs.wire import TORQUE
from thermoctl_hal.can import bus as module
from thermoctl_hal.can.bus import BUS_OFF, open_can

DBC = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: DEV\n\nBO_ 801 READING: 8 DEV\n SG_ Volts : 0|16@1- (0.01,0) [0|0] "V" DEV\n'
PROFILE = (
    f"{HEAD}bus: can-dbc\ndbc: a.dbc\nchannels:\n"
    "  v: {message: READING, signal: Volts, unit: V, rate_hz: 20, stale_after_s: 0.05}\n"
)
READING = can.Message(arbitration_id=801, data=bytes.fromhex("d204") + bytes(6), is_extended_id=False)
ERROR = can.Message(is_error_frame=True, arbitration_id=0x40)


class VCIBusOffError(can.CanError):
    """As IXXAT's, whose name tells it."""


class Interface(can.BusABC):
    """A controller that is driven by the test: what `recv` gives or raises, its state, and what `send` raises."""

    current = None

    def __init__(self, channel, **more):
        super().__init__(channel)
        self.arriving, self.status, self.refuses, self.sent = queue.Queue(), can.BusState.ACTIVE, None, []
        Interface.current = self

    def _recv_internal(self, timeout):
        try:
            item = self.arriving.get(timeout=timeout)
        except queue.Empty:
            return None, True
        if isinstance(item, Exception):
            raise item
        return item, True

    def send(self, msg, timeout=None):
        if self.refuses is not None:
            raise self.refuses
        self.sent.append(msg)

    @property
    def state(self):
        return self.status


def silent_state(bus):
    """No frame tells it: the controller's state alone does."""
    bus.status = can.BusState.ERROR


def state_and_frame(bus):
    bus.status = can.BusState.ERROR
    bus.arriving.put(can.Message(is_error_frame=True))


def raised(error):
    return lambda bus: bus.arriving.put(error)


OFF = {
    "a state, in silence": silent_state,
    "a state, with an error frame": state_and_frame,
    "an error's words (PCAN)": raised(
        can.CanOperationError("Bus error: the CAN controller is in bus-off state")
    ),
    "an error's words (IXXAT)": raised(can.CanOperationError("Bus off status")),
    "an error's name (IXXAT)": raised(VCIBusOffError()),
    "an error's words (systec)": raised(ValueError("CAN controller has gone into BUSOFF")),
}
OTHER = {
    "unplugged": (raised(can.CanOperationError("The handle is not valid")), "The handle is not valid"),
    "a driver's own error": (raised(RuntimeError("usb: pipe")), "RuntimeError: usb: pipe"),
}


@pytest.fixture
def rig(tmp_path, monkeypatch):
    """A meter on an interface of another maker, behind the real back end."""
    monkeypatch.setattr(can, "Bus", lambda channel, **more: Interface(channel, **more))
    monkeypatch.setattr(module, "READ_S", 0.01)
    tmp_path.joinpath("a.dbc").write_text(DBC)
    tmp_path.joinpath("meter.yaml").write_text(PROFILE)
    text = "[{name: meter, profile: meter.yaml, port: 'pcan:PCAN_USBBUS1@500000', roles: {v: voltage_v}}]"
    with Rig(tmp_path, text) as rig:
        Interface.current.arriving.put(READING)
        rig.until(lambda: rig.status("voltage_v") == "OK")
        yield rig


def lost(rig, words):
    first = Interface.current
    rig.until(lambda: words in rig.backend.problem("voltage_v"), words)
    rig.until(lambda: Interface.current is not first, "opened again")
    Interface.current.arriving.put(READING)
    rig.until(lambda: rig.status("voltage_v") == "OK", "read again")


@pytest.mark.parametrize("way", OFF)
def test_bus_off_is_named_however_the_interface_tells_it(rig, way):
    OFF[way](Interface.current)
    lost(rig, f"lost on pcan:PCAN_USBBUS1@500000 ({BUS_OFF})")


@pytest.mark.parametrize("way", OTHER)
def test_another_error_keeps_its_words(rig, way):
    begin, words = OTHER[way]
    begin(Interface.current)
    lost(rig, words)


@pytest.mark.parametrize("state", [can.BusState.ACTIVE, can.BusState.PASSIVE])
def test_error_frames_of_a_live_bus_are_counted_only(rig, state):
    """0x40 is the kernel's bit of bus-off; other makers' error frames mean nothing by it."""
    bus = Interface.current
    bus.status = state
    for _ in range(3):
        bus.arriving.put(ERROR)
    bus.arriving.put(READING)
    frames = rig.backend.counters()["meter.frames"]
    rig.until(lambda: rig.backend.counters()["meter.frames"] > frames)
    assert rig.status("voltage_v") == "OK" and Interface.current is bus


@pytest.mark.parametrize("way", ["words", "name"])
def test_bus_off_at_sending_is_named_at_once(rig, way):
    port = open_can("pcan:PCAN_USBBUS2@500000", ())
    port.send((1, b"a"))
    bus = Interface.current
    assert [m.arbitration_id for m in bus.sent] == [1]
    bus.refuses = can.CanOperationError("in bus-off state") if way == "words" else VCIBusOffError()
    with pytest.raises(OSError, match="CAN bus-off: check wiring"):
        port.send((1, b"b"))
    bus.refuses = can.CanOperationError("The transmit queue is full")
    port.send((1, b"c"))  # a full queue may empty itself
    assert port.bad == 1
    port.close()


def test_own_frames_that_an_interface_hands_back_are_not_taken(monkeypatch):
    """gs_usb does it for every frame: a CiA 402 drive then stopped for a second master, which was we."""
    monkeypatch.setattr(can, "Bus", lambda channel, **more: Interface(channel, **more))
    port = open_can("pcan:PCAN_USBBUS3@500000", (0x205,))
    Interface.current.arriving.put(
        can.Message(arbitration_id=0x205, data=b"a", is_extended_id=False, is_rx=False)
    )
    Interface.current.arriving.put(can.Message(arbitration_id=0x205, data=b"b", is_extended_id=False))
    found = []
    deadline = time.monotonic() + 10
    while not found and time.monotonic() < deadline:
        found = port.receive()
    port.close()
    assert found == [(0x205, b"b")]


def test_a_disable_that_a_full_queue_refused_goes_out_in_the_next_tick(tmp_path, monkeypatch):
    """Before, it came with the repetition after 0.1 s, and the drive drove on until then."""
    monkeypatch.setattr(can, "Bus", lambda channel, **more: Interface(channel, **more))
    monkeypatch.setattr(module, "READ_S", 0.01)
    tmp_path.joinpath("axis.dbc").write_text(AXIS_DBC)
    tmp_path.joinpath("torque.yaml").write_text(TORQUE[: TORQUE.index("  position:")])
    text = (
        "[{name: drive, profile: torque.yaml, port: 'pcan:PCAN_USBBUS1@500000', address: 3, "
        "roles: {state: amplifier_state, error: amplifier_fault}}]"
    )
    with Rig(tmp_path, text) as rig:
        bus = Interface.current

        def is_driven(state):
            """The drive's heartbeat, and whether our command goes out."""
            bus.arriving.put(
                can.Message(arbitration_id=0x61, data=struct.pack("<IB3x", 0, state), is_extended_id=False)
            )
            return any(m.arbitration_id == 0x6E and any(m.data) for m in bus.sent)

        rig.until(lambda: is_driven(1) or rig.status("amplifier_state") == "OK")
        rig.drive, rig.enable = 0.5, True
        rig.until(lambda: is_driven(8))
        rig.enable, bus.refuses = False, can.CanOperationError("The transmit queue is full")
        for _ in range(5):
            rig.tick()
        bus.refuses = None
        bus.sent.clear()
        rig.tick()
        assert [(m.arbitration_id, any(m.data)) for m in bus.sent] == [(0x6E, False), (0x67, True)]
