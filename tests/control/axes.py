"""What axes of a rig have in common, as scenarios: a fault of one disarms another or not, a sensor of all reaches all.

Each takes the code: `Axis` of loop.py, `guard` of processes.py, `AxisBackend` of axes.py of hal, and channels.py. The tests run them on
the product, mutants.py on every small change of MUTATED.
"""

from __future__ import annotations

import ast
import sys
import types
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import thermoctl_hal.rig.axes
from thermoctl.control import arming, faults
from thermoctl.control.model import Parameters, zero_model
from thermoctl.daemon import processes
from thermoctl.daemon.tick import loop
from thermoctl.daemon.tick.ring import Mailbox
from thermoctl.rig import channels
from thermoctl.rig.channels import AT, COIL
from thermoctl.rig.signals import AT as SIGNAL_AT
from thermoctl.rig.signals import fault_word
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, OK, Sample

MUTATED = (
    (Path(loop.__file__).with_name("loop.py"), ("for other in self.guards:", "trips_others")),
    (Path(processes.__file__), ("guard",)),
    (Path(thermoctl_hal.rig.axes.__file__), ("__init__", "read", "write", "problem")),
    (Path(channels.__file__), ("names", "index", "parts", "copies")),
)
"""Files and their functions: of channels.py those of AxesChannels."""
PERIOD_S, READY = 1e-3, arming.STATES.index("READY")


def build(trees: dict[str, ast.Module]) -> SimpleNamespace:
    """The code, each file of MUTATED run by the interpreter as a module of its own; `trees` replaces the source of one."""
    made = {}
    for path, _ in MUTATED:
        module = types.ModuleType(f"mutant_{path.stem}")
        module.__file__ = str(path)
        sys.modules[module.__name__] = module  # dataclass looks it up
        exec(
            compile(trees.get(path.stem) or ast.parse(path.read_text()), module.__file__, "exec"),
            vars(module),
        )
        made[path.stem] = module
    return SimpleNamespace(
        Axis=made["loop"].Axis,
        guard=made["processes"].guard,
        AxisBackend=made["axes"].AxisBackend,
        channels=made["channels"],
    )


PRODUCT = SimpleNamespace(
    Axis=loop.Axis, guard=processes.guard, AxisBackend=thermoctl_hal.rig.axes.AxisBackend, channels=channels
)


class Still:
    """A back end whose stage stands still and whose amplifier obeys."""

    def __init__(self) -> None:
        self.sample, self.lost, self.refuses = Sample(COIL + 1), False, False
        self.sample.value[:], self.sample.status[:], self.sample.time_s[:] = 20.0, OK, 0.0
        self.sample.value[AT["amplifier_state"]], self.sample.value[AT["amplifier_fault"]] = AMP_DISABLED, 0.0
        self.sample.value[AT["current_a"]] = self.sample.value[AT["voltage_v"]] = 0.0
        self.enable = False

    def read(self, now_s: float) -> Sample:
        self.sample.fresh[:] = True
        self.sample.value[AT["position_um"]] = np.nan if self.lost else 0.0
        return self.sample

    def write(self, drive: float, enable: bool) -> None:
        self.enable = enable
        self.sample.value[AT["amplifier_state"]] = AMP_ENABLED if enable else AMP_DISABLED
        if self.refuses:
            raise OSError

    def problem(self, role: str) -> str:
        return ""


class Bench:
    """So many axes that stand still; `policy`: on_other_axis_fault of each."""

    def __init__(self, code: Any, *policy: str) -> None:
        n = COIL + 1
        limits = {name: np.full(n, np.inf) for name in ("rate", "stale_s", "frozen_s")}
        required = np.zeros(n)
        required[AT["position_um"]] = 1.0
        parameters = Parameters(
            0.01, 0.01, 0.0, 1.0, low=np.full(n, -1e3), high=np.full(n, 1e3), required=required, **limits
        )
        points = channels.of_points([channels.Point("coil", role="coil")])
        self.stills = [Still() for _ in policy]
        self.rigs = [
            code.Axis(
                still,
                zero_model(PERIOD_S, ("coil",)),
                parameters,
                PERIOD_S,
                lambda row: None,
                Mailbox(np.zeros(2, np.uint64), np.zeros((64, 2))),
                channels=points,
            )
            for still in self.stills
        ]
        code.guard(
            self.rigs, [SimpleNamespace(protection=SimpleNamespace(on_other_axis_fault=p)) for p in policy]
        )
        self.now_s = 0.0
        self.tick(130)
        assert self.states() == ["READY"] * len(policy), (
            self.states(),
            [self.faults(k) for k in range(len(policy))],
        )

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.now_s += PERIOD_S
            for rig in self.rigs:
                rig.tick(self.now_s, PERIOD_S)

    def send(self, axis: int, command: str) -> None:
        assert self.rigs[axis].mailbox.push(float(arming.COMMANDS.index(command)), 0.0)
        self.tick()

    def arm(self, *axes: int) -> None:
        for axis in axes:
            self.send(axis, "arm")
        self.tick(5)
        assert all(self.states()[a] == "ARMED" for a in axes)

    def states(self) -> list[str]:
        return [arming.STATES[int(rig.row[SIGNAL_AT["state"]])] for rig in self.rigs]

    def faults(self, axis: int) -> set[str]:
        return {f.name for f in faults.decode(fault_word(self.rigs[axis].row))}

    def drives(self) -> list[bool]:
        return [still.enable for still in self.stills]


def a_fault_disarms_the_axis_after_it_in_the_same_tick(code: Any) -> None:
    bench = Bench(code, "disarm", "disarm")
    bench.arm(0, 1)
    bench.stills[0].lost = True
    while bench.states()[0] == "ARMED":
        bench.tick()
    assert bench.states() == ["FAULT", "FAULT"] and bench.drives() == [False, False]
    assert "other_axis" not in bench.faults(0) and bench.faults(1) == {"other_axis"}


def a_fault_disarms_the_axis_before_it_one_tick_later(code: Any) -> None:
    bench = Bench(code, "disarm", "disarm")
    bench.arm(0, 1)
    bench.stills[1].lost = True
    while bench.states()[1] == "ARMED":
        bench.tick()
    assert bench.states()[0] == "ARMED"
    bench.tick()
    assert (
        bench.states()[0] == "FAULT"
        and bench.faults(0) == {"other_axis"}
        and bench.drives() == [False, False]
    )


def an_axis_goes_on_where_it_is_told_to(code: Any) -> None:
    bench = Bench(code, "go_on", "disarm", "go_on")
    bench.arm(0, 1, 2)
    bench.stills[2].lost = True
    bench.tick(20)
    assert bench.states() == ["ARMED", "FAULT", "FAULT"] and bench.drives() == [True, False, False]
    assert not bench.faults(0) and not bench.rigs[0].guards and len(bench.rigs[1].guards) == 2


def no_axis_waits_for_itself(code: Any) -> None:
    bench = Bench(code, "disarm", "disarm")
    bench.arm(0)
    bench.stills[0].lost = True
    bench.tick(20)
    assert bench.states()[0] == "FAULT" and "other_axis" not in bench.faults(0)
    bench.stills[0].lost = False
    bench.tick(5)
    bench.send(0, "disarm")
    bench.tick(2)
    assert bench.states()[0] == "READY"


def a_disarmed_axis_waits_for_the_one_that_stands(code: Any) -> None:
    bench = Bench(code, "disarm", "disarm")
    bench.arm(0, 1)
    bench.stills[0].lost = True
    bench.tick(20)
    bench.send(1, "disarm")
    bench.tick(2)
    assert bench.states() == ["FAULT", "SAFE"] and bench.faults(1) == {"other_axis"}
    bench.send(1, "arm")
    bench.tick(2)
    assert bench.states() == ["FAULT", "SAFE"] and not bench.drives()[1]
    bench.stills[0].lost = False
    bench.tick(5)
    bench.send(0, "disarm")
    bench.tick(3)
    assert bench.states() == ["READY", "READY"] and not bench.faults(1)


def two_axes_in_fault_do_not_wait_for_each_other(code: Any) -> None:
    for first in (0, 1):
        bench = Bench(code, "disarm", "disarm")
        bench.arm(0, 1)
        for still in bench.stills:
            still.lost = True
        bench.tick(20)
        assert bench.states() == ["FAULT", "FAULT"]
        for still in bench.stills:
            still.lost = False
        bench.tick(5)
        bench.send(first, "disarm")
        bench.send(1 - first, "disarm")
        bench.tick(3)
        assert bench.states() == ["READY", "READY"]


def a_fault_taken_over_is_handed_to_nobody(code: Any) -> None:
    """Axis 1 is in FAULT only because of axis 0: with axis 0 acknowledged it stops nobody."""
    bench = Bench(code, "disarm", "disarm")
    bench.arm(0, 1)
    bench.stills[0].lost = True
    bench.tick(20)
    bench.stills[0].lost = False
    bench.tick(5)
    bench.send(0, "disarm")
    bench.tick(3)
    assert bench.states() == ["READY", "FAULT"] and not bench.rigs[1].trips_others()
    bench.arm(0)
    assert bench.states() == ["ARMED", "FAULT"]


def an_axis_that_was_not_armed_stops_nobody(code: Any) -> None:
    bench = Bench(code, "disarm", "disarm")
    bench.stills[0].lost = True
    bench.tick(20)
    assert bench.states() == ["SAFE", "READY"] and bench.faults(0) and not bench.faults(1)
    bench.arm(1)


def a_failed_write_is_kept_beside_it(code: Any) -> None:
    bench = Bench(code, "disarm", "disarm")
    bench.arm(0, 1)
    bench.stills[1].lost = bench.stills[0].refuses = True
    bench.tick(
        2
    )  # the write fails at the end of the first, and is known in the second with the other's fault
    assert bench.states() == ["FAULT", "FAULT"] and bench.faults(0) == {"amplifier_write", "other_axis"}


def each_axis_has_its_part_of_the_sample(code: Any) -> None:
    """Two axes of one and two points; the air is everybody's, the temperatures are each axis' own."""
    point = code.channels.Point
    own = {
        "x": code.channels.of_points([point("coil", role="coil")]),
        "y": code.channels.of_points([point("coil", role="coil"), point("frame")]),
        "z": code.channels.of_points([point("coil", role="coil")]),
    }
    union = code.channels.AxesChannels((), tuple(own.items()), ("air_c", "supply_v"))
    sizes = [len(c.names) for c in own.values()]
    assert union.names == tuple(f"{a}.{r}" for a, c in own.items() for r in c.names)
    assert [union.index[n] for n in union.names] == list(range(sum(sizes)))
    assert union.index["air_c"] == union.index["x.air_c"] and "coil_c" not in union.index
    assert union.copies("air_c") == [union.index["y.air_c"], union.index["z.air_c"]]
    assert union.copies("x.coil_c") == union.copies("y.frame_c") == []
    starts = np.cumsum([0, *sizes])
    assert list(union.parts.values()) == [
        slice(int(a), int(b)) for a, b in zip(starts[:-1], starts[1:], strict=True)
    ]

    class Devices:
        """What AxisBackend takes of DevicesBackend."""

        sample, said = Sample(sum(sizes)), list[object]()

        def __getattr__(self, name: str) -> Any:
            return lambda *given: self.said.append((name, *given)) or f"{name} {given}"

    devices: Any = Devices()
    backends = {a: code.AxisBackend(devices, union, a) for a in own}
    for k in range(sum(sizes)):
        devices.sample.value[k], devices.sample.time_s[k] = k, 100 + k
        devices.sample.fresh[k], devices.sample.status[k] = k % 2, k % 4
    for axis, backend in backends.items():
        seen, part = backend.read(1.5), union.parts[axis]
        assert devices.said.count(("read", 1.5)) == 1, "the first axis reads for all"
        for field in ("value", "time_s", "fresh", "status"):
            assert np.array_equal(getattr(seen, field), getattr(devices.sample, field)[part])
            assert np.shares_memory(getattr(seen, field), getattr(devices.sample, field))
        backend.write(0.25, True)
        assert backend.problem("coil_c") == f"problem ('{axis}.coil_c',)"
        for name in ("open", "close", "counters", "check_pacing", "wait_frame"):
            getattr(backend, name)()
    assert [c for c in devices.said if c[0] == "write"] == [("write", 0.25, True, k) for k in range(3)]
    assert [c[0] for c in devices.said if len(c) == 1] == 3 * [
        "open",
        "close",
        "counters",
        "check_pacing",
        "wait_frame",
    ]


SCENARIOS = (
    a_fault_disarms_the_axis_after_it_in_the_same_tick,
    a_fault_disarms_the_axis_before_it_one_tick_later,
    an_axis_goes_on_where_it_is_told_to,
    no_axis_waits_for_itself,
    a_disarmed_axis_waits_for_the_one_that_stands,
    two_axes_in_fault_do_not_wait_for_each_other,
    a_fault_taken_over_is_handed_to_nobody,
    an_axis_that_was_not_armed_stops_nobody,
    a_failed_write_is_kept_beside_it,
    each_axis_has_its_part_of_the_sample,
)
