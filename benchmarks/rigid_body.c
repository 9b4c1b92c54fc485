/* One CF4 step of the free rigid body, written by hand: the yardstick of rigid_body.py. */
#include <math.h>

/* One system, libm. */

static inline void rotate(const double a[3], const double v[3], double r[3]) {
  double s = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], x = sqrt(s);
  double c1 = x < 1e-4 ? 1 - s / 6 : sin(x) / x, c2 = x < 1e-4 ? 0.5 - s / 24 : (1 - cos(x)) / s;
  double w[3] = {a[1] * v[2] - a[2] * v[1], a[2] * v[0] - a[0] * v[2], a[0] * v[1] - a[1] * v[0]};
  double u[3] = {a[1] * w[2] - a[2] * w[1], a[2] * w[0] - a[0] * w[2], a[0] * w[1] - a[1] * w[0]};
  for (int i = 0; i < 3; i++) r[i] = v[i] + c1 * w[i] + c2 * u[i];
}

#define FOR3 for (int i = 0; i < 3; i++)

#define CF4_STEP(REAL, FIELD, ROTATE)                                                    \
  REAL F1[3], F2[3], F3[3], F4[3], a[3], Y2[3], Y[3], m[3];                              \
  FIELD(y, F1);                                                                          \
  FOR3 a[i] = 0.5 * F1[i];                                                               \
  ROTATE(a, y, Y2);                                                                      \
  FIELD(Y2, F2);                                                                         \
  FOR3 a[i] = 0.5 * F2[i];                                                               \
  ROTATE(a, y, Y);                                                                       \
  FIELD(Y, F3);                                                                          \
  FOR3 a[i] = F3[i] - 0.5 * F1[i];                                                       \
  ROTATE(a, Y2, Y);                                                                      \
  FIELD(Y, F4);                                                                          \
  FOR3 a[i] = (1.0 / 4) * F1[i] + (1.0 / 6) * (F2[i] + F3[i]) - (1.0 / 12) * F4[i];      \
  ROTATE(a, y, m);                                                                       \
  FOR3 a[i] = (-1.0 / 12) * F1[i] + (1.0 / 6) * (F2[i] + F3[i]) + (1.0 / 4) * F4[i];     \
  ROTATE(a, m, y);

void cf4(double *y, const double *inertia, double h, long steps) {
#define FIELD(Y, F) FOR3 (F)[i] = h * (-(Y)[i] / inertia[i])
  for (long n = 0; n < steps; n++) {
    CF4_STEP(double, FIELD, rotate)
  }
}

/* Many systems, eight to a vector; every block stays in registers for all its steps. The angle
   per exponential must be at most 4: nine terms of the series at a quarter of the angle, and two
   doublings. */

typedef double v8 __attribute__((vector_size(64)));

static inline void rotate8(const v8 a[3], const v8 v[3], v8 r[3]) {
  v8 s = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], z = s * 0.0625;
  v8 c1 = {0}, c2 = {0};
  static const double series[19] = {
      1.0, 1.0, 1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880,
      1. / 3628800, 1. / 39916800, 1. / 479001600, 1. / 6227020800., 1. / 87178291200.,
      1. / 1307674368000., 1. / 20922789888000., 1. / 355687428096000., 1. / 6402373705728000.};
  for (int n = 8; n >= 0; n--) {
    double sign = n % 2 ? -1 : 1;
    c1 = c1 * z + sign * series[2 * n + 1];
    c2 = c2 * z + sign * series[2 * n + 2];
  }
  for (int k = 0; k < 2; k++) {
    v8 c = 1 - z * c2;
    c2 = 0.5 * c1 * c1;
    c1 = c1 * c;
    z = 4 * z;
  }
  v8 w[3] = {a[1] * v[2] - a[2] * v[1], a[2] * v[0] - a[0] * v[2], a[0] * v[1] - a[1] * v[0]};
  v8 u[3] = {a[1] * w[2] - a[2] * w[1], a[2] * w[0] - a[0] * w[2], a[0] * w[1] - a[1] * w[0]};
  FOR3 r[i] = v[i] + c1 * w[i] + c2 * u[i];
}

/* y is (batch, 3) and batch a multiple of 8. */
void cf4_batch(double *ys, long batch, const double *inertia, double h, long steps) {
#define FIELD8(Y, F) FOR3 (F)[i] = h * (-(Y)[i] / inertia[i])
  for (long b = 0; b < batch; b += 8) {
    v8 y[3] = {{0}, {0}, {0}};
    for (int k = 0; k < 8; k++) FOR3 y[i][k] = ys[3 * (b + k) + i];
    for (long n = 0; n < steps; n++) {
      CF4_STEP(v8, FIELD8, rotate8)
    }
    for (int k = 0; k < 8; k++) FOR3 ys[3 * (b + k) + i] = y[i][k];
  }
}
