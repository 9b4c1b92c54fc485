/* One step of Williamson3 of the Wilson flow on SU(3) links, written by hand: the yardstick of
   unitary.py. A lattice of SIDE^4 points; the SIDE points along the last axis are one vector. */
#include <string.h>

typedef double v __attribute__((vector_size(8 * SIDE)));
typedef long vi __attribute__((vector_size(8 * SIDE)));
typedef struct {
  v re[9], im[9];
} matrix;

#define LINES (SIDE * SIDE * SIDE)
#define EACH(I, J) \
  for (int I = 0; I < 3; I++) \
    for (int J = 0; J < 3; J++)

/* z = x y, x y^H and x^H y. */
#define PRODUCT(NAME, XRE, XIM, YRE, YIM)                               \
  static inline void NAME(const matrix *x, const matrix *y, matrix *z) { \
    EACH(i, j) {                                                        \
      v re = {0}, im = {0};                                             \
      for (int k = 0; k < 3; k++) {                                     \
        v a = XRE, b = XIM, c = YRE, d = YIM;                           \
        re += a * c - b * d;                                            \
        im += a * d + b * c;                                            \
      }                                                                 \
      z->re[3 * i + j] = re;                                            \
      z->im[3 * i + j] = im;                                            \
    }                                                                   \
  }
PRODUCT(times, x->re[3 * i + k], x->im[3 * i + k], y->re[3 * k + j], y->im[3 * k + j])
PRODUCT(times_dagger, x->re[3 * i + k], x->im[3 * i + k], y->re[3 * j + k], -y->im[3 * j + k])
PRODUCT(dagger_times, x->re[3 * k + i], -x->im[3 * k + i], y->re[3 * k + j], y->im[3 * k + j])

static inline void add(matrix *z, const matrix *x) {
  for (int n = 0; n < 9; n++) z->re[n] += x->re[n], z->im[n] += x->im[n];
}

/* The matrices of the neighbours of a line. */
static inline void neighbour(const matrix *u, int line, int axis, int sign, matrix *out) {
  if (axis == 3) {
    vi places;
    for (int n = 0; n < SIDE; n++) places[n] = (n + sign + SIDE) % SIDE;
    for (int n = 0; n < 9; n++) {
      out->re[n] = __builtin_shuffle(u[line].re[n], places);
      out->im[n] = __builtin_shuffle(u[line].im[n], places);
    }
    return;
  }
  int stride = axis == 0 ? SIDE * SIDE : axis == 1 ? SIDE : 1, place = line / stride % SIDE;
  *out = u[line + ((place + sign + SIDE) % SIDE - place) * stride];
}

static void generator(const matrix *u, matrix *z) {
  /* below: what closes a link on the side of the smaller coordinate, at the corner it is made. */
  static matrix below[4][4][LINES], up[4][LINES];
  memset(up, 0, sizeof(up));
  for (int mu = 0; mu < 4; mu++)
    for (int nu = mu + 1; nu < 4; nu++)
      for (int n = 0; n < LINES; n++) {
        matrix across, above, first, second, t;
        neighbour(u + nu * LINES, n, mu, 1, &across);
        neighbour(u + mu * LINES, n, nu, 1, &above);
        times(&u[mu * LINES + n], &across, &first);
        times(&u[nu * LINES + n], &above, &second);
        times_dagger(&across, &second, &t);
        add(&up[mu][n], &t);
        times_dagger(&above, &first, &t);
        add(&up[nu][n], &t);
        dagger_times(&first, &u[nu * LINES + n], &below[mu][nu][n]);
        dagger_times(&second, &u[mu * LINES + n], &below[nu][mu][n]);
      }
  for (int mu = 0; mu < 4; mu++)
    for (int n = 0; n < LINES; n++) {
      matrix t, loop, *out = &z[mu * LINES + n];
      for (int nu = 0; nu < 4; nu++)
        if (nu != mu) {
          neighbour(below[mu][nu], n, nu, -1, &t);
          add(&up[mu][n], &t);
        }
      times(&u[mu * LINES + n], &up[mu][n], &loop);
      EACH(i, j) {
        out->re[3 * i + j] = 0.5 * (loop.re[3 * j + i] - loop.re[3 * i + j]);
        out->im[3 * i + j] = -0.5 * (loop.im[3 * j + i] + loop.im[3 * i + j]);
      }
      v trace = (out->im[0] + out->im[4] + out->im[8]) / 3;
      for (int i = 0; i < 9; i += 4) out->im[i] -= trace;
    }
}

/* u = exp(h z) u for z in su(3), by Cayley and Hamilton: z^3 = t z + i d, with t and d real. */
static inline void move(const matrix *z, double h, matrix *u) {
  matrix a, a2, e;
  for (int n = 0; n < 9; n++) a.re[n] = h * z->re[n], a.im[n] = h * z->im[n];
  times(&a, &a, &a2);
  v t = 0.5 * (a2.re[0] + a2.re[4] + a2.re[8]), d = {0};
  EACH(i, j) d += a2.re[3 * i + j] * a.im[3 * j + i] + a2.im[3 * i + j] * a.re[3 * j + i];
  d /= 3;
  /* The coefficients of I, a and a^2, in 17 terms: as those of a step are at most 1. */
  v zero = {0}, p[2] = {zero, zero}, q[2] = {zero, zero}, r[2] = {zero, zero};
  double factorial[18] = {1};
  for (int k = 1; k < 18; k++) factorial[k] = factorial[k - 1] * k;
  for (int k = 17; k >= 0; k--) {
    v next[2] = {1 / factorial[k] - d * r[1], d * r[0]};
    v middle[2] = {p[0] + t * r[0], p[1] + t * r[1]};
    for (int c = 0; c < 2; c++) r[c] = q[c], q[c] = middle[c], p[c] = next[c];
  }
  for (int n = 0; n < 9; n++) {
    e.re[n] = q[0] * a.re[n] - q[1] * a.im[n] + r[0] * a2.re[n] - r[1] * a2.im[n];
    e.im[n] = q[0] * a.im[n] + q[1] * a.re[n] + r[0] * a2.im[n] + r[1] * a2.re[n];
  }
  for (int n = 0; n < 9; n += 4) e.re[n] += p[0], e.im[n] += p[1];
  matrix y = *u;
  times(&e, &y, u);
}

/* links: (4, SIDE, SIDE, SIDE, SIDE, 3, 3) complex. */
void williamson3(double *links, double h, long steps) {
  static matrix u[4 * LINES], z[4 * LINES], k[4 * LINES];
  static const double as[3] = {0, -5. / 9, -153. / 128}, bs[3] = {1. / 3, 15. / 16, 8. / 15};
  for (int n = 0; n < 4 * LINES; n++)
    for (int s = 0; s < SIDE; s++)
      for (int c = 0; c < 9; c++) {
        u[n].re[c][s] = links[18 * (SIDE * n + s) + 2 * c];
        u[n].im[c][s] = links[18 * (SIDE * n + s) + 2 * c + 1];
      }
  memset(k, 0, sizeof(k));
  for (long m = 0; m < steps; m++)
    for (int stage = 0; stage < 3; stage++) {
      generator(u, z);
      for (int n = 0; n < 4 * LINES; n++) {
        for (int c = 0; c < 9; c++) {
          k[n].re[c] = as[stage] * k[n].re[c] + h * z[n].re[c];
          k[n].im[c] = as[stage] * k[n].im[c] + h * z[n].im[c];
        }
        move(&k[n], bs[stage], &u[n]);
      }
    }
  for (int n = 0; n < 4 * LINES; n++)
    for (int s = 0; s < SIDE; s++)
      for (int c = 0; c < 9; c++) {
        links[18 * (SIDE * n + s) + 2 * c] = u[n].re[c][s];
        links[18 * (SIDE * n + s) + 2 * c + 1] = u[n].im[c][s];
      }
}
