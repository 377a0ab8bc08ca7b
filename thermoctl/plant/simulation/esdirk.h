/* One step of an implicit integrator. The including file defines the sizes NX, NU, NJ, NM and LINEAR, and the functions rhs_,
   jac_, rhs_jac_, factor_ and solve_.

   ESDIRK4(3)6L[2]SA of Kennedy & Carpenter, Appl. Numer. Math. 44 (2003) 139-181: order 4, six stages, first one
   explicit, L-stable, stiffly accurate, embedded order 3. Each stage X_i solves X_i = base_i + h g f(X_i) by Newton with
   the exact sparse Jacobian. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define STAGES 6
static const double G = 0.25;
static const double C_[STAGES] = {0, 0.5, 83.0 / 250, 31.0 / 50, 17.0 / 20, 1};
static const double A_[STAGES][STAGES] = {
  {0},
  {0.25, 0.25},
  {8611.0 / 62500, -1743.0 / 31250, 0.25},
  {5012029.0 / 34652500, -654441.0 / 2922500, 174375.0 / 388108, 0.25},
  {15267082809.0 / 155376265600.0, -71443401.0 / 120774400, 730878875.0 / 902184768, 2285395.0 / 8070912, 0.25},
  {82889.0 / 524892, 0, 15625.0 / 83664, 69875.0 / 102672, -2260.0 / 8211, 0.25}};
static const double BHAT[STAGES] = {4586570599.0 / 29645900160.0, 0, 178811875.0 / 945068544, 814220225.0 / 1159782912,
                                    -3700637.0 / 11593932, 61727.0 / 225920};

/* In place of fmin, fmax and pow, which are calls of the C library. */
static inline double lesser_(double a, double b) { return a < b ? a : b; }
static inline double larger_(double a, double b) { return a > b ? a : b; }
static inline double root4_(double a) { return sqrt(sqrt(a)); }

static void inputs_at(double s, const double *u0, const double *u1, const int *lin, double *u) {
  for (int j = 0; j < NU; j++) u[j] = u1 && lin[j] ? u0[j] + s * (u1[j] - u0[j]) : u0[j];
}

static double norm_(const double *e, const double *x, const double *xn, double rtol, const double *atol) {
  double worst = 0;
  for (int i = 0; i < NX; i++) {
    double q = fabs(e[i]) / (atol[i] + rtol * 1e-3 * larger_(fabs(x[i]), fabs(xn[i])));
    if (!(q <= worst)) worst = q;          /* a NaN is kept */
  }
  return worst;
}

/* One step from (t, x) over h inside the sampling interval [ta, ta + dt]. Returns the error norm, or -1 where Newton
   failed. k: stages' slopes; xs: stages' states. */
static double try_step(double t, double h, double ta, double dt, const double *u0, const double *u1, const int *lin,
                       const double *p, const double *w, const double *x, double rtol, const double *atol,
                       double *k, double *xs, double *xn, double *M, double *hfac) {
  double u[NU + 1], f[NX + NJ + 1], r[NX + 1], *const J = f + NX;
  inputs_at((t - ta) / dt, u0, u1, lin, u);
  memcpy(xs, x, NX * sizeof(double));
  rhs_(t, x, u, p, w, k);
  for (int s = 1; s < STAGES; s++) {
    double ts = t + C_[s] * h, *X = xs + s * NX, base[NX + 1];
    inputs_at((ts - ta) / dt, u0, u1, lin, u);
    for (int i = 0; i < NX; i++) {
      double b = 0;
      for (int q = 0; q < s; q++) b += A_[s][q] * k[q * NX + i];
      base[i] = x[i] + h * b;
      X[i] = s == 1 ? x[i] : xs[(s - 1) * NX + i];
    }
    double last = 1e300;
    int it, done = 0;
    for (it = 0; it < 12 && !done; it++) {
      if (LINEAR) rhs_(ts, X, u, p, w, f); else rhs_jac_(ts, X, u, p, w, f);
      for (int i = 0; i < NX; i++) r[i] = base[i] + h * G * f[i] - X[i];
      if (!LINEAR || *hfac != h) {
        if (LINEAR) jac_(ts, X, u, p, w, J);
        if (!factor_(h * G, J, M)) return -1;
        *hfac = h;
      }
      solve_(M, r);
      double size = norm_(r, X, X, rtol, atol);
      if (!(size < 1e12)) return -1;
      double damp = 1;
      if (it > 2 && size > 0.9 * last) damp = 0.5;
      for (int i = 0; i < NX; i++) X[i] += damp * r[i];
      if (LINEAR || (damp == 1 && size < 1e-3)) done = 1;
      last = size;
    }
    if (!done) { *hfac = 0; return -1; }
    if (!LINEAR) *hfac = 0;
    for (int i = 0; i < NX; i++) k[s * NX + i] = (X[i] - base[i]) / (h * G);
  }
  double e[NX + 1];
  memcpy(xn, xs + (STAGES - 1) * NX, NX * sizeof(double));
  for (int i = 0; i < NX; i++) {
    e[i] = 0;
    for (int q = 0; q < STAGES; q++) e[i] += (A_[STAGES - 1][q] - BHAT[q]) * k[q * NX + i];
    e[i] *= h;
  }
  return norm_(e, x, xn, rtol, atol);
}

/* From (ta, x) over dt in steps of the estimated size; x and the wanted step in place. Inputs go from u0 to u1 where lin is
   set, else they are held. Returns 0, or 1 where the steps become too many or too short. */
static int advance_states_(double ta, double dt, const double *u0, const double *u1, const int *lin, const double *p,
                           const double *w, double rtol, const double *atol, double *x, double *want) {
  double k[STAGES * (NX + 1)], xs[STAGES * (NX + 1)], xn[NX + 1], M[NM + 1], hfac = 0, at = 0;
  int steps = 0;
  while (NX > 0 && at < dt) {
    double left = dt - at, s = *want <= 0 || *want >= left * 0.999 ? left : *want;
    if (s < left && 2 * s > left) s = left / 2;
    if (++steps > 100000) return 1;
    double err = try_step(ta + at, s, ta, dt, u0, u1, lin, p, w, x, rtol, atol, k, xs, xn, M, &hfac);
    if (!(err >= 0 && err <= 1)) {
      *want = err > 1 && err < 1e9 ? s * larger_(0.1, 0.9 / root4_(err)) : s * 0.1;
      if (*want < 1e-12 * dt) return 1;
      continue;
    }
    memcpy(x, xn, NX * sizeof(double));
    double grow = s * lesser_(4, 0.9 / root4_(larger_(err, 1e-6)));
    *want = s < left ? grow : larger_(*want, grow);
    at = s >= left ? dt : at + s;
  }
  return 0;
}
