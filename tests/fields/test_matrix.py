"""Matrix fields: flows, derivatives, the sign of the bracket, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from cfjax import LeftMatrix, LieEuler, LieTerm, RightMatrix, Rotation, integrate

BOTH = pytest.mark.parametrize("cls", [LeftMatrix, RightMatrix])


def random(shape, dtype: type = np.float64, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=shape)
    if np.issubdtype(dtype, np.complexfloating):
        x = x + 1j * rng.normal(size=shape)
    return x.astype(dtype)


def of_norm(a, norm):
    return (a / np.linalg.norm(a, 2) * norm).astype(a.dtype)


def skew(n, norm, seed=0):
    a = random((n, n), seed=seed)
    return of_norm(a - a.T, norm)


@jax.jit
def flow(field, point):
    return field.flow(point)


def act(cls, matrix, point):
    return matrix @ point if cls is LeftMatrix else point @ matrix


@pytest.mark.representatives(6)
@BOTH
@pytest.mark.parametrize("vector", [True, False])
@pytest.mark.parametrize(
    ("dtype", "point_dtype"),
    [
        (np.float32, np.float32),
        (np.float64, np.float64),
        (np.complex64, np.complex64),
        (np.complex128, np.complex128),
        (np.float32, np.complex64),
        (np.float64, np.complex128),
    ],
)
def test_flow_and_tangent(cls, vector, dtype, point_dtype):
    a = of_norm(random((4, 4), dtype), 2.0)
    shape = (4,) if vector else (4, 2) if cls is LeftMatrix else (2, 4)
    point = random(shape, point_dtype, seed=1)
    # scipy gets the same rounded entries in double precision.
    wide = np.promote_types(dtype, np.float64)
    want = act(cls, scipy.linalg.expm(a.astype(wide)), point)
    got = flow(cls(a), point)
    assert got.dtype == point_dtype
    assert got.shape == shape
    # The condition of exp at norm 2 is below e^4 = 55 relative to the result. A backward error of
    # one unit, and as much for the product.
    eps = np.finfo(dtype).eps
    scale = np.exp(2.0) * np.linalg.norm(point)
    np.testing.assert_allclose(got, want, rtol=0, atol=8 * eps * scale)
    tangent = cls(a).tangent(jnp.asarray(point))
    assert tangent.dtype == point_dtype
    np.testing.assert_allclose(tangent, act(cls, a, point), rtol=0, atol=8 * eps * scale)


@BOTH
def test_steps_add_what_the_flow_adds(cls):
    """A state is a compensated sum of what its flows add."""
    a, y0 = random((4, 4)), random((4, 4), seed=1)
    term = LieTerm(lambda t, y, args: cls(args))
    sol = integrate(term, LieEuler(), 0.0, 1.0, y0, a, num_steps=2)
    expected = act(cls, scipy.linalg.expm(a), y0)
    # Both round by some units of the exponential.
    np.testing.assert_allclose(sol.ys[0], expected, rtol=0, atol=1e-14 * np.abs(expected).max())


@BOTH
def test_tangent_is_the_velocity_of_the_flow(cls):
    a, x = random((3, 3)), random((3, 3), seed=1)
    velocity = jax.jvp(lambda t: cls(t * a).flow(jnp.asarray(x)), (0.0,), (1.0,))[1]
    # One product: a few units of rounding of entries below ten.
    np.testing.assert_allclose(velocity, act(cls, a, x), rtol=0, atol=1e-14)


@BOTH
def test_flow_from_the_identity_commutes_with_the_other_side(cls):
    # Left and right flows differ as soon as the point does not commute with a.
    a, x = random((3, 3)), random((3, 3), seed=1)
    e = scipy.linalg.expm(a)
    got = np.asarray(flow(cls(a), x))
    other = x @ e if cls is LeftMatrix else e @ x
    assert np.linalg.norm(got - other) > 0.1


@BOTH
def test_skew_is_orthogonal_and_inverse_is_exact(cls):
    for norm in (0.0, 1e-9, 1.0, 30.0):
        a = skew(4, norm or 1.0) * (norm > 0)
        q = np.asarray(flow(cls(a), np.eye(4)))
        # Normal matrices: each of at most five squarings of norm 1 doubles the error.
        atol = 2**6 * 4 * 2.0**-52
        np.testing.assert_allclose(q.T @ q, np.eye(4), rtol=0, atol=atol)
        np.testing.assert_allclose(flow(cls(-a), q), np.eye(4), rtol=0, atol=atol)


def test_skew_hermitian_is_unitary():
    a = random((3, 3), np.complex128)
    a = of_norm(a - a.conj().T, 3.0)
    q = np.asarray(flow(LeftMatrix(a), np.eye(3, dtype=complex)))
    np.testing.assert_allclose(q.conj().T @ q, np.eye(3), rtol=0, atol=1e-14)


@pytest.mark.representatives(1)
@BOTH
@pytest.mark.parametrize("norm", [0.0, 30.0])
def test_gradient(cls, norm):
    a = skew(3, norm or 1.0) * (norm > 0)
    direction, point, weight = (random((3, 3), seed=s) for s in (2, 3, 4))
    # A skew matrix keeps norms, so nothing grows: 30 units of rounding of the angle, doubled by
    # five squarings, and ten for norms and sums.
    atol = 1e-15 * (1 + norm) * 2**5 * 10
    want_flow, frechet = scipy.linalg.expm_frechet(a, direction)
    loss = jax.jit(jax.value_and_grad(lambda a: jnp.vdot(weight, cls(a).flow(jnp.asarray(point)))))
    value, gradient = loss(a)
    assert value == pytest.approx(np.vdot(weight, act(cls, want_flow, point)), abs=atol)
    want = np.vdot(weight, act(cls, frechet, point))
    assert np.vdot(gradient, direction) == pytest.approx(want, abs=atol)
    forward = jax.jit(lambda a, d: jax.jvp(lambda a: flow(cls(a), point), (a,), (d,))[1])
    np.testing.assert_allclose(forward(a, direction), act(cls, frechet, point), rtol=0, atol=atol)
    if norm == 0:
        # d/da of w . (exp(a) p) at zero is w p^T from the left and p^T w from the right.
        by_hand = weight @ point.T if cls is LeftMatrix else point.T @ weight
        np.testing.assert_allclose(gradient, by_hand, rtol=0, atol=1e-14)


@pytest.mark.representatives(1)
@BOTH
def test_second_derivative_at_zero(cls):
    # The term of second order of exp is d d / 2, so its second derivative along d is d d.
    d, point = random((3, 3), seed=2), random((3, 3), seed=3)
    along = lambda t: cls(t * d).flow(jnp.asarray(point))  # noqa: E731
    got = jax.jit(jax.jacfwd(jax.jacrev(along)))(0.0)
    np.testing.assert_allclose(got, act(cls, d @ d, point), rtol=0, atol=1e-13)


def elements(cls, seed):
    """Two elements, the coordinates they have, and a point."""
    if cls is Rotation:
        a, b = random((2, 3), seed=seed)
        return a, b, random((3,), seed=seed + 1)
    a, b = random((2, 3, 3), seed=seed)
    return a, b, random((3, 3), seed=seed + 1)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("cls", [Rotation, LeftMatrix, RightMatrix])
def test_bracket_by_composition_of_flows(cls):
    """Flow along a, then along b, is the flow along a + b - [a, b]/2 + ..

    From y = exp(u) p and u' = v - [u, v]/2 + [u, [u, v]]/12 with v = b and u(0) = a:
    u(1) = a + b - [a, b]/2 + ([a, [a, b]] - [b, [a, b]])/12 up to fourth order.
    """
    a, b, point = elements(cls, 5)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)

    def bracket(x, y):
        (coordinates,) = jax.tree.leaves(cls(x).bracket(cls(y)))
        return coordinates

    @jax.jit
    @jax.vmap
    def defects(h):
        x, y = h * a, h * b
        xy = bracket(x, y)
        both = cls(y).flow(cls(x).flow(jnp.asarray(point)))
        second = x + y - xy / 2
        third = second + (bracket(x, xy) - bracket(y, xy)) / 12
        ends = [cls(u).flow(jnp.asarray(point)) for u in (x + y, second, third)]
        return jnp.stack([jnp.linalg.norm(both - end) for end in ends])

    sizes = defects(np.array([0.04, 0.02]))
    slopes = np.log2(sizes[0] / sizes[1])
    # Orders 2, 3 and 4 exactly: a wrong sign or factor leaves order 2 or 3. The next term changes
    # a slope by about h, and the smallest defect (1e-9) is far above rounding (1e-16).
    np.testing.assert_allclose(slopes, [2, 3, 4], rtol=0, atol=0.1)
    assert sizes[1, 2] > 1e-12


@pytest.mark.parametrize("cls", [LeftMatrix, RightMatrix])
def test_bracket_identities(cls):
    a, b, c = (cls(m) for m in random((3, 3, 3)))
    x = jnp.asarray(random((3, 3), seed=1))
    commutator = (
        jax.jvp(a.tangent, (x,), (b.tangent(x),))[1] - jax.jvp(b.tangent, (x,), (a.tangent(x),))[1]
    )
    # Products of three matrices with entries of size 1: below 100 units of rounding.
    np.testing.assert_allclose(a.bracket(b).tangent(x), commutator, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(a.bracket(b).a, -b.bracket(a).a)
    jacobi = [p.bracket(q.bracket(r)).a for p, q, r in [(a, b, c), (b, c, a), (c, a, b)]]
    np.testing.assert_allclose(sum(jacobi), np.zeros((3, 3)), rtol=0, atol=1e-13)
    assert isinstance(a.bracket(b), cls)


@pytest.mark.representatives(1)
@BOTH
def test_vmap(cls):
    a, x = random((5, 3, 3)), random((5, 3), seed=1)
    got = jax.jit(jax.vmap(lambda a, x: cls(a).flow(x)))(a, x)
    want = [act(cls, scipy.linalg.expm(m), p) for m, p in zip(a, x, strict=True)]
    # Norms up to 4: exp(4) = 55, and the condition of exp at most as much again.
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


@BOTH
@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 2, 3)])
def test_not_square(cls, shape):
    with pytest.raises(ValueError, match=r"a must have shape \(n, n\) or \(\*batch, n, n\), got"):
        cls(jnp.ones(shape))


@BOTH
@pytest.mark.parametrize("dtype", [np.int32, np.float16, np.bool_])
def test_wrong_dtype(cls, dtype):
    with pytest.raises(TypeError, match="a must be float32, float64, complex64 or complex128, got"):
        cls(jnp.ones((2, 2), dtype))


@BOTH
@pytest.mark.parametrize("shape", [(), (2,), (2, 2), (3, 3, 3)])
def test_wrong_point(cls, shape):
    # The annotation's check in this test run, or the class itself, names the class or the shapes.
    with pytest.raises((TypeError, ValueError), match=cls.__name__):
        cls(np.eye(3)).tangent(jnp.ones(shape))


@pytest.mark.representatives(2)
@BOTH
@pytest.mark.parametrize("dtype", [np.complex64, np.float32])
def test_precisions_do_not_mix(cls, dtype):
    with pytest.raises((TypeError, ValueError), match="promotion"):
        cls(np.eye(3)).flow(jnp.ones(3, dtype))
