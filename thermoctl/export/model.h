/* One run of an exported plant: start, advance, read. The including file defines the sizes NX (states), NI (recorded inputs),
   NID (delayed inputs), NU = NI + NID, NP, NW (widths of jumps), NF (first readings), ND (delays of outputs) and NY, the
   defaults, and the functions rhs_, outputs_, delayed_, signals_, seconds_ and initial_. Times in seconds. */
typedef struct {
  double t, x[NX + 1], u[NU + 1], rate[NI + 1], p[NP + 1], w[NW + 1], first[NF + 1], shift[NX + 1], y[NY + 1];
  double scale[NX + 1], tolerance, want;
  double *past;        /* rows of t, the signals of the delayed inputs, the arguments of the outputs' delays */
  int kept, room, short_of_memory;
} Model;
#define ROW (1 + NID + ND)

static void model_defaults(Model *m) {
  memset(m, 0, sizeof *m);
  memcpy(m->p, PARAMETERS, NP * sizeof(double));
  memcpy(m->w, WIDTHS, NW * sizeof(double));
  memcpy(m->first, FIRST, NF * sizeof(double));
  m->tolerance = 1e-8;
}

static void model_free(Model *m) { free(m->past); m->past = 0; m->kept = m->room = 0; }

/* Keep what delays need of the present time; a second call at one time replaces the first. */
static void remember(Model *m) {
  if (NID + ND == 0) return;
  int n = m->kept;
  if (n && m->past[(n - 1) * ROW] >= m->t) n--;
  if (n == m->room) {
    double seconds[NID + ND + 1], longest = 0;
    int old = 0;
    seconds_(m->p, seconds);
    for (int j = 0; j < NID + ND; j++) longest = fmax(longest, seconds[j]);
    while (old < n - 4 && m->past[(old + 4) * ROW] < m->t - longest) old++;
    if (old > n / 2) { memmove(m->past, m->past + old * ROW, (size_t)(n - old) * ROW * sizeof(double)); n -= old; }
    else {
      int room = m->room ? 2 * m->room : 1024;
      double *more = realloc(m->past, (size_t)room * ROW * sizeof(double));
      if (!more) { m->short_of_memory = 1; return; }
      m->past = more;
      m->room = room;
    }
  }
  double *row = m->past + (size_t)n * ROW;
  row[0] = m->t;
  signals_(m->u, row + 1);
  delayed_(m->t, m->x, m->u, m->p, m->w, 0, row + 1 + NID);
  m->kept = n + 1;
}

static int row_at(const Model *m, double t) {         /* the last row not after t; row 0 before the start */
  int low = 0, high = m->kept;
  while (high - low > 1) { int k = (low + high) / 2; if (m->past[k * ROW] <= t) low = k; else high = k; }
  return low;
}

/* Slope of column c from row k to the next; beyond the rows the lines go on bending. */
static double line_slope(const Model *m, int k, int c) {
  int last = m->kept - 2, near = k < 0 ? 0 : last;
  if (k >= 0 && k <= last) {
    const double *q = m->past + (size_t)k * ROW;
    return (q[ROW + c] - q[c]) / (q[ROW] - q[0]);
  }
  if (last < 1) return last < 0 ? 0 : line_slope(m, 0, c);
  double at = line_slope(m, near, c), bend = near ? at - line_slope(m, near - 1, c) : line_slope(m, 1, c) - at;
  return at + (k - near) * bend;
}

/* Slope of column c at row k, after Akima (J. ACM 17 (1970) 589): of the two lines that meet, the one that bends less counts more. */
static double row_slope(const Model *m, int k, int c) {
  double first = line_slope(m, k - 2, c), before = line_slope(m, k - 1, c);
  double after = line_slope(m, k, c), last = line_slope(m, k + 1, c);
  double bend = fabs(first - before), turn = fabs(last - after), both = bend + turn;
  return both > 0 ? (turn * before + bend * after) / both : 0.5 * (before + after);
}

/* Column c at time t: cubic between rows, held before the start. */
static double past_value(const Model *m, double t, int c) {
  int k = row_at(m, t);
  const double *q = m->past + (size_t)k * ROW;
  if (t <= q[0] || k + 1 >= m->kept) return q[c];
  double h = q[ROW] - q[0], s = (t - q[0]) / h;
  return (1 + 2 * s) * (1 - s) * (1 - s) * q[c] + s * (1 - s) * (1 - s) * h * row_slope(m, k, c)
       + s * s * (3 - 2 * s) * q[ROW + c] + s * s * (s - 1) * h * row_slope(m, k + 1, c);
}

/* Column c at time t on straight lines; the row after the newest is (end, value). */
static double past_line(const Model *m, double t, int c, double end, double value) {
  int k = row_at(m, t);
  const double *q = m->past + (size_t)k * ROW;
  if (t <= q[0]) return q[c];
  double next = k + 1 < m->kept ? q[ROW] : end, to = k + 1 < m->kept ? q[ROW + c] : value;
  return q[c] + (t - q[0]) / (next - q[0]) * (to - q[c]);
}

/* Mean of the held column c from a to b. */
static double past_mean(const Model *m, double a, double b, int c) {
  double area = 0, at = a;
  for (int k = row_at(m, a); at < b; k++) {
    double stop = k + 1 < m->kept ? fmin(b, m->past[(k + 1) * ROW]) : b;
    area += (stop - at) * m->past[(size_t)k * ROW + c];
    at = stop;
  }
  return area / (b - a);
}

/* Start at time t with the inputs m->u. */
static void model_start(Model *m, double t) {
  m->t = t;
  m->want = 0;
  m->kept = 0;
  memset(m->rate, 0, sizeof m->rate);
  initial_(m->u, m->p, m->first, m->x);
  for (int i = 0; i < NX; i++) {
    m->x[i] += m->shift[i];
    m->scale[i] = SCALES[i] > 0 ? SCALES[i] : fabs(m->x[i]) + 1e-3;
  }
  remember(m);
}

/* The outputs at the present time, into m->y. */
static void model_outputs(Model *m) {
  double d[ND + 1], seconds[NID + ND + 1];
  if (ND) {
    remember(m);
    seconds_(m->p, seconds);
    for (int j = 0; j < ND; j++) d[j] = past_value(m, m->t - fmax(seconds[NID + j], 0), 1 + NID + j);
  }
  outputs_(m->t, m->x, m->u, m->p, m->w, d, m->y);
}

/* Advance by h seconds. Inputs of straight lines change by m->rate a second, the others are held. 1 where it fails. */
static int model_step(Model *m, double h) {
  double end[NU + 1], atol[NX + 1], seconds[NID + ND + 1], s[NID + 1];
  remember(m);
  for (int j = 0; j < NI; j++) end[j] = m->u[j] + (LINE[j] ? m->rate[j] * h : 0);
  if (NID) {
    seconds_(m->p, seconds);
    signals_(end, s);
    for (int j = 0; j < NID; j++) {
      double from = m->t - fmax(seconds[j], 0);
      m->u[NI + j] = LINE[NI + j] ? past_line(m, from, 1 + j, m->t + h, s[j]) : past_mean(m, from, from + h, 1 + j);
      end[NI + j] = LINE[NI + j] ? past_line(m, from + h, 1 + j, m->t + h, s[j]) : m->u[NI + j];
    }
  }
  for (int i = 0; i < NX; i++) atol[i] = m->tolerance * m->scale[i];
  if (advance_states_(m->t, h, m->u, end, LINE, m->p, m->w, m->tolerance, atol, m->x, &m->want) || m->short_of_memory) return 1;
  for (int i = 0; i < NX; i++) if (!(fabs(m->x[i]) < 1e300)) return 1;
  m->t += h;
  memcpy(m->u, end, NU * sizeof(double));
  return 0;
}
