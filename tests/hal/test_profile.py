"""Device profiles and bindings: what ships is good, and every mistake is one line with its place."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hal.conftest import CONFIG
from thermoctl.configuration.settings import load_settings
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.profiles.bind import bind, check_rig, resolve_port
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.rig.make import make_devices
from thermoctl_hal.virtual.rig import virtual_device

PROFILES = sorted((CONFIG / "devices").glob("*.yaml"))
ENCODER = (CONFIG / "devices/encoder-serial.yaml").read_text()
DRIVE = (CONFIG / "devices/drive-cia402.yaml").read_text()
TEXT = (CONFIG / "devices/meter-serial-text.yaml").read_text()
SHUNT = (CONFIG / "devices/meter-can.yaml").read_text()
MODULE = (CONFIG / "devices/thermocouples-modbus-8.yaml").read_text()


@pytest.mark.parametrize("path", PROFILES, ids=lambda p: p.stem)
def test_shipped_profiles_are_good(path):
    profile = load_profile(path)
    assert profile.channels and profile.vendor and profile.model


@pytest.mark.parametrize("name", ["wire.yaml", "rig.yaml"])
def test_shipped_rigs_bind(name):
    devices = make_devices(load_settings(CONFIG / name))
    roles = [r for d in devices for r in d.roles]
    assert len(roles) == len(set(roles)) and sum(d.drives for d in devices) == 1


CASES = [
    (
        ENCODER,
        "format: thermoctl-device/1",
        "format: thermoctl-device/9",
        "'thermoctl-device/1' was expected",
    ),
    (ENCODER, "bus: serial-binary", "bus: serial-bynary", "did you mean 'serial-binary'"),
    (ENCODER, "vendor: thermoctl\n", "", "'vendor' is missing"),
    (ENCODER, "rate_hz: 1000", "rate: 1000", "'rate_hz' is missing"),
    (ENCODER, "scale: 0.005", "scale: 0", "scale: 0 makes every reading the same"),
    (ENCODER, "scale: 0.005", "scale: fast", "scale: a number was expected, found 'fast'"),
    (ENCODER, "[-5000, 5000]", "[5000, -5000]", "is empty"),
    (ENCODER, "stale_after_s: 0.01", "stale_after_s: 0.0005", "every reading would be stale"),
    (ENCODER, "field: counts", "field: count", "did you mean 'counts'"),
    (ENCODER, "type: int32", "type: int33", "did you mean 'int32'"),
    (ENCODER, "[0xAA, 0x55]", "[0xAA, 0x155]", "is outside 0 .. 255"),
    (ENCODER, "crc: ccitt-false", "crc: crc32", "did you mean 'CRC-32'?"),
    (ENCODER, "  crc: ccitt-false\n", "", "'crc' is missing"),
    (ENCODER, "baud: 921600", "baud: 1", "is outside 50 .. 20000000"),
    (ENCODER, "channels:\n", "channels:\n  position: {field: counts}\n", "stands twice"),
    (DRIVE, "eds: drive-cia402.eds", "eds: none.eds", "none.eds cannot be read"),
    (DRIVE, "[0x6041, 0x6078", "[0x6078, 0x6041", "the status word '0x6041' first"),
    (DRIVE, "limits: [-2.5, 2.5]", "limits: [1, 2.5]", "must contain 0"),
    (DRIVE, ", limits: [-2.5, 2.5]", "", "'limits' is missing"),
    (DRIVE, "watchdog_s: 0.1", "watchdog_s: 0.03", "below two heartbeats"),
    (DRIVE, "object: 0x6078", "object: 0x6077", "is not sent by the drive"),
    (DRIVE, "[0x6041, 0x6078", "[0x6041, 0x6078:x", "0x30D1:1 with its sub-index, was expected"),
    (DRIVE, "mode: 10 ", "mode: 10\n  master_id: 200 ", "is outside 1 .. 127"),
    (DRIVE, "mode: 10 ", "mode: 10\n  sdo_timeout_s: 0 ", "is outside 0.01"),
    (TEXT, "field: volts,", "field: volts, base: 8,", "base: 8 is not one of 10, 16"),
    (TEXT, "[-+.0-9eE]+) A", "[-+0-9A-F]+) A", "say base: 16, or base: 10"),
    (TEXT, "text:", "text:\n  decimal: ;", "';' is not one of ., ,"),
    (SHUNT, "unit: A", "unit: mA", "gives Current in A, the profile says mA with scale 1"),
    (MODULE, "register: 0,", "register: 70000,", "is outside 0 .. 65535"),
    (MODULE, "modbus: {unit_id: 1", "modbus: {unit_id: 300", "is outside 0 .. 255"),
    (
        MODULE,
        "channels:\n",
        "drive: {unit: A, scale: 1, limits: [-1, 1]}\nchannels:\n",
        "'watchdog_s' is missing",
    ),
]


@pytest.mark.parametrize("good,old,new,message", CASES, ids=[c[3][:30] for c in CASES])
def test_each_mistake_has_its_place_and_a_word(tmp_path, good, old, new, message):
    assert old in good
    for name in ("drive-cia402.eds", "meter-can.dbc"):
        (tmp_path / name).write_bytes((CONFIG / "devices" / name).read_bytes())
    path = tmp_path / "device.yaml"
    path.write_text(good.replace(old, new, 1))
    with pytest.raises(InputError) as e:
        load_profile(path)
    assert message in str(e.value)
    assert str(e.value).startswith(f"{path}:") and "\n" not in str(e.value)


@given(st.integers(0, len(ENCODER) - 1), st.sampled_from(["", " ", ":", "{", "[", "x", "-", "\t", "0", "'"]))
def test_a_damaged_profile_is_read_or_refused_never_a_traceback(tmp_path_factory, at, put):
    from thermoctl_hal.profiles.read import FORMAT

    path = tmp_path_factory.getbasetemp() / "damaged-profile.yaml"
    path.write_text(ENCODER[:at] + put + ENCODER[at + 1 :])
    try:
        assert load_profile(path).bus and FORMAT
    except InputError as e:
        assert str(path) in str(e)


@pytest.mark.parametrize(
    "text,message",
    [
        ("{profile: none.yaml, port: /dev/x, roles: {}}", "none.yaml cannot be read"),
        ("{profile: encoder-serial.yaml, roles: {position: position_um}}", "'port' is missing"),
        (
            "{profile: encoder-serial.yaml, port: /dev/x, roles: {positon: position_um}}",
            "did you mean 'position'",
        ),
        (
            "{profile: encoder-serial.yaml, port: /dev/x, roles: {position: position}}",
            "did you mean 'position_um'",
        ),
        (
            "{profile: encoder-serial.yaml, port: /dev/x, roles: {position: coil_c}}",
            "the role coil_c takes degC or K",
        ),
        (
            "{profile: encoder-serial.yaml, prot: x, port: /dev/x, roles: {position: position_um}}",
            "unknown key 'prot'",
        ),
    ],
)
def test_mistakes_in_a_binding_are_named(text, message):
    with pytest.raises(InputError, match=message):
        bind(yamlfile.loads(text), CONFIG / "devices")


def test_a_unit_of_modbus_on_a_line_is_not_the_broadcast(tmp_path):
    def bound(more, profile="meter-modbus.yaml", folder=CONFIG / "devices"):
        return bind(yamlfile.loads(f"{{profile: {profile}, roles: {{}}, {more}}}"), folder)

    with pytest.raises(InputError, match="address: 0 is the broadcast, which no unit answers.*1 .. 247"):
        bound("port: 'rtu:/dev/ttyUSB0', address: 0")
    assert bound("port: 'tcp:10.0.0.5:502', address: 0").address == 0
    text = (CONFIG / "devices/meter-modbus.yaml").read_text()
    (tmp_path / "meter.yaml").write_text(text.replace("unit_id: 2", "unit_id: 0"))
    with pytest.raises(InputError, match="address: 0 is the broadcast"):
        bound("port: 'rtu:/dev/ttyUSB0'", "meter.yaml", tmp_path)
    assert bound("port: 'rtu:/dev/ttyUSB0', address: 7", "meter.yaml", tmp_path).address == 7


def test_a_message_of_j1939_of_several_frames_is_refused(tmp_path):
    from thermoctl_hal.can.dbc import DbcDevice

    dbc = """VERSION ""
BU_: ECU
BO_ 2566834942 LONG: 19 ECU
 SG_ T : 0|8@1+ (1,-40) [-40|210] "degC" X
BO_ 2566843134 SHORT: 8 ECU
 SG_ U : 0|8@1+ (1,-40) [-40|210] "degC" X
"""
    (tmp_path / "engine.dbc").write_text(dbc)
    (tmp_path / "engine.yaml").write_text(
        "format: thermoctl-device/1\nvendor: x\nmodel: y\nbus: can-dbc\ndbc: engine.dbc\nchannels:\n"
        "  t: {message: LONG, signal: T, unit: degC, range: [-40, 210], rate_hz: 1, stale_after_s: 3}\n"
        "  u: {message: SHORT, signal: U, unit: degC, range: [-40, 210], rate_hz: 1, stale_after_s: 3}\n"
    )
    rig = "{profile: engine.yaml, port: 'virtual:j1939', roles: {%s: coil_c}}"
    assert DbcDevice(bind(yamlfile.loads(rig % "u"), tmp_path))
    with pytest.raises(InputError, match="engine.yaml:7:.*LONG has 19 bytes: J1939 sends it in parts"):
        DbcDevice(bind(yamlfile.loads(rig % "t"), tmp_path))


def test_a_binding_may_loosen_the_limits_of_its_profile():
    drive = "profile: drive-cia402.yaml, port: 'slcan:x', roles: {state: amplifier_state}"
    tight, loose = (
        bind(yamlfile.loads(f"{{{drive}{more}}}"), CONFIG / "devices")
        for more in ("", ", stale_after_s: 0.1, watchdog_s: 0.2")
    )
    assert tight.profile.bus_spec.watchdog_s == 0.1 and loose.profile.bus_spec.watchdog_s == 0.2
    assert tight.bounds[0].channel.stale_after_s == 0.02 and loose.bounds[0].channel.stale_after_s == 0.1
    for more, message in (
        (", watchdog_s: 0.03", "watchdog_s: 0.03 is outside 0.04"),
        (", stale_after_s: 0", "stale_after_s"),
    ):
        with pytest.raises(InputError, match=message):
            bind(yamlfile.loads(f"{{{drive}{more}}}"), CONFIG / "devices")
    with pytest.raises(InputError, match="has none"):
        bind(
            yamlfile.loads(
                "{profile: encoder-serial.yaml, port: /dev/x, watchdog_s: 1, roles: {position: position_um}}"
            ),
            CONFIG / "devices",
        )


@pytest.mark.parametrize(
    "profile,port",
    [
        ("encoder-serial.yaml", "ttyUSB0"),
        ("encoder-serial.yaml", "socket://box"),
        ("meter-can.yaml", "/dev/ttyACM0"),
        ("meter-can.yaml", "socketcan:can0@500k"),
        ("meter-can.yaml", "slcan:/dev/ttyACM0@0"),
        ("drive-cia402.yaml", "can0"),
        ("meter-modbus.yaml", "/dev/ttyUSB0"),
        ("meter-modbus.yaml", "tcp:10.0.0.5"),
        ("meter-modbus.yaml", "tcp:10.0.0.5:modbus"),
    ],
)
def test_a_port_of_another_bus_is_refused(profile, port):
    """`check` says it, not the first connection; a bitrate that is no number would count as part of the name."""
    node = yamlfile.loads(f"{{profile: {profile}, port: '{port}', roles: {{}}}}")
    with pytest.raises(InputError, match=rf"<text>:1:\d+: port: '{port}' is no port of a .* was expected"):
        bind(node, CONFIG / "devices")


def test_two_devices_in_one_role_are_refused():
    text = "{{name: {0}, profile: encoder-serial.yaml, port: /dev/{0}, roles: {{position: position_um}}}}"
    two = [bind(yamlfile.loads(text.format(n)), CONFIG / "devices") for n in "ab"]
    with pytest.raises(InputError, match="'position_um' is given by b and by a"):
        check_rig(two)


def test_units_convert_into_the_role(tmp_path):
    path = tmp_path / "e.yaml"
    path.write_text(
        ENCODER.replace(
            "unit: um, scale: 0.005, range: [-5000, 5000]",
            "unit: nm, scale: 5, offset: 100, range: [-5000000, 5000000]",
        )
    )
    node = yamlfile.loads("{profile: e.yaml, port: /dev/x, roles: {position: position_um}}")
    bound = bind(node, tmp_path).bounds[0]
    assert bound.scale == pytest.approx(0.005) and bound.offset == pytest.approx(0.1)
    assert bound.high == pytest.approx(5000)


def test_relative_ports_count_from_the_configuration(tmp_path):
    (tmp_path / "link").symlink_to("/dev/null")
    assert resolve_port("./link", tmp_path) == f"{tmp_path}/link"  # the link itself, not its target
    assert resolve_port("slcan:../can@500000", tmp_path / "config") == f"slcan:{tmp_path}/can@500000"
    for port in ("/dev/ttyUSB0", "tcp:127.0.0.1:502", "socketcan:can0", "rtu:/dev/x"):
        assert resolve_port(port, tmp_path) == port


def test_the_virtual_rig_refuses_a_bus_it_cannot_play():
    node = yamlfile.loads(
        "{profile: drive-cia402.yaml, port: 'socketcan:can0', roles: {state: amplifier_state}}"
    )
    with pytest.raises(InputError, match="slcan ports only"):
        virtual_device(bind(node, CONFIG / "devices"), None)


def test_check_says_what_is_allowed_and_yet_unusual(tmp_path, capsys):
    from thermoctl.daemon.offline.doctor import check

    (tmp_path / "module.yaml").write_text(MODULE.replace("register: 0,", "register: 40001,"))
    (tmp_path / "rig.yaml").write_text(
        "rig: {name: measures}\ncontrol: {kp: 0.01, ti_s: 0.004, td_s: 0.001, output_limit: 1.5}\n"
        "protection: {required: [coil_c]}\nhal:\n  backend: devices\n  devices:\n"
        "    - {profile: module.yaml, port: 'tcp:127.0.0.1:502', roles: {thermocouple_1: coil_c}}\n"
        f"socket: {{path: {tmp_path}/rig.sock}}\nrecording: {{directory: {tmp_path}}}\n"
    )
    assert check(load_settings(tmp_path / "rig.yaml")) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert "no device takes the command" in notes[0] and "cannot be driven" in notes[0]
    assert (
        "module.yaml:" in notes[1]
        and "register 40001" in notes[1]
        and "kind: holding, register: 0" in notes[1]
    )
    assert [n.split(":")[1].strip() for n in notes[2:]] == [
        "no output_reference_um (second encoder)",
        "no air_c",
    ]


@pytest.mark.parametrize(
    "number,message",
    [
        (400001, "where the manual calls it 400001, it is kind: holding, register: 0$"),
        (365536, "kind: input, register: 65535$"),
        (465537, "is outside 0 .. 65535"),
        (70000, "is outside 0 .. 65535"),
    ],
)
def test_register_numbers_of_six_digits_are_explained(tmp_path, number, message):
    (tmp_path / "module.yaml").write_text(MODULE.replace("register: 0,", f"register: {number},"))
    with pytest.raises(InputError, match=rf"module\.yaml:\d+:\d+: register: .*{message}"):
        load_profile(tmp_path / "module.yaml")


@pytest.mark.parametrize("limit,is_told", [(2.5, False), (15, True)])
def test_check_says_that_a_drive_takes_less_than_output_limit(tmp_path, capsys, limit, is_told):
    """The controller would wait for commands that the drive cuts off; drive_saturated compares with output_limit."""
    from thermoctl.daemon.offline.doctor import check

    (tmp_path / "rig.yaml").write_text(
        f"rig: {{name: driven}}\ncontrol: {{kp: 0.01, ti_s: 0.004, td_s: 0.001, output_limit: {limit}}}\n"
        "protection: {required: [amplifier_state]}\nhal:\n  backend: devices\n  devices:\n"
        f"    - {{name: amp, profile: {CONFIG}/devices/drive-cia402.yaml, port: 'slcan:/dev/x', "
        "roles: {state: amplifier_state}}\n"
        f"socket: {{path: {tmp_path}/rig.sock}}\nrecording: {{directory: {tmp_path}}}\n"
    )
    assert check(load_settings(tmp_path / "rig.yaml")) == 0
    told = "control.output_limit is 15, but amp takes commands of -2.5 .. 2.5 (drive.limits)"
    assert (told in capsys.readouterr().out) == is_told
