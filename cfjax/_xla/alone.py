"""A program that is scalarised in batches only.

A long step that is scalarised takes seconds longer to compile than one that is not. In a batch that
pays; for a single system it would not within 10 000 steps. Whether a step is batched is not known
when it is traced, nor when the loop around it is. So such a step is one operation, which runs as it
is, and which a batch turns into the scalarised program.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from .derivatives import jvp_of
from .jaxprs import is_inexact, program_of, reached, replaced


class Choice:
    """What a program becomes: `derived` if it is differentiated, and `in_batches` if it is batched.

    All are of the same arrays. `make` returns the scalarised program as a function, or None if
    there is none.
    """

    def __init__(
        self, derived: ClosedJaxpr, make: Callable[[], Callable[..., Sequence[Any]] | None]
    ):
        self.derived, self._make = derived, make

    @functools.cached_property
    def in_batches(self) -> ClosedJaxpr:
        fun = self._make()
        return self.derived if fun is None else program_of(fun, *self.derived.in_avals)


# `program` is what runs, `choice` what else it may become.
alone_p = Primitive("cfjax_alone")
alone_p.multiple_results = True


@alone_p.def_impl
def _run(*operands, program, **_):
    # A literal comes out as NumPy's.
    return list(map(jnp.asarray, jaxpr_as_fun(program)(*operands)))


@alone_p.def_abstract_eval
def _(*operands, program, **_):
    return program.out_avals


def _jvp(primals, tangents, *, program, choice):
    given = enumerate(zip(primals, tangents, strict=True))
    moving = [k for k, (x, way) in given if type(way) is not ad.Zero and is_inexact(x)]
    if moving:
        return jvp_of(choice.derived, primals, tangents, moving)
    outs = alone_p.bind(*primals, program=program, choice=choice)
    return outs, [ad.Zero(aval.to_tangent_aval()) for aval in program.out_avals]


def _transpose(cotangents, *operands, choice, **_):
    unknown = [k for k, x in enumerate(operands) if ad.is_undefined_primal(x)]
    fun = jaxpr_as_fun(choice.derived)
    avals = [operands[k].aval for k in unknown]
    back = jax.linear_transpose(lambda *some: fun(*replaced(operands, unknown, some)), *avals)
    return replaced(
        [None] * len(operands), unknown, back(list(map(ad.instantiate_zeros, cotangents)))
    )


def _batch(operands, dims, *, choice, **_):
    program = choice.in_batches
    are_reached = reached(program.jaxpr, [d is not None for d in dims])
    out_dims = [0 if is_one else None for is_one in are_reached]
    return jax.vmap(jaxpr_as_fun(program), tuple(dims), out_dims)(*operands), out_dims


ad.primitive_jvps[alone_p] = _jvp
ad.primitive_transposes[alone_p] = _transpose
batching.primitive_batchers[alone_p] = _batch
mlir.register_lowering(alone_p, mlir.lower_fun(_run, multiple_results=True))
# Where newer versions of JAX put types of their own within, they take them out first.
alone_p.to_lojax = _run
