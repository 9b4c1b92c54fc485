"""How a step is compiled. Of this folder only this file knows `_xla`.

A step says of its values that several results need them, and what of it may be one loop. What
becomes of that in the program is decided in `_xla`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._control_term import is_driven
from .._xla import chosen as chosen
from .._xla import computed_again as computed_again
from .._xla import computed_once as computed_once
from .._xla import limits as limits
from .._xla import materialised_if_long as materialised_if_long
from .._xla import materialised_in_rows as materialised_in_rows
from .._xla import materialised_together as materialised_together
from .._xla import over_stages as over_stages
from .._xla import scalarised as scalarised
from .._xla import where_scalarised as where_scalarised


def control_of(terms: diffrax.AbstractTerm, t0: Any, t1: Any, **kwargs: Any) -> PyTree:
    """The control of a step, whose random numbers are drawn once."""
    control = terms.contr(t0, t1, **kwargs)
    # Otherwise XLA makes normal numbers of the random bits again for each flow that uses them.
    return computed_once(control) if is_driven(terms) else control


def by_turns(
    body: Callable[[PyTree, Any], tuple[PyTree, PyTree]], carry: PyTree, turns: Sequence[Any]
) -> tuple[PyTree, list[PyTree]]:
    """What `jax.lax.scan` makes of some turns, with the outputs of each."""
    if len(turns) == 1:
        carry, output = body(carry, turns[0])
        return carry, [output]

    def once(carry: PyTree, turn: Any) -> Any:
        return scalarised(lambda carry: body(carry, turn), carry)

    # What is known stays known, so that the loop can be unrolled.
    is_known = lambda xs: not any(isinstance(x, jax.Array) for x in xs)  # noqa: E731
    many = jtu.tree_map(lambda *xs: (np if is_known(xs) else jnp).asarray(xs), *turns)
    carry, stacked = over_stages(once, carry, many)
    return carry, [jtu.tree_map(lambda x: x[k], stacked) for k in range(len(turns))]  # noqa: B023
