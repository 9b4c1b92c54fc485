"""Frozen fields on pytrees, and classes a user writes."""

import itertools
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from problems import hat

import cfjax
from cfjax import AbstractAlgebraElement, AbstractFrozenField, LeftMatrix, Rotation

EPS = 2.0**-52
W = np.array([0.3, -0.7, 1.1])
V = np.array([1.0, 0.5, -2.0])


class Stretch(AbstractAlgebraElement):
    """Affine maps of positions together with their scale, which moves under them too."""

    rate: jax.Array
    velocity: jax.Array
    acts_on_subtree: ClassVar[bool] = True

    def flow(self, point):
        # phi_1(rate), which is 1 at zero.
        safe = jnp.where(self.rate == 0, 1, self.rate)
        phi = jnp.where(self.rate == 0, 1, jnp.expm1(safe) / safe)
        scale = jnp.exp(self.rate)
        return dict(scale=scale * point["scale"], x=scale * point["x"] + phi * self.velocity)

    def tangent(self, point):
        x = self.rate * point["x"] + self.velocity
        return dict(scale=self.rate * point["scale"], x=x)

    def bracket(self, other):
        velocity = self.rate * other.velocity - other.rate * self.velocity
        return Stretch(jnp.zeros_like(self.rate), velocity)


def stretched(rate, velocity, x):
    """The end of a flow from scale one, in NumPy."""
    return np.exp(rate), np.exp(rate) * x + np.expm1(rate) / rate * velocity


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
            "body": Stretch(jnp.asarray(s * 0.7), jnp.asarray(s * V)),
            "pair": (Rotation(s * V), jnp.asarray(s * W)),
            "phase": [Phases(jnp.asarray(s * 0.4), jnp.asarray(spectrum))],
        }

    point = {
        "body": dict(scale=jnp.asarray(1.0), x=jnp.asarray(W)),
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

    @jax.jit
    def motions(point):
        end, want = jax.jvp(lambda t: cfjax.flow(field(t), point), (1.0,), (1.0,))
        start = jax.jvp(lambda t: cfjax.flow(field(t), point), (0.0,), (1.0,))[1]
        return end, want, start, cfjax.tangent(field(1.0), end), cfjax.tangent(field(1.0), point)

    end, *rates = motions(point)
    assert all(jax.tree.structure(x) == jax.tree.structure(point) for x in (end, *rates))
    # Norms below 3 and exponentials of rotations: a few tens of units of rounding.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=100 * EPS)  # noqa: E731
    scale, x = stretched(0.7, V, W)
    close(end["body"]["scale"], scale)
    close(end["body"]["x"], x)
    close(end["pair"][0], scipy.linalg.expm(hat(V)) @ W)
    np.testing.assert_array_equal(end["pair"][1], V + W)
    close(end["phase"][0], np.exp(1j * (np.arange(3) + 0.4 * np.array([1, 4, 9]))))
    # The tangent is the velocity, at the end and at the start.
    for want, got in zip(rates[:2], rates[2:], strict=True):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=40 * EPS), got, want
        )


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
            fields = {"translation": a, "matrix": LeftMatrix(a)}
            for leaf in jax.tree.leaves(cfjax.combine((weight, weight), (fields, fields))):
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
    a = {"r": Rotation(W), "s": (Stretch(jnp.asarray(0.7), jnp.asarray(V)), jnp.asarray(V))}
    b = {"r": Rotation(V), "s": (Stretch(jnp.asarray(-0.4), jnp.asarray(W)), jnp.asarray(W))}
    got = cfjax.bracket(a, b)
    np.testing.assert_allclose(got["r"].omega, np.cross(W, V), rtol=0, atol=8 * EPS)
    np.testing.assert_array_equal(got["s"][1], np.zeros(3))
    lift = lambda s, v: np.block([[s * np.eye(3), v[:, None]], [np.zeros((1, 4))]])  # noqa: E731
    x, y = lift(0.7, V), lift(-0.4, W)
    found = got["s"][0]
    want = x @ y - y @ x
    np.testing.assert_allclose(
        lift(found.rate, np.asarray(found.velocity)), want, rtol=0, atol=20 * EPS
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
    """A constant field, y(t) = exp(t xi) y0, is solved exactly by every method here."""

    def field(t, y, args):
        return Stretch(jnp.asarray(0.7), jnp.asarray(V))

    start = dict(scale=jnp.asarray(1.0), x=jnp.asarray(W))
    scale, x = stretched(1.4, 2 * V, W)
    for solver in (cfjax.CF2(), cfjax.RKMK3()):
        ys = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 2.0, start, num_steps=2).ys
        # Rounding of two steps only.
        np.testing.assert_allclose(ys["scale"][-1], scale, rtol=0, atol=100 * EPS)
        np.testing.assert_allclose(ys["x"][-1], x, rtol=0, atol=400 * EPS)


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
    steps = {cfjax.integrate: {"num_steps": 2}, diffrax.diffeqsolve: {"dt0": 0.5}}
    # Small states are held in components and large ones are not. Any two of fault, size and solve.
    for fault, size, solve in [
        ("shape", 2, cfjax.integrate),
        ("dtype", 12, cfjax.integrate),
        ("shape", 12, diffrax.diffeqsolve),
        ("dtype", 2, diffrax.diffeqsolve),
    ]:
        term = cfjax.LieTerm(lambda t, y, args, fault=fault: Growth(-y, fault))
        message = rf"Growth\.flow must return .*f64\[{size}\], got f"
        with pytest.raises(ValueError, match=message):
            solve(term, cfjax.CF2(), t0=0.0, t1=1.0, y0=jnp.ones(size), **steps[solve])


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
