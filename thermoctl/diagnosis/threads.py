"""One thread for linear algebra: sums in parts differ in their last digits with the number of threads."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

MAPS = Path("/proc/self/maps")  # the libraries of this process (Linux)


def _controls() -> list[tuple[Callable[..., int], Callable[..., int]]]:
    """Return get and set of the thread count of each OpenBLAS: numpy and scipy each load a copy."""
    files = (
        {line.split()[-1] for line in MAPS.read_text().splitlines() if "openblas" in line}
        if MAPS.exists()
        else set()
    )
    controls = []
    for file in sorted(files):
        library = ctypes.CDLL(file)
        for prefix in ("", "scipy_"):
            for suffix in ("", "64_"):
                get = getattr(library, f"{prefix}openblas_get_num_threads{suffix}", None)
                put = getattr(library, f"{prefix}openblas_set_num_threads{suffix}", None)
                if get and put:
                    controls.append((get, put))
    return controls


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep linear algebra to one thread, so that a result does not depend on their number."""
    controls = _controls()
    before = [get() for get, _ in controls]
    for _, put in controls:
        put(1)
    try:
        yield
    finally:
        for (_, put), n in zip(controls, before, strict=True):
            put(n)
