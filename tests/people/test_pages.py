"""The reports, as a person sees them: every verdict of a diagnosis, in the light, in the dark, on a telephone and on paper."""

import base64
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from thermoctl.cli import main

ROOT = Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("make", ROOT / "docs/examples/heater/make.py")
make = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make)
HEADER = "t,heat,air_temperature,temperature_1,temperature_2"


def quiet_rig(rows, seed):
    """The same rig where nobody put a lamp: no finding."""
    return rows


def wobbling(rows, seed):
    """A disturbance that no entry of the catalogue is."""
    rows = rows.copy()
    t = rows[:, 0]
    rows[:, 3] += 1.5 * np.sin(t / 9.0) ** 2 * (rows[:, 3] > 38) + 0.8 * np.sign(np.sin(t / 47.0 + seed)) * (
        rows[:, 4] > 27
    )
    return rows


@pytest.mark.slow  # three diagnoses and a browser: make test-browser
@pytest.mark.parametrize(
    ("name", "lamp_w", "spoil", "verdicts"),
    [
        ("explained", make.LAMP_W, quiet_rig, {"explained"}),
        ("consistent", 0.0, quiet_rig, {"consistent"}),
        ("unknown", 0.0, wobbling, {"unexplained", "ambiguous"}),
    ],
)
def test_a_diagnosis_reads_well(name, lamp_w, spoil, verdicts, tmp_path, browser, monkeypatch):
    monkeypatch.setattr(make, "LAMP_W", lamp_w)
    runs = []
    for seed in (1, 2):
        runs.append(str(tmp_path / f"run_{seed}.csv"))
        np.savetxt(
            runs[-1], spoil(make.record(seed), seed), fmt="%.5g", delimiter=",", header=HEADER, comments=""
        )
    assert (
        main(
            (
                f"diagnose --plant {ROOT / 'docs/examples/heater/plant.yaml'} {' '.join(runs)} --out {tmp_path / 'out'} "
                "--quiet"
            ).split()
        )
        == 0
    )
    browser.size(1100, 900)
    for dark in (False, True):
        browser.dark(dark)
        browser.open(f"file://{tmp_path}/out/report.html")
        verdict = browser.until(
            "document.readyState === 'complete' && document.querySelector('.lead b').textContent"
        )
        assert verdict.rstrip(".").lower() in verdicts
        assert browser.js("document.documentElement.scrollWidth <= innerWidth"), "nothing hangs over the edge"
        light = browser.js("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        assert light is not dark
        if (name, dark) in (("explained", False), ("unknown", True)):
            browser.keep(
                "report-diagnosis" if name == "explained" else "report-diagnosis-unknown", height=1500
            )
    assert str(tmp_path) not in browser.js("document.body.innerText"), "names, no paths"
    assert browser.js(
        "[...document.querySelectorAll('figure')].every(f => f.querySelector('figcaption').textContent.length > 20)"
    )
    assert browser.js("performance.getEntriesByType('resource').length") == 0, "nothing from elsewhere"
    browser.size(400, 900)
    assert browser.js("document.documentElement.scrollWidth <= innerWidth"), (
        "on a telephone tables scroll, the page does not"
    )
    pdf = base64.b64decode(
        browser.call("Page.printToPDF", printBackground=False, preferCSSPageSize=True)["data"]
    )
    assert pdf[:5] == b"%PDF-" and len(pdf) > 20000
    assert browser.messages == []
