# C types for law.py. `python -m tests.typed` writes the parts between "generated" and "end".
cimport cython
from libc.stdint cimport uint8_t

ctypedef unsigned long long bits_t

# generated: the constants of law.py
cdef int _WARM_UP, _OK, _STALE, _ERROR, _ABSENT, _NONE, _SETPOINT, _OFF, _ARMED, _FAULT, _COMMANDS, _POSITION
cdef int _REFERENCE, _VOLTAGE, _CURRENT, _AIR, _COIL, _AMPLIFIER_STATE, _AMPLIFIER_ENABLED, _AMPLIFIER_FAULT
cdef int _K_ERROR, _K_STALE, _K_RANGE, _K_RATE, _K_FROZEN, _KINDS, _B_FOLLOWING, _B_HOT, _B_HOT_MODEL
cdef int _B_HEATING, _B_DISAGREES, _B_POWER, _B_STUCK, _B_BOUND, _B_SLEWING, _B_SATURATED, _B_AMPLIFIER
cdef int _B_STOPPED, _B_NOT_FOLLOWING, _B_LATE, _B_NOT_FINITE, _B_ELECTRICAL, _B_DISPLACED, _B_MONITORED
cdef int _WORD_BITS, _O_STATE, _O_FAULTS, _O_FAULTS_2, _O_SETPOINT, _O_REFERENCE, _O_POSITION, _O_COMPENSATED
cdef int _O_COMPENSATION, _O_EXPANSION, _O_CONTROL, _O_DRIVE, _O_ENABLE, _O_POWER, _O_AIR_RATE, _O_ESTIMATES
cdef int _O_INNOVATION, _O_GAIN, _O_POSITION_AGE, _O_COIL_AGE
cdef bits_t _TRIP_OTHERS, _CRITICAL, _WORD
cdef double _GAP_S, _RESUME_C, _COPPER, _AIR_READINGS, _RESISTANCE_S, _RESISTANCE_LATE_S, _THERMAL_S, _DELAY_S
cdef double _NAN
cdef const uint8_t[::1] _NEXT, _READING_BIT
# end

cdef bint finite(double value) noexcept nogil
cdef double clip(double value, double low, double high) noexcept nogil

cdef class Typed:
    # generated: the fields of Parameters
    cdef public double kp, ti_s, td_s, output_limit, setpoint_rate_um_s, setpoint_low_um, setpoint_high_um
    cdef public double moving_average, compensate, position_mode, bound_um, slew_um_s, following_um
    cdef public double following_s, coil_limit_c, coil_rate_k_s, coil_rate_time_s, innovation_limit_c
    cdef public double innovation_time_s, power_limit_w, power_time_s, idle_current_a, idle_power_w, idle_s
    cdef public double saturation_s, amplifier_s, late_s, agree_time_s, drift_limit_c, monitored_limit_c
    cdef public double resistance_ohm, resistance_current_a, resistance_tolerance, resistance_v
    cdef public double current_per_drive, current_tolerance_a, flexure_um_per_a, position_tolerance_um
    cdef public double reference_tolerance_um, order_limit_c
    # end

cdef class Law:
    cdef readonly object model, parameters, outputs
    cdef Typed p
    cdef readonly int n, m, channels
    cdef int sensors_used, average_length
    cdef bint mkf, hold, expands, reports, enabled, powered, coil_fresh
    cdef readonly bint by_resistance
    cdef double[:, ::1] A, B, C, K
    cdef readonly double correction_step_s
    cdef double[::1] b1, b2, dx, e, out
    cdef int[::1] sensors, predicts
    cdef double[::1] value
    cdef uint8_t[::1] fresh, status, delay
    cdef double b_air, f1, offset_um, expansion_period_s, R_w, R_v, air_filter_s, model_period_s, a1a1, first_gain
    cdef readonly double period_s, dt
    cdef bits_t faults, trips
    cdef public double control_v
    # generated: the arrays of Parameters
    cdef public double[::1] low, high, rate, stale_s, frozen_s, required
    # end
    # generated: the state that snapshot() holds
    cdef public long long state, tick, average_at, averaged
    cdef public bits_t latched
    cdef public double v, eps1, d1, setpoint_um, reference_um, position_um, compensated_um, compensation_um
    cdef public double expansion_um, power_w, air_c, air_start_c, air_known, air_rate_k_s, innovation_c
    cdef public double innovation_mean_c, kalman_gain, P, corrected, primed, expansion_before_um
    cdef public double expansion_after_um, phase_s, coil_slow_c, coil_rate_k_s, coil_elapsed_s, power_mean_w
    cdef public double following_s, idle_s, idle_readings, saturation_s, amplifier_s, enable, drive
    cdef public double air_started, resumed, model_error_c, ohm_v, ohm_scale_v, current_error_a
    cdef public double current_apart_a, drive_low, drive_high, drive_low_before, drive_high_before
    cdef public double displaced_um, position_apart_um, position_low_um, position_high_um
    cdef public double position_low_before_um, position_high_before_um, position_zero_um, zeroed
    cdef public double reference_error_um, reference_zero_um, reference_zeroed, exchanged, driving, ohm_w
    cdef public double ohm_a2, ohm_s, ohm_c
    cdef public double[::1] x, T, T_before, average, age, since_s, suspect, last, same_s, seen, verdict
    cdef public double[::1] corrections, apart_c
    # end

    cpdef bind(self, double[::1] value, uint8_t[::1] fresh, uint8_t[::1] status, uint8_t[::1] delay=*)
    cpdef step(self, double dt, int command=*, double command_value=*, bits_t external=*)
    @cython.locals(i=cython.int, j=cython.int, m=cython.int, n=cython.int, s=cython.double, scale=cython.double)
    cpdef estimate(self, double dt)
    @cython.locals(one=bits_t, m=cython.int, s=cython.double, part=cython.double, target=cython.double, step=cython.double)
    cpdef compensate(self)
    @cython.locals(k=cython.int, s=cython.double, step=cython.double, eps=cython.double, change=cython.double, d=cython.double)
    cpdef control(self, int command, double command_value)
    @cython.locals(one=bits_t, found=bits_t, driven=cython.bint)
    cpdef protect(self, int command, bits_t external)
    @cython.locals(one=bits_t, bit=bits_t, c=cython.int, kind=cython.int, status=cython.int, fresh=cython.bint, value=cython.double)
    cdef void _judge_readings(self, double dt) noexcept
    @cython.locals(late=cython.double, elapsed=cython.double, allowed=cython.double, thermal=cython.bint, jumped=cython.bint)
    cdef void _judge_reading(self, int c, double value) noexcept
    @cython.locals(s=cython.double)
    cdef double _resistance(self) noexcept
    @cython.locals(one=bits_t, told=cython.bint, waits=cython.bint)
    cdef void _watch_amplifier(self) noexcept
    cdef void _power_and_air(self) noexcept
    cdef double _target(self) noexcept
    @cython.locals(part=cython.double, large=cython.bint)
    cdef void _measure_resistance(self) noexcept
    cdef void _start_air(self, double value) noexcept
    @cython.locals(i=cython.int, s=cython.double)
    cdef void _average_air_start(self) noexcept
    @cython.locals(i=cython.int)
    cdef void _forget(self) noexcept
    @cython.locals(i=cython.int, j=cython.int, s=cython.double, left=cython.double, step=cython.double)
    cdef void _predict_corrections(self, double elapsed) noexcept
    @cython.locals(one=bits_t, m=cython.int, s=cython.double, part=cython.double, amperes=cython.double, current=cython.bint,
                   estimated=cython.bint)
    cdef void _agree(self) noexcept
    @cython.locals(low=cython.double, high=cython.double)
    cdef void _compare_drive(self, double amperes) noexcept
    @cython.locals(low=cython.double, high=cython.double, expected=cython.double)
    cdef void _compare_position(self, double position, double held) noexcept
    @cython.locals(m=cython.int, k=cython.int, s=cython.double, limit=cython.double)
    cdef void _compare_order(self) noexcept
    @cython.locals(coil_new=cython.bint, new=cython.bint, i=cython.int, j=cython.int, k=cython.int, c=cython.int, s=cython.double,
                   elapsed=cython.double, gain=cython.double, prior=cython.double)
    cdef void _correct(self) noexcept
    @cython.locals(before=cython.longlong, known=cython.int, started=cython.bint, tripped=cython.bint, critical=cython.bint)
    cdef _arm(self, int command)
    @cython.locals(o='double[::1]', bits=bits_t, m=cython.int)
    cdef void _report(self) noexcept
