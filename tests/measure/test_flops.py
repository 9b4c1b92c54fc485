import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import mlir

import cfjax
from cfjax._measure.flops import count_flops

X = jnp.ones(10)
SCALAR = jnp.ones(())


def matrix(*shape):
    return jax.ShapeDtypeStruct(shape, float)


def z(*shape):
    return jax.ShapeDtypeStruct(shape, complex)


def horner(x):
    return ((2.0 * x + 3.0) * x + 5.0) * x + 7.0


def steps(x):
    return lax.scan(lambda y, _: (2.0 * y + 1.0, None), x, length=5)[0]


def either(x):
    return lax.cond(x[0] > 0, jnp.sin, lambda x: x * x + 1.0, x)


def branches_in_a_loop(x):
    """Adds 1 three times and then, the sum being 4, doubles and adds 1 twice."""

    def step(y, _):
        return lax.cond(y < 4.0, lambda y: y + 1.0, lambda y: 2.0 * y + 1.0, y), None

    return lax.scan(step, x, length=5)[0]


@jax.custom_jvp
def own_derivative(x):
    return x * 3.0


own_derivative.defjvp(lambda primals, tangents: (own_derivative(*primals), tangents[0] * 3.0))


def test_flops_of_known_programs(subtests):
    for number, (fun, arguments, flops) in enumerate(
        [
            (jnp.matmul, (matrix(3, 4), matrix(4, 5)), 2 * 3 * 4 * 5),
            (jnp.matmul, (matrix(6, 3, 4), matrix(6, 4, 5)), 6 * 2 * 3 * 4 * 5),
            (jnp.dot, (X, X), 20),
            (jnp.cross, (matrix(3), matrix(3)), 9),
            (horner, (X,), 60),
            (steps, (SCALAR,), 10),
            (lambda x: lax.fori_loop(0, 4, lambda i, y: jnp.sin(y) / 2.0, x), (X,), 80),
            (either, (matrix(10),), 20),
            (either, (X,), 10),
            (either, (-X,), 20),
            (lambda x: lax.cond(False, jnp.sin, lambda x: x * x + 1.0, x), (matrix(10),), 20),
            (branches_in_a_loop, (SCALAR,), 3 + 2 * 2),
            (branches_in_a_loop, (matrix(),), 5 * 2),
            (jnp.sum, (X,), 9),
            (jnp.prod, (matrix(4, 5),), 19),
            (lambda x: jnp.sum(x, axis=0), (matrix(4, 5),), 15),
            (jnp.cumsum, (X,), 9),
            (lambda x: x**5, (X,), 30),
            (lambda x: x**8, (SCALAR,), 3),
            (lambda x: x**-2, (SCALAR,), 2),
            (lambda x: jnp.sqrt(x) + jnp.exp(x), (X,), 30),
            (own_derivative, (X,), 10),
            (jax.grad(lambda x: own_derivative(x)), (SCALAR,), 1),
            (jax.checkpoint(horner), (X,), 60),
            (jax.jit(horner), (X,), 60),
            (lambda x: horner(x)[0], (X,), 60),
            (lambda x: x.at[jnp.arange(3)].add(2.0), (X,), 3),
            (lambda x: x.at[jnp.arange(3)].apply(horner), (X,), 18),
            (lambda x: x.at[jnp.arange(3)].set(2.0), (X,), 0),
            (lambda x: x.at[jnp.arange(3)].max(2.0), (X,), 0),
            # Fourier transforms.
            (jnp.fft.fft, (z(16),), 5 * 16 * 4),
            (jnp.fft.fft, (z(3, 8),), 3 * 5 * 8 * 3),
            (jnp.fft.fft2, (z(4, 8),), 5 * 32 * 5),
            (jnp.fft.rfft, (matrix(16),), 5 * 16 * 4 // 2),
            (jnp.fft.irfft, (z(9),), 5 * 16 * 4 // 2),
            # Products of complex matrices.
            (jnp.matmul, (z(3, 4), z(4, 5)), 4 * 2 * 3 * 4 * 5),
            (jnp.linalg.solve, (z(5, 5), z(5, 2)), 4 * gauss(5, 2)),
        ]
    ):
        with subtests.test(number=str(number)):
            assert count_flops(fun, *arguments) == flops


def test_complex_numbers(subtests):
    for number, (fun, flops) in enumerate(
        [
            (lambda x, y: x + y, 2),
            (lambda x, y: x - y, 2),
            (lambda x, y: x * y, 6),
            (lambda x, y: x / y, 11),
            (lambda x, y: abs(x), 4),
            (lambda x, y: -x.conj().real, 0),
            (lambda x, y: x**3, 12),
            (lambda x, y: x.at[:].add(y), 2),
        ]
    ):
        with subtests.test(number=str(number)):
            assert count_flops(fun, z(10), z(10)) == 10 * flops


def test_moves_signs_comparisons_and_integers_are_free():
    def fun(x):
        y = jnp.where(x > 0, -x, jnp.maximum(x, 2.0))
        y = jnp.concatenate([y[3:], jnp.round(abs(y[:3]))]).reshape(5, 2).T
        return y, jnp.max(y), y.astype(jnp.float32), jnp.arange(5.0)

    def rarer(x):
        first, *others = jnp.unstack(x.reshape(5, 2))
        return jnp.sort(x), jnp.argmax(x), jnp.tile(first, 3), lax.stop_gradient(others)

    assert count_flops(fun, X) == 0
    assert count_flops(rarer, X) == 0
    # And integers.
    assert count_flops(lambda n: n * n + 1, jnp.arange(3)) == 0
    assert count_flops(lambda n: lax.while_loop(lambda n: n < 9, lambda n: n + 1, n), 3) == 0


# Operations whose names are not known


def unnamed(fun, name="new_name"):
    """`fun` of one array as an operation of JAX."""
    new_p = Primitive(name)
    new_p.def_abstract_eval(lambda x: x)
    mlir.register_lowering(new_p, mlir.lower_fun(fun, multiple_results=False))
    return new_p.bind


def swaps(x):
    """Moves entries by indices that are computed, and compares."""
    index = (3 * jnp.arange(x.size) + 1) % x.size
    return jnp.where(x > 0, x[index], -jnp.sort(x))


def test_an_operation_that_moves_entries_is_free_whatever_its_name():
    assert count_flops(unnamed(swaps), X) == 0
    # One that is not floating-point by its operands.
    assert count_flops(unnamed(lambda n: n * n + 1), jnp.arange(3)) == 0


def test_one_that_computes_is_refused_whatever_its_operands(subtests):
    for fun, argument, operation in (
        (lambda x: 2.0 * x, X, "stablehlo.multiply"),
        (lambda x: jnp.flip(x) + jnp.sum(x), X, "stablehlo.add"),
        (jax.jit(jnp.sin), X, "stablehlo.sine"),
        (lambda n: jnp.sqrt(n.astype(float)).astype(int), jnp.arange(3), "stablehlo.sqrt"),
        (lambda x: jnp.linalg.eigh(x)[1], jnp.eye(3), "stablehlo.custom_call"),
    ):
        message = rf"no rule for new_name, which consists of .*{operation}[\s\S]*Use operations"
        with (
            subtests.test(operation=operation),
            pytest.raises(NotImplementedError, match=message),
        ):
            count_flops(unnamed(fun), argument)


def test_one_that_cannot_be_lowered_is_refused():
    new_p = Primitive("not_lowered")
    new_p.def_abstract_eval(lambda x: x)
    with pytest.raises(NotImplementedError, match=r"no rule for not_lowered, in .*Use operations"):
        count_flops(new_p.bind, X)


def test_what_is_not_needed_is_not_counted():
    def fun(x):
        unused = jnp.sin(x) * 3.0
        return x + 1.0, jax.jit(lambda a, b: (a, b * 2.0))(x, unused)[0]

    assert count_flops(fun, X) == 10


def test_what_is_computed_twice_counts_once():
    def twice(x, y):
        return jax.jit(horner)(x) + jax.jit(horner)(x), horner(x) * 2.0, horner(y)

    assert count_flops(twice, X, X) == 60 + 10 + 10 + 60


# Solves and factorisations, against the operations written out


def gauss(n, right):
    """Elimination and two substitutions: divisions, multiplications and additions."""
    flops = 0
    for k in range(n):
        flops += (n - k - 1) * (1 + 2 * (n - k - 1))
    for k in range(n):
        # Forward with ones on the diagonal, backward with a division.
        flops += right * (2 * k + 2 * k + 1)
    return flops


def cholesky(n):
    flops = 0
    for k in range(n):
        flops += 1 + (n - k - 1)
        flops += sum(2 for i in range(k + 1, n) for j in range(k + 1, i + 1))
    return flops


def householder(m, n):
    """The leading terms: each reflection of length l on c columns costs 4 l c."""
    return sum(4 * (m - k) * (n - k) for k in range(min(m, n)))


def test_solves_and_factorisations():
    for n, right in [(1, 1), (3, 2), (8, 4), (20, 1)]:
        flops = count_flops(jnp.linalg.solve, matrix(n, n), matrix(n, right))
        assert flops == gauss(n, right)
        batch = count_flops(jnp.linalg.solve, matrix(5, n, n), matrix(5, n, right))
        assert batch == 5 * flops
    for m, n in [(3, 3), (5, 2), (2, 5)]:
        flops = sum((m - k - 1) * (1 + 2 * (n - k - 1)) for k in range(min(m, n)))
        assert count_flops(lambda a: lax.linalg.lu(a)[0], matrix(m, n)) == flops
    for n in (1, 2, 7):
        flops = count_flops(lambda a: lax.linalg.cholesky(a, symmetrize_input=False), matrix(n, n))
        assert flops == cholesky(n)
    for m, n in [(200, 200), (300, 100)]:
        # To the leading order, which is all that a count by formula means.
        flops = count_flops(jnp.linalg.qr, matrix(m, n))
        assert abs(flops / (2 * householder(m, n)) - 1) < 0.02
    eigenvalues = lambda a: lax.linalg.eigh(a, symmetrize_input=False)[0]  # noqa: E731
    assert count_flops(eigenvalues, matrix(6, 6)) == 9 * 6**3


def test_triangular_solve():
    def solve(unit, a, b):
        return lax.linalg.triangular_solve(a, b, left_side=True, lower=True, unit_diagonal=unit)

    for unit, flops in [(False, 16), (True, 12)]:
        assert count_flops(lambda a, b, u=unit: solve(u, a, b), matrix(4, 4), matrix(4, 3)) == (
            3 * flops
        )


def test_what_has_no_rule_raises(subtests):
    for fun, message in (
        (lambda x: jnp.linalg.svd(x)[1], "svd"),
        (lax.lgamma, "lgamma"),
        (lambda x: jnp.sin(lax.complex(x, x)), "sin of complex"),
        (lambda x: lax.sign(lax.complex(x, x)), "sign of complex"),
        (lambda x: lax.while_loop(lambda y: y[0, 0] < 9.0, lambda y: y + 1.0, x), "while loop"),
    ):
        with subtests.test(fun=message), pytest.raises(NotImplementedError, match=message):
            count_flops(fun, matrix(3, 3))


def test_a_check_counts_nothing_and_a_function_of_the_host_is_refused():
    checked = lambda x: eqx.error_if(2 * x, x > 3, "too large")  # noqa: E731
    assert count_flops(checked, 1.0) == 1
    for x in (1.0, 1):
        host = lambda x: jax.pure_callback(np.square, jnp.asarray(x), x)  # noqa: E731
        with pytest.raises(NotImplementedError, match="function of the host"):
            count_flops(host, x)


class Product(cfjax.AbstractTransform):
    matrix: jax.Array

    def forward(self, point):
        return self.matrix.T @ point

    def inverse(self, coefficients):
        return self.matrix @ coefficients


class Reversed(cfjax.AbstractTransform):
    """The points backwards, which takes no flops."""

    def forward(self, point):
        return point[::-1]

    def inverse(self, coefficients):
        return coefficients[::-1]


def state_of(solver, term, y0, args=None):
    """Shapes of the state in which a solver starts, and what in it is no array."""
    state = eqx.filter_eval_shape(solver.init, term, 0.0, 0.1, y0, args)
    return eqx.partition(state, lambda x: isinstance(x, jax.ShapeDtypeStruct))


def test_transforms_of_a_step_of_affine_fields(subtests):
    def flops(solver, transform):
        def field(t, y, args):
            return cfjax.Affine(jnp.sin(y) + t, -jnp.arange(8.0), transform)

        term, y0 = cfjax.LieTerm(field), jnp.ones(8)
        state, static = state_of(solver, term, y0)

        def step(t0, t1, y0, state):
            state = eqx.combine(state, static)
            y1, error, _, after, _ = solver.step(term, t0, t1, y0, None, state, False)
            return y1, error, after.first

        return count_flops(step, 0.0, 0.1, y0, state)

    matrix = jnp.asarray(np.linalg.qr(np.random.default_rng(0).standard_normal((8, 8)))[0])
    for solver, transforms in (
        # The start, four times b, three points where the field is evaluated, and the end.
        (cfjax.CF4(estimate=None), 9),
        # One more b, at the end, and the point of the embedded method. Its flow would have been
        # three.
        (cfjax.CF4(), 11),
        # One more b too, and two for the velocity at the end.
        (cfjax.CF4(estimate="algebra"), 12),
        # A bracket takes none.
        (cfjax.RKMK4(), 9),
    ):
        with subtests.test(solver=repr(solver)):
            found = flops(solver, Product(matrix)) - flops(solver, Reversed())
            assert found == transforms * 2 * 8**2


def test_a_batch_of_steps_counts_each():
    """A step is one operation, whose program is of one member."""
    solver, term = cfjax.LieEuler(), cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(-y / args))
    y0, inertia = jnp.array([0.9, 0.4, 0.1]), jnp.arange(1.0, 4.0)
    state, static = state_of(solver, term, y0, inertia)

    def step(t0, y0, inertia, state):
        state = eqx.combine(state, static)
        return solver.step(term, t0, t0 + 0.1, y0, inertia, state, False)[0]

    one = count_flops(step, 0.0, y0, inertia, state)
    batch = jax.vmap(step, (0, 0, None, None))
    assert count_flops(batch, jnp.zeros(7), jnp.tile(y0, (7, 1)), inertia, state) == 7 * one
