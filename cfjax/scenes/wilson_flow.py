"""The Wilson flow of lattice gauge theory: SU(3) links that move down the gradient of the action.

Each link obeys `V' = Z(V) V`, where Z is the traceless skew-Hermitian part of minus the link times
the sum of its staples. The action, which counts every plaquette once,
`S = sum_x sum_(mu < nu) Re tr(1 - P_mu_nu(x))`, never rises, and the fields become smooth. Times
are in squares of the lattice spacing. The frozen field is a left action on each link.

A state has shape `(d, *sides, 3, 3)`: a periodic lattice of d axes with the links of each.

Source: Lüscher, Properties and uses of the Wilson flow in lattice QCD, JHEP 08 (2010) 071,
doi:10.1007/JHEP08(2010)071.
"""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

import cfjax

from .._numerics.matmul import matmul
from .._xla import call
from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 0.5
solver = cfjax.Projected(diffrax.Dopri8())

Links = Complex[Array | np.ndarray, "d *sides 3 3"]


def y0(side: int = 4, seed: int = 0, dimensions: int = 4) -> Complex[np.ndarray, "d *sides 3 3"]:
    """Links in random directions, a lattice at strong coupling."""
    shape = (dimensions, *[side] * dimensions, 3, 3)
    real, imaginary = np.random.default_rng(seed).normal(size=(2, *shape))
    # The unitary part of a normal matrix is uniform once its phases are taken out.
    q, r = np.linalg.qr(real + 1j * imaginary)
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    q = q * (diagonal / np.abs(diagonal))[..., None, :]
    return q / np.linalg.det(q)[..., None, None] ** (1 / 3)


def field(t: Any, y: Links, args: Any = None) -> cfjax.LeftMatrix:
    """The frozen field, with `a` of shape `(d, *sides, 3, 3)`."""
    return cfjax.LeftMatrix(generator(y))


def generator(y: Links) -> Complex[Array, "d *sides 3 3"]:
    """Z: minus the gradient of the action, in su(3)."""
    d = y.shape[0]
    links = [_apart(y[mu]) for mu in range(d)]
    ahead = {(mu, nu): _moved(links[mu], -1, nu) for mu in range(d) for nu in range(d) if mu != nu}
    # What closes a link to squares, on both sides in each other direction.
    staples: list[list[_Matrices]] = [[] for _ in range(d)]
    for mu in range(d):
        for nu in range(mu + 1, d):
            # The two ways to the opposite corner, backwards.
            first = _dagger(_product(links[mu], ahead[nu, mu]))
            second = _dagger(_product(links[nu], ahead[mu, nu]))
            staples[mu].append(_product(ahead[nu, mu], second))
            staples[nu].append(_product(ahead[mu, nu], first))
            staples[mu].append(_moved(_product(first, links[nu]), 1, nu))
            staples[nu].append(_moved(_product(second, links[mu]), 1, mu))
    sums = [tuple(map(sum, zip(*each, strict=True))) for each in staples]
    return jnp.stack([_together(_force(_product(links[mu], sums[mu]))) for mu in range(d)])


def velocity(t: Any, y: Links, args: Any = None) -> Complex[Array, "d *sides 3 3"]:
    """The same field in plain space, where no method keeps links unitary."""
    z = generator(y)
    return jnp.sum(z[..., :, :, None] * y[..., None, :, :], axis=-2)


def plaquettes(y: Links, mu: int, nu: int) -> Complex[Array, "*sides 3 3"]:
    """The product of links around the square that leaves each point along `mu`, then `nu`."""
    there = matmul(y[mu], _ahead(y[nu], mu))
    back = matmul(y[nu], _ahead(y[mu], nu))
    return matmul(there, jnp.conj(jnp.swapaxes(back, -1, -2)))


def density(y: Links) -> Float[Array, "*sides"]:
    """The action of each point: `Re tr(1 - P)` of the squares that leave it."""
    d = y.shape[0]
    traces = (
        jnp.real(jnp.trace(plaquettes(y, mu, nu), axis1=-2, axis2=-1))
        for mu in range(d)
        for nu in range(mu + 1, d)
    )
    return sum((3 - trace for trace in traces), jnp.zeros(y.shape[1:-2], jnp.finfo(y.dtype).dtype))


def action(y: Links) -> Float[Array, ""]:
    """The action S."""
    return jnp.sum(density(y))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0())


def invariants(y: Links, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    eye = np.broadcast_to(np.eye(3, dtype=y.dtype), y.shape)
    defect = matmul(jnp.conj(jnp.swapaxes(y, -1, -2)), y) - eye
    return {
        "action (falls)": action(y),
        "distance of each link from unitary": jnp.linalg.norm(defect, axis=(-2, -1)),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The Wilson flow of 4^4 links of SU(3), 5 to 80 equal steps; Tsit5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF3(), cfjax.CF4(), cfjax.Luscher3(), cfjax.CK34(), cfjax.CK54())
        | by_name(*PROJECTED)
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1, y0()),
        num_steps=[5 * 2**k for k in range(5)],
        **options,
    )


def reference(
    t: float, start: Complex[np.ndarray, "d *sides 3 3"]
) -> Complex[np.ndarray, "d *sides 3 3"]:
    """The links at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-12."""
    d = len(start)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        out = np.empty_like(y)
        for mu in range(d):
            total = np.zeros_like(y[mu])
            for nu in set(range(d)) - {mu}:
                ahead, side = np.roll(y[nu], -1, mu), np.roll(y[mu], -1, nu)
                total += np.einsum("...ij,...kj,...lk->...il", ahead, side.conj(), y[nu].conj())
                behind, across = np.roll(y[nu], 1, nu), np.roll(y[mu], 1, nu)
                corner = np.roll(behind, -1, mu)
                total += np.einsum("...ji,...kj,...kl->...il", corner.conj(), across.conj(), behind)
            loop = y[mu] @ total
            z = (loop.conj().swapaxes(-1, -2) - loop) / 2
            z = z - np.trace(z, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3
            out[mu] = z @ y[mu]
        return out

    return by_dop853(rate, start, t, rtol=1e-12, atol=1e-12)


def picture(side: int = 8) -> figures.Figure:
    """A slice of a larger lattice: where the action is, as it flows away, to t = 3."""
    # The links at t = 0, 0.1, 0.2, ...
    steps = dict(num_steps=60, save_every=2, save_initial=True)
    times, ys = solve(problem(), solver, t1=3.0, y0=y0(side), **steps)
    shots = (0, 1, 3, 10, 30)
    figure = figures.new(2.2 * len(shots), 3.1)
    for ax, k in zip(figure.subplots(1, len(shots)), shots, strict=True):
        t, values = times[k], np.asarray(density(jnp.asarray(ys[k])))
        ax.imshow(values[:, :, 0, 0], interpolation="bicubic", vmin=0, cmap="magma")
        ax.set(xticks=[], yticks=[], title=f"t = {t:g}, mean {values.mean():.2g}")
        figure.colorbar(ax.images[0], ax=ax, location="bottom", label="action of a point")
    return figure


# Matrices as real and imaginary parts with the entries in front, (3, 3, *sides): loops over sites
# become vector instructions.
_Matrices = tuple[Array, Array]


@call
def _apart(x: Complex[Array, "*sides 3 3"]) -> _Matrices:
    return jnp.moveaxis(x.real, (-2, -1), (0, 1)), jnp.moveaxis(x.imag, (-2, -1), (0, 1))


def _together(x: _Matrices) -> Complex[Array, "*sides 3 3"]:
    return jnp.moveaxis(lax.complex(*x), (0, 1), (-2, -1))


@call
def _product(x: _Matrices, y: _Matrices) -> _Matrices:
    # Written out: XLA makes no vector instructions of a sum over an axis.
    def real(x: Array, y: Array) -> Array:
        first, second, third = (x[:, k, None] * y[None, k] for k in range(3))
        return first + second + third

    return real(x[0], y[0]) - real(x[1], y[1]), real(x[0], y[1]) + real(x[1], y[0])


def _moved(x: _Matrices, steps: int, axis: int) -> _Matrices:
    """Along a lattice axis."""
    return jnp.roll(x[0], steps, axis + 2), jnp.roll(x[1], steps, axis + 2)


def _dagger(x: _Matrices) -> _Matrices:
    return x[0].swapaxes(0, 1), -x[1].swapaxes(0, 1)


def _force(loops: _Matrices) -> _Matrices:
    """The part in su(3) of minus the loops."""
    real, imaginary = ((back - x) / 2 for back, x in zip(_dagger(loops), loops, strict=True))
    trace = (imaginary[0, 0] + imaginary[1, 1] + imaginary[2, 2]) / 3
    eye = jnp.eye(3, dtype=trace.dtype).reshape(3, 3, *[1] * trace.ndim)
    return real, imaginary - trace[None, None] * eye


def _ahead(x: Array, axis: int) -> Array:
    """The neighbours' values along a lattice axis."""
    return jnp.roll(x, -1, axis)
