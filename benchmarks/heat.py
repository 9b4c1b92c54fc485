"""Time of one CF4 step of the heat problem against NumPy and SciPy.

Two programs make the same steps with `scipy.fft`, and compute the exponentials of a step of fixed
size once, before the loop: one as the paper writes the method, with grid values as the state and
three transforms for each flow, the other with the sine coefficients as the state, as cfjax does, so
with 8 transforms a step instead of 15. All programs take turns in one run, so that the ratios are
meaningful on a busy machine.
"""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft

import cfjax
import results
from cfjax.scenes import heat

SIZES = (100, 1000, 10_000)
STATES = ("grid values", "coefficients")
STEP = 1e-3
INTERVALS_PER_TURN = 2_000_000  # steps times intervals: some tenths of a second


def measure(quick: bool) -> Iterator[results.Row]:
    for size in SIZES:
        steps = max(20, min(2000, INTERVALS_PER_TURN // size))
        programs = {
            "NumPy and SciPy, grid values": lambda size=size, steps=steps: on_grid(size, steps),
            "NumPy and SciPy, coefficients": lambda size=size, steps=steps: on_coefficients(
                size, steps
            ),
            "cfjax, coefficients": compiled(size, steps, spectral=True),
            "cfjax, grid values": compiled(size, steps, spectral=False),
        }
        check(*(program() for program in programs.values()))
        times = results.in_turns(programs, repeats=3 if quick else 15)
        for name, values in times.items():
            yield {"N": size, "program": name, "seconds a step": results.spread(values / steps)} | {
                f"over {state}": results.ratios(values, times[f"NumPy and SciPy, {state}"])
                for state in STATES
            }


def grid_field(t, u, args: heat.Diffusivity) -> cfjax.Affine:
    spectrum = heat.field(t, u, args).spectrum
    b = heat.grid_field(t, u, args._replace(mu=args.mu - args.constant))
    return cfjax.Affine(b, spectrum, cfjax.SineTransform())


def compiled(size: int, steps: int, *, spectral: bool) -> Callable[[], np.ndarray]:
    """The grid values after so many steps."""
    args = jax.tree.map(jnp.asarray, heat.diffusivity(size))
    term = cfjax.LieTerm(heat.field if spectral else grid_field)

    def run(y0, args):
        y0 = y0 if spectral else heat.to_grid(y0)
        t1 = steps * STEP
        solution = cfjax.integrate(term, cfjax.CF4(), 0.0, t1, y0, args, num_steps=steps)
        y = jax.tree.map(lambda ys: ys[-1], solution.ys)
        return heat.to_grid(y) if spectral else y

    y0 = jnp.asarray(heat.y0(size))
    executable = jax.jit(run).lower(y0, args).compile()
    return lambda: np.asarray(jax.block_until_ready(executable(y0, args)))


def dst(y: np.ndarray) -> np.ndarray:
    return np.asarray(scipy.fft.dst(y, type=1, norm="ortho"))


def on_grid(size: int, steps: int) -> np.ndarray:
    """Grid values as the state: a flow transforms the state, the field, and back."""
    nu, decay, phi = coefficients(size)
    edges = np.zeros(size + 1)

    def f(u):
        edges[1:-1] = u
        return np.diff(nu * np.diff(edges))

    def flow(b, u):
        return dst(decay * dst(u) + phi * dst(b))

    u = dst(heat.y0(size))
    h = STEP
    for _ in range(steps):
        f1 = f(u)
        u2 = flow((h / 2) * f1, u)
        f2 = f(u2)
        f3 = f(flow((h / 2) * f2, u))
        f4 = f(flow(h * f3 - (h / 2) * f1, u2))
        middle = (h / 6) * (f2 + f3)
        u = flow((h / 4) * f1 + middle - (h / 12) * f4, u)
        u = flow(middle - (h / 12) * f1 + (h / 4) * f4, u)
    return u


def on_coefficients(size: int, steps: int) -> np.ndarray:
    """Sine coefficients as the state: only an evaluation of the field transforms."""
    nu, decay, phi = coefficients(size)
    flux = np.zeros(size + 1)

    def f(y):
        flux[1:-1] = dst(y)
        return dst(np.diff(nu * np.diff(flux)))

    y = heat.y0(size)
    h = STEP
    for _ in range(steps):
        started = decay * y
        f1 = f(y)
        y2 = started + phi * ((h / 2) * f1)
        f2 = f(y2)
        f3 = f(started + phi * ((h / 2) * f2))
        f4 = f(decay * y2 + phi * (h * f3 - (h / 2) * f1))
        middle = (h / 6) * (f2 + f3)
        y = started + phi * ((h / 4) * f1 + middle - (h / 12) * f4)
        y = decay * y + phi * (middle - (h / 12) * f1 + (h / 4) * f4)
    return dst(y)


def coefficients(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The diffusivity besides the constant, and the functions of half a step of the constant."""
    mu, constant = heat.diffusivity(size)
    nu = np.asarray((mu - constant) * (size / 2) ** 2)
    rates = -constant * (size * np.sin(np.arange(1, size) * np.pi / (2 * size))) ** 2
    z = STEP / 2 * rates
    # Every flow of a CF4 step goes over half of it.
    return nu, np.exp(z), np.expm1(z) / z


def check(reference: np.ndarray, *alternatives: np.ndarray) -> None:
    # The steps are the same. They differ by rounding, which the heat equation damps.
    for alternative in alternatives:
        if not np.allclose(alternative, reference, atol=1e-10, rtol=0):
            raise RuntimeError(f"Programs disagree by {np.abs(alternative - reference).max()}.")


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
