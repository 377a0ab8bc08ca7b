"""What `thermoctl check` says of a rig whose power cannot be known, and of an amplifier's options that mean nothing."""

import re
import shutil

import pytest

from tests.hal.conftest import CONFIG
from thermoctl.cli import main


@pytest.fixture
def config(tmp_path):
    for part in ("devices", "models", "plants", "effects"):
        shutil.copytree(CONFIG / part, tmp_path / part)
    shutil.copy(CONFIG / "wire.yaml", tmp_path / "wire.yaml")
    return tmp_path / "wire.yaml"


def change(config, *pairs):
    text = config.read_text()
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    config.write_text(text)


@pytest.mark.parametrize(
    "pairs,lacks",
    [
        ([], ""),
        ([("voltage: voltage_v, ", ""), ("voltage_v, current_a, air_c", "current_a, air_c")], ""),  # R I^2
        (
            [
                ("voltage: voltage_v, ", ""),
                ("voltage_v, current_a, air_c", "current_a, air_c"),
                ("resistance_ohm: 5.0", "resistance_ohm: 0"),
            ],
            "without voltage_v",
        ),
        (
            [(", current: current_a", ""), ("voltage_v, current_a, air_c", "voltage_v, air_c")],
            "without current_a:",
        ),
    ],
)
def test_check_says_where_the_power_is_unknown(config, capsys, pairs, lacks):
    change(config, ("  coil_limit_c: 80", "  power_limit_w: 12\n  coil_limit_c: 80"), *pairs)
    assert main(["check", str(config)]) == 0
    said = capsys.readouterr().out
    assert "good" in said and ("warning" in said) == bool(lacks)
    if lacks:
        line = config.read_text().splitlines().index("  power_limit_w: 12") + 1
        assert lacks in said and re.search(rf"{config}:{line}:\d+: the coil.s power is unknown", said)
        assert "can never trip" in said and "driven with 0 W" in said


def test_an_empty_protection_and_a_list_for_a_role_end_in_one_line(config, capsys):
    """Both ended in a traceback."""
    text = config.read_text().replace(", current: current_a", "")
    config.write_text(re.sub(r"(?m)^(protection:).*\n(?: .*\n)+", r"\1\n", text))
    assert main(["check", str(config)]) == 1
    assert "the coil's power is unknown" in capsys.readouterr().out
    change(config, ("voltage: voltage_v", "voltage: [voltage_v]"))
    assert main(["check", str(config)]) == 2
    assert "roles: the role of 'voltage' was expected, found a list" in capsys.readouterr().err


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("frozen_s: {", "frozen_s: {amplifier_state: 1, ", "protection.frozen_s.amplifier_state"),
        ("state: amplifier_state, ", "", "a drive needs its status word"),
    ],
)
def test_check_refuses_what_would_hide_a_stopped_drive(config, capsys, old, new, message):
    change(config, (old, new))
    assert main(["check", str(config)]) == 2
    error = capsys.readouterr().err
    assert message in error and re.search(r"wire.yaml:\d+:\d+", error) and error.count("\n") == 1


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([("        thermocouple_1: coil_c\n", ""), ("coil_c, ", "")], "no coil_c: .* from its resistance"),
        ([("        thermocouple_1: coil_c\n", ""), ("coil_c, ", ""), ("resistance_ohm: 5.0", "resistance_ohm: 0")],
         "no coil_c: the model alone estimates"),
        ([("        pt100: air_c\n", ""), ("air_c, ", "")], "no air_c: the air counts as constant"),
        ([], "no output_reference_um .*calibrate. refuses"),
        ([], r"no calibration stands behind the model .computed from actuator_thermal.yaml.*expected, not measured"),
    ],
)  # fmt: skip
def test_check_says_what_a_rig_without_a_sensor_does(config, capsys, pairs, said):
    change(config, *pairs)
    assert main(["check", str(config)]) == 0
    assert re.search(f"note: {said}", capsys.readouterr().out)


def test_check_refuses_a_model_without_any_temperature(config, capsys):
    change(
        config,
        ("        thermocouple_1: coil_c\n", ""),
        ("        pt100: air_c\n", ""),
        ("air_c, coil_c, ", ""),
        ("resistance_ohm: 5.0", "resistance_ohm: 0"),
    )
    assert main(["check", str(config)]) == 2
    error = capsys.readouterr().err
    assert "compensation.model needs air_c or coil_c" in error and error.count("\n") == 1


def test_check_compares_the_drives_unit_with_the_mode(config, capsys):
    """A target in um for a drive that takes amperes, or the other way round, must never reach it."""
    change(config, ("control:                         #", "control:\n  mode: position                 #"))
    assert main(["check", str(config)]) == 2
    error = capsys.readouterr().err
    assert "takes its command in A, and control.mode is position" in error and error.count("\n") == 1


def test_check_warns_of_a_loop_without_real_time_priority(config, capsys):
    change(config, ("priority: 80", "priority: 0"))
    assert main(["check", str(config)]) == 0
    said = capsys.readouterr().out
    assert "warning: " in said and "loop.priority is 0" in said and "set loop.priority: 80" in said


def test_every_shipped_configuration_asks_for_a_real_time_priority():
    for path in (*CONFIG.glob("*.yaml"), *(CONFIG / "examples").glob("*.yaml")):
        assert not re.search(r"^\s*priority: *0\b", path.read_text(), re.MULTILINE), path


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([("{voltage: voltage_v, ", "{")], r"\d+:\d+: protection.required names voltage_v, but no device of hal.devices has "
         r"this role.*required: \[position_um, current_a, air_c, coil_c, amplifier_state\]"),
        ([("required: [position_um, voltage_v, current_a, air_c, coil_c, amplifier_state]", "late_s: 0.1"),
          ("{voltage: voltage_v, current", "{current")], r"protection.required names voltage_v \(the default\)"),
        ([("        pt100: air_c\n", ""), ("roles: {state: amplifier_state, fault: amplifier_fault, supply: supply_v}",
          "roles: {state: amplifier_state}"), ("required: [", "required: [supply_v, ")],
         "names supply_v, air_c, but no device of hal.devices has these roles"),
        ([("port: ../run/wire/encoder", "port: /dev/serial/by-id/usb-FTDI_XXXXXXXX-if00-port0")],
         "port: 'XXXXXXXX' stands for your own adapter"),
        ([("stale_s: {position_um: 0.1, voltage_v: 1", "stale_s: {position_um: 0.1, voltage_v: 0.001")],
         r"protection.stale_s.voltage_v: 0.001 s is shorter than the time between two readings, [\d.]+ s \(rate_hz: "),
        ([("frozen_s: {position_um: 0.5", "frozen_s: {position_um: 1 us")], "protection.frozen_s.position_um: 1e-06 s"),
        ([("high: {position_um: 400", "high: {position_um: 400, supply_v: 500"), ("low:  {", "low:  {supply_v: 400, "),
          ("required: [", "required: [supply_v, ")], "protection.low..high of supply_v .*no reading is valid"),
        ([("  coil_limit_c: 80", "  coil_limit_c: 80\n  late_s: 1 ms")], "protection.late_s: 0.001 s is not longer"),
    ],
)  # fmt: skip
def test_check_refuses_a_rig_that_could_never_be_armed(config, capsys, pairs, said):
    change(config, *pairs)
    assert main(["check", str(config)]) == 1
    out = capsys.readouterr().out
    assert re.search(rf"^error: {config}:.*{said}", out, re.MULTILINE), out
    assert "NOT READY, the rig could not be armed" in out


def test_a_limit_of_a_channel_that_is_not_required_only_warns(config, capsys):
    change(config, ("stale_s: {", "stale_s: {supply_v: 0.0001, "))
    assert main(["check", str(config)]) == 0
    assert re.search(r"^warning: .*protection.stale_s.supply_v", capsys.readouterr().out, re.MULTILINE)


def test_each_axis_is_asked_for_its_own_channels(capsys, tmp_path):
    shutil.copytree(CONFIG, tmp_path / "config")
    path = tmp_path / "config/examples/stage.yaml"
    text = path.read_text()
    assert text.count("x.current_a") == 1
    path.write_text(re.sub(r"[\w]+: x.current_a,? ?", "", text))
    assert main(["check", str(path)]) == 1
    out = capsys.readouterr().out
    x, y = out.split("axis y:")
    assert "names current_a" in x and "could not be armed" in x and "good. " in y


def test_a_simulated_rig_is_asked_too(capsys, tmp_path):
    shutil.copytree(CONFIG, tmp_path / "config")
    path = tmp_path / "config/simulated.yaml"
    change(path, ("required: [", "required: [supply_v, "))
    assert main(["check", str(path)]) == 1
    assert "names supply_v, but no output of the plant has this role" in capsys.readouterr().out


def test_the_template_of_a_rig_is_not_good(capsys):
    assert main(["check", str(CONFIG / "rig.yaml")]) == 1
    out = capsys.readouterr().out
    assert re.search(r"^error: .*port: 'XXXXXXXX'", out, re.MULTILINE) and "good" not in out


@pytest.mark.parametrize("size, fits", [(107, True), (108, False)])
def test_a_socket_path_that_the_system_does_not_allow(config, capsys, size, fits):
    folder = str(config.parent)
    path = folder + "/" + "s" * (size - len(folder) - 6) + ".sock"
    assert len(path) == size
    change(config, ("path: ../run/wire.sock", f"path: {path}"))
    assert main(["check", "--config", str(config)]) == (0 if fits else 1)
    said = capsys.readouterr().out
    assert fits or f"error: {path}: 108 bytes; a socket's path of at most 107 was expected" in said
    for command in () if fits else ("run", "status"):
        assert main([command, "--config", str(config)]) != 0
        assert "give a shorter socket.path" in capsys.readouterr().err


def test_a_socket_path_that_is_too_long_for_an_axis(tmp_path, capsys):
    """The axes' sockets have the axis in their names: stage.sock fits, stage-x.sock does not."""
    shutil.copytree(CONFIG, tmp_path / "config")
    config = tmp_path / "config/examples/stage.yaml"
    path = f"{tmp_path}/" + "s" * (106 - len(str(tmp_path)) - 6) + ".sock"
    change(config, ("path: ../../run/stage.sock", f"path: {path}"))
    assert main(["check", "--config", str(config)]) == 1
    assert "108 bytes; a socket's path of at most 107 was expected" in capsys.readouterr().out
    assert main(["run", "--config", str(config)]) != 0
    assert "give a shorter socket.path" in capsys.readouterr().err
