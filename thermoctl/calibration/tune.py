"""Tune the position loop on the rig: a test, a proposal, and a proof of each step towards it.

One mechanism for `thermoctl tune` and for the PID step of `thermoctl calibrate`. A test is short ramps of the
setpoint, in a session of its own: armed for this command, disarmed after it. The daemon gives up a step's
gains whenever such a session ends: its end, a fault, Ctrl-C, a command that is killed. So the old gains are
in force before and after every step, and in the file until all steps are proven.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermoctl.calibration import drive
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.schedules import triangles
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import tuning
from thermoctl.identify.measured_loop import Measured, Timing, disagreement, measure
from thermoctl.identify.tuning import Gains, SecondOrder
from thermoctl.interrupt import Interrupted
from thermoctl.rig.option import TRIAL_FACTOR
from thermoctl.rig.signals import AT
from thermoctl_hal.base.backend import HardwareError

FASTER = 1.05  # a proposal for a loop with good margins must raise kp/ti by this factor
DIVERGES = 5.0  # a step ends at once at this multiple of the first test's largest error
TESTS = 1 + 3  # largest number of tests in a tuning: FACTOR is reached in three steps of STEP


class Disagrees(HardwareError):
    """A step's loop was not as predicted; the old gains are in force."""


@dataclass(frozen=True)
class Found:
    """Result of a tuning. `after`: the margins measured with the proposed gains, None if none were tried."""

    plant: SecondOrder
    present: Gains
    proposed: Gains
    before: Measured
    after: Measured | None


def tune(rig: drive.DrivenRig, verify: bool, keyboard: Keyboard, say: Callable[[str], None]) -> Found:
    """Propose gains from a test of the rig's loop; `verify`: prove each step towards them on the rig.

    With `verify` the result's gains are proven, or the present ones. Raises InputError where the test gives
    no gains. Raises Disagrees where a step's loop is not as predicted, and HardwareError where the rig ended
    a test. Then the present gains are in force."""
    settings = rig.settings
    period_s, average = settings.loop.period_s, int(settings.control.moving_average)
    present = _present(rig)
    rows, timing = _test(rig, keyboard)
    extra_s = timing.delay_s(period_s, rig.command_s)
    t, u, y = (rows[:, AT[n]] for n in ("t_s", "drive", "position_raw_um"))
    plant = tuning.fit_response(t, u, y, period_s, max(0.0, 0.5 * (rig.command_s - period_s)), present)
    models = (plant, tuning.pessimist(plant, extra_s))
    before = measure(rows, plant, present, period_s, average)
    k0, tau_d, tau_c = tuning.tangent(plant)
    say(
        f"response: K0 {k0:.4g} um per unit, delay {1e3 * tau_d:.3g} ms (at most {1e3 * tuning.tangent(models[1])[1]:.3g}: command period "
        f"{1e3 * rig.command_s:.3g} ms, jitter {1e3 * timing.spread_s:.2g} ms), time constant {1e3 * tau_c:.3g} ms, residual "
        f"{plant.residual:.2g} um; {timing.skipped + timing.late} of {timing.due} ticks skipped or late"
    )
    say(f"present: {before} measured")
    wanted = tuning.robust(models, period_s, average, derivative=present.td_s > 0.0)
    steps = tuning.propose(models, present, wanted, period_s, average)
    proposed = steps[-1]
    say(f"proposed ({proposed.how}): {_predicted(models, proposed, period_s, average)}")
    is_good = before.phase_deg >= tuning.WANTED_DEG and before.gain >= tuning.WANTED_GAIN
    if is_good and _speed(proposed) < FASTER * _speed(present):
        say("the present gains have the wanted margins and these are not faster: nothing to change")
        return Found(plant, present, present, before, before)
    say(tuning.difference(present, proposed))
    if _speed(wanted) > FASTER * _speed(proposed):
        say(
            f"no gain changes by more than a factor of {TRIAL_FACTOR:g} at once: run it again after this proposal"
        )
    if not verify:
        return Found(plant, present, proposed, before, None)
    error_um = np.abs(rows[:, AT["reference_um"]] - rows[:, AT["compensated_um"]]).max()
    after = _prove(rig, keyboard, models, steps, float(error_um), say)
    return Found(plant, present, proposed, before, after)


def _prove(
    rig: drive.DrivenRig,
    keyboard: Keyboard,
    models: tuple[SecondOrder, SecondOrder],
    steps: list[Gains],
    error_um: float,
    say: Callable[[str], None],
) -> Measured:
    """Run the loop with the gains of each step; return the margins measured with the last ones."""
    period_s, average = rig.settings.loop.period_s, int(rig.settings.control.moving_average)
    measured: Measured
    for k, gains in enumerate(steps, 1):
        where = f"step {k} of {len(steps)} (kp {gains.kp:.4g}, ti_s {gains.ti_s:.4g}, td_s {gains.td_s:.4g})"
        try:
            rows, _ = _test(rig, keyboard, gains, DIVERGES * error_um)
        except (InputError, HardwareError, Interrupted) as e:
            kind = HardwareError if isinstance(e, HardwareError) else type(e)
            raise kind(f"{where}: {e}; the gains of before are in force, nothing was written") from None
        measured = measure(rows, models[0], gains, period_s, average)
        if contradiction := disagreement(measured, models, gains, period_s, average):
            raise Disagrees(
                f"{where}: {contradiction}; the gains of before are in force, nothing was written"
            )
        say(f"{where}: {measured} measured")
    return measured


def _present(rig: drive.DrivenRig) -> Gains:
    """Return the gains in force. Raises InputError where the file has others."""
    c, present = rig.settings.control, rig.gains()
    if c.mode == "position":
        raise InputError(
            f"{rig.settings.path}: control.mode is position: the drive closes the loop, there is nothing to tune"
        )
    if not np.allclose((c.kp, c.ti_s, c.td_s), (present.kp, present.ti_s, present.td_s), rtol=1e-9, atol=0.0):
        raise InputError(
            f"{rig.settings.path}: its gains are not those in force (kp {present.kp:g}, ti_s {present.ti_s:g}, td_s "
            f"{present.td_s:g}); `thermoctl reload` first"
        )
    return present


def _test(
    rig: drive.DrivenRig, keyboard: Keyboard, gains: Gains | None = None, most_um: float = np.inf
) -> tuple[np.ndarray, Timing]:
    """Return the rows of a test with these gains and its ticks' timing. Raises InputError for bad ticks."""
    schedule = triangles(rig.settings, rig.now()["compensated_um"])
    rows = drive.excite(rig, schedule, keyboard, gains, most_um)
    timing = Timing.of(rows, rig.settings.loop.period_s)
    timing.check()
    if np.ptp(rows[:, AT["generation"]]) != 0.0:
        raise InputError("somebody reloaded the configuration during the test: run it again")
    return rows, timing


def _speed(g: Gains) -> float:
    """Return the integral gain: a constant disturbance leaves an integrated error of its inverse."""
    return g.kp / g.ti_s


def _predicted(models: tuple[SecondOrder, SecondOrder], gains: Gains, period_s: float, average: int) -> str:
    fitted, worst = (tuning.margins(m, gains, period_s, average) for m in models)
    unstable = "" if worst.stable else ", UNSTABLE with the longest dead time"
    return (
        f"gain margin {fitted.gain:.2f} (at least {worst.gain:.2f}), phase margin {fitted.phase_deg:.0f} deg (at least "
        f"{worst.phase_deg:.0f}) predicted{unstable}"
    )
