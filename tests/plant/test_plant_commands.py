"""linearise, show and the plant commands, from outside."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from tests.plant.test_plant_refit import BLOCK, TRUTH, recorded
from thermoctl.cli import main
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.linearise import discrete, linearise, thermal
from thermoctl.identify.modelfile import load_model
from thermoctl.plant import extended, load
from thermoctl.plant.files import loads
from thermoctl.plant.show import layout
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.table import Table

THERMAL = "config/plants/actuator_thermal.yaml"


@pytest.fixture(autouse=True)
def in_repository(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)


@pytest.fixture(scope="module")
def plant(request):
    return load(request.config.rootpath / THERMAL)


def remembering(plant):
    """The plant as a diagnosis writes it when a bracket's growth was left out: counted from a node that remembers the start."""

    def add(d):
        d["nodes"]["memory"] = {"unit": "degC", "storage": 1.0, "initial": "air", "initial_sigma": 0.2}
        d["flows"]["kept"] = {"into": "memory", "rate": 0.0}
        d["outputs"]["position_error_um"]["value"] += " + (bracket_2 - memory) * a_bracket_1"

    return extended(plant, add)


@pytest.mark.parametrize("also", [lambda plant: plant, remembering], ids=["shipped", "remembering"])
def test_model_predicts_what_the_plant_does(plant, also):
    """An hour of power steps and drifting air: temperatures and growth by the model, against the plant's own simulation."""
    plant = also(plant)
    steps = {
        n: replace(plant.inputs[n], linear=False) for n in ("voltage", "current")
    }  # here the power jumps
    plant = replace(plant, inputs={**plant.inputs, **steps})
    model, n, step = linearise(plant, period_s=1.0, expansion_period_s=1.0), 3600, 1.0
    t = np.arange(n) * step
    current, air = 0.8 * ((t // 300) % 2), 22 + t / 1800
    run = compile_plant(plant, ()).simulate(
        Table("x", "x", t, {"voltage_v": 5 * current, "current_a": current, "air_c": air})
    )
    x, rises = np.zeros(12), []
    for k in range(n):
        rises.append(model.C @ x)
        x = x + model.A_minus_I @ x + model.B @ [5 * current[k] ** 2, 1 / 1800]
    rises = np.array(rises)
    assert np.abs(rises + air[:, None] - run.y[:, :12]).max() < 1e-4
    growth = rises @ model.b2 + model.b_air * (air - air[0])
    assert np.abs(growth - run.y[:, 12]).max() < 1e-3


def test_delta_form_keeps_the_slow_poles_at_1_ms(plant):
    heat = thermal(plant)
    step, _, noise = discrete(heat, 1e-3)
    poles = np.sort(np.log1p(np.linalg.eigvals(step).real) / 1e-3)
    assert poles == pytest.approx(np.sort(np.linalg.eigvals(heat.A).real), rel=1e-8)
    assert np.linalg.eigvalsh(noise).min() > 0


def test_steady_gain_estimates_better_than_no_sensor(plant):
    heat, rng = thermal(plant), np.random.default_rng(5)
    step, _, noise = discrete(heat, 1.0)
    model, A = linearise(plant, period_s=1.0, sensor_period_s=1.0), expm(heat.A)
    root = np.linalg.cholesky(noise)
    x, z, errors = rng.normal(0, 0.5, 12), np.zeros(12), []
    blind = x.copy()
    for _ in range(4000):
        x, blind, z = A @ x + root @ rng.normal(size=12), A @ blind, A @ z
        z = z + model.gain[:, 0] * (x[0] + np.sqrt(heat.variance[0]) * rng.normal() - z[0])
        errors.append((x[0] - z[0], x[0]))
    with_sensor, without = np.sqrt(np.mean(np.array(errors[500:]) ** 2, axis=0))
    assert with_sensor < 0.7 * without


def test_a_plant_that_is_not_thermal_is_refused():
    with pytest.raises(InputError, match="no input reads the column"):
        linearise(load("config/plants/actuator.yaml"))


@pytest.mark.parametrize("rig", ["simulated", "wire"])
def test_shipped_models_are_those_of_the_plant_file(plant, rig):
    shipped, made = load_model(f"config/models/{rig}.yaml", rig), linearise(plant)
    assert shipped.A_minus_I == pytest.approx(made.A_minus_I, rel=1e-9, abs=1e-15), "stale: make models"
    assert shipped.gain == pytest.approx(made.gain, rel=1e-6) and shipped.b2 == pytest.approx(made.b2)


def test_linearise_writes_a_model(tmp_path):
    out = tmp_path / "m.yaml"
    arguments = f"plant linearise {THERMAL} --out {out} --kind mkf".split()
    assert main(arguments) == 0
    assert load_model(out, "simulated").kind == "mkf"
    assert main(arguments) == 2  # a calibration is never overwritten unasked


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_show_draws_every_node(tmp_path, suffix):
    out = tmp_path / f"p.{suffix}"
    assert main(["plant", "show", THERMAL, "--out", str(out)]) == 0
    assert out.stat().st_size > 20_000
    if suffix == "svg":
        assert out.read_text().count("outer_stator") >= 1


def test_show_prints_and_refuses_other_endings(capsys, tmp_path):
    assert main(["plant", "show", THERMAL]) == 0
    said = capsys.readouterr().out
    assert loads(said).plain() == load(THERMAL).plain() and "G_coil_bobbin" in said
    assert main(["plant", "show", THERMAL, "--out", str(tmp_path / "p.doc")]) == 2


def test_layout_keeps_the_lengths_of_a_chain():
    x = layout(5, [(k, k + 1, 1.0) for k in range(4)])
    assert np.linalg.norm(np.diff(x, axis=0), axis=1) == pytest.approx(np.ones(4), abs=0.05)


@pytest.fixture
def block(tmp_path):
    (tmp_path / "p.yaml").write_text(BLOCK)
    for seed, name in enumerate("ab"):
        write_table(tmp_path / f"{name}.csv", recorded(TRUTH, 600, name, seed))
    return tmp_path


def test_simulate_writes_plots_and_predicts_ahead(block, capsys):
    both = [str(block / "a.csv"), str(block / "b.csv")]
    files = f"{' '.join(both)} --out {block / 'o.csv'} --plot {block / 'o.png'}"
    assert main(f"simulate --plant {block / 'p.yaml'} {files}".split()) == 0
    free = read_table(block / "o_a.csv").columns
    assert (block / "o_b.png").stat().st_size > 10_000
    words = f"simulate --plant {block / 'p.yaml'} {both[0]} --horizon 10 --out {block / 'h.csv'}"
    assert main(words.split()) == 0
    ahead = read_table(block / "h.csv").columns
    errors = [np.sqrt(np.mean((c["y"] - c["y_simulated"]) ** 2)) for c in (free, ahead)]
    assert errors[1] < 0.3 * errors[0]  # the wrong belief has ten seconds only to go astray
    assert "free run" in capsys.readouterr().out


@pytest.mark.parametrize("noise", ["white", "ar1"])
def test_refit_finds_the_truth_and_judges_on_held_out_data(block, capsys, noise):
    p, a, b, p2 = (block / n for n in ("p.yaml", "a.csv", "b.csv", "p2.yaml"))
    words = f"refit --plant {p} {a} --held-out {b} --out {p2} --noise {noise}"
    assert main(words.split()) == 0
    found = load(block / "p2.yaml").parameters
    assert found["C"].value == pytest.approx(46, rel=0.03) and found["G"].value == pytest.approx(
        0.31, rel=0.03
    )
    held = next(line for line in capsys.readouterr().out.splitlines() if "│ b " in line and "no" in line)
    before, after = (float(q) for q in held.replace("│", " ").split()[-2:])
    assert after < 0.12 < before


def test_check_names_what_is_wrong(block, capsys):
    (block / "bad.yaml").write_text(BLOCK.replace("G * (T - air)", "G * (T - iar)"))
    assert main(["plant", "check", str(block / "p.yaml")]) == 0
    assert main(["plant", "check", str(block / "bad.yaml")]) == 2
    assert "did you mean 'air'" in capsys.readouterr().err


@pytest.mark.parametrize("file", [THERMAL, "config/plants/actuator.yaml"])
def test_arrows_end_at_the_boxes_and_not_under_them(file):
    """Every arrow's head lies on the edge of a box (a hidden head says nothing of the direction), at any resolution."""
    from matplotlib.text import Annotation

    from thermoctl.plant.show import drawing

    figure = drawing(load(file))
    axes = figure.axes[0]
    for dpi in (100, 170):
        figure.set_dpi(dpi)
        figure.canvas.draw()
        boxes = np.array(
            [
                q.get_bbox_patch().get_window_extent().get_points()
                for q in axes.texts
                if not isinstance(q, Annotation) and q.get_zorder() == 3
            ]
        )
        heads = np.array([axes.transData.transform(q.xy) for q in axes.texts if isinstance(q, Annotation)])
        assert len(heads) > 20
        depth = np.minimum(heads[:, None] - boxes[None, :, 0], boxes[None, :, 1] - heads[:, None]).min(
            axis=2
        )  # pixels inside
        assert np.abs(depth).min(axis=1).max() < 3, dpi


@pytest.mark.parametrize("widest", [40.0, 10.0, 3.6])
@pytest.mark.parametrize("file", [THERMAL, "config/plants/actuator.yaml"])
def test_a_network_is_as_wide_as_its_page_and_no_box_covers_another(file, widest):
    from thermoctl.plant.show import drawing

    figure = drawing(load(file), widest=widest, title=False)
    assert figure.get_figwidth() <= widest
    figure.canvas.draw()
    boxes = [
        q.get_bbox_patch().get_window_extent().padded(-1)
        for q in figure.axes[0].texts
        if q.get_bbox_patch() is not None and q.get_text()
    ]
    assert len(boxes) > 20 and not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    page = figure.bbox
    assert all(page.containsx(x) and page.containsy(y) for b in boxes for x, y in b.corners())


def test_a_refit_says_from_which_start_its_error_is_seen(tmp_path, capsys):
    """Logged from the middle of a swing: without the fitted start, no simulation shows the error that the refit states."""
    (tmp_path / "p.yaml").write_text(
        "format: thermoctl-plant/1\ntitle: A swing\nparameters: {k: {value: 4, range: [1, 9], unit: 1/s^2}}\n"
        "nodes:\n  v: {storage: 1, initial: 0, initial_sigma: 5, unit: m/s}\n"
        "  x: {storage: 1, initial: first(seen), initial_sigma: 0.01, unit: m}\n"
        "flows: {spring: {from: v, rate: k * x, unit: m/s^2}, travel: {into: x, rate: v, unit: m/s}}\n"
        "outputs: {seen: {value: x, column: x, unit: m, noise: 0.01}}\n"
    )
    t = np.arange(400) * 0.02
    seen = np.sin(2.2 * t + 0.3) + 0.01 * np.random.default_rng(4).normal(size=400)
    write_table(tmp_path / "a.csv", Table("a", "a", t, {"x": seen}))
    assert main(f"refit --plant {tmp_path}/p.yaml {tmp_path}/a.csv --out {tmp_path}/q.yaml".split()) == 0
    said = capsys.readouterr().out.splitlines()
    stated = float(next(line for line in said if "│ a " in line).replace("│", " ").split()[-1])
    start = said[-1].split()[-1]
    assert stated < 0.011
    for given, error in (("", 0.5), (f"--initial {start}", stated)):
        command = f"simulate --plant {tmp_path}/q.yaml {tmp_path}/a.csv --out {tmp_path}/s.csv {given}"
        assert main(command.split()) == 0
        c = read_table(tmp_path / "s.csv").columns
        rms = np.sqrt(np.mean((c["x"] - c["x_simulated"]) ** 2))
        assert rms > error if not given else rms == pytest.approx(error, rel=0.01)
