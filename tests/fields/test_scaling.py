"""Scaling: each entry to relative rounding, signs, shapes, methods of any order, and splittings."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax import lax

import cfjax
from cfjax import Scaling

EPS = 2.0**-52
# In units of the largest rate, whose exponential is far from the ends of the numbers: the parts of
# a complex one underflow earlier than its modulus.
FRACTIONS = np.array([0.0, 1e-30, 1e-9, 1e-3, 0.1, 0.7, 1.0])
RATES = np.concatenate([-FRACTIONS, FRACTIONS])
LARGEST = {"float32": 50.0, "float64": 600.0}


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def test_every_entry_is_relatively_accurate():
    dtypes = [(x, x) for x in ("float32", "float64", "complex64", "complex128")]
    dtypes.append(("float64", "complex128"))
    cases = []
    for dtype, point_dtype in dtypes:
        rate = (LARGEST[str(np.finfo(dtype).dtype)] * RATES).astype(dtype)
        if np.iscomplexobj(rate):
            rate += (1j * np.linspace(-30, 30, len(rate))).astype(dtype)
        # The entries have all sizes from 1e-3 to 1e3, and both signs.
        point = (10.0 ** np.linspace(-3, 3, len(rate)) * (-1) ** np.arange(len(rate))).astype(dtype)
        if point_dtype.startswith("complex"):
            point = (point * np.exp(1j * np.arange(len(rate)))).astype(point_dtype)
        cases.append((rate, point))
    motions = jax.jit(lambda xs: [(Scaling(r).flow(x), Scaling(r).tangent(x)) for r, x in xs])
    for (rate, point), found in zip(cases, motions(cases), strict=True):
        assert [x.dtype for x in found] == [point.dtype] * 2
        flow, tangent = (np.asarray(x, np.clongdouble) for x in found)
        eps, x = np.finfo(rate.dtype).eps, point.astype(np.clongdouble)
        exact = np.exp(rate.astype(np.clongdouble)) * x
        # The exponential is off by up to two units, and a complex one in each part; then a product.
        assert np.all(np.abs(flow - exact) <= 5 * eps * np.abs(exact))
        assert np.all(np.abs(tangent - rate * x) <= 3 * eps * np.abs(rate * x))


def test_signs_zeros_and_moduli():
    rate = np.array([-1e6, -800.0, -1.0, 0.0, 1.0, 700.0])
    points = np.outer([0.3, -0.3, 0.0, -0.0], np.ones(6))
    turns = 1j * np.linspace(-1e3, 1e3, 101)
    flows, phases = jax.jit(
        lambda x, z: (Scaling(rate[None]).flow(x), jnp.abs(Scaling(turns).flow(z)))
    )(points, np.full(101, 0.6 + 0.8j))
    for point, end in zip(points, flows, strict=True):
        np.testing.assert_array_equal(np.signbit(end), np.signbit(point))
        np.testing.assert_array_equal(end[3], point[3])
        np.testing.assert_array_equal(end == 0, (point == 0) | (rate < -760))
    np.testing.assert_allclose(phases, 1, rtol=0, atol=4 * EPS)


def test_populations_stay_positive_however_long_the_step():
    """With rates of 5 and more in each step, where methods in plain space make them negative."""
    y0 = jnp.array([0.1, 3.0, 40.0])

    def smallest(field):
        term = cfjax.LieTerm(lambda t, y, args: field(5 * (1 - y) / (1 + jnp.abs(y)), y))
        sol = cfjax.integrate(term, cfjax.CF2(), 0.0, 10.0, y0, num_steps=5, save_every=1)
        return float(jnp.min(sol.ys))

    assert smallest(lambda rate, y: rate * y) < 0
    assert smallest(lambda rate, y: Scaling(rate)) > 0


def test_what_is_small_decays_as_accurately_as_what_is_large():
    """A compensated sum would lose it: the entries are 1 and 1e-20 of what a step takes away."""
    term = cfjax.LieTerm(lambda t, y, args: Scaling(jnp.full(3, -7.0)))
    y0 = jnp.array([1.0, 1e-20, -1e-200])
    y1 = cfjax.integrate(term, cfjax.CF2(), 0.0, 30.0, y0, num_steps=60).ys[-1]
    # Two flows in each of 60 steps, each with three units and with a rate of up to 3.5.
    np.testing.assert_allclose(y1, y0 * np.exp(-210.0), rtol=2 * 60 * 6 * EPS)


def test_derivatives_of_what_decays():
    """To relative rounding: by time, twice, along a rate and a point that move; and pulled back."""
    p, q, w = (jnp.asarray(normal(k, 4) + 1j * normal(9 + k, 4)) for k in range(3))
    rate = -300.0 + normal(5, 4) + 1j * normal(6, 4)

    @jax.jit
    def everything():
        at = lambda t: Scaling(rate + t * w).flow(p + t * q)  # noqa: E731
        first = lambda t: jax.jvp(at, (t,), (jnp.ones_like(t),))[1]  # noqa: E731
        zero = jnp.zeros((), complex)
        pulled = jax.vjp(lambda rate, x: Scaling(rate).flow(x), rate, p)[1](w)
        return *jax.jvp(first, (zero,), (zero + 1,)), *pulled

    factor = np.exp(rate)
    wants = w * p + q, w * w * p + 2 * w * q, p * w, w
    for found, want in zip(everything(), wants, strict=True):
        # Some ten roundings of numbers of up to 3, and of the rate's own in NumPy's factor.
        np.testing.assert_allclose(found, factor * want, rtol=40 * EPS)


def test_rates_are_broadcast():
    shapes = [(), (4,), (1, 4), (3, 1), (2, 1, 1)]
    x = jnp.asarray(normal(2, 2, 3, 4))

    def motions(fields):
        return [(field.flow(x), field.tangent(x)) for field in fields]

    fields = [Scaling(normal(1, *shape)) for shape in shapes]
    full = [Scaling(np.broadcast_to(field.rate, x.shape)) for field in fields]
    found, wants = jax.jit(lambda *args: tuple(map(motions, args)))(fields, full)
    jax.tree.map(np.testing.assert_array_equal, found, wants)
    for shape, field in zip(shapes, fields, strict=True):
        # An exponential of a rate is computed once.
        jaxpr = str(jax.make_jaxpr(field.flow)(x))
        assert f"f64[{','.join(map(str, shape))}] = exp" in jaxpr


def test_the_algebra_commutes():
    a, b = Scaling(normal(1, 4)), Scaling(normal(2, 4))
    np.testing.assert_array_equal(a.bracket(b).rate, np.zeros(4))
    assert a.dexpinv(b, 5) is b
    assert a.increment(jnp.asarray(normal(3, 4))) is None


def test_a_munthe_kaas_method_acts_on_logarithms():
    """It is the method of its tableau for them, exactly."""
    solver = cfjax.RKMK(diffrax.Bosh3.tableau)

    def rate(t, y):
        return jnp.stack([1 - y[1] + jnp.sin(t), y[0] - 1])

    amounts = cfjax.LieTerm(lambda t, y, args: Scaling(rate(t, y)))
    logarithms = cfjax.LieTerm(lambda t, z, args: rate(t, jnp.exp(z)))
    y0 = jnp.array([0.4, 1.2])
    y1 = cfjax.integrate(amounts, solver, 0.0, 5.0, y0, num_steps=8).ys[-1]
    z1 = cfjax.integrate(logarithms, solver, 0.0, 5.0, jnp.log(y0), num_steps=8).ys[-1]
    # 3 stages of 8 steps, each with some units, and a flow of the equation that enlarges them.
    np.testing.assert_allclose(y1, np.exp(z1), rtol=250 * EPS)


def test_refuses(no_shape_hook, subtests):
    def solve(rate):
        term = cfjax.LieTerm(lambda t, y, args: Scaling(rate))
        cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, np.ones(3), num_steps=1)

    one = Scaling(np.ones(3))
    dtypes = "rate must be one of float32, float64, complex64, complex128, got"
    for call, error, text in [
        (lambda: Scaling(np.arange(3)), TypeError, f"{dtypes} int64"),
        (lambda: Scaling(np.ones(3, np.float16)), TypeError, f"{dtypes} float16"),
        (
            lambda: Scaling(np.ones(4)).flow(jnp.ones((4, 3))),
            ValueError,
            r"Scaling with rate of shape \(4,\) acts on the shapes that rate broadcasts to, got "
            r"\(4, 3\)\. For rates along the first axes give rate the shape \(4, 1\)\.",
        ),
        (
            lambda: Scaling(np.ones((1, 3))).tangent(jnp.ones(3)),
            ValueError,
            r"Scaling with rate of shape \(1, 3\) acts on .* broadcasts to, got \(3,\)\.$",
        ),
        (
            # The result would have the shape of the rate.
            lambda: one.flow(jnp.ones(1)),
            ValueError,
            r"Scaling with rate of shape \(3,\) acts on .* broadcasts to, got \(1,\)\.$",
        ),
        (
            lambda: one.flow(jnp.ones(3, jnp.float32)),
            TypeError,
            "rate must have the precision of the point, float32, got float64",
        ),
        (
            lambda: one.bracket(cfjax.LeftMatrix(np.eye(3))),
            TypeError,
            "Cannot compute the bracket of Scaling and LeftMatrix: both must be of one class",
        ),
        (lambda: solve(1j * np.ones(3)), ValueError, "make y0 complex"),
        (
            lambda: solve(np.ones(3, np.float32)),
            TypeError,
            "does not act there: rate must have the precision of the",
        ),
    ]:
        with subtests.test(case=text), pytest.raises(error, match=text):
            call()


# The nonlinear Schroedinger equation i psi_t = -psi_xx / 2 - |psi|^2 psi, on a period so long that
# the soliton and its images differ by 2 / cosh(32) = 5e-14 at most; what a grid of step 1/6 leaves
# out of its spectrum is 1 / cosh(pi (6 pi - 1) / 2) = 1e-12 of its largest entry.
N, PERIOD, SPEED = 384, 64.0, 1.0
X = PERIOD * (np.arange(N) / N - 0.5)
KINETIC = -0.5j * (2 * np.pi * np.fft.fftfreq(N, PERIOD / N)) ** 2
FOURIER = cfjax.FourierTransform()


def soliton(t):
    phase = SPEED * X + (1 - SPEED**2) * t / 2
    return np.exp(1j * phase) / np.cosh(X - SPEED * t)


TERMS = diffrax.MultiTerm(
    cfjax.LieTerm(lambda t, psi, args: Scaling(1j * (jnp.abs(psi) ** 2).astype(psi.dtype))),
    cfjax.LieTerm(lambda t, psi, args: cfjax.Affine(jnp.zeros_like(psi), KINETIC, FOURIER)),
)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(("solver", "order"), [(cfjax.Strang(), 2), (cfjax.BlanesMoan4(), 4)])
def test_the_order_of_a_splitting_for_a_soliton(solver, order):
    y0 = jnp.asarray(soliton(0.0))

    @jax.jit
    def end(num_steps):
        h = 2.0 / num_steps

        def step(n, carry):
            y, state = carry
            y, *_, state, _ = solver.step(TERMS, n * h, (n + 1) * h, y, None, state, False)
            return y, state

        start = y0, solver.init(TERMS, 0.0, h, y0, None)
        return lax.fori_loop(0, num_steps, step, start)[0]

    steps = [20, 40, 80]
    ends = [end(n) for n in steps]
    errors = np.array([np.abs(end - soliton(2.0)).max() for end in ends])
    assert order - 0.1 < problems.slope(steps, errors) < order + 0.1
    # The norm, with some units of rounding for each of 80 or 480 transforms and phases.
    norms = [np.linalg.norm(y) for y in (ends[-1], y0)]
    assert norms[0] == pytest.approx(norms[1], rel=480 * 10 * EPS)
    if order == 4:
        # Its own is 3e-9 / 8^4 = 7e-13; the grid's is as large, and so is the rounding of 640 * 13
        # transforms of some units each.
        np.testing.assert_allclose(end(640), soliton(2.0), rtol=0, atol=5e-12)
