"""The reference pages say what the code says."""

import shutil

from thermoctl.control.faults import FAULTS
from thermoctl.reference import DOCS, pages, stale
from thermoctl.settings import options


def test_pages_are_not_stale():
    assert stale() == [], "run python -m thermoctl.reference"


def test_a_changed_page_and_a_page_too_many_are_noticed(tmp_path):
    shutil.copytree(DOCS, tmp_path / "docs")
    (tmp_path / "docs/reference/signals.md").write_text("old")
    (tmp_path / "docs/faults/gone.md").write_text("old")
    assert stale(tmp_path / "docs") == ["reference/signals.md", "faults/gone.md"]


def test_every_option_and_fault_is_there():
    text = {str(p): t for p, t in pages().items()}
    for key, _, option in options():
        assert f"| `{key.split('.')[1]}` |" in text["reference/configuration.md"] and option.meaning
    for f in FAULTS:
        assert f.remedy[1:] in text[f"faults/{f.name}.md"]
