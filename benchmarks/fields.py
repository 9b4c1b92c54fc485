"""Ways to write a field: a user-defined field must be as fast as those of cfjax.

The problem is a heavy top whose attitude is a quaternion, moved by a user-defined class, with its
angular momentum. The ways differ only in how they write the product of two quaternions. It measures
the time of a step, and of the gradient of a step, of CF4 and RKMK(Tsit5), for one system and for
each of a batch, by `cfjax.integrate` and `diffrax.diffeqsolve`. All ways take turns.
"""

from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax
import results
from cfjax._measure.work_precision import take_turns

STEP, STEPS, BATCH = 0.01, 100, 2000
REPEATS = {1: 100, BATCH: 1}  # of a solve in one turn, by the number of systems
SOLVERS = {"CF4": cfjax.CF4(), "RKMK(Tsit5)": cfjax.RKMK(diffrax.Tsit5.tableau)}
LOOPS = ("cfjax.integrate", "diffrax.diffeqsolve")
INERTIA = np.array([1.0, 1.2, 0.4])

# Multiplication by a quaternion from the left: its matrix is built of its entries with signs.
ENTRIES = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
SIGNS = np.array([[1, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]], float)
STRUCTURE = SIGNS[:, :, None] * np.eye(4)[ENTRIES]  # of the product: result, right, left

Product = Callable[[Array, Array], Array]


def entries(p: Array, q: Array) -> list[Array]:
    return [
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    ]


def by_array(p: Array, q: Array) -> Array:
    return jnp.array(entries(p, q))


def by_stack(p: Array, q: Array) -> Array:
    return jnp.stack(entries(p, q))


def by_concatenate(p: Array, q: Array) -> Array:
    return jnp.concatenate([x[None] for x in entries(p, q)])


def by_matrix(p: Array, q: Array) -> Array:
    w, x, y, z = p
    return jnp.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ q


def by_einsum(p: Array, q: Array) -> Array:
    return jnp.einsum("ijk,j,k->i", jnp.asarray(STRUCTURE), q, p)


def by_cross(p: Array, q: Array) -> Array:
    vector = p[0] * q[1:] + q[0] * p[1:] + jnp.cross(p[1:], q[1:])
    return jnp.concatenate([(p[0] * q[0] - p[1:] @ q[1:])[None], vector])


def by_indexing(p: Array, q: Array) -> Array:
    return (jnp.asarray(SIGNS) * p[ENTRIES]) @ q


def by_at(p: Array, q: Array) -> Array:
    r = jnp.zeros_like(q)
    for k, x in enumerate(entries(p, q)):
        r = r.at[k].set(x)
    return r


class Quaternion(cfjax.AbstractAlgebraElement):
    """The rotation with angular velocity `omega` in the body, on attitudes as quaternions."""

    omega: Float[Array, "3"]
    product: Product = eqx.field(static=True)

    def flow(self, point):
        x, y, z = self.omega / 2
        square = x * x + y * y + z * z
        is_zero = square == 0
        angle = jnp.sqrt(jnp.where(is_zero, 1.0, square))
        scale = jnp.where(is_zero, 1.0, jnp.sin(angle) / angle)
        cosine = jnp.where(is_zero, 1.0, jnp.cos(angle))
        return self.product(point, jnp.array([cosine, scale * x, scale * y, scale * z]))

    def tangent(self, point):
        x, y, z = self.omega / 2
        return self.product(point, jnp.array([jnp.zeros_like(x), x, y, z]))

    def bracket(self, other):
        # It acts from the right.
        return type(self)(jnp.cross(other.omega, self.omega), self.product)


class Normalised(Quaternion):
    """The same, with the length normalised after each flow, as users often do."""

    def flow(self, point):
        moved = super().flow(point)
        return moved / jnp.linalg.norm(moved)


WAYS: dict[str, tuple[type[Quaternion], Product]] = {
    "`jnp.array([...])`": (Quaternion, by_array),
    "`jnp.stack([...])`": (Quaternion, by_stack),
    "`jnp.concatenate`": (Quaternion, by_concatenate),
    "a 4 x 4 matrix": (Quaternion, by_matrix),
    "`jnp.einsum`": (Quaternion, by_einsum),
    "`jnp.cross`": (Quaternion, by_cross),
    "`jnp.linalg.norm`": (Normalised, by_stack),
    "an array as index": (Quaternion, by_indexing),
    "`.at[...].set`": (Quaternion, by_at),
}


def term(way: str) -> cfjax.LieTerm:
    kind, product = WAYS[way]

    def field(t, state, inertia):
        (w, x, y, z), momentum = state["attitude"], state["momentum"]
        omega = momentum / inertia
        up = jnp.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])
        torque = jnp.cross(up, jnp.array([0.1, 0.0, 1.0])) + 0.1 * jnp.cos(t)
        momentum = jnp.cross(momentum, omega) + torque
        return {"attitude": kind(omega, product), "momentum": momentum}

    return cfjax.LieTerm(field)


def solve(loop: str, solver: Any, way: str) -> Callable[[Any, Array], Any]:
    t1 = STEP * STEPS

    def final_state(state, inertia):
        if loop == "cfjax.integrate":
            sol = cfjax.integrate(term(way), solver, 0.0, t1, state, inertia, num_steps=STEPS)
        else:
            sol = diffrax.diffeqsolve(
                term(way), solver, 0.0, t1, STEP, state, inertia, max_steps=STEPS + 1
            )
        return jax.tree.map(lambda ys: ys[-1], sol.ys)

    return final_state


def gradient(final_state: Callable[[Any, Array], Any]) -> Callable[[Any, Array], Any]:
    def loss(state, inertia):
        return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(final_state(state, inertia)))

    return jax.grad(loss, argnums=(0, 1))


def initial_state(systems: int) -> dict[str, Array]:
    rng = np.random.default_rng(0)
    q, momentum = rng.normal(size=(systems, 4)), rng.normal(size=(systems, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return {"attitude": jnp.asarray(q), "momentum": jnp.asarray(momentum)}


def compiled(program: Callable[..., Any], systems: int) -> Callable[[], Any]:
    state, inertia = initial_state(BATCH), jnp.asarray(INERTIA)
    if systems == 1:
        state = jax.tree.map(lambda x: x[0], state)
    else:
        program = jax.vmap(program, in_axes=(0, None))
    return results.compiled(program, state, inertia, repeats=REPEATS[systems])


def measure(quick: bool) -> Iterator[results.Row]:
    for loop in LOOPS[: 1 if quick else None]:
        for systems in REPEATS:
            solves = {name: [solve(loop, s, way) for way in WAYS] for name, s in SOLVERS.items()}
            solves["CF4, gradient"] = [gradient(final_state) for final_state in solves["CF4"]]
            programs = [compiled(program, systems) for row in solves.values() for program in row]
            check([program() for program in programs[: len(WAYS)]])
            seconds = take_turns(programs, repeats=3 if quick else 25)
            seconds = seconds.reshape(len(solves), len(WAYS), -1)
            work = STEPS * systems * REPEATS[systems]
            for name, times in zip(solves, seconds, strict=True):
                best = min(times, key=np.median)
                for k, way in enumerate(WAYS):
                    yield {
                        "way": way,
                        "loop": loop,
                        "program": name,
                        "systems": systems,
                        "seconds a step": results.spread(times[k] / work),
                        "over the best": results.ratios(times[k], best),
                        "over the solve": results.ratios(times[k], seconds[0, k]),
                    }


def check(ends: list[Any]) -> None:
    for end in ends:
        for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(ends[0]), strict=True):
            if not np.allclose(a, b, atol=1e-9, rtol=0):
                raise RuntimeError("The ways disagree.")


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
