"""Recordings or refits side by side, on all cores.

A plant's machine code and numpy's loops run outside Python's lock. Results come in the order of the
items and are summed in this order. So they do not depend on the number of cores."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

LEAST = (
    200_000  # numbers that a run computes, about a millisecond: less is not worth the way to another thread
)
# Number of refits, or of chunks of directions, that run in parallel. The result depends on it, because a
# refit ends early if it falls behind earlier ones. So it does not follow the number of cores.
ABREAST = 2
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # options of malloc.h
LARGE = 1 << 30  # bytes
HALF_HEAP = 1 << 25  # bytes; older versions of glibc take no more for the second

T = TypeVar("T")
R = TypeVar("R")

_here = threading.local()


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of this process; a forked one has none of its parent's."""
    return ThreadPoolExecutor(_cores(), thread_name_prefix=f"recordings-{process}", initializer=_entered)


def _entered() -> None:
    """Mark this thread: if it waited for others of its pool, none might be left to compute."""
    _here.inside = True


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(f: Callable[[T], R], items: Sequence[T], numbers: int = LEAST) -> list[R]:
    """Return f of each item, side by side if `numbers`, the count that all of them compute, is large.

    Inside f a call of `each` takes one item after the other. The first item's exception is raised."""
    if len(items) < 2 or numbers < LEAST or _cores() == 1 or getattr(_here, "inside", False):
        return [f(x) for x in items]
    return list(_pool(os.getpid()).map(f, items))


def batches(queue: list[T], wanted: Callable[[T], bool]) -> Iterator[tuple[list[T], int]]:
    """Yield the wanted items of a queue that may grow, and the number left after them.

    The first one is alone, as it may show that no other is wanted. ABREAST at a time follow."""
    position, most = 0, 1
    while position < len(queue):
        batch: list[T] = []
        while position < len(queue) and len(batch) < most:
            batch += [queue[position]] if wanted(queue[position]) else []
            position += 1
        if batch:
            yield batch, len(queue) - position
            most = ABREAST


def reuse_memory() -> None:
    """Let the C library (glibc) use freed arrays again, until they are given back.

    By default it returns each large array at once: the system then clears the same pages again and again."""
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option:
        set_option(TRIM_THRESHOLD, LARGE)
        set_option(MMAP_THRESHOLD, LARGE) or set_option(MMAP_THRESHOLD, HALF_HEAP)


def give_back() -> None:
    """Give freed memory back to the system, where the C library can (glibc).

    Each thread has a heap of its own, which it keeps at its largest size otherwise."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:
        trim(0)
