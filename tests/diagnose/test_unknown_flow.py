"""A flow that every reading hides in its own slow noise, and that all of them show together.

The rig is a bar of blocks that conduct well, so that each reading follows all flows; scipy simulates it."""

import json

import numpy as np
from scipy.signal import lfilter, lsim

from thermoctl.cli import main

BLOCKS = 8
STORAGE, LINK, LOSS = 20.0, 3.0, 0.05  # J/K, W/K between neighbours, W/K to the air


def bar():
    """A plant that knows the bar: only its storages and losses are to be refitted."""
    n = range(BLOCKS)
    lines = ["format: thermoctl-plant/1", "title: Bar of blocks", "inputs: {heat: {unit: W}}", "parameters:"]
    lines += [
        "  C: {value: 18, unit: J/K, range: [9, 40]}",
        "  H: {value: 0.06, unit: W/K, range: [0.02, 0.2]}",
    ]
    lines += ["nodes:"]
    lines += [f"  b{k}: {{unit: degC, storage: C, initial: 20, initial_sigma: 0.01}}" for k in n]
    lines += ["flows:", "  power: {into: b0, rate: heat, unit: W}"]
    lines += [f"  air{k}: {{from: b{k}, rate: H * (b{k} - 20), unit: W}}" for k in n]
    lines += [
        f"  link{k}: {{from: b{k}, into: b{k + 1}, rate: {LINK} * (b{k} - b{k + 1}), unit: W}}"
        for k in n[:-1]
    ]
    lines += ["outputs:"]
    lines += [f"  t{k}: {{value: b{k}, unit: degC, noise: 0.1}}" for k in n]
    return "\n".join(lines) + "\n"


def recording(seed, watts, between):
    """Time and columns; `watts`: rms of a slow flow into block 5, or from 4 to 5, that the plant lacks."""
    t = np.arange(0.0, 3000.0, 3.0)
    rng = np.random.default_rng(seed)
    heat = rng.permutation([0.0, 8.0, 3.0, 0.0, 6.0, 1.0])[(t // 500).astype(int)]
    lacking = watts * np.sqrt(2) * np.sin(2 * np.pi * t / 700 + seed)
    a = -np.diag(np.full(BLOCKS, LOSS))
    for k in range(BLOCKS - 1):
        a[[k, k + 1], [k, k + 1]] -= LINK
        a[[k, k + 1], [k + 1, k]] += LINK
    into = np.zeros((BLOCKS, 2))
    into[0, 0] = into[5, 1] = 1.0
    into[4, 1] = -float(between)
    system = (a / STORAGE, into / STORAGE, np.eye(BLOCKS), np.zeros((BLOCKS, 2)))
    _, x, _ = lsim(system, np.column_stack([heat, lacking]), t, interp=False)
    slow = lfilter([1], [1, -0.9], rng.standard_normal(x.shape), axis=0) * (1 - 0.9**2) ** 0.5
    y = 20 + x + 0.1 * (0.8 * rng.standard_normal(x.shape) + 0.6 * slow)
    return np.column_stack([t, heat, y])


def diagnosed(folder, watts, seeds, between=False):
    header = "t,heat," + ",".join(f"t{k}" for k in range(BLOCKS))
    plant = folder / "plant.yaml"
    plant.write_text(bar())
    paths = [folder / f"run_{s}.csv" for s in seeds]
    for path, seed in zip(paths, seeds, strict=True):
        np.savetxt(
            path, recording(seed, watts, between), delimiter=",", header=header, comments="", fmt="%.5f"
        )
    assert (
        main(["diagnose", "--plant", str(plant), *map(str, paths), "--out", str(folder / "out"), "--quiet"])
        == 0
    )
    return json.loads((folder / "out" / "diagnosis.json").read_text())


def test_slow_noise_of_each_reading_is_no_flow(tmp_path):
    r = diagnosed(tmp_path, 0.0, (3, 4))
    assert r["verdict"] == "consistent" and r["decision"]["flow"] < 0.3


def test_a_flow_that_no_reading_shows_alone_is_found_at_its_node(tmp_path):
    r = diagnosed(tmp_path, 0.04, (1, 2))
    assert r["verdict"] == "unexplained" and not r["findings"]
    assert r["decision"]["remains"] < 0.9 < r["decision"]["flow"]
    assert r["remainder"]["node"] == "b5"
    assert any("a flow into b5 is missing" in note for note in r["notes"])


def test_a_flow_between_two_nodes_is_found_beside_their_link(tmp_path):
    r = diagnosed(tmp_path, 0.2, (1, 2), between=True)
    assert r["verdict"] == "unexplained" and not r["findings"]
    assert r["remainder"]["node"] in {"b4", "b5"}
    assert any("a flow along link4 is missing" in n for n in r["notes"])
