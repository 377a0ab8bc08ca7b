"""A rig of any points: its own names reach every view, recording, model and replay."""

import json
import urllib.request

import numpy as np
import pytest
import yaml

from tests.people.running import Running
from tests.rigs.chain import plants, rig_text
from thermoctl.cli import main
from thermoctl.configuration.settings import effective, load_settings
from thermoctl.daemon.answers import readings, snapshot
from thermoctl.daemon.answers.display import value_lines
from thermoctl.daemon.offline.replay import replay
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.daemon.recorder import law_metadata
from thermoctl.daemon.tick.shared import Shared
from thermoctl.daemon.views import metrics
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.reader import read_rows
from thermoctl.recording.writer import FULL, RecordingWriter, recording_files
from thermoctl.rig.channels import DEFAULT, MAX_POINTS, of_text
from thermoctl.rig.signals import AT, of_channels
from thermoctl_hal.virtual.rig import VirtualRig

SPINDLE = ("motor", "spindle_front_bearing", "rear_bearing", "frame")


def make(folder, names=SPINDLE, labels=None):
    """Return the path of the rig file of a chain of these points, with a model computed from its plant."""
    plants(folder, names)
    path = folder / "rig.yaml"
    path.write_text(rig_text(names, labels=labels))
    model = folder / "model.yaml"
    out = ["--rig", "chain", "--points", str(path), "--out", str(model)]
    assert main(["plant", "linearise", str(folder / "thermal.yaml"), *out]) == 0
    path.write_text(rig_text(names, "model.yaml", labels))
    return path


@pytest.fixture
def spindle(tmp_path):
    return load_settings(make(tmp_path, labels={"spindle_front_bearing": "front bearing"}))


def test_the_points_are_those_of_the_file(spindle):
    assert spindle.channels.point_names == SPINDLE and spindle.channels.coil == "motor_c"
    assert spindle.channels.labels["spindle_front_bearing"] == "front bearing"
    assert set(spindle.protection.high) == {"position_um", *spindle.channels.temperatures}
    assert of_text(spindle.channels.text()) == spindle.channels


@pytest.mark.parametrize("count", [1, 4, MAX_POINTS])
def test_compensation_by_any_number_of_points(tmp_path, count):
    """The heated chain lengthens the output; the law, which knows the coil's sensor alone, takes it back."""
    names = (
        SPINDLE[:count]
        if count <= len(SPINDLE)
        else tuple(["motor", *(f"body_{k}" for k in range(1, count))])
    )
    errors = {}
    for on in ("true", "false"):
        (tmp_path / on).mkdir()
        path = make(tmp_path / on, names)
        path.write_text(path.read_text().replace("enable: true", f"enable: {on}"))
        simulation = Simulation(load_settings(path))
        simulation.arm()
        simulation.command("setpoint", 240.0)
        row = simulation.tick(60_000 if count < MAX_POINTS else 2_000)
        assert row[AT["state"]] == 3.0
        errors[on] = abs(row[AT["output_reference_um"]] - row[AT["setpoint_um"]])
        simulation.close()
    if count < MAX_POINTS:
        assert errors["false"] > 0.3 and errors["true"] < 0.2 * errors["false"], errors


def test_every_view_names_the_points(spindle):
    running = Running(spindle)
    try:
        running.tick(2000)
        status = snapshot.status(running.shared)
        assert tuple(status["temperatures_c"]) == tuple(status["estimates_c"]) == SPINDLE
        assert status["coil"] == "motor_c" and status["readings"]["spindle_front_bearing_c"]["state"] == "OK"
        assert any(line.startswith("front bearing ") for line in value_lines(status))
        page = metrics.metrics(running.shared)
        assert 'point="spindle_front_bearing",kind="estimated"' in page and "bobbin" not in page
        attached = Shared.attach(running.shared._path.name)
        assert attached.channels == spindle.channels
        running.backend.broken.add("motor_c")
    finally:
        running.close()


def test_a_recording_holds_the_points(spindle, tmp_path):
    """Recorded, read back, replayed bit for bit; its configuration reads back with the same points."""
    rows = []
    simulation = Simulation(spindle, publish=lambda row: rows.append(row.copy()))
    simulation.arm()
    simulation.tick(500)
    law = law_metadata(simulation.law.model, simulation.law.parameters, 1e-3, 0, 0, None)
    meta = {"rig": "chain", "law": law, "points": spindle.channels.text()}
    writer = RecordingWriter(spindle.recording, meta, "chain", signals=spindle.row.signals)
    writer.write(np.array(rows))
    writer.close()
    simulation.close()
    (path,) = recording_files(tmp_path / "recordings", FULL)
    back, law = read_rows(path)
    assert np.array_equal(back, np.array(rows), equal_nan=True)
    result = replay(back, law)
    assert result.ticks == len(rows) and not result.differences
    (tmp_path / "again.yaml").write_text(effective(spindle))
    assert load_settings(tmp_path / "again.yaml").channels == spindle.channels


def test_the_virtual_rig_plays_devices_at_the_files_own_points(tmp_path):
    path = make(tmp_path)
    text = "vendor: test\nmodel: test\nbus: modbus\nmodbus: {timeout_s: 0.1}\nchannels:\n"
    text += "  t: {register: 0, type: int16, scale: 0.1, unit: degC, range: [-50, 300], rate_hz: 10, stale_after_s: 1}\n"
    (tmp_path / "meter.yaml").write_text(f"format: thermoctl-device/1\n{text}")
    rig = yaml.safe_load(path.read_text())
    rig["hal"]["devices"] = [
        {
            "name": "meter",
            "profile": "meter.yaml",
            "port": f"rtu:{tmp_path}/line",
            "roles": {"t": "rear_bearing_c"},
        }
    ]
    path.write_text(yaml.safe_dump(rig))
    virtual = VirtualRig(load_settings(path))
    (bound,) = virtual.devices["meter"].binding.bounds
    assert virtual.devices["meter"].reading(bound) == pytest.approx(200, abs=30)  # of 0.1 degC, at rest


def test_a_full_row_of_64_points_is_replayed(tmp_path):
    """Words of bits of all channels: a lost reading of the last point comes back from the second words on."""
    names = ("motor", *(f"body_{k}" for k in range(1, MAX_POINTS)))
    settings = load_settings(make(tmp_path, names))
    rows = []
    simulation = Simulation(settings, publish=lambda row: rows.append(row.copy()))
    simulation.tick(305)
    simulation.backend.sample.status[-1] = 1
    simulation.tick()
    row = settings.row
    states = row.states(rows[-1])[0]
    assert states[-1] == 1 and (states[8:-1] == 0).all()
    last = f"body_{MAX_POINTS - 1}_c"
    assert np.isnan(readings.hide_invalid(np.array(rows), last, row)[-1])
    law = law_metadata(simulation.law.model, simulation.law.parameters, 1e-3, 0, 0, None)
    assert not replay(np.array(rows), law).differences
    simulation.close()


def test_a_model_of_other_points_is_refused(spindle, tmp_path):
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("rear_bearing", "back_bearing"))
    from thermoctl.daemon.tick.assemble import compensator

    with pytest.raises(
        InputError, match=r"model is of motor, .*rear_bearing.*the rig has .*back_bearing.*calibrate"
    ):
        compensator(load_settings(tmp_path / "rig.yaml"))


@pytest.mark.parametrize(
    ("points", "why"),
    [
        ("{}", "one point with role: coil"),
        ("{motor: {}, frame: {}}", "one point with role: coil.*found none"),
        ("{motor: {role: coil}, frame: {role: coil}}", "found motor, frame"),
        ("{Motor: {role: coil}}", "small letters"),
        ("{motor: {role: coil}, air: {}}", "two signals would have the name air_c"),
        ("{motor: {role: coil}, innovation: {}}", "two signals would have the name innovation_c"),
        ("{motor: {role: coil}, motor_est: {}}", "two signals would have the name motor_est_c"),
        ("{motor: {role: heater}}", "coil"),
        ("{motor: {role: coil, place: x}}", "place"),
        ("gone.yaml", "gone.yaml"),
    ],
)
def test_a_wrong_declaration_is_one_message(tmp_path, points, why):
    path = tmp_path / "rig.yaml"
    lines = rig_text(SPINDLE).split("\n")
    begin = lines.index("points:")
    path.write_text("\n".join([*lines[:begin], f"points: {points}", *lines[begin + 5 :]]))
    with pytest.raises(InputError, match=why):
        load_settings(path)


def test_too_many_points(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(rig_text(("motor", *(f"p{k}" for k in range(MAX_POINTS)))))
    with pytest.raises(InputError, match="65; at most 64"):
        load_settings(path)


def test_without_a_declaration_the_points_are_the_papers(tmp_path):
    lines = rig_text(("coil",)).split("\n")
    begin = lines.index("points:")
    (tmp_path / "rig.yaml").write_text("\n".join([*lines[:begin], *lines[begin + 2 :]]))
    assert load_settings(tmp_path / "rig.yaml").channels == DEFAULT
    assert of_channels(DEFAULT).names[-1] == f"{DEFAULT.point_names[-1]}_est_c"


def test_the_dashboard_draws_the_points(spindle):
    import threading

    from thermoctl.daemon.views.dashboard import drawing, make_server, url
    from thermoctl.daemon.views.watch import Watch

    server = make_server(spindle, "127.0.0.1:0", Watch(spindle))
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        with urllib.request.urlopen(url(server) + "api/info", timeout=10) as answer:
            info = json.load(answer)
        assert list(info["points"]) == list(SPINDLE) and info["drawing"] == "" and info["coil"] == "motor_c"
    finally:
        server.shutdown()
        server.server_close()
    assert 'data-p="bobbin"' in drawing(load_settings("config/simulated.yaml"))
