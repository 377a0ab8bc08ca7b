"""Recordings side by side on all cores: a plant's machine code and numpy's loops run outside Python's lock.

Results come in the order of the recordings and are summed in this order, so that they do not depend on the
number of cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

LEAST = (
    200_000  # numbers that a run computes, about a millisecond: less is not worth the way to another thread
)

T = TypeVar("T")
R = TypeVar("R")


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of this process; a forked one has none of its parent's."""
    return ThreadPoolExecutor(_cores(), thread_name_prefix=f"recordings-{process}")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(f: Callable[[T], R], items: Sequence[T], numbers: int) -> list[R]:
    """Return f of each item, side by side if `numbers`, the count that all of them compute, is large.

    f must not call `each`. The first item's exception is raised."""
    if len(items) < 2 or numbers < LEAST or _cores() == 1:
        return [f(x) for x in items]
    return list(_pool(os.getpid()).map(f, items))
