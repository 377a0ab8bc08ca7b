/* cc -O2 -DMAIN plant.c -lm -o plant; plant < inputs.csv > outputs.csv
   A header line, then rows of the time in seconds and the inputs in the order of INPUTS. */
#include <stdio.h>
static int row_(double *t, double *u) {
  if (scanf("%lf", t) != 1) return 0;
  for (int j = 0; j < NI; j++) if (scanf(",%lf", u + j) != 1) return 0;
  return 1;
}

int main(void) {
  static Model m;
  double t, next, u[NI + 1];
  if (scanf("%*[^\n]") == EOF) return 2;
  model_defaults(&m);
  if (!row_(&t, m.u)) { fprintf(stderr, "inputs.csv: a row of t,%s was expected\n", INPUTS); return 2; }
  printf("t,%s\n", OUTPUTS);
  double zero = t;
  model_start(&m, 0);
  for (;;) {
    model_outputs(&m);
    printf("%.17g", t);
    for (int j = 0; j < NY; j++) printf(",%.17g", m.y[j]);
    printf("\n");
    if (!row_(&next, u)) return 0;
    for (int j = 0; j < NI; j++) m.rate[j] = LINE[j] ? (u[j] - m.u[j]) / (next - t) : 0;
    if (model_step(&m, next - t)) { fprintf(stderr, "the plant cannot be integrated beyond t = %g s\n", t); return 1; }
    m.t = next - zero;
    memcpy(m.u, u, NI * sizeof(double));
    t = next;
  }
}
