"""Two problems on the Stiefel manifold: n x p matrices with orthonormal columns.

`first` is `Y' = (g Y^T - Y g^T) Y` with `g = D Y C`. `second` is `Y' = S(Y) Y` with the skew matrix
`S = [[A, -B^T], [B, 0]]`. All quantities are dimensionless, and t runs from 0 to 1. Any n >= p;
the paper has p = 4 and n = 100 and 1000.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.2, doi:10.1016/S0167-739X(02)00161-9.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 1.0
solver = cfjax.Projected(diffrax.Dopri8())

# The first two rows of Y(1) and the sum of its entries for n = 100, p = 4, from an independent
# program, rounded to 13 decimals.
tabulated = {
    "first": (
        np.array(
            [
                [0.1641570774157, -0.1539080809612, -0.3672064275045, -0.2622972415577],
                [-0.1380751208096, -0.2246971448282, 0.3229395241233, -0.0523774997053],
            ]
        ),
        -0.8017493611088,
    ),
    "second": (
        np.array(
            [
                [0.4778990111738, -0.058155756172, 0.3581387591196, -0.101179885336],
                [-0.170258166442, 0.0774084024799, -0.1118791496841, 0.3080389149506],
            ]
        ),
        0.8944825715559,
    ),
}


def y0(n: int, p: int = 4) -> Float[np.ndarray, "n p"]:
    """The initial value: Q of the matrix `cos(i j)`, i = 1..n, j = 1..p, with diag(R) > 0."""
    q, r = np.linalg.qr(np.cos(np.outer(np.arange(1, n + 1), np.arange(1, p + 1))))
    return q * np.sign(np.diag(r))


def diagonals(n: int, p: int = 4) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " p"]]:
    """The diagonals of D (1 up to 2 - 1/n) and C (-3 down to -4 + 1/p) of the first problem."""
    return 1 + np.arange(n) / n, -3 - np.arange(p) / p


def first(
    t: Any,
    y: Float[Array, "n p"],
    args: tuple[Float[Array | np.ndarray, " n"], Float[Array | np.ndarray, " p"]],
) -> cfjax.LowRankSkew:
    """The frozen field of the first problem at `y`, with `args = (D, C)` as diagonals."""
    d, c = args
    return cfjax.LowRankSkew(d[:, None] * y * c[None, :])


def second(t: Any, y: Float[Array, "n p"], args: Any = None) -> cfjax.BorderedSkew:
    """The frozen field of the second problem at `y`; needs n > p."""
    n, p = y.shape
    # G is skew and tridiagonal with G[i, i + 1] = (1 + sum_j Y[j, j]) i, counting from 1.
    rate = (1 + jnp.trace(y[:p])) * np.arange(1, p + 1).astype(y.dtype)
    above = rate[:, None] * y[1 : p + 1]
    below = jnp.pad(rate[: p - 1, None] * y[: p - 1], ((1, 0), (0, 0)))
    return cfjax.BorderedSkew(jnp.concatenate([jnp.tril(above - below, -1), y[: n - p]]))


def reference(problem: str, n: int, p: int = 4) -> Float[np.ndarray, "n p"]:
    """`Y(1)` of the problem, "first" or "second", in NumPy's float64.

    It is computed by DOP853 in the space of all matrices, at the tightest tolerance that SciPy
    accepts. The error is about 1e-13. It takes some tenths of a second for n = 1000.
    """
    d, c = diagonals(n, p)
    index = np.arange(1, p + 1)[:, None]

    def first(t, y):
        g = d[:, None] * y * c
        return g @ (y.T @ y) - y @ (g.T @ y)

    def second(t, y):
        above = (1 + np.trace(y[:p])) * index * y[1 : p + 1]
        below = (1 + np.trace(y[:p])) * (index - 1) * np.concatenate([y[:1], y[: p - 1]])
        lower = np.tril(above - below, -1)
        border = y[: n - p]
        top = (lower - lower.T) @ y[:p] - border.T @ y[p:]
        return np.concatenate([top, border @ y[:p]])

    rate = {"first": first, "second": second}[problem]
    return by_dop853(rate, y0(n, p), t1, rtol=2.3e-14, atol=1e-16)


def problem(which: str = "first", n: int = 100) -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    field, args = {"first": (first, diagonals(n)), "second": (second, None)}[which]
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(n), args=args)


def invariants(y: Float[Array, "n p"], args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    defect = y.T @ y - np.eye(y.shape[1], dtype=y.dtype)
    return {"distance from orthonormal columns": jnp.linalg.norm(defect)}


def chart_first(**options: Any) -> cfjax.WorkPrecision:
    """Stiefel manifold, first experiment, n = 1000, p = 4, 4 to 256 equal steps to t = 1."""
    return _chart("first", options)


def chart_second(**options: Any) -> cfjax.WorkPrecision:
    """Stiefel manifold, second experiment, n = 1000, p = 4, 4 to 256 equal steps to t = 1."""
    return _chart("second", options)


def picture(n: int = 40) -> figures.Figure:
    """Columns of the first problem that gather where D is smallest, and two ways to stay there.

    The flow climbs `tr(C Y^T D Y) / 2`, whose maximum has the columns on the first p axes.
    """
    end, steps = 40.0, 400
    d, c = diagonals(n)
    plain = diffrax.ODETerm(_velocity(first))
    options = dict(t1=end, num_steps=steps, save_every=1)
    times, ys = solve(problem("first", n), solver, **options)
    _, others = solve(problem("first", n), diffrax.Tsit5(), term=plain, **options)
    figure = figures.new(10.0, 3.6)
    columns, climb, drift = figure.subplots(1, 3, width_ratios=(1.2, 1, 1))
    shots = np.concatenate([y0(n)[None], ys[[19, 99, -1]]])
    # One blank column between the matrices.
    board = np.pad(np.abs(shots), ((0, 0), (0, 0), (0, 1)), constant_values=np.nan)
    width = board.shape[2]
    board = np.concatenate(list(board), axis=1)[:, :-1]
    columns.imshow(board, aspect="auto", cmap="magma_r", vmin=0, vmax=1, interpolation="nearest")
    labels = [f"t = {t:g}" for t in (0, *times[[19, 99, -1]])]
    columns.set_xticks([width * k + (width - 2) / 2 for k in range(len(shots))], labels)
    columns.set(title="Entries of Y, large ones dark", ylabel="row")
    height = np.einsum("tij,i,j->t", ys**2, d, c) / 2
    top = np.sum(d[: len(c)] * np.sort(c)) / 2
    climb.plot(times, height, color=figures.BLUE)
    climb.axhline(top, color="0.6", linestyle=":", linewidth=1)
    climb.set(title="tr($C\\,Y^T D\\,Y$) / 2, and its maximum", xlabel="t")
    for name, y in {"Projected, Dopri8": ys, "Tsit5 in plain space": others}.items():
        off = np.abs(np.swapaxes(y, 1, 2) @ y - np.eye(y.shape[2])).max(axis=(1, 2))
        drift.semilogy(times, np.maximum(off, 1e-17), label=name)
    drift.set(title=f"Off orthonormal, steps of {end / steps:g}", xlabel="t")
    drift.legend(frameon=False)
    return figure


def _velocity(field: Callable[..., Any]) -> Callable[..., Any]:
    """A field in plain space, where no method keeps columns orthonormal."""
    return lambda t, y, args: cfjax.tangent(field(t, y, args), y)


def _chart(which: str, options: dict[str, Any]) -> cfjax.WorkPrecision:
    field = {"first": first, "second": second}[which]
    return cfjax.work_precision(
        **problem(which, 1000),
        methods=by_name(cfjax.CF3(), cfjax.CF4(), cfjax.RKMK4())
        | {"RKR-C4": cfjax.CayleyRK4()}
        | by_name(*PROJECTED)
        | in_plain_space(_velocity(field), diffrax.Tsit5()),
        reference=reference(which, 1000),
        num_steps=[4 * 2**k for k in range(7)],
        **options,
    )
