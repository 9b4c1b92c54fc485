"""A picture of a frozen field: a point, its velocity, the flow that leaves it, and the line beside.

Nothing is measured.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure

import cfjax
from cfjax.scenes import _figures

START = np.array([0.1, -0.92, 0.30])
DURATION = 1.75


def field(t: Array, y: Array, args: None) -> cfjax.Rotation:
    return cfjax.Rotation(jnp.array([-0.2, 0.0, 1.0]) - 0.7 * y[0] * jnp.array([0.3, 1.0, 0.0]))


def draw() -> dict[str, Figure]:
    y = jnp.asarray(START / np.linalg.norm(START))
    frozen = field(jnp.zeros(()), y, None)
    ts = np.linspace(0, DURATION, 81)
    flow = np.stack([cfjax.flow(cfjax.combine((t,), (frozen,)), y) for t in ts])
    velocity = np.asarray(cfjax.tangent(frozen, y))
    line = np.asarray(y) + ts[:, None] * velocity
    sol = cfjax.integrate(
        cfjax.LieTerm(field), cfjax.RKMK8(), 0.0, DURATION, y, num_steps=80, save_every=1
    )
    assert sol.ys is not None
    solution = np.concatenate([y[None], sol.ys])

    figure = _figures.new(5.0, 4.2)
    axes = _figures.sphere(figure, zoom=1.5)
    axes.view_init(elev=18, azim=-62)
    curves: list[tuple[Any, str, str, str]] = [
        (solution, "0.35", "--", "the solution"),
        (flow, _figures.BLUE, "-", "the flow of the frozen field"),
        (line, _figures.VERMILION, "-", "the straight line of its velocity"),
    ]
    for curve, color, style, label in curves:
        axes.plot(*curve.T, color=color, linestyle=style, linewidth=2.2, label=label)
    axes.quiver(*y, *(0.3 * velocity), color="black", linewidth=1.8, arrow_length_ratio=0.22)
    axes.scatter(*y, color="black", s=30, zorder=10)
    axes.text(y[0] - 0.12, y[1], y[2] + 0.1, "$y$", fontsize=13)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
    figure.legend(loc="outside lower center", frameon=False, fontsize=9)
    return {"frozen_field": figure}
