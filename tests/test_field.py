"""Frozen fields on pytrees, and classes a user writes."""

import itertools
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg

import cfjax
from cfjax import AbstractAlgebraElement, AbstractFrozenField, LeftMatrix, Rotation

EPS = 2.0**-52
W = np.array([0.3, -0.7, 1.1])
V = np.array([1.0, 0.5, -2.0])


def hat(w):
    return jnp.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


class Screw(AbstractAlgebraElement):
    """A rigid motion of an attitude and a position together: SE(3) from the left."""

    omega: jax.Array
    velocity: jax.Array
    acts_on_subtree: ClassVar[bool] = True

    def flow(self, point):
        top = jnp.concatenate([hat(self.omega), self.velocity[:, None]], axis=1)
        # Of norms below 6: the series of a 64th leaves 0.1^13 / 13!.
        small, e = jnp.concatenate([top, jnp.zeros((1, 4))]) / 64, jnp.eye(4)
        for k in range(12, 0, -1):
            e = jnp.eye(4) + small @ e / k
        for _ in range(6):
            e = e @ e
        return dict(Q=e[:3, :3] @ point["Q"], x=e[:3, :3] @ point["x"] + e[:3, 3])

    def tangent(self, point):
        a = hat(self.omega)
        return dict(Q=a @ point["Q"], x=a @ point["x"] + self.velocity)

    def bracket(self, other):
        return Screw(
            jnp.cross(self.omega, other.omega),
            jnp.cross(self.omega, other.velocity) - jnp.cross(other.omega, self.velocity),
        )


class Phases(AbstractFrozenField):
    """Unit complex numbers that turn at one rate times a spectrum, which is structure."""

    rate: jax.Array
    spectrum: jax.Array

    def flow(self, point):
        return point * jnp.exp(self.exponent())

    def tangent(self, point):
        return point * self.exponent()

    def exponent(self):
        return 1j * (self.rate * self.spectrum).astype(complex)

    @classmethod
    def combine(cls, weights, fields):
        rates = [w * f.rate for w, f in zip(weights, fields, strict=True)]
        return cls(jnp.sum(jnp.stack(rates)), fields[0].spectrum)


@pytest.fixture
def mixed():
    """Fields and a point with every kind of part, nested."""
    spectrum = np.array([1.0, 4.0, 9.0])

    def field(s):
        return {
            "body": Screw(jnp.asarray(s * W), jnp.asarray(s * V)),
            "pair": (Rotation(s * V), jnp.asarray(s * W)),
            "phase": [Phases(jnp.asarray(s * 0.4), jnp.asarray(spectrum))],
        }

    point = {
        "body": dict(Q=jnp.eye(3), x=jnp.asarray(V)),
        "pair": (jnp.asarray(W), jnp.asarray(V)),
        "phase": [jnp.exp(1j * jnp.arange(3, dtype=complex))],
    }
    return field, point


def test_arrays_are_translations():
    point = {"a": jnp.arange(3.0), "b": (jnp.ones((2, 2)), jnp.asarray(1 + 2j))}
    field = jax.tree.map(lambda x: 2 * x + 1, point)
    for got, p, f in zip(
        *map(jax.tree.leaves, (cfjax.flow(field, point), point, field)), strict=True
    ):
        np.testing.assert_array_equal(got, p + f)
    jax.tree.map(np.testing.assert_array_equal, cfjax.tangent(field, point), field)
    zero = cfjax.bracket(field, point)
    jax.tree.map(lambda z, p: np.testing.assert_array_equal(z, 0 * p), zero, point)
    assert [z.dtype for z in jax.tree.leaves(zero)] == [p.dtype for p in jax.tree.leaves(point)]


def test_mixed_pytree_flows_part_by_part(mixed):
    field, point = mixed
    end = cfjax.flow(field(1.0), point)
    assert jax.tree.structure(end) == jax.tree.structure(point)
    e = scipy.linalg.expm(np.block([[hat(W), V[:, None]], [np.zeros((1, 4))]]))
    # Norms below 3 and exponentials of rotations: a few tens of units of rounding.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=100 * EPS)  # noqa: E731
    close(end["body"]["Q"], e[:3, :3])
    close(end["body"]["x"], e[:3, :3] @ V + e[:3, 3])
    close(end["pair"][0], scipy.linalg.expm(hat(V)) @ W)
    np.testing.assert_array_equal(end["pair"][1], V + W)
    close(end["phase"][0], np.exp(1j * (np.arange(3) + 0.4 * np.array([1, 4, 9]))))
    # The tangent is the velocity.
    want = jax.jvp(lambda t: cfjax.flow(field(t), point), (0.0,), (1.0,))[1]
    got = cfjax.tangent(field(1.0), point)
    assert jax.tree.structure(got) == jax.tree.structure(point)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=40 * EPS), got, want)


def test_none_is_a_part_at_rest():
    field, point = (
        {"a": None, "b": jnp.ones(2)},
        {"a": (jnp.ones(3), jnp.ones(())), "b": jnp.ones(2)},
    )
    moved, velocity = cfjax.flow(field, point), cfjax.tangent(field, point)
    np.testing.assert_array_equal(moved["b"], [2.0, 2.0])
    np.testing.assert_array_equal(moved["a"][0], np.ones(3))
    np.testing.assert_array_equal(velocity["a"][0], np.zeros(3))
    assert jax.tree.structure(velocity) == jax.tree.structure(point)


def test_combine_is_linear_and_carries_structure(mixed):
    field, _ = mixed
    fields = (field(1.0), field(-2.0), field(0.5))
    combine = lambda *weights: cfjax.combine(weights, fields)  # noqa: E731
    want = field(0.5 - 0.5 - 1.5)
    for got in (combine(0.5, 0.25, -3.0), jax.jit(combine)(0.5, 0.25, -3.0)):
        assert jax.tree.structure(got) == jax.tree.structure(want)
        # The spectrum stays as it is, all else is a sum of three exact products.
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=4 * EPS), got, want)
        np.testing.assert_array_equal(got["phase"][0].spectrum, [1, 4, 9])


def test_weights_take_the_precision_of_the_field():
    for dtype in (np.float32, np.float64, np.complex64, np.complex128):
        a = jnp.ones((3, 3), dtype)
        for weight in (0.5, jnp.asarray(0.5), np.float64(0.5)):
            for field in (a, LeftMatrix(a)):
                (leaf,) = jax.tree.leaves(cfjax.combine((weight, weight), (field, field)))
                assert leaf.dtype == dtype
                np.testing.assert_array_equal(leaf, a)
    got = cfjax.combine((2.0,), (Rotation(W),))
    assert isinstance(got, Rotation)
    np.testing.assert_array_equal(got.omega, 2 * W)
    # A translation may be an array of NumPy.
    got = cfjax.combine((0.5, 2.0), (np.ones(3), np.ones(3)))
    np.testing.assert_array_equal(got, 2.5 * np.ones(3))


def test_gradients_with_respect_to_weights_and_fields():
    # combine is bilinear, so the derivatives are the other factor.
    a, b = jnp.asarray(W), jnp.asarray(V)
    loss = lambda w, fs: jnp.vdot(V, cfjax.combine(w, fs)[0].omega)  # noqa: E731
    by_weights, by_fields = jax.grad(loss, argnums=(0, 1))(
        (2.0, -3.0), ((Rotation(a),), (Rotation(b),))
    )
    np.testing.assert_allclose(by_weights, [V @ W, V @ V], rtol=4 * EPS)
    np.testing.assert_allclose(by_fields[0][0].omega, 2 * V, rtol=4 * EPS)
    np.testing.assert_allclose(by_fields[1][0].omega, -3 * V, rtol=4 * EPS)


def test_bracket_of_mixed_pytrees():
    a = {"r": Rotation(W), "s": (Screw(*map(jnp.asarray, (W, V))), jnp.asarray(V))}
    b = {"r": Rotation(V), "s": (Screw(*map(jnp.asarray, (V, -W))), jnp.asarray(W))}
    got = cfjax.bracket(a, b)
    np.testing.assert_allclose(got["r"].omega, np.cross(W, V), rtol=0, atol=8 * EPS)
    np.testing.assert_array_equal(got["s"][1], np.zeros(3))
    lift = lambda w, v: np.block([[np.array(hat(w)), v[:, None]], [np.zeros((1, 4))]])  # noqa: E731
    x, y = lift(W, V), lift(V, -W)
    want = x @ y - y @ x
    np.testing.assert_allclose(
        lift(got["s"][0].omega, np.asarray(got["s"][0].velocity)), want, rtol=0, atol=20 * EPS
    )


def test_bracket_refuses_a_field_without_one():
    phase = Phases(jnp.asarray(1.0), jnp.ones(3))
    with pytest.raises(TypeError, match=r"Phases has none.*commutator-free.*CF4") as error:
        cfjax.bracket((Rotation(W), phase), (Rotation(W), phase))
    assert "Munthe-Kaas" in str(error.value)


def test_structures_that_do_not_match():
    with pytest.raises(ValueError):
        cfjax.flow({"a": Rotation(W)}, {"b": jnp.asarray(W)})
    with pytest.raises(TypeError, match="Only fields of one structure can be added"):
        cfjax.combine((1.0, 1.0), ((jnp.ones(2), jnp.ones(2)), (jnp.ones(2),)))


def test_fields_of_two_kinds_are_not_added():
    for other, is_translation in ((LeftMatrix(np.eye(3)), False), (np.ones(3), True)):
        pair = [{"a": Rotation(W)}, {"a": other}]
        for fields in (pair, pair[::-1]):
            with pytest.raises(TypeError, match=r"Only fields of one kind .* at \['a'\]") as caught:
                cfjax.combine((1.0, 1.0), fields)
            # The field of points that turn and move.
            advice = 'RigidMotion(omega=omega, v=v, frame="fixed")'
            assert (advice in str(caught.value)) == is_translation


def test_abstract_methods_are_required():
    with pytest.raises(TypeError, match="abstract"):
        AbstractFrozenField()  # pyright: ignore
    with pytest.raises(TypeError, match="abstract"):
        AbstractAlgebraElement()  # pyright: ignore


def test_a_class_of_the_user_under_every_solver_kind():
    """A constant field on SE(3): y(t) = exp(t xi) y0."""

    def field(t, y, args):
        return Screw(jnp.asarray(W), jnp.asarray(V))

    start = dict(Q=jnp.eye(3), x=jnp.asarray(V))
    e = scipy.linalg.expm(2 * np.block([[hat(W), V[:, None]], [np.zeros((1, 4))]]))
    for solver in (cfjax.CF2(), cfjax.RKMK3()):
        end = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 2.0, start, num_steps=2)
        # A constant field is solved exactly by every method here: rounding of two steps only.
        ys = jax.tree.map(lambda y: y[-1], end.ys)
        np.testing.assert_allclose(ys["Q"], e[:3, :3], rtol=0, atol=100 * EPS)
        np.testing.assert_allclose(ys["x"], e[:3, :3] @ V + e[:3, 3], rtol=0, atol=400 * EPS)


SPIN = np.array([[0.0, -0.3, 0.2], [0.3, 0.0, -0.7], [-0.2, 0.7, 0.0]])


def test_increment_has_the_rounding_of_the_increment():
    for make in (
        lambda a: cfjax.Rotation(jnp.array([a[2, 1], a[0, 2], a[1, 0]])),
        cfjax.LeftMatrix,
        cfjax.RightMatrix,
    ):

        @jax.jit
        def ends(a, make=make):
            return make(a).increment(jnp.eye(3)), cfjax.flow(make(a), jnp.eye(3))

        for size in (1e-7, 1.0, 30.0):
            a = size * SPIN
            moved, end = ends(jnp.asarray(a))
            with mpmath.workdps(40):
                exact = mpmath.expm(mpmath.matrix(a)) - mpmath.eye(3)
                exact = np.array(exact.tolist(), float)
            # Eight units times the largest entry; an angle beyond one multiplies its own rounding.
            atol = 8 * EPS * np.abs(exact).max() * max(1, size)
            np.testing.assert_allclose(moved, exact, rtol=0, atol=atol)
            np.testing.assert_allclose(end, exact + np.eye(3), rtol=0, atol=max(atol, 1e-15))


class Growth(AbstractFrozenField):
    rate: Any
    fault: str = eqx.field(static=True, default="none")

    def flow(self, point):
        moved = point * jnp.exp(self.rate)
        return {"none": moved, "shape": moved[:1], "dtype": moved.astype(jnp.float32)}[self.fault]

    def tangent(self, point):
        return point * self.rate


def test_integers_and_other_values_are_refused(subtests):
    message = r"Growth\.rate must be a floating or complex array"
    for rate in (np.array([1, -1]), np.array([True, False]), 1, 1.0, "text"):
        with subtests.test(rate=str(rate)), pytest.raises(TypeError, match=message):
            cfjax.combine([0.5, 0.5], [Growth(rate), Growth(rate)])
    for rate in ([1, -1], [True, False]):
        # In integers a weight of 1/2 is 0: the state would never move.
        term = cfjax.LieTerm(lambda t, y, args, rate=rate: Growth(jnp.asarray(rate)))
        with (
            subtests.test(solve_of=str(rate)),
            jax.numpy_dtype_promotion("standard"),
            pytest.raises(TypeError, match=message),
        ):
            cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, np.ones(2), num_steps=2)
    with pytest.raises(TypeError, match=r"translation must be a floating or complex array.*i64\[3"):
        cfjax.combine([0.5, 0.5], [jnp.arange(3), jnp.arange(3)])


def test_a_flow_of_another_shape_is_refused():
    for fault, size in itertools.product(("shape", "dtype"), (2, 12)):
        # Small states are held in components and large ones are not.
        term = cfjax.LieTerm(lambda t, y, args, fault=fault: Growth(-y, fault))
        for solve in (cfjax.integrate, diffrax.diffeqsolve):
            step = {"num_steps": 2} if solve is cfjax.integrate else {"dt0": 0.5}
            message = rf"Growth\.flow must return .*f64\[{size}\], got f"
            with pytest.raises(ValueError, match=message):
                solve(term, cfjax.CF4(), t0=0.0, t1=1.0, y0=jnp.ones(size), **step)


def test_brackets_of_two_classes_are_refused():
    fields = [Rotation(W), jnp.asarray(W), LeftMatrix(np.eye(3)), cfjax.RightMatrix(np.eye(3))]
    for a, b in itertools.permutations(fields, 2):
        with pytest.raises(TypeError, match=rf"bracket of .* and .*{type(b).__name__}\b"):
            cfjax.bracket(a, b)


def test_the_old_names_of_a_chart_work_and_are_deprecated():
    with pytest.warns(DeprecationWarning, match="to_chart") as caught:

        class Shifted(AbstractFrozenField):
            """A rate in coordinates that are one more than the state."""

            rate: Any

            def flow(self, point):
                return point * jnp.exp(self.rate)

            def tangent(self, point):
                return point * self.rate

            def enter(self, point, earlier):
                return _Inside(self.rate), point if earlier else point + 1

    assert [str(w.message).split(":")[0] for w in caught] == ["Shifted.enter is deprecated"]
    with pytest.warns(DeprecationWarning, match="from_chart"):

        class _Inside(AbstractFrozenField):
            rate: Any

            def flow(self, point):
                return 1 + (point - 1) * jnp.exp(self.rate)

            def tangent(self, point):
                return point * self.rate

            def leave(self, point):
                return point - 1

    term = cfjax.LieTerm(lambda t, y, args: Shifted(-t * jnp.ones(2)))
    y0 = jnp.array([1.0, 2.0])
    end = cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, y0, num_steps=4).ys[-1]
    # The midpoint rule is exact for a rate that is linear in t.
    np.testing.assert_allclose(end, y0 * np.exp(-0.5), rtol=16 * EPS)
