"""The exponential of a matrix or an operator, times a vector: flows of cfjax and Krylov methods.

- dense: a random Hermitian matrix, complex, of size n.
- spins: a chain of 12 in a transverse field, as in `cfjax.scenes.annealing`, halfway.
- diffusion and advection: differences on 1024 points, symmetric, or nearly skew but damped.

The 2-norm of a step is given, and declared for `OperatorSum`. `LeftMatrix` sees a matrix only when
it runs. The others are the dense exponential of cfjax times
the vector, and the Lanczos method of matfree, without reorthogonalisation, if the operator is
Hermitian, otherwise the Arnoldi method of matfree. Both use the exponential of cfjax for the small
matrix, which is faster than an exponential by eigenvalues. They have no tolerance: each takes the
smallest number of products from a list for which its error is at most `GOAL` times the norm, found
by trial. The time does not include the trials, which is to their advantage. Six products are what a
step of Tsit5 takes in plain space. A gradient is one in the coefficient and the state. All take
turns. Without matfree there is no Krylov method.
"""

import functools
import importlib
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse as sparse
from jax import Array, lax
from scipy.sparse.linalg import expm_multiply

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax._numerics.expm import expm
from cfjax.scenes import annealing

SIZES = (2, 4, 8, 16, 32, 64, 128, 256, 512)
NORMS = (0.5, 5.0, 50.0)
SPINS, POINTS = 12, 1024
COUNTS = (4, 8, 12, 14, 20, 24, 32, 40, 56, 80, 112)
GOAL = 2e-14
SECONDS = 0.02  # A timed call, about.

# The product with the operator, from coefficient and state to the state.
Action = Callable[[Array, Array], Array]


def measure(quick: bool) -> Iterator[results.Row]:
    for n in SIZES[:3] if quick else SIZES:
        for norm in NORMS:
            yield from rows("dense", n, norm, dense(n, norm), False, quick)
    for name, make, norms in (
        ("spins", spins, NORMS),
        ("diffusion", lambda norm: differences(norm, 0.0), (1.0, 5.0, 20.0, 100.0)),
        ("advection", lambda norm: differences(norm, 0.9), (1.0, 5.0, 20.0, 100.0)),
    ):
        for gradient in (False, True):
            for norm in norms[:1] if quick else norms:
                yield from rows(name, 0, norm, make(norm), gradient, quick)


def rows(
    name: str, n: int, norm: float, problem: Any, gradient: bool, quick: bool
) -> Iterator[results.Row]:
    y, exact, ours, product, krylov = problem
    steps = dict(ours)
    if krylov is not None:
        method, make = krylov
        for count in (c for c in COUNTS if c <= y.size):
            step = functools.partial(make(count), product)
            if distance(step, y, exact) <= GOAL * max(1.0, norm):
                steps[f"{method}, {count} products"] = step
                break
    base = next(iter(steps))
    programs = {}
    for method, step in steps.items():
        if method != "six products":
            error = distance(step, y, exact)
            # Not that of a matrix squared six times, whose rounding grows.
            if error > 10 * GOAL * max(1.0, norm):
                raise RuntimeError(f"{name}, {n}, {norm}: {method} is off by {error}")
        programs[method] = looped(step, y, gradient)
    length = lengths(programs[base], y)
    compiled = {method: program(length) for method, program in programs.items()}
    times = results.in_turns(compiled, repeats=3 if quick else 15)
    for method, seconds in times.items():
        yield {
            "problem": name,
            "n": y.size,
            "norm": norm,
            "gradient": gradient,
            "program": method,
            "seconds": results.spread(seconds / length),
            f"over {base}": results.ratios(seconds, times[base]),
        }


def distance(step: Action, y: Array, exact: np.ndarray) -> float:
    return float(np.linalg.norm(jax.jit(step)(jnp.ones(()), y) - exact))


def looped(step: Action, y: Array, gradient: bool) -> Callable[[int], Callable[[], Any]]:
    """A loop of so many steps from y, each of which needs the last; or of gradients."""

    def value(c: Array, y: Array) -> Array:
        return jnp.sum(jnp.abs(step(c, y)[: y.size // 2]) ** 2)

    def body(y: Array, c: Array) -> tuple[Array, None]:
        if not gradient:
            return step(c, y), None
        in_c, in_y = jax.grad(value, (0, 1))(c, y)
        return y + 1e-9 * (in_c + in_y.conj()), None

    def make(length: int) -> Callable[[], Any]:
        cs = jnp.ones(length)
        compiled = jax.jit(lambda y, cs: lax.scan(body, y, cs)[0]).lower(y, cs).compile()
        return lambda: compiled(y, cs)

    return make


def lengths(make: Callable[[int], Callable[[], Any]], y: Array) -> int:
    program = make(2)
    (seconds,) = take_turns([program], repeats=3)
    return int(np.clip(SECONDS / (np.min(seconds) / 2), 2, 200))


def unit(n: int, is_complex: bool) -> np.ndarray:
    rng = np.random.default_rng(1)
    y = rng.normal(size=n) + 1j * rng.normal(size=n) * is_complex
    y = y if is_complex else y.real
    return y / np.linalg.norm(y)


def dense(n: int, norm: float) -> Any:
    rng = np.random.default_rng(n)
    h = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    h = h + h.conj().T
    h *= norm / np.linalg.norm(h, 2)
    y = unit(n, True)
    values, vectors = np.linalg.eigh(h)
    exact = vectors @ (np.exp(-1j * values) * (vectors.conj().T @ y))
    a = jnp.asarray(h)

    def six(c: Array, y: Array) -> Array:
        return functools.reduce(lambda y, _: c * (a @ y), range(6), y)

    ours = {
        "OperatorSum": lambda c, y: cfjax.OperatorSum([-1j * c], [(a, norm)], is_skew=True).flow(y),
        "LeftMatrix": lambda c, y: cfjax.LeftMatrix(-1j * c * a).flow(y),
        "dense exponential": lambda c, y: expm(-1j * c * a) @ y,
        "six products": six,
    }
    return jnp.asarray(y), exact, ours, lambda c, y: c * (a @ y), krylov(is_hermitian=True)


def spins(norm: float) -> Any:
    matrix = sparse.csr_array((2**SPINS, 2**SPINS))
    flip = sparse.csr_array([[0.0, 1.0], [1.0, 0.0]])
    for j in range(SPINS):
        before, after = sparse.eye_array(2**j), sparse.eye_array(2 ** (SPINS - 1 - j))
        matrix = matrix - sparse.kron(sparse.kron(before, flip), after)
    matrix = sparse.csr_array(matrix - sparse.diags_array(annealing.couplings(SPINS)))
    y = unit(2**SPINS, True)
    # Halfway, each part has half of its weight.
    size = norm / abs(sparse.linalg.eigsh(matrix / 2, k=1)[0][0])
    exact = expm_multiply(-1j * size / 2 * matrix, y)
    field = annealing.field(annealing.t1 / 2, jnp.asarray(y))

    def scaled(c: Array, y: Array) -> Any:
        return cfjax.combine([c * size], [field])

    ours = {"OperatorSum": lambda c, y: scaled(c, y).flow(y)}
    product = lambda c, y: 1j * scaled(c, y).tangent(y)  # noqa: E731
    return jnp.asarray(y), exact, ours, product, krylov(is_hermitian=True)


def differences(norm: float, slant: float) -> Any:
    up, down, middle = (1 + slant) * norm / 4, (1 - slant) * norm / 4, -norm / 2
    bands = ((0, middle), (1, up), (-1, down))
    matrix = sum(np.diag(np.full(POINTS - abs(k), value), k) for k, value in bands)
    y = unit(POINTS, False)
    exact = expm_multiply(sparse.csr_array(matrix), y)

    def shifted(x: Array) -> Array:
        return middle * x + up * jnp.pad(x[1:], (0, 1)) + down * jnp.pad(x[:-1], (1, 0))

    operator = lx.FunctionLinearOperator(shifted, jax.ShapeDtypeStruct(y.shape, y.dtype))
    ours = {"OperatorSum": lambda c, y: cfjax.OperatorSum([c], [(operator, norm)]).flow(y)}
    product = lambda c, y: c * shifted(y)  # noqa: E731
    return jnp.asarray(y), exact, ours, product, krylov(is_hermitian=slant == 0, factor=1.0)


def krylov(
    is_hermitian: bool, factor: complex = -1j
) -> tuple[str, Callable[[int], Callable[[Action, Array, Array], Array]]] | None:
    """The method, and for so many products how it gets the flow from the product with the
    Hermitian operator, or with any other, the coefficient and the state."""
    if importlib.util.find_spec("matfree") is None:
        return None
    decomp, funm = (importlib.import_module(f"matfree.{name}") for name in ("decomp", "funm"))
    small = lambda t: expm(factor * t)  # noqa: E731

    def make(count: int) -> Any:
        if is_hermitian:
            # matfree has the adjoint of its own for real numbers only.
            decomposition = decomp.tridiag_sym(count, reortho="none", custom_vjp=False)
            flow = funm.funm_lanczos_sym(small, decomposition)
        else:
            decomposition = decomp.hessenberg(count, reortho="full", custom_vjp=False)
            flow = funm.funm_arnoldi(small, decomposition)
        return lambda product, c, y: flow(functools.partial(product, c), y)

    return "Lanczos" if is_hermitian else "Arnoldi", make


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
