"""One diagnosis on the workers of a Dask cluster: a task a recording, with the same result as on one machine.

A worker keeps its recordings' part of a problem (`Problem.alone`). Dask gives the tasks of a worker that died
to another one, and sends it these parts again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from thermoctl.diagnosis.threads import one_thread
from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.fitting.cores import elsewhere

CONNECT_S = 20.0  # longest wait for the scheduler

R = TypeVar("R")


class DaskWorkers:
    """The workers behind a Dask client."""

    def __init__(self, client: Any):
        self.client = client

    def hold(self, thing: Any) -> Any:
        """Return the future of an object. The scheduler keeps its bytes, and can make it again."""
        return self.client.submit(_same, thing, pure=False)

    def each(self, f: Callable[..., R], held: Sequence[Any], arguments: Iterable[tuple[Any, ...]]) -> list[R]:
        """Return f(object, *arguments) of each future, in their order."""
        tasks = [
            self.client.submit(_called, f, thing, *given, pure=False)
            for thing, given in zip(held, arguments, strict=True)
        ]
        return list(self.client.gather(tasks))


def _same(thing: R) -> R:
    return thing


def _called(f: Callable[..., R], *arguments: Any) -> R:
    with one_thread():
        return f(*arguments)


@contextmanager
def cluster(scheduler: str | None) -> Iterator[None]:
    """Compute by recording on the workers of the scheduler at this address, if there is one.

    Raises InputError where Dask is missing, or nothing answers at the address."""
    if not scheduler:
        yield
        return
    distributed = load("distributed", "one diagnosis on many machines")
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError, TimeoutError) as e:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({e})") from None
    with client, elsewhere(DaskWorkers(client)):
        yield
