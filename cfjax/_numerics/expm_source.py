"""The exponential of a dense matrix, and what a constant source adds to a congruence by it."""

from jaxtyping import Array, Inexact

from .expm import TAYLOR_SCHEMES, by_norm, in_full_register, taylor_from_second
from .matmul import plus_identity, small_product

# The backward error in the source has a factor k in its k-th term, so norms must be smaller.
# tests/numerics/test_expm_source.py derives it.
_SMALLER = 0.83

# Block matrices `[[a, q], [0, b^H]]`.
_Blocks = tuple[Array, Array, Array]


def expm_parts_with_source(
    a: Inexact[Array, "n n"], q: Inexact[Array, "n n"]
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"], Inexact[Array, "n n"]]:
    """`weight, rest, g`: exp(a) as `expm_parts` has it, and `g`, the integral over s from 0 to 1 of
    `exp(s a) q exp(s a)^H`.

    **Cost:** 16 products of size n for norms up to 0.56, 19 beyond (16 in single precision), and 3
    for each squaring: half of what an exponential of size 2 n costs. `g` is as definite as `q`, to
    rounding relative to `q`. Nothing grows where exp(a) does not.

    exp([[a, q], [0, -a^H]]) = [[exp(a), g exp(-a^H)], [0, exp(-a^H)]], for a small multiple of a.
    Then `g(2 t) = g(t) + exp(t a) g(t) exp(t a)^H`.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automat.
    Contr. 23 (1978), doi:10.1109/TAC.1978.1101743.
    """
    schemes = TAYLOR_SCHEMES[a.dtype.name]

    def approximate(
        k: int, first: tuple[Array, Array], second: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        (a, q), (a2, aq) = first, second
        rest, source, _ = taylor_from_second(schemes[k], (a, q, -a), (a2, aq, a2), _block_product)
        return rest, small_product(q + source, _adjoint(plus_identity(rest + a)))

    n = a.shape[0]
    a, q = in_full_register(a), in_full_register(q)
    second = small_product(a, a), small_product(a, q) - small_product(q, _adjoint(a))
    thetas = [_SMALLER * scheme.theta for scheme in schemes]
    weight, (rest, g) = by_norm(
        thetas,
        (a, q),
        second,
        approximate,
        lambda first, small: (plus_identity(small[0] + first[0]), small[1]),
        _doubled,
    )
    return weight, rest[:n, :n], g[:n, :n]


def _block_product(x: _Blocks, y: _Blocks) -> _Blocks:
    source = small_product(x[0], y[1]) + small_product(x[1], _adjoint(y[2]))
    return small_product(x[0], y[0]), source, small_product(x[2], y[2])


def _doubled(x: tuple[Array, Array]) -> tuple[Array, Array]:
    e, g = x
    return small_product(e, e), g + small_product(small_product(e, g), _adjoint(e))


def _adjoint(a: Array) -> Array:
    return a.conj().T
