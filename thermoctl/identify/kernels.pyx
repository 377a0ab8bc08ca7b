# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The loops of identification that must be fast. Pure arithmetic on float64 arrays.

    linear simulation         x(n+1) = A x(n) + B u(n),  y(n) = C x(n)                          (31), (32)
    modal states              s_k(n+1) = l_k s_k(n) + u(n): one row of the regression for B and x(0)
    block moments             means of the outputs and Gram moments of the inputs over blocks of q samples
    recursive least squares   (5) with weight lambda: L = Q f/(lambda + f'Q f); Q = (Q - L f'Q)/lambda
    square-root RLS           R, z of the information form, updated by Givens rotations (stays symmetric)
    steady-state filter       x = A x + B u; x += K (y - C_s x)            also with A diagonal (modal form)
    MKF                       (34), (35) with the scalar gain
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


def modal_states(double complex[::1] poles, double[::1] u):
    """Return s_k(n+1) = l_k s_k(n) + u(n) from 0 for every pole, (n, N) complex."""
    cdef Py_ssize_t n = poles.shape[0], N = u.shape[0], i, k
    s_ = np.empty((n, N), dtype=complex)
    cdef double complex[:, ::1] s = s_
    cdef double complex v, l
    for i in range(n):
        v = 0
        l = poles[i]
        for k in range(N):
            s[i, k] = v
            v = l * v + u[k]
    return s_


def decays(double[::1] poles, double[:, ::1] u):
    """Simulate s_k(n+1) = l_k s_k(n) + u_k(n) from 0 and its derivative by l_k; u (K, N) -> s, ds (K, N)."""
    cdef Py_ssize_t K = poles.shape[0], N = u.shape[1], i, k
    s_ = np.empty((K, N))
    d_ = np.empty((K, N))
    cdef double[:, ::1] s = s_, d = d_
    cdef double v, w, l
    for i in range(K):
        v = 0
        w = 0
        l = poles[i]
        for k in range(N):
            s[i, k] = v
            d[i, k] = w
            w = l * w + v
            v = l * v + u[i, k]
    return s_, d_


def block_moments(double[:, ::1] z, Py_ssize_t m, double[:, ::1] weights, double[:, :, ::1] u_moment,
                  double[:, ::1] y_sum, double[:, ::1] y_count, Py_ssize_t start):
    """Add the samples z (N, m + l) = [inputs, outputs] to the sums u_moment (J, m, r), y_sum, y_count (J, l).

    weights (r, q): row p is the p-th polynomial at the q places of a block. `start` is the first row's index.
    A missing output (NaN) is left out. A missing input counts as 0; the caller fills inputs first.
    """
    cdef Py_ssize_t N = z.shape[0], l = z.shape[1] - m, r = weights.shape[0], q = weights.shape[1]
    cdef Py_ssize_t k, j, i, p, place
    cdef double v
    place = start % q
    j = start // q
    for k in range(N):
        if j >= y_sum.shape[0]:
            return
        for i in range(m):
            v = z[k, i]
            for p in range(r):
                u_moment[j, i, p] += v * weights[p, place]
        for i in range(l):
            v = z[k, m + i]
            if not isnan(v):
                y_sum[j, i] += v
                y_count[j, i] += 1
        place += 1
        if place == q:
            place = 0
            j += 1


cdef extern from *:
    """
    /* Written so that every inner loop runs along a row without a sum across it: it vectorises at -O3 with the same bits. */
    __attribute__((optimize("O3")))
    static double rls_c(double *restrict theta, double *restrict q, const double *restrict f, double y, double lam,
                        double *restrict g, long n) {
        double d = lam, e = y, over_lam = 1 / lam, over_d;
        for (long j = 0; j < n; j++) g[j] = 0;
        for (long i = 0; i < n; i++) {              /* g = Q f by rows; Q is symmetric */
            double fi = f[i]; const double *row = q + i * n;
            for (long j = 0; j < n; j++) g[j] += fi * row[j];
        }
        for (long i = 0; i < n; i++) { d += f[i] * g[i]; e -= f[i] * theta[i]; }
        over_d = 1 / d;
        for (long i = 0; i < n; i++) theta[i] += g[i] * over_d * e;
        for (long i = 0; i < n; i++) {
            double gi = g[i]; double *row = q + i * n;
            for (long j = 0; j < n; j++) row[j] = (row[j] - gi * g[j] * over_d) * over_lam;
        }
        return e;
    }
    """
    double rls_c(double* theta, double* q, const double* f, double y, double lam, double* g, long n) noexcept nogil


def rls_run(double[::1] theta, double[:, ::1] q, double[:, ::1] f, double[::1] y, double lam):
    """Run (5) over all rows of f (N, p), y (N,), in place; return the prediction errors (N,)."""
    cdef Py_ssize_t N = f.shape[0], k, n = theta.shape[0]
    e_ = np.empty(N)
    cdef double[::1] e = e_, w = np.empty(n)
    with nogil:
        for k in range(N):
            e[k] = rls_c(&theta[0], &q[0, 0], &f[k, 0], y[k], lam, &w[0], n)
    return e_


def rls_own_output(double[::1] theta, double[:, ::1] q, double[:, ::1] f, double[::1] y, double lam, double y0):
    """Run (5) with the model's own past output as the last regressor, as in (3).

    f (N, p - 1) are the inputs.
    """
    cdef Py_ssize_t N = f.shape[0], k, i, n = theta.shape[0]
    e_ = np.empty(N)
    cdef double[::1] e = e_, w = np.empty(n), phi = np.empty(n)
    cdef double own = y0
    for k in range(N):
        for i in range(n - 1):
            phi[i] = f[k, i]
        phi[n - 1] = own
        e[k] = rls_c(&theta[0], &q[0, 0], &phi[0], y[k], lam, &w[0], n)
        own = 0
        for i in range(n):
            own += phi[i] * theta[i]
    return e_


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


def triangle_run(double[:, ::1] r, double[:, ::1] rows, double lam):
    """Rotate rows (N, p + 1) = [regressors, measurement] into the triangle r (p, p + 1) of square-root RLS.
    """
    cdef Py_ssize_t N = rows.shape[0], n = r.shape[0], k
    cdef double[::1] w = np.empty(n + 1)
    cdef double root = sqrt(lam), left = 0
    for k in range(N):
        w[:] = rows[k]
        left += _givens(&r[0, 0], &w[0], n, root) ** 2
    return left


def bank_run(double[:, :, ::1] r, double[::1] cost, double[:, ::1] state, double[::1] poles, double[::1] prior,
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


def steady_filter_modal(double[::1] poles, double[:, ::1] b, double[::1] c, double[::1] gain, double[::1] x0,
                        double[:, ::1] u, double[::1] y):
    """Run the steady Kalman filter with A diagonal and one sensor: about 4 n operations a step."""
    cdef Py_ssize_t n = poles.shape[0], m = b.shape[1], N = u.shape[0], j, k, i
    out_ = np.empty((N, n))
    cdef double[:, ::1] out = out_
    cdef double[::1] x = np.array(x0)
    cdef double e, v
    for k in range(N):
        e = y[k]
        if isnan(e):
            e = 0
        else:
            for j in range(n):
                e -= c[j] * x[j]
        for j in range(n):
            v = x[j] + gain[j] * e
            out[k, j] = v
            v *= poles[j]
            for i in range(m):
                v += b[j, i] * u[k, i]
            x[j] = v
    return out_


def mkf_run(double[:, ::1] alpha, double[:, ::1] beta, double[::1] zeta, double rw, double rv, double[::1] t0,
            double[:, ::1] u, double[::1] coil):
    """Return filtered temperatures (N, M) and gains (N,) of the MKF (34), (35).

    u (N, m); coil (N,), NaN where there is no sample.
    """
    cdef Py_ssize_t n = alpha.shape[0], m = beta.shape[1], N = u.shape[0], i, j, k
    out_ = np.empty((N, n))
    gain_ = np.zeros(N)
    cdef double[:, ::1] out = out_
    cdef double[::1] gains = gain_, x = np.array(t0), w = np.empty(n)
    cdef double p = rw, a1 = 0, e, v, gain
    for j in range(n):
        a1 += alpha[0, j] * alpha[0, j]
    for k in range(N):
        if not isnan(coil[k]):
            gain = p / (p + rv)
            p *= 1 - gain
            e = gain * (coil[k] - x[0])
            for j in range(n):
                x[j] += e * zeta[j]
            gains[k] = gain
        for j in range(n):
            out[k, j] = x[j]
        for i in range(n):
            v = 0
            for j in range(n):
                v += alpha[i, j] * x[j]
            for j in range(m):
                v += beta[i, j] * u[k, j]
            w[i] = v
        x[:] = w
        p = a1 * p + rw
    return out_, gain_
