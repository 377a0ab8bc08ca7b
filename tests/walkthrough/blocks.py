"""The commands of README and docs, taken from the pages themselves and run as a reader would.

A block of commands (```sh) has a comment before it that says what becomes of it:

    <!-- runs -->                      as one script (sh -e), in a folder that the blocks of all pages share
    <!-- runs in a clone -->           only in the walk-through: it needs a whole clone of its own
    <!-- runs for N s -->              as the one above, Ctrl-C after N seconds
    <!-- not run: REASON -->
"""

import os
import re
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 900.0
_BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>.*?) -->\n)?^(?P<indent> *)```(?P<kind>\w*)\n(?P<text>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A block of commands: where it stands, its mark, its text."""

    page: Path
    line: int
    mark: str
    text: str

    @property
    def where(self):
        return f"{self.page.name}:{self.line}"


def pages():
    """README first, then the how-to pages by name."""
    return [ROOT / "README.md", *sorted((ROOT / "docs/how-to").glob("*.md"))]


def blocks(page):
    """The blocks of commands of a page, in order."""
    text = page.read_text()
    return [
        Block(
            page,
            text[: m.start("text")].count("\n") + 1,
            m["mark"] or "",
            re.sub(f"^{m['indent']}", "", m["text"], flags=re.MULTILINE),
        )
        for m in _BLOCK.finditer(text)
        if m["kind"] == "sh"
    ]


def run(block, folder, path, seconds=None):
    """Run a block in `folder`; its output. Ctrl-C after `seconds`, which then has to end it well. Raises AssertionError with
    what it said."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("THERMOCTL")}
    environment |= {"PATH": f"{path}:{os.environ['PATH']}", "COLUMNS": "100", "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        ["sh", "-ec", block.text],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        said, _ = process.communicate(timeout=seconds or LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=60.0)
        assert seconds, f"{block.where}: not done within {LIMIT_S:g} s:\n{block.text}\n{said}"
        assert process.returncode in (0, 2, 130, -signal.SIGINT), (
            f"{block.where}: ended with {process.returncode}:\n{said}"
        )
        return said
    logs = (
        "".join(f"\n{p}:\n{p.read_text(errors='replace')[-3000:]}" for p in sorted(folder.glob("run/*.log")))
        if process.returncode
        else ""
    )
    assert process.returncode == 0, (
        f"{block.where}: exit status {process.returncode}:\n{block.text}\n{said}{logs}"
    )
    return said
