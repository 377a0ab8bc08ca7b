/* The integrator behind every compiled plant, compiled once for all plants of NX states, LINEAR or not, and linked to the
   equations of each (compiled.h).

   Inputs change at each sample, so that most steps are far shorter than accuracy needs: an explicit step is tried first, and
   esdirk.h takes those where its error does not pass or the plant is stiff. Sensitivities S = dx/dq are the exact derivative
   of the step that was taken; of ESDIRK's
       (I - h g J_i) S_i = S_base,i + h g F_p,i          (staggered direct method)                                      */
#include "compiled.h"
#include "esdirk.h"

/* Numbers below 2e-308 become 0 in a run. The sensitivity to a start decays; it would stay at the last such number for ever
   (rounding keeps it), and a processor takes a hundred cycles for each operation on one. */
#if defined(__SSE2__)
#include <xmmintrin.h>
static unsigned long flush_(void) { unsigned long was = _mm_getcsr(); _mm_setcsr(was | 0x8040); return was; }  /* FTZ and DAZ */
static void unflush_(unsigned long was) { _mm_setcsr(was); }
#elif defined(__aarch64__)
static unsigned long flush_(void) {
  unsigned long was;
  __asm__ volatile("mrs %0, fpcr" : "=r"(was));
  __asm__ volatile("msr fpcr, %0" : : "r"(was | 1UL << 24));                                                  /* FZ */
  return was;
}
static void unflush_(unsigned long was) { __asm__ volatile("msr fpcr, %0" : : "r"(was)); }
#else
static unsigned long flush_(void) { return 0; }
static void unflush_(unsigned long was) { (void)was; }
#endif

/* Forces on dx/dt that are not in the equations: entry e adds q[n * count + e], on a straight line between samples, to the
   slope of state row[e] in column col[e] of S. With forces, the columns of S are responses to them, not sensitivities. */
typedef struct { int count; const int *row, *col; const double *q; } Forces;

/* The columns of S go through a step LANES at a time, in the processor's registers. Entries V of F_p belong to columns: `entry`
   lists them by group of lanes, those of group g from begin[g] on, and `slot` their places in the group's (NX, LANES). */
typedef struct { int nc, groups, count, *begin, *entry, *slot; double *JV, *S; } Columns;

static int columns_(Columns *c, int nc, const double *S0, const Forces *force) {
  const int *row = force ? force->row : V_ROW, *col = force ? force->col : V_COL;
  c->nc = nc;
  c->groups = (nc + LANES - 1) / LANES;
  c->count = force ? force->count : NV;
  size_t size = (size_t)c->groups * NX * LANES;
  c->S = calloc(size + STAGES * (NJ + (size_t)c->count) + 1, sizeof(double));
  c->begin = calloc((size_t)c->groups + 1 + 2 * (size_t)c->count, sizeof(int));
  if (!c->S || !c->begin) { free(c->S); free(c->begin); return 0; }
  c->JV = c->S + size;
  c->entry = c->begin + c->groups + 1;
  c->slot = c->entry + c->count;
  for (int g = 0, at = 0; g < c->groups; g++) {
    for (int e = 0; e < c->count; e++) if (col[e] / LANES == g) { c->entry[at] = e; c->slot[at++] = row[e] * LANES + col[e] % LANES; }
    c->begin[g + 1] = at;
  }
  for (int i = 0; i < NX; i++) for (int k = 0; k < nc; k++)
    c->S[((size_t)(k / LANES) * NX + i) * LANES + k % LANES] = S0[(size_t)i * nc + k];
  return 1;
}

static void columns_out_(const Columns *c, double *S) {
  for (int g = 0; g < c->groups; g++) {
    const int wide = c->nc - g * LANES;
    const double *from = c->S + (size_t)g * NX * LANES;
    double *to = S + g * LANES;
    for (int i = 0; i < NX; i++, from += LANES, to += c->nc)
      if (wide >= LANES) *(lanes *)to = *(const lanes *)from; else memcpy(to, from, wide * sizeof(double));
  }
}

/* J, if the plant is not linear, and the entries V of F_p at point s of a step; returns V, which follows J. */
static double *tangents_(double t, double part, const double *u, const double *p, const double *w, const double *X, Columns *c, int s,
                         const Forces *force, int n) {
  double *J = c->JV + (size_t)s * (NJ + c->count), *V = J + NJ;
  if (force) {
    const double *q0 = force->q + (size_t)n * c->count, *q1 = q0 + c->count;
    for (int e = 0; e < c->count; e++) V[e] = q0[e] + part * (q1[e] - q0[e]);
    if (!LINEAR) jac_(t, X, u, p, w, J);
  } else sens_(t, X, u, p, w, LINEAR ? V : J);
  return V;
}

/* The entries V of a group of lanes, at each of so many points of a step, in their places: F[s] is (NX, LANES). Made a group ahead: a
   vector that is read right after one of its numbers was written keeps a processor waiting. */
static void place_(const Columns *c, int points, int g, lanes F[][NX + 1]) {
  if (g >= c->groups) return;
  for (int s = 0; s < points; s++) {
    const double *V = c->JV + (size_t)s * (NJ + c->count) + NJ;
    memset(F[s], 0, sizeof F[s]);
    for (int e = c->begin[g]; e < c->begin[g + 1]; e++) ((double *)F[s])[c->slot[e]] += V[c->entry[e]];
  }
}

/* The sensitivities over the step that try_step accepted; c->S is advanced in place. Ms: the stages' factors. */
static int sens_step(double t, double h, double ta, double dt, const double *u0, const double *u1, const int *lin,
                     const double *p, const double *w, const double *xs, Columns *c, double *Ms, double *hfac, const Forces *force, int n) {
  double u[NU + 1];
  for (int s = 0; s < STAGES; s++) {
    const double ts = t + C_[s] * h, *X = xs + s * NX;
    inputs_at((ts - ta) / dt, u0, u1, lin, u);
    double *J = tangents_(ts, (ts - ta) / dt, u, p, w, X, c, s, force, n) - NJ;
    if (LINEAR && (s == 0 || *hfac != h)) jac_(ts, X, u, p, w, J);
    if (s && (!LINEAR || *hfac != h)) {
      if (!factor_(h * G, J, Ms + (LINEAR ? 0 : s * (NM + 1)))) return 0;
      if (LINEAR) *hfac = h;
    }
  }
  lanes F[2][STAGES][NX + 1];
  place_(c, STAGES, 0, F[0]);
  for (int g = 0; g < c->groups; g++) {
    lanes K[STAGES][NX + 1], R[NX + 1], *S = (lanes *)(c->S + (size_t)g * NX * LANES);
    const double back = 1 / (h * G);
    place_(c, STAGES, g + 1, F[(g + 1) % 2]);
    for (int s = 0; s < STAGES; s++) {
      lanes *const k = K[s];
      const lanes *const f = F[g % 2][s];
      if (s == 0) {
        for (int i = 0; i < NX; i++) k[i] = f[i];
        multiply_lanes_(c->JV, S, k);
      } else {
        const double a0 = h * A_[s][0], a1 = h * A_[s][1], a2 = h * A_[s][2], a3 = h * A_[s][3], a4 = h * A_[s][4];
        switch (s) {
          case 1: for (int i = 0; i < NX; i++) R[i] = S[i] + a0 * K[0][i]; break;
          case 2: for (int i = 0; i < NX; i++) R[i] = S[i] + a0 * K[0][i] + a1 * K[1][i]; break;
          case 3: for (int i = 0; i < NX; i++) R[i] = S[i] + a0 * K[0][i] + a1 * K[1][i] + a2 * K[2][i]; break;
          case 4: for (int i = 0; i < NX; i++) R[i] = S[i] + a0 * K[0][i] + a1 * K[1][i] + a2 * K[2][i] + a3 * K[3][i]; break;
          default: for (int i = 0; i < NX; i++) R[i] = S[i] + a0 * K[0][i] /* a1 is 0 */ + a2 * K[2][i] + a3 * K[3][i] + a4 * K[4][i];
        }
        for (int i = 0; i < NX; i++) k[i] = R[i] + h * G * f[i];
        solve_lanes_(Ms + (LINEAR ? 0 : s * (NM + 1)), k);
        if (s == STAGES - 1) for (int i = 0; i < NX; i++) S[i] = k[i];
        else for (int i = 0; i < NX; i++) k[i] = (k[i] - R[i]) * back;
      }
    }
  }
  return 1;
}

/* Explicit steps of order 4: the classical method, with Zonneveld's fifth point for an error of order 3 (Hairer, Norsett, Wanner,
   Solving ODEs I, sec. II.4; a sixteenth of the difference, still above the error). No weight of it is small: a jump between
   any two points shows. */
#define POINTS 4
static const double RC_[POINTS + 1] = {0, 0.5, 0.5, 1, 0.75}, RB_[POINTS] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};
static const double RA_[POINTS] = {5.0 / 32, 7.0 / 32, 13.0 / 32, -1.0 / 32};
static const double RE_[POINTS + 1] = {1.0 / 24, -0.125, -0.125, -0.125, 1.0 / 3};
#define SHORT 0.5        /* of a step that the error allows: where explicit steps have to be shorter, those of ESDIRK cost less */
#define STEEP 0.5        /* largest step times a bound of the eigenvalues; a state at rest passes any longer step, its slopes grow */
#define LONGEST_WAIT 16  /* steps of ESDIRK before the next explicit try: 1, doubled with each failure */

/* A bound of the eigenvalues of J, 1/s: max (|J| z)_i / z_i of positive z. z is made better until h times the bound is at most
   STEEP; where that fails z is left as it was. */
static double steepest_(const double *J, double h, double *z) {
  double bound = 0, better[NX + 1];
  memcpy(better, z, NX * sizeof(double));
  for (int round = 0; round < 12; round++) {
    double y[NX + 1];
    memset(y, 0, sizeof y);
    for (int q = 0; q < NJ; q++) y[J_ROW[q]] += fabs(J[q]) * better[J_COL[q]];
    bound = 0;
    for (int i = 0; i < NX; i++) { double a = y[i] / better[i]; if (!(a <= bound)) bound = a; }
    if (h * bound <= STEEP) { if (round) memcpy(z, better, NX * sizeof(double)); break; }
    if (!(bound < 1e300)) break;
    for (int i = 0; i < NX; i++) better[i] = larger_(0.5 * (better[i] + y[i] / bound), 1e-250);
  }
  return bound;
}

/* Whether slopes differ by more than 4 STEEP / h times the states that they belong to: dry friction that sticks, about which explicit
   steps would go to and fro, where it slides through a reversal they do not. */
static int sticks_(double h, const double *k0, const double *k1, const double *x0, const double *x1, const double *z, const double *atol) {
  double slope = 0, way = 0;
  for (int i = 0; i < NX; i++) {
    const double d = h * fabs(k1[i] - k0[i]);
    if (d > 1e-2 * atol[i]) slope = larger_(slope, d / z[i]);
    way = larger_(way, fabs(x1[i] - x0[i]) / z[i]);
  }
  return slope > 4 * STEEP * way;
}

/* One explicit step of at most *h, which becomes the step that STEEP allows. xs: states at the points; z: as of steepest_, whose
   last bound is *steep (below 0: none yet). Returns the norm of the error, or -1 where the step would fall below `least` or sticks. */
static double try_explicit(double t, double *h, double least, double ta, double dt, const double *u0, const double *u1, const int *lin,
                           const double *p, const double *w, const double *x, double rtol, const double *atol,
                           double *xs, double *xn, double *z, double *steep) {
  double u[NU + 1], e[NX + 1], k[POINTS + 1][NX + 1], first[NX + NJ + 1];
  for (int s = 0; s <= POINTS; s++) {
    const double ts = t + RC_[s] * *h;
    double *const X = xs + s * NX;
    inputs_at((ts - ta) / dt, u0, u1, lin, u);
    if (s == 0) {
      memcpy(X, x, NX * sizeof(double));
      if (!LINEAR) rhs_jac_(ts, x, u, p, w, first);
      else if (*steep < 0) jac_(ts, x, u, p, w, first + NX);
      if (!LINEAR || *steep < 0) *steep = steepest_(first + NX, *h, z);
      if (!(*h * *steep <= STEEP)) {
        *h /= ceil(*h * *steep / STEEP);
        if (!(*h >= least)) return -1;
      }
    } else if (s < POINTS) for (int i = 0; i < NX; i++) X[i] = x[i] + *h * RC_[s] * k[s - 1][i];
    else for (int i = 0; i < NX; i++) X[i] = x[i] + *h * (RA_[0] * k[0][i] + RA_[1] * k[1][i] + RA_[2] * k[2][i] + RA_[3] * k[3][i]);
    if (LINEAR || s) rhs_(ts, X, u, p, w, k[s]); else memcpy(k[0], first, NX * sizeof(double));
    if (!LINEAR && (s == 1 || s == 3) && sticks_(*h, k[s - 1], k[s], X - NX, X, z, atol)) return -1;
  }
  for (int i = 0; i < NX; i++) {
    xn[i] = x[i] + *h * (RB_[0] * k[0][i] + RB_[1] * k[1][i] + RB_[2] * k[2][i] + RB_[3] * k[3][i]);
    e[i] = *h * (RE_[0] * k[0][i] + RE_[1] * k[1][i] + RE_[2] * k[2][i] + RE_[3] * k[3][i] + RE_[4] * k[4][i]);
  }
  return norm_(e, x, xn, rtol, atol);
}

/* The sensitivities over the step that try_explicit accepted; c->S is advanced in place. Returns 0 where J gets steep within the step. */
static int sens_explicit(double t, double h, double ta, double dt, const double *u0, const double *u1, const int *lin,
                          const double *p, const double *w, const double *xs, const double *z, Columns *c, const Forces *force, int n) {
  double u[NU + 1], own[NX + 1];
  memcpy(own, z, sizeof own);
  for (int s = 0; s < POINTS; s++) {
    const double ts = t + RC_[s] * h;
    inputs_at((ts - ta) / dt, u0, u1, lin, u);
    const double *J = tangents_(ts, (ts - ta) / dt, u, p, w, xs + s * NX, c, s, force, n) - NJ;
    if (LINEAR && !s) jac_(ts, xs, u, p, w, c->JV);
    if (!LINEAR && s && !(h / 4 * steepest_(J, h / 4, own) <= STEEP)) return 0;
  }
  lanes F[2][POINTS][NX + 1];
  place_(c, POINTS, 0, F[0]);
  for (int g = 0; g < c->groups; g++) {
    lanes R[NX + 1], sum[NX + 1], *S = (lanes *)(c->S + (size_t)g * NX * LANES);
    place_(c, POINTS, g + 1, F[(g + 1) % 2]);
    for (int s = 0; s < POINTS; s++) {
      lanes *const k = F[g % 2][s];
      multiply_lanes_(c->JV + (LINEAR ? 0 : (size_t)s * (NJ + c->count)), s ? R : S, k);
      const double a = h * RB_[s], b = s + 1 < POINTS ? h * RC_[s + 1] : 0;
      if (s) for (int i = 0; i < NX; i++) sum[i] += a * k[i]; else for (int i = 0; i < NX; i++) sum[i] = S[i] + a * k[i];
      if (b) for (int i = 0; i < NX; i++) R[i] = S[i] + b * k[i];
    }
    memcpy(S, sum, NX * sizeof(lanes));
  }
  return 1;
}

/* to = a from, or to += a from; (n,) each. Groups of lanes of `from` begin `step` apart. */
static void times_(double a, const double *from, int step, int n, double *to, int add) {
  for (; n >= LANES; n -= LANES, from += step, to += LANES) {
    const lanes b = a * *(const lanes *)from;
    *(lanes *)to = add ? *(lanes *)to + b : b;
  }
  for (int c = 0; c < n; c++) to[c] = (add ? to[c] : 0) + a * from[c];
}

/* One sample's outputs of one list, see observe. S: sensitivities of the states, a state's `next` apart, its groups of lanes `step`. */
static void look_(int o, double t, const double *u, const double *p, const double *w, const double *x, const double *S, int next,
                  int step, int nc, const double *d, const double *sd, double *y, double *sy, int own) {
  if (o) delayed_(t, x, u, p, w, d, y); else outputs_(t, x, u, p, w, d, y);
  if (!sy) return;
  double V[(NO0 > NO1 ? NO0 : NO1) + 1];
  const int ny = o ? ND : NY, count = o ? NO1 : NO0, *row = o ? O1_ROW : O0_ROW, *kind = o ? O1_KIND : O0_KIND, *col = o ? O1_COL : O0_COL;
  if (o) delayed_slopes_(t, x, u, p, w, d, V); else outputs_slopes_(t, x, u, p, w, d, V);
  for (int r = 0, q = 0; r < ny; r++, sy += nc) {                  /* of a row's entries those by states come first */
    int add = q < count && row[q] == r && kind[q] == 0;
    if (add) times_(V[q], S + col[q] * next, step, nc, sy, 0), q++; else memset(sy, 0, nc * sizeof(double));
    for (; q < count && row[q] == r; q++)
      if (kind[q] == 0) times_(V[q], S + col[q] * next, step, nc, sy, 1);
      else if (kind[q] == 2) times_(V[q], sd + col[q] * nc, LANES, nc, sy, 1);                     /* by a delay */
      else if (own) sy[col[q]] += V[q];                                                          /* by a parameter */
  }
}

/* Outputs of one list (o = 0: the outputs, 1: the arguments of their delays) at N samples. D: N x ND values of the delays
   and SD their sensitivities (N x ND x nc), NULL for list 1. Y: N x NYo, SY: N x NYo x nc or NULL. `own`: the columns of SX
   are sensitivities, so that the outputs' own slopes by the parameters count. */
void observe(int o, int N, const double *t, const double *U, const double *p, const double *w, const double *X,
             const double *SX, int nc, const double *D, const double *SD, double *Y, double *SY, int own) {
  const size_t ny = o ? ND : NY;
  for (size_t n = 0; n < N; n++)
    look_(o, t[n], U + n * NU, p, w, X + n * NX, SX + n * NX * nc, nc, LANES, nc, D ? D + n * ND : 0, SD ? SD + n * ND * nc : 0,
          Y + n * ny, SY ? SY + n * ny * nc : 0, own);
}

/* Integrate over N samples. Returns 0, or 1 + the index of the interval that could not be integrated. info: steps,
   rejected. X: N x NX. With nc columns of sensitivities (S0: NX x nc): SX, N x NX x nc, or Y and SY (N x NY x nc, no delays of
   outputs), the outputs at each sample: memory grows with the outputs, not with the states. */
int integrate(int N, const double *t, const double *U, const int *lin, const double *p, const double *w, const double *x0,
              const double *S0, int nc, double rtol, const double *atol, int max_steps, double *X, double *SX,
              double *info, const Forces *force, double *Y, double *SY, int own) {
  double x[NX + 1], xn[NX + 1], k[STAGES * (NX + 1)], xs[STAGES * (NX + 1)], M[NM + 1], Ms[(LINEAR ? 1 : STAGES) * (NM + 1)], z[NX + 1];
  size_t block = (size_t)NX * nc;
  double want = 0, hfac = 0, hfac_s = 0, steep = -1, reach = 0;
  int skip = 0, wait = 1;                              /* steps that ESDIRK takes before the next explicit try */
  Columns c = {0};
  if (nc && !columns_(&c, nc, S0, force)) return -1;
  if (SX) memcpy(SX, S0, block * sizeof(double));
  int failed_at = 0;
  const unsigned long mode = flush_();
  for (int i = 0; i < NX; i++) z[i] = atol[i];
  memcpy(x, x0, NX * sizeof(double));
  memcpy(X, x0, NX * sizeof(double));
  info[0] = info[1] = 0;
  if (SY) look_(0, t[0], U, p, w, X, c.S, LANES, NX * LANES, nc, 0, 0, Y, SY, own);
  for (int n = 0; n + 1 < N; n++) {
    const double *u0 = U + (size_t)n * NU, *u1 = u0 + NU;
    double ta = t[n], dt = t[n + 1] - ta, at = ta;
    int steps = 0, failed = 0;
    while (at < t[n + 1]) {
      const double left = t[n + 1] - at;
      if (++steps > max_steps) { failed_at = n + 1; goto out; }
      double h = reach <= 0 || reach > left ? left : left / ceil(left / reach);
      if (skip) skip--;
      else {
        const double wished = h;
        double err = try_explicit(at, &h, wished * SHORT, ta, dt, u0, u1, lin, p, w, x, rtol, atol, xs, xn, z, &steep);
        double grow = h * lesser_(8, 0.9 / root4_(larger_(err, 1e-4)));
        if (err >= 0 && err <= 1 && (!nc || sens_explicit(at, h, ta, dt, u0, u1, lin, p, w, xs, z, &c, force, n))) {
          memcpy(x, xn, NX * sizeof(double));
          info[0]++;
          reach = h < left ? grow : larger_(reach, grow);
          at = h < left ? at + h : t[n + 1];
          wait = 1;
          continue;
        }
        if (err > 1 && err < 1e9 && grow > 1e-9 * dt) { reach = grow; info[1]++; continue; }
        if (wished < left) want = want <= 0 ? wished : lesser_(want, wished);
        skip = wait;
        if (wait < LONGEST_WAIT) wait *= 2;
      }
      reach = 0;
      h = want <= 0 || want >= left * 0.999 ? left : want;
      if (h < left && 2 * h > left) h = left / 2;
      int last = h >= left;
      if (last) h = left;
      if (last && at == ta && fabs(h - hfac) < 1e-9 * h) h = hfac;  /* a clock equal but for rounding: same factors */
      double err = try_step(at, h, ta, dt, u0, u1, lin, p, w, x, rtol, atol, k, xs, xn, M, &hfac);
      if (!(err >= 0 && err <= 1)) {
        info[1]++;
        want = err > 1 && err < 1e9 ? h * larger_(0.1, 0.9 / root4_(err)) : h * 0.1;
        if (want < 1e-12 * dt || ++failed > 60) { failed_at = n + 1; goto out; }
        continue;
      }
      if (nc && !sens_step(at, h, ta, dt, u0, u1, lin, p, w, xs, &c, Ms, &hfac_s, force, n)) { failed_at = n + 1; goto out; }
      memcpy(x, xn, NX * sizeof(double));
      info[0]++;
      double grow = h * lesser_(4, 0.9 / root4_(larger_(err, 1e-6)));
      if (!last || grow < want || want <= 0) want = grow; else want = larger_(want, grow);
      at = last ? t[n + 1] : at + h;
    }
    memcpy(X + (size_t)(n + 1) * NX, x, NX * sizeof(double));
    if (SX) columns_out_(&c, SX + (n + 1) * block);
    if (SY) look_(0, t[n + 1], u1, p, w, x, c.S, LANES, NX * LANES, nc, 0, 0, Y + (size_t)(n + 1) * NY, SY + (size_t)(n + 1) * NY * nc, own);
  }
out:
  unflush_(mode);
  free(c.S);
  free(c.begin);
  return failed_at;
}

/* The slopes dx/dt at N samples (for delays in outputs). */
void slopes(int N, const double *t, const double *U, const double *p, const double *w, const double *X, double *F) {
  for (int n = 0; n < N; n++) rhs_(t[n], X + (size_t)n * NX, U + (size_t)n * NU, p, w, F + (size_t)n * NX);
}

#ifdef STEPPER
/* Steps of one fixed period by the exponential Rosenbrock-Euler method (Hochbruck, Ostermann, Acta Numerica 2010, sec. 2.4):
       x(t + h) = x + h phi1(h J) f(x),   phi1(z) = (exp(z) - 1) / z
   exact for a linear plant with held inputs, however stiff. h phi1(h J) is kept from step to step; what it leaves out,
   d = f(x1) - f(x) - J (x1 - x), is measured at every step, its mean effect h phi1 d / 2 is added, and where that exceeds the
   tolerance the matrix is made anew, and if it still does the step is left to ESDIRK.
   memory: [0] h of the matrix (0: none), [1] steps to wait before the next try, [2] matrices made, then J, then h phi1(h J)
   by columns. */
#define GLIDE_MAX 48
int memory_size(void) { return 3 + NJ + NX * NX; }

#if NX > 0 && NX <= GLIDE_MAX
static void product_(const double *A, const double *B, double *out) {     /* by columns; out is neither */
  for (int k = 0; k < NX; k++) {
    double *to = out + k * NX;
    memset(to, 0, NX * sizeof(double));
    for (int j = 0; j < NX; j++) {
      const double b = B[k * NX + j], *from = A + j * NX;
      if (b != 0) for (int i = 0; i < NX; i++) to[i] += b * from[i];
    }
  }
}

static void apply_(const double *A, const double *v, double *out) {
  memset(out, 0, NX * sizeof(double));
  for (int j = 0; j < NX; j++) for (int i = 0; i < NX; i++) out[i] += A[j * NX + i] * v[j];
}

static void phi1_(double h, const double *J, double *P) {
  double Z[NX * NX], E[NX * NX], T[NX * NX], size = 0, row[NX];
  memset(Z, 0, sizeof Z);
  memset(row, 0, sizeof row);
  for (int q = 0; q < NJ; q++) { Z[J_COL[q] * NX + J_ROW[q]] += h * J[q]; row[J_ROW[q]] += fabs(h * J[q]); }
  for (int i = 0; i < NX; i++) size = fmax(size, row[i]);
  int halvings = size > 0.5 ? (int)ceil(log2(size / 0.5)) : 0;
  if (halvings > 60) halvings = 60;
  for (int q = 0; q < NX * NX; q++) Z[q] = ldexp(Z[q], -halvings);
  memset(P, 0, NX * NX * sizeof(double));
  for (int i = 0; i < NX; i++) P[i * NX + i] = 1;
  for (int k = 13; k >= 2; k--) {                                       /* P = 1 + Z/2 (1 + Z/3 (...)) */
    product_(Z, P, T);
    for (int q = 0; q < NX * NX; q++) P[q] = T[q] / k;
    for (int i = 0; i < NX; i++) P[i * NX + i] += 1;
  }
  product_(Z, P, E);
  for (int i = 0; i < NX; i++) E[i * NX + i] += 1;
  for (int s = 0; s < halvings; s++) {                                  /* phi1(2z) = (exp(z) + 1) phi1(z) / 2 */
    product_(E, P, T);
    for (int q = 0; q < NX * NX; q++) P[q] = 0.5 * (P[q] + T[q]);
    if (s + 1 < halvings) { product_(E, E, T); memcpy(E, T, sizeof T); }
  }
  for (int q = 0; q < NX * NX; q++) P[q] *= h;
}

/* 1 where the step was taken. */
static int glide(double t, double h, const double *u, const double *p, const double *w, double rtol, const double *atol,
                 double *x, double *memory) {
  double f0[NX], f1[NX], x1[NX], dx[NX], d[NX], *J = memory + 3, *P = memory + 3 + NJ;
  if (memory[1] > 0) { memory[1]--; return 0; }
  rhs_(t + 0.5 * h, x, u, p, w, f0);
  for (int made = memory[0] != h; ; made++) {
    if (made) {
      jac_(t + 0.5 * h, x, u, p, w, J);
      phi1_(h, J, P);
      memory[0] = h;
      memory[2]++;
    }
    apply_(P, f0, dx);
    for (int i = 0; i < NX; i++) x1[i] = x[i] + dx[i];
    rhs_(t + 0.5 * h, x1, u, p, w, f1);
    for (int i = 0; i < NX; i++) d[i] = f1[i] - f0[i];
    for (int q = 0; q < NJ; q++) d[J_ROW[q]] -= J[q] * dx[J_COL[q]];
    apply_(P, d, dx);
    for (int i = 0; i < NX; i++) dx[i] *= 0.5;
    double size = norm_(dx, x, x1, rtol, atol);
    if (size <= 1) { for (int i = 0; i < NX; i++) x[i] = x1[i] + dx[i]; return 1; }
    if (made) { memory[0] = 0; memory[1] = 20; return 0; }
  }
}
#endif

/* One period with inputs held; x in place, y out. Returns 0 or 1. (Static: glibc has a symbol named advance.) */
static int period_(double t, double h, const double *u, const double *p, const double *w, double rtol, const double *atol,
                   double *x, double *y, double *want) {
  if (advance_states_(t, h, u, 0, 0, p, w, rtol, atol, x, want)) return 1;
  outputs_(t + h, x, u, p, w, 0, y);
  return 0;
}

/* The same, the fast way first. */
int advance_period(double t, double h, const double *u, const double *p, const double *w, double rtol, const double *atol,
                   double *x, double *y, double *want, double *memory) {
#if NX > 0 && NX <= GLIDE_MAX
  if (glide(t, h, u, p, w, rtol, atol, x, memory)) { outputs_(t + h, x, u, p, w, 0, y); return 0; }
#else
  (void)memory;
#endif
  return period_(t, h, u, p, w, rtol, atol, x, y, want);
}

/* The same by ESDIRK alone: the reference that tests compare with. */
int advance(double t, double h, const double *u, const double *p, const double *w, double rtol, const double *atol,
            double *x, double *y, double *want) {
  return period_(t, h, u, p, w, rtol, atol, x, y, want);
}
#endif
