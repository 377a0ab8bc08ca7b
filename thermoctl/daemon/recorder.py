"""The recorder process: moves the ring's rows into a recording, ten times a second.

Nothing waits for it. When it falls behind by more than the ring's length, the lost ticks are counted and
shown by `status`.

A recording holds the effective configuration, the model, the law's parameters, and a state of the law where a
replay starts. A reload starts a new file, so that a file has one set of parameters. The recorder also tests
the innovations, and logs when the model no longer fits.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control import faults
from thermoctl.control.model import ARRAYS, PLAIN, CompensatorModel, Parameters
from thermoctl.daemon.misfit import Misfit
from thermoctl.daemon.tick.shared import RECORDER_LOST, RECORDER_ROWS, RESUMED, Shared
from thermoctl.daemon.unsaved import Unsaved
from thermoctl.rig.signals import AT

INTERVAL_S = 0.1
# Version of the law's inputs, state and arithmetic: a replay is bit for bit only within one version.
LAW_VERSION = 4
_TICK, _GENERATION = AT["tick"], AT["generation"]


def encode(array: np.ndarray) -> str:
    """Return a float64 array as text, without loss."""
    return base64.b64encode(np.ascontiguousarray(array, dtype=np.float64).tobytes()).decode()


def decode(text: str) -> np.ndarray:
    """Return the flat array of a text from `encode`."""
    return np.frombuffer(base64.b64decode(text, validate=True))


def law_metadata(
    model: CompensatorModel,
    parameters: Parameters,
    period_s: float,
    generation: int,
    tick: int,
    state: np.ndarray | None,
) -> str:
    """Return the data that a replay needs besides the rows, as JSON.

    These are the model, the parameters, and the law's state after `tick` (None: a new law)."""
    arrays = {name: getattr(model, name) for name in ARRAYS}
    fields = {name: getattr(model, name) for name in PLAIN}
    fields |= {name: {"shape": a.shape, "values": encode(a)} for name, a in arrays.items()}
    head = {"version": LAW_VERSION, "period_s": period_s, "generation": generation, "tick": tick}
    kept = {"state": None if state is None else encode(state), "parameters": encode(parameters.pack())}
    return json.dumps(head | kept | {"model": fields})


def read_law_metadata(text: str) -> dict[str, Any]:
    """Read the text of `law_metadata`.

    Keys: period_s, generation, tick, state (or None), parameters (Parameters), model (CompensatorModel)."""
    content = json.loads(text)
    if content["version"] != LAW_VERSION:
        raise ValueError(f"law version {content['version']}, this program has version {LAW_VERSION}")
    m = content["model"]
    if unknown := set(m) - {*PLAIN, *ARRAYS}:
        raise ValueError(f"the model has {', '.join(sorted(unknown))}, which this program does not know")
    values: dict[str, Any] = {name: m[name] for name in PLAIN if name in m} | {
        k: tuple(m[k]) for k in ("sensors", "points") if k in m
    }
    values |= {name: decode(m[name]["values"]).reshape(m[name]["shape"]) for name in ARRAYS if name in m}
    model = CompensatorModel(**values)
    return {
        **content,
        "model": model,
        "parameters": Parameters.unpack(decode(content["parameters"])),
        "state": None if content["state"] is None else decode(content["state"]),
    }


class Recorder:
    """Writes rows in order; starts a new file when the generation changes or the writer is full.

    open_writer(law_metadata) returns a writer with write(rows) and close()."""

    def __init__(
        self,
        shared: Shared,
        model: CompensatorModel,
        parameters: Parameters,
        period_s: float,
        open_writer: Callable[[str], Any],
        log: Callable[..., None] = lambda *a, **k: None,
    ):
        self.log = log
        self.misfit: Misfit | None = Misfit(model)
        self.shared, self.model, self.parameters, self.period_s = shared, model, parameters, period_s
        self.open_writer = open_writer
        kept = shared.state.get()
        # Row k of the ring is tick k + 1. A restarted recorder begins after the last saved state.
        self.position = min(shared.ring.head, int(kept[0])) if kept is not None else 0
        self.generation = -1
        self.writer: Any = None

    def move(self) -> int:
        """Write the ring's new rows; return their number."""
        rows, self.position, lost = self.shared.ring.read(self.position)
        self.shared.counters[RECORDER_LOST] += lost
        written, all_rows = len(rows), rows
        while len(rows):
            if self.writer is None or rows[0, _GENERATION] != self.generation:
                self._new_file(rows[0])
            same = int(np.argmin(rows[:, _GENERATION] == self.generation)) or len(rows)
            part, rows = rows[:same], rows[same:]
            split = self._new_file_after(part) if self.writer.full else None
            if split:
                self._write(part[:split])
                self._new_file(part[split])
                part = part[split:]
            self._write(part)
        self.shared.counters[RECORDER_ROWS] += written
        self._watch(all_rows)
        return written

    def _watch(self, rows: np.ndarray) -> None:
        if self.misfit is None:
            return
        try:
            alarm = self.misfit.add(
                rows[:, AT["t_s"]], rows[:, AT["innovation_c"]], rows[:, AT["kalman_gain"]]
            )
        except Exception as e:  # a failing model check must never stop the recording
            self.misfit = None
            self.log("the check of the model failed and is switched off; recording continues", error=repr(e))
            return
        if alarm is not None:
            self.log(
                "the model no longer fits",
                begins_s=round(alarm.begin_s, 1),
                ends_s=round(alarm.end_s, 1),
                mean_innovation_c=round(alarm.mean_c, 3),
                remedy="`thermoctl diagnose --live --out DIR` finds which physics changed",
            )

    def _write(self, rows: np.ndarray) -> None:
        self.shared.counters[RECORDER_LOST] += self.writer.write(rows)

    def _new_file_after(self, rows: np.ndarray) -> int | None:
        """Return the row of `rows` where a new file may begin, or None.

        It follows the newest saved state, so that the file's replay starts there."""
        kept = self.shared.state.get()
        if kept is None:
            return None
        split = int(np.searchsorted(rows[:, _TICK], kept[0], side="right"))
        return split if 0 < split < len(rows) else None

    def _new_file(self, first: np.ndarray) -> None:
        self.close()
        self.generation = int(first[_GENERATION])
        numbers = self.shared.parameters.get()
        if numbers is not None and self.generation > 0:
            self.parameters = Parameters.unpack(numbers)
        kept = self.shared.state.get()
        tick, state = 0, None
        if kept is not None and (first[_TICK] > 1 or self.shared.counters[RESUMED]):
            tick, state = int(kept[0]), kept[2:]
        self.writer = self.open_writer(
            law_metadata(self.model, self.parameters, self.period_s, self.generation, tick, state)
        )

    def close(self) -> None:
        """End the file."""
        if self.writer is not None:
            self.shared.counters[RECORDER_LOST] += self.writer.close()
            self.writer = None


def make_recorder(settings: Settings, shared: Shared, log: Callable[..., None]) -> Recorder:
    """Make the recorder of a daemon.

    Its files hold every option of the configuration in force, and the law's metadata."""
    from thermoctl.configuration.settings import POINTS, effective
    from thermoctl.daemon.tick.assemble import compensator, in_force, law_parameters, rig_identity
    from thermoctl.recording.writer import RecordingWriter

    rig = rig_identity(settings)
    tell = Unsaved(shared, "recording", log)

    def open_writer(law: str) -> RecordingWriter:
        """Return the writer of a new file; `law`: the text of `law_metadata`."""
        metadata = {
            "rig": rig,
            "run": shared.run,
            "config": effective(in_force(settings, shared.parameters.get())),
            "law": law,
            "faults": json.dumps(faults.NAMES),
            POINTS: settings.channels.text(),
        }
        return RecordingWriter(settings.recording, metadata, rig, tell, settings.row.signals)

    return Recorder(
        shared, compensator(settings), law_parameters(settings), settings.loop.period_s, open_writer, log
    )


def record(recorder: Recorder, stopping: Callable[[], bool]) -> None:
    """Record until `stopping()`, then write the rest of the ring."""
    while not stopping():
        recorder.move()
        time.sleep(INTERVAL_S)
    recorder.move()
    recorder.close()
