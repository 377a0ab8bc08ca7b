# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The time loops of the concealed truths, compiled. Each has the arithmetic of a loop in Python, named at its function.

tests/concealed/test_loops.py compares both; `make same-cases` compares whole cases, byte by byte. Built by
tests/concealed/compiled.py when the generator is first imported.
"""

from libc.math cimport M_PI, exp, fabs, fmax, fmin, fmod, pow, sin, sqrt, copysign
from libc.string cimport memcpy, memset

import numpy as np

cdef enum:
    FEW_ROWS = 16


# ------------------------------------------------------------------------------------------ thermal networks
def thermal(modes, v, run, double[:, :, ::1] out):
    """March all rows of a thermal truth: fills `out` (m, N, bodies), degC. In Python: thermal.march_in_python.

    `modes` a thermal.Modes, `v` the rows as thermal.Rows. Temperatures that no row's forces read, and forces that are zero,
    cost nothing: most rows differ from the truth at one or two bodies."""
    cdef:
        int rows = out.shape[0], samples = out.shape[1], nb = out.shape[2]
        int n = modes.rate.shape[0], ne = len(modes.g0), nj = len(v.heat_body), nl = len(v.links)
        bint g_varies = v.g_varies
        double melt_at = run.get("melt_at", 0.0)
        double[::1] t = np.ascontiguousarray(run["t"], float), air = np.ascontiguousarray(run["air"], float)
        double[::1] speed = _track(run, "velocity"), place = _track(run, "position"), base = _track(run, "base")
        double[:, ::1] column = np.array([run[name] for name in v.heat_columns], float).reshape(nj, samples)
        double[:, ::1] decay = modes.decay, phi1 = modes.phi1, phi2 = modes.phi2, push = modes.push
        double[:, ::1] start = modes.start(v, run), cool = modes.hidden_start(v, run)
        double[::1] g0 = modes.g0, c0 = modes.c0
        int[::1] a = modes.a.astype(np.intc), b = modes.b.astype(np.intc), heated = v.heat_body.astype(np.intc)
        double[:, ::1] g = v.g, c = v.c, hid_c = v.hid_c, copper = v.copper, heat_scale = v.heat_scale
        double[:, ::1] t0 = v.t0, t1 = v.t1
        double[:, :, ::1] split = v.split
        double[:, ::1] rad = v.body["rad"], nat = v.body["nat"], q = v.body["q"], eddy = v.body["eddy"]
        double[:, ::1] hyst = v.body["hyst"], cap = v.body["cap"], based = v.body["base"], hid_g = v.body["hid_g"]
        double[:, ::1] hid_air = v.body["hid_air"], melt = v.body["melt"], burst = v.body["burst"]
        double[:, ::1] temp = v.edge["temp"], pos = v.edge["pos"], step = v.edge["step"]
        double[:, ::1] fan = v.edge["fan"], forced = v.edge["forced"]
        int[:, ::1] ends = np.array([u[:3] for u in v.links] or [[-1, 0, 0]], np.intc)  # row, body, body
        double[::1] link_g = np.array([u[3] for u in v.links] or [0.0], float)
        unsigned char[:, ::1] need = v.needed(modes)  # temperatures (m, 2 bodies) that a row's forces read
        bint[:, ::1] plain = np.array(v.g == modes.g0, np.intc)  # flows (m, flows) as in the truth
        bint[:, ::1] foreign = np.zeros((rows, nb), np.intc)  # bodies (m, bodies) with a heat of their own
        bint[::1] resized = np.zeros(rows, np.intc)
        double[:, ::1] zs = np.array(start), z1s = np.zeros((rows, n)), f0s = np.zeros((rows, n))
        double[:, ::1] temps = np.zeros((rows, 2 * nb))  # surface temperatures, then means
        double[:, ::1] hids = np.zeros((rows, 2 * nb)), hid_rates = np.zeros((rows, 2 * nb))  # and predicted ones
        double[:, ::1] fans = np.zeros((rows, ne))
        double[:, ::1] scratch = np.zeros((4, max(n, 2 * nb + 1)))
        double *f1 = &scratch[0, 0]
        double *watts = &scratch[1, 0]     # at the surfaces, then spread over the bodies
        double *net = &scratch[2, 0]
        double *heat = &scratch[3, 0]
        double *z = NULL
        double *z1 = NULL
        double *f0 = NULL
        double *seen = NULL
        double *hid = NULL
        double *hid_rate = NULL
        double *fan_on = NULL
        double *f = NULL
        double *d = NULL
        double *now_z = NULL
        double *now_hid = NULL
        double ts, other, now, room, flux, linear, cond, w, rise, x, share, storage, h = 0.0
        int r, k, s, i, j, e, l, body, first
        bint c_varies

    for r in range(rows):
        memcpy(&hids[r, 0], &cool[r, 0], nb * sizeof(double))
        for i in range(nb):
            resized[r] |= c[r, i] != c0[i] or cap[r, i] != 0 or melt[r, i] != 0
            foreign[r, i] = (rad[r, i] != 0 or nat[r, i] != 0 or q[r, i] != 0 or eddy[r, i] != 0 or hyst[r, i] != 0
                             or based[r, i] != 0 or burst[r, i] != 0 or hid_g[r, i] != 0 or hid_air[r, i] != 0)
        for e in range(ne):
            plain[r, e] &= not (g_varies and (temp[r, e] != 0 or step[r, e] != 0 or forced[r, e] != 0
                                              or pos[r, e] != 0 or fan[r, e] != 0))
    # a few rows at a time: their modes, and a sample's factors, stay in the fastest cache
    for first in range(0, rows, FEW_ROWS):
        for k in range(samples):
            for r in range(first, min(first + FEW_ROWS, rows)):
                z, z1, f0, seen, fan_on = &zs[r, 0], &z1s[r, 0], &f0s[r, 0], &temps[r, 0], &fans[r, 0]
                hid, hid_rate, c_varies = &hids[r, 0], &hid_rates[r, 0], resized[r]
                for s in range(2):  # the two stages of ETD2RK
                    if s == 0:
                        now_z, now_hid, f, d, room, now = z, hid, f0, hid_rate, air[k], t[k] - t[0]
                    else:
                        now_z, now_hid, f, d, room = z1, hid + nb, f1, hid_rate + nb, air[k + 1]
                        now = t[k + 1] - t[0] - 1e-9
                    for i in range(2 * nb):
                        if need[r, i] or (s == 0 and i >= nb):
                            x = 0.0
                            for j in range(n):
                                x += now_z[j] * push[i, j]
                            seen[i] = x
                    if s == 0:
                        for i in range(nb):
                            out[r, k, i] = seen[nb + i]
                        if k == samples - 1:
                            break
                    # flows between surfaces
                    for i in range(nb):
                        watts[i] = net[i] = heat[i] = 0.0
                    for e in range(ne):
                        if plain[r, e] and not c_varies:  # nothing beside its part of the modes
                            if b[e] == nb:
                                watts[a[e]] += g0[e] * room
                            continue
                        ts = seen[a[e]]
                        other = seen[b[e]] if b[e] < nb else room
                        cond = g[r, e]
                        if g_varies:
                            if temp[r, e] != 0:
                                cond *= fmax(1 + temp[r, e] * (ts - 20), 0.05)
                            if step[r, e] != 0:
                                cond *= 1 + step[r, e] * (now >= t0[r, 0])
                            if forced[r, e] != 0:
                                cond *= 1 + forced[r, e] * sqrt(fabs(speed[k]))
                            if pos[r, e] != 0:
                                cond *= 1 + pos[r, e] * place[k]
                            if fan[r, e] != 0:
                                x = ts - air[k]
                                fan_on[e] = 1.0 if x > 8 else 0.0 if x < 5 else fan_on[e]
                                cond *= 1 + fan[r, e] * fan_on[e]
                        flux = cond * (ts - other)
                        if b[e] < nb:
                            linear = (cond - g0[e]) * (ts - other)
                            net[b[e]] += flux
                            watts[b[e]] += linear
                        else:
                            linear = (cond - g0[e]) * ts - cond * other
                        net[a[e]] -= flux
                        watts[a[e]] -= linear
                    # foreign heat at the surfaces; `net` collects all that comes in
                    for i in range(nb):
                        if not foreign[r, i]:
                            continue
                        ts = seen[i]
                        rise = ts - room
                        w = 0.0
                        if rad[r, i] != 0:
                            x, share = (ts + 273.15) * (ts + 273.15), (room + 273.15) * (room + 273.15)
                            w -= rad[r, i] * (x * x - share * share)
                        if nat[r, i] != 0:
                            w -= nat[r, i] * rise * sqrt(sqrt(fabs(rise)))
                        if q[r, i] != 0:
                            w += q[r, i] * (now >= t0[r, 0] and now < t1[r, 0])
                        if eddy[r, i] != 0:
                            w += eddy[r, i] * speed[k] * speed[k]
                        if hyst[r, i] != 0:
                            w += hyst[r, i] * fabs(speed[k])
                        if based[r, i] != 0:
                            w -= based[r, i] * (ts - base[k])
                        if burst[r, i] != 0:
                            w -= burst[r, i] * fmax(rise - 4, 0.0) * (fmod(now, 240.0) < 40)
                        if hid_g[r, i] != 0 or hid_air[r, i] != 0:
                            x = hid_g[r, i] * (ts - now_hid[i])
                            d[i] = (x - hid_air[r, i] * (now_hid[i] - room)) / hid_c[r, i]
                            w -= x
                        watts[i] += w
                        net[i] += w
                    for l in range(nl):
                        if ends[l, 0] == r:
                            x = link_g[l] * (seen[ends[l, 1]] - seen[ends[l, 2]])
                            watts[ends[l, 1]] -= x
                            net[ends[l, 1]] -= x
                            watts[ends[l, 2]] += x
                            net[ends[l, 2]] += x
                    # Joule heat in the volumes
                    for j in range(nj):
                        body = heated[j]
                        w = column[j, k] * heat_scale[r, j]
                        if copper[r, j] != 0:
                            w *= 1 + copper[r, j] * (seen[nb + body] - 20)
                        heat[body] += w
                        x = 0.0
                        for i in range(nb):
                            share = split[r, j, i] * w
                            heat[i] += share
                            x += share
                        heat[body] -= x
                    for i in range(nb):
                        watts[nb + i] = heat[i]
                        if c_varies and (c[r, i] != c0[i] or cap[r, i] != 0 or melt[r, i] != 0):
                            storage = c[r, i] * fmax(1 + cap[r, i] * (seen[nb + i] - 20), 0.1)
                            if melt[r, i] != 0:
                                x = seen[nb + i] - melt_at
                                storage *= 1 + melt[r, i] * exp(-0.5 * x * x)
                            watts[nb + i] += (c0[i] / storage - 1) * (net[i] + heat[i])
                    memset(f, 0, n * sizeof(double))
                    for i in range(2 * nb):
                        w = watts[i]
                        if w != 0:
                            for j in range(n):
                                f[j] += w * push[i, j]
                    if s == 0:
                        h = t[k + 1] - t[k]
                        for j in range(n):
                            z1[j] = z[j] * decay[k, j] + phi1[k, j] * f0[j]
                        for i in range(nb):
                            hid[nb + i] = hid[i] + h * hid_rate[i]
                    else:
                        for j in range(n):
                            z[j] = z1[j] + phi2[k, j] * (f1[j] - f0[j])
                        for i in range(nb):
                            hid[i] += h / 2 * (hid_rate[i] + hid_rate[nb + i])


def _track(run, name):
    """A recorded course (N,) of a run; zero where the rig has none."""
    return np.ascontiguousarray(run[name] if name in run else np.zeros(len(run["t"])), float)


# ------------------------------------------------------------------------------------------ motion
def motion(dict p, dict e, dict run, bint heated, bint dry, bint delayed,
           double[:, ::1] position, double[:, ::1] velocity, double[:, ::1] coil):
    """Integrate all rows of a motion truth: fills three arrays (m, N). In Python: rigs_motion.march_in_python.

    `p` parameters and starts by name (m,), `e` effect parameters by name (m,); `dry`, `delayed`: some row has such an effect."""
    cdef:
        int rows = position.shape[0], samples = position.shape[1], substeps = run["substeps"], r, k, s
        bint held = run["held"]
        double[::1] t = np.ascontiguousarray(run["t"], float), u = np.ascontiguousarray(run["drive"], float)
        double[::1] air = np.ascontiguousarray(run["air"], float)
        double[::1] area = run["area"]
        double[::1] gain = p["gain"], mass = p["mass"], damping = p["damping"], stiffness = p["stiffness"]
        double[::1] ohm = p["R"], heat_c = p["C_coil"], heat_g = p["G_coil"], copper = p["copper"]
        double[::1] x_start = p["start"], coil_start = p["start_coil"]
        double[::1] viscous = e["viscous_friction.B"], coulomb = e["coulomb_friction.F"]
        double[::1] st_fc = e["stribeck_friction.FC"], st_fs = e["stribeck_friction.FS"]
        double[::1] st_vs = e["stribeck_friction.VS"]
        double[::1] fp = e["directional_friction.FP"], fm = e["directional_friction.FM"]
        double[::1] bp = e["directional_friction.BP"], bm = e["directional_friction.BM"]
        double[::1] load = e["constant_load.F"], drag = e["quadratic_drag.B"], cubic = e["cubic_stiffness.K"]
        double[::1] cog_a = e["cogging.A"], cog_p = e["cogging.P"], cog_phi = e["cogging.PHI"]
        double[::1] bouc_f = e["backlash_hysteresis.F"], bouc_x = e["backlash_hysteresis.X"]
        double[::1] creep_k = e["creep.K"], creep_tau = e["creep.TAU"]
        double[::1] warm = e["force_constant_temperature.B"], far = e["position_dependent_force_constant.A"]
        double[::1] most = e["actuator_saturation.U"], dead = e["actuator_dead_zone.U"], late = e["actuator_delay.TD"]
        double[::1] sticky_f = e["?sticky_zone.F"], sticky_x = e["?sticky_zone.X"]
        double[::1] second_k = e["?second_mass.K"], second_m = e["?second_mass.M"], one_way = e["?one_way_gain.A"]
        double x, v, c, rest, bouc, x2, v2, h, drive, sent, motor, force, rate, free, push, new, limit, left
        double half, pull, begin, watts, room, settle, fade, last_h, last_rate, faded_h
        int at

    for r in range(rows):
        x = rest = x2 = x_start[r]
        v = v2 = bouc = free = push = fade = 0.0
        c = coil_start[r]
        last_h = last_rate = faded_h = -1.0
        at = 0
        for k in range(samples):
            position[r, k], velocity[r, k], coil[r, k] = x, v, c
            if k == samples - 1:
                break
            h = (t[k + 1] - t[k]) / substeps
            for s in range(substeps):
                x = x + v * (h / 2)
                if delayed:
                    begin = t[k] + s * h - late[r]
                    if held:
                        drive = (_until(begin + h, t, area, u[0], &at) - _until(begin, t, area, u[0], &at)) / h
                    else:
                        drive = _between((begin + (begin + h)) / 2, t, u, &at)
                elif held:
                    drive = u[k]
                else:
                    drive = u[k] + (u[k + 1] - u[k]) * (s + 0.5) / substeps
                sent = fmin(fmax(drive, -most[r]), most[r])
                if fabs(sent) < dead[r]:
                    sent = 0.0
                if one_way[r] != 0:
                    sent *= 1 + one_way[r] * (sent * v > 0)
                motor = gain[r]
                if warm[r] != 0:
                    motor *= 1 - warm[r] * (c - 20)
                if far[r] != 0:
                    motor *= 1 - far[r] * x * x
                force = motor * sent - stiffness[r] * x - load[r]
                if cubic[r] != 0:
                    force -= cubic[r] * x * x * x
                if cog_a[r] != 0:
                    force += cog_a[r] * sin(2 * M_PI * x / cog_p[r] + cog_phi[r])
                if drag[r] != 0:
                    force -= drag[r] * v * fabs(v)
                if bouc_f[r] != 0:
                    half = bouc + (v - 0.5 * (fabs(v) * bouc + v * fabs(bouc))) / bouc_x[r] * (h / 2)
                    bouc = bouc + (v - 0.5 * (fabs(v) * half + v * fabs(half))) / bouc_x[r] * h
                    force -= bouc_f[r] * bouc
                if creep_k[r] != 0:
                    rest = x + (rest - x) * exp(-h / creep_tau[r])
                    force -= creep_k[r] * (x - rest)
                if second_k[r] != 0:
                    pull = second_k[r] * (x2 - x) + 0.02 * sqrt(second_k[r] * second_m[r]) * (v2 - v)
                    v2 = v2 - pull / second_m[r] * h
                    x2 = x2 + v2 * h
                    force += pull
                rate = damping[r] + viscous[r] + (bp[r] if v > 0 else bm[r])
                if h != last_h or rate != last_rate:
                    free = exp(-rate * h / mass[r])
                    push = (1 - free) / rate if rate > 1e-9 else h / mass[r]
                    last_h, last_rate = h, rate
                new = v * free + push * force
                if dry:
                    limit = coulomb[r] + st_fc[r] + (fp[r] if new > 0 else fm[r])
                    if st_fs[r] != 0:
                        limit += st_fs[r] * exp(-(v / st_vs[r]) * (v / st_vs[r]))
                    if x > sticky_x[r]:
                        limit += sticky_f[r]
                    left = fabs(new) - push * limit
                    new = 0.0 if left <= 0 else copysign(left, new)
                v = new
                x = x + v * (h / 2)
                if heated:
                    watts = ohm[r] * drive * drive * (1 + 0.00393 * (c - 20) * copper[r])
                    room = air[k] + (air[k + 1] - air[k]) * (s + 0.5) / substeps
                    settle = room + watts / heat_g[r]
                    if h != faded_h:
                        fade, faded_h = exp(-heat_g[r] / heat_c[r] * h), h
                    c = settle + (c - settle) * fade


cdef double _between(double x, double[::1] t, double[::1] y, int *at) noexcept:
    """np.interp at one place; `at` is where the last search ended."""
    cdef int last = t.shape[0] - 1
    if x <= t[0]:
        return y[0]
    if x >= t[last]:
        return y[last]
    while t[at[0]] > x:
        at[0] -= 1
    while t[at[0] + 1] <= x:
        at[0] += 1
    return y[at[0]] + (y[at[0] + 1] - y[at[0]]) / (t[at[0] + 1] - t[at[0]]) * (x - t[at[0]])


cdef double _until(double when, double[::1] t, double[::1] area, double first, int *at) noexcept:
    """Integral of a held drive up to a time."""
    return _between(when, t, area, at) + first * fmin(when - t[0], 0.0)


# ------------------------------------------------------------------------------------------ tanks
def tank_rate(double k_pump, double[::1] k, double[::1] power, double[::1] rim, double share,
              double[::1] siphon, double[::1] clog):
    """Rates of tank levels as a function (levels, time, pump) for scipy's odeint. In Python: rigs_tanks.rate_in_python.

    The function gives the same array again at each call; odeint copies it."""
    cdef int n = k.shape[0]
    given = np.empty(n)
    cdef double[::1] d = given
    special = bool(np.any(siphon) or np.any(clog))
    cdef bint strange = special

    def rate(double[::1] x, double now, double u):
        """Return the levels' rates (n,), V/s."""
        cdef double over_flow = 0.0, over_spill = 0.0, level, flow, spill
        cdef int i
        for i in range(n):
            level = fmax(x[i], 0.0)
            flow = k[i] * pow(level, power[i])
            if strange:
                flow *= (1 + siphon[i] / (1 + exp(-(level - 4.0) / 0.05))) * (1 - clog[i] * (fmod(now, 700.0) / 700.0))
            spill = fmax(level - rim[i], 0.0) * 5.0
            d[i] = -flow - spill + (k_pump * u if i == 0 else over_flow + share * over_spill)
            over_flow, over_spill = flow, spill
        return given

    return rate


# ------------------------------------------------------------------------------------------ sensors
def lag(const double[::1] y, double[::1] e, double[::1] gain):
    """First-order lag (N,) of y (N,) with each step's decay `e` and `gain` (N-1,). In Python: sensors.lag_in_python."""
    out = np.empty(y.shape[0])
    cdef double[::1] lagged = out
    cdef int k
    cdef double z = y[0]
    lagged[0] = z
    for k in range(e.shape[0]):
        z = z * e[k] + y[k] * (gain[k] - e[k]) + y[k + 1] * (1 - gain[k])
        lagged[k + 1] = z
    return out
