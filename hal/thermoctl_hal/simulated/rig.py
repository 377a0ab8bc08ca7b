"""The simulated rig: a plant file as hardware, deterministic, at any speed.

The plant advances in periods of the loop, with the command held. A sensor reads the plant's output plus
noise, rounded to the sensor's resolution; the plant file gives both. Encoders are read every period, slow
sensors every `sensor_period_s`. The same seed and the same commands at the same times give the same bits.

`hal.truth` may name another plant file than the one of the compensator, to simulate an effect that the model
lacks. An output has the role of its own name, or the one that `hal.roles` gives it. The plant's other inputs
(the chamber's air) follow `hal.inputs`:

    mean + swing * sin(2 pi t / period_s)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.files.yamlfile import InputError, Node, Section, suggest
from thermoctl.plant import load
from thermoctl.plant.language import SensorNoise
from thermoctl.plant.simulation.sensor import SlowError
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.rig.channels import AT, DEFAULT, Channels
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, ERROR, OK, STALE, Sample

MAX_CATCH_UP = 1000  # periods in one read; when the clock jumps further (suspend), the plant skips that time
SLOWEST_S = 3600.0  # longest time constant of a simulated 1/f error; slower parts count as offset
_STATE, _FAULT = AT["amplifier_state"], AT["amplifier_fault"]
EVERY_PERIOD = ("position_um", "output_reference_um", "voltage_v", "current_a")


@dataclass(frozen=True)
class Surrounding:
    """A plant input that is not commanded, and the sensor that measures it."""

    mean: float
    swing: float = 0.0
    period_s: float = 86400.0
    noise: float = 0.0
    resolution: float = 0.0

    def at(self, t: float) -> float:
        """Return the value t seconds after the start."""
        return self.mean + self.swing * math.sin(2 * math.pi * t / self.period_s)


def surroundings(node: Node | None) -> dict[str, Surrounding]:
    """Read `hal.inputs`: name -> {mean, swing, period_s, noise, resolution}. Raises InputError."""
    if node is None:
        return {}
    by_name = {}
    for name, item in Section(node, "inputs").node.value.items():
        s = Section(item, name)
        by_name[name] = Surrounding(
            s.number("mean"),
            s.number("swing", 0.0),
            s.number("period_s", 86400.0, 1.0),
            s.number("noise", 0.0, 0.0),
            s.number("resolution", 0.0, 0.0),
        )
        s.end()
    return by_name


class PlantRig:
    """A running plant: `step` advances it, `sense` reads a sensor.

    Used by the simulated back end and by the virtual rig."""

    def __init__(
        self,
        path: str | Path,
        period_s: float,
        drive_input: str,
        surroundings: Mapping[str, Surrounding],
        roles: Mapping[str, str],
        seed: int,
        channels: Channels = DEFAULT,
    ) -> None:
        """Compile the plant and connect its inputs and outputs. Raises InputError when they do not fit.

        surroundings: the plant's inputs other than the command; roles: output -> role where their names
        differ."""
        plant = load(path)
        model = compile_plant(plant, ())
        if drive_input not in model.inputs:
            raise InputError(
                f"{path}: no input '{drive_input}' to drive{suggest(drive_input, model.inputs)}; "
                f"hal.drive_input must be one of {', '.join(model.inputs)}"
            )
        free = [n for n in model.inputs if n != drive_input]
        for name in surroundings:
            if name not in free:
                raise InputError(
                    f"{path}: hal.inputs: the plant has no free input '{name}'{suggest(name, free)}"
                )
        missing = [n for n in free if n not in surroundings]
        if missing:
            raise InputError(f"{path}: hal.inputs must say what {', '.join(missing)} is")
        self._drive = model.inputs.index(drive_input)
        self._surroundings = [(model.inputs.index(n), s) for n, s in surroundings.items()]
        self.u = np.zeros(len(model.inputs))
        for i, s in self._surroundings:
            self.u[i] = s.at(0.0)
        self.stepper = model.stepper(period_s, self.u)
        self._draw = _draws(np.random.default_rng(seed)).__next__
        self.y = self.stepper.step(self.u)
        # Sensors of the surroundings have the numbers after the outputs.
        self.index = _roles_of_outputs(path, model.outputs, roles, channels.names)
        outputs = [plant.outputs[n] for n in model.outputs]
        self._noise = [o.noise.white if isinstance(o.noise, SensorNoise) else o.noise or 0.0 for o in outputs]
        self._noise += [s.noise for _, s in self._surroundings]
        self._slow = {
            i: SlowError(o.noise, period_s, SLOWEST_S, np.random.default_rng([seed, i]))
            for i, o in enumerate(outputs)
            if isinstance(o.noise, SensorNoise)
        }
        self._resolution = [o.resolution or 0.0 for o in outputs] + [
            s.resolution for _, s in self._surroundings
        ]
        for k, name in enumerate(surroundings):
            role = next((r for r in (name, plant.inputs[name].column) if r in channels.names), "")
            if role and role not in self.index:
                self.index[role] = len(outputs) + k

    def step(self, drive: float) -> None:
        """Advance one period with `drive` held."""
        self.u[self._drive] = drive
        for i, s in self._surroundings:
            self.u[i] = s.at(self.stepper.t)
        self.y = self.stepper.step(self.u)

    def sense(self, role: str) -> float:
        """Return the reading of the sensor in this role: output + noise, rounded to its resolution."""
        return self.read_sensor(self.index[role])

    def true(self, role: str) -> float:
        """Return the true value, without noise and rounding."""
        return self._value(self.index[role])

    def _value(self, i: int) -> float:
        n = len(self.y)
        return float(self.y[i] if i < n else self.u[self._surroundings[i - n][0]])

    def read_sensor(self, i: int) -> float:
        """Return the present reading of sensor number i (`index[role]`)."""
        return self.measured(i, self._value(i))

    def measured(self, i: int, value: float) -> float:
        """Return sensor i's reading of a true value: noise added, rounded to its resolution."""
        if self._noise[i]:
            value += self._noise[i] * self._draw()
        if i in self._slow:
            value += self._slow[i].at(self.stepper.t)
        step = self._resolution[i]
        return round(value / step) * step if step else value


def _roles_of_outputs(
    path: str | Path, outputs: Sequence[str], roles: Mapping[str, str], known: Sequence[str]
) -> dict[str, int]:
    """Return role -> number of the plant's output. Raises InputError."""
    index = {}
    for i, name in enumerate(outputs):
        role = roles.get(name, name)
        if role in known:
            index[role] = i
        elif name in roles:
            raise InputError(f"{path}: hal.roles: '{role}' is no role{suggest(role, known)}")
    for name in roles:
        if name not in outputs:
            raise InputError(f"{path}: hal.roles: the plant has no output '{name}'{suggest(name, outputs)}")
    if "position_um" not in index:
        raise InputError(
            f"{path}: no output plays position_um; name one in hal.roles (outputs: {', '.join(outputs)})"
        )
    return index


def _draws(random: np.random.Generator) -> Iterator[float]:
    """Draw standard normal numbers in blocks, which takes a third of the time of single draws."""
    while True:
        yield from random.standard_normal(4096).tolist()


def make_rig(settings: Settings) -> PlantRig:
    """Make the plant that simulates the hardware (`hal.truth`, else `hal.plant`). Raises InputError."""
    hal = settings.hal
    if not (hal.truth or hal.plant):
        raise InputError(
            f"{settings.path}: hal.plant is missing: it names the plant file that is played; the plant's outputs carry the "
            "roles' names, as in config/examples/spindle.plant.yaml (docs/how-to/devices.md#play-your-own-rig)"
        )
    return PlantRig(
        Path(settings.path).parent / (hal.truth or hal.plant),
        settings.loop.period_s,
        hal.drive_input,
        surroundings(hal.inputs),
        hal.roles,
        hal.seed,
        settings.channels,
    )


def simulated_backend(settings: Settings) -> SimulatedBackend:
    """Make the back end `simulated`. Raises InputError."""
    return SimulatedBackend(
        make_rig(settings), settings.loop.period_s, settings.hal.sensor_period_s, settings.channels
    )


class SimulatedBackend:
    """`thermoctl_hal.base.backend.Backend` over a PlantRig."""

    def __init__(
        self, rig: PlantRig, period_s: float, sensor_period_s: float, channels: Channels = DEFAULT
    ) -> None:
        self.rig, self.period_s = rig, period_s
        self.roles = channels.index
        self.sample = Sample(len(channels.names))
        self._every = max(1, round(sensor_period_s / period_s))
        self._fast = [(self.roles[r], i) for r, i in rig.index.items() if r in EVERY_PERIOD]
        self._slow = [(self.roles[r], i) for r, i in rig.index.items() if r not in EVERY_PERIOD]
        self._fast_roles = np.array([role for role, _ in self._fast] + [_STATE, _FAULT])
        self._slow_roles = np.array([role for role, _ in self._slow], dtype=int)
        self.sample.value[_FAULT] = 0.0
        self._steps, self._start_s, self._drive, self._enabled = 0, math.nan, 0.0, False
        self._shown = -1

    def open(self) -> None:
        """Mark all channels as stale until the first read."""
        self.sample.status[list(self.roles[r] for r in self.rig.index)] = STALE

    def read(self, now_s: float) -> Sample:
        """Advance the plant to `now_s` with the last command held, then read the sensors that are due."""
        sample, rig = self.sample, self.rig
        sample.fresh[:] = False
        if math.isnan(self._start_s):
            self._start_s = now_s
        due = round((now_s - self._start_s) / self.period_s)
        if due - self._steps > MAX_CATCH_UP or due < self._steps:
            self._start_s = now_s - (self._steps + 1) * self.period_s
            due = self._steps + 1
        for _ in range(due - self._steps):
            rig.step(self._drive)
        slow_due = self._shown < 0 or due // self._every > self._shown // self._every
        self._steps = self._shown = due
        self._take(self._fast, self._fast_roles, now_s)
        if slow_due:
            self._take(self._slow, self._slow_roles, now_s)
        sample.value[_STATE] = AMP_ENABLED if self._enabled else AMP_DISABLED
        return sample

    def _take(self, channels: list[tuple[int, int]], roles: np.ndarray, now_s: float) -> None:
        """Take new readings of these sensors; `roles` may also hold the amplifier's state and fault."""
        sample, read = self.sample, self.rig.read_sensor
        sample.fresh[roles], sample.time_s[roles], sample.status[roles] = True, now_s, OK
        for role, i in channels:
            value = read(i)
            if value - value == 0.0:  # finite
                sample.value[role] = value
            else:
                sample.status[role] = ERROR

    def write(self, drive: float, enable: bool) -> None:
        """Hold `drive` from now on; zero when it is not enabled or not finite."""
        self._enabled = bool(enable and math.isfinite(drive))
        self._drive = float(drive) if self._enabled else 0.0

    def close(self) -> None:
        """Set the command to zero."""
        self.write(0.0, False)

    def problem(self, role: str) -> str:
        """Say why a simulated channel is not OK."""
        status = self.sample.status[self.roles[role]]
        if status == OK:
            return ""
        problem = "the plant's output is not finite" if status == ERROR else "not an output of the plant"
        return f"{role}: {problem}"

    def counters(self) -> dict[str, int]:
        """Return the number of periods simulated."""
        return {"simulated.periods": self._steps}
