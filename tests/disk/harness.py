"""Run a writer with its n-th file operation failing, and examine the folder: `sweep` does so for every n and every error.

The library of fault.c is preloaded (`preloaded` starts this program again with it). A case runs in a fork, so imports cost once.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from thermoctl.files import yamlfile
from thermoctl.recording.stream import open_stream

SOURCE = Path(__file__).with_name("fault.c")
ERRORS = {  # number in fault.c: name in the table
    1: "full at call n",
    2: "full from n on",
    3: "EIO at n",
    4: "EIO from n on",
    5: "short write",
    6: "rename refused",
    7: "kill before n",
    8: "kill inside n",
}
FULL, SHORT, RENAME, KILLS = (1, 2), 5, 6, (7, 8)
SPACE = {"open", "write", "fsync", "allocate", "rename", "link", "mkdir"}  # a full disk refuses these
LIBRARY = "THERMOCTL_FAULT_LIBRARY"


def compiled() -> str:
    """The library's path; it is compiled once for each version of fault.c."""
    found = Path(tempfile.gettempdir()) / f"thermoctl-fault-{os.getuid()}-{SOURCE.stat().st_mtime_ns}.so"
    if not found.exists():
        part = found.with_suffix(f".{os.getpid()}")
        subprocess.run(["gcc", "-shared", "-fPIC", "-O1", str(SOURCE), "-o", str(part), "-ldl"], check=True)
        part.replace(found)
    return str(found)


def preloaded(arguments: list[str]) -> None:
    """Start this program again with the library, unless it has it."""
    if LIBRARY not in os.environ:
        library = compiled()
        os.execve(
            sys.executable,
            [sys.executable, *arguments],
            {**os.environ, LIBRARY: library, "LD_PRELOAD": library},
        )
    os.environ.pop("LD_PRELOAD", None)  # not for the compiler


@dataclass
class Writer:
    """One writer of the product.

    `before` makes the files that are there, `run` writes and returns the exit status; both in an empty folder. `sound(folder, told)`
    raises where a promise beyond whole files is broken. `always`: the writer goes on after an error, as the daemon's do.
    """

    name: str
    run: Callable[[], object]
    before: Callable[[], object] = lambda: None
    sound: Callable[[Path, dict[str, object]], None] | None = None
    always: bool = False


@dataclass
class Case:
    """A run: exit status (negative: signal), text on stdout and stderr, `tell`'s values, names of the operations."""

    status: int
    out: str
    err: str
    told: dict[str, object]
    calls: list[str]


_told: dict[str, object] = {}
_to_parent: list[int] = []


def tell(**values: object) -> None:
    """Tell the parent, from a writer, what is acknowledged; it arrives also where the writer is killed next."""
    _told.update(values)
    os.write(_to_parent[0], (json.dumps(_told) + "\n").encode())


def forked(work: Callable[[], object], folder: Path, error: int = 0, n: int = 0) -> Case:
    """Do `work` in a fork in `folder`, with an error at operation n."""
    library = ctypes.CDLL(os.environ[LIBRARY])
    library.fault_trace.restype = ctypes.c_char_p
    with ExitStack() as stack:
        out, err, told = (
            stack.enter_context(os.fdopen(os.memfd_create(n), "rb+")) for n in ("out", "err", "told")
        )
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            status = 70
            try:
                os.dup2(out.fileno(), 1)
                os.dup2(err.fileno(), 2)
                os.chdir(folder)
                _to_parent[:] = [told.fileno()]
                library.fault_arm(str(folder).encode(), error, ctypes.c_long(n))
                found = work()
                library.fault_disarm()
                status = found if isinstance(found, int) else 0
            except yamlfile.InputError as e:  # as the command line does
                print(f"thermoctl: {e}", file=sys.stderr)
                status = 2
            except OSError as e:
                print(f"thermoctl: {e.filename}: {e.strerror}", file=sys.stderr)
                status = 3
            except SystemExit as e:
                status = e.code if isinstance(e.code, int) else 1
            except BaseException:
                traceback.print_exc()
            library.fault_disarm()
            sys.stdout.flush()
            sys.stderr.flush()
            tell(calls=library.fault_trace().decode())
            os._exit(status)
        _, code = os.waitpid(pid, 0)
        texts = []
        for file in (out, err, told):
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    said = json.loads(texts[2].splitlines()[-1]) if texts[2] else {}
    calls = str(said.pop("calls", "")).split()
    return Case(os.waitstatus_to_exitcode(code), texts[0], texts[1], said, calls)


def files(folder: Path) -> dict[str, bytes]:
    """The content of every file below a folder, temporary ones left out."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and ".part" not in "/".join(p.relative_to(folder).parts)
    }


def _names(found: dict[str, bytes]) -> set[str]:
    """The names, without times of day."""
    return {re.sub(r"\d{8}T\d{6}(\.\d{3}Z)?", "TIME", name) for name in found}


def leftovers(folder: Path) -> list[str]:
    """The temporary files and folders that are left."""
    return [str(p.relative_to(folder)) for p in folder.rglob("*") if p.name.endswith(".part")]


def _read(path: Path) -> None:
    """Read a file as the product or its format's library does; raises where it is not whole."""
    from thermoctl.recording.files import READERS, read_table

    kind = path.suffix
    if kind == ".arrows":
        open_stream(path)
    elif kind in READERS:
        assert len(read_table(path)) > 0
    elif kind in (".zip", ".fmu"):
        with zipfile.ZipFile(path) as archive:
            assert archive.testzip() is None
    elif kind in (".yaml", ".yml"):
        yamlfile.load(path)
    elif kind in (".json", ".state"):
        json.loads(path.read_text())
    elif path.name == "current":
        assert (path.parent / path.read_text().strip()).is_file()
    elif kind == ".html":
        assert path.read_text().rstrip().endswith("</html>")
    elif kind == ".svg":
        ElementTree.fromstring(path.read_text())
    elif kind == ".png":
        assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
    elif kind == ".mf4":
        from asammdf import MDF

        with MDF(path) as mdf:
            assert len(mdf.get_master(0)) > 0
    elif kind == ".mcap":
        from mcap.reader import make_reader

        with path.open("rb") as f:
            assert sum(1 for _ in make_reader(f).iter_messages()) > 0
    else:
        raise ValueError(f"no reader for {path.name}")


@dataclass
class Result:
    """The counts of one writer: cases by error, and its faults as lines."""

    name: str
    calls: int = 0
    cases: Counter[int] = field(default_factory=Counter)
    refused: int = 0
    faults: list[str] = field(default_factory=list)


def sweep(writer: Writer, place: Path, every: int = 1, errors: tuple[int, ...] = tuple(ERRORS)) -> Result:
    """Run a writer under every error at every `every`-th operation, in folders below `place`."""
    template, work = place / "before", place / "work"
    _warm(writer)
    for folder in (template, work):
        shutil.rmtree(folder, ignore_errors=True)
    work.mkdir(parents=True)
    made = forked(writer.before, work)  # where it runs, too: files may hold their place
    assert made.status == 0, f"{writer.name}: {made.err}"
    work.rename(template)
    before, result = files(template), Result(writer.name)
    whole = _fresh(writer, template, work)
    assert whole.status == 0, f"{writer.name} without an error: {whole.status} {whole.err}"
    after = files(work)
    assert whole.calls, f"{writer.name}: no operation was seen"
    result.calls = len(whole.calls)
    for error in errors:
        for n, call in enumerate(whole.calls, 1):
            if (
                (n - 1) % every
                or (error in FULL and call not in SPACE)
                or (error in (SHORT, 8) and call != "write")
                or (error == RENAME and call not in ("rename", "link"))
            ):
                continue
            case = _fresh(writer, template, work, error, n)
            result.cases[error] += 1
            result.refused += case.status > 0
            where = f"{writer.name}, {ERRORS[error]}, call {n} ({call})"
            result.faults += [f"{where}: {f}" for f in examine(writer, work, error, case, before, after)]
    return result


def _warm(writer: Writer) -> None:
    """Run a writer once in this process, so that its forks find everything imported."""
    here = os.getcwd()
    _to_parent[:] = [os.open(os.devnull, os.O_WRONLY)]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        os.chdir(folder)
        try:
            writer.before()
            writer.run()
            if writer.sound:
                writer.sound(Path(folder), dict(_told))
            for path in Path(folder).rglob("*"):
                with contextlib.suppress(Exception):
                    if path.is_file():
                        _read(path)
        finally:
            os.chdir(here)
            os.close(_to_parent[0])
            _told.clear()


def _fresh(writer: Writer, template: Path, work: Path, error: int = 0, n: int = 0) -> Case:
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(template, work)
    return forked(writer.run, work, error, n)


def examine(
    writer: Writer, folder: Path, error: int, case: Case, before: dict[str, bytes], after: dict[str, bytes]
) -> list[str]:
    """What is wrong after a case, as lines; `before` and `after`: the files before, and after a run without an error."""
    found, now = [], files(folder)
    for name in before:
        if name not in now and name in after:
            found.append(f"{name} is lost")
    for name, content in now.items():
        if content in (before.get(name), after.get(name)):
            continue
        read = forked(lambda name=name: _read(Path(name)), folder)
        if read.status:
            found.append(
                f"{name} is {'torn' if name in before else 'neither whole nor absent'}: {read.err[-200:]}"
            )
    if writer.sound and (sound := forked(lambda: writer.sound(folder, case.told), folder)).status:
        found.append(f"broken promise: {sound.err.strip().splitlines()[-1]}")
    if error in KILLS:
        assert case.status in (0, -9), case.err
        return found
    if (left := leftovers(folder)) and error not in (3, 4):  # a disk that refuses to delete keeps them
        found.append(f"left: {', '.join(left)}")
    if case.status < 0 or "Traceback" in case.err:
        found.append(f"ended by signal or traceback: {case.err[-300:]}")
    elif "[Errno" in case.err:
        found.append(f"no words for the error: {case.err[-300:]!r}")
    elif case.status and sum(line.startswith("thermoctl: ") for line in case.err.splitlines()) != 1:
        found.append(f"no single line: {case.err[-300:]!r}")
    elif not case.status and not writer.always and _names(now) != _names(after):
        found.append(f"exit 0 without {sorted(_names(after) ^ _names(now))}")
    elif (
        not case.status
        and not writer.always
        and any(now[n] == b and after[n] != b for n, b in before.items() if n in after)
    ):
        found.append("exit 0, but the old file is there")
    if error == SHORT and case.status:
        found.append(f"a short write is no error: {case.err.strip()}")
    return found
