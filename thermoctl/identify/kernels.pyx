# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The loops of identification that must be fast. Pure arithmetic on float64 arrays.

    linear simulation         x(n+1) = A x(n) + B u(n),  y(n) = C x(n)                          (31), (32)
    steady-state filter       x = A x + B u; x += K (y - C_s x)
"""
import numpy as np
from libc.math cimport isnan


def simulate(a, b, c, x0, u):
    """Return y (N, l) of x(n+1) = A x + B u, y = C x, from x0 (n,), without correction; u (N, m)."""
    n, N = len(a), len(u)
    return steady_filter(a, b, np.empty((0, n)), np.empty((n, 0)), x0, u, np.empty((N, 0))) @ np.asarray(c).T


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
