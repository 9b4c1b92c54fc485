"""Fields with a linear part, of which exponential Runge-Kutta methods take functions."""

import abc
from collections.abc import Sequence
from typing import Any

from .._field import AbstractFrozenField


class AbstractSemilinearField(AbstractFrozenField):
    """A field `x' = L x + b` with a linear part L, for exponential Runge-Kutta methods.

    These methods, such as `cfjax.ETD54`, take L from the first field of a step, and subtract it
    from every later field. So a class must define, beyond what `AbstractFrozenField` requires:

    - `functions(pairs)`: for each pair (c, k) of a node and an order the function `phi_k(c L)`,
      with `phi_k(z) = sum_j z^j / (j + k)!`, as an array or a pytree of arrays. The method forms
      linear combinations of these, entry by entry;
    - `times(function, x)`: such a function, or a combination of them, applied to x;
    - `rest(first, point)`: the velocity at `point` less `L point`, where L is the linear part of
      the field `first`.

    In a class that has a chart of its own these act in the chart, which must be linear.
    """

    @abc.abstractmethod
    def functions(self, pairs: Sequence[tuple[float, int]]) -> list[Any]:
        """The functions `phi_k(c L)` for pairs (c, k)."""

    @abc.abstractmethod
    def times(self, function: Any, x: Any) -> Any:
        """A function of L, or a combination of them, applied to x; shaped like x."""

    @abc.abstractmethod
    def rest(self, first: Any, point: Any) -> Any:
        """The velocity at `point` less the linear part of `first` there; shaped like `point`."""
