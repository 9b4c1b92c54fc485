"""Loops over the stages of a method, which are a part of what is scalarised."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn, Primitive
from jax.interpreters import mlir
from jaxtyping import Array, PyTree

from .scope import is_rewritten
from .understood import STAGES


def over_stages(
    body: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], carry: PyTree, turns: PyTree
) -> tuple[PyTree, PyTree]:
    """`lax.scan` over what is known of the stages of a method, as NumPy's arrays.

    Where all of a step is scalarised, the loop is unrolled.
    """
    with jax.named_scope(STAGES):
        return lax.scan(body, carry, turns)


def chosen(predicate: Array, yes: Callable[[], PyTree], no: Callable[[], PyTree]) -> PyTree:
    """`lax.cond` within such a loop, of what is known once that is unrolled."""
    with jax.named_scope(STAGES):
        return lax.cond(predicate, yes, no)


def computed_again(value: PyTree, compute: Callable[[], PyTree]) -> PyTree:
    """`value`, which `compute()` computes again where this is scalarised and not differentiated.

    There XLA computes anew, for each entry of the value, all that the value is made of.
    """
    return where_scalarised(compute, lambda: value, in_derivatives=False)


def where_scalarised(
    yes: Callable[[], PyTree], no: Callable[[], PyTree], in_derivatives: bool = True
) -> PyTree:
    """`yes()` where this is scalarised, with or without its derivatives, and otherwise `no()`.

    Both have one value.
    """
    if not is_rewritten():
        return no()
    return chosen(is_scalarised_p.bind(in_derivatives=in_derivatives), yes, no)


# Whether this is evaluated on single numbers, and there also in derivatives.
is_scalarised_p = Primitive("cfjax_is_scalarised")


@is_scalarised_p.def_impl
def _run(**_):
    return jnp.zeros((), bool)


@is_scalarised_p.def_abstract_eval
def _(**_):
    return ShapedArray((), jnp.dtype(bool))


mlir.register_lowering(is_scalarised_p, mlir.lower_fun(_run, multiple_results=False))


class Loop(NamedTuple):
    """A `lax.scan`: what it makes in each turn of constants, a carry and what it goes over."""

    body: ClosedJaxpr
    num_constants: int
    num_carried: int
    turns: Sequence[int]

    @classmethod
    def of(cls, eqn: JaxprEqn) -> "Loop":
        params: Any = eqn.params
        if "num_consts" in params:
            constants, carried = params["num_consts"], params["num_carry"]
        else:
            # From jax 0.12 on.
            parts = params["ft_in"].unpack()
            constants, carried = (len(list(part)) for part in parts[:2])
        turns = range(params["length"])
        turns = turns[::-1] if params["reverse"] else turns
        return cls(params["jaxpr"], constants, carried, turns)
