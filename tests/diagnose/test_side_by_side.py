"""Refits that run side by side: the result is that of one core, and a queue may grow while it is worked off."""

from __future__ import annotations

import json
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tests.plants import ONE_BLOCK, radiating
from thermoctl.diagnosis.run import diagnose
from thermoctl.diagnosis.search import refits
from thermoctl.plant import loads
from thermoctl.plant.fitting import cores
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def test_one_core_and_two_write_the_same_bytes(tmp_path, monkeypatch):
    plant, tables = radiating(tmp_path, recordings=1)
    written, threads = [], []
    for n in (1, 2):
        monkeypatch.setattr(cores, "_cores", lambda n=n: n)
        cores._pool.cache_clear()
        seen = set[int]()
        side_by_side = cores.each

        def each(f, items, *numbers, seen=seen, side_by_side=side_by_side):
            return side_by_side(lambda x: (seen.add(threading.get_ident()), f(x))[1], items, *numbers)

        with monkeypatch.context() as patch:
            patch.setattr(refits, "each", each)
            diagnose(plant, tables, tmp_path / f"out{n}")
        threads.append(len(seen))
        found = json.loads((tmp_path / f"out{n}" / "diagnosis.json").read_text())
        found.pop("seconds")
        written.append((found, (tmp_path / f"out{n}" / "plant.yaml").read_bytes()))
    cores._pool.cache_clear()
    assert threads[0] == 1 < threads[1]  # a single item stays in the thread that asks
    assert len(written[0][0]["hypotheses"]) > 3
    assert written[0] == written[1]


def test_batches_take_what_is_wanted_from_a_queue_that_grows():
    queue, taken = [1, 2, 3, 4, 5], []
    for batch, left in cores.batches(queue, lambda x: x % 2 == 1):
        taken.append((batch, left))
        if batch[0] == 1:
            queue.append(7)
    assert taken == [([1], 4), ([3, 5], 1), ([7], 0)]


def test_items_that_are_split_again_are_taken_one_after_the_other(monkeypatch):
    """More items than threads, each of which waits for others: without the rule none would ever end."""
    monkeypatch.setattr(cores, "_cores", lambda: 2)
    cores._pool.cache_clear()
    found = cores.each(
        lambda x: sum(cores.each(lambda y: x * y, range(4), cores.LEAST)), range(8), cores.LEAST
    )
    cores._pool.cache_clear()
    assert found == [6 * x for x in range(8)]


def test_two_threads_respond_for_one_recording_with_a_delayed_output():
    """Both wrote into one buffer: five of 80 responses were wrong."""
    model, t = (
        compile_plant(loads(ONE_BLOCK.replace("value: block,", "value: 'delay(block, 8)',"))),
        np.arange(3000.0),
    )
    columns = {"heat": 9 * np.sin(t / 50) ** 2, "air": 20 + 0 * t, "temperature": 20 + 0 * t}
    d = model.prepare(model.excitation(Table("run", "", t, columns)))
    flows = np.random.default_rng(0).standard_normal((8, 3000, 96))
    buffers = {}

    def response(q):
        """Return the sum of the responses to flows (N, 96)."""
        return model.respond(d, None, None, [(0, k) for k in range(96)], q, 96, buffers=buffers).sum()

    alone = list(map(response, flows))
    with ThreadPoolExecutor(2) as pool:
        assert [list(pool.map(response, flows)) for _ in range(10)] == [alone] * 10
