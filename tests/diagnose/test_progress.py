"""Progress counts what was planned; a diagnosis can be stopped; an output folder is checked before the work."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from types import SimpleNamespace

import pytest

from tests.plants import radiating
from thermoctl.diagnosis.commands import on_interrupt
from thermoctl.diagnosis.data.case import Budget
from thermoctl.diagnosis.data.progress import Pace
from thermoctl.diagnosis.diagnose import sought
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.run import diagnose
from thermoctl.diagnosis.search import beam as search
from thermoctl.files import shipped
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load
from thermoctl.recording.table import Table

PLANT = shipped.shipped("config") / "plants" / "actuator_thermal.yaml"


def test_a_refit_is_reported_of_those_planned():
    said: list[str] = []
    budget = Budget(5, said.append)
    for planned in (1, 3, 9):
        budget.planned = planned
        budget.spend()
    assert [text.split("refit ")[1].split(" planned")[0] for text in said] == ["1 of 1", "2 of 3", "3 of 5"]


# Seconds at which refits (r) and screenings (s) began, with refits planned by then: a network of 120 bodies, whose
# third refit left no more than noise, under a profiler; the end of the search, and of the diagnosis.
NETWORK = "r17/1 s21 r110/17 r123/17 r136/17 r145/17 r153/17 r163/17 r173/17 r186/17 r195/17 r212/17 r223/17 r233/17 "
NETWORK += "r244/17 r259/17 r270/17 s294"
END_S = 396.0


def test_time_left_is_within_a_factor_of_two_from_the_second_minute_on():
    """The plan of the search as it was then: one more screening, of the best hypothesis, which is the last."""
    now, said = [0.0], list[tuple[float, str]]()
    budget = Budget(80, lambda text: said.append((now[0], text)), pace=Pace(lambda: now[0]))
    for number, event in enumerate(NETWORK.split()):
        seconds, _, planned = event[1:].partition("/")
        now[0] = float(seconds)
        budget.later = 0 if number == 0 or event == "s294" else 1
        if event[0] == "s":
            budget.screen()
        else:
            budget.planned = int(planned)
            budget.spend()
    told = [(t, text.rpartition("about ")[2].split()) for t, text in said if "about" in text]
    assert len(told) == len(NETWORK.split()) - 2  # none before the first screening is done
    for t, (number, unit, _) in told:
        left = float(number) * (60 if unit == "min" else 1)
        assert 0.5 < left / (END_S - t) < 2, (t, left)


def test_the_first_extension_expects_a_beam_after_it(monkeypatch):
    """Six recordings of twelve bodies, close to the noise from the start: 0.3 to 0.5 of the true time was told."""
    told: list[float] = []

    class First(SimpleNamespace):
        def extended(self, parent):
            told.append(self.case.budget.later)
            return False

    null = SimpleNamespace(score=0.0, fitted=SimpleNamespace(hypothesis=SimpleNamespace(keys=frozenset())))
    monkeypatch.setattr(search, "leaders", lambda tried, limits: tried)
    monkeypatch.setattr(search, "only_noise", lambda case, fitted, limits: True)
    limits = SimpleNamespace(effects=3, beam=4)
    search.grow(
        First(limits=limits, tried={1: null}, seen={}, case=SimpleNamespace(budget=Budget(9)), best=null)
    )
    assert told == [search.CLOSE * limits.beam]


@pytest.mark.parametrize("inside", ["", "result"])
def test_a_file_in_place_of_the_folder_is_refused_before_the_work(tmp_path, inside):
    taken = tmp_path / "taken"
    taken.write_text("")
    plant = load(PLANT)
    with pytest.raises(InputError, match="--out"):
        diagnose(plant, [Table("none", "none", None, {})], taken / inside)  # type: ignore[arg-type]
    assert taken.read_text() == ""


@pytest.fixture
def foreground():
    """Ctrl-C as in a terminal: a shell starts background jobs with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_stopped_diagnosis_leaves_the_result_so_far(tmp_path, foreground):
    """Radiation is concealed; Ctrl-C comes during the second and third refit, which run side by side."""
    plant, tables = radiating(tmp_path, recordings=1)
    with on_interrupt() as stopped:

        def progress(text: str) -> None:
            if "refit 2 of" in text:
                signal.raise_signal(signal.SIGINT)

        found = diagnose(plant, tables, tmp_path / "out", progress=progress, stopped=stopped)
    assert len(found["hypotheses"]) == 2  # without an effect, and the one whose refit was under way
    assert found["truncated"] and found["notes"][0].startswith("stopped by hand after 2 refits")
    assert [a["effect"] for a in found["alternatives"]] == ["second_ambient"]
    assert found["verdict"] == "unexplained"  # an event that nothing else confirms
    assert json.loads((tmp_path / "out" / "diagnosis.json").read_text())["notes"] == found["notes"]


def test_the_second_interrupt_gives_up(foreground):
    with pytest.raises(KeyboardInterrupt), on_interrupt() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        signal.raise_signal(signal.SIGINT)


def test_a_background_job_that_ignores_interrupts_goes_on(foreground):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with on_interrupt() as stopped:
        signal.raise_signal(signal.SIGINT)
        assert not stopped()


def test_a_result_is_truncated_only_where_a_refit_was_left_out(tmp_path):
    """The last refit allowed that ended a search told of hidden effects; the refits of laws hid one that was left out."""
    plant, tables = radiating(tmp_path, recordings=1)
    entries, single = {"radiation": catalogue()["radiation"]}, replace(limits(), effects=1)
    needed = sought(plant, tables, entries, single, ()).case.budget.fits_done
    for fits in (needed, needed - 1):
        found = sought(plant, tables, entries, replace(single, fits=fits), ())
        assert found.searched.truncated == (fits < needed)
