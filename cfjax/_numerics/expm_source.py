"""The exponential of a dense matrix together with the integral of a source under congruences."""

from jaxtyping import Array, Inexact

from .expm import TAYLOR_SCHEMES, by_norm, in_full_register, taylor_from_second
from .matmul import plus_identity, small_product

# The k-th term of the backward error in the source has a factor k, so norms must be smaller.
# tests/numerics/test_expm_source.py derives it.
_SMALLER = 0.83

# Block matrices `[[a, q], [0, b^H]]`.
_Blocks = tuple[Array, Array, Array]


def expm_parts_with_source(
    a: Inexact[Array, "n n"], q: Inexact[Array, "n n"]
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"], Inexact[Array, "n n"]]:
    """exp(a) as `expm_parts` returns it, and `g`, the integral of `exp(s a) q exp(s a)^H` over s
    from 0 to 1.

    **Cost:** 16 products of size n for norms up to 0.56, 19 beyond (16 in single precision), and 3
    for each squaring: half the cost of an exponential of size 2 n. `g` is as definite as `q`, up to
    rounding relative to `q`. Intermediate results grow only if exp(a) does.

    For a small multiple of a, g comes from
    exp([[a, q], [0, -a^H]]) = [[exp(a), g exp(-a^H)], [0, exp(-a^H)]]. Then
    `g(2 t) = g(t) + exp(t a) g(t) exp(t a)^H`.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automat.
    Contr. 23 (1978), doi:10.1109/TAC.1978.1101743.
    """
    schemes = TAYLOR_SCHEMES[a.dtype.name]

    def approximate(
        k: int, first: tuple[Array, Array], second: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        (a, q), (a2, aq) = first, second
        blocks = (a, q, -a), (a2, aq, a2)
        remainder, source, _ = taylor_from_second(schemes[k], *blocks, _block_product)
        return remainder, small_product(q + source, _adjoint(plus_identity(remainder + a)))

    n = a.shape[0]
    a, q = in_full_register(a), in_full_register(q)
    second = small_product(a, a), small_product(a, q) - small_product(q, _adjoint(a))
    thetas = [_SMALLER * scheme.theta for scheme in schemes]
    weight, (remainder, g) = by_norm(
        thetas,
        (a, q),
        second,
        approximate,
        lambda first, value: (plus_identity(value[0] + first[0]), value[1]),
        _doubled,
    )
    return weight, remainder[:n, :n], g[:n, :n]


def _block_product(x: _Blocks, y: _Blocks) -> _Blocks:
    source = small_product(x[0], y[1]) + small_product(x[1], _adjoint(y[2]))
    return small_product(x[0], y[0]), source, small_product(x[2], y[2])


def _doubled(x: tuple[Array, Array]) -> tuple[Array, Array]:
    e, g = x
    return small_product(e, e), g + small_product(small_product(e, g), _adjoint(e))


def _adjoint(a: Array) -> Array:
    return a.conj().T
