"""Which hypotheses a search extends: a search with known scores, and no data."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.plants import SPRING_STAGE
from thermoctl.diagnosis.data.case import Budget, Case, case
from thermoctl.diagnosis.evidence.fit import Placed, fitted
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search import beam, shortlist
from thermoctl.diagnosis.search.beam import Search, Weighed, grow
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.table import Table

PLACE = "somewhere"


def weighed(names: str, score: float) -> Weighed:
    """Return a hypothesis of effects of one letter each, with a score; nothing else of it is known."""
    keys = frozenset((name, PLACE) for name in names)
    hypothesis = SimpleNamespace(keys=keys, effects=tuple(SimpleNamespace(key=k) for k in keys))
    rough = SimpleNamespace(cost=-score)
    return Weighed(
        SimpleNamespace(hypothesis=hypothesis, log_evidence=score, rough=rough, doubtful=False), 0.0
    )


class Known(Search):
    """A search whose refits have known scores: `extensions` of each hypothesis, by its letters."""

    def __init__(self, extensions: dict[str, dict[str, float]]):
        budget = SimpleNamespace(spent=False, later=0.0)
        super().__init__(SimpleNamespace(budget=budget, limits=limits()), {})
        self.known = {frozenset(k): v for k, v in extensions.items()}
        self.order: list[str] = []
        self.keep([weighed("", 0.0)])

    def extended(self, parent: Weighed) -> list[Weighed]:
        """Extend a hypothesis, once."""
        keys = parent.fitted.hypothesis.keys
        if keys in self.seen:
            return []
        self.seen.add(keys)
        names = frozenset(name for name, _ in keys)
        self.order.append("".join(sorted(names)))
        found = [weighed(k, score) for k, score in self.known.get(names, {}).items()]
        self.keep(found)
        return found


@pytest.fixture(autouse=True)
def only_noise(monkeypatch):
    """Let every hypothesis with effects leave only noise."""
    monkeypatch.setattr(beam, "only_noise", lambda case, f: bool(f.hypothesis.effects))


FIRST = {"a": 145.0, "b": 141.0, "xb": 197.0}  # x imitates a beside b: the pair was proposed as a pair


def test_a_pair_does_not_end_the_search_of_single_effects():
    """A proposed pair left only noise, so a + b was never refitted, and x was named beside b with 1.0."""
    s = Known({"": FIRST, "xb": {"xbc": 275.0}, "a": {"ab": 287.0}})
    grow(s)
    assert s.best.fitted.hypothesis.keys == {("a", PLACE), ("b", PLACE)}


def test_a_pair_that_cannot_be_extended_does_not_end_it_either():
    s = Known({"": FIRST, "b": {"ab": 287.0}})
    grow(s)
    assert s.best.fitted.hypothesis.keys == {("a", PLACE), ("b", PLACE)}


@pytest.mark.parametrize("score", [141.0, 140.0])
def test_beside_one_effect_that_leaves_only_noise_a_distant_rival_is_not_extended(score):
    s = Known({"": {"a": 145.0, "b": score}, "a": {"ac": 140.0}})
    grow(s)
    assert ("b" in s.order) == (score > 145.0 - beam.NEAR)


@pytest.mark.parametrize(("promise", "where"), [(60.0, "here"), (60.0, "elsewhere"), (40.0, "here")])
def test_a_rival_of_a_leader_is_refitted_if_twice_its_promise_reaches_it(monkeypatch, promise, where):
    """A delay of a reading promised more than a lag, so the lag, 27 nats likelier, was never refitted.

    Radiation at a node was not, as the conductance that leads acts at a flow of it."""
    reached = {("delay", "here"): 100.0, ("drift", "there"): 10.0, ("lag", where): 130.0}
    promised = dict(zip(reached, (100.0, 90.0, promise), strict=True))
    effect = SimpleNamespace(contains=None)
    queue = [
        ((SimpleNamespace(candidate=SimpleNamespace(key=k, effect=effect)),), gain)
        for k, gain in promised.items()
    ]

    def refit(case, parent, looked, batch, leader):
        """Return a refit of each extension, with its known score."""
        out = []
        for (d,), _ in batch:
            f = weighed("", reached[d.candidate.key]).fitted
            f.hypothesis.keys = frozenset([d.candidate.key])
            f.hypothesis.effects, f.absent, f.doubtful, f.log_likelihood = (d,), False, False, f.log_evidence
            out.append(f)
        return out

    monkeypatch.setattr(beam, "shortlist", lambda *a, **k: queue)
    monkeypatch.setattr(beam, "refitted", refit)
    monkeypatch.setattr(beam, "odds", lambda *a: 0.0)
    s = Known({})
    vars(s.case.budget).update(fits_done=0, planned=0, untried=0)
    s.best.fitted.log_likelihood = 0.0
    found = beam.extensions(s, s.best, SimpleNamespace(promised=[]))
    assert (("lag", where) in {k for w in found for k in w.fitted.hypothesis.keys}) == (2 * promise > 100.0)


def test_what_is_left_of_the_best_meets_its_own_rivals(monkeypatch):
    """Radiation at a wrong body was best beside a gain, and better alone; the right body was never refitted."""
    s = Known({"": {"g": 40.0}, "g": {"gr": 60.0}})
    grow(s)
    s.case.budget.stopped = lambda: False
    s.known[frozenset()] = {"g": 40.0, "t": 80.0}  # with the gain of r, the promise of t reaches the best
    monkeypatch.setattr(beam, "rebuilt", lambda s, rest, *a: weighed(rest[0].key[0], 70.0))
    monkeypatch.setattr(beam, "simplified", lambda s: [])
    monkeypatch.setattr(beam, "cleared", lambda s: [])
    beam.swap(s)
    assert s.best.fitted.hypothesis.keys == {("t", PLACE)}


TREE = {"": {"g": 40.0}, "g": {"gr": 60.0}, "gr": {"grt": 80.0}, "gt": {"gst": 90.0}}


@pytest.mark.parametrize("after", range(1, 10))
def test_a_search_that_is_stopped_knows_that_something_was_left_out(monkeypatch, after):
    """Stopped between two rounds, or before rivals were tried, a gain of a sensor was named at 1.0 (a cylinder)."""
    order: list[Weighed] = []

    def extensions(s, parent, looked, again):
        """Return the known extensions of a hypothesis."""
        order.append(parent)
        known = TREE.get("".join(sorted(name for name, _ in parent.fitted.hypothesis.keys)), {})
        return [weighed(k, score) for k, score in known.items()]

    monkeypatch.setattr(beam, "extensions", extensions)
    monkeypatch.setattr(beam, "screened", lambda *a: SimpleNamespace(norms=[], promised=[]))
    monkeypatch.setattr(beam, "simplified", lambda s: [])
    monkeypatch.setattr(beam, "cleared", lambda s: [])
    monkeypatch.setattr(beam, "rebuilt", lambda s, rest, *a: weighed("".join(e.key[0] for e in rest), 50.0))
    s = Search(SimpleNamespace(budget=Budget(99, stopped=lambda: len(order) >= after), limits=limits()), {})
    s.keep([weighed("", 0.0)])
    grow(s)
    beam.swap(s)
    whole = s.best.fitted.hypothesis.keys == weighed("gst", 0.0).fitted.hypothesis.keys
    assert whole or s.case.budget.untried
    assert after < 9 or not s.case.budget.untried


@pytest.mark.parametrize(("promise", "tried"), [(30.0, True), (25.0, False)])
def test_the_leading_effect_is_tried_where_it_promised_as_much(monkeypatch, promise, tried):
    monkeypatch.setattr(shortlist, "relabels", lambda candidate: False)
    promised = {("drift", "here"): 50.0, ("radiation", "here"): promise, ("radiation", "there"): 27.0}
    directions = [SimpleNamespace(candidate=SimpleNamespace(key=k)) for k in promised]
    looked = SimpleNamespace(promised=[*zip(directions, promised.values(), strict=True)])
    found = shortlist.elsewhere({("radiation", "there")}, 60.0, looked, [])
    assert [(d.candidate.key, gain) for (d,), gain in found] == [(("radiation", "here"), 60.0)] * tried
    assert not shortlist.elsewhere({("radiation", "there"), ("drift", "here")}, 60.0, looked, [])


def rubbed() -> Case:
    """Return a case of a spring stage whose dry friction of 1.2 N is missing."""
    t = np.arange(3000) * 0.002
    truth = SPRING_STAGE.replace(
        "damper:", "rub: {from: velocity, rate: 1.2 * tanh(velocity / 0.001)}\n  damper:"
    )
    force = Table("run", "run", t, {"force": 6 * np.sin(7 * t) + 3 * np.sin(23 * t)})
    table = compile_plant(loads(truth)).measure(force, seed=1)
    return case(loads(SPRING_STAGE), [table], catalogue(), Budget(20))


@pytest.mark.parametrize(
    ("richer", "sizes"),
    [
        ("stribeck_friction", {"W": 1e-3, "FC": 0.9, "FS": 0.3, "VS": 0.02}),
        ("directional_friction", {"W": 1e-3, "F": 0.9, "D": 0.1, "H": 0.5}),
    ],
)
def test_what_contains_dry_friction_is_compared_with_it(richer, sizes):
    """Beside cogging, dry friction promised too little for a refit: a friction that contains it was named."""
    known = rubbed()
    s = beam.started(known)
    rig = known.rig(known.plant, known.drives(known.null.model))
    c = next(c for c in candidates(rig, known.catalogue) if c.key == (richer, "velocity"))
    plant = c.extend(sizes, {k: (-4.0 if k in "DH" else 0.0, 4.0) for k in sizes} | {"W": (1e-5, 0.1)})
    s.keep([s.weighed(fitted(known, plant, (Placed(c, {p: c.own(p) for p in sizes}),)))])
    (simple,) = beam.simplified(s)
    assert simple.fitted.hypothesis.keys == {("coulomb_friction", "velocity")}
    assert simple.fitted.plant.parameters["F_coulomb_friction_velocity"].value == pytest.approx(1.2, rel=0.02)
    s.keep([simple])
    assert not beam.simplified(s)


def test_an_effect_that_is_nothing_is_not_ahead_of_a_worse_refit_of_the_others():
    """A free stage with friction and cogging: their refit had ended far off, and a third effect of no size was named."""
    known = rubbed()
    s, plant, placed = beam.started(known), known.plant, ()
    for key, values, ranges in (
        (("coulomb_friction", "velocity"), {"W": 1e-3, "F": 1.1}, {"W": (1e-5, 0.1), "F": (0.0, 4.0)}),
        (("constant_load", "velocity"), {"F": 0.01}, {"F": (-4.0, 4.0)}),
    ):
        rig = known.rig(plant, known.drives(compile_plant(plant)))
        c = next(c for c in candidates(rig, known.catalogue) if c.key == key)
        plant = c.extend(values, ranges)
        placed = (*placed, Placed(c, {p: c.own(p) for p in values}))
        f = fitted(known, plant, placed)
        s.keep([Weighed(f, s.weighed(f).log_odds - 1000.0 * (len(placed) == 1))])  # the first is far off
    assert [e.key[0] for e in s.best.fitted.hypothesis.effects] == ["coulomb_friction", "constant_load"]
    (rest,) = beam.cleared(s)
    assert rest.fitted.hypothesis.keys == {("coulomb_friction", "velocity")} and rest.score > s.best.score
    s.keep([rest])
    assert not beam.cleared(s)


def test_a_hypothesis_whose_responses_cannot_be_simulated_is_not_extended(monkeypatch):
    """Two of sixteen real rigs lost their diagnosis, though the plant alone could be refitted."""

    def failed(*_: object) -> None:
        raise SimulationError("run_2: the plant cannot be simulated")

    s = beam.started(rubbed())
    monkeypatch.setattr(beam, "screened", failed)
    assert s.extended(s.best) == [] and s.best.fitted.hypothesis.keys == frozenset()
