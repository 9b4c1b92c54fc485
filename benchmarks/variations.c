/* A window of an IMU, its covariance and its bias Jacobian, written by hand: the yardstick of
   variations.py. It is included in itself, once for one window and once for eight in a vector. */
#ifndef REAL
#include <math.h>

typedef double v8 __attribute__((vector_size(64)));

#define FOR3(i) for (int i = 0; i < 3; i++)

#define REAL double
#define LANES 1
#define NAME(name) name##_1
#include "variations.c"
#undef REAL
#undef LANES
#undef NAME
#define REAL v8
#define LANES 8
#define NAME(name) name##_8
#include "variations.c"

/* Of each window the biases, 6 numbers, and where results go: attitude (9), velocity (3) and
   position (3); P (81); S (54). More than one are a multiple of 8. */
void windows(long count, long steps, const double *bias, const double *noise, double *state,
             double *p, double *s) {
  if (count == 1) window_1(steps, bias, noise, state, p, s);
  for (long b = 0; b + 8 <= count; b += 8)
    window_8(steps, bias + 6 * b, noise, state + 15 * b, p + 81 * b, s + 54 * b);
}

#else

typedef REAL NAME(matrix)[3][3];
#define MATRIX NAME(matrix)

static inline void NAME(product)(const MATRIX a, const MATRIX b, MATRIX c) {
  FOR3(i) FOR3(j) c[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}

/* a transposed times b, and a times b transposed. */
static inline void NAME(tproduct)(const MATRIX a, const MATRIX b, MATRIX c) {
  FOR3(i) FOR3(j) c[i][j] = a[0][i] * b[0][j] + a[1][i] * b[1][j] + a[2][i] * b[2][j];
}
static inline void NAME(productt)(const MATRIX a, const MATRIX b, MATRIX c) {
  FOR3(i) FOR3(j) c[i][j] = a[i][0] * b[j][0] + a[i][1] * b[j][1] + a[i][2] * b[j][2];
}

/* Of a rotation vector the rotation, and the right Jacobian: I + c1 W + c2 W^2, I - c2 W + c3 W^2.
   Angles of a step are small: below 0.1 the terms left out are below a unit of rounding. */
static inline void NAME(turn)(const REAL w[3], MATRIX e, MATRIX jacobian) {
  REAL s = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
  REAL c1 = 1 + s * (-1. / 6 + s * (1. / 120 + s * (-1. / 5040 + s / 362880)));
  REAL c2 = 0.5 + s * (-1. / 24 + s * (1. / 720 + s * (-1. / 40320 + s / 3628800)));
  REAL c3 = 1. / 6 + s * (-1. / 120 + s * (1. / 5040 + s * (-1. / 362880 + s / 39916800)));
  FOR3(i) FOR3(j) {
    REAL outer = w[i] * w[j];
    e[i][j] = c2 * outer;
    jacobian[i][j] = c3 * outer;
  }
  FOR3(i) {
    int j = (i + 1) % 3, k = (i + 2) % 3;
    e[i][i] += 1 - c2 * s;
    jacobian[i][i] += 1 - c3 * s;
    e[i][j] -= c1 * w[k];
    e[j][i] += c1 * w[k];
    jacobian[i][j] += c2 * w[k];
    jacobian[j][i] -= c2 * w[k];
  }
}

/* a times the cross product with f. */
static inline void NAME(crossed)(const MATRIX a, const REAL f[3], MATRIX c) {
  FOR3(i) FOR3(j) c[i][j] = a[i][(j + 1) % 3] * f[(j + 2) % 3] - a[i][(j + 2) % 3] * f[(j + 1) % 3];
}

/* Preintegration on the manifold with readings in the middle of a step, of order two. Covariance
   and bias Jacobian by its exact derivatives, with half of the noise before and half after a step.
   Coordinates: angles in the frame of the body, velocity and position in the fixed one. */
static void NAME(window)(long steps, const double *bias, const double *noise, double *state,
                         double *p, double *s) {
  double h = 1.0 / steps, half = 0.5 * h * h;
  REAL b[6] = {0}, v[3] = {0}, x[3] = {0};
  double *lanes = (double *)b;
  for (int l = 0; l < LANES; l++)
    for (int i = 0; i < 6; i++) lanes[LANES * i + l] = bias[6 * l + i];
  MATRIX r = {0}, aa = {0}, va = {0}, vv = {0}, xa = {0}, xv = {0},
         xx = {0}, ag = {0}, vg = {0}, vf = {0}, xg = {0}, xf = {0};
  FOR3(i) r[i][i] += 1;
  for (long n = 0; n < steps; n++) {
    double t = (n + 0.5) * h;
    double gyro[3] = {sin(3 * t), cos(2 * t), 0.5}, force[3] = {cos(t), sin(2 * t), 9.81};
    REAL w[3], f[3], a[3];
    MATRIX e, e2, jr, jr2, mid, m, c, mt, pa, pv, px, u, k;
    FOR3(i) w[i] = 0.5 * h * (gyro[i] - b[i]);
    FOR3(i) f[i] = force[i] - b[3 + i];
    NAME(turn)(w, e2, jr2);
    FOR3(i) w[i] *= 2;
    NAME(turn)(w, e, jr);
    NAME(product)(r, e2, mid);
    FOR3(i) a[i] = mid[i][0] * f[0] + mid[i][1] * f[1] + mid[i][2] * f[2];
    a[2] -= 9.81;
    FOR3(i) x[i] += h * v[i] + half * a[i];
    FOR3(i) v[i] += h * a[i];
    NAME(product)(r, e, u);
    FOR3(i) FOR3(j) r[i][j] = u[i][j];

    /* The acceleration changes by m times the angles, and by k times the bias of the gyroscope. */
    NAME(crossed)(mid, f, c);
    NAME(productt)(c, e2, m);
    FOR3(i) FOR3(j) m[i][j] = -m[i][j];
    NAME(product)(c, jr2, k);
    FOR3(i) FOR3(j) k[i][j] *= 0.5 * h;

    FOR3(i) aa[i][i] += 0.5 * h * noise[0];
    FOR3(i) vv[i][i] += 0.5 * h * noise[1];
    NAME(product)(m, aa, pa);
    NAME(productt)(m, va, pv);
    NAME(productt)(m, xa, px);
    /* The rows of F P for the position, then for the velocity. */
    MATRIX x0, x1, x2, v0, v1;
    FOR3(i) FOR3(j) {
      x0[i][j] = half * pa[i][j] + h * va[i][j] + xa[i][j];
      x1[i][j] = half * pv[i][j] + h * vv[i][j] + xv[i][j];
      x2[i][j] = half * px[i][j] + h * xv[j][i] + xx[i][j];
      v0[i][j] = h * pa[i][j] + va[i][j];
      v1[i][j] = h * pv[i][j] + vv[i][j];
    }
    NAME(productt)(x0, m, mt);
    FOR3(i) FOR3(j) {
      xv[i][j] = h * mt[i][j] + x1[i][j];
      xx[i][j] = half * mt[i][j] + h * x1[i][j] + x2[i][j];
    }
    NAME(productt)(v0, m, mt);
    FOR3(i) FOR3(j) vv[i][j] = h * mt[i][j] + v1[i][j];
    NAME(product)(x0, e, xa);
    NAME(product)(v0, e, va);
    NAME(product)(aa, e, u);
    NAME(tproduct)(e, u, aa);
    FOR3(i) aa[i][i] += 0.5 * h * noise[0];
    FOR3(i) vv[i][i] += 0.5 * h * noise[1];

    NAME(product)(m, ag, u);
    FOR3(i) FOR3(j) {
      REAL by_gyro = u[i][j] + k[i][j];
      xg[i][j] += h * vg[i][j] + half * by_gyro;
      vg[i][j] += h * by_gyro;
      xf[i][j] += h * vf[i][j] - half * mid[i][j];
      vf[i][j] -= h * mid[i][j];
    }
    NAME(tproduct)(e, ag, u);
    FOR3(i) FOR3(j) ag[i][j] = u[i][j] - h * jr[i][j];
  }
  for (int l = 0; l < LANES; l++) {
#define LANE(value) (((double *)&(value))[l])
    FOR3(i) {
      FOR3(j) {
        state[15 * l + 3 * i + j] = LANE(r[i][j]);
        double *q = p + 81 * l, *z = s + 54 * l;
        q[9 * i + j] = LANE(aa[i][j]);
        q[9 * (3 + i) + j] = q[9 * j + 3 + i] = LANE(va[i][j]);
        q[9 * (3 + i) + 3 + j] = LANE(vv[i][j]);
        q[9 * (6 + i) + j] = q[9 * j + 6 + i] = LANE(xa[i][j]);
        q[9 * (6 + i) + 3 + j] = q[9 * (3 + j) + 6 + i] = LANE(xv[i][j]);
        q[9 * (6 + i) + 6 + j] = LANE(xx[i][j]);
        z[6 * i + j] = LANE(ag[i][j]);
        z[6 * i + 3 + j] = 0;
        z[6 * (3 + i) + j] = LANE(vg[i][j]);
        z[6 * (3 + i) + 3 + j] = LANE(vf[i][j]);
        z[6 * (6 + i) + j] = LANE(xg[i][j]);
        z[6 * (6 + i) + 3 + j] = LANE(xf[i][j]);
      }
      state[15 * l + 9 + i] = LANE(v[i]);
      state[15 * l + 12 + i] = LANE(x[i]);
    }
#undef LANE
  }
}
#undef MATRIX
#endif
