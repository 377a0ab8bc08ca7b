# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The loops of identification that must be fast. Pure arithmetic on float64 arrays.

    linear simulation         x(n+1) = A x(n) + B u(n),  y(n) = C x(n)                          (31), (32)
    square-root RLS           R, z of the information form, updated by Givens rotations (stays symmetric)
    steady-state filter       x = A x + B u; x += K (y - C_s x)
"""
import numpy as np
from libc.math cimport sqrt, isnan


def simulate(double[:, ::1] a, double[:, ::1] b, double[:, ::1] c, double[::1] x0, double[:, ::1] u):
    """Return y (N, l) of x(n+1) = A x + B u, y = C x, from x0 (n,), without correction; u (N, m)."""
    cdef Py_ssize_t n = a.shape[0], m = b.shape[1], l = c.shape[0], N = u.shape[0], i, j, k
    y_ = np.empty((N, l))
    cdef double[:, ::1] y = y_
    cdef double[::1] x = np.array(x0), w = np.empty(n)
    cdef double s
    for k in range(N):
        for i in range(l):
            s = 0
            for j in range(n):
                s += c[i, j] * x[j]
            y[k, i] = s
        for i in range(n):
            s = 0
            for j in range(n):
                s += a[i, j] * x[j]
            for j in range(m):
                s += b[i, j] * u[k, j]
            w[i] = s
        x[:] = w
    return y_


cdef inline double _givens(double* r, double* row, Py_ssize_t n, double root_lam) noexcept nogil:
    """Rotate `row` (n + 1 numbers, measurement last) into the triangle r (n, n + 1); return its residual."""
    cdef Py_ssize_t i, j
    cdef double a, b, h, c, s, t
    for i in range(n * (n + 1)):
        r[i] *= root_lam
    for i in range(n):
        b = row[i]
        if b == 0:
            continue
        a = r[i * (n + 1) + i]
        h = sqrt(a * a + b * b)
        c = a / h
        s = b / h
        for j in range(i, n + 1):
            t = r[i * (n + 1) + j]
            r[i * (n + 1) + j] = c * t + s * row[j]
            row[j] = c * row[j] - s * t
    return row[n]


def bank_run(double[:, :, ::1] r, double[::1] cost, double[:, ::1] state, double[::1] poles,
             double[:, ::1] t, double[::1] y, double lam, double[:, ::1] last):
    """Update online output-error models in place: for every fixed pole f1 its own square-root RLS.

    The inputs are filtered by 1/(z - f1). p = 2 M + 2 regressors: [t(n-1), t(n)] filtered, the constant, the
    initial output's decay.

        r       (P, p, p + 1) triangles
        cost    (P,) weighted sums of squared errors
        state   (P, p - 1) filtered inputs and the decay of the initial output
        last    (1, M) the previous temperatures
        t, y    (N, M) temperature rises; (N,) measured output (NaN: none)
    """
    cdef Py_ssize_t P = poles.shape[0], M = t.shape[1], N = y.shape[0], p = 2 * M + 2, k, i, j
    cdef double[::1] w = np.empty(p + 1)
    cdef double root = sqrt(lam), f, g, e
    for k in range(N):
        for i in range(P):
            f = poles[i]
            g = 1 - f
            if not isnan(y[k]):
                for j in range(2 * M):
                    w[j] = state[i, j]
                w[2 * M] = state[i, 2 * M]
                w[2 * M + 1] = 1
                w[p] = y[k]
                e = _givens(&r[i, 0, 0], &w[0], p, root)
                cost[i] = lam * cost[i] + e * e
            for j in range(M):
                state[i, j] = f * state[i, j] + g * last[0, j]
                state[i, M + j] = f * state[i, M + j] + g * t[k, j]
            state[i, 2 * M] *= f
        for j in range(M):
            last[0, j] = t[k, j]


def steady_filter(double[:, ::1] a, double[:, ::1] b, double[:, ::1] cs, double[:, ::1] gain, double[::1] x0,
                  double[:, ::1] u, double[:, ::1] y):
    """Return the filtered states (N, n) of a steady Kalman filter.

    Each step corrects with y(n) (NaN: no sample), then predicts with u(n).
    """
    cdef Py_ssize_t n = a.shape[0], m = b.shape[1], s = cs.shape[0], N = u.shape[0], i, j, k
    out_ = np.empty((N, n))
    cdef double[:, ::1] out = out_
    cdef double[::1] x = np.array(x0), e = np.empty(s), w = np.empty(n)
    cdef double v
    for k in range(N):
        for i in range(s):
            v = y[k, i]
            if isnan(v):
                e[i] = 0
                continue
            for j in range(n):
                v -= cs[i, j] * x[j]
            e[i] = v
        for j in range(n):
            v = x[j]
            for i in range(s):
                v += gain[j, i] * e[i]
            x[j] = v
            out[k, j] = v
        for i in range(n):
            v = 0
            for j in range(n):
                v += a[i, j] * x[j]
            for j in range(m):
                v += b[i, j] * u[k, j]
            w[i] = v
        x[:] = w
    return out_
