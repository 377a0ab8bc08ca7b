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
        ([("voltage: voltage_v, ", "")], ""),  # R I^2
        ([("voltage: voltage_v, ", ""), ("resistance_ohm: 5.0", "resistance_ohm: 0")], "without voltage_v"),
        ([(", current: current_a", "")], "without current_a:"),
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
