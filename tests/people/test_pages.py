"""The reports, as a person sees them: four verdicts of a diagnosis, light and dark, on a telephone, a screen and on paper."""

import base64
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from tests.plants import HEATED_BLOCK, HEATED_RADIATES
from thermoctl.diagnosis.run import diagnose_files
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

ROOT = Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("make", ROOT / "docs/examples/heater/make.py")
make = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make)
HEADER = "t,heat,air_temperature,temperature_1,temperature_2"
# Rectangles of all visible texts, each with what cuts it: the page's edge, the drawing or the box that it is in; letters below 9 px.
LOOK = """(() => {
  const texts = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), faults = [];
  while (walker.nextNode()) {
    const node = walker.currentNode, parent = node.parentElement;
    if (!node.textContent.trim() || parent.closest('style,script') || !parent.checkVisibility()) continue;
    const range = document.createRange(); range.selectNodeContents(node);
    for (const r of range.getClientRects()) {
      if (r.width < 1 || r.height < 1) continue;
      const svg = parent.closest('svg'), wide = parent.closest('.wide');
      const box = (svg || (wide && wide.scrollWidth <= wide.clientWidth ? wide : document.documentElement)).getBoundingClientRect();
      const text = node.textContent.trim().slice(0, 40);
      if (r.left < box.left - 1.5 || r.right > box.right + 1.5) faults.push('cut: ' + text);
      const scale = svg ? svg.getBoundingClientRect().width / svg.viewBox.baseVal.width : 1;
      if (scale * parseFloat(getComputedStyle(parent).fontSize) < 9) faults.push('small: ' + text);
      texts.push({r, node, text});
    }
  }
  for (let i = 0; i < texts.length; i++) for (let j = i + 1; j < texts.length; j++) {
    const a = texts[i].r, b = texts[j].r;
    if (texts[i].node === texts[j].node) continue;
    const w = Math.min(a.right, b.right) - Math.max(a.left, b.left), h = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (w > 2 && h > 0.3 * Math.min(a.height, b.height)) faults.push('overlap: ' + texts[i].text + ' | ' + texts[j].text);
  }
  if (document.documentElement.scrollWidth > innerWidth) faults.push('the page is wider than the window');
  if (innerWidth < 640) for (const w of document.querySelectorAll('.wide'))
    if (w.scrollWidth > w.clientWidth + 1) faults.push('a table is wider than the telephone: ' + w.textContent.slice(0, 40));
  return [texts.length, faults];
})()"""
KINDS = {  # verdict, its picture, the window's size and theme, the part of the page that is kept
    "explained": ({"explained"}, (1280, 900), False, 1500),
    "ambiguous": ({"ambiguous"}, (1280, 900), False, 1500),
    "nothing-missing": ({"consistent"}, (360, 780), False, 1900),
    "unexplained": ({"unexplained", "partly_explained"}, (1280, 900), True, 1500),
}


def wobbling(rows, seed):
    """A disturbance that no entry of the catalogue is."""
    rows = rows.copy()
    t = rows[:, 0]
    rows[:, 3] += 1.5 * np.sin(t / 9.0) ** 2 * (rows[:, 3] > 38) + 0.8 * np.sign(np.sin(t / 47.0 + seed)) * (
        rows[:, 4] > 27
    )
    return rows


def recorded(name, folder, monkeypatch):
    """Files of a plant and its recordings, whose diagnosis has the verdict."""
    if name == "ambiguous":
        t = np.arange(240) * 5.0
        heat = np.where((np.abs(t - 156) < 75) | (np.abs(t - 736) < 75), 20.0, 0.0)
        table = Table("run_1", "run_1", t, {"heat": heat, "air": np.full(len(t), 22.0)})
        plant, truth = (b.replace("noise: 0.05", "noise: 0.2") for b in (HEATED_BLOCK, HEATED_RADIATES))
        (folder / "plant.yaml").write_text(plant)
        write_table(folder / "run_1.csv", compile_plant(loads(truth), ()).measure(table, seed=1))
        return folder / "plant.yaml", [folder / "run_1.csv"]
    monkeypatch.setattr(make, "LAMP_W", make.LAMP_W if name == "explained" else 0.0)
    paths = [folder / f"run_{seed}.csv" for seed in ((1, 2, 3) if name == "explained" else (1, 2))]
    for seed, path in enumerate(paths, 1):
        rows = make.record(seed)
        rows = wobbling(rows, seed) if name == "unexplained" else rows
        np.savetxt(path, rows, fmt="%.5g", delimiter=",", header=HEADER, comments="")
    return ROOT / "docs/examples/heater/plant.yaml", paths


@pytest.mark.slow  # four diagnoses and a browser: make test-browser
@pytest.mark.parametrize("name", KINDS)
def test_a_diagnosis_reads_well(name, tmp_path, browser, monkeypatch):
    verdicts, size, dark, height = KINDS[name]
    plant, recordings = recorded(name, tmp_path, monkeypatch)
    result = diagnose_files(plant, recordings, tmp_path / "out")
    assert result["verdict"] in verdicts
    assert result == json.loads((tmp_path / "out/diagnosis.json").read_text())
    looked_at(browser, tmp_path / "out/report.html")
    assert str(tmp_path) not in browser.js("document.body.innerText"), "names, no paths"
    browser.size(*size)
    browser.dark(dark)
    browser.open(f"file://{tmp_path}/out/report.html")
    browser.until("document.readyState === 'complete' && document.querySelector('figure svg').id !== null")
    first = browser.js("document.querySelector('figure').getBoundingClientRect().bottom / innerHeight")
    assert first < 1.0, "verdict, sentence and curves are on the first screen"
    browser.keep(f"report-{name}", height=height)


def looked_at(browser, path):
    """On every size and theme, folded and unfolded, no text covers another one and nothing is cut."""
    for width in (360, 800, 1280):
        browser.size(width, 900)
        for dark in (False, True):
            browser.dark(dark)
            clean(browser, path)
            ground = browser.js("getComputedStyle(document.body).backgroundColor")
            assert (ground == "rgb(255, 255, 255)") is not dark
    browser.size(718, 1000)  # A4 between its margins
    browser.call("Emulation.setEmulatedMedia", media="print", features=[])
    clean(browser, path)
    pdf = browser.call("Page.printToPDF", printBackground=False, preferCSSPageSize=True)["data"]
    assert base64.b64decode(pdf)[:5] == b"%PDF-"
    browser.call("Emulation.setEmulatedMedia", media="", features=[])
    assert browser.js("performance.getEntriesByType('resource').length") == 0, "nothing from elsewhere"
    assert browser.messages == []


def clean(browser, path):
    """Fail with the texts that overlap or are cut."""
    browser.open(f"file://{path}")
    browser.until("document.readyState === 'complete' && document.querySelector('.lead b').textContent")
    for opened in ("false", "true"):
        browser.js(f"for (const d of document.querySelectorAll('details')) d.open = {opened}")
        count, faults = browser.js(LOOK)
        assert count > 40 and faults == []
