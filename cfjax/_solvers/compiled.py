"""How a step is compiled. In this folder only this file imports `_xla`.

A step marks values that several results need, and what may be one loop. `_xla` decides what the
program makes of these marks.
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
from .._xla import materialised_together as materialised_together
from .._xla import over_stages as over_stages
from .._xla import scalarised as scalarised
from .._xla import where_scalarised as where_scalarised


def control_of(terms: diffrax.AbstractTerm, t0: Any, t1: Any, **kwargs: Any) -> PyTree:
    """The control of a step, whose random numbers are drawn once."""
    control = terms.contr(t0, t1, **kwargs)
    # Otherwise XLA would turn the random bits into normal numbers anew for each flow.
    return computed_once(control) if is_driven(terms) else control


def scan_list(
    body: Callable[[PyTree, Any], tuple[PyTree, PyTree]], carry: PyTree, xs: Sequence[Any]
) -> tuple[PyTree, list[PyTree]]:
    """`jax.lax.scan` over a list of pytrees, which returns the outputs as a list."""
    if len(xs) == 1:
        carry, output = body(carry, xs[0])
        return carry, [output]

    def scalarised_body(carry: PyTree, x: Any) -> Any:
        return scalarised(lambda carry: body(carry, x), carry)

    # Values known while tracing stay so, so that the loop can be unrolled.
    is_static = lambda xs: not any(isinstance(x, jax.Array) for x in xs)  # noqa: E731
    stacked_xs = jtu.tree_map(lambda *xs: (np if is_static(xs) else jnp).asarray(xs), *xs)
    carry, outputs = over_stages(scalarised_body, carry, stacked_xs)
    return carry, [jtu.tree_map(lambda x: x[k], outputs) for k in range(len(xs))]  # noqa: B023
