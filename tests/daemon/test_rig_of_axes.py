"""A rig file with axes: what each axis gets, and the mistakes that are told with their place."""

from pathlib import Path

import pytest

from tests.rigs.axes import simulated_axes
from thermoctl.settings import load_rig, load_settings
from thermoctl.yamlfile import InputError


def test_an_axis_has_the_settings_of_a_rig_of_its_own(tmp_path):
    path = simulated_axes(tmp_path)
    rig = load_rig(path)
    x, y = rig.axes
    assert [p.axis for p in rig.parts] == ["x", "y"] and rig.of_axis("y") == y == load_settings(path, "y")
    assert load_settings(f"{path}#x") == x and x.parts == (x,)
    assert (x.rig.name, y.rig.name) == ("stage-x", "stage-y") and (x.hal.seed, y.hal.seed) == (1, 2)
    for part in rig.axes:
        assert Path(part.socket.path).name == f"rig-{part.axis}.sock"
        assert part.rig_socket == rig.socket.path and Path(part.recording.directory).name == part.axis
        assert part.protection.low["coil_c"] == 0.0 and part.protection.required[-1] == "coil_c"
    assert x.recording.budget_gb + y.recording.budget_gb == rig.recording.budget_gb
    assert len(rig.channels.names) == len(x.channels.names) + len(y.channels.names)
    assert rig.channels.index["air_c"] == rig.channels.index["x.air_c"]
    assert rig.channels.copies("air_c") == [rig.channels.index["y.air_c"]]
    assert rig.channels.copies("x.coil_c") == []


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("rig: {name: stage}\n", "", "'rig.name' is missing"),
        ("axes:\n", "points: {frame: {role: coil}}\naxes:\n", "frame is a coil: every axis has its own"),
        ("axes:\n", "points: {bench: {}}\naxes:\n", "'bench' is a point of all axes already"),
        ("points: {coil: {role: coil}, bench: {}}", "points: {bench: {}}", "one point with role: coil"),
        ("  x:\n", "  X-1:\n", "small letters and digits"),
        ("hal: {seed: 1}", "loop: {priority: 1}", "'loop'"),
        ("hal: {seed: 1}", "control: {kp: -1}", "control.kp"),
    ],
)
def test_mistakes_of_axes_are_told(tmp_path, old, new, message):
    path = simulated_axes(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as e:
        load_rig(path)
    assert str(e.value).startswith(f"{path}:")


def test_an_axis_must_be_named_and_known(tmp_path):
    path = simulated_axes(tmp_path)
    with pytest.raises(InputError, match="axes x, y; name one by --axis"):
        load_settings(path)
    with pytest.raises(InputError, match="no axis 'z'.*one of x, y"):
        load_settings(path, "z")


@pytest.mark.parametrize(
    "role, message",
    [
        ("position_um", "write x.position_um or y.position_um"),
        ("z.position_um", "'z.position_um' is no role"),
        ("x.bench", "did you mean 'x.bench_c'"),
    ],
)
def test_a_role_needs_its_axis(tmp_path, role, message):
    path = simulated_axes(tmp_path)
    devices = f"  devices: [{{name: encoder, profile: p.yaml, port: /dev/x, roles: {{position: {role}}}}}]\n"
    path.write_text(path.read_text().replace("  backend: simulated\n", f"  backend: simulated\n{devices}"))
    with pytest.raises(InputError, match=message):
        load_rig(path)
