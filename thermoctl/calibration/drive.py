"""Drive a rig for a test.

Only through the daemon's law, armed, with all protections, and only after the user's consent.

Two rigs run the same schedules of setpoints: `DaemonRig` through a running daemon, `SimulatedRig` in this
process. Both raise hal.backend.HardwareError (exit status 3, one line) when the rig refuses or is absent.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from thermoctl.calibration.daemon_rig import DaemonRig
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.schedules import forecast, span, within_limits
from thermoctl.calibration.simulated_rig import SimulatedRig
from thermoctl.configuration.settings import Settings
from thermoctl.control import arming
from thermoctl.daemon.control_socket import ask
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.experiments import Aborted, Schedule
from thermoctl.identify.tuning import Gains
from thermoctl.interrupt import Interrupted
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table
from thermoctl.rig.signals import AT
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.rig.make import make_devices

DrivenRig = SimulatedRig | DaemonRig


def rig_of(settings: Settings) -> DrivenRig:
    """Find the rig that tests run on: the daemon's where one answers, else the simulated one.

    Raises HardwareError where there is neither."""
    try:
        ask(settings.socket.path, {"command": "status"})
        return DaemonRig(settings)
    except InputError as e:
        if settings.hal.backend != "simulated":
            raise HardwareError(
                f"{settings.path}: no daemon holds this rig ({e}); it is driven only through the daemon: "
                "thermoctl start, then this command again"
            ) from None
    return SimulatedRig(settings)


def earlier_part(
    rig: DrivenRig, path: Path, at_s: float, say: Callable[[str], None]
) -> tuple[Table | None, float]:
    """Return the rows of an interrupted test on a daemon, and the time that it reached.

    It starts again on a simulated rig, and where the daemon's own recording has a gap since then."""
    if not path.exists() or not isinstance(rig, DaemonRig):
        return None, 0.0
    earlier = rig.meanwhile(read_table(path))
    if earlier is None:
        say("starts again: the daemon did not record without a gap since it was ended")
        return None, 0.0
    say(f"goes on at {at_s:.0f} s")
    return earlier, at_s


def agreed(rig: DrivenRig, schedules: Sequence[Schedule], yes: bool) -> bool:
    """Report which rig will move, how far, how long, and the coil's predicted temperature.

    Ask before a daemon's rig moves, unless `yes`. Raises InputError for setpoints outside the configuration's
    limits, for a coil that would become too hot, and when nobody can be asked."""
    settings = rig.settings
    p = settings.protection
    low, high = within_limits(settings, schedules)
    coil_c = float(next(iter(rig.now()["temperatures_c"].values())) or math.nan)
    peaks = [forecast(settings, s, coil_c)[1] for s in schedules]
    predicted = [t for t in peaks if t is not None and math.isfinite(t)]
    if predicted and max(predicted) > p.coil_limit_c:
        raise InputError(
            f"{settings.path}: the coil would reach {max(predicted):.1f} degC, above protection.coil_limit_c ({p.coil_limit_c:g})"
        )
    warm = (
        f"at most {max(predicted):.1f} degC predicted"
        if predicted
        else "not predicted (no model, or no reading of the coil)"
    )
    print(f"rig '{settings.rig.name}' ({settings.path}), back end {settings.hal.backend}: {rig.where}")
    if settings.hal.backend == "devices":
        print("devices: " + ", ".join(f"{d.name} at {d.binding.port}" for d in make_devices(settings)))
    print(
        f"moves the output from {low:.4g} to {high:.4g} um, {span(sum(s.duration_s for s in schedules))} in all; "
        f"coil {warm}, the protection trips at {p.coil_limit_c:g} degC",
        flush=True,
    )
    if not rig.real or yes:
        return True
    if not sys.stdin.isatty():
        raise InputError(
            "this moves a rig and there is no terminal to ask at; --yes starts it without a question"
        )
    return input("type go to arm the rig and start; anything else leaves it as it is: ").strip() == "go"


def excite(
    rig: DrivenRig,
    schedule: Schedule,
    keyboard: Keyboard,
    gains: Gains | None = None,
    most_um: float = math.inf,
) -> np.ndarray:
    """Record every tick of a short schedule; `gains`: tried for as long as it lasts.

    It is ended at an error of most_um, um. Raises HardwareError when it ends early, Interrupted when the user
    ends it."""
    blocks = []
    run = rig.run(schedule, lambda p: None, keyboard, every_s=0.0, rest=False, gains=gains)
    try:
        with keyboard.listening(), contextlib.closing(run):
            for rows in run:
                blocks.append(rows)
                error_um = np.abs(rows[:, AT["reference_um"]] - rows[:, AT["compensated_um"]]).max()
                if error_um > most_um:
                    raise Aborted(
                        f"the error grew to {error_um:.3g} um",
                        float(rows[-1, AT["t_s"]] - blocks[0][0, AT["t_s"]]),
                    )
    except Aborted as e:
        kind = Interrupted if keyboard.ended else HardwareError
        raise kind(f"ended after {e.done_s:.1f} s, the amplifier is disabled: {e.reason}") from None
    rows = np.vstack(blocks)
    return rows[rows[:, AT["state"]] == arming.ARMED]
