/* What a plant's equations (written by compile.py) give to the integrator, which is compiled apart from them. */
#pragma once
#pragma GCC visibility push(hidden)
#define LANES 8 /* columns of sensitivities at a time */
typedef double lanes __attribute__((vector_size(8 * LANES), aligned(8)));
#define AT double t, const double *x, const double *u, const double *p, const double *w

extern const int NU, NY, ND;                                                  /* inputs, outputs, delays of outputs */
extern const int NJ, J_ROW[], J_COL[], NV, V_ROW[], V_COL[];                  /* entries of df/dx, and of df/dq by parameters */
extern const int NO0, O0_ROW[], O0_KIND[], O0_COL[], NO1, O1_ROW[], O1_KIND[], O1_COL[];    /* of the slopes of outputs, delays */
extern const int NM;                                                          /* of the factors of I - a df/dx */
void rhs_(AT, double *out);
void jac_(AT, double *out);
void rhs_jac_(AT, double *out);                                               /* both, unless df/dx is constant */
void sens_(AT, double *out);                                                  /* df/dx, unless it is constant, then df/dq */
void outputs_(AT, const double *d, double *out), outputs_slopes_(AT, const double *d, double *out);
void delayed_(AT, const double *d, double *out), delayed_slopes_(AT, const double *d, double *out);
int factor_(double a, const double *J, double *M);
void solve_(const double *M, double *r);
void solve_lanes_(const double *restrict M, lanes *restrict r);
void multiply_lanes_(const double *J, const lanes *R, lanes *restrict k);     /* k += J R */
#pragma GCC visibility pop
