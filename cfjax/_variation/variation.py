"""`Variation`: a state, and what is carried beside it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real


class Variation(eqx.Module):
    """A state, and what `cfjax.VariationTerm` carries beside it; None is not carried.

    `term.start` makes one. The n coordinates of a variation of the state and their order are those
    of the term (`cfjax.VariationTerm`). In a solution all have the axis of the saved times in
    front.

    - `state`: the state, any pytree.
    - `transition`: shape `(n, n)`. It takes a variation of the start to that of the state.
    - `covariance`: shape `(n, n)`, of a variation of the state, to first order in the noise.
    - `sensitivity`: shape `(n, m)`. Its columns are the variations that m parameters cause.
    - `log_density`: shape `()`, the logarithm of the density of the state where the start is
      random.

    The matrices of a small state are stored by rows, and of a covariance the upper half, so
    `equinox.tree_at` cannot replace these four. To go on with others, such as a covariance after a
    measurement, call `term.start` again.
    """

    state: PyTree
    _transition: Any
    _covariance: Any
    _sensitivity: Any
    _log_density: Any

    def __init__(
        self,
        state: PyTree,
        transition: Any = None,
        covariance: Any = None,
        sensitivity: Any = None,
        log_density: Any = None,
    ):
        self.state = state
        self._transition = transition
        self._covariance = covariance
        self._sensitivity = sensitivity
        self._log_density = log_density

    @property
    def transition(self) -> Any:
        return _whole(self._transition)

    @property
    def covariance(self) -> Any:
        return _whole(self._covariance)

    @property
    def sensitivity(self) -> Any:
        return _whole(self._sensitivity)

    @property
    def log_density(self) -> Any:
        return _whole(self._log_density)

    def by_rows(self) -> "Variation":
        """The same, stored by rows if it is small enough for its steps to be rewritten."""
        whole = self.transition, self.covariance, self.sensitivity
        n = next((x.shape[0] for x in whole if x is not None), 0)
        vectors = [*jtu.tree_leaves(self.state), *(x[0] for x in whole if x is not None and n)]
        matrices = [x.size for x in (self.transition, self.sensitivity) if x is not None]
        packed = 0 if self.covariance is None else n * (n + 1) // 2
        num = sum(x.size for x in jtu.tree_leaves(self.state)) + sum(matrices) + packed
        num += self.log_density is not None
        if num > MAX_ENTRIES or any(x.ndim > 1 or x.size > MAX_LENGTH for x in vectors):
            return self
        transition, covariance, sensitivity = (
            None if x is None else Rows.of(x, half=k == 1) for k, x in enumerate(whole)
        )
        return Variation(self.state, transition, covariance, sensitivity, self.log_density)

    def stored_like(self, other: "Variation") -> "Variation":
        """The same, each matrix stored as that of the other."""

        def stored(x: Any, like: Any) -> Any:
            return Rows.of(x, like.half) if isinstance(like, Rows) else x

        return Variation(
            self.state,
            stored(self._transition, other._transition),
            stored(self._covariance, other._covariance),
            stored(self._sensitivity, other._sensitivity),
            self._log_density,
        )


# Steps of states of so many numbers, in vectors of this length, are rewritten
# (`_xla/limits.py`); those of a matrix are not.
MAX_ENTRIES, MAX_LENGTH = 16, 7


class Rows(eqx.Module):
    """A matrix as its rows, or a symmetric one as the upper half of them."""

    rows: tuple[Array, ...]
    half: bool = eqx.field(static=True)

    @classmethod
    def of(cls, matrix: Real[Array, "n m"], half: bool) -> "Rows":
        return cls(tuple(row[k * half :] for k, row in enumerate(matrix)), half)

    def whole(self) -> Real[Array, "*batch n m"]:
        if not self.half:
            return jnp.stack(self.rows, axis=-2)
        n = len(self.rows)
        entries = [[self.rows[min(i, j)][..., abs(i - j)] for j in range(n)] for i in range(n)]
        return jnp.stack([jnp.stack(row, axis=-1) for row in entries], axis=-2)


def _whole(x: Any) -> Any:
    return x.whole() if isinstance(x, Rows) else x
