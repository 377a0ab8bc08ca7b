"""DBC and EDS files as people have them: only what a profile names must be sound (all small files are ours)."""

import re

import pytest

from tests.devices.harness import HEAD, make
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import ABSENT, ERROR, OK, ROLE, STALE, Sample
from thermoctl_hal.base.message import can_frame
from thermoctl_hal.base.profile import CanMessage
from thermoctl_hal.base.units import dbc_unit
from thermoctl_hal.can.bus import BY_PGN, EXTENDED, is_wanted, pgn_of
from thermoctl_hal.can.dbc_file import load_dbc
from thermoctl_hal.can.eds import read_eds
from thermoctl_hal.virtual.slcan import DbcSender

START = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: DEV HOST\n\n'
GOOD = 'BO_ 801 READING: 8 DEV\n SG_ Volts : 0|16@1- (0.01,0) [0|0] "V" HOST\n SG_ T : 16|8@1+ (1,-40) [0|0] "°C" HOST\n\n'
V = "v: {message: READING, signal: Volts, unit: V, rate_hz: 20, stale_after_s: 1"
T = "t: {message: READING, signal: T, unit: degC, rate_hz: 20, stale_after_s: 1"
ROLES = "{v: voltage_v, t: air_c}"


class Frames:
    """A CAN port that has the given frames."""

    bad = ignored = 0

    def __init__(self, *frames):
        self.frames = list(frames)

    def receive(self):
        found, self.frames = self.frames, []
        return found

    def long_frames(self):
        return []

    def close(self):
        pass


def device(folder, dbc, channels, roles=ROLES, more=""):
    folder.joinpath("a.dbc").write_bytes(dbc if isinstance(dbc, bytes) else dbc.encode())
    lines = "\n".join(f"  {c}}}" for c in channels)
    return make(folder, f"{HEAD}bus: can-dbc\ndbc: a.dbc\nchannels:\n{lines}\n", "virtual:x", roles, more)


def read(dev, *frames):
    dev._port, sample = Frames(*frames), Sample()
    dev.read(sample, 1.0)
    return sample


FAULTS = {
    "an id without bit 31": 'BO_ 13274 OTHER: 8 DEV\n SG_ X : 0|8@1+ (1,0) [0|0] "" HOST\n',
    "overlapping signals": 'BO_ 9 OTHER: 8 DEV\n SG_ C : 0|8@1+ (1,0) [0|0] "" H\n SG_ B : 3|1@1+ (1,0) [0|0] "" H\n',
    "a signal outside its message": 'BO_ 9 OTHER: 1 DEV\n SG_ C : 4|8@1+ (1,0) [0|0] "" HOST\n',
    "words of no signal": 'VAL_ 801 Absent 0 "off" 1 "on" ;\n',
    "words of no message": 'VAL_ 77 OTHER 0 "off" ;\n',
    "a factor without a zero": 'BO_ 9 OTHER: 8 DEV\n SG_ C : 0|8@1+ (.5,0) [0|0] "" HOST\n',
    "a decimal comma": 'BO_ 9 OTHER: 8 DEV\n SG_ C : 0|8@1+ (0,5,0,0) [0|0] "" HOST\n',
    "a factor that is no number": 'BO_ 9 OTHER: 8 DEV\n SG_ C : 0|8@1+ (x,0) [0|0] "" HOST\n',
    "a name with a digit first": 'BO_ 9 OTHER: 8 DEV\n SG_ 2C : 0|8@1+ (1,0) [0|0] "" HOST\n',
    "an id of 31 bits": 'BO_ 1075054137 OTHER: 8 DEV\n SG_ C : 0|8@1+ (1,0) [0|0] "" HOST\n',
    "a comment without an object": 'CM_ 801 "OTHER";\n',
    "two signals of one name": 'BO_ 9 OTHER: 8 DEV\n SG_ C : 0|8@1+ (1,0) [0|0] "" H\n SG_ C : 8|8@1+ (1,0) [0|0] "" H\n',
    "no signal at all": "BO_ 9 OTHER: 8 DEV\n SG_ C 0|8@1+\n",
    "an id in hexadecimal": 'BO_ 0x9 OTHER: 8 DEV\n SG_ C : 0|8@1+ (1,0) [0|0] "" HOST\n',
    "a blank in a name": 'BO_ 9 OTHER MSG: 8 DEV\n SG_ C : 0|8@1+ (1,0) [0|0] "" HOST\n',
    "no message": 'BO_ OTHER 9: 8 DEV\n SG_ Volts : 40|8@1+ (1,0) [0|0] "" HOST\n',
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("first", [True, False])
def test_what_a_profile_does_not_name_may_be_wrong(tmp_path, fault, first):
    other = FAULTS[fault] + "\n"
    dev = device(tmp_path, START + (other + GOOD if first else GOOD + other), [V, T])
    sample = read(dev, (801, bytes.fromhex("d2043c0000000000")))
    assert sample.value[ROLE["voltage_v"]] == pytest.approx(12.34)
    assert sample.value[ROLE["air_c"]] == pytest.approx(20)
    warning = dev.binding.profile.bus_spec.warning
    line = 1 + (START + ("" if first else GOOD)).count("\n")
    found = re.fullmatch(r".*a\.dbc:(\d+): .*", warning)
    assert found, warning
    assert line <= int(found[1]) <= line + 2 and re.search("OTHER|Absent", warning), warning


@pytest.mark.parametrize("fault", ["an id without bit 31", "overlapping signals"])
def test_a_comment_of_several_lines_is_no_message(tmp_path, fault):
    """Old messages that somebody kept as a comment."""
    comment = 'CM_ BO_ 801 "before:\nBO_ 801 READING: 8 DEV\n SG_ Volts : 0|8@1+ (9,0) [0|0]\nBO_ 802 T: 8 DEV\nend";\n'
    dev = device(tmp_path, START + FAULTS[fault] + GOOD + comment, [V, T])
    assert read(dev, (801, bytes.fromhex("d2043c0000000000"))).value[ROLE["voltage_v"]] == pytest.approx(
        12.34
    )


@pytest.mark.parametrize(
    "text,channel,words",
    [
        (GOOD + GOOD.replace("801", "802"), V, "2 messages have this name .0x321, 0x322."),
        (GOOD.replace("801", "1075054137"), V, "has more than 29 bits"),
        (GOOD.replace("(0.01,0)", "(x,0)"), V, "no signal of the format"),
        (GOOD.replace("(0.01,0)", "(0,0)"), V, "signal: .*a.dbc: Volts has the factor 0"),
        (GOOD.replace(" T :", " Volts :"), V, "a second signal of this name"),
        (GOOD, V.replace("Volts", "Vols"), "'Vols' is not one of Volts, T .did you mean 'Volts'"),
    ],
)
def test_what_a_profile_names_must_be_sound(tmp_path, text, channel, words):
    with pytest.raises(InputError, match=words) as e:
        device(tmp_path, START + text, [channel], "{v: voltage_v}")
    assert re.match(r".*device\.yaml:\d+:\d+: ", str(e.value)) and "\n" not in str(e.value)


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "latin-1", "cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-32"]
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_every_encoding_that_csv_files_have(tmp_path, encoding, end):
    dbc = (START + GOOD + 'CM_ SG_ 801 T "Größe";\n').replace("\n", end).encode(encoding)
    dev = device(tmp_path, dbc, [V, T])
    assert read(dev, (801, bytes.fromhex("d2043c0000000000"))).value[ROLE["air_c"]] == pytest.approx(20)
    assert dev.binding.profile.bus_spec.warning == ""


@pytest.mark.parametrize(
    "theirs", ["°F", "degF", "deg F", "Fahrenheit", "\u2109", "ºF", "K", "kelvin", "rpm", "mV"]
)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16"])
def test_another_unit_in_the_file_is_refused(tmp_path, theirs, encoding):
    try:
        dbc = (START + GOOD.replace("°C", theirs)).encode(encoding)
    except UnicodeEncodeError:
        return
    with pytest.raises(InputError, match="the DBC file gives T in "):
        device(tmp_path, dbc, [T], "{t: air_c}")


@pytest.mark.parametrize(
    "theirs,ours",
    [
        ("°C", "degC"), ("C", "degC"), ("Deg_C", "degC"), ("degree C", "degC"), ("[deg. C]", "degC"), ("℃", "degC"),
        ("ºC", "degC"), ("Â°C", "degC"), ("\ufffdC", "degC"), ("grad C", "degC"), ("celsius", "degC"), ("µm", "um"),
        ("μm", "um"), ("micrometer", "um"), ("micron", "um"), ("millivolt", "mV"), ("MV", "MV"), ("Volts", "V"),
        ("°K", "K"), ("°", "deg"), ("deg/s", "deg/s"), ("", ""), (None, ""), ("km/h", "km/h"), ("milliamps", "mA"),
    ],
)  # fmt: skip
def test_spellings_of_units(theirs, ours):
    assert dbc_unit(theirs) == ours


def test_a_factor_of_the_file_counts_once(tmp_path):
    with pytest.raises(
        InputError, match="scale: the DBC file gives Volts in V with its factor 0.01, .* say scale: 1"
    ):
        device(tmp_path, START + GOOD, [V + ", scale: 0.01"], "{v: voltage_v}")
    for scale in ("1.02", "0.5"):  # a calibration, a divider
        device(tmp_path, START + GOOD, [V + f", scale: {scale}"], "{v: voltage_v}")


@pytest.mark.parametrize("first,second", [(801, 801), (0x98FEEEFE, 0x8CFEEEFE)])
def test_two_messages_of_one_identifier_are_told(tmp_path, first, second):
    """A signal of the second one would be read by the layout of the first one."""
    other = GOOD.replace("801 READING", f"{second} OTHER").replace("16|8@1+ (1,", "24|8@1+ (2,")
    dbc = START + GOOD.replace("801", str(first)) + other
    with pytest.raises(
        InputError, match=r"yaml:\d+:\d+: message: OTHER and READING have the same identifier"
    ):
        device(tmp_path, dbc, [V, T.replace("READING", "OTHER")])
    device(tmp_path, dbc, [V, T])


def test_kelvin_with_an_offset_is_celsius(tmp_path):
    device(tmp_path, START + GOOD, [T.replace("degC", "K") + ", offset: 273.15"], "{t: air_c}")


@pytest.mark.parametrize(
    "sentinel,raw",
    [
        ("327.67", 0x7FFF),
        ("-327.68", 0x8000),
        ("32767", 0x7FFF),
        ("0x7FFF", 0x7FFF),
        ("'0x8000'", 0x8000),
        ("0xFFFF", 0xFFFF),
    ],
)
def test_a_sentinel_is_compared_as_a_raw_number(tmp_path, sentinel, raw):
    dev = device(tmp_path, START + GOOD, [f"{V}, sentinels: [{sentinel}]"], "{v: voltage_v}")
    for data, status in ((raw, ERROR), (raw - 1 & 0xFFFF, OK), (1234, OK)):
        sample = read(dev, (801, data.to_bytes(2, "little") + bytes(6)))
        assert sample.status[ROLE["voltage_v"]] == status, hex(data)


@pytest.mark.parametrize("sentinel", ["40000", "-40000", "327.675", "0x10000", "1e9"])
def test_a_sentinel_that_cannot_come_is_refused(tmp_path, sentinel):
    with pytest.raises(InputError, match=r"device\.yaml:\d+:\d+: sentinels: .* cannot come"):
        device(tmp_path, START + GOOD, [f"{V}, sentinels: [{sentinel}]"], "{v: voltage_v}")


@pytest.mark.parametrize("sign", ["1-", "0-"])
@pytest.mark.parametrize("stated", [0, 2, 5])
def test_a_signal_beyond_the_length_of_its_message_costs_no_other(tmp_path, stated, sign):
    """With a length below 6 the message did not decode at all, though `check` found nothing."""
    beyond = f' SG_ X : {40 if sign == "1-" else 47}|8@{sign} (1,0) [0|0] "A" HOST\n'
    message = GOOD.replace("READING: 8", f"READING: {stated}").replace(" SG_ T", beyond + " SG_ T")
    dev = device(
        tmp_path,
        START + message,
        [V, T, V.replace("v:", "x:").replace("Volts", "X").replace("unit: V", "unit: A")],
        "{v: voltage_v, t: air_c, x: current_a}",
    )
    sample = read(dev, (801, bytes.fromhex("d2043c0000fb")))
    found = [sample.value[ROLE[r]] for r in ("voltage_v", "air_c", "current_a")]
    assert found == pytest.approx([12.34, 20.0, -5.0])


@pytest.mark.parametrize("size", [3, 4, 7])
def test_a_short_frame_gives_the_signals_that_it_has(tmp_path, size):
    dev = device(tmp_path, START + GOOD, [V, T])
    sample = read(dev, (801, bytes.fromhex("d2043c0000000000")[:size]))
    assert sample.value[ROLE["voltage_v"]] == pytest.approx(12.34) and sample.status[ROLE["air_c"]] == OK
    short = read(dev, (801, b"\xd2\x04"))
    assert short.status[ROLE["voltage_v"]] == OK and short.status[ROLE["air_c"]] != OK
    read(dev, (801, b"\xd2"))
    assert "READING came with 1 of 8 bytes" in dev.silence()


def test_a_page_that_the_file_does_not_describe_gives_the_signals_of_every_page(tmp_path):
    dbc = GOOD.replace(" SG_ Volts : 0", ' SG_ Page M : 32|8@1+ (1,0) [0|0] "" H\n SG_ Volts : 0').replace(
        "T :", "T m1 :"
    )
    dev = device(tmp_path, START + dbc, [V, T])
    sample = read(dev, (801, bytes.fromhex("d2043c0001000000")), (801, bytes.fromhex("d3043d0007000000")))
    assert sample.value[ROLE["voltage_v"]] == pytest.approx(12.35) and dev.counts["errors"] == 0
    assert sample.value[ROLE["air_c"]] == pytest.approx(20)
    dev = device(tmp_path, START + dbc, [T], "{t: air_c}")
    read(dev, (801, bytes.fromhex("d3043d0007000000")))
    assert (
        "1 frames came and gave no reading: READING came with Page 7, a page without the signal"
        in dev.silence()
    )


def test_a_page_without_signals_below_costs_no_signal_beside_it(tmp_path):
    """Extended multiplexing: of page 7 Volts counts, and of Sub, which is on it too, no page but 3 is described."""
    dbc = (
        'BO_ 801 READING: 8 DEV\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" H\n SG_ Sub m7M : 8|8@1+ (1,0) [0|0] "" H\n'
        ' SG_ Volts m2 : 16|16@1- (0.01,0) [0|0] "V" H\n SG_ T m3 : 32|8@1+ (1,-40) [0|0] "°C" H\n\n'
        "SG_MUL_VAL_ 801 Sub Page 7-7, 9-12;\nSG_MUL_VAL_ 801 Volts Page 2-2, 7-7;\nSG_MUL_VAL_ 801 T Sub 3-3;\n"
    )
    dev = device(tmp_path, START + dbc, [V, T])
    sample = read(dev, (801, bytes.fromhex("0700d2043c000000")))
    assert sample.value[ROLE["voltage_v"]] == pytest.approx(12.34) and sample.status[ROLE["air_c"]] != OK
    sample = read(dev, (801, bytes.fromhex("0c0300003c000000")))
    assert sample.value[ROLE["air_c"]] == pytest.approx(20) and sample.status[ROLE["voltage_v"]] != OK


J1939 = 'BO_ 2566844158 ET1: 8 DEV\n SG_ T : 0|8@1+ (1,-40) [0|0] "deg C" HOST\n'
ET1 = "t: {message: ET1, signal: T, unit: degC, rate_hz: 20, stale_after_s: 1"


def test_a_j1939_message_comes_from_any_source_at_any_priority(tmp_path):
    for can_id in (0x18FEEE00, 0x18FEEE5A, 0x0CFEEE21):
        dev = device(tmp_path, START + J1939, [ET1], "{t: air_c}")
        assert read(dev, (EXTENDED | can_id, b"\x5a" + bytes(7))).value[ROLE["air_c"]] == 50
        assert read(dev, (EXTENDED | can_id, b"\xff" + bytes(7))).status[ROLE["air_c"]] == ERROR
    dev = device(tmp_path, START + J1939, [ET1], "{t: air_c}")
    for other in (0x18FEEF00, 0x18FEED00, 0x19FEEE00):
        assert read(dev, (EXTENDED | other, b"\x5a" + bytes(7))).status[ROLE["air_c"]] != OK
    assert "none is PGN 65262 of J1939" in dev.silence()


@pytest.mark.parametrize("bits, good", [(8, 0xFA), (16, 0xFAFF), (32, 0xFAFFFFFF), (12, 0xFFF)])
def test_what_j1939_calls_not_available_or_an_error_is_no_reading(tmp_path, bits, good):
    """0xFF of a thermometer that is not fitted was 215 degC; 12 bits have no such codes."""
    signal = J1939.replace("0|8@1+ (1,-40)", f"0|{bits}@1+ (1e-8,0)")
    dev = device(tmp_path, START + signal, [ET1], "{t: air_c}")
    for raw in (good, 0xFE << bits - 8, (1 << bits) - 1):
        sample = read(dev, (EXTENDED | 0x18FEEE00, raw.to_bytes(8, "little")))
        assert (sample.status[ROLE["air_c"]] == OK) == (raw == good or bits == 12)
    dev = device(tmp_path, START + signal.replace("2566844158", "801"), [ET1], "{t: air_c}")
    assert read(dev, (801, b"\xff" * 8)).status[ROLE["air_c"]] == OK


def test_of_two_senders_of_a_group_the_first_or_the_named_one_counts(tmp_path):
    both = [(EXTENDED | 0x18FEEE00, b"\x5a" + bytes(7)), (EXTENDED | 0x18FEEE5B, b"\x64" + bytes(7))]
    dev = device(tmp_path, START + J1939, [ET1], "{t: air_c}")
    assert read(dev, *both).value[ROLE["air_c"]] == 50
    dev = device(tmp_path, START + J1939, [ET1], "{t: air_c}", ", address: 0x5B")
    assert read(dev, *both).value[ROLE["air_c"]] == 60
    read(dev, both[0])
    assert "source addresses 0 send it, too: give the wanted one as 'address'" in dev.silence()


@pytest.mark.parametrize("address", [0, 0x5B])
def test_the_named_sender_counts_whoever_came_first(tmp_path, address):
    both = [(EXTENDED | 0x18FEEE00 | a, bytes((90 + a // 9,)) + bytes(7)) for a in (0x5B, 0, 0x17)]
    dev = device(tmp_path, START + J1939, [ET1], "{t: air_c}", f", address: {address}")
    assert read(dev, *both).value[ROLE["air_c"]] == 50 + address // 9


def test_a_message_with_an_address_of_its_own_is_another_senders_by_address(tmp_path):
    """Without a mark in the file, 29 bits are an identifier; the message says which key makes them a parameter group."""
    dbc = START + J1939.replace("2566844158", str(EXTENDED | 0x18FEEE00))
    other = (EXTENDED | 0x18FEEE5A, b"\x5a" + bytes(7))
    dev = device(tmp_path, dbc, [ET1], "{t: air_c}")
    assert read(dev, other).status[ROLE["air_c"]] != OK
    assert "0x18FEEE5A came" in dev.silence() and "say address: 90" in dev.silence()
    dev = device(tmp_path, dbc, [ET1], "{t: air_c}", ", address: 90")
    assert read(dev, other).value[ROLE["air_c"]] == 50
    typed = 'BA_DEF_ "ProtocolType" STRING ;\nBA_DEF_DEF_ "ProtocolType" "";\nBA_ "ProtocolType" "J1939";\n'
    for fault in ("", FAULTS["overlapping signals"]):
        dev = device(tmp_path, dbc + fault + typed, [ET1], "{t: air_c}")
        assert read(dev, other).value[ROLE["air_c"]] == 50


def test_a_message_of_11_bits_is_none_of_j1939(tmp_path):
    formats = (
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n'
    )
    dev = device(tmp_path, START + GOOD + formats, [V], "{v: voltage_v}")
    assert read(dev, (801, bytes.fromhex("d204") + bytes(6))).value[ROLE["voltage_v"]] == pytest.approx(12.34)


def test_parameter_groups_of_identifiers():
    assert pgn_of(EXTENDED | 0x18FEEE5A) == BY_PGN | 0xFEEE and pgn_of(0x7FF) == 0
    assert pgn_of(EXTENDED | 0x0CEF1234) == BY_PGN | 0xEF00  # below 240: the receiver's address follows
    assert is_wanted(EXTENDED | 0x18FEEE00, frozenset({BY_PGN | 0xFEEE}))
    assert not is_wanted(0x18, frozenset({BY_PGN | 0xFEEE}))


@pytest.mark.parametrize("text", ["", START + "BO_", "hello", "[6041]", "BO_ x y\n", "\0" * 100])
def test_what_is_no_dbc_file_is_refused(tmp_path, text):
    with pytest.raises(InputError, match=r"a\.dbc is not a DBC file: no message .a line 'BO_"):
        device(tmp_path, text, [V], "{v: voltage_v}")


def test_multiplexed_and_float_signals_survive_a_fault_elsewhere(tmp_path):
    text = (
        START
        + FAULTS["an id without bit 31"]
        + 'BO_ 7 M: 8 D\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" H\n SG_ 1A m0 : 8|16@1- (0.1,0) [0|0] "V" H\n'
        + ' SG_ B m1 : 8|16@1- (1,0) [0|0] "V" H\n SG_ F : 32|32@1- (1,0) [0|0] "V" H\n\nSIG_VALTYPE_ 7 F : 1;\n'
    )
    tmp_path.joinpath("a.dbc").write_text(text)
    file = load_dbc(tmp_path / "a.dbc")
    message = file.database.get_message_by_name("M")
    found = message.decode_simple(b"\x00\x0a\x00\x00\x00\x00\x80\x3f", False)
    assert found["1A"] == pytest.approx(1.0) and found["F"] == 1.0 and "B" not in found and not file.faults


EDS = "[FileInfo]\nFileName=x\n\n[6041]\nParameterName=Statusword\nObjectType=0x7\nDataType=0x0006\n\n"
MORE = "[2022]\nParameterName=many\nObjectType=9\nSubNumber=2\n[2022sub1]\nParameterName=a\nDataType=3\n"
ODD = {
    "none": ("", ""),
    "a comment without a mark": ("// a maker's remark\n", r"a\.eds:\d+: '// a maker"),
    "a line without a key": ("what is this\n", r"a\.eds:\d+: 'what is this'"),
    "a doubled section": ("[6041]\nDataType=6\n", r"object 0x6041 stands twice"),
    "numbers with h": ("[2300]\nObjectType=7h\nDataType=0007h\n", ""),
    "no type": ("[2300]\nParameterName=x\nObjectType=0x7\n", r"object 0x2300 has no DataType"),
    "an orphaned sub-object": (
        "[2023sub1]\nObjectType=7\nDataType=5\n",
        r"\[2023sub1\] has no object \[2023\]",
    ),
    "an orphaned count": ("[2023sub0]\nObjectType=7\nDataType=5\n", r"\[2023sub0\] has no object \[2023\]"),
    "numbers with leading zeros": ("[DeviceInfo]\nVendorNumber=001\nGranularity=\n", ""),
    "a percent sign": ("[2300]\nParameterName=100 %\nDataType=6\nDefaultValue=%(x)s\n", ""),
    "a bracket forgotten": ("[3000\nDataType=6\n", ""),
    "another case": ("[1a00SUB1]\nDATATYPE=7\n[1A00]\nobjecttype=9\n", ""),
}


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_an_eds_file_is_read_in_spite_of_what_is_not_named(tmp_path, odd, encoding):
    text, warning = ODD[odd]
    path = tmp_path / "a.eds"
    path.write_bytes((EDS + "[DeviceInfo]\nProductName=Verstärker 5 µA\n" + MORE + text).encode(encoding))
    found = read_eds(path)
    assert [found.entries[k].data_type for k in ((0x6041, 0), (0x2022, 1))] == [6, 3]
    assert re.search(warning, found.warning) if warning else found.warning == ""


@pytest.mark.parametrize(
    "old,new",
    [
        ("=0x0006", '="0x0006"'), ("=0x0006", "=0x0006 # status"), ("=0x0006", "=0x0006;status"), ("=0x0006", "=UNSIGNED16"),
        ("=0x0006", "=0X0006"), ("=0x0006", "=0x06h"), ("=0x0006", "=006 // status"),
        ("=0x0006", "=Unsigned16"), ("=0x0006", "=6"), ("DataType=", "DataType=\nDataType="), ("=", " = "), ("=", ": "),
        ("[6041]", "[6041h]"), ("[6041]", "[0x6041] ; status"), ("[6041]", "[ 6041"), ("\n", "\n\t"),
    ],
)  # fmt: skip
def test_spellings_of_an_eds(tmp_path, old, new):
    path = tmp_path / "a.eds"
    path.write_text(EDS.replace(old, new))
    assert read_eds(path).entries[0x6041, 0].data_type == 6


def test_compact_sub_objects_have_the_type_of_their_object(tmp_path):
    path = tmp_path / "a.eds"
    path.write_text("[5002]\nParameterName=array\nCompactSubObj=3\nObjectType=8\nDataType=2\n")
    found = read_eds(path)
    assert found.subs(0x5002) == [1, 2, 3] and found.entries[0x5002, 3].data_type == 2 and not found.warning


DRIVE = """
bus: can-cia402
cia402: {eds: a.eds, node_id: 5, mode: 10, command: 0x6071, transmit: [0x6041%s], heartbeat_s: 0.02, watchdog_s: 0.1}
drive: {unit: A, scale: 0.001, limits: [-1, 1]}
channels:
  state: {object: 0x6041, unit: '1', rate_hz: 100, stale_after_s: 0.1}
"""
TORQUE = "[6071]\nObjectType=7\nDataType=3\n"


@pytest.mark.parametrize(
    "more,named,words",
    [
        ("[2300]\nParameterName=x\n", ", 0x2300", r"object 0x2300 \(line \d+\) has no DataType"),
        ("[2300]\nDataType=0x 0003\n", ", 0x2300", r"has DataType=0x 0003, which is no number: correct it"),
        (
            "[6077]\nDataType=3\n[6077]\nDataType=4\n",
            ", 0x6077",
            r"stands twice with different types \(lines 12, 14\)",
        ),
        (MORE, ", 0x2022", "has sub-indices; say which, as 0x2022:1"),
        (MORE, ", '0x2022:2'", "has no sub-index 2; it has 1"),
        (MORE, ", 0x3000", "0x3000 is not in it"),
        ("[6077]\nDataType=9\n", ", 0x6077", r"\(line 12\) is no whole number of up to 4 bytes"),
        (
            "[6077]\nDataType=3\nPDOMapping=0x0\n",
            ", 0x6077",
            r"\(line 12\) has PDOMapping=0: no PDO can hold",
        ),
        ("[2100]\nDataType=3\nPDOMapping=0\nCompactSubObj=2\n", ", '0x2100:1'", "has PDOMapping=0"),
    ],
)
def test_what_a_drive_names_must_be_sound_in_its_eds(tmp_path, more, named, words):
    tmp_path.joinpath("a.eds").write_text(EDS + TORQUE + more)
    with pytest.raises(InputError, match=words):
        make(tmp_path, HEAD + DRIVE % named, "virtual:x", "{state: amplifier_state}")
    assert make(tmp_path, HEAD + DRIVE % "", "virtual:x", "{state: amplifier_state}")


LIMITS = {
    "decimal": ("-1000", "+1000"), "a blank after the sign": ("- 1000", "1000"), "16 bits": ("0xFC18", "0X03E8"),
    "32 bits for 16": ("0xFFFFFC18", "0x000003E8"), "with h": ("0FC18h", "3E8h"), "both marks": ("0xFC18h", "0x3E8"),
    "a comment": ("-1000 // A", "1000 ; A"), "leading zeros": ("-1000", "0x0003E8"),
}  # fmt: skip


@pytest.mark.parametrize("how", LIMITS)
def test_the_limits_of_an_eds_are_heeded_in_every_spelling(tmp_path, how):
    """A limit that was not understood was none: the drive's refusal came in the tick, or never."""
    low, high = LIMITS[how]
    tmp_path.joinpath("a.eds").write_text(EDS + TORQUE + f"LowLimit={low}\nHighLimit={high}\n")
    for reach, fits in (("[-1, 1]", True), ("[-1.1, 1]", False), ("[-1, 1.1]", False)):
        profile = HEAD + DRIVE.replace("[-1, 1]", reach) % ""
        if fits:
            assert make(tmp_path, profile, "virtual:x", "{state: amplifier_state}")
            continue
        with pytest.raises(InputError, match=r"takes -1000 \.\. 1000 \(LowLimit, HighLimit\)"):
            make(tmp_path, profile, "virtual:x", "{state: amplifier_state}")


@pytest.mark.parametrize(
    "limit, says",
    [
        ("-1000.5", "no decimal number"),
        ("1 000", "no decimal number"),
        ("01750", "could be octal, 1000"),
        ("−5", "=−5"),
    ],
)
def test_a_limit_that_is_no_number_is_not_passed_over(tmp_path, limit, says):
    tmp_path.joinpath("a.eds").write_text(EDS + TORQUE + f"LowLimit={limit}\n")
    with pytest.raises(InputError, match=f"0x6071 has LowLimit={limit}.*{says}|{says}.*correct the file"):
        make(tmp_path, HEAD + DRIVE % "", "virtual:x", "{state: amplifier_state}")


def test_an_eds_without_objects_is_refused(tmp_path):
    tmp_path.joinpath("a.eds").write_text("[FileInfo]\nFileName=x\n")
    with pytest.raises(
        InputError,
        match="no EDS file: it has no section of an object.* of an XDD or ESI file .* saves an EDS",
    ):
        make(tmp_path, HEAD + DRIVE % "", "virtual:x", "{state: amplifier_state}")


def test_a_file_is_read_again_when_it_has_changed(tmp_path):
    """A daemon that reloads its configuration must not keep the profile, DBC or EDS file of its start."""
    dev = device(tmp_path, START + GOOD, [V], "{v: voltage_v}")
    assert read(dev, (801, bytes.fromhex("d204") + bytes(6))).value[ROLE["voltage_v"]] == pytest.approx(12.34)
    dev = device(tmp_path, START + GOOD.replace("(0.01,0)", "(0.02,0)"), [V], "{v: voltage_v}")
    assert read(dev, (801, bytes.fromhex("d204") + bytes(6))).value[ROLE["voltage_v"]] == pytest.approx(24.68)
    dev = device(tmp_path, START + GOOD, [V + ", offset: 0.5"], "{v: voltage_v}")
    assert read(dev, (801, bytes.fromhex("d204") + bytes(6))).value[ROLE["voltage_v"]] == pytest.approx(12.84)
    path = tmp_path / "a.eds"
    for number in (6, 7):
        path.write_text(EDS.replace("0x0006", str(number)))
        assert read_eds(path).entries[0x6041, 0].data_type == number
    path.unlink()
    with pytest.raises(OSError):
        read_eds(path)


FLOAT = 'BO_ 801 READING: 8 DEV\n SG_ Volts : 0|32@1- (1,0) [0|0] "V" HOST\n\n'
KINDS = {
    "cut off": "SIG_VALTYPE_ 801 Volts : 1\n",
    "cut off, a fault elsewhere": FAULTS["a factor without a zero"] + "SIG_VALTYPE_ 801 Volts : 1\n",
    "hexadecimal": "SIG_VALTYPE_ 0x321 Volts : 1;\n",
    "another end": "SIG_VALTYPE_ 801 Volts : 1,\n",
    "small letters": "sig_valtype_ 801 Volts : 1;\n",
}


@pytest.mark.parametrize("line", KINDS.values(), ids=KINDS)
def test_a_float_whose_kind_cannot_be_read_is_no_whole_number(tmp_path, line):
    """2.5 V was read as 1075838976 V."""
    with pytest.raises(InputError, match="Volts : 1.*no line of the format"):
        device(tmp_path, START + FLOAT + line, [V], "{v: voltage_v}")


NESTED = (
    'BO_ 801 READING: 8 DEV\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" HOST\n SG_ Sub m1M : 8|8@1+ (1,0) [0|0] "" HOST\n'
    ' SG_ Volts m3 : 16|16@1- (0.01,0) [0|0] "V" HOST\n\n'
)
PAGES = "SG_MUL_VAL_ 801 Sub Page 1-1;\nSG_MUL_VAL_ 801 Volts Sub 3-3;\n"


@pytest.mark.parametrize(
    "text",
    [NESTED, NESTED.replace("m1M", "").replace(" M ", " "), NESTED + "SG_MUL_VAL_ 801 Volts Sub 3-3;\n"],
)
def test_a_page_that_nothing_selects_is_refused(tmp_path, text):
    """The signal was read from the frames of every page."""
    with pytest.raises(InputError, match="select its page: add SG_MUL_VAL_"):
        device(tmp_path, START + text, [V], "{v: voltage_v}")


@pytest.mark.parametrize("fault", ["", FAULTS["a factor without a zero"]])
def test_nested_pages_are_told_apart(tmp_path, fault):
    dev = device(tmp_path, START + fault + NESTED + PAGES, [V], "{v: voltage_v}")
    frame = bytes([1, 3, 0xD2, 4, 0, 0, 0, 0])
    assert read(dev, (801, frame)).value[ROLE["voltage_v"]] == pytest.approx(12.34)
    for other in (bytes([1, 2]), bytes([2, 3])):
        assert read(dev, (801, other + frame[2:])).status[ROLE["voltage_v"]] != OK


@pytest.mark.parametrize("fault", ["", FAULTS["a factor without a zero"]])
def test_a_number_that_the_file_names_as_no_value_is_none(tmp_path, fault):
    words = [
        "SNA",
        "Error",
        "Sensor defect",
        "Signal_ungueltig",
        "Invalid_Value",
        "Init",
        "n/a",
        "Undefined",
        "Not valid",
    ]
    words += [
        "unavailable",
        "open_circuit",
        "Kurzschluss",
        "nicht verfügbar",
        "kein Wert",
        "Timeout",
        "Out of range",
    ]
    words += ["overflow", "Signal lost", "Ersatzwert", "Not_plausible"]
    fine = ["no error", "highest", "no timeout", "open", "Reserved"]
    table = " ".join(f'{255 - k} "{word}"' for k, word in enumerate(words + fine))
    text = (START + fault + GOOD + f"VAL_ 801 T {table} ;\n").encode("cp1252")
    dev = device(tmp_path, text, [T], "{t: air_c}")
    for raw in range(220, 256):
        status = read(dev, (801, bytes([0, 0, raw, 0, 0, 0, 0, 0]))).status[ROLE["air_c"]]
        assert status == (ERROR if raw > 255 - len(words) else OK), raw


@pytest.mark.parametrize(
    "line", ["801 Volts Absent ;", '801 Volts 65535.0 "SNA" ;', '801 Volts\n 65535 "SNA" ;']
)
@pytest.mark.parametrize("fault", ["", FAULTS["a factor without a zero"]])
def test_words_that_cannot_be_read_leave_out_their_signal(tmp_path, line, fault):
    """They were passed over, so that their 'SNA' was a reading."""
    text = START + fault + GOOD + f"VAL_ {line}\n"
    assert device(tmp_path, text, [T], "{t: air_c}")
    if not fault and "\n" in line:  # cantools reads it
        assert device(tmp_path, text, [V], "{v: voltage_v}")
        return
    with pytest.raises(InputError, match="VAL_ 801 Volts.*: no line of the format"):
        device(tmp_path, text, [V], "{v: voltage_v}")


@pytest.mark.parametrize("fault", ["", FAULTS["a factor without a zero"]])
def test_words_without_their_semicolon_count(tmp_path, fault):
    dev = device(tmp_path, START + fault + GOOD + 'VAL_ 801 Volts 65535 "SNA"\n', [V], "{v: voltage_v}")
    assert read(dev, (801, bytes.fromhex("ffff000000000000"))).status[ROLE["voltage_v"]] == ERROR


@pytest.mark.parametrize("fault", ["", FAULTS["a factor without a zero"]])
@pytest.mark.parametrize(
    "lines",
    [
        'VAL_ 801 Volts 65535 "SNA" ;\nVAL_ 801 T 255 "SNA" ;\nVAL_ 801 Volts 65534 "Error" ;\n',
        'VAL_TABLE_ None 65535 "SNA" 65534 "Error" ;\nVAL_ 801 Volts None ;\n',
        'VAL_ 801 Volts None ;\nVAL_TABLE_ None 65535 "SNA" 65534 "Error" ;\n',
    ],
)
def test_words_in_two_lines_or_in_a_table_count(tmp_path, fault, lines):
    """The last line of a signal counted alone: 655.35 V was a reading. The name of a table was refused."""
    dev = device(tmp_path, START + fault + GOOD + lines, [V], "{v: voltage_v}")
    for data, status in (("ffff", ERROR), ("feff", ERROR), ("fdff", OK)):
        found = read(dev, (801, bytes.fromhex(data.ljust(16, "0"))))
        assert found.status[ROLE["voltage_v"]] == status


@pytest.mark.parametrize("value", ["99", '"StandardCAN_FD"'])
def test_a_wrong_frame_format_is_passed_over(tmp_path, value):
    """It was refused with 'list index out of range'."""
    text = 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN";\nBA_DEF_DEF_ "VFrameFormat" "StandardCAN";\n'
    dev = device(
        tmp_path, START + GOOD + text + f'BA_ "VFrameFormat" BO_ 801 {value};\n', [V], "{v: voltage_v}"
    )
    assert read(dev, (801, bytes.fromhex("d204000000000000"))).value[ROLE["voltage_v"]] == pytest.approx(
        12.34
    )


@pytest.mark.parametrize("stated", [-32768, 32768])
def test_no_value_of_a_signed_signal_may_be_stated_as_its_bits(tmp_path, stated):
    """The bits were a number that the signal cannot have, so that -327.68 V was a reading."""
    dev = device(tmp_path, START + GOOD + f'VAL_ 801 Volts {stated} "SNA" ;\n', [V], "{v: voltage_v}")
    for data, status in ((b"\x00\x80", ERROR), (b"\x01\x80", OK)):
        assert read(dev, (801, data.ljust(8, b"\0"))).status[ROLE["voltage_v"]] == status


def test_the_error_of_a_state_is_a_reading(tmp_path):
    text = GOOD + ' SG_ S : 24|8@1+ (1,0) [0|0] "" HOST\n' + 'VAL_ 801 S 0 "off" 1 "on" 2 "Error" 3 "SNA" ;\n'
    state = "s: {message: READING, signal: S, unit: '1', rate_hz: 20, stale_after_s: 1"
    dev = device(tmp_path, START + text.replace("\n\n SG_", "\n SG_"), [state], "{s: amplifier_state}")
    for raw, status in ((2, OK), (3, ERROR)):
        assert read(dev, (801, bytes([0, 0, 0, raw, 0, 0, 0, 0]))).status[ROLE["amplifier_state"]] == status


@pytest.mark.parametrize("fault", ["", FAULTS["an id without bit 31"]])
def test_long_names_are_read_beside_a_fault_too(tmp_path, fault):
    """The names that people see in their tools were unknown when another message had a fault."""
    named = "".join(
        f'BA_DEF_ {o} "System{of}LongSymbol" STRING ;\nBA_DEF_DEF_ "System{of}LongSymbol" "";\n'
        for o, of in (("BO_", "Message"), ("SG_", "Signal"))
    )
    named += 'BA_ "SystemMessageLongSymbol" BO_ 801 "READING_with_a_long_name";\n'
    named += 'BA_ "SystemSignalLongSymbol" SG_ 801 Volts "Volts_with_a_long_name";\n'
    channel = V.replace("READING", "READING_with_a_long_name").replace("Volts", "Volts_with_a_long_name")
    dev = device(tmp_path, START + fault + GOOD + named, [channel], "{v: voltage_v}")
    frame = (801, bytes.fromhex("d2043c0000000000"))
    assert read(dev, frame).value[ROLE["voltage_v"]] == pytest.approx(12.34)


def test_a_page_is_selected_by_the_raw_number_of_its_multiplexer(tmp_path):
    """By a multiplexer with a factor the value of another page was read, and another page was sent."""
    pages = NESTED.replace("m1M : 8|8@1+ (1,0)", "M : 8|8@1+ (2,1)").replace(" Page M ", " Page ")
    dev = device(tmp_path, START + pages, [V], "{v: voltage_v}")
    for raw, status in ((3, OK), (1, ABSENT)):
        frame = bytes([0, raw, 0xD2, 4, 0, 0, 0, 0])
        assert read(dev, (801, frame)).status[ROLE["voltage_v"]] == status
    message = CanMessage("READING", {"Sub": 7.0, "Volts": None})
    assert can_frame(message, dev.binding.profile.bus_spec, 12.34, 0) == (
        801,
        bytes([0, 3, 0xD2, 4, 0, 0, 0, 0]),
    )


STATUS = ' SG_ Good : 56|8@1+ (1,0) [0|0] "" HOST\n'
SEEN = {
    "a short frame": (GOOD.rstrip("\n") + "\n" + STATUS, [bytes(4), bytes(7)]),
    "another page": (
        GOOD.replace(" Volts :", " Volts m1 :").rstrip("\n")
        + '\n SG_ Page M : 48|8@1+ (1,0) [0|0] "" HOST\n'
        + STATUS.replace(" :", " m0 :"),
        [bytes([0, 0, 0, 0, 0, 0, page, 0]) for page in (0, 1)],
    ),
}


@pytest.mark.parametrize("how", SEEN)
def test_a_reading_whose_status_does_not_come_is_none(tmp_path, how):
    text, frames = SEEN[how]
    dev = device(tmp_path, START + text + "\n", [V + ", invalid: {signal: Good, good: 0}"], "{v: voltage_v}")
    sample = read(dev, *((801, frame) for frame in frames))
    assert sample.status[ROLE["voltage_v"]] == ABSENT
    sample.status[ROLE["voltage_v"]] = STALE
    assert "READING came without Good, which says" in dev.explain(sample, ROLE["voltage_v"])


def test_a_status_or_sentinel_of_a_float(tmp_path):
    """A status of NaN ended the loop; a sentinel of 16 bits ended `check`."""
    floats = GOOD.rstrip("\n") + "\n" + STATUS.replace("56|8", "32|16") + "\nSIG_VALTYPE_ 801 Good : 1;\n"
    with pytest.raises(InputError, match="signal: Good is a float"):
        device(tmp_path, START + floats, [V + ", invalid: {signal: Good, good: 0}"], "{v: voltage_v}")
    channel = V.replace("Volts", "Good") + ", sentinels: ['0x7B00']"
    dev = device(tmp_path, START + floats, [channel], "{v: voltage_v}")
    for raw, status in ((0x7B, ERROR), (0x3C, OK)):
        assert read(dev, (801, bytes([0, 0, 0, 0, 0, raw]))).status[ROLE["voltage_v"]] == status


COMMAND = """
bus: can-dbc
dbc: a.dbc
drive:
  {unit: A, scale: 1, limits: [-2, 2], watchdog_s: none, state: assumed, disable: [{message: STOP}],
   command: {message: COMMAND, values: {%s: command}}}
channels: {v: {message: READING, signal: Volts, unit: V, rate_hz: 20, stale_after_s: 1}}
"""
SENT = {
    "overlapping": (
        ' SG_ Amps : 0|16@1- (0.001,0) [0|0] "A" H\n SG_ B : 8|8@1- (1,0) [0|0] "" H\n',
        "overlap",
    ),
    "a page without signals": (
        ' SG_ Amps : 0|16@1- (0.001,0) [0|0] "A" H\n SG_ P M : 16|8@1+ (1,0) [0|0] "" H\n SG_ B m2 : 24|8@1- (1,0) [0|0] "" H\n',
        'multiplexer "P" but got 0',
    ),
    "pages that select themselves": (
        ' SG_ P M : 0|8@1+ (1,0) [0|0] "" H\n SG_ Q m1M : 8|8@1+ (1,0) [0|0] "" H\n SG_ Amps m2 : 16|16@1- (0.001,0) [0|0] "A" H\n\n'
        "SG_MUL_VAL_ 802 Q Q 1-1;\nSG_MUL_VAL_ 802 Amps Q 2-2;\n",
        "Q selects its own page",
    ),
}


@pytest.mark.parametrize("how", SENT)
def test_a_command_that_cannot_be_encoded_is_refused(tmp_path, how):
    """It ended the loop while it drove, or kept the messages that switch the amplifier off from being sent."""
    signals, words = SENT[how]
    stop = 'BO_ 803 STOP: 1 H\n SG_ Off : 0|8@1+ (1,0) [0|0] "" D\n\n'
    tmp_path.joinpath("a.dbc").write_text(
        START + GOOD.replace("°", "") + stop + "BO_ 802 COMMAND: 8 H\n" + signals
    )
    with pytest.raises(InputError, match=words) as e:
        make(tmp_path, HEAD + COMMAND % "Amps", "virtual:x", "{state: amplifier_state, v: voltage_v}")
    assert re.match(r".*device\.yaml:\d+:\d+: (command|message): ", str(e.value))


@pytest.mark.parametrize("factor", ["(1,0)", "(2,1)"])
def test_the_virtual_rig_sends_every_page_that_has_a_reading(tmp_path, factor):
    """It ended with a traceback where no page had the number 0, and sent no page but that one."""
    pages = NESTED.replace(" Sub m1M : 8|8@1+ (1,0)", f" Sub m1M : 8|8@1+ {factor}").rstrip("\n")
    pages += '\n SG_ T m2 : 16|8@1+ (1,-40) [0|0] "degC" HOST\n\n' + PAGES + "SG_MUL_VAL_ 801 T Sub 2-2;\n"
    dev = device(tmp_path, START + pages, [V, T])
    sender = object.__new__(DbcSender)
    sender.binding, sender._spec = dev.binding, dev.binding.profile.bus_spec
    sender.reading = lambda bound: {"voltage_v": 12.34, "air_c": 21.0}[bound.role]
    sample = read(dev, *sender.frames("READING"))
    assert sample.value[ROLE["voltage_v"]] == pytest.approx(12.34) and sample.value[ROLE["air_c"]] == 21
