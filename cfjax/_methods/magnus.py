"""Commutator-free Magnus methods, for fields that depend on t but not on y: their coefficients.

A step of length h from t is

    y_1 = exp(h sum_k rows[J][k] A(t + c_k h)) ... exp(h sum_k rows[0][k] A(t + c_k h)) y_0

with the nodes c_k. Row j stands for a linear functional of `A(t + theta h)`, as a function of theta
in [0, 1]. It is stored here as its values on the shifted Legendre polynomials, `P_n(2 theta - 1)`:
row 0 comes first, values left out are zero. On K nodes it is applied to the polynomial of degree
K - 1 through the values there. That keeps a method's order p where quadrature on the nodes is of
order p.

Within a step the solution at `t + theta h` is that of a step of this length which has the same
polynomial. So every functional goes to `theta^(m+1)` times its value on the m-th power, which makes
an output of uniform order min(p, K).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from typing import TypeAlias

from .coefficients import ContinuousExtension, Product

# Values of linear functionals on Legendre polynomials, by flow and degree.
Functionals: TypeAlias = Sequence[Sequence[Decimal]]

_DIGITS = 50


@dataclass(frozen=True)
class MagnusTableau:
    """Coefficients of a commutator-free Magnus method.

    - `order`, and `embedded_order` of the embedded method, if there is one;
    - `nodes`: where a step evaluates the field, in units of the step;
    - `rows[j][k]`: for flow j, the first applied first, the coefficient of the field at node k;
    - `embedded[j][k]`: the same for another end point, to estimate the error;
    - `continuous_extension`: as that of a `Tableau`.
    """

    order: int
    nodes: tuple[float, ...]
    rows: Product
    continuous_extension: ContinuousExtension
    embedded: Product | None = None
    embedded_order: int | None = None

    @property
    def shares_ends(self) -> bool:
        """Whether the last evaluation of a step is the first one of the next."""
        return self.nodes[0] == 0 and self.nodes[-1] == 1

    @property
    def is_symmetric(self) -> bool:
        """Whether a step backwards in time undoes one forwards: the flows are a palindrome."""
        mirrored = tuple(tuple(reversed(row)) for row in reversed(self.rows))
        return mirrored == self.rows and all(
            a + b == 1 for a, b in zip(self.nodes, reversed(self.nodes), strict=True)
        )

    @classmethod
    def of(
        cls,
        order: int,
        nodes: Sequence[Decimal],
        functionals: Functionals,
        embedded: Functionals | None = None,
        embedded_order: int | None = None,
    ) -> "MagnusTableau":
        with localcontext(prec=_DIGITS):
            extension = _continuous_extension(functionals, nodes)
            rows = _ends(extension)
            embedded_rows = _ends(_continuous_extension(embedded or (), nodes)) or None
        return cls(
            order,
            tuple(map(float, nodes)),
            rows,
            tuple(tuple(tuple(map(float, row)) for row in powers) for powers in extension),
            embedded_rows,
            embedded_order,
        )


def _continuous_extension(
    functionals: Functionals, nodes: Sequence[Decimal]
) -> list[list[list[Decimal]]]:
    """By flow, power of theta and node."""
    basis = _lagrange(nodes)
    size = len(nodes)
    return [
        [[_moment(values, m) * basis[k][m] for k in range(size)] for m in range(size)]
        for values in functionals
    ]


def _ends(extension: list[list[list[Decimal]]]) -> Product:
    """The rows at theta = 1, rounded once."""
    return tuple(
        tuple(float(sum(column)) for column in zip(*powers, strict=True)) for powers in extension
    )


def _moment(values: Sequence[Decimal], m: int) -> Decimal:
    """The value on `theta^m = sum_n (2 n + 1) m!^2 / ((m - n)! (m + n + 1)!) P_n(2 theta - 1)`."""
    total = Decimal(0)
    for n, value in enumerate(values[: m + 1]):
        denominator = math.factorial(m - n) * math.factorial(m + n + 1)
        total += value * (2 * n + 1) * math.factorial(m) ** 2 / denominator
    return total


def _lagrange(nodes: Sequence[Decimal]) -> list[list[Decimal]]:
    """The polynomials that are one at one node and zero at the others, by node and power."""
    basis = []
    for k, node in enumerate(nodes):
        powers = [Decimal(1)]
        for j, root in enumerate(nodes):
            if j != k:
                shifted = zip([*powers, 0], [0, *powers], strict=True)
                powers = [(b - root * a) / (node - root) for a, b in shifted]
        basis.append(powers)
    return basis


def _symmetric(nodes: Sequence[str]) -> list[Decimal]:
    """All nodes, from those up to the middle."""
    first_half = [Decimal(c) for c in nodes]
    with localcontext(prec=_DIGITS):
        return first_half + [1 - c for c in reversed(first_half) if 2 * c != 1]


def _decimals(rows: Sequence[Sequence[str]]) -> list[list[Decimal]]:
    return [[Decimal(value) for value in row] for row in rows]


def _palindrome(rows: Sequence[Sequence[str]], num_rows: int) -> list[list[Decimal]]:
    """All rows of a symmetric method, from those up to the middle."""
    first_half = _decimals(rows)
    mirrored = [[-v if n % 2 else v for n, v in enumerate(row)] for row in reversed(first_half)]
    return first_half + mirrored[2 * len(first_half) - num_rows :]


_MIDPOINT = [Decimal("0.5")]
_GAUSS_3 = _symmetric(["0.1127016653792583114820734600217600389167", "0.5"])
# Both ends, and the zeros of the derivative of a Legendre polynomial.
_LOBATTO_3 = _symmetric(["0", "0.5"])
_LOBATTO_5 = _symmetric(["0", "0.1726731646460114281008537718765708222154", "0.5"])
_LOBATTO_7 = _symmetric(
    [
        "0",
        "0.08488805186071653506398389301626743020641",
        "0.2655756032646428930981140590456168352972",
        "0.5",
    ]
)
_LOBATTO_9 = _symmetric(
    [
        "0",
        "0.05012100229426992134382737779083102097426",
        "0.1614068602446311232770572864543287746445",
        "0.3184412680869109206446239656456703934897",
        "0.5",
    ]
)

# The exponential midpoint rule.
MAGNUS2 = MagnusTableau.of(2, _MIDPOINT, _decimals([["1"]]))

# The same numbers as CF4's. Embedded: the midpoint rule.
with localcontext(prec=_DIGITS):
    _third = Decimal(1) / 3
MAGNUS4_LOBATTO = MagnusTableau.of(
    4,
    _LOBATTO_3,
    [[Decimal("0.5"), -_third], [Decimal("0.5"), _third]],
    _decimals([["1", "0", "-0.5"]]),
    2,
)

_MAGNUS4 = (
    ("0.275", "-0.229885057471264367816092", "0.14"),
    ("0.45", "0", "-0.28"),
)
# Embedded: the remaining weights, except for a part that detects the error of the quadrature.
_magnus4 = _palindrome(_MAGNUS4, 3)
MAGNUS4 = MagnusTableau.of(
    4,
    _GAUSS_3,
    _magnus4,
    [_magnus4[0], [Decimal("0.725"), -_magnus4[0][1], Decimal("0.01")]],
    2,
)

_MAGNUS6 = (
    ("0.16625", "-0.150379011269976853917648", "0.118637033809930561752943", "-0.0705"),
    (
        "0.380575893676728687195212",
        "-0.14389925806305365868126",
        "-0.129609763456426645996293",
        "0.204860357511315285881413",
    ),
    ("-0.093651787353457374390425", "0", "0.0219454592929921684867", "0"),
)
_MAGNUS6_EMBEDDED = (
    (
        "0.441825276633664282895552",
        "-0.139745815663090899047649",
        "-0.205162067876462386439937",
        "0.093131852476969513561776",
    ),
    (
        "0.391924723366335717104448",
        "0.290124826933067752965297",
        "0.086525034066531824686994",
        "-0.022631852476969513576176",
        "0.25",
    ),
)
_magnus6 = _palindrome(_MAGNUS6, 5)
MAGNUS6 = MagnusTableau.of(6, _LOBATTO_5, _magnus6, [_magnus6[0], *_decimals(_MAGNUS6_EMBEDDED)], 4)

# The embedded method of higher orders: with the sixth Legendre polynomial in its last row. Without,
# all would have the same weights, and fields that commute no error.
_order_6 = [*_magnus6[:-1], [*_magnus6[-1], Decimal(0), Decimal(0), Decimal("0.25")]]

_MAGNUS8 = (
    (
        "0.168086090929995724678725",
        "-0.151277481836996152210852",
        "0.117660263650997007275107",
        "-0.06723443637199828987149",
    ),
    (
        "0.359366420581440774721484",
        "-0.131383069919073315812558",
        "-0.130901348254126300328284",
        "0.202898756921778178511026",
    ),
    (
        "0.40827036864282357822467",
        "0.232755493657637405185505",
        "-0.085790834074322529017897",
        "-0.333879397325709438250496",
    ),
    (
        "-0.435722880154260077624878",
        "-0.245547960632803984698691",
        "0.099031918677451822071074",
        "0.368321940949205977048036",
    ),
)
MAGNUS8 = MagnusTableau.of(8, _LOBATTO_7, _palindrome(_MAGNUS8, 8), _order_6, 6)

_MAGNUS10 = (
    (
        "0.111814721451399913548621",
        "-0.104729747096658098638341",
        "0.090559798387174468817783",
        "-0.069304875322949024086945",
        "0.040964977903981764445828",
    ),
    (
        "0.257632709351801963570658",
        "-0.15025103426494349573734",
        "-0.00342313020804359670474",
        "0.115364764079799377609431",
        "-0.123623245348970611320335",
    ),
    (
        "0.55323169794052666650954",
        "0.088322120251897856851583",
        "-0.329266770486529981816671",
        "-0.158583900635206190462465",
        "0.288220534423302707294917",
    ),
    (
        "-0.307471478595354910632109",
        "-0.050946722227920955160187",
        "0.178281550496094868974447",
        "0.080959032671230755303871",
        "-0.164371601945694328031427",
    ),
    (
        "0.130179339519867057734121",
        "-0.041456419048189952145634",
        "-0.119048908299226759102062",
        "0.035166715203347262192631",
        "0.118087585719825628190343",
    ),
    (
        "-0.312166335211099609295236",
        "0.056002893666530104888193",
        "0.221564718695670494171475",
        "-0.097630993023303101972147",
        "-0.195619463883541754322879",
    ),
    (
        "-0.262347186761551229985945",
        "-0.041175002178743744876273",
        "0.221560611016186696043087",
        "0.038505372807395119520074",
        "-0.182316575897406125105304",
    ),
    (
        "0.329126532304410148550349",
        "0.042677591397498839121983",
        "-0.260227869601326190383318",
        "-0.064016387096248258682975",
        "0.218657789028502718848858",
    ),
)
MAGNUS10 = MagnusTableau.of(10, _LOBATTO_9, _palindrome(_MAGNUS10, 16), _order_6, 6)
