"""Progress counts what was planned; a diagnosis can be stopped; an output folder is checked before the work."""

from __future__ import annotations

import json
import signal
from dataclasses import replace

import pytest

from tests.plants import radiating
from thermoctl.diagnosis.commands import on_interrupt
from thermoctl.diagnosis.data.case import Budget
from thermoctl.diagnosis.diagnose import sought
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.run import diagnose
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


def test_progress_gives_the_time_of_the_planned_refits():
    """Refits of 20 s, side by side in pairs; the screening of 90 s before them is no measure of a refit."""
    said: list[str] = []
    times = iter([0.0, 110.0, 110.0, 150.0, 150.0, 190.0])
    budget = Budget(80, said.append, clock=lambda: next(times))
    budget.spend()
    budget.screen()
    budget.planned = 17
    for _ in range(5):
        budget.spend()
    assert [text.partition(", ")[2] for text in said] == [""] * 5 + [
        "about 3 min for these",
        "about 4 min for these",
    ]


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
    assert [a["effect"] for a in (*found["findings"], *found["alternatives"])] == ["second_ambient"]
    assert found["verdict"] == "ambiguous"  # others that promised as much were left out
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
