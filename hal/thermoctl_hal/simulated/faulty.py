"""Fault injection: a wrapper around any back end, on a schedule of the configuration, for tests and drills.

    faults:
      - {kind: freeze, role: coil_c, at_s: 10, for_s: 5}

`at_s` counts from the first read; without `for_s` a fault never ends. `role` may be a list, or `all`. Kinds:
    drop        readings do not arrive (with `probability`); STALE when older than `stale_after_s`
    delay       readings arrive `by` seconds late
    duplicate   every tick gives the last reading again as new
    corrupt     a random bit of the reading is flipped (with `probability`)
    freeze      the value stays, time stamps go on
    nan         readings are NaN and claim to be OK
    step        `by` is added;   drift: `by` a second is added;   set: the value is `by`
    swap        the first two roles change places
    error       the device reports an error
    disconnect  error, and commands do not arrive: the amplifier stops by its own watchdog
    stuck       the amplifier drives `by`, whatever its command is (no role)
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.files.yamlfile import Node, Section, suggest
from thermoctl.rig.channels import AT, DEFAULT, Channels
from thermoctl_hal.base.backend import ABSENT, ERROR, OK, STALE, Backend, Sample

_KINDS = "drop delay duplicate corrupt freeze nan step drift set swap error disconnect stuck"
KINDS = tuple(_KINDS.split())
SWAPPED = 2  # roles of a swap
MAX_DELAYED = 100_000  # readings of one role that wait for their delay


@dataclass(frozen=True)
class Fault:
    """One entry of the schedule; active while at_s <= t < until_s."""

    kind: str
    roles: tuple[int, ...]
    at_s: float
    until_s: float
    by: float = 0.0
    probability: float = 1.0
    stale_after_s: float = 0.05


def schedule(nodes: Iterable[Node], channels: Channels = DEFAULT) -> list[Fault]:
    """Read `hal.faults` of a rig with these channels. Raises InputError with file and line."""
    faults = []
    for node in nodes:
        s = Section(node, "fault")
        kind = s.text("kind", choices=KINDS)
        at = s.number("at_s", 0.0, 0.0)
        until = at + s.number("for_s", math.inf if s.get("for_s", False) is None else None, 0.0)
        fault = Fault(
            kind,
            _roles(s, kind, channels.index),
            at,
            until,
            s.number("by", 0.0),
            s.number("probability", 1.0, 0.0, 1.0),
            s.number("stale_after_s", 0.05, 0.0),
        )
        if kind in ("step", "drift", "set", "delay") and s.get("by", False) is None:
            raise node.error(f"{kind}: 'by' is missing")
        if kind == "delay" and fault.by <= 0.0:
            raise node.error("delay: 'by' must be above 0 s")
        if kind == "swap" and len(fault.roles) != SWAPPED:
            raise node.error("swap: two roles were expected")
        s.end()
        faults.append(fault)
    return faults


def _roles(s: Section, kind: str, known: Mapping[str, int]) -> tuple[int, ...]:
    node = s.get("role", kind != "stuck")
    if node is None:
        return ()
    names = [n.value for n in node.value] if isinstance(node.value, list) else [node.value]
    if names == ["all"]:
        return tuple(range(len(known)))
    for name in names:
        if name not in known:
            raise node.error(
                f"role: '{name}' is no role{suggest(str(name), known)}; roles: all, {', '.join(known)}"
            )
    return tuple(known[n] for n in names)


class FaultInjector:
    """`thermoctl_hal.base.backend.Backend` that injects faults into another one; seeded, deterministic."""

    def __init__(
        self, inner: Backend, faults: Iterable[Fault], seed: int = 0, channels: Channels = DEFAULT
    ) -> None:
        self.inner: Any = inner
        self.faults = list(faults)
        self.roles = channels.index
        self.sample = Sample(len(channels.names))
        self._random = np.random.default_rng(seed)
        self._start_s = math.nan
        self._t = 0.0
        # The sample before this read.
        self._value, self._time_s = self.sample.value.copy(), self.sample.time_s.copy()
        self._held: dict[tuple[int, int], float] = {}  # (fault, role) -> frozen value
        self._late: dict[tuple[int, int], deque[tuple[float, float]]] = {}

    def open(self) -> None:
        """Open the inner back end; the schedule starts with the first read."""
        self.inner.open()
        self._start_s = math.nan

    def read(self, now_s: float) -> Sample:
        """Read the inner back end and apply the active faults."""
        inner, out = self.inner.read(now_s), self.sample
        if math.isnan(self._start_s):
            self._start_s = now_s
        self._t = now_s - self._start_s + 1e-9  # a time on a tick's edge belongs to that tick
        self._value[:], self._time_s[:] = out.value, out.time_s
        np.copyto(out.value, inner.value, where=inner.fresh)
        np.copyto(out.time_s, inner.time_s, where=inner.fresh)
        out.fresh[:], out.status[:] = inner.fresh, inner.status
        for number, fault in enumerate(self.faults):
            if not fault.at_s <= self._t < fault.until_s:
                for role in fault.roles:
                    self._held.pop((number, role), None)
                    self._late.pop((number, role), None)
            elif fault.kind == "swap":
                self._swap(inner, *fault.roles)
            elif fault.kind != "stuck":
                for role in fault.roles:
                    if inner.status[role] != ABSENT:
                        getattr(self, f"_{fault.kind}")(fault, number, role, now_s)  # every kind is a method
        return out

    def write(self, drive: float, enable: bool) -> None:
        """Send the command, changed by the active faults."""
        for fault in self.faults:
            if fault.at_s <= self._t < fault.until_s:
                if fault.kind == "stuck":
                    drive, enable = fault.by, True
                elif fault.kind == "disconnect" and AT["amplifier_state"] in fault.roles:
                    drive, enable = 0.0, False
        self.inner.write(drive, enable)

    def check_pacing(self) -> None:
        """Raise InputError when no device of the inner back end can start the ticks."""
        self.inner.check_pacing()

    def wait_frame(self, due_ns: int, until_ns: int) -> None:
        """Wait for the inner back end: a fault changes the reading, not its time."""
        self.inner.wait_frame(due_ns, until_ns)

    def close(self) -> None:
        """Close the inner back end."""
        self.inner.close()

    def problem(self, role: str) -> str:
        """Name the injected fault, else the inner back end's problem."""
        for fault in self.faults:
            if self.roles[role] in fault.roles and fault.at_s <= self._t < fault.until_s:
                return f"{role}: injected fault: {fault.kind}"
        return self.inner.problem(role)

    def counters(self) -> dict[str, int]:
        """Return the inner back end's counters."""
        return self.inner.counters()

    def _swap(self, inner: Sample, a: int, b: int) -> None:
        out = self.sample
        pairs = ((out.value, inner.value), (out.time_s, inner.time_s), (out.fresh, inner.fresh))
        for changed, true in (*pairs, (out.status, inner.status)):
            changed[a], changed[b] = true[b], true[a]

    def _hit(self, fault: Fault) -> bool:
        return fault.probability >= 1.0 or self._random.random() < fault.probability

    def _drop(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        out = self.sample
        if out.fresh[role] and self._hit(fault):
            out.value[role], out.time_s[role], out.fresh[role] = self._value[role], self._time_s[role], False
        if now_s - out.time_s[role] > fault.stale_after_s:
            out.status[role] = STALE

    def _delay(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        out = self.sample
        late = self._late.setdefault((number, role), deque(maxlen=MAX_DELAYED))
        if out.fresh[role]:
            late.append((out.value[role], out.time_s[role]))
        out.fresh[role] = False
        while late and now_s - late[0][1] >= fault.by - 1e-9:
            value, _ = late.popleft()
            self._held[number, role] = value
            out.fresh[role] = True
            out.time_s[role] = now_s  # a delayed reading appears new: this is the hazard
        out.value[role] = self._held.get((number, role), self._value[role])

    def _duplicate(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        out = self.sample
        if math.isfinite(out.value[role]):
            out.fresh[role], out.time_s[role], out.status[role] = True, now_s, OK

    def _corrupt(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        if self.sample.fresh[role] and self._hit(fault):
            bits = self.sample.value[role : role + 1].view(np.uint64)
            bits ^= np.uint64(1) << np.uint64(self._random.integers(64))

    def _freeze(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        self.sample.value[role] = self._held.setdefault((number, role), float(self.sample.value[role]))

    def _nan(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        self.sample.value[role] = math.nan

    def _step(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        if self.sample.fresh[role]:
            self.sample.value[role] += fault.by

    def _drift(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        if self.sample.fresh[role]:
            self.sample.value[role] += fault.by * (self._t - fault.at_s)

    def _set(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        self.sample.value[role] = fault.by

    def _error(self, fault: Fault, number: int, role: int, now_s: float) -> None:
        self.sample.fresh[role], self.sample.status[role] = False, ERROR

    _disconnect = _error
