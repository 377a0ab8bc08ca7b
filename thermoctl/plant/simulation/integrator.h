/* The integrator behind every compiled plant. The generated file defines the sizes, the pattern of the Jacobian and the
   functions rhs_, jac_, sens_, factor_, solve_, solve_lanes_ and includes this file.

   States by esdirk.h. Sensitivities S = dx/dq are the exact derivative of the converged step:
       (I - h g J_i) S_i = S_base,i + h g F_p,i          (staggered direct method)                                      */
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
#define LANES 8
typedef struct { int nc, groups, count, *begin, *entry, *slot; double *V, *S; } Columns;

static int columns_(Columns *c, int nc, const double *S0, const Forces *force) {
  const int *row = force ? force->row : V_ROW, *col = force ? force->col : V_COL;
  c->nc = nc;
  c->groups = (nc + LANES - 1) / LANES;
  c->count = force ? force->count : NV;
  size_t size = (size_t)c->groups * NX * LANES;
  c->S = calloc(size + STAGES * (size_t)c->count + 1, sizeof(double));
  c->begin = calloc((size_t)c->groups + 1 + 2 * (size_t)c->count, sizeof(int));
  if (!c->S || !c->begin) { free(c->S); free(c->begin); return 0; }
  c->V = c->S + size;
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
    int wide = c->nc - g * LANES < LANES ? c->nc - g * LANES : LANES;
    for (int i = 0; i < NX; i++) memcpy(S + (size_t)i * c->nc + g * LANES, c->S + ((size_t)g * NX + i) * LANES, wide * sizeof(double));
  }
}

/* The sensitivities over the step that try_step accepted; c->S is advanced in place. Ms: the stages' factors. */
static int sens_step(double t, double h, double ta, double dt, const double *u0, const double *u1, const int *lin,
                     const double *p, const double *w, const double *xs, Columns *c, double *Ms, double *hfac, const Forces *force, int n) {
  double u[NU + 1], J[NJ + 1], J0[NJ + 1];
  for (int s = 0; s < STAGES; s++) {
    double ts = t + C_[s] * h, *V = c->V + (size_t)s * c->count;
    const double *X = xs + s * NX;
    inputs_at((ts - ta) / dt, u0, u1, lin, u);
    if (force) {
      const double *q0 = force->q + (size_t)n * c->count, *q1 = q0 + c->count, part = (ts - ta) / dt;
      for (int e = 0; e < c->count; e++) V[e] = q0[e] + part * (q1[e] - q0[e]);
    } else sens_(ts, X, u, p, w, V);
    if (s == 0) jac_(ts, X, u, p, w, J0);
    else if (!LINEAR || *hfac != h) {
      jac_(ts, X, u, p, w, J);
      if (!factor_(h * G, J, Ms + (LINEAR ? 0 : s * (NM + 1)))) return 0;
      if (LINEAR) *hfac = h;
    }
  }
  for (int g = 0; g < c->groups; g++) {
    lanes K[STAGES][NX + 1], R[NX + 1], *S = (lanes *)(c->S + (size_t)g * NX * LANES);
    double F[(NX + 1) * LANES];
    const double back = 1 / (h * G);
    const int first = c->begin[g], last = c->begin[g + 1];
    memset(F, 0, sizeof F);
    for (int s = 0; s < STAGES; s++) {
      const double *V = c->V + (size_t)s * c->count;
      for (int e = first; e < last; e++) F[c->slot[e]] += V[c->entry[e]];
      lanes *const k = K[s];
      const lanes *const f = (const lanes *)F;
      if (s == 0) {
        for (int i = 0; i < NX; i++) k[i] = f[i];
        for (int q = 0; q < NJ; q++) k[J_ROW[q]] += J0[q] * S[J_COL[q]];
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
      for (int e = first; e < last; e++) F[c->slot[e]] = 0;
    }
  }
  return 1;
}

/* Outputs of one list (o = 0: the outputs, 1: the arguments of their delays) at N samples. D: N x ND values of the delays
   and SD their sensitivities (N x ND x nc), NULL for list 1. Y: N x NYo, SY: N x NYo x nc or NULL. `own`: the columns of SX
   are sensitivities, so that the outputs' own slopes by the parameters count. */
void observe(int o, int N, const double *t, const double *U, const double *p, const double *w, const double *X,
             const double *SX, int nc, const double *D, const double *SD, double *Y, double *SY, int own) {
  int ny = o ? ND : NY;
  for (int n = 0; n < N; n++) {
    const double *x = X + (size_t)n * NX, *u = U + (size_t)n * NU, *d = D ? D + (size_t)n * ND : 0;
    double *y = Y + (size_t)n * ny;
    if (o) delayed_(t[n], x, u, p, w, d, y); else outputs_(t[n], x, u, p, w, d, y);
    if (!SY) continue;
    double V[NO + 1], *sy = SY + (size_t)n * ny * nc;
    int count = o ? NO1 : NO0;
    const int *row = o ? O1_ROW : O0_ROW, *kind = o ? O1_KIND : O0_KIND, *col = o ? O1_COL : O0_COL;
    if (o) delayed_slopes_(t[n], x, u, p, w, d, V); else outputs_slopes_(t[n], x, u, p, w, d, V);
    memset(sy, 0, (size_t)ny * nc * sizeof(double));
    for (int q = 0; q < count; q++) {
      double *to = sy + (size_t)row[q] * nc;
      if (kind[q] == 1) { if (own) to[col[q]] += V[q]; continue; }                                  /* by a parameter */
      const double *from = kind[q] == 0 ? SX + ((size_t)n * NX + col[q]) * nc : SD + ((size_t)n * ND + col[q]) * nc;
      for (int c = 0; c < nc; c++) to[c] += V[q] * from[c];                                /* by a state or a delay */
    }
  }
}

/* Integrate over N samples. Returns 0, or 1 + the index of the interval that could not be integrated. info[0]: steps,
   info[1]: rejected. X: N x NX, SX: N x NX x nc or NULL (S0: NX x nc). With SY (N x NY x nc, no delays of outputs) the outputs
   are observed at each sample, and SX is one sample's (NX x nc): memory grows with the outputs, not with the states. */
int integrate(int N, const double *t, const double *U, const int *lin, const double *p, const double *w, const double *x0,
              const double *S0, int nc, double rtol, const double *atol, int max_steps, double *X, double *SX,
              double *info, const Forces *force, double *Y, double *SY, int own) {
  double x[NX + 1], xn[NX + 1], k[STAGES * (NX + 1)], xs[STAGES * (NX + 1)], M[NM + 1], Ms[(LINEAR ? 1 : STAGES) * (NM + 1)];
  size_t block = (size_t)NX * nc;
  double want = 0, hfac = 0, hfac_s = 0;
  Columns c = {0};
  if (SX) {
    if (!columns_(&c, nc, S0, force)) return -1;
    memcpy(SX, S0, block * sizeof(double));
  }
  int failed_at = 0;
  const unsigned long mode = flush_();
  memcpy(x, x0, NX * sizeof(double));
  memcpy(X, x0, NX * sizeof(double));
  info[0] = info[1] = 0;
  if (SY) observe(0, 1, t, U, p, w, X, SX, nc, 0, 0, Y, SY, own);
  for (int n = 0; n + 1 < N; n++) {
    const double *u0 = U + (size_t)n * NU, *u1 = u0 + NU;
    double ta = t[n], dt = t[n + 1] - ta, at = ta;
    int steps = 0, failed = 0;
    while (at < t[n + 1]) {
      double left = t[n + 1] - at, h = want <= 0 || want >= left * 0.999 ? left : want;
      if (h < left && 2 * h > left) h = left / 2;
      int last = h >= left;
      if (last) h = left;
      if (last && at == ta && fabs(h - hfac) < 1e-9 * h) h = hfac;  /* a clock equal but for rounding: same factors */
      if (++steps > max_steps) { failed_at = n + 1; goto out; }
      double err = try_step(at, h, ta, dt, u0, u1, lin, p, w, x, rtol, atol, k, xs, xn, M, &hfac);
      if (!(err >= 0 && err <= 1)) {
        info[1]++;
        want = err > 1 && err < 1e9 ? h * fmax(0.1, 0.9 * pow(err, -0.25)) : h * 0.1;
        if (want < 1e-12 * dt || ++failed > 60) { failed_at = n + 1; goto out; }
        continue;
      }
      if (SX && !sens_step(at, h, ta, dt, u0, u1, lin, p, w, xs, &c, Ms, &hfac_s, force, n)) { failed_at = n + 1; goto out; }
      memcpy(x, xn, NX * sizeof(double));
      info[0]++;
      double grow = h * fmin(4, 0.9 * pow(fmax(err, 1e-6), -0.25));
      if (!last || grow < want || want <= 0) want = grow; else want = fmax(want, grow);
      at = last ? t[n + 1] : at + h;
    }
    memcpy(X + (size_t)(n + 1) * NX, x, NX * sizeof(double));
    if (SX) columns_out_(&c, SX + (SY ? 0 : (n + 1) * block));
    if (SY) observe(0, 1, t + n + 1, u1, p, w, X + (size_t)(n + 1) * NX, SX, nc, 0, 0, Y + (size_t)(n + 1) * NY,
                    SY + (size_t)(n + 1) * NY * nc, own);
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
#define MEMORY (3 + NJ + NX * NX)
const int memory_size = MEMORY;

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
  static const int hold[NU + 1];
  if (advance_states_(t, h, u, 0, hold, p, w, rtol, atol, x, want)) return 1;
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
