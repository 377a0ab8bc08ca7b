"""What README and the how-to pages tell a reader to type works, page by page, in a folder as a clone has it."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.process import patient
from tests.walkthrough.blocks import ROOT, blocks, pages, run

BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """config and docs/examples of the clone; pages go on with what the pages before left."""
    place = tmp_path_factory.mktemp("reader")
    for name in ("config", "docs/examples"):
        shutil.copytree(ROOT / name, place / name)
    config = patient(place / "config/simulated.yaml")
    yield place
    subprocess.run([BIN / "thermoctl", "stop", "--config", config], cwd=place, capture_output=True)


def test_every_block_of_commands_says_whether_it_is_run():
    for page in pages():
        for block in blocks(page):
            assert re.fullmatch(r"runs|runs in a clone|runs for \d+ s|not run: .{10,}", block.mark), (
                f"{block.where}: {block.mark!r}"
            )


def test_links_of_the_documents_lead_somewhere():
    for page in [*pages(), *sorted((ROOT / "docs").rglob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize(  # first-rig.md begins in a folder of its own: tests/walkthrough/first_rig.py
    "page",
    [p for p in pages() if p.stem != "first-rig" and any(b.mark == "runs" for b in blocks(p))],
    ids=lambda p: p.stem,
)
def test_a_page(page, folder):
    for block in blocks(page):
        if block.mark == "runs":
            run(block, folder, BIN)
    if page.name == "README.md":
        found = json.loads((folder / "result/diagnosis.json").read_text())
        assert found["verdict"] == "explained" and found["findings"][0]["effect"] == "external_heat_source"


def test_the_example_is_what_its_script_writes(tmp_path):
    subprocess.run([sys.executable, ROOT / "docs/examples/heater/make.py", tmp_path], check=True)
    for name in ("run_1.csv", "run_2.csv"):
        there, here = (
            np.loadtxt(p / name, delimiter=",", skiprows=1) for p in (ROOT / "docs/examples/heater", tmp_path)
        )
        assert np.allclose(there, here, rtol=2e-4, atol=2e-3)
