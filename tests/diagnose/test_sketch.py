"""Sketched products of directions are those of their simulated rows, and keep the right place."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tests.bench.scale import block_plant, recorded
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import fitted
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.search import again
from thermoctl.diagnosis.search.metric import Metric, Plain
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import directions, groups_of, screen
from thermoctl.diagnosis.search.sketch import SKETCHES, likeliest, products
from thermoctl.plant import load
from thermoctl.plant.recordings import read_recordings


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """A chain of six blocks with heat into the third that the plant lacks; metric, places and groups."""
    folder = tmp_path_factory.mktemp("chain")
    recorded(folder, block_plant(6), "{into: block_3, rate: 1.5 * step(t - 2000), unit: W}", 500, 10.0, 10.0)
    plant = load(folder / "plant.yaml")
    known = case(plant, read_recordings(plant, [folder / "run_1.csv"]), catalogue(), Budget(80))
    first = fitted(known, known.plant, (), known.null)
    metric = Metric(Plain(known, first.rough), first.average, False)
    rig = known.rig(first.rough_plant, metric.drives)
    found = candidates(rig, known.catalogue)
    return metric, rig, found, [Trajectory(metric, rig, 0)]


def test_sketched_products_are_those_of_the_rows(chain):
    metric, _, found, at = chain
    groups = [g for c in found for g in groups_of(c, metric)]
    columns = [column for g in groups for column in g.columns()]
    (sketched,) = products([metric], at, columns)
    rows = np.concatenate([part for _, part in directions(metric, at, groups)], axis=1)
    whole = rows * metric.weight[:, None]
    rows = metric.project(whole)
    size = np.linalg.norm(rows, axis=0)
    clear = size > 0.05 * np.linalg.norm(whole, axis=0)
    assert clear.sum() > 200
    gain = (rows[:, clear].T @ metric.residual) / size[clear]
    assert np.abs(sketched[clear, 0] / size[clear] - gain).max() < 0.02 * np.abs(gain).max()
    norm = np.linalg.norm(sketched[clear, 1:], axis=1) / size[clear]
    assert np.abs(norm - 1).max() < 4 / np.sqrt(2 * SKETCHES)  # four standard deviations


def test_what_a_sketch_keeps_holds_the_best_directions(chain, monkeypatch):
    metric, rig, found, _ = chain
    (every,) = screen([metric], rig, found)
    monkeypatch.setattr(sys.modules[likeliest.__module__], "EXACT", 0)
    monkeypatch.setattr(sys.modules[likeliest.__module__], "KEPT", 300)
    (kept,) = screen([metric], rig, found, select=likeliest)
    assert len(kept) < 0.8 * len(every)
    assert [d.candidate.key for d in kept[:10]] == [d.candidate.key for d in every[:10]]
    assert [d.gain for d in kept[:10]] == pytest.approx([d.gain for d in every[:10]], rel=0.05)


def test_what_a_later_screening_keeps_holds_the_best_directions(chain, monkeypatch):
    """Also where only the residual has changed since: the rows of the first screening tell its gains."""
    metric, rig, found, _ = chain
    known = again.Known([run.y for run in metric.runs])
    screen([metric], rig, found, norms=[], keep=known.add)
    assert known.like(metric)
    monkeypatch.setattr(again, "KEPT", 100)
    monkeypatch.setattr(metric, "residual", metric.project(metric.residual[::-1].copy()))
    (every,) = screen([metric], rig, found)
    (kept,) = screen([metric], rig, found, select=known.likeliest)
    assert len(kept) < 0.5 * len(every)
    assert [d.candidate.key for d in kept[:10]] == [d.candidate.key for d in every[:10]]
    assert [d.gain for d in kept[:10]] == pytest.approx([d.gain for d in every[:10]], rel=1e-3)


def test_a_plant_that_moves_otherwise_is_screened_anew(chain):
    metric, *_ = chain
    assert not again.Known().like(metric)
    assert not again.Known([1.3 * run.y for run in metric.runs]).like(metric)
