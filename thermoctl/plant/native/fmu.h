/* One instance of an FMU (FMI 2 or 3, model exchange) as a function: derivatives of its states, then its outputs.

   Arguments: time, the states, then variables that may be set: reals, and Boolean and integer inputs. An argument that is NaN keeps its value. Results and the columns
   of slopes are kept until an argument changes. A failure of the FMU gives NaN, and the integrator takes a smaller step. */
#include <math.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef unsigned Ref;
enum { TIME, STATE, CONTINUOUS, DISCRETE, FIXED }; /* kinds of arguments: where FMI allows them to be set */
enum { REAL, BOOLEAN, INTEGER, INTEGER64 }; /* types of arguments; FMI 2 has 32 bits for the second and third */
enum { SET_TIME, SET_STATES, GET_DERIVATIVES, SET, GET, TO_EVENTS, UPDATE, TO_CONTINUOUS, RESET, SETUP, TO_INITIAL, FROM_INITIAL, SLOPE, SET_BOOLEAN, SET_INTEGER,
       SET_INTEGER64, FUNCTIONS };
enum { ERROR = 3, ROUNDS = 100 };

typedef struct {
  void *instance, *f[FUNCTIONS];
  int version, nx, na, nr, events, exact; /* events: relations change at events only; exact: directional derivatives are given */
  Ref *argument, *result;
  int *kind, *type;
  double *scale, *a, *r, *slope, start;
  char *known, *told; /* known: r, then each column of slope; told: arguments that were ever given */
  pthread_mutex_t lock;
} Fmu;

#define CALL(k, types, ...) (((int (*)types)m->f[k])(m->instance, __VA_ARGS__) >= ERROR)
#define CALL0(k) (((int (*)(void *))m->f[k])(m->instance) >= ERROR)

static int set(Fmu *m, int j) {
  Ref ref = m->argument[j];
  double value = m->a[j];
  if (m->type[j] == BOOLEAN) {
    int flag = value >= 0.5;
    bool one = flag;
    if (m->version == 2) return CALL(SET_BOOLEAN, (void *, const Ref *, size_t, const int *), &ref, 1, &flag);
    return CALL(SET_BOOLEAN, (void *, const Ref *, size_t, const bool *, size_t), &ref, 1, &one, 1);
  }
  if (m->type[j]) {
    int64_t wide = llround(value);
    int32_t whole = (int32_t)wide;
    if (m->version == 2) return CALL(SET_INTEGER, (void *, const Ref *, size_t, const int *), &ref, 1, &whole);
    if (m->type[j] == INTEGER) return CALL(SET_INTEGER, (void *, const Ref *, size_t, const int32_t *, size_t), &ref, 1, &whole, 1);
    return CALL(SET_INTEGER64, (void *, const Ref *, size_t, const int64_t *, size_t), &ref, 1, &wide, 1);
  }
  if (m->version == 2) return CALL(SET, (void *, const Ref *, size_t, const double *), &ref, 1, &value);
  return CALL(SET, (void *, const Ref *, size_t, const double *, size_t), &ref, 1, &value, 1);
}

/* Enter event mode, and iterate until the discrete states are settled. A state that the FMU sets itself is a failure. */
static int settle(Fmu *m) {
  for (int k = 0; k < ROUNDS; k++) {
    if (m->version == 2) {
      struct { int again, stop, nominals, values, defined; double next; } e = {0};
      if (CALL(UPDATE, (void *, void *), &e) || e.stop || e.values) return 1;
      if (!e.again) return 0;
    } else {
      bool again = false, stop = false, nominals = false, values = false, defined = false;
      double next = 0;
      if (CALL(UPDATE, (void *, bool *, bool *, bool *, bool *, bool *, double *), &again, &stop, &nominals, &values, &defined, &next)
          || stop || values) return 1;
      if (!again) return 0;
    }
  }
  return 1;
}

static int set_kind(Fmu *m, const char *changed, int kind) {
  for (int j = 1 + m->nx; j < m->na; j++)
    if (m->kind[j] == kind && (changed ? changed[j] : m->told[j]) && set(m, j)) return 1;
  return 0;
}

/* Begin anew, with the fixed parameters; the rest is set afterwards. */
static int restart(Fmu *m) {
  if (CALL0(RESET)) return 1;
  if (m->version == 2 && CALL(SETUP, (void *, int, double, double, int, double), 0, 0.0, m->a[0], 0, 0.0)) return 1;
  for (int kind = FIXED; kind >= CONTINUOUS; kind--) if (set_kind(m, NULL, kind)) return 1;
  if (m->version == 2 ? CALL0(TO_INITIAL) : CALL(TO_INITIAL, (void *, bool, double, double, bool, double), false, 0.0, m->a[0], false, 0.0)) return 1;
  return CALL0(FROM_INITIAL) || settle(m) || CALL0(TO_CONTINUOUS);
}

static int apply(Fmu *m, const char *changed) {
  int jump = m->events;
  for (int j = 1 + m->nx; j < m->na; j++) {
    if (changed[j] && m->kind[j] == FIXED) {
      if (restart(m)) return 1;
      break;
    }
    jump |= changed[j] && m->kind[j] == DISCRETE;
  }
  if (CALL(SET_TIME, (void *, double), m->a[0])) return 1;
  if (m->nx && CALL(SET_STATES, (void *, const double *, size_t), m->a + 1, m->nx)) return 1;
  if (set_kind(m, changed, CONTINUOUS)) return 1;
  return jump && (CALL0(TO_EVENTS) || set_kind(m, changed, DISCRETE) || settle(m) || CALL0(TO_CONTINUOUS));
}

static int read_results(Fmu *m, double *r) {
  size_t ny = m->nr - m->nx;
  if (m->nx && CALL(GET_DERIVATIVES, (void *, double *, size_t), r, m->nx)) return 1;
  if (!ny) return 0;
  if (m->version == 2) return CALL(GET, (void *, const Ref *, size_t, double *), m->result + m->nx, ny, r + m->nx);
  return CALL(GET, (void *, const Ref *, size_t, double *, size_t), m->result + m->nx, ny, r + m->nx, ny);
}

static void evaluate(Fmu *m, const char *changed, double *r) {
  if (apply(m, changed) || read_results(m, r)) for (int i = 0; i < m->nr; i++) r[i] = NAN;
}

static void take(Fmu *m, const double *a) {
  char changed[m->na];
  int any = !m->known[0];
  for (int j = 0; j < m->na; j++) {
    changed[j] = !isnan(a[j]) && (a[j] != m->a[j] || !m->told[j]);
    if (changed[j]) m->a[j] = a[j], m->told[j] = 1, any = 1;
  }
  if (!any) return;
  memset(m->known, 0, m->na + 1);
  evaluate(m, changed, m->r);
  m->known[0] = 1;
}

static void column(Fmu *m, int j) {
  double *s = m->slope + (size_t)j * m->nr, one = 1;
  m->known[1 + j] = 1;
  if (m->type[j] != REAL) {
    memset(s, 0, m->nr * sizeof *s);
    return;
  }
  if (m->exact && (m->kind[j] == STATE || m->kind[j] == CONTINUOUS)) {
    int failed = m->version == 2
      ? CALL(SLOPE, (void *, const Ref *, size_t, const Ref *, size_t, const double *, double *), m->result, m->nr, m->argument + j, 1, &one, s)
      : CALL(SLOPE, (void *, const Ref *, size_t, const Ref *, size_t, const double *, size_t, double *, size_t),
             m->result, m->nr, m->argument + j, 1, &one, 1, s, m->nr);
    if (!failed) return;
    m->exact = 0;
  }
  const double at = m->a[j], step = 6e-6 * fmax(fabs(at), m->scale[j]); /* cube root of the rounding error: central differences */
  double up[m->nr];
  char changed[m->na];
  memset(changed, 0, m->na);
  changed[j] = 1;
  m->a[j] = at + step;
  evaluate(m, changed, up);
  m->a[j] = at - step;
  evaluate(m, changed, s);
  for (int i = 0; i < m->nr; i++) s[i] = (up[i] - s[i]) / (2 * step);
  m->a[j] = at;
  apply(m, changed);
}

double fmu_value(void *v, int k, const double *a) {
  Fmu *m = v;
  pthread_mutex_lock(&m->lock);
  take(m, a);
  double out = m->r[k];
  pthread_mutex_unlock(&m->lock);
  return out;
}

double fmu_slope(void *v, int k, int j, const double *a) {
  Fmu *m = v;
  pthread_mutex_lock(&m->lock);
  take(m, a);
  if (!m->known[1 + j]) column(m, j);
  double out = m->slope[(size_t)j * m->nr + k];
  pthread_mutex_unlock(&m->lock);
  return out;
}

/* Result k (or its slope by argument j >= 0) at n rows of arguments. */
void fmu_rows(void *v, int k, int j, int n, const double *a, double *out) {
  for (int i = 0; i < n; i++, a += ((Fmu *)v)->na) out[i] = j < 0 ? fmu_value(v, k, a) : fmu_slope(v, k, j, a);
}

static void *copy(const void *from, size_t size) {
  void *to = malloc(size + 1);
  return to ? memcpy(to, from, size) : NULL;
}

/* sizes: version, nx, na, nr, events, exact. `a` (na,): the values that the instance has now. */
void *fmu_make(void *instance, void *const *functions, const int *sizes, const Ref *argument, const int *kind, const int *type, const double *scale,
               const Ref *result, const double *a) {
  Fmu *m = calloc(1, sizeof *m);
  if (!m) return NULL;
  m->instance = instance;
  memcpy(m->f, functions, sizeof m->f);
  m->version = sizes[0], m->nx = sizes[1], m->na = sizes[2], m->nr = sizes[3], m->events = sizes[4], m->exact = sizes[5];
  m->argument = copy(argument, m->na * sizeof *argument), m->kind = copy(kind, m->na * sizeof *kind), m->type = copy(type, m->na * sizeof *type);
  m->scale = copy(scale, m->na * sizeof *scale), m->a = copy(a, m->na * sizeof *a);
  m->result = copy(result, m->nr * sizeof *result), m->r = calloc(m->nr + 1, sizeof *m->r);
  m->slope = calloc((size_t)m->na * m->nr + 1, sizeof *m->slope);
  m->known = calloc(m->na + 1, 1), m->told = calloc(m->na + 1, 1);
  pthread_mutex_init(&m->lock, NULL);
  return m->argument && m->kind && m->type && m->scale && m->a && m->result && m->r && m->slope && m->known && m->told ? m : NULL;
}
