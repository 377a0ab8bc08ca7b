"""The reference pages say what the code says."""

import os
import shutil

from tests.reference import DOCS, pages, stale
from thermoctl.configuration.settings import options
from thermoctl.control.faults import FAULTS, KINDS


def test_pages_are_not_stale():
    before = dict(os.environ)
    assert stale() == [], "run python -m tests.reference"
    assert dict(os.environ) == before, "the pages' width is not the terminal's"


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
        page = text[f"faults/{f.name}.md"]
        assert all(part and part.rstrip(".")[1:] in page for part in (f.cause, f.check, f.cure)), f.name


def test_the_encoders_page_is_about_encoders():
    """Each page speaks of its own device; CAN's bus-off has its sentence where a CAN device may stand."""
    text = {p.stem: t for p, t in pages().items() if p.parent.name == "faults"}
    for name in ("position", "voltage", "current", "amplifier"):
        for kind in KINDS:
            assert "thermocouple" not in text.get(f"{name}_{kind}", "").lower()
    assert all("left the bus" in text[n] for n in ("amplifier_error", "current_error", "amplifier_write"))
    assert len({t.split("## Cause")[1].split("Then `")[0] for t in text.values()}) == len(FAULTS), (
        "no two alike"
    )
