"""Every writer under every I/O error at every call: `python -m tests.disk.run [--page FILE] [--every N] [WORD ...]`.

On tmpfs (/dev/shm) and on an ext4 image, which takes root and a loop device; without them the page says so. Words choose writers.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.disk.harness import ERRORS, Result, preloaded, sweep

IMAGE_MB = 96
SYSTEMS = ("tmpfs", "ext4")


@contextmanager
def memory() -> Iterator[Path]:
    """A folder on tmpfs."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as place:
        yield Path(place)


@contextmanager
def ext4() -> Iterator[Path | str]:
    """A folder on a fresh ext4 image; or the reason why there is none."""
    if os.geteuid() or not shutil.which("mkfs.ext4"):
        yield "not run: needs root, mkfs.ext4 and a loop device"
        return
    with tempfile.TemporaryDirectory() as base:
        image, place = Path(base) / "image", Path(base) / "mount"
        place.mkdir()
        with image.open("wb") as file:
            file.truncate(IMAGE_MB * 1_000_000)
        subprocess.run(["mkfs.ext4", "-q", str(image)], check=True)
        done = subprocess.run(["mount", "-o", "loop", str(image), str(place)], capture_output=True, text=True)
        if done.returncode:
            yield f"not run: {done.stderr.strip()}"
            return
        try:
            yield place
        finally:
            subprocess.run(["umount", "-l", str(place)], check=True)


def table(results: list[Result]) -> list[str]:
    """The table of one file system: cases by writer and error."""
    lines = [
        "| writer | calls | " + " | ".join(ERRORS.values()) + " | refused | wrong |",
        "|---" * (len(ERRORS) + 4) + "|",
    ]
    for r in results:
        cells = " | ".join(str(r.cases[e] or "-") for e in ERRORS)
        lines.append(f"| {r.name} | {r.calls} | {cells} | {r.refused} | {len(r.faults)} |")
    cells = " | ".join(str(sum(r.cases[e] for r in results)) for e in ERRORS)
    wrong, refused = sum(len(r.faults) for r in results), sum(r.refused for r in results)
    lines.append(f"| **all** | {sum(r.calls for r in results)} | {cells} | {refused} | {wrong} |")
    return lines


PAGE = """\
<!-- Written by `make disk`. -->
# Writers under I/O errors

Each writer of the program, with an error at its n-th file operation, for every n. A case is right if

- every file that was there is there, byte for byte the old one or the new one, and its reader reads it;
- every new file is whole, as its reader finds, or absent; no temporary file is left where the disk lets it be deleted;
- the command ends with one line that says why, or succeeds with the new file; what it acknowledged is there;
- the recorder: no row is missing that is not counted as lost, each loss has its reason, no old file goes but by the budget.

"refused": cases that ended with an error and its line; the others succeeded, were killed, or are the daemon's, which go on. "-": no such
call. "full": ENOSPC for what takes space, after a first half write. "EIO": every call, also sync, close, rename and delete. "kill inside": half of
the write is on the disk. A diagnosis is written over an older one by renames: kill -9 between two of them leaves whole files of both.

"""


def on(name: str, args: argparse.Namespace) -> int:
    """Sweep on one file system; print the results, write its section of the page; 1 where a case is wrong."""
    from tests.disk import writers as product

    chosen = [w for w in product.writers() if not args.words or any(word in w.name for word in args.words)]
    if any("diagnose" in w.name or "Diagnosis" in w.name for w in chosen):
        product.prepare_diagnosis()
    started, results = time.monotonic(), []
    with memory() if name == "tmpfs" else ext4() as place:
        if isinstance(place, str):
            print(f"{name}: {place}")
            Path(args.section).write_text(f"## {name}\n{place}\n\n")
            return 0
        for writer in chosen:
            begin = time.monotonic()
            results.append(sweep(writer, place / "sweep", args.every))
            r = results[-1]
            cases = sum(r.cases.values())
            print(
                f"{name}: {r.name}: {cases} cases, {len(r.faults)} wrong, {time.monotonic() - begin:.0f} s",
                flush=True,
            )
            for fault in r.faults[:6]:
                print(f"    {fault}", flush=True)
    cases, faults = sum(sum(r.cases.values()) for r in results), sum(len(r.faults) for r in results)
    print(f"{name}: {cases} cases, {faults} wrong, {time.monotonic() - started:.0f} s")
    text = f"## {name}\n{cases} cases, {faults} wrong.\n\n" + "\n".join(table(results)) + "\n\n"
    Path(args.section).write_text(text, encoding="utf-8")
    return 1 if faults else 0


def main() -> int:
    """Sweep on both file systems at once; write the page where one is named; 1 where a case is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--page")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--on", choices=SYSTEMS)
    parser.add_argument("--section")
    args = parser.parse_args()
    if args.on:
        preloaded(["-m", "tests.disk.run", *sys.argv[1:]])
        return on(args.on, args)
    with tempfile.TemporaryDirectory() as folder:
        sections = [Path(folder) / name for name in SYSTEMS]
        running = [
            subprocess.Popen(
                [sys.executable, "-m", "tests.disk.run", *sys.argv[1:], "--on", s.name, "--section", str(s)]
            )
            for s in sections
        ]
        codes = [process.wait() for process in running]
        if args.page and all(s.exists() for s in sections):
            text = PAGE + "".join(s.read_text(encoding="utf-8") for s in sections)
            Path(args.page).write_text(text.rstrip() + "\n", encoding="utf-8")
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
