"""EtherCAT at the wire: the master of pysoem at one end of a virtual cable, emulated slaves at the other.

Shown: values and faults of a terminal; a drive that follows, stops and is not enabled again by itself; every way
in which the link or a slave fails, and the way back.
"""

import contextlib
import math
import sys
import threading
import time

import pytest

from tests.devices.ethercat import AL_STATUS, INIT, OP, SAFEOP
from tests.devices.ethercat_cable import Cable, why_not
from tests.devices.ethercat_devices import Drive, Terminal, coupler
from tests.devices.harness import Rig
from thermoctl.devices.library import find
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, AMP_FAULT, HardwareError, Sample
from thermoctl_hal.ethercat import bus
from thermoctl_hal.ethercat.slave import OUTPUT_CONTROL
from thermoctl_hal.profiles.bind import bind, check_rig, rig_notes
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.rig.make import driver
from thermoctl_hal.rig.probe import Probe, read_for

WHY_NOT = why_not()
wire = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "-")
pytest.importorskip("pysoem", reason="the extra ethercat is not installed")
ROLES = "{state: amplifier_state, fault: amplifier_fault, current: current_a}"


@pytest.fixture
def cables():
    made = []

    def make(*slaves):
        made.append(Cable(lambda: [s() for s in slaves]))
        return made[-1]

    yield make
    for cable in made:
        cable.close()


def terminal(cable, address=2, name="terminal", roles="{t0: coil_c, t1: air_c}", more=""):
    return (
        f"{{name: {name}, profile: {find('beckhoff-el3314')}, port: {cable.name}, address: {address}, "
        f"roles: {roles}{more}}}"
    )


def drive(cable, address=1, watchdog_s=0.5):
    """watchdog_s: longer than a busy machine keeps a process waiting."""
    return (
        f"{{name: amplifier, profile: {find('maxon-epos4-ethercat')}, port: {cable.name}, address: {address}, "
        f"roles: {ROLES}, watchdog_s: {watchdog_s}}}"
    )


def problem(rig, role):
    return rig.backend.problem(role)


def cycles(rig, cable, count):
    """Tick until so many more frames have passed."""
    end = cable.ask(0, "frames") + count
    rig.until(lambda: cable.ask(0, "frames") > end)


@wire
def test_a_terminal_is_read_and_its_open_wire_is_an_error(cables, tmp_path):
    cable = cables(coupler, Terminal)
    with Rig(tmp_path, f"[{terminal(cable)}]") as rig:
        rig.until(lambda: rig.status("coil_c") == rig.status("air_c") == "OK")
        assert math.isclose(rig.value("coil_c"), 21.5) and math.isclose(rig.value("air_c"), 22.5)
        cable.ask(2, "open_wire", 0)
        rig.until(lambda: rig.status("coil_c") == "ERROR")
        assert "input 0 reads 0x4040" in problem(rig, "coil_c") and rig.status("air_c") == "OK"
        assert cable.ask(2, "state") == OP
    assert cable.ask(2, "state") == INIT


@wire
def test_a_drive_follows_only_when_enabled_and_is_off_afterwards(cables, tmp_path):
    cable = cables(Drive)
    with Rig(tmp_path, f"[{drive(cable)}]") as rig:
        rig.until(lambda: rig.value("amplifier_state") == AMP_DISABLED)
        rig.drive = 0.5
        rig.until(lambda: cable.ask(1, "state") == OP and cable.ask(0, "frames") > 0)
        assert cable.ask(1, "output") == 0 and cable.ask(1, "enabled_count") == 0
        rig.enable = True
        rig.until(lambda: cable.ask(1, "output") == 250)
        rig.until(
            lambda: rig.value("amplifier_state") == AMP_ENABLED and math.isclose(rig.value("current_a"), 0.5)
        )
        rig.drive = 99.0
        rig.until(lambda: cable.ask(1, "output") == 500)
        rig.drive = math.nan
        rig.until(lambda: rig.value("amplifier_state") == AMP_DISABLED and cable.ask(1, "output") == 0)
        rig.drive = -0.1
        rig.until(lambda: cable.ask(1, "output") == -50)
        written = cable.ask(1, "written")
        assert (0x6060, 0, 10) in written and (0x1600, 2, 0x60710010) in written
        assert (0x1A00, 3, 0x30D10220) in written
        assert cable.ask(1, "enabled_count") == 2
    assert cable.ask(1, "output") == 0 and cable.ask(1, "state") == INIT and cable.ask(1, "last_control") == 0


@wire
def test_a_fault_and_a_stop_by_itself_are_not_undone(cables, tmp_path):
    cable = cables(Drive)
    with Rig(tmp_path, f"[{drive(cable)}]") as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(1, "output") == 100)
        cable.ask(1, "trip", 0)
        rig.until(lambda: rig.value("amplifier_state") == AMP_DISABLED)
        cycles(rig, cable, 50)
        assert cable.ask(1, "output") == 0 and cable.ask(1, "enabled_count") == 1
        rig.enable = False
        cycles(rig, cable, 20)
        rig.enable = True
        rig.until(lambda: cable.ask(1, "output") == 100)
        cable.ask(1, "trip", 0x3220)
        rig.until(
            lambda: rig.value("amplifier_state") == AMP_FAULT and rig.value("amplifier_fault") == 0x3220
        )
        cycles(rig, cable, 50)
        assert cable.ask(1, "word") == 0x08, "a fault is reset only while disabled"
        rig.enable = False
        rig.until(lambda: rig.value("amplifier_state") == AMP_DISABLED and rig.value("amplifier_fault") == 0)


@wire
def test_a_pulled_cable_stops_the_drive_by_its_watchdog_and_it_comes_back_disabled(cables, tmp_path):
    cable = cables(coupler, Terminal, Drive)
    with Rig(tmp_path, f"[{drive(cable, 3)}, {terminal(cable)}]") as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(3, "output") == 100 and rig.status("coil_c") == "OK")
        cable.unplug()
        rig.until(lambda: rig.status("amplifier_state") == "ERROR")
        assert "frames do not come back" in problem(rig, "amplifier_state") or "no slave" in problem(
            rig, "amplifier_state"
        )
        rig.until(lambda: cable.ask(3, "output") == 0)
        assert cable.ask(3, "memory")[0x134] == 0x1B, "the watchdog of the outputs"
        rig.until(lambda: rig.status("coil_c") == "STALE")
        rig.enable = False
        cable.plug()
        rig.until(lambda: rig.status("amplifier_state") == rig.status("coil_c") == "OK")
        assert rig.value("amplifier_state") == AMP_DISABLED and cable.ask(3, "enabled_count") == 1
        rig.enable = True
        rig.until(lambda: cable.ask(3, "output") == 100)


@wire
def test_single_lost_frames_are_counted_and_keep_the_values(cables, tmp_path):
    cable = cables(coupler, Terminal)
    with Rig(tmp_path, f"[{terminal(cable)}]") as rig:
        rig.until(lambda: rig.status("coil_c") == "OK")
        cable.ask(0, "lost", 1)
        rig.until(lambda: rig.devices[0].counts["lost"] == 1)
        time_s = time.monotonic()
        rig.until(lambda: rig.sample.time_s[rig.devices[0].roles[0]] > time_s)
        assert rig.status("coil_c") == "OK" and rig.devices[0].counts["reconnections"] == 0


@wire
def test_a_read_of_the_states_without_an_answer_loses_no_slave(cables, tmp_path, monkeypatch):
    """One such read, which a busy machine misses, counted every slave as gone: the whole bus began anew."""
    monkeypatch.setattr(bus, "LOST_FRAMES", 1000)  # a busy machine misses frames of data, too
    cable = cables(Drive, Terminal)
    with Rig(tmp_path, f"[{drive(cable)}, {terminal(cable, more=', stale_after_s: 0.3')}]") as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(1, "output") == 100 and rig.status("coil_c") == "OK")
        cable.ask(0, "lost_at", {AL_STATUS: 4})
        rig.until(lambda: cable.ask(0, "lost_at")[AL_STATUS] == 0)
        cycles(rig, cable, 200)
        assert rig.devices[0].counts["reconnections"] == rig.devices[1].counts["reconnections"] == 0
        assert cable.ask(1, "output") == 100 and cable.ask(1, "enabled_count") == 1


@wire
def test_a_lost_answer_of_the_set_up_ends_no_thread(cables, tmp_path):
    """pysoem's own error for it ended the poller of the drive, for good."""
    cable = cables(Drive, Terminal)
    cable.ask(0, "lost_at", {OUTPUT_CONTROL: 2})
    with Rig(tmp_path, f"[{drive(cable)}, {terminal(cable)}]") as rig:
        rig.until(lambda: "slave 1 does not answer" in problem(rig, "amplifier_state"))
        rig.until(lambda: rig.status("amplifier_state") == rig.status("coil_c") == "OK")


@wire
def test_a_wrong_working_counter_does_not_count_as_a_reading(cables, tmp_path):
    cable = cables(coupler, Terminal)
    with Rig(tmp_path, f"[{terminal(cable, more=', stale_after_s: 0.3')}]") as rig:
        rig.until(lambda: rig.status("coil_c") == "OK")
        cable.ask(2, "deaf", True)  # in OP, but its FMMUs do not answer
        rig.until(lambda: rig.status("coil_c") == "STALE")
        assert "not every slave took part" in problem(rig, "coil_c")
        assert rig.devices[0].counts["incomplete"] > 0
        cable.ask(2, "deaf", False)
        rig.until(lambda: rig.status("coil_c") == "OK")


WAYS = pytest.mark.parametrize("way", ["error", "power", "away"])


@contextlib.contextmanager
def beside_a_lost_terminal(cables, tmp_path, monkeypatch, way):
    """Yield the cable and the rig of a drive at 100 counts, whose neighbour is lost.

    An error of its state machine; a short loss of power; a terminal that is taken out and put back. On a busy
    machine the slaves miss three frames in a row, of data or of states; then the drive stops, and with the
    terminal away the bus does not begin again."""
    monkeypatch.setattr(bus, "LOST_FRAMES", 1000)
    monkeypatch.setattr(bus, "SILENT_READS", 20)
    cable = cables(Drive, Terminal)
    with Rig(
        tmp_path, f"[{drive(cable, watchdog_s=5.0)}, {terminal(cable, more=', stale_after_s: 0.3')}]"
    ) as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(1, "output") == 100 and rig.status("coil_c") == "OK")
        if way == "error":
            cable.ask(2, "stuck", SAFEOP)
            cable.ask(2, "fail", SAFEOP, 0x1A)
        else:
            cable.ask(2, "power_on")
            cable.ask(2, "present", False)
        rig.until(lambda: rig.status("coil_c") == "STALE")
        yield cable, rig


@wire
@WAYS
def test_a_slave_that_leaves_op_comes_back_while_the_other_goes_on(cables, tmp_path, monkeypatch, way):
    with beside_a_lost_terminal(cables, tmp_path, monkeypatch, way) as (cable, rig):
        assert "slave 2" in problem(rig, "coil_c")
        # a slow machine may make the drive's reading stale for a moment, too: it has to be fresh again
        rig.until(lambda: cable.ask(1, "output") == 100 and rig.status("amplifier_state") == "OK")
        assert rig.status("coil_c") == "STALE"
        cable.ask(2, "stuck", 0)
        cable.ask(2, "present", True)
        rig.until(lambda: rig.status("coil_c") == "OK")
        assert cable.ask(2, "state") == OP
        assert cable.ask(1, "enabled_count") == 1, "the drive was not disturbed"


@wire
@WAYS
def test_a_disarm_does_not_wait_for_a_slave_that_is_brought_back(cables, tmp_path, monkeypatch, way):
    """The drive's own watchdog is longer than the test: only the disarm can stop it."""
    with beside_a_lost_terminal(cables, tmp_path, monkeypatch, way) as (cable, rig):
        worst_s = 0.0
        for phase in range(4):
            cycles(rig, cable, 100 + 50 * phase)
            rig.enable, start_s = False, time.monotonic()
            rig.until(lambda: cable.ask(1, "output") == 0)
            worst_s = max(worst_s, time.monotonic() - start_s)
            rig.enable = True
            rig.until(lambda: cable.ask(1, "output") == 100)
        assert worst_s < bus.UP_S / 4


@wire
def test_two_slaves_that_are_lost_at_once_come_back_and_the_drive_stays_off(cables, tmp_path):
    """The drive trips while both are brought back."""
    cable = cables(Drive, Terminal)
    with Rig(tmp_path, f"[{drive(cable)}, {terminal(cable, more=', stale_after_s: 0.3')}]") as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(1, "output") == 100 and rig.status("coil_c") == "OK")
        for slave in (1, 2):
            cable.ask(slave, "stuck", SAFEOP)
            cable.ask(slave, "fail", SAFEOP, 0x1A)
        rig.until(lambda: rig.status("amplifier_state") == "ERROR" and rig.status("coil_c") == "STALE")
        rig.until(lambda: cable.ask(1, "output") == 0)
        rig.enable = False
        for slave in (1, 2):
            cable.ask(slave, "stuck", 0)
        begin_s = time.monotonic()
        rig.until(lambda: rig.status("amplifier_state") == rig.status("coil_c") == "OK")
        print(f"both back after {time.monotonic() - begin_s:.2f} s")
        assert cable.ask(1, "output") == 0 and cable.ask(1, "enabled_count") == 1
        rig.enable = True
        rig.until(lambda: cable.ask(1, "output") == 100)


@wire
def test_a_return_that_hangs_does_not_hold_its_line(cables, tmp_path, monkeypatch):
    """The last user leaves while the thread of another slave does not end."""
    cable, go_on = cables(Drive, Terminal), threading.Event()
    revive = bus.EthercatBus._revive
    with Rig(tmp_path, f"[{drive(cable)}, {terminal(cable, more=', stale_after_s: 0.3')}]") as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(1, "output") == 100 and rig.status("coil_c") == "OK")
        monkeypatch.setattr(bus.EthercatBus, "_revive", lambda *a: (go_on.wait(60), revive(*a)))
        monkeypatch.setattr(bus, "UP_S", 0.5)
        cable.ask(2, "fail", SAFEOP, 0x1A)
        rig.until(lambda: "is being brought back" in problem(rig, "coil_c"))
        cable.ask(1, "fail", SAFEOP, 0x1A)
        rig.until(lambda: "still being brought back" in problem(rig, "amplifier_state"), "its error")
        assert rig.status("amplifier_state") == "ERROR" and cable.ask(1, "output") == 0
        rig.enable = False
        go_on.set()
        rig.until(lambda: rig.status("amplifier_state") == rig.status("coil_c") == "OK")
        assert cable.ask(1, "output") == 0 and cable.ask(1, "enabled_count") == 1


@wire
def test_a_drive_that_lost_its_power_is_set_up_again_and_stays_off(cables, tmp_path):
    cable = cables(Drive, Terminal)
    with Rig(tmp_path, f"[{drive(cable)}, {terminal(cable)}]") as rig:
        rig.drive, rig.enable = 0.2, True
        rig.until(lambda: cable.ask(1, "output") == 100 and rig.status("coil_c") == "OK")
        cable.ask(1, "stuck", INIT)
        cable.ask(1, "power_on")
        cable.ask(1, "stop")
        rig.until(lambda: rig.status("amplifier_state") == "ERROR")
        rig.enable = False
        rig.until(lambda: not rig.devices[0].up)
        cable.ask(1, "stuck", 0)
        rig.until(lambda: rig.status("amplifier_state") == "OK")
        assert cable.ask(1, "size", 0x1C12) == 4, "mapped again"
        assert cable.ask(1, "enabled_count") == 1 and cable.ask(1, "output") == 0


def refused(folder, text):
    """The error of a connection."""
    devices = [driver(b) for b in check_rig([bind(n, folder) for n in yamlfile.loads(text).value])]
    try:
        with pytest.raises(HardwareError) as found:
            devices[0].connect()
    finally:
        devices[0].disconnect()
    assert "\n" not in str(found.value)
    return str(found.value)


@wire
def test_a_wrong_device_is_refused_by_name(cables, tmp_path):
    cable = cables(coupler, Terminal)
    text = refused(tmp_path, f"[{terminal(cable, 1)}]")
    assert "slave 1 is another device" in text and "1 EK1100 (0x2, 0x044C2C52), 2 EL3314" in text
    assert "slave 3 is not there" in refused(tmp_path, f"[{terminal(cable, 3)}]")
    cable.ask(0, "cut", 0)
    assert "no slave answers" in refused(tmp_path, f"[{terminal(cable)}]")
    cable.ask(0, "cut", 2)
    assert "cannot be opened" in refused(tmp_path, f"[{terminal(cable)}]".replace(cable.name, "none0"))


@wire
def test_set_up_that_the_slave_refuses_says_why(cables, tmp_path):
    cable = cables(Drive)
    cable.ask(1, "refused", 0x6060)
    text = refused(tmp_path, f"[{drive(cable)}]")
    assert "slave 1 refuses object 0x6060:0: abort 0x06010002" in text
    cable.ask(1, "refused", 0)
    cable.ask(1, "stuck", SAFEOP)
    assert "slave 1 is in SAFEOP, OP was expected" in refused(tmp_path, f"[{drive(cable)}]")


@wire
def test_a_drive_without_the_watchdog_of_its_profile_is_not_driven(cables, tmp_path):
    cable = cables(lambda: Drive(watched=False))
    text = refused(tmp_path, f"[{drive(cable)}]")
    assert "has no watchdog of its outputs (sync manager 2: 0x24" in text and "watchdog_s: none" in text
    assert cable.ask(1, "enabled_count") == 0


@wire
def test_the_watchdog_time_of_the_rig_reaches_the_slave(cables, tmp_path):
    cable = cables(Drive)
    with Rig(tmp_path, f"[{drive(cable, watchdog_s=0.25)}]") as rig:
        rig.until(lambda: rig.status("amplifier_state") == "OK")
        memory = cable.ask(1, "memory")
        assert int.from_bytes(memory[0x420:0x422], "little") == 2500


@wire
def test_one_master_an_interface(cables, tmp_path):
    cable = cables(Drive)
    with Rig(tmp_path, f"[{drive(cable)}]") as rig:
        rig.until(lambda: rig.status("amplifier_state") == "OK")
        other = driver(bind(yamlfile.loads(drive(cable)), tmp_path))
        with pytest.raises(HardwareError, match="another process is the EtherCAT master"):
            other.switch_off()


@wire
def test_the_amplifier_is_switched_off_over_a_link_of_its_own(cables, tmp_path):
    cable = cables(Drive)
    device = driver(bind(yamlfile.loads(drive(cable)), tmp_path))
    device.connect()
    try:
        for _ in range(50):
            device.poll(Sample())
            device.write(0.2, True, time.monotonic())
        assert cable.ask(1, "output") == 100
        device._bus._close()  # the process has died
        again = driver(bind(yamlfile.loads(drive(cable)), tmp_path))
        again.switch_off()
        assert cable.ask(1, "output") == 0 and cable.ask(1, "state") != OP
    finally:
        device.disconnect()


@wire
def test_a_position_drive_starts_where_it_is_and_moves_no_faster_than_its_slew(cables, tmp_path):
    text = find("maxon-epos4-ethercat").read_text()
    text = text.replace("mode: 10", "mode: 8").replace("command: 0x6071", "command: 0x607A")
    text = text.replace(
        "{unit: A, scale: 0.002, limits: [-1, 1]}",
        "{unit: um, scale: 0.1, limits: [0, 900], slew_per_s: 500}",
    )
    (tmp_path / "position.yaml").write_text(text)
    cable = cables(Drive)
    node = f"[{{name: axis, profile: position.yaml, port: {cable.name}, roles: {ROLES}}}]"
    with Rig(tmp_path, node) as rig:
        rig.until(lambda: rig.status("amplifier_state") == "OK")
        rig.drive, rig.enable = 510.0, True
        rig.until(lambda: cable.ask(1, "position") == 5100)
        assert cable.ask(1, "moved") <= 50, "5 um: the way of 10 ms"


@wire
def test_probe_reads_a_terminal_without_a_rig(cables):
    cable = cables(coupler, Terminal)
    found = read_for(Probe(load_profile(find("beckhoff-el3314")), cable.name, None), 2.0)
    assert [r.value for r in found] == pytest.approx([21.5, 22.5, 23.5, 24.5]) and not any(
        r.problem for r in found
    )


PROFILE = """format: thermoctl-device/1
vendor: test
model: test
bus: ethercat
ethercat: {vendor_id: 1, product_code: 2, %s}
%s
channels: {x: {%s, unit: '1', rate_hz: 10, stale_after_s: 1}}
"""


@pytest.mark.parametrize(
    "section, rest, channel, error",
    [
        ("command: 0x6071, transmit: [0x6041]", "", "object: 0x6041", "watchdog_s: is missing"),
        ("command: 0x6071, transmit: [0x6064], watchdog_s: 0.1", "", "object: 0x6064", "status word 0x6041 first"),
        ("transmit: [0x2001]", "", "byte: 0, type: int16", "type of object 0x2001 is not known"),
        ("transmit: [0x6041]", "", "object: 0x6077", "0x6077 is not sent by the slave"),
        ("input_bytes: 4", "", "byte: 3, type: int16", "4 of the inputs is outside the 4 input_bytes"),
        ("input_bytes: 4", "", "byte: 0, object: 0x6041, type: int16", "give one of them"),
        ("input_bytes: 4", "", "byte: 0, type: int16, low_bit: 12, bits: 5", "not inside the 16 bits"),
        ("start_up: [{index: 0x6060, value: 300}]", "", "byte: 0, type: int16", "300 does not fit object 0x6060"),
        ("input_bytes: 4", "drive: {unit: A, scale: 1, limits: [0, 1]}", "byte: 0, type: int16", "command: is missing"),
        ("watchdog_s: 9", "", "byte: 0, type: int16", "watchdog_s"),
    ],
)  # fmt: skip
def test_mistakes_of_a_profile_have_place_and_remedy(tmp_path, section, rest, channel, error):
    (tmp_path / "p.yaml").write_text(PROFILE % (section, rest, channel))
    with pytest.raises(InputError, match=r"p\.yaml:\d+:\d+: ") as found:
        load_profile(tmp_path / "p.yaml")
    assert error in str(found.value)


def test_check_warns_of_a_drive_without_a_watchdog(tmp_path):
    text = find("maxon-epos4-ethercat").read_text().replace("watchdog_s: 0.1", "watchdog_s: none")
    (tmp_path / "drive.yaml").write_text(text)
    node = yamlfile.loads(f"{{profile: drive.yaml, port: eth1, roles: {ROLES}}}")
    (note,) = rig_notes([bind(node, tmp_path)])
    assert "cannot stop by itself (watchdog_s: none)" in note


def test_two_devices_of_one_position_are_refused(tmp_path):
    nodes = [
        f"{{name: {n}, profile: {find('beckhoff-el3314')}, port: eth1, roles: {{t0: {r}}}}}"
        for n, r in (("a", "coil_c"), ("b", "air_c"))
    ]
    with pytest.raises(InputError, match="both are slave 2"):
        check_rig([bind(yamlfile.loads(n), tmp_path) for n in nodes])


def test_without_pysoem_the_rig_file_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pysoem", None)
    (tmp_path / "rig.yaml").write_text(
        f"{{name: t, profile: {find('beckhoff-el3314')}, port: eth1, roles: {{t0: coil_c}}}}"
    )
    with pytest.raises(
        InputError, match=r"rig\.yaml:1:1: t on EtherCAT: needs the package 'pysoem': pip install"
    ):
        driver(bind(yamlfile.load(tmp_path / "rig.yaml"), tmp_path))
