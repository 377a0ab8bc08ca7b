"""Refits that fail: the hypothesis is left out, and the diagnosis goes on."""

from __future__ import annotations

from tests.plants import radiating
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import fitted
from thermoctl.diagnosis.law.forms import Term, library
from thermoctl.diagnosis.law.propose import Place, Proposal
from thermoctl.diagnosis.law.refit import refitted_law
from thermoctl.diagnosis.law.signals import Signal
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import expression as ex


def test_a_law_that_the_plant_cannot_hold_is_left_out(tmp_path):
    """An expression of 400 terms ended the diagnosis: only the refit itself was caught, not the plant with it."""
    plant, tables = radiating(tmp_path, recordings=1)
    known = case(plant, tables, {}, Budget(9))
    null = fitted(known, known.plant, (), known.null)
    long = ex.name("block")
    for _ in range(400):
        long = ex.add(long, ex.name("block"))
    linear = next(f for f in library() if f.name == "linear")
    for value, possible in ((ex.name("block"), True), (long, False)):
        term = Term(linear, (Signal("signal", value, "K", size=2.0),), {})
        law = Proposal(Place("block"), (term,), (0.01,), 0.0, 0.0, limits())
        assert (refitted_law(known, null, law, null) is not None) == possible
