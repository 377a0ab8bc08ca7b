# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False, freethreading_compatible=True
"""The law of one tick: estimate, compensate, control, protect. Pure: no I/O, clock, files, allocation.

This file is plain Python. `law.pxd` gives every name a C type, and Cython compiles both into the module that
runs. The same source runs compiled in the loop, in simulation and in replay, and interpreted under coverage
and mutation tests. Both give the same bits (IEEE doubles, no contraction, one order of operations).

    estimate    x(n+1) = x(n) + (dt/T) [(A-I) x(n) + B q(n)],  q = [V I, d(air)/dt]      (33), delta form
                on a new reading: P- = (a1 a1') P + R_w,  k = P-/(P- + R_v),  P = P-(1 - k)    (34), (35)
                x = x + k zeta (y1 - C1 x)            kind 'mkf'  (36)
                x = x + K (y - C x)                   kind 'kalman', all new readings at once
    compensate  yL(n+1) = f1 yL(n) + b1 T(n-1) + b2 T(n) + b_air (air - air at start)          (39)
                a straight line between its samples; bounded; slew-limited; frozen while an input is at fault
    control     reference follows the setpoint at a limited rate; eps = reference - (position + compensation)
                v(n) = v(n-1) + Kp [(eps - eps1) + (dt/Ti) eps + Td (d - d1)],  d = (eps - eps1)/dt      (41)
                With dt constant this is (41) term by term; after a late tick the differences still add up.
                v is clipped where it is stored: no wind-up. Gains may change without a jump.
                a drive that closes the position loop itself gets v = reference - compensation, its target
    protect     range, rate, age and liveness of every reading; following error; coil temperature and its
                rate; power; idle current; innovation; saturation; amplifier; arming; finite numbers
    agree       two measures of one quantity must agree in the mean. Only this finds a sensor that drifts, is
                swapped, or hangs between its limits:
                - coil voltage and R20 (1 + alpha (coil - 20 degC)) current
                - current and the drive requested since the reading before the last
                - position, all since the reading before the last, and the current that holds it
                  against the flexures
                - a watched temperature and its estimate
                - reference encoder and position + expansion (zero of each encoder taken while OFF)
                - two temperatures, exchanged: y_i > y_j while T_i < T_j, and the readings would fit better
                  the other way round, (y_i - y_j)(T_i - T_j) < -order_limit^2
                - the coil's reading and the open-loop model, x - c, with c the sum of all corrections,
                  c(n+1) = c(n) + (dt/T) (A-I) c(n) + k zeta e; a drifting sensor moves x, but not x - c

Without a thermometer at the coil its resistance is the thermometer: R = mean(V I) / mean(I^2) over
RESISTANCE_S. It gives a reading every RESISTANCE_S while the current is large enough. Without any reading
of the coil the estimate is the model alone, from rest at the air's temperature.

After a gap of more than MAX_GAP_S (suspend) the estimate restarts on the coil's next reading. `resume` starts
from the estimates of an earlier run, advanced over the pause without power. They are dropped when the coil's
first reading is more than RESUME_LIMIT_C from them.

An invalid reading is never used (`last` holds the newest valid one). A tick without a new encoder frame holds
the last position; the differences come one tick later. This happens in 1 to 3 % of a polled encoder's ticks.

The rate of a reading is its change over the time between the samples, not between their arrivals. For a
temperature this time is at least THERMAL_S, because a bonded sensor follows no faster. So two answers in
close order, or one digit up to rate x THERMAL_S (2 K at 20 K/s), are no jump. A temperature that exceeds its
rate is not used. It trips when the next reading still exceeds the rate, counted from the last valid one. A
body with heat capacity stays at its new temperature, an outlier does not.

While ARMED, an amplifier that reports another state than enabled holds v = 0 and the reference at the stage.
So nothing integrates against a drive that is off. `amplifier_s` is the time for the enable sequence after
arming. An amplifier that was enabled since and no longer is trips at once. One that still reports enabled
prevents READY.
"""

from __future__ import annotations

from array import array
from dataclasses import fields
from typing import Any

import numpy as np

from thermoctl.control import arming, faults
from thermoctl.control.model import BY_CHANNEL, CompensatorModel, Parameters
from thermoctl.rig.channels import ABSENT, AMP_ENABLED, AMP_FAULT, AT, CODES, COIL, ERROR, OK, STALE
from thermoctl.rig.signals import FAULT_WORD_BITS, OUTPUT, OUTPUTS

MAX_AVERAGE = 64
WARM_UP_TICKS = 100
THERMAL_S = 0.1  # least time for a change of temperature: a bonded sensor's own time constant
# Unit of `delay`, s. A recording stores it in four bits: the largest, 15, is 375 ms, above the 300 ms timeout
# of an answer.
DELAY_S = 0.025
MAX_GAP_S = 10.0  # after a longer time between two ticks the estimate restarts
RESUME_LIMIT_C = 2.0  # keep the estimates of an earlier run if the coil's first reading is this close
# Number of air readings averaged into the expansion's origin. The noise of a single one, 0.02 K, would
# remain as an offset of 0.03 um.
AIR_READINGS = 30.0
COPPER_1_K = 0.00393  # temperature coefficient of the coil's resistance, from 20 degC
RESISTANCE_S = 1.0  # mean of the coil's resistance, and time between two readings of it
RESISTANCE_LATE_S = 10.0  # after this time without a reading by resistance nothing is known of the coil
_GAP_S, _RESUME_C, _COPPER, _WARM_UP = MAX_GAP_S, RESUME_LIMIT_C, COPPER_1_K, WARM_UP_TICKS
_AIR_READINGS = AIR_READINGS
_RESISTANCE_S, _RESISTANCE_LATE_S = RESISTANCE_S, RESISTANCE_LATE_S
_THERMAL_S, _DELAY_S, _NAN = THERMAL_S, DELAY_S, float("nan")
COMPILED = not __file__.endswith(".py")
"""Whether the law is compiled. Interpreted, it is 100 times too slow for a rig: for test coverage only."""

# Constants that the compiler turns into C numbers (typed in law.pxd).
_OK, _STALE, _ERROR, _ABSENT = OK, STALE, ERROR, ABSENT
_NONE, _SETPOINT, _OFF, _ARMED, _FAULT = arming.NONE, arming.SETPOINT, arming.OFF, arming.ARMED, arming.FAULT
_NEXT, _COMMANDS = arming.TABLE, len(arming.COMMANDS)
_POSITION, _REFERENCE = AT["position_um"], AT["output_reference_um"]
_VOLTAGE, _CURRENT, _AIR, _COIL = AT["voltage_v"], AT["current_a"], AT["air_c"], COIL
_AMPLIFIER_STATE = AT["amplifier_state"]
_AMPLIFIER_ENABLED, _AMPLIFIER_FAULT = int(AMP_ENABLED), int(AMP_FAULT)
_K_ERROR, _K_STALE, _K_RANGE, _K_RATE, _K_FROZEN = range(len(faults.KINDS))
_KINDS, _READING_BIT = len(faults.KINDS), faults.READING_BIT
_B_FOLLOWING = faults.BIT["following_error"]
_B_HOT, _B_HOT_MODEL = faults.BIT["coil_overtemperature"], faults.BIT["coil_overtemperature_model"]
_B_HEATING, _B_DISAGREES = faults.BIT["coil_heating_rate"], faults.BIT["coil_disagrees"]
_B_POWER, _B_STUCK = faults.BIT["power_limit"], faults.BIT["coil_stuck_on"]
_B_BOUND, _B_SLEWING = faults.BIT["compensation_bound"], faults.BIT["compensation_slewing"]
_B_SATURATED, _B_AMPLIFIER = faults.BIT["drive_saturated"], faults.BIT["amplifier_fault"]
_B_STOPPED = faults.BIT["amplifier_stopped"]
_B_NOT_FOLLOWING, _B_LATE = faults.BIT["amplifier_not_following"], faults.BIT["loop_late"]
_B_NOT_FINITE = faults.BIT["not_finite"]
_B_ELECTRICAL, _B_DISPLACED = faults.BIT["electrical_disagrees"], faults.BIT["position_disagrees"]
_B_MONITORED = faults.BIT["monitored_disagrees"]
_TRIP_OTHERS = faults.mask(
    "fault", "critical", readings=False
)  # a reading's fault trips only where its channel is required
_CRITICAL = faults.mask("critical")
_WORD_BITS, _WORD = FAULT_WORD_BITS, (1 << FAULT_WORD_BITS) - 1
_O_STATE, _O_FAULTS, _O_FAULTS_2 = OUTPUT["state"], OUTPUT["fault_bits"], OUTPUT["fault_bits_2"]
_O_SETPOINT, _O_REFERENCE, _O_POSITION = OUTPUT["setpoint_um"], OUTPUT["reference_um"], OUTPUT["position_um"]
_O_COMPENSATED, _O_COMPENSATION = OUTPUT["compensated_um"], OUTPUT["compensation_um"]
_O_EXPANSION, _O_CONTROL, _O_DRIVE = OUTPUT["expansion_um"], OUTPUT["control_v"], OUTPUT["drive"]
_O_ENABLE, _O_POWER, _O_AIR_RATE = OUTPUT["enable"], OUTPUT["power_w"], OUTPUT["air_rate_k_s"]
_O_ESTIMATES = len(OUTPUTS)
_O_INNOVATION, _O_GAIN = OUTPUT["innovation_c"], OUTPUT["kalman_gain"]
_O_POSITION_AGE, _O_COIL_AGE = OUTPUT["position_age_s"], OUTPUT["coil_age_s"]

_STATE = """
state tick latched v eps1 d1 setpoint_um reference_um position_um compensated_um compensation_um expansion_um
power_w air_c air_start_c air_known air_rate_k_s innovation_c innovation_mean_c kalman_gain P corrected primed
expansion_before_um expansion_after_um phase_s coil_slow_c coil_rate_k_s coil_elapsed_s power_mean_w following_s
idle_s idle_readings saturation_s amplifier_s average_at averaged enable drive air_started resumed model_error_c
ohm_v ohm_scale_v current_error_a current_apart_a drive_low drive_high drive_low_before drive_high_before
displaced_um position_apart_um position_low_um position_high_um position_low_before_um position_high_before_um
position_zero_um zeroed reference_error_um reference_zero_um reference_zeroed exchanged driving ohm_w ohm_a2 ohm_s
ohm_c
"""
_SCALARS = tuple(_STATE.split())
_WHOLE = ("state", "tick", "latched", "average_at", "averaged")
_VECTORS = (
    "x",
    "T",
    "T_before",
    "average",
    "age",
    "since_s",
    "suspect",
    "last",
    "same_s",
    "seen",
    "verdict",
    "corrections",
    "apart_c",
)
_RESUMED = """
air_c air_start_c air_known air_started corrected primed P expansion_before_um expansion_after_um phase_s
compensation_um expansion_um position_zero_um zeroed reference_zero_um reference_zeroed x T T_before corrections
"""
_KEPT = tuple(_RESUMED.split())


def finite(value):
    """Return True for a number that is neither infinite nor NaN."""
    return value - value == 0.0


def clip(value, low, high):
    """Return the value limited to low..high; NaN stays NaN."""
    if value < low:
        return low
    return high if value > high else value


class Typed:
    """The scalar fields of Parameters with C types; law.pxd's fields are generated."""

    def __init__(self, parameters: Parameters):
        for f in fields(parameters):
            if f.name not in BY_CHANNEL:
                setattr(self, f.name, getattr(parameters, f.name))


class Law:
    """The state of the law and its four stages, called in order once per tick; `step` calls all four.

    model: CompensatorModel; parameters: Parameters; period_s: the loop's nominal period, s. `bind` sets the
    arrays in which the readings arrive. After a tick, `outputs` (OUTPUTS, then the points' estimates)
    and the attributes of the same names hold the results. `drive` and `enable` go to the amplifier.
    """

    def __init__(self, model: CompensatorModel, parameters: Parameters, period_s: float):
        self.model = model
        self.n, self.m, self.sensors_used = model.A_minus_I.shape[0], model.C.shape[0], len(model.sensors)
        self.channels = channels = _COIL + self.m
        self.mkf = model.kind == "mkf"
        self.A, self.B, self.C, self.K = model.A_minus_I, model.B, model.C, model.gain
        self.b1, self.b2, self.b_air, self.f1 = model.b1, model.b2, model.b_air, model.f1
        self.offset_um, self.expansion_period_s = model.offset_um, model.expansion_period_s
        self.R_w, self.R_v, self.air_filter_s = model.R_w, model.R_v, model.air_filter_s
        self.model_period_s, self.period_s = model.period_s, period_s
        first = model.A_minus_I[0].copy()
        first[0] += 1.0
        self.a1a1 = float(first @ first)
        self.sensors = array("i", model.sensors)
        # Without a model of a temperature, or of the expansion, nothing can disagree with it.
        self.predicts = array("i", model.C.any(axis=1).astype(int))
        self.expands = bool(model.b1.any() or model.b2.any() or model.b_air != 0.0)
        # The first correction sets the estimate to the coil's reading: along zeta, or along K.
        along = float(model.C[0] @ model.gain[:, 0])
        self.first_gain = 1.0 / along if abs(along) > 1e-9 else 0.0
        # c is advanced once a reading, in steps short enough for the fastest mode.
        self.correction_step_s = (
            0.5 * model.period_s / max(float(np.abs(model.A_minus_I).sum(axis=1).max()), 1e-12)
        )
        self.dx, self.e = np.zeros(self.n), np.zeros(self.m)
        self.corrections, self.apart_c = np.zeros(self.n), np.zeros(self.m)
        self.x, self.T, self.T_before = np.zeros(self.n), np.zeros(self.m), np.zeros(self.m)
        self.average = np.zeros(MAX_AVERAGE)
        self.age, self.last, self.same_s = np.zeros(channels), np.zeros(channels), np.zeros(channels)
        self.since_s, self.suspect = np.zeros(channels), np.zeros(channels)
        self.seen, self.verdict = np.zeros(channels), np.zeros(channels)
        self._zero()
        self.average_length = 1
        self.out = np.zeros(len(OUTPUTS) + self.m)
        self.outputs = np.asarray(self.out)
        self.faults = 0
        self.hold = 0
        self.reports = self.enabled = self.powered = self.coil_fresh = self.by_resistance = False
        self.configure(parameters)
        self.bind(
            np.full(channels, np.nan),
            np.zeros(channels, dtype=np.uint8),
            np.full(channels, _ABSENT, dtype=np.uint8),
        )

    def _zero(self):
        """Set the scalars of the state to those of a new law."""
        for name in _SCALARS:
            setattr(self, name, 0 if name in _WHOLE else 0.0)
        self.state, self.P, self.control_v = arming.OFF, 1e3 * self.R_v, 0.0

    def bind(self, value, fresh, status, delay=None):
        """Take the arrays over the channels that hold the readings of each tick.

        value: float64; fresh: uint8, 1 for a new reading; status: uint8, OK to ABSENT of channels.py.
        delay: uint8, the age of a new reading when it arrived, in units of DELAY_S; None: read in the tick.
        """
        self.value, self.fresh, self.status = value, fresh, status
        self.delay = np.zeros(self.channels, dtype=np.uint8) if delay is None else delay

    def configure(self, parameters: Parameters):
        """Take new gains and limits, all at once, between two ticks; the state stays.

        Raises ValueError for limits of another number of channels.
        """
        if len(parameters.low) != self.channels:
            raise ValueError(
                f"law: limits of {len(parameters.low)} channels, the model's points make {self.channels}"
            )
        typed: Any = Typed(parameters)  # its fields are declared in law.pxd only
        self.parameters, self.p = parameters, typed
        self.low, self.high = parameters.low.copy(), parameters.high.copy()
        self.rate, self.required = parameters.rate.copy(), parameters.required.copy()
        self.stale_s, self.frozen_s = parameters.stale_s.copy(), parameters.frozen_s.copy()
        for role in CODES:  # a state or an error number does not change while all is well
            self.frozen_s[AT[role]] = np.inf
        length = int(min(max(parameters.moving_average, 1), MAX_AVERAGE))
        if self.tick > 0 and length != self.average_length:
            self.average = np.full(MAX_AVERAGE, self.position_um)  # the filter restarts at its own output
            self.average_at, self.averaged = 0, length
        self.average_length = length

    def snapshot(self) -> np.ndarray:
        """Return the whole state as one float64 vector, for replay and for a warm restart."""
        return np.concatenate(
            [
                np.array([float(getattr(self, name)) for name in _SCALARS]),
                *(np.asarray(getattr(self, name)) for name in _VECTORS),
            ]
        )

    def restore(self, vector: np.ndarray):
        """Take a state that `snapshot` gave for a model of the same order.

        Raises ValueError for another length, and where a counter is not finite or out of range.
        """
        size = len(self.snapshot())
        if len(vector) != size:
            raise ValueError(
                f"law: a state of {len(vector)} numbers, expected {size} (another model or version)"
            )
        if not np.isfinite(vector[[_SCALARS.index(name) for name in _WHOLE]]).all():
            raise ValueError("law: a state whose counters are not finite")
        for name, end in (
            ("state", len(arming.STATES)),
            ("average_at", MAX_AVERAGE),
        ):  # both are indices of a table
            if not 0 <= vector[_SCALARS.index(name)] < end:
                raise ValueError(
                    f"law: a state whose {name} is {vector[_SCALARS.index(name)]:g}, expected 0 to {end - 1}"
                )
        for name, number in zip(_SCALARS, vector, strict=False):
            setattr(self, name, float(number) if name not in _WHOLE else int(number))
        start = len(_SCALARS)
        for name in _VECTORS:
            length = len(np.asarray(getattr(self, name)))
            setattr(self, name, np.array(vector[start : start + length], dtype=np.float64))
            start += length

    def resume(self, vector: np.ndarray, gap_s: float):
        """Start from the estimates of a run that ended `gap_s` seconds ago, without power since.

        `vector` is its snapshot. Arming, controller and fault timers start anew. Raises ValueError as
        `restore` does.
        """
        earlier = Law(self.model, self.parameters, self.period_s)
        earlier.restore(vector)
        for name in _KEPT:
            kept = getattr(earlier, name)
            setattr(self, name, kept if isinstance(kept, float) else np.array(kept))
        self.resumed = self.corrected
        step_s = min(self.expansion_period_s, float(self.correction_step_s))
        A, x, c = np.asarray(self.A), np.asarray(self.x), np.asarray(self.corrections)
        left, phase, before, after = gap_s, self.phase_s, self.expansion_before_um, self.expansion_after_um
        T_before = np.asarray(self.T_before)
        while left > 0.0:
            h = min(left, step_s)
            left, phase = left - h, phase + h
            x, c = x + h / self.model_period_s * (A @ x), c + h / self.model_period_s * (A @ c)
            if phase >= self.expansion_period_s:
                phase -= self.expansion_period_s
                T = np.asarray(self.C) @ x
                before, after = (
                    after,
                    (
                        self.f1 * after
                        + self.b_air * (self.air_c - self.air_start_c)
                        + float(np.asarray(self.b1) @ T_before + np.asarray(self.b2) @ T)
                    ),
                )
                T_before = T
        self.x, self.corrections, self.T, self.T_before = x, c, np.asarray(self.C) @ x, T_before
        self.phase_s, self.expansion_before_um, self.expansion_after_um = phase, before, after

    def _forget(self):
        """Restart the estimate on the coil's next reading; keep the expansion's origin."""
        for i in range(self.n):
            self.x[i] = 0.0
            self.corrections[i] = 0.0
        self.corrected = self.primed = self.air_known = self.resumed = self.model_error_c = (
            self.innovation_mean_c
        ) = 0.0
        self.P = 1e3 * self.R_v

    def step(self, dt, command=0, command_value=0.0, external=0):
        """Run one tick. dt: measured, s; command: of arming; external: fault bits from outside the law."""
        self.estimate(dt)
        self.compensate()
        self.control(command, command_value)
        self.protect(command, external)

    # ---- estimate -----------------------------------------------------------------------------------------------

    def estimate(self, dt):
        """Check the readings, predict the temperatures over the measured dt (s), correct them."""
        self.dt = clip(dt, 0.0, 1.0) if finite(dt) else 0.0
        self.tick += 1
        self.coil_elapsed_s += self.dt
        if dt > _GAP_S:
            self._forget()
        self.coil_fresh = self.fresh[_COIL]
        if self.status[_COIL] == _ABSENT:
            self._measure_resistance()
        self._judge_readings(dt)
        self._power_and_air()
        n = self.n
        scale = self.dt / self.model_period_s
        for i in range(n):
            s = self.B[i, 0] * self.power_w + self.B[i, 1] * self.air_rate_k_s
            for j in range(n):
                s += self.A[i, j] * self.x[j]
            self.dx[i] = s
        for i in range(n):
            self.x[i] += scale * self.dx[i]
        if not self.hold:
            self._correct()
        for m in range(self.m):
            s = 0.0
            for j in range(n):
                s += self.C[m, j] * self.x[j]
            self.T[m] = s

    def _judge_readings(self, dt):
        """Set verdict[c]: 0 good, else 1 + kind of fault. Readings out of range or jumped are not used."""
        self.faults = 0
        one = 1
        self.trips = 0
        self.hold = 0
        for c in range(self.channels):
            self.age[c] += self.dt
            self.since_s[c] += self.dt
            status, fresh, value = self.status[c], self.fresh[c], self.value[c]
            if status == _ABSENT and c == _COIL and self.by_resistance:
                if not self.coil_fresh:
                    if self.seen[c] == 0.0 or self.age[c] > _RESISTANCE_LATE_S:
                        self.verdict[c] = 1.0 + _K_ERROR
                    continue
                status, fresh, value = _OK, True, self.ohm_c
            elif status == _ABSENT and self.required[c] == 0.0:
                self.verdict[c] = 1.0 + _K_ERROR
                continue
            if status in (_ERROR, _ABSENT):
                self.verdict[c] = 1.0 + _K_ERROR
            elif status == _STALE:
                self.verdict[c] = 1.0 + _K_STALE
            elif fresh:
                self._judge_reading(c, value)
                self.age[c] = 0.0
            elif self.age[c] > self.stale_s[c] or (self.seen[c] == 0.0 and self.verdict[c] == 0.0):
                self.verdict[c] = 1.0 + _K_STALE
            if self.verdict[c] > 0.0:
                kind = _K_ERROR
                while self.verdict[c] > 1.0 + kind:
                    kind += 1
                bit = one << _READING_BIT[min(c, _COIL + 1) * _KINDS + kind]
                self.faults |= bit
                if self.required[c] > 0.0:
                    self.trips |= bit
                    if c in (_VOLTAGE, _CURRENT, _AIR, _COIL):
                        self.hold = 1
        if dt > self.p.late_s:
            self.faults |= one << _B_LATE
        self.reports = self.status[_AMPLIFIER_STATE] == _OK
        self.enabled = self.reports and self.value[_AMPLIFIER_STATE] == _AMPLIFIER_ENABLED

    def _judge_reading(self, c, value):
        """Check range, rate and liveness of a new reading; `last` and `since_s`: the newest valid one."""
        late = _DELAY_S * self.delay[c]
        elapsed = max(self.since_s[c] - late, self.period_s)
        thermal = c >= _AIR
        allowed = self.rate[c] * (max(elapsed, _THERMAL_S) if thermal else elapsed)
        jumped = self.seen[c] > 0.0 and abs(value - self.last[c]) > allowed
        if not (self.low[c] <= value <= self.high[c]) or not finite(value):
            self.verdict[c] = 1.0 + _K_RANGE
        elif jumped and thermal and self.suspect[c] == 0.0:
            self.suspect[c] = 1.0  # one reading proves no jump; wait for the next one
        else:
            if self.seen[c] > 0.0 and value == self.last[c]:
                self.same_s[c] += elapsed
            else:
                self.same_s[c] = 0.0
            if jumped:
                self.verdict[c] = 1.0 + _K_RATE
            else:
                self.verdict[c] = 1.0 + _K_FROZEN if self.same_s[c] > self.frozen_s[c] else 0.0
            self.last[c] = value
            self.seen[c] = 1.0
            self.suspect[c] = 0.0
            self.since_s[c] = late

    def _power_and_air(self):
        """Set q(n): electrical power, rate of the low-passed air. Holds the last good value during a fault.

        Without a voltage meter the power is R I^2. `powered`: the power is known; else its output is NaN.
        """
        self.powered = self.status[_CURRENT] != _ABSENT and (
            self.status[_VOLTAGE] != _ABSENT or self.p.resistance_ohm > 0.0
        )
        if self.verdict[_VOLTAGE] == 0.0 and self.verdict[_CURRENT] == 0.0:
            self.power_w = self.last[_VOLTAGE] * self.last[_CURRENT]
        elif self.status[_VOLTAGE] == _ABSENT and self.verdict[_CURRENT] == 0.0:
            self.power_w = self._resistance() * self.last[_CURRENT] * self.last[_CURRENT]
        elif self.enable == 0.0:
            self.power_w = 0.0
        self.power_mean_w += (self.power_w - self.power_mean_w) * min(1.0, self.dt / self.p.power_time_s)
        self.air_rate_k_s = 0.0
        if self.verdict[_AIR] == 0.0:
            if self.air_known == 0.0:
                self._start_air(self.last[_AIR])
            elif self.air_started < _AIR_READINGS and self.fresh[_AIR]:
                self._average_air_start()
            self.air_rate_k_s = (self.last[_AIR] - self.air_c) / self.air_filter_s
            self.air_c += self.air_rate_k_s * self.dt

    def _resistance(self):
        """Return the coil's resistance, ohm, at its estimated, else measured temperature, else 20 degC."""
        s = 20.0
        if self.predicts[0] and self.air_known > 0.0:
            s = self.T[0] + self.air_c
        elif self.verdict[_COIL] == 0.0:
            s = self.last[_COIL]
        return self.p.resistance_ohm * (1.0 + _COPPER * (s - 20.0))

    def _measure_resistance(self):
        """Set coil_fresh and ohm_c where a mean of the resistance is complete; no thermometer is bound."""
        self.coil_fresh = False
        self.by_resistance = (
            self.p.resistance_ohm > 0.0
            and self.required[_COIL] == 0.0
            and self.status[_VOLTAGE] != _ABSENT
            and self.status[_CURRENT] != _ABSENT
        )
        if not self.by_resistance:
            return
        part = min(1.0, self.dt / _RESISTANCE_S)
        if self.verdict[_VOLTAGE] == 0.0 and self.verdict[_CURRENT] == 0.0:
            self.ohm_w += part * (self.last[_VOLTAGE] * self.last[_CURRENT] - self.ohm_w)
            self.ohm_a2 += part * (self.last[_CURRENT] * self.last[_CURRENT] - self.ohm_a2)
        large = self.ohm_a2 > self.p.resistance_current_a * self.p.resistance_current_a
        self.ohm_s = self.ohm_s + self.dt if large else 0.0
        if self.ohm_s >= 2.0 * _RESISTANCE_S:  # the mean has settled; from now on once in RESISTANCE_S
            self.ohm_s -= _RESISTANCE_S
            self.ohm_c = 20.0 + (self.ohm_w / (self.p.resistance_ohm * self.ohm_a2) - 1.0) / _COPPER
            self.coil_fresh = True

    def _start_air(self, value):
        """Start the air's low-pass at this reading; the very first one is the expansion's origin."""
        self.air_c = value
        self.air_known = 1.0
        if self.air_started == 0.0:
            self.air_start_c = value
            self.air_started = 1.0

    def _average_air_start(self):
        """Average the first air readings to the reference air temperature of the expansion.

        The estimated states are shifted by each change of that average."""
        self.air_started += 1.0
        s = (self.last[_AIR] - self.air_c) / self.air_started
        self.air_c += s
        self.air_start_c = self.air_c
        if self.corrected > 0.0:
            for i in range(self.n):
                self.x[i] += self.B[i, 1] / self.model_period_s * s

    def _correct(self):
        """Correct the state with every new valid reading (35); the coil's first reading starts it."""
        coil_new = self.coil_fresh and self.verdict[_COIL] == 0.0 and self.suspect[_COIL] == 0.0
        if self.resumed > 0.0 and coil_new:  # do the kept estimates still fit?
            s = self.last[_COIL] - self.air_c
            for j in range(self.n):
                s -= self.C[0, j] * self.x[j]
            self.resumed = 0.0
            self.coil_slow_c = self.last[_COIL]
            if not (abs(s) <= _RESUME_C):
                self._forget()
                self.air_started = 0.0
                if self.verdict[_AIR] == 0.0:
                    self._start_air(self.last[_AIR])
        if self.air_known == 0.0 and coil_new:  # no air sensor: rises above the first coil reading
            self._start_air(self.last[_COIL])
        if self.corrected == 0.0 and not coil_new:
            if self.status[_COIL] == _ABSENT and self.air_started >= _AIR_READINGS:
                self.corrected = 1.0  # no thermometer at the coil: from rest
            return
        for k in range(self.sensors_used):
            c = _COIL + self.sensors[k]
            self.e[k] = 0.0
            new = coil_new
            if c != _COIL:
                new = self.fresh[c] and self.verdict[c] == 0.0 and self.suspect[c] == 0.0
            if new:
                s = self.last[c] - self.air_c
                for j in range(self.n):
                    s -= self.C[self.sensors[k], j] * self.x[j]
                self.e[k] = s
        if coil_new:
            elapsed = self.dt if self.corrected == 0.0 else self.coil_elapsed_s
            self.coil_elapsed_s = 0.0
            if self.corrected == 0.0:
                for i in range(self.n):
                    self.x[i] += self.first_gain * self.K[i, 0] * self.e[0]
                self.coil_slow_c = self.last[_COIL]
                self.coil_rate_k_s = 0.0
                self.corrected = 1.0
                self.primed = 0.0
                return
            self._predict_corrections(elapsed)
            self.innovation_c = self.e[0]
            self.innovation_mean_c += (self.e[0] - self.innovation_mean_c) * min(
                1.0, elapsed / self.p.innovation_time_s
            )
            self.coil_rate_k_s = (self.last[_COIL] - self.coil_slow_c) / self.p.coil_rate_time_s
            self.coil_slow_c += self.coil_rate_k_s * min(elapsed, self.p.coil_rate_time_s)
        gain = 1.0
        if self.mkf:
            if not coil_new:
                return
            prior = self.a1a1 * self.P + self.R_w
            gain = prior / (prior + self.R_v)
            self.P = prior * (1.0 - gain)
        self.kalman_gain = gain
        for k in range(self.sensors_used):
            if self.e[k] != 0.0:
                for i in range(self.n):
                    self.x[i] += gain * self.K[i, k] * self.e[k]
                    self.corrections[i] += gain * self.K[i, k] * self.e[k]

    def _predict_corrections(self, elapsed):
        """Advance c over the time since the coil's last reading; then reading - (model alone) = e + C c."""
        left = min(elapsed, _GAP_S)
        while left > 0.0:
            step = min(left, self.correction_step_s)
            left -= step
            for i in range(self.n):
                s = 0.0
                for j in range(self.n):
                    s += self.A[i, j] * self.corrections[j]
                self.dx[i] = s
            for i in range(self.n):
                self.corrections[i] += step / self.model_period_s * self.dx[i]
        s = self.e[0]
        for j in range(self.n):
            s += self.C[0, j] * self.corrections[j]
        self.model_error_c = s

    # ---- compensate ---------------------------------------------------------------------------------------------

    def compensate(self):
        """Compute the estimated thermal error, um: expansion model, bound, slew limit.

        It is frozen while a needed reading is at fault.
        """
        one = 1
        if self.primed == 0.0:  # quasi-steady start at the first temperatures
            s = self.b_air * (self.air_c - self.air_start_c)
            for m in range(self.m):
                s += (self.b1[m] + self.b2[m]) * self.T[m]
                self.T_before[m] = self.T[m]
            self.expansion_before_um = self.expansion_after_um = s / (1.0 - self.f1)
            self.phase_s = 0.0
            # until then the origin still changes
            if self.air_started >= _AIR_READINGS or self.verdict[_AIR] > 0.0:
                self.primed = self.corrected
        self.phase_s += self.dt
        if self.phase_s >= self.expansion_period_s:
            self.phase_s -= self.expansion_period_s
            s = self.f1 * self.expansion_after_um + self.b_air * (self.air_c - self.air_start_c)
            for m in range(self.m):
                s += self.b1[m] * self.T_before[m] + self.b2[m] * self.T[m]
                self.T_before[m] = self.T[m]
            self.expansion_before_um = self.expansion_after_um
            self.expansion_after_um = s
        part = min(1.0, self.phase_s / self.expansion_period_s)
        self.expansion_um = (
            self.expansion_before_um
            + part * (self.expansion_after_um - self.expansion_before_um)
            + self.offset_um
        )
        target = self.expansion_um if self.p.compensate > 0.0 else 0.0
        if not (abs(target) <= self.p.bound_um):  # also when it is not a number
            self.faults |= one << _B_BOUND
            target = (
                clip(target, -self.p.bound_um, self.p.bound_um) if finite(target) else self.compensation_um
            )
        if self.hold:
            return
        if self.state == _ARMED:
            step = self.p.slew_um_s * self.dt
            # else the origin still changes
            if self.primed > 0.0 and abs(target - self.compensation_um) > 2.0 * step:
                self.faults |= one << _B_SLEWING
            target = clip(target, self.compensation_um - step, self.compensation_um + step)
        self.compensation_um = target

    # ---- control ------------------------------------------------------------------------------------------------

    def control(self, command, command_value):
        """Run moving average, setpoint limiter and velocity-form PID (41). Not armed: setpoint = stage.

        While an armed amplifier reports that it does not drive, the reference follows the stage and v stays
        0.
        """
        if self.fresh[_POSITION] and self.verdict[_POSITION] == 0.0:
            if self.averaged == 0.0:
                for k in range(MAX_AVERAGE):
                    self.average[k] = self.value[_POSITION]
            self.averaged = self.average_length
            self.average[self.average_at] = self.value[_POSITION]
            self.average_at = self.average_at + 1 if self.average_at + 1 < self.average_length else 0
            s = 0.0
            for k in range(self.average_length):
                s += self.average[k]
            self.position_um = s / self.average_length
        self.compensated_um = self.position_um + self.compensation_um
        if self.state != _ARMED:
            self.setpoint_um = self.compensated_um
        else:
            if command == _SETPOINT and finite(command_value):
                self.setpoint_um = command_value
            self.setpoint_um = clip(self.setpoint_um, self.p.setpoint_low_um, self.p.setpoint_high_um)
        if self.state != _ARMED or (self.reports and not self.enabled):
            self.reference_um = self.compensated_um
            self.v = self.eps1 = self.d1 = 0.0
            if self.p.position_mode > 0.0:
                self.v = self._target()
            return
        step = self.p.setpoint_rate_um_s * self.dt
        self.reference_um = clip(self.setpoint_um, self.reference_um - step, self.reference_um + step)
        eps = self.reference_um - self.compensated_um
        if self.p.position_mode > 0.0:
            self.v, self.eps1 = self._target(), eps
            return
        change = eps - self.eps1
        d = change / self.dt if self.dt > 0.0 else 0.0
        self.v = clip(
            self.v + self.p.kp * (change + self.dt / self.p.ti_s * eps + self.p.td_s * (d - self.d1)),
            -self.p.output_limit,
            self.p.output_limit,
        )
        self.eps1, self.d1 = eps, d

    def _target(self):
        """Return the target, um, of a drive that holds its own encoder's position: the reference, shifted."""
        return clip(self.reference_um - self.compensation_um, -self.p.output_limit, self.p.output_limit)

    # ---- protect ------------------------------------------------------------------------------------------------

    def protect(self, command, external):
        """Check all limits, run the arming machine; fill `outputs`, `drive` and `enable`."""
        one = 1
        found = external
        if self.state == _ARMED:
            self.following_s = self.following_s + self.dt if abs(self.eps1) > self.p.following_um else 0.0
            if self.following_s > self.p.following_s or abs(self.eps1) > 2.0 * self.p.following_um:
                found |= one << _B_FOLLOWING
            self.saturation_s = self.saturation_s + self.dt if abs(self.v) >= self.p.output_limit else 0.0
            if self.saturation_s > self.p.saturation_s:
                found |= one << _B_SATURATED
            self.idle_s = self.idle_readings = 0.0
        else:
            self.following_s = self.saturation_s = 0.0
            if self.fresh[_CURRENT]:
                self.idle_readings += 1.0
            driven = (
                self.verdict[_CURRENT] == 0.0
                and self.idle_readings > 1.0
                and (
                    abs(self.last[_CURRENT]) > self.p.idle_current_a
                    or abs(self.power_w) > self.p.idle_power_w
                )
            )
            # Counted down at a quarter: a current that flows for more than a fifth of the time is found.
            counted = self.dt if driven else -0.25 * self.dt
            self.idle_s = max(0.0, min(self.idle_s, self.p.idle_s) + counted)
            if self.idle_s > self.p.idle_s:
                found |= one << _B_STUCK
        if self.verdict[_COIL] == 0.0 and self.last[_COIL] > self.p.coil_limit_c:
            found |= one << _B_HOT
        if self.T[0] + self.air_c > self.p.coil_limit_c:
            found |= one << _B_HOT_MODEL
        if self.coil_rate_k_s > self.p.coil_rate_k_s:
            found |= one << _B_HEATING
        if self.predicts[0] and (
            abs(self.innovation_mean_c) > self.p.innovation_limit_c
            or abs(self.model_error_c) > self.p.drift_limit_c
        ):
            found |= one << _B_DISAGREES
        if self.power_mean_w > self.p.power_limit_w:
            found |= one << _B_POWER
        if not (
            finite(self.v)
            and finite(self.reference_um)
            and finite(self.compensated_um)
            and finite(self.T[0])
            and finite(self.expansion_um)
            and finite(self.power_w)
        ):
            found |= one << _B_NOT_FINITE
        self._watch_amplifier()
        self._agree()
        self.faults |= found
        self.trips |= self.faults & _TRIP_OTHERS
        self._arm(command)
        self.control_v = self.v
        self.enable = 1.0 if self.state == _ARMED and finite(self.v) else 0.0
        self.drive = clip(self.v, -self.p.output_limit, self.p.output_limit) if self.enable > 0.0 else 0.0
        self._report()

    def _watch_amplifier(self):
        """Compare the amplifier's reported state with its command: enabled in ARMED, else disabled."""
        one = 1
        told = self.state == _ARMED
        if not told:
            self.driving = 0.0
        if self.reports and self.value[_AMPLIFIER_STATE] == _AMPLIFIER_FAULT:
            self.faults |= one << _B_AMPLIFIER
        elif self.reports and not self.enabled and self.driving > 0.0:
            self.faults |= one << _B_STOPPED
        if told and self.enabled:
            self.driving = 1.0
        waits = self.reports and self.enabled != told and self.driving == 0.0
        self.amplifier_s = self.amplifier_s + self.dt if waits else 0.0
        if self.amplifier_s > self.p.amplifier_s:
            self.faults |= one << _B_NOT_FOLLOWING

    def _agree(self):
        """Compare low-passed readings with each other; `drive` is still the command of the tick before."""
        one = 1
        part = min(1.0, self.dt / self.p.agree_time_s)
        current = self.verdict[_CURRENT] == 0.0
        amperes = self.last[_CURRENT] if current else 0.0
        estimated = (
            self.predicts[0] and self.air_known > 0.0
        )  # the coil's temperature: estimate, or else its own reading
        if (
            current
            and self.verdict[_VOLTAGE] == 0.0
            and self.p.resistance_ohm > 0.0
            and (estimated or self.verdict[_COIL] == 0.0)
        ):
            s = self._resistance() * amperes
            self.ohm_v += part * (self.last[_VOLTAGE] - s - self.ohm_v)
            self.ohm_scale_v += part * (max(abs(self.last[_VOLTAGE]), abs(s)) - self.ohm_scale_v)
            if abs(self.ohm_v) > self.p.resistance_tolerance * self.ohm_scale_v + self.p.resistance_v:
                self.faults |= one << _B_ELECTRICAL
        self._compare_drive(amperes)
        if self.state != _ARMED or not current or self.p.current_per_drive == 0.0:
            self.current_error_a = 0.0
        else:
            self.current_error_a += part * (self.current_apart_a - self.current_error_a)
            if abs(self.current_error_a) > self.p.current_tolerance_a:
                self.faults |= one << _B_NOT_FOLLOWING
        if current and self.verdict[_POSITION] == 0.0 and self.p.flexure_um_per_a != 0.0:
            before_um = abs(self.position_apart_um)
            self._compare_position(self.last[_POSITION], self.p.flexure_um_per_a * amperes)
            # A stage that was switched off far from its rest comes back by itself.
            if self.state == _ARMED or abs(self.position_apart_um) >= before_um:
                self.displaced_um += part * (self.position_apart_um - self.displaced_um)
            if abs(self.displaced_um) > self.p.position_tolerance_um:
                self.faults |= one << _B_DISPLACED
        if self.corrected == 0.0:
            return
        part = min(1.0, self.dt / self.p.innovation_time_s)
        for m in range(self.m):
            if self.verdict[_COIL + m] == 0.0 and self.predicts[m]:
                self.apart_c[m] += part * (self.last[_COIL + m] - self.air_c - self.T[m] - self.apart_c[m])
                if m > 0 and abs(self.apart_c[m]) > self.p.monitored_limit_c:
                    self.faults |= one << _B_MONITORED
        if self.coil_fresh:
            self._compare_order()
        if self.exchanged > 0.0:
            self.faults |= one << _B_MONITORED
        if self.expands and self.verdict[_REFERENCE] == 0.0 and self.verdict[_POSITION] == 0.0:
            s = self.last[_REFERENCE] - self.last[_POSITION] - self.expansion_um
            if self.reference_zeroed == 0.0:
                self.reference_zero_um = s
                self.reference_zeroed = 1.0 if self.state != _OFF else 0.0
            part = min(1.0, self.dt / self.p.agree_time_s)
            self.reference_error_um += part * (s - self.reference_zero_um - self.reference_error_um)
            if abs(self.reference_error_um) > self.p.reference_tolerance_um:
                self.faults |= one << _B_MONITORED

    def _compare_drive(self, amperes):
        """Set current_apart_a: distance of a new current from all drives since the reading before the last.

        A slow meter samples at some time before its reading arrives. Compared with the present drive alone,
        it would trip on an amplifier that works while the drive changes.
        """
        self.drive_low = min(self.drive_low, self.drive)
        self.drive_high = max(self.drive_high, self.drive)
        if self.fresh[_CURRENT] and self.p.current_per_drive != 0.0:
            low = min(self.drive_low, self.drive_low_before)
            high = max(self.drive_high, self.drive_high_before)
            self.current_apart_a = amperes - self.p.current_per_drive * clip(
                amperes / self.p.current_per_drive, low, high
            )
            self.drive_low_before, self.drive_high_before = self.drive_low, self.drive_high
            self.drive_low = self.drive_high = self.drive

    def _compare_position(self, position, held):
        """Compute position_apart_um: distance of recent positions from where the current holds.

        held: displacement by the newest current, um. Recent: since the reading before the last.
        As in _compare_drive, the current may have been sampled at any of these positions.
        The zero is taken while OFF.
        """
        if self.zeroed == 0.0:
            self.position_zero_um = position - held
            self.zeroed = 1.0 if self.state != _OFF else 0.0
        self.position_low_um = min(self.position_low_um, position)
        self.position_high_um = max(self.position_high_um, position)
        if self.fresh[_CURRENT]:
            expected = held + self.position_zero_um
            low = min(self.position_low_um, self.position_low_before_um)
            high = max(self.position_high_um, self.position_high_before_um)
            self.position_apart_um = clip(expected, low, high) - expected
            self.position_low_before_um, self.position_high_before_um = (
                self.position_low_um,
                self.position_high_um,
            )
            self.position_low_um = self.position_high_um = position

    def _compare_order(self):
        """Set `exchanged`: two mean readings would fit their estimates better the other way round."""
        self.exchanged = 0.0
        limit = -self.p.order_limit_c * self.p.order_limit_c
        for m in range(1, self.m):
            for k in range(m):
                if (
                    self.predicts[m]
                    and self.predicts[k]
                    and self.verdict[_COIL + m] == 0.0
                    and self.verdict[_COIL + k] == 0.0
                ):
                    s = self.T[m] - self.T[k]
                    if (s + self.apart_c[m] - self.apart_c[k]) * s < limit:
                        self.exchanged = 1.0

    def _arm(self, command):
        """Run the state machine; faults that tripped stay in `fault_bits` until FAULT is left."""
        before, known = self.state, command if 0 <= command < _COMMANDS else _NONE
        started, critical = self.tick > _WARM_UP, (self.trips & _CRITICAL) != 0
        tripped = self.trips != 0 or (
            before < _ARMED and self.amplifier_s > 0.0
        )  # it still drives: not READY
        self.state = _NEXT[(((before * _COMMANDS + known) * 2 + started) * 2 + tripped) * 2 + critical]
        if self.state == _FAULT:
            self.latched = self.latched | self.trips
        else:
            self.latched = 0
        if before == _ARMED and self.state != _ARMED:
            self.v = self.eps1 = self.d1 = 0.0

    def _report(self):
        """Fill `outputs` in the order of OUTPUTS."""
        o = self.out
        bits = self.faults | self.latched
        o[_O_STATE] = self.state
        o[_O_FAULTS] = bits & _WORD
        o[_O_FAULTS_2] = bits >> _WORD_BITS
        o[_O_SETPOINT] = self.setpoint_um
        o[_O_REFERENCE] = self.reference_um
        o[_O_POSITION] = self.position_um
        o[_O_COMPENSATED] = self.compensated_um
        o[_O_COMPENSATION] = self.compensation_um
        o[_O_EXPANSION] = self.expansion_um
        o[_O_CONTROL] = self.control_v
        o[_O_DRIVE] = self.drive
        o[_O_ENABLE] = self.enable
        o[_O_POWER] = self.power_w if self.powered else _NAN
        o[_O_AIR_RATE] = self.air_rate_k_s
        for m in range(self.m):
            o[_O_ESTIMATES + m] = self.T[m] + self.air_c
        o[_O_INNOVATION] = self.innovation_c
        o[_O_GAIN] = self.kalman_gain
        o[_O_POSITION_AGE] = self.age[_POSITION]
        o[_O_COIL_AGE] = self.age[_COIL]

    @property
    def fault_bits(self) -> int:
        """Active faults and, in FAULT, the latched faults that caused it."""
        return self.faults | self.latched
