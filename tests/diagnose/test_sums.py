"""Sums over recordings: the same as with all recordings' sensitivities side by side."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from tests.plants import radiating
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import as_refitted, fitted, with_residuals
from thermoctl.diagnosis.evidence.posterior import Posterior
from thermoctl.diagnosis.law.smooth import _smoothed
from thermoctl.diagnosis.run import diagnose
from thermoctl.diagnosis.search.metric import FREE, Absorbed, Metric, Plain
from thermoctl.diagnosis.search.overlay import filtered
from thermoctl.plant.fitting import residuals


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    plant, tables = radiating(tmp_path_factory.mktemp("rig"), recordings=3)
    return case(plant, tables, {}, Budget(9))


def test_the_metric_is_that_of_noise_free_parameters_and_starts_within_their_priors(known):
    """Against the covariance of all rows: the noise's and the one that all unknowns add, side by side."""
    null = fitted(known, known.plant, (), known.null)
    plain = Plain(known, null.rough)
    metric = Metric(plain, as_refitted(known, null).average, True)
    whole, at = np.zeros((len(metric.weight), len(plain.problem.unknowns))), 0
    for r, rows in enumerate(plain.sensitivities):
        whole[at : at + len(rows), plain.unknowns(r)] = rows
        at += len(rows)
    free = [q not in metric.fit.at_bound for q, _ in plain.problem.unknowns]
    starts = np.arange(len(free)) >= plain.problem.n_parameters
    whole *= metric.weight[:, None]
    j = (whole * np.where(starts, 1.0, FREE))[:, free]
    inverse = np.linalg.inv(np.eye(len(j)) + j @ j.T)
    d = np.random.default_rng(1).standard_normal((len(metric.weight), 4))
    assert np.allclose(metric.project(d).T @ metric.project(d), d.T @ inverse @ d, rtol=1e-6)
    at_priors = plain.residual * metric.weight + whole @ (starts * metric.fit.z)
    assert np.allclose(metric.project(d).T @ metric.residual, d.T @ inverse @ at_priors, rtol=1e-6)
    assert np.allclose(metric.pulled(metric.residual) @ d, d.T @ inverse @ at_priors, rtol=1e-6)


def test_sensitivities_that_are_not_kept_give_the_same_sums_and_result(known, monkeypatch):
    kept = fitted(known, known.plant, (), known.null)
    posterior = Posterior(known, known.plant, ())
    z = kept.fit.z
    rows = posterior.rows(posterior.errors_and_slopes(z))
    inverse = posterior.likelihood(rows)[0].inverse
    gradient, matrix = posterior.slope(z, rows, inverse)
    monkeypatch.setattr(residuals, "KEPT", 0)
    other = Posterior(known, known.plant, ())
    for a, b in zip(other.slope(z, rows, inverse), (gradient, matrix), strict=True):
        assert np.array_equal(a, b)
    forgot = fitted(known, known.plant, (), known.null)
    assert forgot.fit.residuals == [] and forgot.log_evidence == pytest.approx(kept.log_evidence, abs=0.02)
    again = with_residuals(known, forgot)
    assert np.nanstd(again.fit.residuals[0]) == pytest.approx(np.nanstd(kept.fit.residuals[0]), rel=1e-3)


def test_a_diagnosis_that_keeps_no_sensitivities_has_the_same_findings(tmp_path, monkeypatch):
    plant, tables = radiating(tmp_path, recordings=3)
    kept = diagnose(plant, tables, tmp_path / "kept")
    monkeypatch.setattr(residuals, "KEPT", 0)
    forgot = diagnose(plant, tables, tmp_path / "forgot")
    for a, b in zip(
        kept["findings"] + kept["alternatives"], forgot["findings"] + forgot["alternatives"], strict=True
    ):
        assert (a["effect"], a["where"]) == (b["effect"], b["where"])
        assert a["probability"] == pytest.approx(b["probability"], abs=0.02)
    assert kept["verdict"] == forgot["verdict"] and kept["fit"]["after"] == pytest.approx(
        forgot["fit"]["after"], rel=1e-3
    )


def test_unknown_flows_of_each_recording_are_solved_alone_as_if_together():
    rng = np.random.default_rng(2)
    wide, targets = [rng.standard_normal((40, 6)) for _ in range(3)], list(rng.standard_normal((3, 40)))
    starts = [rng.standard_normal((40, 2)) for _ in range(3)]
    together = _smoothed([block_diag(*wide)], [np.concatenate(targets)], [Absorbed.by(block_diag(*starts))])
    alone = _smoothed(wide, targets, [Absorbed.by(x) for x in starts])
    assert np.allclose(np.concatenate(alone), together[0])


def test_steps_that_are_joined_in_pairs_give_the_same_lag_as_one_after_the_other():
    rng = np.random.default_rng(5)
    decay, gain = rng.uniform(0, 1, 1001), rng.standard_normal(1001)
    value, expected = 2.0, []
    for c, g in zip(decay, gain, strict=True):
        value = value * c + g
        expected.append(value)
    assert np.allclose(filtered(decay, gain, 2.0), expected, rtol=1e-12, atol=1e-12)
