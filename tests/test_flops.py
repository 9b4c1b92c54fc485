import jax
import jax.numpy as jnp
import pytest
from jax import lax

from cfjax._flops import count_flops

X = jnp.ones(10)
SCALAR = jnp.ones(())


def matrix(*shape):
    return jax.ShapeDtypeStruct(shape, float)


def horner(x):
    return ((2.0 * x + 3.0) * x + 5.0) * x + 7.0


def steps(x):
    return lax.scan(lambda y, _: (2.0 * y + 1.0, None), x, length=5)[0]


def either(x):
    return lax.cond(x[0] > 0, jnp.sin, lambda x: x * x + 1.0, x)


@jax.custom_jvp
def own_derivative(x):
    return x * 3.0


own_derivative.defjvp(lambda primals, tangents: (own_derivative(*primals), tangents[0] * 3.0))


@pytest.mark.parametrize(
    "fun, arguments, flops",
    [
        (jnp.matmul, (matrix(3, 4), matrix(4, 5)), 2 * 3 * 4 * 5),
        (jnp.matmul, (matrix(6, 3, 4), matrix(6, 4, 5)), 6 * 2 * 3 * 4 * 5),
        (jnp.dot, (X, X), 20),
        (jnp.cross, (matrix(3), matrix(3)), 9),
        (horner, (X,), 60),
        (steps, (SCALAR,), 10),
        (lambda x: lax.fori_loop(0, 4, lambda i, y: jnp.sin(y) / 2.0, x), (X,), 80),
        (either, (X,), 20),
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
    ],
)
def test_flops_of_known_programs(fun, arguments, flops):
    assert count_flops(fun, *arguments) == flops


def test_moves_signs_and_comparisons_are_free():
    def fun(x):
        y = jnp.where(x > 0, -x, jnp.maximum(x, 2.0))
        y = jnp.concatenate([y[3:], jnp.round(abs(y[:3]))]).reshape(5, 2).T
        return y, jnp.max(y), y.astype(jnp.float32)

    assert count_flops(fun, X) == 0


def test_integer_arithmetic_is_free():
    assert count_flops(lambda n: n * n + 1, jnp.arange(3)) == 0


def test_what_is_not_needed_is_not_counted():
    def fun(x):
        unused = jnp.sin(x) * 3.0
        return x + 1.0, jax.jit(lambda a, b: (a, b * 2.0))(x, unused)[0]

    assert count_flops(fun, X) == 10


def test_what_is_computed_twice_counts_once():
    def twice(x, y):
        return jax.jit(horner)(x) + jax.jit(horner)(x), horner(x) * 2.0, horner(y)

    assert count_flops(twice, X, X) == 60 + 10 + 10 + 60


@pytest.mark.parametrize(
    "fun, message",
    [
        (jnp.linalg.cholesky, "cholesky"),
        (lax.lgamma, "lgamma"),
        (lambda x: lax.complex(x, x), "complex"),
        (lambda x: lax.while_loop(lambda y: y[0, 0] < 9.0, lambda y: y + 1.0, x), "while loop"),
    ],
)
def test_what_has_no_rule_raises(fun, message):
    with pytest.raises(NotImplementedError, match=message):
        count_flops(fun, matrix(3, 3))
