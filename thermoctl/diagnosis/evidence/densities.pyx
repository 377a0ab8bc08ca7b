# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False, language_level=3
"""Log densities of an output's residual in its frequencies, integrated by Laplace's method (noise.py).

Three densities of x and the powers P (nodes,):

    noise        x: log c^2 and, where it may be seen, log j^2 over its median
    slow noise   x: these, then standard normal values as probable as the slow parts' sizes and time
    remainder    x: these, then u

Each has V, d log V / dx, and slope and exact curvature of minus the log density. The expected curvature
(Fisher) misleads where a residual spans many decades. Newton's method with damping finds the maximum.
"""
import numpy as np
from libc.math cimport cos, erfc, exp, fabs, fmax, fmin, log, sqrt, INFINITY, M_PI
from libc.string cimport memcpy, memset
from scipy.linalg.cython_lapack cimport dpotrf, dpotrs

NOISE, SLOW, REMAINDER = range(3)

cdef double CLOSE = 1e-4  # predicted gain that ends Newton's method
cdef double LONGEST = 10.0  # step in a logarithm that is tried
cdef double DAMPED = 0.01  # first damping of a step, as a share of the curvature
cdef int STEPS = 1000  # largest number of steps


cdef class Spot:
    """A log density at x (k,): V (nodes,), d log V / dx (nodes, k).

    `uphill` (k,) and `curvature` (k, k) are of minus the log density."""
    cdef readonly double log_density
    cdef readonly object x, variance, slope, uphill, curvature
    cdef double[::1] _x, _variance, _uphill
    cdef double[:, ::1] _slope, _curvature, _part  # _part: room for terms of V and their derivatives

    def __init__(self, Py_ssize_t nodes, Py_ssize_t k):
        self.x, self.variance, self.uphill = np.zeros(k), np.zeros(nodes), np.zeros(k)
        self.slope, self.curvature = np.zeros((nodes, k)), np.zeros((k, k))
        self._x, self._variance, self._uphill = self.x, self.variance, self.uphill
        self._slope, self._curvature, self._part = self.slope, self.curvature, np.zeros((10, nodes))


cdef class Density:
    """One density of an output's residual.

    - `kind`: NOISE, SLOW or REMAINDER
    - `count`, `shape`, `turn` (nodes,), `variance`, `clock`, `small`, `scales`: of its Grid
    - `slow` (3, 2): least and largest log size, time and size of the slow parts
    - `diagonal` (nodes,), `beside` (nodes - 1,): of u's tridiagonal precision
    - `spread`: share of the remainder's energy at all frequencies
    - `starts` (n, 3), `spectra` (n, nodes): x of the slow parts, and their spectra"""
    cdef readonly int kind
    cdef readonly Py_ssize_t size
    cdef Py_ssize_t nodes, first
    cdef double variance, clock, small, spread, rows
    cdef double[::1] count, shape, turn, scales, diagonal, beside, logs, cosine
    cdef double[:, ::1] slow, starts, spectra
    cdef object made_of

    def __init__(self, int kind, count, shape, turn, scales, double variance, double clock, double small, double spread,
                 slow, diagonal, beside, starts, spectra):
        self.made_of = (kind, count, shape, turn, scales, variance, clock, small, spread, slow, diagonal, beside, starts,
                        spectra)
        self.kind, self.nodes, self.first = kind, len(count), len(scales)
        self.size = self.first + (0, 3, self.nodes)[kind]
        self.variance, self.clock, self.small, self.spread = variance, clock, small, spread
        self.count, self.shape, self.turn, self.scales = count, shape, turn, scales
        self.slow, self.diagonal, self.beside = slow, diagonal, beside
        self.starts, self.spectra = (starts, spectra) if kind == SLOW else (np.zeros((1, 0)), shape[None])
        self.logs, self.cosine, self.rows = np.log(self.spectra) @ count, np.cos(turn), count.sum()

    def __reduce__(self):  # to another process
        return Density, self.made_of

    def at(self, double[::1] x, double[::1] power):
        """Return the Spot at x."""
        cdef Spot found = Spot(self.nodes, self.size)
        found._x[:] = x
        self._look(power, found)
        return found

    def start(self, double[::1] power):
        """Return x to start from: of noises the likeliest of some, the times without an error."""
        x = np.zeros(self.size)
        cdef double[::1] to = x
        cdef Py_ssize_t i, k, best = 0
        cdef double whole, level, score, top = -INFINITY
        if self.kind == 2:
            for i in range(self.nodes):
                level = power[i] / self.count[i] / self.small
                to[self.first + i] = log(fmin(level, sqrt(level * self.rows)))
            return x
        for k in range(self.spectra.shape[0]):
            whole = 0
            for i in range(self.nodes):
                whole += power[i] / self.spectra[k, i]
            level = log(whole / self.rows / self.variance)
            score = -0.5 * (self.rows * level + (level / self.scales[0]) ** 2 + self.logs[k])
            if score > top:
                top, best, to[0] = score, k, level
        for k in range(self.size - self.first):
            to[self.first + k] = self.starts[best, k]
        return x

    cdef void _look(self, double[::1] power, Spot found):
        if self.kind == 2:
            self._remainder(power, found)
        else:
            self._noise(power, found)

    cdef void _noise(self, double[::1] power, Spot found):
        """Noise, with or without slow parts that nobody stated."""
        cdef Py_ssize_t n = self.nodes, first = self.first, k = self.size, i, a, b, at
        cdef double[::1] x = found._x
        cdef double[:, ::1] slope = found._slope, h = found._curvature
        cdef double noise = self.variance * exp(x[0]), timing = self.variance * self.clock * exp(x[first - 1])
        cdef double v, p, pull, weight, density = 0, prior
        cdef double[:, ::1] part = found._part  # shape, its 3 slopes, its 6 second derivatives
        if self.kind == 1:
            self._slow_parts(x, part)
        else:
            part[0, :] = self.shape
        h[:, :] = 0
        found._uphill[:] = 0
        for i in range(n):
            v = noise * part[0, i] + (timing if first > 1 else 0.0)
            found._variance[i] = v
            slope[i, 0] = noise * part[0, i] / v
            if first > 1:
                slope[i, 1] = timing / v
            for a in range(first, k):
                slope[i, a] = noise * part[1 + a - first, i] / v
            p = power[i] / v
            density += self.count[i] * log(v) + p
            weight, pull = p - 0.5 * self.count[i], 0.5 * (self.count[i] - p)
            for a in range(k):
                found._uphill[a] += pull * slope[i, a]
                for b in range(a + 1):
                    h[a, b] += weight * slope[i, a] * slope[i, b]
            h[0, 0] += pull * slope[i, 0]
            if first > 1:
                h[1, 1] += pull * slope[i, 1]
            at = 4
            for a in range(first, k):
                h[a, 0] += pull * slope[i, a]
                for b in range(first, a + 1):
                    h[a, b] += pull * noise * part[at, i] / v
                    at += 1
        for a in range(k):
            prior = self.scales[a] ** -2.0 if a < first else 1.0
            found._uphill[a] += prior * x[a]
            h[a, a] += prior
            density += prior * x[a] ** 2
            for b in range(a):
                h[b, a] = h[a, b]
        found.log_density = -0.5 * density

    cdef void _slow_parts(self, double[::1] x, double[:, ::1] part):
        """Write the spectrum with slow parts, its mean over all rows 1, and its derivatives by x."""
        cdef Py_ssize_t n = self.nodes, i, a, b, at
        cdef double[3] value, step, y, drift
        cdef double[6] bend
        cdef double first, other, phi, below, near, far, by_time, curved, whole = 0, w
        for a in range(3):
            y[a] = x[self.first + a]
            w = self.slow[a, 1] - self.slow[a, 0]
            value[a] = exp(self.slow[a, 0] + w * 0.5 * erfc(-y[a] / sqrt(2.0)))
            step[a] = w * exp(-0.5 * y[a] ** 2) / sqrt(2 * M_PI)
        phi = exp(-1 / value[1])
        far = phi / (1 - phi**2)
        for i in range(n):
            below = 1 - 2 * phi * self.cosine[i] + phi**2
            first = value[0] ** 2 * (1 - phi**2) / below
            other = value[2] ** 2 * M_PI / (log(10.0) * self.turn[i])
            near = (self.cosine[i] - phi) / below
            by_time = 2 * phi / value[1] * (near - far)
            curved = (1 / value[1] - 1) * by_time
            curved += 2 * (phi / value[1]) ** 2 * (2 * near**2 - 1 / below - (1 + phi**2) / (1 - phi**2) ** 2)
            part[0, i] = 1 + first + other
            part[1, i] = 2 * first * step[0]
            part[2, i] = by_time * first * step[1]
            part[3, i] = 2 * other * step[2]
            part[4, i] = part[1, i] * (2 * step[0] - y[0])
            part[5, i] = part[2, i] * 2 * step[0]
            part[6, i] = part[2, i] * (by_time * step[1] - y[1]) + first * curved * step[1] ** 2
            part[7, i] = part[8, i] = 0
            part[9, i] = part[3, i] * (2 * step[2] - y[2])
            whole += part[0, i] * self.count[i]
        whole /= self.rows
        memset(drift, 0, sizeof(drift))
        memset(bend, 0, sizeof(bend))
        for i in range(n):
            for a in range(10):
                part[a, i] /= whole
            for a in range(3):
                drift[a] += part[1 + a, i] * self.count[i] / self.rows
            for a in range(6):
                bend[a] += part[4 + a, i] * self.count[i] / self.rows
        for i in range(n):
            at = 0
            for a in range(3):
                for b in range(a + 1):
                    part[4 + at, i] += part[0, i] * (2 * drift[a] * drift[b] - bend[at])
                    part[4 + at, i] -= part[1 + a, i] * drift[b] + part[1 + b, i] * drift[a]
                    at += 1
            for a in range(3):
                part[1 + a, i] -= part[0, i] * drift[a]

    cdef void _remainder(self, double[::1] power, Spot found):
        """Noise as stated and a remainder: V_i = noise_i + own_i + sum of common_j, which holds for all i."""
        cdef Py_ssize_t n = self.nodes, first = self.first, k = self.size, i, j, a
        cdef double[::1] x = found._x, v = found._variance, uphill = found._uphill
        cdef double[:, ::1] slope = found._slope, h = found._curvature
        cdef double[::1] noise = found._part[0], own = found._part[1], common = found._part[2]
        cdef double[::1] pull = found._part[3], weight = found._part[4], part = found._part[5]
        cdef double level = self.variance * exp(x[0]), timing = self.variance * self.clock * exp(x[first - 1])
        cdef double whole = 0, density = 0, p, free, pulls = 0, weights = 0, crossed = 0, timed = 0, prior, cj
        for i in range(n):
            free = exp(x[first + i])
            part[i] = self.count[i] * free / self.rows
            own[i], common[i] = self.small * free, self.small * self.spread * part[i]
            whole += part[i]
        density = whole
        memset(&uphill[0], 0, k * sizeof(double))
        for a in range(first):
            for j in range(a + 1):
                h[a, j] = 0
        for i in range(n):
            noise[i] = level * self.shape[i]
            v[i] = noise[i] + own[i] + self.small * self.spread * whole + (timing if first > 1 else 0.0)
            p = power[i] / v[i]
            density += self.count[i] * log(v[i]) + p
            pull[i] = 0.5 * (self.count[i] - p) / v[i]
            weight[i] = (p - 0.5 * self.count[i]) / v[i] ** 2
            pulls += pull[i]
            weights += weight[i]
            crossed += noise[i] * weight[i]
            timed += timing * weight[i]
            uphill[0] += noise[i] * pull[i]
            h[0, 0] += noise[i] ** 2 * weight[i]
            if first > 1:
                uphill[1] += timing * pull[i]
                h[1, 0] += noise[i] * timing * weight[i]
                h[1, 1] += timing**2 * weight[i]
        for j in range(n):
            a, cj = first + j, common[j]
            uphill[a] = cj * pulls + own[j] * pull[j] + 0.5 * part[j]
            h[a, 0] = cj * crossed + noise[j] * own[j] * weight[j]
            if first > 1:
                h[a, 1] = cj * timed + timing * own[j] * weight[j]
            for i in range(j):
                h[a, first + i] = cj * common[i] * weights + cj * own[i] * weight[i] + common[i] * own[j] * weight[j]
            h[a, a] = cj**2 * weights + 2 * cj * own[j] * weight[j] + own[j] ** 2 * weight[j] + self.diagonal[j]
            if j:
                h[a, a - 1] += self.beside[j - 1]
        for a in range(first):
            h[a, a] += self.scales[a] ** -2.0
        for a in range(k):  # d2V / dx2 is diagonal: each term is an exponential of its own x
            h[a, a] += uphill[a]
            for j in range(a):
                h[j, a] = h[a, j]
        for a in range(first):
            prior = x[a] / self.scales[a] ** 2
            uphill[a] += prior
            density += x[a] * prior
        for j in range(n):
            a = first + j
            prior = self.diagonal[j] * x[a]
            if j:
                prior += self.beside[j - 1] * x[a - 1]
            if j + 1 < n:
                prior += self.beside[j] * x[a + 1]
            uphill[a] += prior
            density += x[a] * prior
        for i in range(n):
            slope[i, 0] = noise[i] / v[i]
            if first > 1:
                slope[i, 1] = timing / v[i]
            for j in range(n):
                slope[i, first + j] = common[j] / v[i]
            slope[i, first + i] += own[i] / v[i]
        found.log_density = -0.5 * density

    def top(self, double[::1] power, near=None):
        """Return the Spot at the maximum, from `near` or a start of its own, and the curvature's root (k, k).

        The root is lower triangular; above its diagonal are other numbers."""
        cdef Spot at = Spot(self.nodes, self.size), then = Spot(self.nodes, self.size)
        cdef int k = self.size, turn, a
        cdef double damping = 0, up, longest
        root = np.empty((k, k))
        cdef double[:, ::1] factor = root
        cdef double[::1] step = np.empty(k), begin = self.start(power) if near is None else near
        at._x[:] = begin
        self._look(power, at)
        for turn in range(STEPS):
            longest = INFINITY
            if _factored(at._curvature, damping, factor):
                up = _solved(factor, at._uphill, step)
                longest = 0
                for a in range(k):
                    longest = fmax(longest, fabs(step[a]))
                if 0.5 * up < CLOSE and (not damping or _factored(at._curvature, 0, factor)):
                    break
            if longest < LONGEST:
                for a in range(k):
                    then._x[a] = at._x[a] - step[a]
                self._look(power, then)
            if longest < LONGEST and then.log_density >= at.log_density:
                at, then = then, at
                damping = damping / 4 if damping > DAMPED else 0.0
            else:
                damping = fmax(4 * damping, DAMPED)
        return at, root


cdef bint _factored(double[:, ::1] h, double damping, double[:, ::1] factor):
    """Write the lower root of h + damping |diag h| to `factor`; is it positive definite?"""
    cdef int k = h.shape[0], bad, a
    cdef char upper = b"U"  # of columns: the lower triangle of these rows
    memcpy(&factor[0, 0], &h[0, 0], k * k * sizeof(double))
    for a in range(k):
        factor[a, a] += damping * fabs(h[a, a])
    dpotrf(&upper, &k, &factor[0, 0], &k, &bad)
    return not bad


cdef double _solved(double[:, ::1] factor, double[::1] right, double[::1] step):
    """Write the solution to `step`; return its product with the right-hand side."""
    cdef int k = factor.shape[0], one = 1, bad, a
    cdef char upper = b"U"
    cdef double up = 0
    step[:] = right
    dpotrs(&upper, &k, &one, &factor[0, 0], &k, &step[0], &k, &bad)
    for a in range(k):
        up += right[a] * step[a]
    return up
