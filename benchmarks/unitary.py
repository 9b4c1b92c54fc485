"""Small unitary matrices: exponentials, steps on SU(3), and the Wilson flow against C by hand.

All programs that are compared take turns in one run, so that the ratios mean something on a busy
machine. Without a C compiler there is no ratio to C.
"""

import ctypes
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

import cfjax
import results
from cfjax._numerics.expm import TAYLOR_SCHEMES, by_norm, taylor_from_second
from cfjax._numerics.matmul import small_product
from cfjax.scenes import wilson_flow

T1, STEPS = 1.0, 100
BATCH = 500
REPEATS = 25


def measure(quick: bool) -> Iterator[results.Row]:
    repeats = 3 if quick else REPEATS
    for n in (2, 3):
        for gradient in (False, True):
            for batch in (1, BATCH, 20_000):
                yield from exponentials(n, gradient, batch, repeats)
    for batch in (1, BATCH):
        yield from components(batch, repeats)
        yield from steps(batch, repeats)
    for side in (4, 8):
        yield from links(side, repeats)


def skew(batch: int, n: int, norm: float, seed: int = 0) -> Array:
    """Skew-Hermitian matrices without trace, of the given 2-norm."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(batch, n, n)) + 1j * rng.normal(size=(batch, n, n))
    a = a - a.conj().swapaxes(1, 2)
    a -= np.trace(a, axis1=1, axis2=2)[:, None, None] / n * np.eye(n)
    return jnp.asarray(a / np.linalg.norm(a, 2, axis=(1, 2))[:, None, None] * norm)


# Exponentials.


def by_products(a: Array) -> Array:
    """By the polynomial that `cfjax.expm` uses for larger matrices."""
    schemes = TAYLOR_SCHEMES[a.dtype.name]

    def approximate(k: int, a: Array, a2: Array) -> Array:
        return taylor_from_second(schemes[k], a, a2) + a + jnp.eye(a.shape[0])

    thetas = [scheme.theta for scheme in schemes]
    return by_norm(thetas, a, small_product(a, a), approximate, lambda _, e: e)[1]


def exponentials(n: int, gradient: bool, batch: int, repeats: int) -> Iterator[results.Row]:
    """A loop of matrices times an exponential, each of which differs from the last."""
    loops = max(2, 20_000 // batch)
    a, y = skew(batch, n, 0.5), jnp.eye(n) + skew(batch, n, 0.5, 1)

    def program(expm: Callable[[Array], Array]) -> Callable[[], object]:
        def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            a, y = carry
            return (a * (1 - 1e-9), small_product(expm(a), y)), None

        def run(a: Array, y: Array) -> Array:
            carry = lax.scan(jax.checkpoint(step) if gradient else step, (a, y), None, length=loops)
            return jnp.sum(jnp.abs(carry[0][1][0]) ** 2)

        function = jax.grad(run) if gradient else run
        # Alone a batch of one is not vectorised.
        if batch > 1:
            return results.compiled(jax.vmap(function), a, y)
        return results.compiled(function, a[0], y[0])

    times = results.in_turns(
        {
            "cfjax.expm": program(cfjax.expm),
            "products of matrices": program(by_products),
            "jax.scipy.linalg.expm": program(jax.scipy.linalg.expm),
        },
        repeats=repeats,
    )
    for name, seconds in times.items():
        yield {
            "exponential": name,
            "n": n,
            "batch": batch,
            "gradient": gradient,
            "seconds each": results.spread(seconds / loops / batch),
            "over products": results.ratios(seconds, times["products of matrices"]),
        }


# One matrix, with a field that depends on it.

_C = np.random.default_rng(0).normal(size=(3, 3)) + 1j * np.random.default_rng(1).normal(
    size=(3, 3)
)


def generator(t: Array, y: Array) -> Array:
    m = (jnp.cos(t) * _C) @ y + jnp.sin(t) * _C
    m = m - m.conj().T
    return m - jnp.trace(m) / 3 * jnp.eye(3)


def field(t, y, args=None):
    return cfjax.LeftMatrix(generator(t, y))


def velocity(t, y, args=None):
    return generator(t, y) @ y


def loop_cg3(y0: Array) -> Array:
    """Crouch and Grossman's method as one writes it down."""
    tableau = cfjax.CG3().tableau
    h, expm = T1 / STEPS, jax.scipy.linalg.expm

    def flows(y: Array, rows, stages: list[Array]) -> Array:
        for row in rows:
            for weight, a in zip(row, stages, strict=False):
                if weight:
                    y = expm(h * float(weight) * a) @ y
        return y

    def step(y: Array, k: Array) -> tuple[Array, None]:
        stages: list[Array] = []
        for c, rows in zip(tableau.c, tableau.alpha, strict=True):
            stages.append(generator(h * (k + float(c)), flows(y, rows, stages)))
        return flows(y, tableau.beta, stages), None

    return lax.scan(step, y0, jnp.arange(STEPS, dtype=float))[0]


def starts(batch: int) -> Array:
    phases = np.linspace(0, 1, batch)[:, None, None]
    return jnp.asarray(np.exp(1j * phases) * np.eye(3))


def ours(solver: diffrax.AbstractSolver, num_steps: int = STEPS) -> Callable[[Array], Array]:
    def run(y: Array) -> Array:
        sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, T1, y, num_steps=num_steps)
        return jax.tree.leaves(sol.ys)[0][-1]

    return run


def theirs(term: diffrax.AbstractTerm, solver: diffrax.AbstractSolver) -> Callable[[Array], Array]:
    def run(y: Array) -> Array:
        ys = diffrax.diffeqsolve(term, solver, 0.0, T1, T1 / STEPS, y, max_steps=None).ys
        return jax.tree.leaves(ys)[0][0]

    return run


def steps(batch: int, repeats: int) -> Iterator[results.Row]:
    lie, plain = cfjax.LieTerm(field), diffrax.ODETerm(velocity)
    methods: dict[str, tuple[int, Callable[[Array], Array]]] = {
        "a loop with jax.scipy.linalg.expm, CG3": (3, loop_cg3),
        "cfjax.integrate, CG3": (3, ours(cfjax.CG3())),
        "cfjax.integrate, CF3": (3, ours(cfjax.CF3())),
        "cfjax.integrate, CF4": (4, ours(cfjax.CF4())),
        "cfjax.integrate, CF54": (5, ours(cfjax.CF54())),
        "diffrax, CG3": (3, theirs(lie, cfjax.CG3())),
        "diffrax, CF4": (4, theirs(lie, cfjax.CF4())),
        "diffrax, CF54": (5, theirs(lie, cfjax.CF54())),
        "diffrax, Tsit5 in plain space": (5, theirs(plain, diffrax.Tsit5())),
    }
    y0 = starts(batch)
    y0 = y0 if batch > 1 else y0[0]

    def compiled(run: Callable[[Array], Array], repeats: int = 1) -> Callable[[], object]:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Complex dtype support in Diffrax")
            program = jax.vmap(run) if batch > 1 else run
            return results.compiled(program, y0, repeats=repeats)

    exact = np.asarray(compiled(ours(cfjax.CF54(), 10 * STEPS))())
    programs = {name: compiled(run) for name, (_, run) in methods.items()}
    errors = {name: np.max(np.abs(np.asarray(run()) - exact)) for name, run in programs.items()}
    times = results.in_turns(programs, repeats=repeats)
    loop, tsit5 = next(iter(methods)), list(methods)[-1]
    for name, seconds in times.items():
        order, _ = methods[name]
        # The step as long as it takes to have Tsit5's error.
        factor = (errors[name] / errors[tsit5]) ** (1 / order)
        yield {
            "program": name,
            "batch": batch,
            "error": results.digits(errors[name]),
            "seconds a step": results.spread(seconds / STEPS / batch),
            "over the loop": results.ratios(seconds, times[loop]),
            "over Tsit5": results.ratios(seconds, times[tsit5]),
            "over Tsit5 at its error": results.ratios(factor * seconds, times[tsit5]),
        }


def components(batch: int, repeats: int) -> Iterator[results.Row]:
    """The components of a step: a field, and a flow, each in a loop."""
    loops = 1000
    y0 = starts(batch)

    def program(operation: Callable[[Array, Array], Array]) -> Callable[[], object]:
        def run(y: Array) -> Array:
            return lax.scan(lambda y, t: (operation(t, y), None), y, jnp.linspace(0, 1, loops))[0]

        return results.compiled(jax.vmap(run), y0) if batch > 1 else results.compiled(run, y0[0])

    a = 0.05 * skew(1, 3, 1.0)[0]
    times = results.in_turns(
        {
            "field": program(generator),
            "flow": program(lambda t, y: cfjax.LeftMatrix((1 + t) * a).flow(y)),
        },
        repeats=repeats,
    )
    for name, seconds in times.items():
        yield {
            "part": name,
            "batch": batch,
            "seconds each": results.spread(seconds / loops / batch),
            "over the field": results.ratios(seconds, times["field"]),
        }


# SU(3) links.

LINK_STEP, LINK_STEPS = 0.01, 10


def straightforward(y0: Array) -> Array:
    """Williamson's method with matrix products and `jax.scipy.linalg.expm` under vmap."""
    expm = jax.scipy.linalg.expm
    for _ in range(y0.ndim - 2):
        expm = jax.vmap(expm)

    def dagger(x: Array) -> Array:
        return jnp.conj(jnp.swapaxes(x, -1, -2))

    def force(y: Array) -> Array:
        d = y.shape[0]
        forces = []
        for mu in range(d):
            total = jnp.zeros_like(y[mu])
            for nu in set(range(d)) - {mu}:
                across, above = jnp.roll(y[nu], -1, mu), jnp.roll(y[mu], -1, nu)
                total += across @ dagger(above) @ dagger(y[nu])
                total += jnp.roll(dagger(across) @ dagger(y[mu]) @ y[nu], 1, nu)
            loop = y[mu] @ total
            z = (dagger(loop) - loop) / 2
            trace = jnp.trace(z, axis1=-2, axis2=-1)[..., None, None]
            forces.append(z - trace / 3 * jnp.eye(3).reshape(*[1] * d, 3, 3))
        return jnp.stack(forces)

    def step(y: Array, _: None) -> tuple[Array, None]:
        k = jnp.zeros_like(y)
        for a, b in zip(cfjax.Williamson3.a, cfjax.Williamson3.b, strict=True):
            k = float(a) * k + LINK_STEP * force(y)
            y = expm(float(b) * k) @ y
        return y, None

    return lax.scan(step, y0, None, length=LINK_STEPS)[0]


def links(side: int, repeats: int) -> Iterator[results.Row]:
    y0 = jnp.asarray(wilson_flow.y0(side))
    t1 = LINK_STEP * LINK_STEPS

    def solve(y: Array) -> Array:
        term, solver = cfjax.LieTerm(wilson_flow.field), cfjax.Williamson3()
        sol = cfjax.integrate(term, solver, 0.0, t1, y, num_steps=LINK_STEPS, save_every=LINK_STEPS)
        return jax.tree.leaves(sol.ys)[0][-1]

    programs = {
        "cfjax.integrate": results.compiled(solve, y0),
        "jax.scipy.linalg.expm under vmap": results.compiled(straightforward, y0),
    }
    final_links = np.asarray(programs["cfjax.integrate"]())
    _check(programs["jax.scipy.linalg.expm under vmap"](), final_links)
    with tempfile.TemporaryDirectory() as folder:
        library = results.compile_c("wilson_flow.c", Path(folder), f"-DSIDE={side}")
        if library is not None:
            programs = {"C": _c(library, side, final_links), **programs}
        times = results.in_turns(programs, repeats=max(3, repeats // 2))
    base = next(iter(programs))
    for name, seconds in times.items():
        yield {
            "Williamson3 on links": name,
            "side": side,
            "seconds a step": results.spread(seconds / LINK_STEPS),
            f"over {base}": results.ratios(seconds, times[base]),
        }


def _c(library: ctypes.CDLL, side: int, expected: np.ndarray) -> Callable[[], object]:
    williamson3 = library.williamson3
    pointer = ctypes.POINTER(ctypes.c_double)
    williamson3.argtypes = [pointer, ctypes.c_double, ctypes.c_long]
    y0 = np.ascontiguousarray(wilson_flow.y0(side))

    def run() -> np.ndarray:
        y = y0.copy()
        williamson3(y.ctypes.data_as(pointer), LINK_STEP, LINK_STEPS)
        return y

    _check(run(), expected)
    return run


def _check(actual, expected) -> None:
    # The steps are the same. They differ by rounding.
    if not np.allclose(actual, expected, atol=1e-12, rtol=0):
        raise RuntimeError(f"The programs disagree by {np.max(np.abs(actual - expected))}.")


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
