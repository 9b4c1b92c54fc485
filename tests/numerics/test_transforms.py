"""Transforms: against scipy, the operators they make diagonal, derivatives, and what is refused."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
from xla.interpreter import run

import cfjax

# Up to here a product with a dense matrix, as the docstrings say.
MAX_DENSE = 160
# The dense path, both sides of the switch, and a prime number of intervals, 251.
SIZES = [1, 2, 8, 99, MAX_DENSE, MAX_DENSE + 1, 250, 1023, 1024]


def transform(kind, n):
    return {
        "sine": cfjax.SineTransform,
        "cosine": cfjax.CosineTransform,
        "Fourier": cfjax.FourierTransform,
        "real Fourier": lambda: cfjax.RealFourierTransform(n),
    }[kind]()


SCIPY = {
    "sine": lambda x: np.asarray(scipy.fft.dst(x, type=1, norm="ortho", axis=0)),
    "cosine": lambda x: np.asarray(scipy.fft.dct(x, type=2, norm="ortho", axis=0)),
    "Fourier": lambda x: np.asarray(scipy.fft.fft(x, norm="ortho", axis=0)),
    "real Fourier": lambda x: np.asarray(scipy.fft.rfft(x, norm="ortho", axis=0)),
}
kinds = pytest.mark.parametrize("kind", SCIPY)


def point(kind, shape, seed=1):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(shape)
    return x + 1j * rng.standard_normal(shape) if kind == "Fourier" else x


def close(found, wanted, n):
    """A dense product adds n terms and a fast one log n, of entries of size one."""
    eps = np.finfo(np.asarray(found).dtype).eps
    np.testing.assert_allclose(found, wanted, rtol=0, atol=4 * eps * np.sqrt(n) * np.log2(n + 2))


@pytest.mark.representatives(5)
@kinds
@pytest.mark.parametrize("n", SIZES)
def test_against_scipy_and_back(kind, n):
    """Alone, and with columns in batches."""
    t, x = transform(kind, n), point(kind, (n, 3, 2))

    def everything(x):
        alone, found = t.forward(x[:, 0, 0]), t.forward(x)
        batch = jax.vmap(jax.vmap(t.forward))(x.transpose(1, 2, 0)).transpose(2, 0, 1)
        return found, batch, t.inverse(found), alone, t.inverse(alone)

    found, batch, back, alone, back_alone = run(everything, x)
    want = SCIPY[kind](x)
    for got in (found, batch):
        close(got, want, n)
    close(back, x, n)
    close(alone, want[:, 0, 0], n)
    close(back_alone, x[:, 0, 0], n)


@kinds
def test_float32(kind):
    n = 200 if kind in ("sine", "real Fourier") else 6
    t, x = transform(kind, n), point(kind, (n,))
    single = jnp.asarray(x, jnp.complex64 if kind == "Fourier" else jnp.float32)
    c, back = run(lambda x: (c := t.forward(x), t.inverse(c)), single)
    assert c.dtype == (jnp.complex64 if "Fourier" in kind else jnp.float32)
    close(c, SCIPY[kind](x), n)
    assert back.dtype == single.dtype


@pytest.mark.parametrize("kind", ["sine", "cosine"])
@pytest.mark.parametrize("n", [7, 180])
def test_complex_points(kind, n):
    t, x = transform(kind, n), point("Fourier", (n,))
    c, back = run(lambda x: (c := t.forward(x), t.inverse(c)), x)
    close(c, SCIPY[kind](x.real) + 1j * SCIPY[kind](x.imag), n)
    close(back, x, n)


@pytest.mark.parametrize("kind", ["sine", "cosine"])
def test_a_dense_product_up_to_so_many_points(kind):
    def program(n):
        return str(jax.make_jaxpr(transform(kind, n).forward)(jnp.ones(n)))

    assert "dot_general" in program(MAX_DENSE) and "fft" not in program(MAX_DENSE)
    assert "fft" in program(MAX_DENSE + 1) and "dot_general" not in program(MAX_DENSE + 1)


@pytest.mark.representatives(4)
@kinds
@pytest.mark.parametrize("n", [4, 5, 170])
def test_transpose_and_derivative(kind, n):
    """The transpose of a map L by its definition, and its derivative, which is L itself."""
    t, x, dx = transform(kind, n), point(kind, (n,), 1), point(kind, (n,), 2)
    check_derivatives(t, x, dx, n, n)


def check_derivatives(t, x, dx, n, size):
    def everything(x, dx):
        (c, dc), changed = jax.jvp(t.forward, (x,), (dx,)), t.forward(dx)
        g = point("Fourier", c.shape, 3)
        g = jnp.asarray(g if jnp.iscomplexobj(c) else g.real)
        pulled = *jax.vjp(t.forward, x)[1](g), *jax.vjp(t.inverse, c)[1](x)
        return dc, changed, g, pulled

    dc, changed, g, (of_forward, of_inverse) = run(everything, x, dx)
    close(dc, changed, n)
    # JAX pairs complex numbers by the real part of their product, without a conjugate.
    close(np.sum(g * dc).real, np.sum(of_forward * dx).real, size)
    close(np.sum(x * dx).real, np.sum(of_inverse * dc).real, size)


def second_difference(kind, n):
    """The operator of the docstring, dense. On one or two periodic points neighbours coincide."""
    eye = np.eye(n)
    if "Fourier" in kind:
        return np.roll(eye, 1, axis=0) + np.roll(eye, -1, axis=0) - 2 * eye
    a = np.eye(n, k=1) + np.eye(n, k=-1) - 2 * eye
    if kind == "cosine":
        a[0, 0] += 1
        a[-1, -1] += 1
    return a


def scaled(factors, c):
    return factors.astype(c.dtype) * c


@kinds
def test_eigenvalues_of_the_second_difference(kind, subtests):
    for n in (1, 2, 5, 6, 161):
        t, x = transform(kind, n), point(kind, (n,))
        eigenvalues = t.second_difference(n)
        found = run(lambda x, t=t, e=eigenvalues: t.inverse(scaled(e, t.forward(x))), x)
        with subtests.test(n=str(n)):
            close(found, second_difference(kind, n) @ x, n)
            # What np.int64 counts is counted all the same.
            np.testing.assert_array_equal(t.second_difference(np.int64(n)), eigenvalues)


# Tensor products.

PAIRS = [(a, b) for a in SCIPY for b in SCIPY if (a, b) != ("real Fourier",) * 2]
# Small grids, and beyond the dense limit along either axis, for the kinds that have one.
LARGE = {(MAX_DENSE + 2, 3): 0, (3, MAX_DENSE + 1): 1}
GRIDS = [(pair, (4, 5)) for pair in PAIRS] + [
    (pair, shape)
    for shape, axis in LARGE.items()
    for pair in PAIRS
    if pair[axis] in ("sine", "cosine")
]


def on_grid(grid_kinds, shape, seed=1):
    """The product of transforms and a point on the grid, complex where no transform takes real."""
    axes = zip(grid_kinds, shape, strict=False)
    t = cfjax.TensorTransform([kind and transform(kind, n) for kind, n in axes])
    is_complex = "Fourier" in grid_kinds and "real Fourier" not in grid_kinds
    return t, point("Fourier" if is_complex else "real", shape, seed)


def scipy_on_grid(grid_kinds, x: Any):
    """SciPy's transforms along the axes: those of real points first, and of complex ones last."""
    order = ("sine", "cosine", "real Fourier", "Fourier")
    for kind in order:
        for axis in [k for k, found in enumerate(grid_kinds) if found == kind]:
            x = np.moveaxis(x, axis, 0)
            by_parts = kind in order[:2] and np.iscomplexobj(x)
            x = SCIPY[kind](x.real) + 1j * SCIPY[kind](x.imag) if by_parts else SCIPY[kind](x)
            x = np.moveaxis(x, 0, axis)
    return x


@pytest.mark.representatives(4)
@pytest.mark.parametrize("pair, shape", GRIDS)
def test_grids_against_scipy_and_back(pair, shape):
    t, x = on_grid(pair, shape)
    c, back = run(lambda x: (c := t.forward(x), t.inverse(c)), x)
    wanted = scipy_on_grid(pair, x)
    assert c.shape == wanted.shape and c.dtype == wanted.dtype
    close(c, wanted, max(shape))
    assert back.dtype == x.dtype
    close(back, x, max(shape))


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "three",
    [
        ("Fourier", "real Fourier", "sine"),
        ("cosine", "Fourier", "real Fourier"),
        (None, "sine", "cosine"),
        ("sine", None, "real Fourier"),
    ],
)
def test_three_axes_and_columns(three):
    shape = (3, 4, 5, 2)
    t, x = on_grid(three, shape)
    in_batches = jax.vmap(t.forward, in_axes=-1, out_axes=-1)
    c, back, batch = run(lambda x: (c := t.forward(x), t.inverse(c), in_batches(x)), x)
    close(c, scipy_on_grid(three, x), 5)
    close(back, x, 5)
    close(batch, c, 5)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("pair", [("sine", "real Fourier"), ("Fourier", "cosine")])
def test_transpose_and_derivative_on_grids(pair):
    """The transpose of a map L by its definition, and its derivative, which is L itself."""
    t, x = on_grid(pair, (4, 5))
    check_derivatives(t, x, on_grid(pair, (4, 5), 2)[1], 5, 20)


def test_float32_on_grids():
    pair = ("cosine", "real Fourier")
    t, x = on_grid(pair, (6, 5))
    c, back = run(lambda x: (c := t.forward(x), t.inverse(c)), x.astype(np.float32))
    assert c.dtype == jnp.complex64 and back.dtype == jnp.float32
    close(c, scipy_on_grid(pair, x), 6)


# What is refused.


def test_wrong_number_of_points(no_shape_hook):
    for n in (0, -1, 2.0, True, None):
        for call in (cfjax.RealFourierTransform, cfjax.SineTransform().second_difference):
            with pytest.raises(ValueError, match="n must be an integer of at least 1, got"):
                call(n)
    t = cfjax.RealFourierTransform(np.int64(4))
    assert t == cfjax.RealFourierTransform(4) and type(t.n) is int


def test_wrong_arrays_and_transforms(no_shape_hook, subtests):
    sine, cosine, fourier = cfjax.SineTransform(), cfjax.CosineTransform(), cfjax.FourierTransform()
    real, four, six = cfjax.RealFourierTransform, *map(cfjax.RealFourierTransform, (4, 6))
    tensor: Any = cfjax.TensorTransform
    of_four, of_six = (rf"RealFourierTransform\({n}\) " for n in (4, 6))
    ones, first = jnp.ones, "Transform needs points along the first axis, got shape"
    values = (
        (lambda: four.forward(ones(5)), of_four + "got a point of length 5, expected 4"),
        # irfft would fill up with zeros.
        (
            lambda: six.inverse(ones(3, complex)),
            of_six + "got coefficients of length 3, expected 4",
        ),
        (lambda: six.second_difference(5), of_six + "got points of length 5, expected 6"),
        (lambda: cosine.forward(ones(())), rf"Cosine{first} \(\)"),
        (lambda: fourier.forward(ones((0, 2), complex)), rf"Fourier{first} \(0, 2\)"),
        (
            lambda: tensor([real(4)] * 2),
            "transforms must hold at most one RealFourierTransform, .* got .*n=4",
        ),
        (
            lambda: tensor([sine] * 3).forward(ones((4, 5))),
            r"TensorTransform of 3 axes got an array of shape \(4, 5\)",
        ),
        (
            lambda: tensor([None, sine]).inverse(ones(4)),
            r"TensorTransform of 2 axes got an array of shape \(4,\)",
        ),
    )
    takes = "FourierTransform takes complex arrays, got float64"
    types = (
        # The matrix in integers would be zero.
        (
            lambda: sine.forward(jnp.arange(4)),
            "SineTransform takes arrays of float32, .*, got int64",
        ),
        (
            lambda: cosine.inverse(ones(4, jnp.float16)),
            "CosineTransform takes arrays of .*, got float16",
        ),
        (lambda: fourier.forward(ones(4)), f"{takes}. Real points take"),
        (lambda: four.forward(ones(4, complex)), of_four + "takes real points, got complex128"),
        (
            lambda: tensor(sine),
            r"transforms must be a sequence of transforms, got SineTransform\(\)",
        ),
        (
            lambda: tensor((sine, "sine")),
            "transforms must hold cfjax.AbstractTransform or None, got 'sine'",
        ),
        (
            lambda: tensor((tensor(()),)),
            "transforms must be of one axis each, got a TensorTransform",
        ),
        (lambda: tensor([sine, fourier]).forward(ones((4, 5))), takes),
    )
    for error, cases in ((ValueError, values), (TypeError, types)):
        for call, message in cases:
            with subtests.test(case=message), pytest.raises(error, match=message):
                call()
