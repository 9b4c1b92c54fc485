"""Tableaus of commutator-free Lie group methods: plain data, checked when constructed."""

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, partial
from typing import Any

from .coefficients import (
    ContinuousExtension,
    Product,
    Row,
    checked_coefficient,
    checked_end,
    checked_entries,
    checked_extension,
    checked_product,
    rounded_sum,
)


@dataclass(frozen=True, init=False, repr=False)
class Tableau:
    """Coefficients of an explicit commutator-free method with `s` stages.

    In the notation of Celledoni, Marthinsen & Owren (2003), Algorithm 2.1, but counting from 0,
    a step from `p` is

        Y_r = exp(sum_k alpha[r][J][k] F_k) ... exp(sum_k alpha[r][0][k] F_k) p,  r = 0..s-1,
        F_r = h f(t + c_r h, Y_r),
        y_1 = exp(sum_k beta[J][k] F_k) ... exp(sum_k beta[0][k] F_k) p.

    `alpha[r][j][k]` belongs to stage r, flow j (the first applied first) and field F_k;
    `beta[j][k]` is the same for the end point.

    **Arguments:** nested sequences (lists, tuples, arrays) of int, `Fraction` or float. A row may
    leave out trailing zeros. A tableau stores them as nested tuples: every row with one entry for
    each stage, rows of zeros left out (the flow of zero is the identity), integers as `Fraction`.

    A tableau is compared and hashed by value, so it can be static in a jitted function.

    Two more products are optional. Both may use one more field, `F_s = h f(t + h, y_1)`, with which
    the next step starts (first same as last).

    - `embedded[j][k]`: another end point, of an order lower by one, to estimate the error.
    - `continuous_extension[j][i][k]`: for the solution at `t + theta h`, the coefficient of field
      F_k in flow j is the sum over i of these numbers times `theta^(i+1)`. At theta = 1 it equals
      that of `beta`.

    **Raises:** `TypeError` where the nesting or a coefficient's type is wrong; `ValueError` where
    a row is too long, the method is implicit, a coefficient is not finite, the rows of `beta` or
    `embedded` do not sum to 1, `embedded` is `beta`, or the sums of the rows of
    `continuous_extension` are not those of `beta`.
    """

    alpha: tuple[Product, ...]
    beta: Product
    embedded: Product | None
    continuous_extension: ContinuousExtension | None

    def __init__(
        self,
        alpha: Iterable[Iterable[Iterable[Any]]],
        beta: Iterable[Iterable[Any]],
        embedded: Iterable[Iterable[Any]] | None = None,
        continuous_extension: Iterable[Iterable[Iterable[Any]]] | None = None,
    ) -> None:
        stages = checked_entries("alpha", alpha, "a sequence with one list of flows for each stage")
        if not stages:
            raise ValueError("alpha must have at least one stage, got none.")
        s = len(stages)
        # The only way to set a field of a frozen dataclass; it is never changed after this.
        store = partial(object.__setattr__, self)
        store("alpha", tuple(checked_product(f"alpha[{r}]", p, s, r) for r, p in enumerate(stages)))
        store("beta", checked_end("beta", beta, s))
        if embedded is not None:
            embedded = checked_end("embedded", embedded, s + 1)
            if embedded == checked_end("beta", self.beta, s + 1):
                raise ValueError(
                    "embedded must lead to another end point than beta, got the same coefficients, "
                    "with which the estimate of the error is always zero."
                )
        store("embedded", embedded)
        if continuous_extension is not None:
            continuous_extension = checked_extension(continuous_extension, s + 1, self.beta)
        store("continuous_extension", continuous_extension)

    def __repr__(self) -> str:
        stages = ", ".join(map(_show_product, self.alpha))
        optional = "" if self.embedded is None else f", embedded={_show_product(self.embedded)}"
        if self.continuous_extension is not None:
            flows = ", ".join(map(_show_product, self.continuous_extension))
            optional += f", continuous_extension=[{flows}]"
        return f"Tableau(alpha=[{stages}], beta={_show_product(self.beta)}{optional})"

    def __hash__(self) -> int:
        return self._hash

    # Hashing a Fraction takes a modular inverse, and a static argument is hashed at every call.
    @cached_property
    def _hash(self) -> int:
        return hash((self.alpha, self.beta))

    @property
    def num_stages(self) -> int:
        return len(self.alpha)

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the field in one step: one for each stage.

        Error control of a first-same-as-last method evaluates at the end of a step, and the next
        step does not evaluate at its start: no more in the long run.
        """
        return self.num_stages

    def uses_last(self, rows: Product) -> bool:
        """Whether the rows have a coefficient for the field at the end of the step."""
        return any(any(row[self.num_stages :]) for row in rows)

    @cached_property
    def embedded_method(self) -> "Tableau | None":
        """The embedded method as a method of its own, whose last stage is the end of the step."""
        if self.embedded is None:
            return None
        return Tableau((*self.alpha, self.beta), self.embedded)

    @cached_property
    def c(self) -> Row:
        """Stage times, the sum of all rows of the stage. With floats: rounded once."""
        return tuple(rounded_sum([a for row in rows for a in row]) for rows in self.alpha)

    @cached_property
    def prefixes(self) -> tuple[Product, ...]:
        """The distinct prefixes of the rows of stages and end point, each after its own prefixes.

        Each is one flow: the point after `prefix` is the flow of its last row from the point
        after `prefix[:-1]`. Rows that begin alike share these flows.
        """
        products = (*self.alpha, self.beta)
        beginnings = (rows[: j + 1] for rows in products for j in range(len(rows)))
        return tuple(dict.fromkeys(beginnings))

    @property
    def num_flows(self) -> int:
        """Flows (exponentials) in one step."""
        return len(self.prefixes)

    @property
    def num_embedded_flows(self) -> int:
        """Flows that the embedded method adds to a step."""
        method = self.embedded_method
        return 0 if method is None else method.num_flows - self.num_flows

    @cached_property
    def is_exact(self) -> bool:
        """Whether all coefficients are fractions."""
        rows = (row for rows in (*self.alpha, self.beta) for row in rows)
        return all(isinstance(a, Fraction) for row in rows for a in row)


def _show_product(rows: Product) -> str:
    texts = []
    for row in rows:
        last_nonzero = max((k for k, a in enumerate(row) if a), default=0)
        texts.append("(" + ", ".join(map(str, row[: last_nonzero + 1])) + ")")
    return "[" + ", ".join(texts) + "]"


def crouch_grossman(
    a: Iterable[Iterable[Any]],
    b: Iterable[Any],
    embedded: Iterable[Any] | None = None,
    continuous_extension: Iterable[Iterable[Any]] | None = None,
) -> Tableau:
    """The Crouch-Grossman method of a Runge-Kutta tableau: one flow for each coefficient.

    `a` holds the rows of the stages after the first, `a[i]` with the coefficients of stages
    0..i; `b` holds one weight for each stage, and so does `embedded`. `continuous_extension[k][i]`
    is the coefficient of theta^(i+1) in the weight of stage k. Zero coefficients cost no flow. Its
    order is in general lower than that of the Runge-Kutta method.

    **Raises:** as `Tableau`, naming `alpha` for `a` and `beta` for `b`.
    """

    def one_flow_each(row: Iterable[Any]) -> list[list[Any]]:
        return [[0] * k + [coefficient] for k, coefficient in enumerate(row)]

    return Tableau(
        [[], *map(one_flow_each, a)],
        one_flow_each(b),
        None if embedded is None else one_flow_each(embedded),
        None
        if continuous_extension is None
        else [
            [[0] * k + [power] for power in powers] for k, powers in enumerate(continuous_extension)
        ],
    )


def third_order_a(alpha: int | Fraction | float) -> Tableau:
    """The paper's first family of order 3 with 3 flows: the second stage's flow begins the step.

    The stage times are 0, 1/3 and `alpha`. The result is exact for an int or a Fraction; for a
    float every coefficient is correctly rounded.

    **Raises:** `ValueError` for `alpha` 0 or 1/3, where the weights divide by zero.

    Source: Celledoni, Marthinsen & Owren, FGCS 19 (2003), doi:10.1016/S0167-739X(02)00161-9.
    """
    x = _parameter(alpha, {Fraction(0): "6 alpha", Fraction(1, 3): "3 alpha - 1"})
    third = Fraction(1, 3)
    stages = [[], [[third]], [[x * (2 - 3 * x), x * (3 * x - 1)]]]
    last = [(3 - 5 * x) / (6 * x), 3 * (3 * x - 2) / (2 * (3 * x - 1)), 1 / (2 * x * (3 * x - 1))]
    return _family(alpha, stages, [[third], last])


def third_order_b(alpha: int | Fraction | float) -> Tableau:
    """The paper's second family of order 3 with 3 flows: the third stage's flow begins the step.

    The stage times are 0, 2 (3 alpha^2 - 3 alpha + 1) / (3 (1 - alpha)) and `alpha`. The result
    is exact for an int or a Fraction; for a float every coefficient is correctly rounded.

    **Raises:** `ValueError` for `alpha` 1 or 1/3, where the coefficients divide by zero.

    Source: Celledoni, Marthinsen & Owren, FGCS 19 (2003), doi:10.1016/S0167-739X(02)00161-9.
    """
    x = _parameter(alpha, {Fraction(1): "1 - alpha", Fraction(1, 3): "3 alpha - 1"})
    # Never zero: 3x^2 - 3x + 1 = 3 (x - 1/2)^2 + 1/4.
    c2 = 2 * (3 * x * x - 3 * x + 1) / (3 * (1 - x))
    a32 = (x / 2 - Fraction(1, 6)) / c2
    a31 = x - a32
    b3 = 1 / (3 * x - 1)
    b2 = (Fraction(1, 2) - x * b3) / c2
    b1 = 1 - b2 - b3
    return _family(alpha, [[], [[c2]], [[a31, a32]]], [[a31, a32], [b1 - a31, b2 - a32, b3]])


def _parameter(value: Any, excluded: dict[Fraction, str]) -> Fraction:
    number = checked_coefficient("alpha", value)
    for singular, denominator in excluded.items():
        # The float nearest to 1/3 stands for 1/3.
        if number == (singular if isinstance(number, Fraction) else float(singular)):
            raise ValueError(
                f"alpha must not be {singular}, got {value!r}: the coefficients of this family "
                f"divide by {denominator}, which is zero there."
            )
    return Fraction(number)


def _family(parameter: Any, alpha: list[Any], beta: list[Any]) -> Tableau:
    """Rounds, where the parameter is a float, once and at the end."""
    if isinstance(checked_coefficient("alpha", parameter), Fraction):
        return Tableau(alpha, beta)

    def rounded(rows: list[list[Fraction]]) -> list[list[float]]:
        return [[float(a) for a in row] for row in rows]

    try:
        return Tableau([rounded(rows) for rows in alpha], rounded(beta))
    except OverflowError:
        raise ValueError(
            f"alpha = {parameter!r} is out of range: a coefficient of this family overflows."
        ) from None


_half, _third, _sixth, _twelfth = (Fraction(1, n) for n in (2, 3, 6, 12))

# Order 1: the exponential Euler step of every Lie group method.
LIE_EULER = Tableau([[]], [[1]], continuous_extension=[[[1]]])

# Order 2: the classical midpoint rule. Embedded method of order 1, continuous extension of order 2.
CF2 = Tableau([[], [[_half]]], [[0, 1]], [[1]], [[[1], [-1, 1]]])

# Order 3: Celledoni, Marthinsen & Owren, FGCS 19 (2003), the first family at 2/3. Embedded
# method and continuous extension of order 2.
_cf3 = third_order_a(Fraction(2, 3))
CF3 = Tableau(
    _cf3.alpha,
    _cf3.beta,
    [[0, _half, _half]],
    [[[_third]], [[2 * _third], [Fraction(-3, 4), 0, Fraction(3, 4)]]],
)

# Order 4: Celledoni, Marthinsen & Owren, FGCS 19 (2003), equation (7). Embedded
# method, with the field at the end of the step, and continuous extension of order 3.
CF4 = Tableau(
    [[], [[_half]], [[0, _half]], [[_half], [-_half, 0, 1]]],
    [
        [Fraction(1, 4), _sixth, _sixth, -_twelfth],
        [-_twelfth, _sixth, _sixth, Fraction(1, 4)],
    ],
    [
        [Fraction(1, 4), _sixth, _sixth, -_twelfth],
        [-_twelfth, _sixth, _sixth, 0, Fraction(1, 4)],
    ],
    [
        [[_half], [Fraction(-1, 4), _sixth, _sixth, -_twelfth]],
        [
            [_half],
            [Fraction(-5, 4), 5 * _sixth, 5 * _sixth, Fraction(-5, 12)],
            [2 * _third, -2 * _third, -2 * _third, 2 * _third],
        ],
    ],
)

# Order 3: Crouch & Grossman, J. Nonlinear Sci. 3 (1993); Owren & Marthinsen, BIT 39 (1999).
# Embedded method, of the same sources, and continuous extension of order 2.
CG3 = crouch_grossman(
    [[Fraction(3, 4)], [Fraction(119, 216), Fraction(17, 108)]],
    [Fraction(13, 51), Fraction(-2, 3), Fraction(24, 17)],
    [Fraction(17, 54), Fraction(19, 54), _third],
    [[1, Fraction(-38, 51)], [0, Fraction(-2, 3)], [0, Fraction(24, 17)]],
)

# Order 4: Jackiewicz, Marthinsen & Owren, Adv. Comput. Math. 13 (2000).
CG4 = crouch_grossman(
    [
        [0.8177227988124852],
        [0.3199876375476427, 0.0659864263556022],
        [0.9214417194464946, 0.4997857776773573, -1.0969984448371582],
        [0.3552358559023322, 0.2390958372307326, 1.3918565724203246, -1.1092979392113465],
    ],
    [
        0.1370831520630755,
        -0.0183698531564020,
        0.7397813985370780,
        -0.1907142565505889,
        0.3322195591068374,
    ],
)

# Order 5: Jackiewicz, Marthinsen & Owren, Adv. Comput. Math. 13 (2000).
CG5 = crouch_grossman(
    [
        [0.5119828014137712],
        [0.1256672120643583, 0.7516202380829815],
        [-0.1859318985660963, 0.9805295406563367, -0.5333302514616872],
        [0.1693767277911736, 0.9505578305836004, -0.2601241719456298, -0.2298819100175240],
        [
            -0.3672779810475256,
            -0.0086029950554851,
            -0.0010336337263253,
            0.4747844514543335,
            -0.1827675787966842,
        ],
        [
            -0.1967584902954152,
            -0.0841805485664162,
            -0.0269530236366960,
            0.7559747536983863,
            -0.0238706198984107,
            0.0482925299135956,
        ],
        [
            -0.5309452158934434,
            0.0197456651284920,
            -0.0890782597312347,
            1.1112114193183167,
            -0.2549231869664070,
            0.0690881269948897,
            -0.0190658555145840,
        ],
        [
            0,
            -0.1116041993954347,
            0.0007837329078394,
            0.1273989332794543,
            -0.2951798037735399,
            -0.5806798044068681,
            -0.3715982236980106,
            1.1170906343009428,
        ],
    ],
    [
        0.7927513978455029,
        0,
        0.3490698579749237,
        0.3139686995007973,
        -0.4266876632081064,
        -0.8094238190622946,
        1.3450516465346317,
        -0.9242094915998407,
        0.3594793720143862,
    ],
)
