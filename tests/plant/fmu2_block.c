/* A heated block as an FMU of FMI 2, model exchange: a fixed parameter C, a tunable G, a heater that a relation switches off
   above 60 degC (it changes at events only), directional derivatives. As strict as FMI 2 about when a variable may be set. */
#include <stdlib.h>
#include <string.h>
#define API __attribute__((visibility("default")))
#ifndef NOMINAL_SLOPE
#define NOMINAL_SLOPE(g, c) (-(g) / (c))
#endif
enum { POWER, AIR, C, G, T, DT, READING, N };
enum { FRESH, INITIAL, EVENT, CONTINUOUS };
typedef struct { double v[N]; int mode, on, enabled, stage; } Block; /* enabled, stage: a Boolean and an integer input */
typedef unsigned Ref;
API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }
static void defaults(Block *b) { double v[N] = {0, 22, 100, 0.2, 22, 0, 22}; memcpy(b->v, v, sizeof v); b->mode = FRESH; b->on = b->enabled = b->stage = 1; }
API void *fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f, int g) {
  Block *m = calloc(1, sizeof *m); defaults(m); return m;
}
API void fmi2FreeInstance(void *b) { free(b); }
API int fmi2SetupExperiment(void *b, int d, double t, double s, int e, double x) { return 0; }
API int fmi2EnterInitializationMode(void *v) { ((Block *)v)->mode = INITIAL; return 0; }
API int fmi2ExitInitializationMode(void *v) { ((Block *)v)->mode = EVENT; return 0; }
API int fmi2Terminate(void *b) { return 0; }
API int fmi2Reset(void *b) { defaults(b); return 0; }
API int fmi2EnterEventMode(void *v) { ((Block *)v)->mode = EVENT; return 0; }
API int fmi2NewDiscreteStates(void *v, char *info) {
  Block *b = v; memset(info, 0, 20); b->on = b->v[T] < 60; return b->mode == EVENT ? 0 : 3;
}
API int fmi2EnterContinuousTimeMode(void *v) { ((Block *)v)->mode = CONTINUOUS; return 0; }
API int fmi2CompletedIntegratorStep(void *v, int a, int *b, int *c) { *b = *c = 0; return 0; }
API int fmi2SetTime(void *v, double t) { return 0; }
API int fmi2SetContinuousStates(void *v, const double *x, size_t n) { Block *b = v; b->v[T] = x[0]; return b->mode == CONTINUOUS ? 0 : 3; }
API int fmi2GetContinuousStates(void *v, double *x, size_t n) { x[0] = ((Block *)v)->v[T]; return 0; }
API int fmi2GetNominalsOfContinuousStates(void *v, double *x, size_t n) { x[0] = 1; return 0; }
API int fmi2GetEventIndicators(void *v, double *z, size_t n) { z[0] = ((Block *)v)->v[T] - 60; return 0; }
static void update(Block *b) {
  double *v = b->v;
  v[DT] = ((b->on && b->enabled ? b->stage * v[POWER] : 0) - v[G] * (v[T] - v[AIR])) / v[C]; v[READING] = v[T] + 0.01 * v[POWER];
}
API int fmi2GetDerivatives(void *v, double *x, size_t n) { update(v); x[0] = ((Block *)v)->v[DT]; return 0; }
API int fmi2SetReal(void *v, const Ref *r, size_t n, const double *x) {
  Block *b = v;
  for (size_t i = 0; i < n; i++) {
    if (r[i] == C && b->mode != FRESH && b->mode != INITIAL) return 3;
    if (r[i] == G && b->mode == CONTINUOUS) return 3;
    b->v[r[i]] = x[i];
  }
  return 0;
}
API int fmi2GetReal(void *v, const Ref *r, size_t n, double *x) { update(v); for (size_t i = 0; i < n; i++) x[i] = ((Block *)v)->v[r[i]]; return 0; }
API int fmi2GetDirectionalDerivative(void *v, const Ref *z, size_t nz, const Ref *k, size_t nk, const double *d, double *out) {
  Block *b = v;
  for (size_t i = 0; i < nz; i++)
    out[i] = d[0] * (z[i] == DT ? (*k == T ? NOMINAL_SLOPE(b->v[G], b->v[C]) : *k == AIR ? b->v[G] / b->v[C] : b->on / b->v[C])
                                : *k == T ? 1 : *k == POWER ? 0.01 : 0);
  return 0;
}
API int fmi2DoStep(void *v, double t, double h, int n) { /* as co-simulation: refuses a power above 100 */
  Block *b = v;
  if (b->v[POWER] > 100) return 3;
  for (int k = 0; k < 100; k++) update(b), b->v[T] += h / 100 * b->v[DT];
  return 0;
}
API int fmi2GetBoolean(void *v, const Ref *r, size_t n, int *x) { x[0] = ((Block *)v)->enabled; return 0; }
API int fmi2SetBoolean(void *v, const Ref *r, size_t n, const int *x) { Block *b = v; b->enabled = x[0]; return b->mode == CONTINUOUS ? 3 : 0; }
API int fmi2GetInteger(void *v, const Ref *r, size_t n, int *x) { x[0] = ((Block *)v)->stage; return 0; }
API int fmi2SetInteger(void *v, const Ref *r, size_t n, const int *x) { Block *b = v; b->stage = x[0]; return b->mode == CONTINUOUS ? 3 : 0; }
#define UNUSED(name) API int fmi2##name(void *b) { return 3; }
UNUSED(SetDebugLogging) UNUSED(GetString) UNUSED(SetString)
UNUSED(CancelStep) UNUSED(GetRealOutputDerivatives) UNUSED(SetRealInputDerivatives) UNUSED(GetStatus) UNUSED(GetRealStatus) UNUSED(GetIntegerStatus) UNUSED(GetBooleanStatus) UNUSED(GetStringStatus)
UNUSED(GetFMUstate) UNUSED(SetFMUstate) UNUSED(FreeFMUstate) UNUSED(SerializedFMUstateSize) UNUSED(SerializeFMUstate) UNUSED(DeSerializeFMUstate)
