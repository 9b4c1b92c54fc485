"""`check_field`: every class of the package passes, and every planted mistake is named."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from problems import to_the_circle

import cfjax
from cfjax import AbstractAlgebraElement, AbstractFrozenField

RNG = np.random.default_rng(5)


def random(dtype: Any, *shape: int) -> jax.Array:
    x = RNG.standard_normal(shape)
    if np.issubdtype(dtype, np.complexfloating):
        x = x + 1j * RNG.standard_normal(shape)
    return jnp.asarray(x.astype(dtype))


def frame(dtype: Any, n: int, p: int) -> jax.Array:
    return jnp.asarray(np.linalg.qr(RNG.standard_normal((n, p)))[0].astype(dtype))


SPECTRUM = RNG.standard_normal(4)
F32, F64, C64 = np.float32, np.float64, np.complex64
# Of each way through the checks: leading columns, complex numbers, a mean, structure, a chart of
# its own, a defect, and an increment.
BUILT_IN: dict[str, tuple[Any, Any]] = {
    "Scaling": (lambda: cfjax.Scaling(random(C64, 3, 1)), random(C64, 3, 4)),
    "Rotation, float32": (lambda: cfjax.Rotation(random(F32, 3)), random(F32, 3, 2)),
    "LeftMatrix": (lambda: cfjax.LeftMatrix(random(C64, 2, 2)), random(C64, 2, 3)),
    "Congruence": (
        lambda: cfjax.Congruence(random(C64, 2, 2), random(C64, 2, 2)),
        random(C64, 2, 2),
    ),
    "LinearAffine": (lambda: cfjax.LinearAffine(random(F32, 4, 4), random(F32, 4)), random(F32, 4)),
    "Affine": (
        lambda: cfjax.Affine(random(F64, 4), SPECTRUM, cfjax.SineTransform(), alpha=random(F64)),
        random(F64, 4),
    ),
    "LowRankSkew": (lambda: cfjax.LowRankSkew(random(F64, 5, 2)), frame(F64, 5, 2)),
    "SphereRotation": (lambda: cfjax.SphereRotation(random(F64, 5)), frame(F64, 5, 1)[:, 0]),
    "QuaternionRotation": (
        lambda: cfjax.QuaternionRotation(random(F64, 3), frame="body", layout="wxyz"),
        jnp.asarray([0.5, -0.1, 0.7, 0.5]),
    ),
}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", BUILT_IN)
def test_every_class_of_the_package_passes(name):
    make, point = BUILT_IN[name]
    cfjax.check_field([make(), make()], point)


class Line(AbstractAlgebraElement):
    """Affine maps of a line, for each entry: the smallest algebra that does not commute."""

    a: jax.Array
    b: jax.Array

    def flow(self, point):
        # phi_1(a) is 1 at zero.
        safe = jnp.where(self.a == 0, 1, self.a)
        phi = jnp.where(self.a == 0, 1, jnp.expm1(safe) / safe)
        return jnp.exp(self.a) * point + phi * self.b

    def tangent(self, point):
        return self.a * point + self.b

    def bracket(self, other):
        return type(self)(0 * self.a, self.a * other.b - other.a * self.b)


def fields_of(cls):
    return [cls(random(F64, 2), random(F64, 2)) for _ in range(3)]


POINT = random(F64, 2)


def test_a_field_of_a_users_own():
    cfjax.check_field(fields_of(Line), POINT)


def test_mistakes_in_framed_are_named(subtests):
    for framed, text in [
        (lambda self, point: self, "must return elements that move the point freely"),
        (lambda self, point: 2 * self.tangent(point), "must have the velocity of the field"),
        (lambda self, point: self.tangent(point) ** 2, "must be linear in the field"),
        (lambda self, point: self.tangent(point)[0], "must return an algebra element, or"),
        (lambda self, point: Still(self.b), "must return an algebra element or the velocity"),
    ]:
        fields = fields_of(type("Framed", (Line,), {"framed": framed}))
        with subtests.test(text=text), pytest.raises(ValueError, match=f"Framed.framed {text}"):
            cfjax.check_field(fields, POINT)


def test_mistakes_in_projected_are_named(subtests):
    point = POINT / np.linalg.norm(POINT)
    fields = [problems.Circle(random(F64)), problems.Circle(random(F64))]
    cfjax.check_field(fields, point)
    for nearest, factor, text in [
        (to_the_circle, 2, "have the velocity of the field"),
        (lambda x: x * jnp.asarray([1.0, 2.0]), 1, "leave a velocity along the manifold as it is"),
        (lambda x: to_the_circle(x) + 1e-3, 1, "leave a point of the manifold where it is"),
        (lambda x: x, 1, "lead to points that have length 1"),
    ]:

        def projected(self, point, nearest=nearest, factor=factor):
            return cfjax.Nearest(factor * self.tangent(point), nearest)

        planted = type("Planted", (problems.Circle,), {"projected": projected})
        with subtests.test(text=text):
            with pytest.raises(ValueError, match=f"Planted.projected must {text}"):
                cfjax.check_field([planted(f.angle) for f in fields], point)


class Still(AbstractFrozenField):
    """A field without a bracket."""

    v: jax.Array

    def flow(self, point):
        return point + self.v

    def tangent(self, point):
        return self.v


def opposite_bracket(self, other):
    return type(self)(0 * self.a, other.a * self.b - self.a * other.b)


def double_bracket(self, other):
    return type(self)(0 * self.a, 2 * (self.a * other.b - other.a * self.b))


def doubled(cls, weights, fields):
    return cls(*(2 * sum(w * x for w, x in zip(weights, xs, strict=True)) for xs in ab(fields)))


def structured(cls, weights, fields):
    """As for a field whose a is structure, which it is not here."""
    _, bs = ab(fields)
    return cls(fields[0].a, sum(w * b for w, b in zip(weights, bs, strict=True)))


def ab(fields):
    return [f.a for f in fields], [f.b for f in fields]


def along_the_old_one(self, point):
    """A rotation by ten times the first entry of a, and what leads the length back."""
    (x, y), angle, off = point, 10 * self.a[0], (point @ point / (POINT @ POINT) - 1) / 2
    c, s = jnp.cos(angle) - 1, jnp.sin(angle)
    return jnp.stack([c * x - s * y, c * y + s * x]) + off * c * point


MISTAKES = {
    "opposite sign": (
        dict(bracket=opposite_bracket),
        r"bracket must .*, here \[a, b\], but it has the opposite sign\.",
    ),
    "twice": (dict(bracket=double_bracket), r"bracket must .* but it is 2 times what is expected"),
    "tangent of half": (
        dict(tangent=lambda self, point: (self.a * point + self.b) / 2),
        r"tangent must be the derivative of the flow .* but it is 0\.5 times what is expected",
    ),
    "Euler": (
        dict(flow=lambda self, point: point + self.a * point + self.b),
        r"flow of 0\.4 of a field after 0\.6 of it must be that of the whole field",
    ),
    "the middle of the flow": (
        dict(mean=lambda self, point: type(self)(self.a / 2, self.b / 2).flow(point)),
        r"mean must be the mean of the flow",
    ),
    "not at rest": (
        dict(flow=lambda self, point: Line.flow(self, point) + 1e-3),
        r"flow of the zero field must be the identity, but",
    ),
    "no derivative": (
        dict(flow=lambda self, point: point + jnp.sqrt(self.b * self.b)),
        r"what is expected is not finite\. .* cfjax\.stumpff",
    ),
    "increment": (
        dict(increment=lambda self, point: self.flow(point)),
        r"increment must be flow\(point\) - point",
    ),
    "sum of twice": (dict(combine=classmethod(doubled)), "tangent must be the derivative"),
    "structure that is a coordinate": (
        dict(combine=classmethod(structured)),
        "flow of the zero field must be the identity",
    ),
    "to_chart": (
        dict(to_chart=lambda self, point, earlier: (self, point + 0.01)),
        "to_chart and from_chart must lead back to the point",
    ),
    "defect": (
        dict(defect=classmethod(lambda cls, p: (abs(p @ p - POINT @ POINT), "the start's length"))),
        "flow must keep the start's length",
    ),
    "increment that multiplies what the length is off": (
        dict(
            # As a spin of half a turn does where it is led back along the old point.
            flow=lambda self, point: point + along_the_old_one(self, point),
            increment=along_the_old_one,
            tangent=lambda self, point: 10 * self.a[0] * jnp.stack([-point[1], point[0]]),
            defect=lambda self, point: (jnp.abs(point @ point - POINT @ POINT), "the length"),
        ),
        r"increment must keep the length over 100 flows, also of large fields, but it is off by",
    ),
    "shape": (
        dict(flow=lambda self, point: point[:1]),
        r"flow must return what is shaped like its point, f64\[2\], got f64\[1\]",
    ),
    "dtype of the tangent": (
        dict(tangent=lambda self, point: point.astype(jnp.float32)),
        r"Its tangent is f32\[2\]",
    ),
}


def test_a_planted_mistake_is_named(subtests):
    for mistake, (overrides, message) in MISTAKES.items():
        fields = fields_of(type("Planted", (Line,), overrides))
        with subtests.test(mistake=mistake), pytest.raises(ValueError, match=message):
            cfjax.check_field(fields, POINT)


# Mistakes that some fields show only.


class Turn(AbstractFrozenField):
    """The Lorentz group of a plane and time, by sines only: of boosts it is NaN."""

    w: jax.Array

    def flow(self, point):
        x = jnp.sqrt(self.w @ (jnp.array([1.0, -1.0, -1.0]) * self.w))
        return point + jnp.sin(x) / x * self.tangent(point)

    def tangent(self, point):
        return jnp.array([-1.0, 1.0, 1.0]) * jnp.cross(self.w, point)


def test_a_flow_that_is_nan_for_some_fields_is_named():
    for a, b, label in [
        ([0.3, 1.0, 0.2], [1.0, 0.2, -0.3], r"fields\[0\]"),
        ([1.0, 0.3, 0.2], [0.2, 1.0, -0.3], r"fields\[1\]"),
        ([1.0, 0.1, 0.2], [1.0, 0.5, -0.3], r"fields\[0\] - fields\[1\]"),
    ]:
        message = rf"Turn\.flow must be finite, but it is NaN for {label}\."
        with pytest.raises(ValueError, match=message):
            cfjax.check_field([Turn(jnp.asarray(a)), Turn(jnp.asarray(b))], TURNED)


TURNED = random(F64, 3)


class Growth(AbstractFrozenField):
    rate: jax.Array

    def flow(self, point):
        return point * jnp.exp(jnp.abs(self.rate))

    def tangent(self, point):
        return point * self.rate


class ShortGrowth(Growth):
    def flow(self, point):
        return point * jnp.exp(jnp.where(jnp.abs(self.rate) > 1, jnp.nan, self.rate))


def test_a_flow_that_is_wrong_for_some_signs_or_sizes_is_named():
    rates = jnp.array([[0.4, 0.1], [0.3, 0.2]])
    for cls, message in [
        (Growth, r"flow of -0\.4 of a field must lead back along that of the field, but"),
        (ShortGrowth, r"flow must be finite, but it is NaN for 4 fields\[0\]\."),
    ]:
        with pytest.raises(ValueError, match=message):
            cfjax.check_field([cls(rate) for rate in rates], POINT)


def test_a_stiff_field_may_overflow_backwards():
    spectrum, transform = -1e4 * np.arange(1.0, 3), cfjax.SineTransform()
    fields = [cfjax.Affine(random(F64, 2), spectrum, transform, alpha=a) for a in (0.7, 1.2)]
    assert np.isnan(jax.jit(cfjax.Affine.flow)(cfjax.combine((-1.0,), fields[:1]), POINT)).any()
    cfjax.check_field(fields, POINT)


# A class that acts on a subtree.


class Pair(AbstractFrozenField):
    acts_on_subtree = True
    rate: jax.Array

    def flow(self, point):
        return {"x": point["x"] + self.rate * point["y"], "y": point["y"]}

    def tangent(self, point):
        return {"x": self.rate * point["y"], "y": jnp.zeros_like(point["y"])}


PAIR = {"x": random(F64, 2), "y": random(F64, 2)}


def test_a_subtree():
    cfjax.check_field([Pair(random(F64)), Pair(random(F64))], PAIR)


def test_a_forgotten_acts_on_subtree_is_named():
    forgetful = type("Forgetful", (Pair,), {"acts_on_subtree": False})
    fields = [forgetful(random(F64)), forgetful(random(F64))]
    message = r"acts on one array.* write `acts_on_subtree = True` in the class"
    with pytest.raises(TypeError, match=message):
        cfjax.check_field(fields, PAIR)
    term = cfjax.LieTerm(lambda t, y, args: fields[0])
    with pytest.raises(TypeError, match=message):
        cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, PAIR, num_steps=1)


def test_an_annotated_acts_on_subtree_is_named():
    with pytest.raises(TypeError, match=r"Annotated\.acts_on_subtree .* `acts_on_subtree = True`"):

        class Annotated(Pair):
            acts_on_subtree: bool = True  # pyright: ignore[reportIncompatibleVariableOverride]


def test_wrong_arguments(no_shape_hook, subtests):
    line, columns = Line(POINT, POINT), np.ones((3, 1))
    for fields, point, error, message in [
        (line, POINT, TypeError, "fields must be a sequence of at least two"),
        ([line], POINT, TypeError, "fields must be a sequence of at least two"),
        ([POINT, POINT], POINT, TypeError, "fields must be frozen fields of one class, got Arr"),
        ([line, cfjax.Rotation(np.ones(3))], POINT, TypeError, "of one class, got Line, Rotation"),
        ([line] * 2, np.ones(2, int), TypeError, "point must be floating or comp"),
        (
            [cfjax.BorderedSkew(columns)] * 2,
            columns,
            ValueError,
            "point must have orthonormal columns .*, and is off by 2",
        ),
    ]:
        with subtests.test(message=message), pytest.raises(error, match=message):
            cfjax.check_field(fields, point)
    with pytest.raises(TypeError, match=r"must be a diffrax\.MultiTerm"):
        cfjax.check_terms(cfjax.LieTerm(drift), 0.0, BODY)


# Splittings.

BODY = {"q": jnp.asarray([0.3, -0.5, 0.8]), "p": jnp.asarray([0.7, 0.2, -0.4])}
INERTIA = jnp.asarray([1.0, 2.0, 3.0])


def kick(t, y, args):
    return {"q": None, "p": -args * jnp.sin(y["q"])}


def drift(t, y, args):
    return {"q": cfjax.Rotation(y["p"]), "p": None}


def tumble(axes):
    return lambda t, y, args: {"q": None, "p": cfjax.Rotation(-axes * y["p"] / INERTIA)}


def sum_of(*fields):
    return diffrax.MultiTerm(*map(cfjax.LieTerm, fields))


def test_terms_with_exact_flows_pass():
    about_one_axis = tumble(jnp.asarray([1.0, 0.0, 0.0]))
    noise = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))
    bath = cfjax.LieControlTerm(lambda t, y, args, dw: {"q": None, "p": dw}, noise)
    terms = sum_of(kick, drift, about_one_axis).terms
    cfjax.check_terms(diffrax.MultiTerm(*terms, bath), 0.0, BODY, 2.0)
    # A term that hardly moves the state: what is left is rounding.
    cfjax.check_terms(
        sum_of(kick, lambda t, y, args: {"q": None, "p": 1e-16 * y["q"]}), 0.0, BODY, 2.0
    )
    # Frozen in a chart of its own, and on leading axes.
    sphere = lambda t, y, args: cfjax.SphereRotation(0 * y)  # noqa: E731
    cfjax.check_terms(sum_of(sphere, sphere), 0.0, BODY["q"] / jnp.linalg.norm(BODY["q"]))


def test_terms_that_change_along_their_flow_are_named():
    for fields, place in [
        ((kick, tumble(jnp.ones(3))), 1),
        ((lambda t, y, args: {"q": None, "p": -y["p"]}, drift), 0),
        # Both parts at once.
        ((lambda t, y, args: {"q": y["p"], "p": -y["q"]}, kick), 0),
    ]:
        message = rf"terms\[{place}\] must not change along its own flow"
        with pytest.raises(ValueError, match=message):
            cfjax.check_terms(sum_of(*fields), 0.0, BODY, 2.0)


def test_a_small_array_that_changes_beside_a_large_one_that_moves():
    def far(t, y, args):
        return {"q": jnp.full(3, 1e9), "p": tumble(jnp.ones(3))(t, y, args)["p"]}

    with pytest.raises(ValueError, match=r"terms\[0\] must not change .* where it moves y\['p'\]"):
        cfjax.check_terms(sum_of(far, drift), 0.0, BODY, 2.0)
