/* FMI 2.0.4, model exchange and co-simulation, around one Model (https://fmi-standard.org).
   Value references, in this order: inputs, parameters, widths of jumps, first readings, shifts of initial states, states,
   their derivatives, outputs. A jump of time of width 0 is a time event. */
#if defined _WIN32
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif
#define OK 0
#define ERROR 3
enum { V_P = NI, V_W = V_P + NP, V_F = V_W + NW, V_S = V_F + NF, V_X = V_S + NX, V_D = V_X + NX, V_Y = V_D + NX, V_END = V_Y + NY };
typedef unsigned int Ref;
typedef struct { void *logger; void *(*allocate)(size_t, size_t); void (*release)(void *); void *finished, *environment; } Callbacks;
typedef struct { int again, terminate, nominals, states, defined; double time; } EventInfo;
typedef struct { Model m; double width[NW + 1]; int running; } Instance;    /* width: as set; m.w: latched between events */

/* Latch the jumps of time of width 0; return the next one's time, or INFINITY. */
static double latch(Instance *c) {
  double next = INFINITY;
  for (int i = 0; i < NW; i++) {
    c->m.w[i] = c->width[i];
    if (c->width[i] > 0 || !TIMED[i]) continue;
    double z0 = time_jump_(i, 0, c->m.p), slope = time_jump_(i, 1, c->m.p) - z0;
    double at = slope != 0 ? -z0 / slope : INFINITY;
    int passed = at <= c->m.t + 1e-9 * fmax(1, fabs(at));
    c->m.w[i] = (slope != 0 ? passed == (slope > 0) : z0 >= 0) ? -2 : -1;
    if (!passed && at < next) next = at;
  }
  return next;
}

static double *place(Instance *c, Ref v) {
  if (v < V_P) return &c->m.u[v];
  if (v < V_W) return &c->m.p[v - V_P];
  if (v < V_F) return &c->width[v - V_W];
  if (v < V_S) return &c->m.first[v - V_F];
  if (v < V_X) return &c->m.shift[v - V_S];
  return v < V_D ? &c->m.x[v - V_X] : 0;
}

API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }
API int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const k[]) { (void)c; (void)on; (void)n; (void)k; return OK; }

API int fmi2Reset(void *v) {
  Instance *c = v;
  model_free(&c->m);
  model_defaults(&c->m);
  memcpy(c->width, c->m.w, sizeof c->width);
  memcpy(c->m.u, START, NI * sizeof(double));
  c->running = 0;
  return OK;
}

API void *fmi2Instantiate(const char *name, int type, const char *guid, const char *place, const Callbacks *f, int visible, int log) {
  (void)name; (void)type; (void)place; (void)f; (void)visible; (void)log;
  if (!guid || strcmp(guid, GUID)) return 0;
  Instance *c = calloc(1, sizeof *c);
  if (c) fmi2Reset(c);
  return c;
}

API void fmi2FreeInstance(void *v) { if (v) { model_free(&((Instance *)v)->m); free(v); } }

API int fmi2SetupExperiment(void *v, int has, double tolerance, double start, int hasStop, double stop) {
  Instance *c = v;
  (void)hasStop; (void)stop;
  if (has && tolerance > 0 && tolerance < c->m.tolerance) c->m.tolerance = tolerance;
  c->m.t = start;
  return OK;
}

API int fmi2EnterInitializationMode(void *v) { (void)v; return OK; }

API int fmi2ExitInitializationMode(void *v) {
  Instance *c = v;
  latch(c);
  model_start(&c->m, c->m.t);
  c->running = 1;
  return OK;
}

API int fmi2Terminate(void *v) { (void)v; return OK; }

API int fmi2SetReal(void *v, const Ref r[], size_t n, const double value[]) {
  for (size_t i = 0; i < n; i++) {
    double *to = place(v, r[i]);
    if (!to || r[i] >= V_X) return ERROR;
    *to = value[i];
    if (r[i] < V_P) ((Instance *)v)->m.rate[r[i]] = 0;
  }
  return OK;
}

API int fmi2GetReal(void *v, const Ref r[], size_t n, double value[]) {
  Instance *c = v;
  double slope[NX + 1];
  int slopes = 0, outputs = 0;
  if (!c->running) {                       /* before the start: as it would start now */
    latch(c);
    model_start(&c->m, c->m.t);
  }
  for (size_t i = 0; i < n; i++) {
    if (r[i] >= V_END) return ERROR;
    if (r[i] < V_D) { value[i] = *place(c, r[i]); continue; }
    if (r[i] < V_Y) {
      if (!slopes++) rhs_(c->m.t, c->m.x, c->m.u, c->m.p, c->m.w, slope);
      value[i] = slope[r[i] - V_D];
      continue;
    }
    if (!outputs++) model_outputs(&c->m);
    value[i] = c->m.y[r[i] - V_Y];
  }
  return OK;
}

#define NONE(what, type) \
  API int fmi2Get##what(void *c, const Ref r[], size_t n, type v[]) { (void)c; (void)r; (void)v; return n ? ERROR : OK; } \
  API int fmi2Set##what(void *c, const Ref r[], size_t n, const type v[]) { (void)c; (void)r; (void)v; return n ? ERROR : OK; }
NONE(Integer, int)
NONE(Boolean, int)
NONE(String, char *)

/* Not offered: states of the whole FMU (the description says so). */
API int fmi2GetFMUstate(void *c, void **s) { (void)c; (void)s; return ERROR; }
API int fmi2SetFMUstate(void *c, void *s) { (void)c; (void)s; return ERROR; }
API int fmi2FreeFMUstate(void *c, void **s) { (void)c; (void)s; return ERROR; }
API int fmi2SerializedFMUstateSize(void *c, void *s, size_t *n) { (void)c; (void)s; (void)n; return ERROR; }
API int fmi2SerializeFMUstate(void *c, void *s, char b[], size_t n) { (void)c; (void)s; (void)b; (void)n; return ERROR; }
API int fmi2DeSerializeFMUstate(void *c, const char b[], size_t n, void **s) { (void)c; (void)b; (void)n; (void)s; return ERROR; }
API int fmi2GetDirectionalDerivative(void *c, const Ref z[], size_t nz, const Ref v[], size_t nv, const double dv[], double dz[]) {
  (void)c; (void)z; (void)nz; (void)v; (void)nv; (void)dv; (void)dz;
  return ERROR;
}

/* Model exchange. */
API int fmi2EnterEventMode(void *v) { (void)v; return OK; }
API int fmi2EnterContinuousTimeMode(void *v) { (void)v; return OK; }
API int fmi2NewDiscreteStates(void *v, EventInfo *e) {
  memset(e, 0, sizeof *e);
  e->time = latch(v);
  e->defined = e->time < INFINITY;
  return OK;
}
API int fmi2CompletedIntegratorStep(void *v, int keep, int *event, int *terminate) { (void)v; (void)keep; *event = *terminate = 0; return OK; }
API int fmi2SetTime(void *v, double t) { ((Instance *)v)->m.t = t; return OK; }
API int fmi2SetContinuousStates(void *v, const double x[], size_t n) { memcpy(((Instance *)v)->m.x, x, n * sizeof(double)); return n == NX ? OK : ERROR; }
API int fmi2GetContinuousStates(void *v, double x[], size_t n) { memcpy(x, ((Instance *)v)->m.x, n * sizeof(double)); return n == NX ? OK : ERROR; }
API int fmi2GetNominalsOfContinuousStates(void *v, double x[], size_t n) { memcpy(x, ((Instance *)v)->m.scale, n * sizeof(double)); return n == NX ? OK : ERROR; }
API int fmi2GetEventIndicators(void *v, double z[], size_t n) { (void)v; (void)z; return n ? ERROR : OK; }
API int fmi2GetDerivatives(void *v, double dx[], size_t n) {
  Model *m = &((Instance *)v)->m;
  if (n != NX) return ERROR;
  rhs_(m->t, m->x, m->u, m->p, m->w, dx);
  return OK;
}

/* Co-simulation. */
API int fmi2SetRealInputDerivatives(void *v, const Ref r[], size_t n, const int order[], const double value[]) {
  for (size_t i = 0; i < n; i++) {
    if (r[i] >= V_P || order[i] != 1) return ERROR;
    ((Instance *)v)->m.rate[r[i]] = value[i];
  }
  return OK;
}
API int fmi2GetRealOutputDerivatives(void *v, const Ref r[], size_t n, const int order[], double value[]) {
  (void)v; (void)r; (void)order; (void)value;
  return n ? ERROR : OK;
}
API int fmi2DoStep(void *v, double t, double h, int keep) {
  Instance *c = v;
  (void)keep;
  memcpy(c->m.w, c->width, sizeof c->width);   /* the integrator's own steps find a jump */
  c->m.t = t;
  if (!(h > 0)) return h == 0 ? OK : ERROR;
  if (model_step(&c->m, h)) return ERROR;
  c->m.t = t + h;
  memset(c->m.rate, 0, sizeof c->m.rate);
  return OK;
}
API int fmi2CancelStep(void *v) { (void)v; return ERROR; }
API int fmi2GetStatus(void *v, int kind, int *value) { (void)v; (void)kind; (void)value; return 2; }
API int fmi2GetRealStatus(void *v, int kind, double *value) { (void)kind; *value = ((Instance *)v)->m.t; return OK; }
API int fmi2GetIntegerStatus(void *v, int kind, int *value) { (void)v; (void)kind; (void)value; return 2; }
API int fmi2GetBooleanStatus(void *v, int kind, int *value) { (void)v; (void)kind; *value = 0; return OK; }
API int fmi2GetStringStatus(void *v, int kind, const char **value) { (void)v; (void)kind; (void)value; return 2; }
