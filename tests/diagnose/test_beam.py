"""Which hypotheses a search extends: a search with known scores, and no data."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search import beam
from thermoctl.diagnosis.search.beam import Search, Weighed, grow

PLACE = "somewhere"


def weighed(names: str, score: float) -> Weighed:
    """Return a hypothesis of effects of one letter each, with a score; nothing else of it is known."""
    keys = frozenset((name, PLACE) for name in names)
    hypothesis = SimpleNamespace(keys=keys, effects=tuple(keys))
    return Weighed(
        SimpleNamespace(hypothesis=hypothesis, log_evidence=score, rough=SimpleNamespace(cost=-score)), 0.0
    )


class Known(Search):
    """A search whose refits have known scores: `extensions` of each hypothesis, by its letters."""

    def __init__(self, extensions: dict[str, dict[str, float]]):
        budget = SimpleNamespace(spent=False, later=0.0)
        super().__init__(SimpleNamespace(budget=budget), limits(), {})
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
    monkeypatch.setattr(beam, "only_noise", lambda case, f, limits: bool(f.hypothesis.effects))


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
