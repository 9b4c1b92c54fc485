"""`LieTerm`: what it refuses, what it costs, and how diffrax uses it."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import assert_close, first_step

import cfjax
from cfjax import CF4, LeftMatrix, LieTerm, Rotation

INERTIA = np.array([1.0, 2.0, 3.0])
Y0 = np.array([0.6, -0.7, 0.4])


def rigid_body(t, y, args):
    del t
    return Rotation(-y / args)


def vf(value, y):
    """What the term makes of a field that returns `value` at the state y."""
    return LieTerm(lambda t, y, args: value).vf(0.0, y, None)


class Doubling(cfjax.AbstractFrozenField):
    """A field whose tangent can be made wrong in shape, dtype or by an error of its own."""

    rate: jax.Array
    fault: str = "none"

    def flow(self, point):
        return jnp.exp(self.rate) * point

    def tangent(self, point):
        if self.fault == "shape":
            return self.rate * point[:1]
        if self.fault == "dtype":
            return (self.rate * point).astype(jnp.float32)
        if self.fault == "structure":
            return (point, point)
        if self.fault == "branch" and point[0] > 0:
            return point
        return self.rate * point


V3 = jnp.ones(3)
F32 = jnp.ones(3, jnp.float32)
PAIR = {"q": V3, "p": (V3, V3)}


WRONG: list[tuple[Any, Any, str]] = [
    # Structure.
    ({"q": V3}, PAIR, "prefix"),
    ({"q": V3, "r": (V3, V3)}, PAIR, "prefix"),
    ({"q": V3, "p": [V3, V3]}, PAIR, "prefix"),
    ({"q": V3, "p": (V3, V3, V3)}, PAIR, "prefix"),
    (None, V3, "got None"),
    ([1.0, 2.0, 3.0], V3, "prefix"),
    # Translations.
    ({"q": V3, "p": (V3, V3[:2])}, PAIR, r"y\['p'\]\[1\]"),
    ({"q": V3[:, None], "p": (V3, V3)}, PAIR, r"y\['q'\]"),
    ({"q": V3.astype(jnp.float32), "p": (V3, V3)}, PAIR, r"y\['q'\]"),
    (V3, PAIR, "for y,"),
    ({"q": V3, "p": V3}, PAIR, r"y\['p'\]"),
    (V3, F32, "for y,"),
    (V3.astype(complex), V3, "for y,"),
    (jnp.zeros(()), V3, "for y,"),
    (1.0, V3, "for y,"),
    ("text", V3, "for y,"),
    (jnp.array([True, False, True]), V3, "for y,"),
    # Python and numpy scalars that are not of the state's kind.
    (1j, jnp.asarray(1.0), "for y,"),
    (True, jnp.asarray(1.0), "for y,"),
    (np.float64(1.0), jnp.asarray(1.0, jnp.float32), "for y,"),
    # States that do not move.
    (jnp.arange(3), jnp.arange(3), "for y,"),
    (1.0, jnp.arange(3), "for y,"),
    (Rotation(V3), jnp.arange(3), "for y[.,]"),
    # Fields.
    (Rotation(V3), jnp.ones(4), "for y,"),
    (
        {"q": Rotation(V3), "p": (V3, Rotation(V3))},
        {"q": V3, "p": (V3, jnp.ones((2, 3)))},
        r"y\['p'\]\[1\]",
    ),
    ({"q": Rotation(V3), "p": Rotation(V3)}, PAIR, r"y\['p'\]"),
    (Rotation(V3), PAIR, "for y[.,]"),
    (Rotation(V3), F32, "for y[.,]"),
    (Rotation(V3), V3.astype(complex), "for y,"),
    (LeftMatrix(jnp.eye(4)), V3, "for y,"),
    (LeftMatrix(jnp.eye(3, dtype=complex)), V3, "for y[.,]"),
    (Doubling(jnp.asarray(1.0), "shape"), V3, "for y[.,]"),
    (Doubling(jnp.asarray(1.0), "dtype"), V3, "for y[.,]"),
    (Doubling(jnp.asarray(1.0), "structure"), V3, "for y[.,]"),
    # A tangent that branches on a value cannot be traced. Its error needs more than a text.
    (Doubling(jnp.asarray(1.0), "branch"), V3, "for y[.,]"),
]
LOWER_PRECISION: list[tuple[Any, Any, str]] = [
    (
        Rotation(F32),
        V3,
        r"Rotation for y, .*f64\[3\]\. Its \.omega is f32\[3\].*asarray\(x, y.dtype",
    ),
    (LeftMatrix(jnp.eye(3, dtype=jnp.float32)), V3, "LeftMatrix for y, "),
    (LeftMatrix(jnp.eye(3, dtype=jnp.complex64)), V3.astype(complex), "LeftMatrix for y, "),
    (Doubling(F32), V3, "Doubling for y, "),
    ({"q": V3, "p": (V3, Rotation(F32))}, PAIR, r"Rotation for y\['p'\]\[1\]"),
]


def test_wrong_values_are_refused_with_their_place(no_shape_hook, subtests):
    # Users have JAX's standard promotion, under which a tangent hides a field's precision: the
    # rounding of a field of lower precision would become the state's drift.
    for promotion, cases, error in [
        ("strict", WRONG, (TypeError, ValueError)),
        ("standard", WRONG, (TypeError, ValueError)),
        ("standard", LOWER_PRECISION, TypeError),
    ]:
        for k, (value, y, text) in enumerate(cases):
            with (
                subtests.test(promotion=promotion, case=str(k), text=text),
                jax.numpy_dtype_promotion(promotion),
                pytest.raises(error, match=text),
            ):
                vf(value, y)


def test_a_complex_field_on_a_real_state_says_what_to_do(no_shape_hook):
    for value in (V3.astype(complex), LeftMatrix(jnp.eye(3, dtype=complex))):
        with pytest.raises(ValueError, match="make y0 complex"):
            vf(value, V3)


def test_the_field_must_be_a_function(no_shape_hook):
    with pytest.raises(TypeError, match="field must be a function of t, y and args, got None"):
        LieTerm(None)  # pyright: ignore[reportArgumentType]


def test_numbers_and_numpy_arrays_are_translations():
    for dtype in (np.float32, np.float64, np.complex64):
        for value in (1, 2.5, *([1j] if dtype is np.complex64 else [])):
            got = vf(value, jnp.asarray(1.0, dtype))
            assert got.dtype == dtype
            assert got == value
    # A constant field is naturally written with numpy.
    got = vf(np.array([1.0, 2.0, 3.0]), V3)
    assert isinstance(got, jax.Array)
    np.testing.assert_array_equal(got, [1.0, 2.0, 3.0])


def test_the_checks_leave_nothing_in_the_program():
    tree = {"a": (jnp.ones((2, 2)), jnp.ones((2, 2))), "b": jnp.asarray(1.0)}
    for field, y in [
        (rigid_body, jnp.asarray(Y0)),
        (lambda t, y, args: {"a": (LeftMatrix(y["a"][1]), y["a"][1]), "b": 2 * y["b"]}, tree),
    ]:
        args = jnp.asarray(INERTIA)
        # A cached jit inside the tangent must not matter either: the texts are compared whole.
        with_checks = jax.make_jaxpr(lambda y, f=field, a=args: LieTerm(f).vf(0.0, y, a))(y)
        without = jax.make_jaxpr(lambda y, f=field, a=args: f(0.0, y, a))(y)
        assert str(with_checks) == str(without)


def test_prod_is_linear_in_the_control_and_keeps_float32():
    term = LieTerm(rigid_body)
    y = jnp.asarray(Y0, jnp.float32)
    args = jnp.asarray(INERTIA, jnp.float32)
    value = term.vf(0.0, y, args)
    for control in (0.25, jnp.asarray(0.25), jnp.asarray(0.25, jnp.float32)):
        got = term.prod(value, control)
        assert got.omega.dtype == jnp.float32
        np.testing.assert_array_equal(got.omega, 0.25 * value.omega)
        velocity = term.vf_prod(0.0, y, args, control)
        # omega x y in float32, a product and a difference: a few units of rounding.
        want = 0.25 * np.cross(-Y0 / INERTIA, Y0)
        np.testing.assert_allclose(velocity, want, rtol=0, atol=4e-7)
    assert term.contr(1.0, 0.25) == -0.75


def solve(term, solver, dt0, y0: Any = Y0, args: Any = INERTIA, **kwargs):
    y0, args = jax.tree.map(jnp.asarray, (y0, args))
    ys = diffrax.diffeqsolve(term, solver, 0.0, 1.0, dt0, y0, args, max_steps=256, **kwargs).ys
    return jax.tree.map(lambda y: y[-1], ys)


def steps(pairs, y0: Any = Y0):
    """The ends of steps of length one, by solvers with terms, in one program."""

    @jax.jit
    def ends(t0, t1, y0, args):
        return [first_step(solver, term, t0, t1, y0, args)[0] for solver, term in pairs]

    y0, args = jax.tree.map(jnp.asarray, (y0, INERTIA))
    return ends(jnp.asarray(0.0), jnp.asarray(1.0), y0, args)


def test_vf_prod_is_the_ambient_tangent():
    """Solvers that ask for nothing else make steps in the linear space: the midpoint rule."""
    (got,) = steps([(diffrax.Midpoint(), LieTerm(rigid_body))])
    middle = Y0 + np.cross(-Y0 / INERTIA, Y0) / 2
    np.testing.assert_allclose(got, Y0 + np.cross(-middle / INERTIA, middle), rtol=0, atol=1e-15)


def test_solvers_of_linear_spaces_refuse_a_rotation():
    for name in ("Bosh3", "ReversibleHeun"):
        with pytest.raises(TypeError, match="Rotation is a frozen vector field and not an array"):
            solve(LieTerm(rigid_body), getattr(diffrax, name)(), 0.1)


def test_translations_are_an_ordinary_equation():
    def ordinary(t, y, args):
        return {"a": jnp.cross(-y["a"] / args, y["a"]), "b": -t * y["b"]}

    solvers = diffrax.Tsit5(), diffrax.Euler(), diffrax.ReversibleHeun()
    terms = LieTerm(ordinary), diffrax.ODETerm(ordinary)
    y0 = {"a": Y0, "b": np.asarray(2.0)}
    ends = steps([(solver, term) for solver in solvers for term in terms], y0)
    for got, want in zip(ends[::2], ends[1::2], strict=True):
        # The same operations, up to the order in which XLA fuses them.
        assert_close(got, want, 1e-14)


def test_multi_term_is_the_sum():
    drift = lambda t, y, args: Rotation(jnp.stack([t + 1, y[0], y[1] * y[2]]))  # noqa: E731
    total = lambda t, y, args: Rotation(rigid_body(t, y, args).omega + drift(t, y, args).omega)  # noqa: E731
    terms = diffrax.MultiTerm(LieTerm(rigid_body), LieTerm(drift))
    got, want, less = steps(
        [(cfjax.LieEuler(), x) for x in (terms, LieTerm(total), LieTerm(rigid_body))]
    )
    # Sums in another order: a few units of rounding.
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-14)
    assert np.linalg.norm(got - less) > 0.01


def test_multi_term_adds_fields_and_not_their_arrays():
    """Two Affine fields share their spectrum, which is no coordinate."""
    spectrum, b, y0 = -np.array([0.5, 1.0, 2.0]), np.array([0.3, -0.2, 0.1]), np.ones(3)
    terms = diffrax.MultiTerm(
        *(
            LieTerm(lambda t, y, args, w=w: cfjax.Affine(w * b, spectrum, alpha=w))
            for w in (0.25, 0.75)
        )
    )
    found = cfjax.integrate(terms, cfjax.CF2(), 0.0, 2.0, jnp.asarray(y0), num_steps=3).ys[-1]
    # The sum is y' = M y + b, whose flow is exact in every step.
    exact = np.exp(2 * spectrum) * y0 + np.expm1(2 * spectrum) / spectrum * b
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-14)


def test_terms_that_do_not_fit_a_solver_are_refused():
    # A translation of shape () would broadcast, and one of shape (3, 3) is what ODETerm lets pass.
    for value, y in ((jnp.ones(()), V3), (V3, jnp.eye(3))):
        for solver in (CF4(), cfjax.RKMK4()):
            with pytest.raises(ValueError, match="translation"):
                solve(LieTerm(lambda t, y, args, value=value: value), solver, 0.5, y)
    turn = LieTerm(rigid_body)
    for other in (lambda t, y, args: LeftMatrix(jnp.eye(3)), lambda t, y, args: y):
        with pytest.raises(TypeError, match="Only fields of one kind can be added, got Rotation"):
            solve(diffrax.MultiTerm(turn, LieTerm(other)), CF4(), 0.25)

    class Wrapped(diffrax.AbstractTerm):
        term: diffrax.AbstractTerm

        def vf(self, t, y, args):
            return self.term.vf(t, y, args)

        def contr(self, t0, t1, **kwargs):
            return self.term.contr(t0, t1, **kwargs)

        def prod(self, vf, control):
            return self.term.prod(vf, control)

    wrapped = Wrapped(diffrax.MultiTerm(turn, turn))
    with pytest.raises(TypeError, match="must not be wrapped in another term, got Wrapped"):
        cfjax.integrate(wrapped, CF4(), 0.0, 1.0, Y0, jnp.asarray(INERTIA), num_steps=2)
    term = diffrax.ControlTerm(lambda t, y, args: Rotation(y), lambda t0, t1: t1 - t0)
    with pytest.raises(TypeError, match=r"cannot multiply a frozen field by its control, f64\[\]"):
        cfjax.integrate(term, CF4(), 0.0, 1.0, Y0, num_steps=2)
    with pytest.raises(TypeError, match="cannot multiply a frozen field by its control"):
        solve(term, CF4(), 0.25)
