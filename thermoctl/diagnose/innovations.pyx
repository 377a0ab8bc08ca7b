# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Innovations of a residual under many colours of noise at once: w = ar(z)/ma(z) e, and their variance,

    V = mean(min(|w|, L)^2),   L = 5 max(s, 0.3 rms(w)),   s = 1.2533 mean(min(|w|, 5 s))

(s: a normal sigma from the mean size; two rounds from all of |w|), so that an outlier counts as one of five sigmas."""
import numpy as np
from libc.math cimport fabs, sqrt


cdef double _clipped(double[::1] w, Py_ssize_t n, double limit, bint squared) noexcept nogil:
    cdef double total = 0, a
    cdef Py_ssize_t k
    for k in range(n):
        a = fabs(w[k])
        a = limit if a > limit else a
        total += a * a if squared else a
    return total / n


cdef void _filtered(double[::1] e, Py_ssize_t start, Py_ssize_t end, double[::1] ar, double[::1] ma, Py_ssize_t order,
                    double[::1] z, double[::1] w) noexcept nogil:
    cdef Py_ssize_t k, i
    cdef double x, y, phi, theta, before = 0
    if order == 0:
        for k in range(start, end):
            w[k] = e[k]
    elif order == 1:
        phi, theta, y = ar[1], ma[1], 0
        for k in range(start, end):
            y = e[k] + phi * before - theta * y
            before = e[k]
            w[k] = y
        w[start] *= sqrt(1 - phi * phi)         # the first sample comes from the stationary distribution
    else:
        for i in range(order + 1):
            z[i] = 0
        for k in range(start, end):
            x = e[k]
            y = x + z[0]
            for i in range(order):
                z[i] = ar[i + 1] * x + z[i + 1] - ma[i + 1] * y
            w[k] = y


def variances(double[::1] e, Py_ssize_t[::1] ends, double[:, ::1] ar, double[:, ::1] ma, Py_ssize_t[::1] orders):
    """(F,) variances of the innovations of e (N,), whose parts end at `ends` and are filtered each by itself, under each of F
    colours, ar and ma (F, K), of orders (F,) < K."""
    cdef Py_ssize_t F = ar.shape[0], n = e.shape[0], f, p, start, r
    out_ = np.empty(F)
    cdef double[::1] out = out_, w = np.empty(n), z = np.empty(ar.shape[1] + 1)
    cdef double spread, raw, size
    with nogil:
        for f in range(F):
            start = 0
            for p in range(ends.shape[0]):
                _filtered(e, start, ends[p], ar[f], ma[f], orders[f], z, w)
                start = ends[p]
            raw = _clipped(w, n, 1e300, True)
            size = 1e300
            for r in range(3):
                spread = 1.2533141373155 * _clipped(w, n, size, False)
                size = 5 * spread
            size = 5 * max(spread, 0.3 * sqrt(raw))
            out[f] = _clipped(w, n, size, True)
    return out_
