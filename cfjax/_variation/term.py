"""`VariationTerm`: transition matrix, covariance, sensitivities and log-density beside a state."""

import math
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree, Real

from .._arguments import as_state, time_dtype, time_scalar
from .._arrays import describe
from .._control_term import LieControlTerm, is_driven
from .._field import Rest, combine, is_field, tangent
from .._fields.conjugation import Congruence
from .._fields.matrix import LeftMatrix
from .._numerics.checks import Fault, needing
from .._numerics.matmul import matmul
from .._term import checked, product
from .basis import Basis
from .blocks import Blocks, dependences
from .frame import Frame, MatrixPart, describe_class
from .variation import Variation


class VariationTerm(diffrax.AbstractTerm):
    """An equation with its transition matrix, covariance, sensitivities and log-density.

    It is a term around a term of time, such as a `cfjax.LieTerm`. Its state is a
    `cfjax.Variation`, which `start` makes, and what the start has is carried along:

    ```python
    def noise(t, q, args, dw):
        return cfjax.QuaternionRotation(0.02 * dw, frame="body", layout="wxyz")

    term = cfjax.VariationTerm(cfjax.LieTerm(field), noise=noise, channels=3)
    y0 = term.start(0.0, q0, args, transition=True, covariance=1e-4 * jnp.eye(3))
    sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, args, num_steps=100)
    sol.ys.state, sol.ys.transition, sol.ys.covariance
    ```

    It works with all solvers of cfjax that take fields which depend on the state, and if all parts
    of the state move by arrays, with those of diffrax too. The state moves exactly as without
    variations, and what is carried has the order of the method. *Covariance, Jacobians and
    densities* in the documentation has the equations, the coordinates of each class, and what all
    of it costs: a stage takes n Jacobian products of the field, m for a sensitivity alone.

    **Arguments:**

    - `term`: a term of time: `cfjax.LieTerm`, `diffrax.ODETerm` or a `diffrax.MultiTerm` of such.
    - `noise`: for the covariance, the function `noise(t, y, args, increment)` that a
      `cfjax.LieControlTerm` takes, linear in the increment. It returns fields of the classes and
      frames that the term's field has; None where a part gets no noise. The increment is white
      noise of unit strength: its variance is the time. Without it P is carried along only.
    - `channels`: the shape of the increment, or its length.
    - `parameters`: for sensitivities, a place in args with m numbers in all, as for
      `equinox.tree_at`: `lambda args: args["bias"]`, or a tuple of such places.
    - `basis`: for `LeftMatrix` and `RightMatrix` on matrices, shape `(d, n, n)`, linearly
      independent over the real numbers and closed under the commutator: `cfjax.algebra_basis` has
      some. It must span the matrices of the field.
    - `probes`: shape `(k, n)`. The trace of the log-density is the mean of `v^T D xi v` over these
      vectors v, Hutchinson's estimate, without bias if their entries are random signs.
    - `definite`: moves P by `cfjax.Congruence` and Phi by `cfjax.LeftMatrix`: P stays definite at
      any step with `CF3` and `CF4`, and both are exact where A is constant. A flow then costs
      exponentials of size n and 2 n.

    **Raises** `TypeError` or `ValueError` for arguments of other types or shapes, a basis that is
    not closed, noise without channels, a term that is driven by a path, complex coordinates, or
    noise of another frame than the term.

    Sources: for covariances of attitudes and poses, Barfoot, State Estimation for Robotics,
    Cambridge University Press 2017; for densities, Mathieu and Nickel, Riemannian Continuous
    Normalizing Flows, 2020.
    """

    term: diffrax.AbstractTerm
    noise: Callable[[Any, Any, Any, Any], PyTree] | None
    channels: tuple[int, ...] = eqx.field(static=True)
    parameters: Callable[[Any], Any] | None = eqx.field(static=True)
    basis: Basis | None = eqx.field(static=True)
    probes: Array | None
    definite: bool = eqx.field(static=True)

    def __init__(
        self,
        term: diffrax.AbstractTerm,
        *,
        noise: Callable[[Any, Any, Any, Any], PyTree] | None = None,
        channels: int | tuple[int, ...] = 0,
        parameters: Callable[[Any], Any] | None = None,
        basis: Any = None,
        probes: Any = None,
        definite: bool = False,
    ):
        if not isinstance(term, diffrax.AbstractTerm):
            raise TypeError(
                f"term must be a diffrax term, such as cfjax.LieTerm(field), got {term!r}."
            )
        if is_driven(term):
            raise TypeError(
                "term must be one of time, without a path: give the function of a "
                "cfjax.LieControlTerm as noise."
            )
        for name, fun, arguments in (
            ("noise", noise, "t, y, args and increment"),
            ("parameters", parameters, "args"),
        ):
            if fun is not None and not callable(fun):
                raise TypeError(f"{name} must be a function of {arguments}, got {fun!r}.")
        shape = channels if isinstance(channels, tuple) else (channels,)
        if not all(isinstance(k, int | np.integer) and not isinstance(k, bool) for k in shape):
            raise TypeError(f"channels must be an int or a shape of ints, got {channels!r}.")
        if noise is not None and (not shape or min(shape) < 1):
            raise ValueError(
                "noise needs channels, the shape of its increment, such as channels=3, got "
                f"{channels!r}."
            )
        if noise is None and channels != 0:
            raise ValueError(f"channels={channels!r} needs noise, got None.")
        if not isinstance(definite, bool):
            raise TypeError(f"definite must be a bool, got {definite!r}.")
        if probes is not None:
            probes = jnp.asarray(probes)
            if probes.ndim != 2 or not jnp.issubdtype(probes.dtype, jnp.floating):
                raise ValueError(
                    f"probes must be real and have shape (k, n), got {describe(probes)}."
                )
        self.term = term
        self.noise = noise
        self.channels = tuple(map(int, shape)) if noise is not None else ()
        self.parameters = parameters
        self.basis = basis if basis is None or isinstance(basis, Basis) else Basis(basis)
        self.probes = probes
        self.definite = definite

    def start(
        self,
        t0: Any,
        y0: PyTree,
        args: PyTree = None,
        *,
        transition: Any = None,
        covariance: Any = None,
        sensitivity: Any = None,
        log_density: Any = None,
    ) -> Variation:
        """The state to start from: `y0`, and what is given beside it.

        **Arguments:**

        - `t0`, `y0`, `args`: as for the solve.
        - `transition`: True for the identity, or an array of shape `(n, n)`.
        - `covariance`: the covariance of the start, shape `(n, n)`.
        - `sensitivity`: True for zero, if the start does not depend on the parameters, or an array
          of shape `(n, m)`.
        - `log_density`: the logarithm of the density of the start, a number.

        What is None is not carried.

        **Raises** `ValueError` or `TypeError` if nothing is given, for another shape, or for a
        sensitivity without `parameters`; `ValueError` for noise that the program shows not to be
        linear. A runtime error for a covariance that is not symmetric, or has a negative
        eigenvalue in units in which the variances are 1, by more than the root of a unit of
        rounding; for noise that is not linear; or for a matrix off the span of `basis`.
        """
        if isinstance(y0, Variation):
            raise TypeError("y0 must be the state alone, got a Variation: start from its .state.")
        y0 = as_state(y0)
        dtype = time_dtype(y0)
        here = _Evaluation(self, time_scalar("t0", t0, dtype), y0, args)
        n, m = here.frame.size, here.num_parameters

        def matrix(name: str, value: Any, default: Callable[[], Array], shape: Any) -> Any:
            if value is None or value is False:
                return None
            if value is True:
                return default()
            value = jnp.asarray(value)
            if value.shape != shape or not jnp.issubdtype(value.dtype, jnp.number):
                raise ValueError(f"{name} must have shape {shape}, got {describe(value)}.")
            if jnp.iscomplexobj(value):
                raise TypeError(f"{name} must be real, got {describe(value)}.")
            return value.astype(dtype)

        if sensitivity is not None and sensitivity is not False and self.parameters is None:
            raise ValueError("sensitivity needs parameters, a place in args, of the VariationTerm.")
        if covariance is True:
            raise TypeError(f"covariance must be that of the start, shape {(n, n)}, got True.")
        if log_density is True:
            raise TypeError("log_density must be that of the start, a number, got True.")
        start = Variation(
            y0,
            matrix("transition", transition, lambda: jnp.eye(n, dtype=dtype), (n, n)),
            matrix("covariance", covariance, lambda: jnp.zeros((n, n), dtype), (n, n)),
            matrix("sensitivity", sensitivity, lambda: jnp.zeros((n, m), dtype), (n, m)),
            matrix("log_density", log_density, lambda: jnp.zeros((), dtype), ()),
        )
        here.check(start)
        fault = here.fault(start)
        if start.covariance is not None:
            p = start.covariance
            symmetric = (p + p.T) / 2
            start = eqx.tree_at(lambda v: v._covariance, start, symmetric)
            fault = fault.with_case(
                _is_not_semidefinite(symmetric), "covariance must be positive semidefinite."
            )
            fault = fault.with_case(_is_not_symmetric(p), "covariance must be symmetric.")
        zero = fault.error(jnp.zeros((), dtype))
        start = eqx.tree_at(lambda v: v.state, start, needing(zero, y0))
        return start if self.definite else start.by_rows()

    def size(self, t: Any, y: PyTree, args: PyTree = None) -> int:
        """The number n of coordinates of a variation of the state y; only its shapes matter."""
        return _frame(self, t, y, args).size

    def slices(self, t: Any, y: PyTree, args: PyTree = None) -> PyTree:
        """Where each part of the state y is among the n coordinates: a slice for each part."""
        frame = _frame(self, t, y, args)
        return frame.treedef.unflatten(frame.slices)

    def vf(self, t: Any, y: Variation, args: PyTree) -> Variation:
        if not isinstance(y, Variation):
            raise TypeError(
                "The state of a cfjax.VariationTerm is a cfjax.Variation: start from "
                f"term.start(t0, y0, args, ...), got {describe(y)}."
            )
        here = _Evaluation(self, t, y.state, args)
        here.check(y)
        return here.rates(y).stored_like(y)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return t1 - t0

    def prod(self, vf: PyTree, control: Any) -> PyTree:
        return combine((control,), (vf,))

    def vf_prod(self, t: Any, y: PyTree, args: PyTree, control: Any) -> PyTree:
        return tangent(self.prod(self.vf(t, y, args), control), y)


def _frame(term: VariationTerm, t: Any, y: PyTree, args: PyTree) -> Frame:
    y = y.state if isinstance(y, Variation) else as_state(y)
    found: list[Frame] = []
    eqx.filter_eval_shape(lambda y: found.append(_Evaluation(term, t, y, args).frame), y)
    return found[0]


class _Evaluation:
    """The equations of variation at one time and state."""

    def __init__(self, term: VariationTerm, t: Any, y: PyTree, args: PyTree):
        self.term, self.t, self.y, self.args = term, t, y, args
        self.dtype = time_dtype(y)
        self.field = self.field_at(y, args)
        self.frame = Frame.of(self.field, y, term.basis)
        self.points = self.frame.treedef.flatten_up_to(y)
        self.framed = self.frame.framed(self.field, y)
        self.theta, self.unravel = _parameters(term, args, self.dtype)

    @property
    def num_parameters(self) -> int:
        return 0 if self.theta is None else self.theta.size

    def field_at(self, y: PyTree, args: PyTree) -> PyTree:
        term = self.term.term
        field = product(term, term.vf(self.t, y, args), term.contr(0.0, 1.0))
        return checked(field, y)

    def coordinates(self, points: list[PyTree], theta: Any = None) -> list[Array]:
        """The coordinates of the field, part by part, at a state given by its parts."""
        args = self.args
        if theta is not None:
            where: Any = self.term.parameters
            args = eqx.tree_at(where, args, self.unravel(theta))
        y = self.frame.treedef.unflatten(points)
        return self.frame.coordinates(self.frame.framed(self.field_at(y, args), y))

    def check(self, y: Variation) -> None:
        """Raises `TypeError` or `ValueError` unless what is carried has the shapes of the state."""
        n, m = self.frame.size, self.num_parameters
        shapes = {"transition": (n, n), "covariance": (n, n), "sensitivity": (n, m)}
        carried = {
            name: getattr(y, name)
            for name in (*shapes, "log_density")
            if getattr(y, name) is not None
        }
        if not carried:
            raise ValueError(
                "A Variation must carry something beside the state: transition, covariance, "
                "sensitivity or log_density. For the state alone integrate the term itself."
            )
        for name, x in carried.items():
            shape = shapes.get(name, ())
            if jnp.shape(x) != shape:
                raise ValueError(
                    f"{name} must have shape {shape}, as a variation of this state has {n} "
                    f"coordinates{f' and there are {m} parameters' if m else ''}, got "
                    f"{describe(x)}."
                )
        if self.term.probes is not None and self.term.probes.shape[1] != n:
            raise ValueError(
                f"probes must have shape (k, {n}), as a variation of this state has {n} "
                f"coordinates, got {self.term.probes.shape}."
            )

    def fault(self, y: Variation) -> Fault:
        """What is wrong with the noise, or a matrix in a basis."""
        fault = Fault.none()
        for part, framed in zip(self.frame.parts, self.framed, strict=True):
            if isinstance(part, MatrixPart):
                fault = fault.with_case(
                    part.is_outside(framed),
                    f"The matrix of {type(framed).__name__} at {part.place} must be in the span of "
                    "basis.",
                )
        if self.term.noise is not None and y.covariance is not None:
            term = LieControlTerm(self.term.noise, _NoPath())
            increment = jax.ShapeDtypeStruct(self.term.channels, self.dtype)
            try:
                fault = term.fault(fault, self.t, self.y, self.args, increment)
            except ValueError as error:
                raise ValueError(f"noise: {error}") from error
            # It must have the frame of the term.
            jax.eval_shape(self.of_noise)
        return fault

    def rates(self, y: Variation) -> Variation:
        y = Variation(y.state, y.transition, y.covariance, y.sensitivity, y.log_density)
        transition = covariance = sensitivity = log_density = a = None
        needs_matrix = y.transition is not None or y.covariance is not None
        if needs_matrix:
            of_coordinates = self.jacobian()
            a = self.with_bracket(of_coordinates)
            if y.log_density is not None and self.term.probes is None:
                log_density = -of_coordinates.trace(self.dtype)
        elif y.log_density is not None and self.term.probes is None:
            log_density = -self.jacobian(diagonal=True).trace(self.dtype)
        if y.log_density is not None and self.term.probes is not None:
            log_density = -self.estimated_trace(self.term.probes.astype(self.dtype))

        if y.sensitivity is not None:
            if a is None:
                sensitivity = self.along(y.sensitivity)
            else:
                sensitivity = a @ y.sensitivity + self.by_parameters()
        if a is not None and self.term.definite:
            dense = a.dense(self.dtype)
            if y.transition is not None:
                transition = LeftMatrix(dense)
            if y.covariance is not None:
                covariance = Congruence(dense, self.of_noise())
        elif a is not None:
            if y.transition is not None:
                transition = a @ y.transition
            if y.covariance is not None:
                product = a @ y.covariance
                covariance = product + product.T
                source = self.of_noise()
                covariance = covariance if source is None else covariance + source
        return Variation(self.field, transition, covariance, sensitivity, log_density)

    def jacobian(self, diagonal: bool = False) -> Blocks:
        """The matrix of `eta -> D xi[X_eta]`, for its diagonal blocks if these are enough."""
        frame, blocks = self.frame, {}
        needed = dependences(self.coordinates, self.points)
        for q, part in enumerate(frame.parts):
            rows = [p for p, inputs in enumerate(needed) if q in inputs]
            rows = [p for p in rows if p == q] if diagonal else rows
            if not rows or not part.size:
                continue

            def column(vector: Array, q=q, rows=rows) -> list[Array]:
                def coordinates(point: PyTree) -> list[Array]:
                    points = [*self.points[:q], point, *self.points[q + 1 :]]
                    values = self.coordinates(points)
                    return [values[p] for p in rows]

                point = self.points[q]
                direction = frame.velocity(q, vector, point)
                return jax.jvp(coordinates, (point,), (direction,))[1]

            columns = jax.vmap(column, out_axes=1)(jnp.eye(part.size, dtype=self.dtype))
            blocks.update({(p, q): block for p, block in zip(rows, columns, strict=True)})
        return Blocks(frame.slices, blocks)

    def with_bracket(self, jacobian: Blocks) -> Blocks:
        """The matrix A of `eta' = D xi[X_eta] + [xi, eta]`."""
        blocks = dict(jacobian.blocks)
        for p, part in enumerate(self.frame.parts):
            if part.is_element and part.size:
                adjoint = self.bracket(p, jnp.eye(part.size, dtype=self.dtype))
                blocks[p, p] = blocks[p, p] + adjoint if (p, p) in blocks else adjoint
        return Blocks(jacobian.slices, blocks)

    def bracket(self, p: int, x: Real[Array, "k m"]) -> Real[Array, "k m"]:
        """The brackets of the field with the columns of x, for one part of the state."""
        part = self.frame.parts[p]
        fun = lambda vector: part.bracket(self.framed[p], vector)  # noqa: E731
        return jax.vmap(fun, in_axes=1, out_axes=1)(x)

    def directions(self, vector: Real[Array, " n"]) -> list[PyTree]:
        return [
            self.frame.velocity(k, vector[s], point)
            for k, (s, point) in enumerate(zip(self.frame.slices, self.points, strict=True))
        ]

    def by_parameters(self) -> Real[Array, "n m"]:
        def column(vector: Array) -> Array:
            fun = lambda theta: self.coordinates(self.points, theta)  # noqa: E731
            return jnp.concatenate(jax.jvp(fun, (self.theta,), (vector,))[1])

        return jax.vmap(column, out_axes=1)(jnp.eye(self.num_parameters, dtype=self.dtype))

    def along(self, x: Real[Array, "n m"]) -> Real[Array, "n m"]:
        """The rate of a sensitivity x, without the matrix A."""

        def column(vector: Array, by_theta: Array) -> Array:
            directions = (self.directions(vector), by_theta)
            _, rate = jax.jvp(self.coordinates, (self.points, self.theta), directions)
            return jnp.concatenate(rate)

        eye = jnp.eye(self.num_parameters, dtype=self.dtype)
        rate = jax.vmap(column, in_axes=1, out_axes=1)(x, eye)
        brackets = [
            self.bracket(p, x[s]) if part.is_element else jnp.zeros_like(x[s])
            for p, (part, s) in enumerate(zip(self.frame.parts, self.frame.slices, strict=True))
        ]
        return rate + jnp.concatenate(brackets)

    def estimated_trace(self, probes: Real[Array, "k n"]) -> Real[Array, ""]:
        """The mean of `v^T D xi v` over the probes."""

        def of_one(vector: Array) -> Array:
            _, rate = jax.jvp(self.coordinates, (self.points,), (self.directions(vector),))
            return jnp.concatenate(rate) @ vector

        return jnp.mean(jax.vmap(of_one)(probes))

    def of_noise(self) -> Real[Array, "n n"] | None:
        """The covariance that the noise causes in unit time."""
        noise = self.term.noise
        if noise is None:
            return None

        def column(increment: Array) -> Array:
            field = checked(noise(self.t, self.y, self.args, increment), self.y)
            return jnp.concatenate(self.coordinates_of_noise(field))

        channels = self.term.channels
        k = math.prod(channels)
        increments = jnp.eye(k, dtype=self.dtype).reshape(k, *channels)
        g = jax.vmap(column, out_axes=1)(increments)
        return matmul(g, g.T)

    def coordinates_of_noise(self, field: PyTree) -> list[Array]:
        """The coordinates of a field, which must be those of the term's field."""
        frame = self.frame
        try:
            field = jtu.tree_map(
                lambda f, like: (
                    jtu.tree_map(lambda _: f, like, is_leaf=is_field) if isinstance(f, Rest) else f
                ),
                field,
                self.field,
                is_leaf=is_field,
            )
            fields = frame.treedef.flatten_up_to(field)
        except ValueError as error:
            raise TypeError(
                f"noise must return a field of the structure of the term's: {error}"
            ) from error
        values = []
        for part, f, point in zip(frame.parts, fields, self.points, strict=True):
            if isinstance(f, Rest):
                values.append(jnp.zeros(part.size, self.dtype))
                continue
            framed = frame.framed_part(f, point)
            if not _are_alike(framed, part.like):
                raise TypeError(
                    f"noise must return for {part.place} a field of the same frame as the term, "
                    f"{describe_class(part.field)} with coordinates {describe(part.like)}, got "
                    f"{describe_class(f)} with {describe(framed)}. Where the term has None, give "
                    "it the zero field."
                )
            values.append(part.coordinates(framed))
        return values


def _parameters(term: VariationTerm, args: PyTree, dtype: Any) -> tuple[Any, Any]:
    if term.parameters is None:
        return None, None
    nodes = term.parameters(args)
    try:
        # A Python number takes the precision of the state.
        arrays = jtu.tree_map(
            lambda x: jnp.asarray(x, dtype if isinstance(x, float) else None), nodes
        )
        eqx.tree_at(term.parameters, args, arrays)
    except (TypeError, ValueError) as error:
        raise TypeError(
            "parameters must be a place in args, as for equinox.tree_at, such as "
            f'lambda args: args["bias"], got a function that returns {describe(nodes)}: {error}'
        ) from error
    leaves = jtu.tree_leaves(arrays)
    if not leaves or not all(jnp.issubdtype(x.dtype, jnp.floating) for x in leaves):
        raise TypeError(
            "parameters must be a place in args with real floating numbers, got "
            f"{describe(arrays)}."
        )
    if any(x.dtype != dtype and not x.weak_type for x in leaves):
        raise TypeError(
            f"parameters must have the precision of the state, {dtype}, got {describe(arrays)}: "
            "convert what args has there with jnp.asarray(x, y0.dtype)."
        )
    return ravel_pytree(jtu.tree_map(lambda x: x.astype(dtype), arrays))


def _are_alike(a: PyTree, b: PyTree) -> bool:
    """Whether both have the same classes, shapes and dtypes, some of which may be weak."""
    return jtu.tree_structure(a) == jtu.tree_structure(b) and all(
        x.shape == y.shape and x.dtype == y.dtype
        for x, y in zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    )


class _NoPath(diffrax.AbstractPath):
    """The noise without a path: a term that is never solved."""

    t0: Any = 0.0
    t1: Any = 1.0

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        raise NotImplementedError


def _is_not_symmetric(p: Real[Array, "n n"]) -> Any:
    tolerance = np.sqrt(jnp.finfo(p.dtype).eps) * jnp.max(jnp.abs(p), initial=0)
    return jnp.max(jnp.abs(p - p.T), initial=0) > tolerance


def _is_not_semidefinite(p: Real[Array, "n n"]) -> Any:
    # In units in which the variances are one.
    scale = jnp.sqrt(jnp.abs(jnp.diagonal(p)))
    scale = jnp.where(scale > 0, scale, 1)
    smallest = jnp.min(jnp.linalg.eigvalsh(p / jnp.outer(scale, scale)), initial=0)
    return smallest < -np.sqrt(jnp.finfo(p.dtype).eps)
