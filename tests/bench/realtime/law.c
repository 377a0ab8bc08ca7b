#include "law.h"
#include <math.h>
#include <stdio.h>
#include <string.h>

enum { OK, STALE, ERROR, ABSENT };
enum { POSITION = 0, REFERENCE = 1, VOLTAGE = 2, CURRENT = 3, AMPLIFIER_STATE = 5, AIR = 7, COIL = 8 };
enum { THERMAL = AIR, THERMAL_END = COIL + M };
enum { K_ERROR, K_STALE, K_RANGE, K_RATE, K_FROZEN };
enum { B_STOPPED = 34, B_FOLLOWING = 35, B_HOT, B_HOT_MODEL, B_HEATING, B_DISAGREES, B_POWER, B_STUCK, B_BOUND, B_SLEWING, B_SATURATED,
       B_AMPLIFIER, B_NOT_FOLLOWING, B_LATE, B_WRITE, B_NOT_FINITE, B_ELECTRICAL, B_DISPLACED,
       B_MONITORED };
enum { OFF, SAFE, READY, ARMED, FAULT };
enum { NONE, ARM, DISARM, SETPOINT };
enum { B_OTHER_AXIS = 53 };
#define AIR_READINGS 30.0
#define COPPER 0.00393
#define RESISTANCE_S 1.0
#define RESISTANCE_LATE_S 10.0
#define BIT(b) ((uint64_t)1 << (b))

static int finite_(double v) { return v - v == 0.0; }
static double clip(double v, double low, double high) { return v < low ? low : v > high ? high : v; }
static double least(double a, double b) { return b < a ? b : a; }
static double most(double a, double b) { return b > a ? b : a; }

static const double *take(const double *p, double *to, int count) {
    memcpy(to, p, count * sizeof(double));
    return p + count;
}

int law_load(law_t *l, const char *path) {
    static double numbers[4 * ORDER * ORDER + 4096];
    FILE *f = fopen(path, "rb");
    if (!f) return -1;
    size_t count = fread(numbers, sizeof(double), sizeof numbers / sizeof *numbers, f);
    fclose(f);
    const double *p = numbers;
    memset(l, 0, sizeof *l);
    l->n = (int)*p++, l->sensors_used = (int)*p++, l->mkf = (int)*p++;
    for (int k = 0; k < l->sensors_used; k++) l->sensors[k] = (int)*p++;
    for (int c = 0; c < N * KINDS; c++) l->reading_bit[c] = (int)*p++;
    for (int m = 0; m < M; m++) l->predicts[m] = *p++ > 0.0;
    l->expands = *p++ > 0.0;
    p = take(p, l->A, l->n * l->n), p = take(p, l->B, l->n * 2), p = take(p, l->C, M * l->n);
    p = take(p, l->K, l->n * l->sensors_used), p = take(p, l->b1, M), p = take(p, l->b2, M);
    double *scalars[] = {&l->b_air, &l->f1, &l->offset_um, &l->expansion_period_s, &l->R_w, &l->R_v, &l->air_filter_s,
        &l->model_period_s, &l->period_s, &l->a1a1, &l->first_gain, &l->correction_step_s,
        &l->kp, &l->ti_s, &l->td_s, &l->output_limit,
        &l->setpoint_rate_um_s, &l->setpoint_low_um, &l->setpoint_high_um};
    for (unsigned k = 0; k < sizeof scalars / sizeof *scalars; k++) *scalars[k] = *p++;
    l->average_length = (int)*p++, l->compensate_on = *p++ > 0.0, l->position_mode = *p++ > 0.0;
    l->bound_um = *p++, l->slew_um_s = *p++;
    p = take(p, l->low, N), p = take(p, l->high, N), p = take(p, l->rate, N);
    p = take(p, l->stale_s, N), p = take(p, l->frozen_s, N), p = take(p, l->required, N);
    double *limits[] = {&l->following_um, &l->following_limit_s, &l->coil_limit_c, &l->coil_rate_limit, &l->coil_rate_time_s,
        &l->innovation_limit_c, &l->innovation_time_s, &l->power_limit_w, &l->power_time_s, &l->idle_current_a,
        &l->idle_power_w, &l->idle_limit_s, &l->saturation_limit_s, &l->amplifier_limit_s, &l->late_s, &l->agree_time_s,
        &l->drift_limit_c, &l->monitored_limit_c, &l->resistance_current_a, &l->resistance_ohm, &l->resistance_tolerance, &l->resistance_v,
        &l->current_per_drive, &l->current_tolerance_a, &l->flexure_um_per_a, &l->position_tolerance_um,
        &l->reference_tolerance_um, &l->order_limit_c};
    for (unsigned k = 0; k < sizeof limits / sizeof *limits; k++) *limits[k] = *p++;
    l->trip_others = (uint64_t)*p++, l->critical = (uint64_t)*p++;
    l->P = 1e3 * l->R_v;
    for (int c = 0; c < N; c++) l->value[c] = NAN, l->status[c] = ABSENT;
    return (size_t)(p - numbers) == count ? 0 : -2;
}

static void judge_reading(law_t *l, int c, double value) {
    double late = 0.025 * l->delay[c], elapsed = l->since_s[c] - late;
    if (elapsed < l->period_s) elapsed = l->period_s;
    int thermal = c >= THERMAL && c < THERMAL_END;
    double allowed = l->rate[c] * (thermal && elapsed < 0.1 ? 0.1 : elapsed);
    int jumped = l->seen[c] > 0.0 && fabs(value - l->last[c]) > allowed;
    if (!(l->low[c] <= value && value <= l->high[c]) || !finite_(value)) {
        l->verdict[c] = 1.0 + K_RANGE;
    } else if (jumped && thermal && l->suspect[c] == 0.0) {
        l->suspect[c] = 1.0;
    } else {
        if (l->seen[c] > 0.0 && value == l->last[c]) l->same_s[c] += elapsed;
        else l->same_s[c] = 0.0;
        if (jumped) l->verdict[c] = 1.0 + K_RATE;
        else l->verdict[c] = l->same_s[c] > l->frozen_s[c] ? 1.0 + K_FROZEN : 0.0;
        l->last[c] = value;
        l->seen[c] = 1.0;
        l->suspect[c] = 0.0;
        l->since_s[c] = late;
    }
}

static void judge_readings(law_t *l, double dt) {
    l->faults = l->trips = 0;
    l->hold = 0;
    for (int c = 0; c < N; c++) {
        l->age[c] += l->dt;
        l->since_s[c] += l->dt;
        int status = l->status[c], fresh = l->fresh[c];
        double value = l->value[c];
        if (status == ABSENT && c == COIL && l->by_resistance) {
            if (!l->coil_fresh) {
                if (l->seen[c] == 0.0 || l->age[c] > RESISTANCE_LATE_S) l->verdict[c] = 1.0 + K_ERROR;
                continue;
            }
            status = OK, fresh = 1, value = l->ohm_c;
        } else if (status == ABSENT && l->required[c] == 0.0) {
            l->verdict[c] = 1.0 + K_ERROR;
            continue;
        }
        if (status == ERROR || status == ABSENT) {
            l->verdict[c] = 1.0 + K_ERROR;
        } else if (status == STALE) {
            l->verdict[c] = 1.0 + K_STALE;
        } else if (fresh) {
            judge_reading(l, c, value);
            l->age[c] = 0.0;
        } else if (l->age[c] > l->stale_s[c] || (l->seen[c] == 0.0 && l->verdict[c] == 0.0)) {
            l->verdict[c] = 1.0 + K_STALE;
        }
        if (l->verdict[c] > 0.0) {
            int kind = (int)l->verdict[c] - 1;
            uint64_t bit = BIT(l->reading_bit[c * KINDS + kind]);
            l->faults |= bit;
            if (l->required[c] > 0.0) {
                l->trips |= bit;
                if (c == VOLTAGE || c == CURRENT || c == AIR || c == COIL) l->hold = 1;
            }
        }
    }
    if (dt > l->late_s) l->faults |= BIT(B_LATE);
    l->reports = l->status[AMPLIFIER_STATE] == OK;
    l->enabled = l->reports && l->value[AMPLIFIER_STATE] == 2.0;
}

static void forget(law_t *l) {
    for (int i = 0; i < l->n; i++) l->x[i] = l->corrections[i] = 0.0;
    l->corrected = l->primed = l->air_known = l->resumed = l->model_error_c = l->innovation_mean_c = 0.0;
    l->P = 1e3 * l->R_v;
}

static void start_air(law_t *l, double value) {
    l->air_c = value;
    l->air_known = 1.0;
    if (l->air_started == 0.0) l->air_start_c = value, l->air_started = 1.0;
}

static void average_air_start(law_t *l) {
    l->air_started += 1.0;
    double s = (l->last[AIR] - l->air_c) / l->air_started;
    l->air_c += s;
    l->air_start_c = l->air_c;
    if (l->corrected > 0.0)
        for (int i = 0; i < l->n; i++) l->x[i] += l->B[2 * i + 1] / l->model_period_s * s;
}

static double resistance(law_t *l) {
    double s = 20.0;
    if (l->predicts[0] && l->air_known > 0.0) s = l->T[0] + l->air_c;
    else if (l->verdict[COIL] == 0.0) s = l->last[COIL];
    return l->resistance_ohm * (1.0 + COPPER * (s - 20.0));
}

static void measure_resistance(law_t *l) {
    l->coil_fresh = 0;
    l->by_resistance = l->resistance_ohm > 0.0 && l->required[COIL] == 0.0 && l->status[VOLTAGE] != ABSENT
                       && l->status[CURRENT] != ABSENT;
    if (!l->by_resistance) return;
    double part = least(1.0, l->dt / RESISTANCE_S);
    if (l->verdict[VOLTAGE] == 0.0 && l->verdict[CURRENT] == 0.0) {
        l->ohm_w += part * (l->last[VOLTAGE] * l->last[CURRENT] - l->ohm_w);
        l->ohm_a2 += part * (l->last[CURRENT] * l->last[CURRENT] - l->ohm_a2);
    }
    l->ohm_s = l->ohm_a2 > l->resistance_current_a * l->resistance_current_a ? l->ohm_s + l->dt : 0.0;
    if (l->ohm_s >= 2.0 * RESISTANCE_S) {
        l->ohm_s -= RESISTANCE_S;
        l->ohm_c = 20.0 + (l->ohm_w / (l->resistance_ohm * l->ohm_a2) - 1.0) / COPPER;
        l->coil_fresh = 1;
    }
}

static void power_and_air(law_t *l) {
    l->powered = l->status[CURRENT] != ABSENT && (l->status[VOLTAGE] != ABSENT || l->resistance_ohm > 0.0);
    if (l->verdict[VOLTAGE] == 0.0 && l->verdict[CURRENT] == 0.0) l->power_w = l->last[VOLTAGE] * l->last[CURRENT];
    else if (l->status[VOLTAGE] == ABSENT && l->verdict[CURRENT] == 0.0)
        l->power_w = resistance(l) * l->last[CURRENT] * l->last[CURRENT];
    else if (l->enable == 0.0) l->power_w = 0.0;
    l->power_mean_w += (l->power_w - l->power_mean_w) * least(1.0, l->dt / l->power_time_s);
    l->air_rate_k_s = 0.0;
    if (l->verdict[AIR] == 0.0) {
        if (l->air_known == 0.0) start_air(l, l->last[AIR]);
        else if (l->air_started < AIR_READINGS && l->fresh[AIR]) average_air_start(l);
        l->air_rate_k_s = (l->last[AIR] - l->air_c) / l->air_filter_s;
        l->air_c += l->air_rate_k_s * l->dt;
    }
}

static void predict_corrections(law_t *l, double elapsed) {
    double left = least(elapsed, 10.0);
    int n = l->n;
    while (left > 0.0) {
        double step = least(left, l->correction_step_s);
        left -= step;
        for (int i = 0; i < n; i++) {
            double s = 0.0;
            for (int j = 0; j < n; j++) s += l->A[i * n + j] * l->corrections[j];
            l->dx[i] = s;
        }
        for (int i = 0; i < n; i++) l->corrections[i] += step / l->model_period_s * l->dx[i];
    }
    double s = l->e[0];
    for (int j = 0; j < n; j++) s += l->C[j] * l->corrections[j];
    l->model_error_c = s;
}

static void correct(law_t *l) {
    int coil_new = l->coil_fresh && l->verdict[COIL] == 0.0 && l->suspect[COIL] == 0.0, n = l->n;
    if (l->resumed > 0.0 && coil_new) {
        double s = l->last[COIL] - l->air_c;
        for (int j = 0; j < n; j++) s -= l->C[j] * l->x[j];
        l->resumed = 0.0;
        l->coil_slow_c = l->last[COIL];
        if (!(fabs(s) <= 2.0)) {
            forget(l);
            l->air_started = 0.0;
            if (l->verdict[AIR] == 0.0) start_air(l, l->last[AIR]);
        }
    }
    if (l->air_known == 0.0 && coil_new) start_air(l, l->last[COIL]);
    if (l->corrected == 0.0 && !coil_new) {
        if (l->status[COIL] == ABSENT && l->air_started >= AIR_READINGS) l->corrected = 1.0;
        return;
    }
    for (int k = 0; k < l->sensors_used; k++) {
        int c = COIL + l->sensors[k];
        l->e[k] = 0.0;
        int new = c == COIL ? coil_new : l->fresh[c] && l->verdict[c] == 0.0 && l->suspect[c] == 0.0;
        if (new) {
            double s = l->last[c] - l->air_c;
            for (int j = 0; j < n; j++) s -= l->C[l->sensors[k] * n + j] * l->x[j];
            l->e[k] = s;
        }
    }
    if (coil_new) {
        double elapsed = l->corrected == 0.0 ? l->dt : l->coil_elapsed_s;
        l->coil_elapsed_s = 0.0;
        if (l->corrected == 0.0) {
            for (int i = 0; i < n; i++) l->x[i] += l->first_gain * l->K[i * l->sensors_used] * l->e[0];
            l->coil_slow_c = l->last[COIL];
            l->coil_rate_k_s = 0.0;
            l->corrected = 1.0;
            l->primed = 0.0;
            return;
        }
        predict_corrections(l, elapsed);
        l->innovation_c = l->e[0];
        l->innovation_mean_c += (l->e[0] - l->innovation_mean_c) * least(1.0, elapsed / l->innovation_time_s);
        l->coil_rate_k_s = (l->last[COIL] - l->coil_slow_c) / l->coil_rate_time_s;
        l->coil_slow_c += l->coil_rate_k_s * least(elapsed, l->coil_rate_time_s);
    }
    double gain = 1.0;
    if (l->mkf) {
        if (!coil_new) return;
        double prior = l->a1a1 * l->P + l->R_w;
        gain = prior / (prior + l->R_v);
        l->P = prior * (1.0 - gain);
    }
    l->kalman_gain = gain;
    for (int k = 0; k < l->sensors_used; k++)
        if (l->e[k] != 0.0)
            for (int i = 0; i < n; i++) {
                l->x[i] += gain * l->K[i * l->sensors_used + k] * l->e[k];
                l->corrections[i] += gain * l->K[i * l->sensors_used + k] * l->e[k];
            }
}

static void estimate(law_t *l, double dt) {
    int n = l->n;
    l->dt = finite_(dt) ? clip(dt, 0.0, 1.0) : 0.0;
    l->tick += 1;
    l->coil_elapsed_s += l->dt;
    if (dt > 10.0) forget(l);
    l->coil_fresh = l->fresh[COIL];
    if (l->status[COIL] == ABSENT) measure_resistance(l);
    judge_readings(l, dt);
    power_and_air(l);
    double scale = l->dt / l->model_period_s;
    for (int i = 0; i < n; i++) {
        double s = l->B[2 * i] * l->power_w + l->B[2 * i + 1] * l->air_rate_k_s;
        for (int j = 0; j < n; j++) s += l->A[i * n + j] * l->x[j];
        l->dx[i] = s;
    }
    for (int i = 0; i < n; i++) l->x[i] += scale * l->dx[i];
    if (!l->hold) correct(l);
    for (int m = 0; m < M; m++) {
        double s = 0.0;
        for (int j = 0; j < n; j++) s += l->C[m * n + j] * l->x[j];
        l->T[m] = s;
    }
}

static void compensate(law_t *l) {
    if (l->primed == 0.0) {
        double s = l->b_air * (l->air_c - l->air_start_c);
        for (int m = 0; m < M; m++) {
            s += (l->b1[m] + l->b2[m]) * l->T[m];
            l->T_before[m] = l->T[m];
        }
        l->expansion_before_um = l->expansion_after_um = s / (1.0 - l->f1);
        l->phase_s = 0.0;
        if (l->air_started >= AIR_READINGS || l->verdict[AIR] > 0.0) l->primed = l->corrected;
    }
    l->phase_s += l->dt;
    if (l->phase_s >= l->expansion_period_s) {
        l->phase_s -= l->expansion_period_s;
        double s = l->f1 * l->expansion_after_um + l->b_air * (l->air_c - l->air_start_c);
        for (int m = 0; m < M; m++) {
            s += l->b1[m] * l->T_before[m] + l->b2[m] * l->T[m];
            l->T_before[m] = l->T[m];
        }
        l->expansion_before_um = l->expansion_after_um;
        l->expansion_after_um = s;
    }
    double part = least(1.0, l->phase_s / l->expansion_period_s);
    l->expansion_um = (l->expansion_before_um + part * (l->expansion_after_um - l->expansion_before_um)) + l->offset_um;
    double target = l->compensate_on ? l->expansion_um : 0.0;
    if (!(fabs(target) <= l->bound_um)) {
        l->faults |= BIT(B_BOUND);
        target = finite_(target) ? clip(target, -l->bound_um, l->bound_um) : l->compensation_um;
    }
    if (l->hold) return;
    if (l->state == ARMED) {
        double step = l->slew_um_s * l->dt;
        if (l->primed > 0.0 && fabs(target - l->compensation_um) > 2.0 * step) l->faults |= BIT(B_SLEWING);
        target = clip(target, l->compensation_um - step, l->compensation_um + step);
    }
    l->compensation_um = target;
}

static double target(law_t *l) {
    return clip(l->reference_um - l->compensation_um, -l->output_limit, l->output_limit);
}

static void control(law_t *l, int command, double command_value) {
    if (l->fresh[POSITION] && l->verdict[POSITION] == 0.0) {
        if (l->averaged == 0)
            for (int k = 0; k < AVERAGE; k++) l->average[k] = l->value[POSITION];
        l->averaged = l->average_length;
        l->average[l->average_at] = l->value[POSITION];
        l->average_at = l->average_at + 1 < l->average_length ? l->average_at + 1 : 0;
        double s = 0.0;
        for (int k = 0; k < l->average_length; k++) s += l->average[k];
        l->position_um = s / l->average_length;
    }
    l->compensated_um = l->position_um + l->compensation_um;
    if (l->state != ARMED) {
        l->setpoint_um = l->compensated_um;
    } else {
        if (command == SETPOINT && finite_(command_value)) l->setpoint_um = command_value;
        l->setpoint_um = clip(l->setpoint_um, l->setpoint_low_um, l->setpoint_high_um);
    }
    if (l->state != ARMED || (l->reports && !l->enabled)) {
        l->reference_um = l->compensated_um;
        l->v = l->eps1 = l->d1 = 0.0;
        if (l->position_mode) l->v = target(l);
        return;
    }
    double step = l->setpoint_rate_um_s * l->dt;
    l->reference_um = clip(l->setpoint_um, l->reference_um - step, l->reference_um + step);
    double eps = l->reference_um - l->compensated_um, change = eps - l->eps1;
    if (l->position_mode) {
        l->v = target(l), l->eps1 = eps;
        return;
    }
    double d = l->dt > 0.0 ? change / l->dt : 0.0;
    l->v = clip(l->v + l->kp * (change + l->dt / l->ti_s * eps + l->td_s * (d - l->d1)), -l->output_limit, l->output_limit);
    l->eps1 = eps;
    l->d1 = d;
}

static int64_t next_state(int64_t state, int command, int started, int tripped, int critical) {
    if (!started || state == OFF) return started ? SAFE : OFF;
    if (critical) return FAULT;
    if (state == ARMED) return tripped ? FAULT : command == DISARM ? SAFE : ARMED;
    if (state == FAULT) return command == DISARM && !tripped ? SAFE : FAULT;
    if (tripped) return SAFE;
    return state == READY && command == ARM ? ARMED : READY;
}

static void compare_order(law_t *l) {
    l->exchanged = 0.0;
    for (int m = 1; m < M; m++)
        for (int k = 0; k < m; k++)
            if (l->predicts[m] && l->predicts[k] && l->verdict[COIL + m] == 0.0 && l->verdict[COIL + k] == 0.0) {
                double s = l->T[m] - l->T[k];
                if ((s + l->apart_c[m] - l->apart_c[k]) * s < -l->order_limit_c * l->order_limit_c) l->exchanged = 1.0;
            }
}

static void compare_drive(law_t *l, double amperes) {
    l->drive_low = least(l->drive_low, l->drive);
    l->drive_high = most(l->drive_high, l->drive);
    if (l->fresh[CURRENT] && l->current_per_drive != 0.0) {
        double low = least(l->drive_low, l->drive_low_before), high = most(l->drive_high, l->drive_high_before);
        l->current_apart_a = amperes - l->current_per_drive * clip(amperes / l->current_per_drive, low, high);
        l->drive_low_before = l->drive_low;
        l->drive_high_before = l->drive_high;
        l->drive_low = l->drive_high = l->drive;
    }
}

static void compare_position(law_t *l, double position, double held) {
    if (l->zeroed == 0.0) {
        l->position_zero_um = position - held;
        l->zeroed = l->state != OFF ? 1.0 : 0.0;
    }
    l->position_low_um = least(l->position_low_um, position);
    l->position_high_um = most(l->position_high_um, position);
    if (l->fresh[CURRENT]) {
        double expected = held + l->position_zero_um;
        double low = least(l->position_low_um, l->position_low_before_um);
        double high = most(l->position_high_um, l->position_high_before_um);
        l->position_apart_um = clip(expected, low, high) - expected;
        l->position_low_before_um = l->position_low_um;
        l->position_high_before_um = l->position_high_um;
        l->position_low_um = l->position_high_um = position;
    }
}

static void agree(law_t *l) {
    double part = least(1.0, l->dt / l->agree_time_s), s;
    int current = l->verdict[CURRENT] == 0.0;
    double amperes = current ? l->last[CURRENT] : 0.0;
    int estimated = l->predicts[0] && l->air_known > 0.0;
    if (current && l->verdict[VOLTAGE] == 0.0 && l->resistance_ohm > 0.0 && (estimated || l->verdict[COIL] == 0.0)) {
        s = resistance(l) * amperes;
        l->ohm_v += part * (l->last[VOLTAGE] - s - l->ohm_v);
        double a = fabs(l->last[VOLTAGE]), b = fabs(s);
        l->ohm_scale_v += part * ((b > a ? b : a) - l->ohm_scale_v);
        if (fabs(l->ohm_v) > l->resistance_tolerance * l->ohm_scale_v + l->resistance_v) l->faults |= BIT(B_ELECTRICAL);
    }
    compare_drive(l, amperes);
    if (l->state != ARMED || !current || l->current_per_drive == 0.0) {
        l->current_error_a = 0.0;
    } else {
        l->current_error_a += part * (l->current_apart_a - l->current_error_a);
        if (fabs(l->current_error_a) > l->current_tolerance_a) l->faults |= BIT(B_NOT_FOLLOWING);
    }
    if (current && l->verdict[POSITION] == 0.0 && l->flexure_um_per_a != 0.0) {
        compare_position(l, l->last[POSITION], l->flexure_um_per_a * amperes);
        l->displaced_um += part * (l->position_apart_um - l->displaced_um);
        if (fabs(l->displaced_um) > l->position_tolerance_um) l->faults |= BIT(B_DISPLACED);
    }
    if (l->corrected == 0.0) return;
    part = least(1.0, l->dt / l->innovation_time_s);
    for (int m = 0; m < M; m++)
        if (l->verdict[COIL + m] == 0.0 && l->predicts[m]) {
            l->apart_c[m] += part * (l->last[COIL + m] - l->air_c - l->T[m] - l->apart_c[m]);
            if (m > 0 && fabs(l->apart_c[m]) > l->monitored_limit_c) l->faults |= BIT(B_MONITORED);
        }
    if (l->coil_fresh) compare_order(l);
    if (l->exchanged > 0.0) l->faults |= BIT(B_MONITORED);
    if (l->expands && l->verdict[REFERENCE] == 0.0 && l->verdict[POSITION] == 0.0) {
        s = l->last[REFERENCE] - l->last[POSITION] - l->expansion_um;
        if (l->reference_zeroed == 0.0) l->reference_zero_um = s, l->reference_zeroed = l->state != OFF ? 1.0 : 0.0;
        part = least(1.0, l->dt / l->agree_time_s);
        l->reference_error_um += part * (s - l->reference_zero_um - l->reference_error_um);
        if (fabs(l->reference_error_um) > l->reference_tolerance_um) l->faults |= BIT(B_MONITORED);
    }
}

static void watch_amplifier(law_t *l) {
    int told = l->state == ARMED;
    if (!told) l->driving = 0.0;
    if (l->reports && l->value[AMPLIFIER_STATE] == 3.0) l->faults |= BIT(B_AMPLIFIER);
    else if (l->reports && !l->enabled && l->driving > 0.0) l->faults |= BIT(B_STOPPED);
    if (told && l->enabled) l->driving = 1.0;
    int waits = l->reports && l->enabled != told && l->driving == 0.0;
    l->amplifier_s = waits ? l->amplifier_s + l->dt : 0.0;
    if (l->amplifier_s > l->amplifier_limit_s) l->faults |= BIT(B_NOT_FOLLOWING);
}

static void protect(law_t *l, int command, uint64_t external) {
    uint64_t found = external;
    if (l->state == ARMED) {
        l->following_s = fabs(l->eps1) > l->following_um ? l->following_s + l->dt : 0.0;
        if (l->following_s > l->following_limit_s || fabs(l->eps1) > 2.0 * l->following_um) found |= BIT(B_FOLLOWING);
        l->saturation_s = fabs(l->v) >= l->output_limit ? l->saturation_s + l->dt : 0.0;
        if (l->saturation_s > l->saturation_limit_s) found |= BIT(B_SATURATED);
        l->idle_s = l->idle_readings = 0.0;
    } else {
        l->following_s = l->saturation_s = 0.0;
        if (l->fresh[CURRENT]) l->idle_readings += 1.0;
        int driven = l->verdict[CURRENT] == 0.0 && l->idle_readings > 1.0
                     && (fabs(l->last[CURRENT]) > l->idle_current_a || fabs(l->power_w) > l->idle_power_w);
        l->idle_s = fmax(0.0, fmin(l->idle_s, l->idle_limit_s) + (driven ? l->dt : -0.25 * l->dt));
        if (l->idle_s > l->idle_limit_s) found |= BIT(B_STUCK);
    }
    if (l->verdict[COIL] == 0.0 && l->last[COIL] > l->coil_limit_c) found |= BIT(B_HOT);
    if (l->T[0] + l->air_c > l->coil_limit_c) found |= BIT(B_HOT_MODEL);
    if (l->coil_rate_k_s > l->coil_rate_limit) found |= BIT(B_HEATING);
    if (l->predicts[0] && (fabs(l->innovation_mean_c) > l->innovation_limit_c || fabs(l->model_error_c) > l->drift_limit_c))
        found |= BIT(B_DISAGREES);
    if (l->power_mean_w > l->power_limit_w) found |= BIT(B_POWER);
    if (!(finite_(l->v) && finite_(l->reference_um) && finite_(l->compensated_um) && finite_(l->T[0])
          && finite_(l->expansion_um) && finite_(l->power_w))) found |= BIT(B_NOT_FINITE);
    watch_amplifier(l);
    agree(l);
    l->faults |= found;
    l->trips |= l->faults & l->trip_others;
    int64_t before = l->state;
    int tripped = l->trips != 0 || (before < ARMED && l->amplifier_s > 0.0);
    l->state = next_state(before, command, l->tick > 100, tripped, (l->trips & l->critical) != 0);
    l->latched = l->state == FAULT ? l->latched | l->trips : 0;
    if (before == ARMED && l->state != ARMED) l->v = l->eps1 = l->d1 = 0.0;
    l->control_v = l->v;
    l->enable = l->state == ARMED && finite_(l->v) ? 1.0 : 0.0;
    l->drive = l->enable > 0.0 ? clip(l->v, -l->output_limit, l->output_limit) : 0.0;
    double *o = l->out;
    uint64_t bits = l->faults | l->latched;
    o[0] = l->state, o[1] = bits & (BIT(53) - 1), o[2] = bits >> 53, o[3] = l->setpoint_um, o[4] = l->reference_um;
    o[5] = l->position_um, o[6] = l->compensated_um, o[7] = l->compensation_um, o[8] = l->expansion_um;
    o[9] = l->control_v, o[10] = l->drive, o[11] = l->enable, o[12] = l->powered ? l->power_w : NAN, o[13] = l->air_rate_k_s;
    o[14] = l->innovation_c, o[15] = l->kalman_gain, o[16] = l->age[POSITION], o[17] = l->age[COIL];
    for (int m = 0; m < M; m++) o[18 + m] = l->T[m] + l->air_c;
}

void law_step(law_t *l, double dt, int command, double command_value, uint64_t external) {
    estimate(l, dt);
    compensate(l);
    control(l, command, command_value);
    protect(l, command, external);
}

/* Axes of one daemon, one after the other, as run_loop ticks them: an axis in FAULT by a fault of its own disarms the others.
 * The readings of every tick go in, each row of outputs into a ring. */
static law_t axes[AXES];
static double rows[8192][OUTPUTS + N];
int axes_load(const char *path) {
    for (int a = 0; a < AXES; a++)
        if (law_load(&axes[a], path)) return -1;
    return 0;
}
void axes_run(long count, int used, const double *values, const uint8_t *fresh, const uint8_t *status, double dt,
              double *outputs) {
    for (long k = 0; k < count; k++)
        for (int a = 0; a < used; a++) {
            law_t *l = &axes[a];
            uint64_t external = 0;
            for (int b = 0; b < used; b++)
                if (b != a && axes[b].state == FAULT && axes[b].latched & ~BIT(B_OTHER_AXIS) && l->state != FAULT)
                    external = BIT(B_OTHER_AXIS);
            memcpy(l->value, values + k * N, sizeof l->value);
            memcpy(l->fresh, fresh + k * N, N);
            memcpy(l->status, status + k * N, N);
            law_step(l, dt, 0, 0.0, external);
            double *row = rows[l->tick % 8192];
            memcpy(row, l->value, sizeof l->value);
            memcpy(row + N, l->out, sizeof l->out);
        }
    memcpy(outputs, axes[0].out, sizeof axes[0].out);
}

/* For the batch figure: `count` ticks with readings (count, N) as the loop would get them; outputs (count, OUTPUTS). */
static law_t the_law;
int batch_load(const char *path) { return law_load(&the_law, path); }
void batch_run(long count, const double *values, const uint8_t *fresh, const uint8_t *status, const double *dt,
               const int *commands, const double *command_values, double *outputs) {
    for (long k = 0; k < count; k++) {
        memcpy(the_law.value, values + k * N, sizeof the_law.value);
        memcpy(the_law.fresh, fresh + k * N, N);
        memcpy(the_law.status, status + k * N, N);
        law_step(&the_law, dt[k], commands[k], command_values[k], 0);
        memcpy(outputs + k * OUTPUTS, the_law.out, sizeof the_law.out);
    }
}
