"""A bad configuration gives one good line: file, line, column, what was expected."""

import re
from pathlib import Path

import pytest

from thermoctl import cli
from thermoctl.configuration import settings
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.tuning import write_values

SIMULATED = Path(__file__).parent.parent / "config" / "simulated.yaml"
TEXT = SIMULATED.read_text()


def loaded(tmp_path, old="", new=""):
    assert old in TEXT
    path = tmp_path / "rig.yaml"
    path.write_text(TEXT.replace(old, new, 1))
    return settings.load_settings(path)


@pytest.mark.parametrize(
    "old, new, says",
    [
        ("  kp: 0.01", "  kpp: 0.01", r"kpp.*did you mean 'kp'"),
        ("control:", "controll:", r"controll.*did you mean 'control'"),
        ("  kp: 0.01", "  kp: fast", r"control\.kp.*number.*fast|fast.*number"),
        ("  kp: 0.01", "  kp: -1", r"control\.kp"),
        ("  kp: 0.01", "  kp: .nan", r"control\.kp"),
        ("  kp: 0.01", "  kp: 0.01\n  kp: 0.02", r"'kp' stands twice"),
        ("  kp: 0.01", "  kp: [0.01]", r"control\.kp"),
        ("  kp: 0.01", "  kp:", r"control\.kp"),
        ("period_s: 1 ms", "period_s: 1 mm", r"period_s.*\bs\b"),
        ("period_s: 1 ms", "period_s: 1 h", r"period_s"),
        ("period_s: 1 ms", "period_s: 1 xyz", r"period_s.*xyz"),
        ("priority: 80", "priority: 80.5", r"priority.*whole"),
        ("priority: 80", "priority: 1000", r"priority"),
        ("enable: true", "enable: 1", r"enable.*true or false"),
        ("backend: simulated", "backend: simulatd", r"backend.*did you mean 'simulated'"),
        ("backend: simulated", "backend: devices", r"hal\.devices is missing"),
        ("rate: {position_um: 50000", "rate: {positon_um: 50000", r"positon_um.*did you mean 'position_um'"),
        ("low:  {position_um: -400", "low:  {position_um: 500", r"high\.position_um must be above"),
        ("required: [position_um", "required: [positon_um", r"positon_um.*did you mean 'position_um'"),
        ("rig: {name: simulated}", "rig: simulated", r"rig"),
        ("rig: {name: simulated}", "rig: {name: 3}", r"rig\.name"),
        ("rig: {name: simulated}", "rig: {name: 'a", r"not valid YAML"),
        ("rig: {name: simulated}", "\trig: {name: simulated}", r"tab"),
    ],
)
def test_bad_configuration(tmp_path, old, new, says):
    with pytest.raises(InputError) as e:
        loaded(tmp_path, old, new)
    message = str(e.value)
    assert re.match(rf"{re.escape(str(tmp_path))}/rig\.yaml:\d+:\d+: ", message), message
    assert re.search(says, message) and "\n" not in message, message
    text, line = TEXT.replace(old, new, 1), int(message.split(":")[1])
    first = text[: text.index(new)].count("\n") + 1
    if "end of stream" not in message:  # an open quote is noticed at the file's end
        assert first <= line <= first + 12, message  # at the place, or at the first value below it


RIGS = [f for f in SIMULATED.parent.glob("**/*.yaml") if re.search("(?m)^socket:", f.read_text())]


@pytest.mark.parametrize("mistake", ["contrl: {}\n", "loop: {period_s: 1 ms\n", "loop:\n\tperiod_s: 1 ms\n"])
@pytest.mark.parametrize("file", RIGS, ids=lambda f: f.stem)
def test_a_rig_can_be_stopped_while_its_file_has_a_mistake(tmp_path, capsys, file, mistake):
    """An armed rig could not be disarmed while somebody edited its file."""
    rig, broken = settings.load_rig(file), tmp_path / file.name
    text = re.sub("(?m)^( *path:|socket: {path:) *[^ }#\n]+", r"\1 x/y.sock", file.read_text())
    broken.write_text(mistake + text)
    found = settings.for_stopping(str(broken))
    folder = tmp_path / "x"
    ends = [Path(p.socket.path).stem.removeprefix(Path(p.rig_socket).stem) for p in rig.axes]
    assert [p.socket.path for p in found.parts] == [str(folder / f"y{end}.sock") for end in ends or [""]]
    assert [p.axis for p in found.parts] == [p.axis for p in rig.parts]
    assert cli.main(["stop", "--config", str(broken)]) == 0
    said = capsys.readouterr()
    assert "not running" in said.out and "stop needs the rig's socket only" in said.err
    assert cli.main(["arm", "--config", str(broken)]) == 2


def test_what_is_in_force_is_written_and_taken_back(tmp_path):
    first = settings.load_settings(SIMULATED)
    path = tmp_path / "again.yaml"
    path.write_text(settings.effective(first))
    assert [key for key, _ in settings.changed(first, settings.load_settings(path))] in ([], ["hal.plant"])


def test_a_reload_knows_what_needs_a_restart(tmp_path):
    before = loaded(tmp_path)
    after = loaded(tmp_path, "kp: 0.01", "kp: 0.02")
    assert settings.changed(before, after) == [("control.kp", False)]
    after = loaded(tmp_path, "priority: 80", "priority: 70")
    assert settings.changed(before, after) == [("loop.priority", True)]


def test_quantities_in_other_units_are_converted(tmp_path):
    s = loaded(tmp_path)
    assert s.loop.period_s == pytest.approx(1e-3, rel=1e-15)
    assert s.control.setpoint_rate_um_s == pytest.approx(1000 / 60, rel=1e-12)


def test_a_written_value_may_bring_its_own_comment(tmp_path):
    """Before, the comment of the old model stood beside the new one (review_user_3 C18)."""
    path = tmp_path / "rig.yaml"
    path.write_text(
        "compensation:\n  model: old.yaml   # thermoctl plant linearise\n  bound_um: 40  # clipped\n"
    )
    write_values(path, "compensation", {"model": "models  # written by calibrate", "bound_um": "30"})
    assert path.read_text() == (
        "compensation:\n  model: models  # written by calibrate\n  bound_um: 30  # clipped\n"
    )


@pytest.mark.parametrize(
    "text", ["5 ms", "5\u00a0ms", "5ms", "5e-3 s", '"5 ms"', "0.005", '"0.005"', "5000 us", "1/200 s"]
)
def test_a_quantity_however_it_is_spaced(tmp_path, text):
    """A no-break space from a manual was refused as 'a number in s was expected, not 5 ms'."""
    assert loaded(tmp_path, "period_s: 1 ms", f"period_s: {text}").loop.period_s == pytest.approx(
        0.005, rel=1e-12
    )


@pytest.mark.parametrize(
    "text", ["5 kg", "5 5 ms", "ms", "ms 5", "5,0 ms", "5 m s", "1e ms", "0x5 ms", "nan ms", "1/0 s"]
)
def test_no_quantity_is_guessed(tmp_path, text):
    with pytest.raises(InputError, match="loop.period_s"):
        loaded(tmp_path, "period_s: 1 ms", f"period_s: {text}")
