/* The law of thermoctl/control/law.py in plain C: the same equations, the same order of operations, the same bits.
 * Written by hand as a yardstick for `make bench-realtime`; the bench checks that both give equal outputs. */
#ifndef LAW_H
#define LAW_H
#include <stdint.h>

#ifndef POINTS
#define POINTS 12                               /* temperature points: the paper's; `make bench-points` compiles others */
#endif
enum { M = POINTS, N = 8 + M, ORDER = M > 24 ? M : 24, AVERAGE = 64, KINDS = 5, OUTPUTS = 18 + M, AXES = 4 };

typedef struct {
    /* model */
    int n, sensors_used, mkf, expands, sensors[M], predicts[M], reading_bit[N * KINDS];
    double A[ORDER * ORDER], B[ORDER * 2], C[M * ORDER], K[ORDER * M], b1[M], b2[M];
    double b_air, f1, offset_um, expansion_period_s, R_w, R_v, air_filter_s, model_period_s, period_s, a1a1, first_gain, correction_step_s;
    /* parameters */
    double kp, ti_s, td_s, output_limit, setpoint_rate_um_s, setpoint_low_um, setpoint_high_um;
    int average_length, compensate_on, position_mode;
    double bound_um, slew_um_s, low[N], high[N], rate[N], stale_s[N], frozen_s[N], required[N];
    double following_um, following_limit_s, coil_limit_c, coil_rate_limit, coil_rate_time_s, innovation_limit_c;
    double innovation_time_s, power_limit_w, power_time_s, idle_current_a, idle_power_w, idle_limit_s;
    double saturation_limit_s, amplifier_limit_s, late_s, agree_time_s, drift_limit_c, monitored_limit_c;
    double resistance_current_a, resistance_ohm, resistance_tolerance, resistance_v, current_per_drive, current_tolerance_a, flexure_um_per_a;
    double position_tolerance_um, reference_tolerance_um, order_limit_c;
    uint64_t trip_others, critical;
    /* readings */
    double value[N];
    uint8_t fresh[N], status[N], delay[N];
    /* state */
    int64_t state, tick, average_at, averaged;
    uint64_t latched, faults, trips;
    int hold, reports, enabled, powered, coil_fresh, by_resistance;
    double dt, v, eps1, d1, setpoint_um, reference_um, position_um, compensated_um, compensation_um, expansion_um;
    double power_w, air_c, air_start_c, air_rate_k_s, air_known, innovation_c, innovation_mean_c, kalman_gain, P;
    double ohm_w, ohm_a2, ohm_s, ohm_c, corrected, primed, expansion_before_um, expansion_after_um, phase_s, coil_slow_c, coil_rate_k_s;
    double coil_elapsed_s, power_mean_w, following_s, idle_s, saturation_s, amplifier_s, enable, drive, control_v;
    double air_started, resumed, model_error_c, ohm_v, ohm_scale_v, current_error_a, displaced_um, position_zero_um, zeroed;
    double reference_error_um, reference_zero_um, reference_zeroed, exchanged, driving, idle_readings, current_apart_a;
    double drive_low, drive_high, drive_low_before, drive_high_before, position_apart_um, position_low_um, position_high_um;
    double position_low_before_um, position_high_before_um, since_s[N], suspect[N];
    double x[ORDER], dx[ORDER], corrections[ORDER], apart_c[M], e[M], T[M], T_before[M], average[AVERAGE], age[N], last[N], same_s[N], seen[N], verdict[N];
    double out[OUTPUTS];
} law_t;

int law_load(law_t *law, const char *path);     /* numbers that run.py writes; 0 done */
void law_step(law_t *law, double dt, int command, double command_value, uint64_t external);
#endif
