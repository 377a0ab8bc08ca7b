"""One archive for a question to others: versions, configuration, log, the end of the newest recording.

Values of keys that are called password, token, secret or key, and passwords in addresses, are left out.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import sys
import tempfile
import zipfile
from importlib import metadata
from pathlib import Path

from thermoctl import __version__
from thermoctl.configuration.settings import Settings, effective
from thermoctl.daemon.service import journal, log_path
from thermoctl.files.safe_file import whole_file
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.reader import export, info
from thermoctl.recording.writer import FULL, recording_files

LOG_BYTES = 1_000_000  # size of the part of the log that is kept, its end
HIDDEN = "(left out)"
_SECRET = re.compile(r"(?i)((?:password|passwd|token|secret|api_?key)\w*[\"']?\s*[:=]\s*|bearer\s+)[^\s,}]+")
_ADDRESS = re.compile(r"(://[^\s:/@]*:)[^\s@]+(?=@)")


def without_secrets(text: str) -> str:
    """Return the text with passwords, tokens and keys replaced."""
    return _ADDRESS.sub(rf"\g<1>{HIDDEN}", _SECRET.sub(rf"\g<1>{HIDDEN}", text))


def versions() -> str:
    """Return the versions of program, Python, system and required packages, one a line."""
    lines = [f"thermoctl {__version__}", f"python {sys.version}", f"system {platform.platform()}"]
    lines += [f"processors {os.cpu_count()}"]
    for requirement in metadata.requires("thermoctl") or ():
        name = re.split(r"[^\w.-]", requirement)[0]
        try:
            installed = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed = "not installed"
        lines.append(f"{name} {installed}")
    return "\n".join(dict.fromkeys(lines)) + "\n"


def report(settings: Settings, out: str, seconds: float) -> int:
    """Write the archive; print its content and what is missing. Raises InputError."""
    files = {
        "versions.txt": versions(),
        "configuration.yaml": without_secrets(Path(settings.path).read_text(encoding="utf-8")),
        "effective.yaml": without_secrets(effective(settings)),
    }
    log, missing = log_path(settings), []
    try:
        files["log.txt"] = without_secrets(journal(settings, LOG_BYTES) or _tail(log))
    except OSError:
        missing.append(f"no log: {log} does not exist, and no service runs this configuration")
    folder = Path(settings.recording.directory)
    newest = _newest(recording_files(folder, FULL) if folder.is_dir() else [])
    if newest is None:
        missing.append(f"no recording in {folder}")
    with (
        tempfile.TemporaryDirectory() as work,
        whole_file(out) as written,
        zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, text in files.items():
            archive.writestr(name, text)
        if newest is not None:
            path, ends_s = newest
            part = Path(work) / f"{path.stem}.parquet"
            export(path, part, begin_s=ends_s - seconds)
            archive.write(part, part.name)
        names = archive.namelist()
    print(f"wrote {out}: {', '.join(names)}", *missing, "Read it before you send it.", sep="\n")
    return 0


def _newest(recorded: list[Path]) -> tuple[Path, float] | None:
    """Return the newest recording that has rows, and its end, s."""
    for path in reversed(recorded):
        with contextlib.suppress(InputError):
            return path, info(path).ends_s
    return None


def _tail(path: Path) -> str:
    with path.open("rb") as log:
        log.seek(max(0, path.stat().st_size - LOG_BYTES))
        return log.read().decode(errors="replace")


__all__ = ["report", "versions", "without_secrets"]
