"""The daemon's own tick in simulated time: as fast as the machine allows, the same rows for the same seed."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control import arming, faults
from thermoctl.control.model import CompensatorModel, Parameters, packed_length
from thermoctl.daemon.tick.assemble import compensator, law_parameters
from thermoctl.daemon.tick.loop import RELOAD, Axis
from thermoctl.daemon.tick.ring import Box, Mailbox
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.signals import AT, fault_word
from thermoctl_hal.rig.make import make_backend

COMMANDS = {**{name: float(k) for k, name in enumerate(arming.COMMANDS)}, "reload": RELOAD}


class Simulation:
    """One rig in simulated time: `command` sends a command, `tick` advances by one period.

    `row` is the newest record row (`settings.row` has its signals), `law` the control law,
    `backend` the open back end.
    The setting hal.backend must be simulated. `model`, `parameters` and
    `backend`: those of the settings if None."""

    def __init__(
        self,
        settings: Settings,
        model: CompensatorModel | None = None,
        parameters: Parameters | None = None,
        publish: Any = None,
        backend: Any = None,
    ):
        self.period_s = settings.loop.period_s
        self.ticks, self.now_s = 0, 0.0
        self.backend = backend or make_backend(settings)
        self.backend.open()
        self.mailbox, self.box = (
            Mailbox(np.zeros(2, np.uint64), np.zeros((64, 2))),
            Box(np.zeros(1, np.uint64), np.zeros(packed_length(len(settings.channels.names)) + 1)),
        )
        self.quiet = publish is None
        self.rig = Axis(
            self.backend,
            model or compensator(settings),
            parameters or law_parameters(settings),
            self.period_s,
            publish or (lambda row: None),
            self.mailbox,
            self.box,
            channels=settings.channels,
        )
        self.rig.wall_s = lambda: self.now_s
        self.law, self.row = self.rig.law, self.rig.row

    def command(self, name: str, value: float = 0.0) -> None:
        """Give arm, disarm, or setpoint (um) for the next tick.

        Raises RuntimeError when the mailbox is full."""
        if not self.mailbox.push(COMMANDS[name], float(value)):
            raise RuntimeError("more commands than the mailbox holds: let it tick")

    def reload(self, parameters: Parameters) -> None:
        """Apply new parameters at the next tick."""
        self.box.put(parameters.pack())
        self.command("reload")

    def tick(self, count: int = 1) -> np.ndarray:
        """Run `count` ticks; return the newest row (a view).

        Without `publish` only the last row is made."""
        rig, law, period_s = self.rig, self.law, self.period_s
        for left in range(count - 1, -1, -1):
            self.ticks += 1
            self.now_s = now_s = self.ticks * period_s
            if left and self.quiet:
                rig.sample(now_s)
                law.step(period_s, rig.command, rig.value, rig.external)
                rig.actuate()
            else:
                rig.tick(now_s, period_s, 0.0, lambda: 0)
        return self.row

    def until(self, condition: Any, limit_s: float) -> bool:
        """Tick until condition(row), for at most `limit_s` of simulated time; return whether it held."""
        return any(condition(self.tick()) for _ in range(round(limit_s / self.period_s)))

    def arm(self, limit_s: float = 20.0) -> None:
        """Wait for READY and arm. Raises RuntimeError when READY does not come."""
        state = AT["state"]
        if not self.until(lambda row: row[state] == arming.READY, limit_s):
            raise RuntimeError(
                f"not READY within {limit_s} s: state {arming.STATES[int(self.row[state])]}, faults "
                f"{', '.join(f.name for f in faults.decode(fault_word(self.row))) or 'none'}"
            )
        self.command("arm")
        self.tick()

    def close(self) -> None:
        """Disable the amplifier and close the back end."""
        self.backend.write(0.0, False)
        self.backend.close()


SETTLE_S = 0.5  # settling time at the setpoint before the deviation counts
STROKE_UM, CYCLE_S = 200.0, 75.0


def trapezoids(settings: Settings, hours: float, compensate: bool, out: str | None = None) -> int:
    """Move in trapezoids of 75 s (the paper's test 4B); print mean and largest deviation of the output.

    The reference encoder, which the law never reads, measures it while the reference has stood for SETTLE_S.
    out: file of ten rows a second, Parquet. Returns 0 when all deviations are within 0.5 um, else 1."""
    if not CYCLE_S <= hours * 3600.0 < np.inf:
        raise InputError(f"--hours {hours:g}: at least {CYCLE_S / 3600:.3f}, one cycle, was expected")
    parameters = dataclasses.replace(law_parameters(settings), compensate=float(compensate))
    simulation = Simulation(settings, parameters=parameters)
    simulation.arm()
    half, steps = round(CYCLE_S / 2 / simulation.period_s), round(hours * 3600.0 / simulation.period_s)
    keep = max(1, round(0.1 / simulation.period_s))
    rows = np.empty((steps // keep, len(settings.row)))
    standing = round(SETTLE_S / simulation.period_s)
    setpoint, reference, output = (AT[n] for n in ("setpoint_um", "reference_um", "output_reference_um"))
    stood, settled = 0, np.zeros(len(rows), dtype=bool)
    for k in range(steps):
        if k % half == 0:
            simulation.command("setpoint", STROKE_UM if k // half % 2 == 0 else -STROKE_UM)
        row = simulation.tick()
        stood = stood + 1 if row[setpoint] == row[reference] else 0
        if k % keep == keep - 1:
            rows[k // keep], settled[k // keep] = row, stood > standing
    state = arming.STATES[int(simulation.row[AT["state"]])]
    simulation.close()
    error = (rows[:, output] - rows[:, setpoint])[settled]
    coil = rows[:, settings.row.estimates.start]
    print(
        f"{hours:g} h of rig time, compensation {'on' if compensate else 'off'}: state {state}, coil "
        f"{coil[0]:.1f} to {coil.max():.1f} C, compensation up to "
        f"{np.abs(rows[:, AT['compensation_um']]).max():.2f} um"
    )
    print(
        f"output minus setpoint, {settled.sum()} settled samples: mean {error.mean():+.3f} um, 2 sigma "
        f"{2 * error.std():.3f} um, largest {np.abs(error).max():.3f} um"
    )
    if out:
        from thermoctl.recording.files import write_table
        from thermoctl.recording.table import Table

        columns = {
            s.name: np.ascontiguousarray(rows[:, i])
            for i, s in enumerate(settings.row.signals)
            if s.name != "t_s"
        }
        write_table(out, Table(name="simulated", path=out, t=rows[:, AT["t_s"]].copy(), columns=columns))
    return 0 if np.abs(error).max() <= 0.5 and state == "ARMED" else 1
