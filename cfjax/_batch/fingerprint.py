"""Digests that identify a computation, the same in every process."""

import functools
import hashlib
import itertools
import re
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jaxlib.version
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxprs_in_params
from jax.stages import Lowered, Traced
from jaxtyping import Array, Shaped

_SYMBOL = re.compile(r'@("[^"]*"|[\w.$-]+)')
_FUNCTION = re.compile(rf"^  func\.func \w+ {_SYMBOL.pattern}", re.MULTILINE)
# A function of the host whose result enters the program: on a CPU, on a GPU, on a TPU.
_HOST_FUNCTION = re.compile(r"= stablehlo\.(custom_call @\w*python\w*callback|recv\b)")
# The text identifies one only by a number, in the order in which they were lowered.
_HOST_NUMBER = re.compile(r"(@\w*python\w*callback.*?)\{index = \d+ : ui64\}")
# In this one equinox calls the host to raise an error, and takes no value from it.
_EQUINOX_CHECK = re.compile(r"branched_error_if_impl(_\d+)?")


def environment(devices: Iterable[Any]) -> dict[str, Any]:
    """Versions and kinds of device, on which the arithmetic of a program's text may depend."""
    from .. import __version__  # not at the top: the package defines it last

    return {
        "cfjax": __version__,
        "jax": jax.__version__,
        "jaxlib": jaxlib.version.__version__,
        "devices": sorted({f"{device.platform} {device.device_kind}" for device in devices}),
    }


def fingerprint(traced: Traced, lowered: Lowered, environment: dict[str, Any]) -> bytes:
    """A digest of all that decides the values of a program, given its inputs.

    It is the digest of the text that is compiled, and of the environment. A jaxpr would not do:
    constants may be in nested ones, in parameters of equations and in static objects of primitives.
    The text has each to the last bit, and the settings of precision, random numbers and sharding.
    Which calls share a function, and so the functions' names and order, depends on what jax has
    cached from other programs: so a call counts as the text that it calls. Flags of the compiler
    are no part of the digest.

    **Raises** `ValueError` if the program takes values from a function of the host, which the text
    does not contain. A print returns no value, and a check of equinox none but success.
    """
    outside, *functions = _FUNCTION.split(_HOST_NUMBER.sub(r"\1", lowered.as_text()))
    bodies: dict[str, str] = {}
    for name, function in zip(functions[::2], functions[1::2], strict=True):
        bodies[name], _, after = function.partition("\n  }\n")
        outside += after
        if _HOST_FUNCTION.search(function) and not _EQUINOX_CHECK.fullmatch(name):
            raise ValueError(
                "folder needs a solve whose values jax alone computes, got one that calls a "
                "function of the host (jax.pure_callback, jax.experimental.io_callback, a progress "
                "meter): a change of it would go unnoticed. Leave out folder or the call."
            )

    @functools.cache
    def content(name: str) -> str:
        inner = lambda symbol: content(symbol[1]) if symbol[1] in bodies else symbol[0]  # noqa: E731
        return hashlib.sha256(_SYMBOL.sub(inner, bodies[name]).encode()).hexdigest()

    text = "\n".join([repr(environment), outside, content("main")])
    return digest(text.encode(), *_arrays(traced.jaxpr))


def digest(*items: bytes | Shaped[Array | np.ndarray, "..."]) -> bytes:
    state = hashlib.sha256()
    for item in items:
        array = np.frombuffer(item, np.uint8) if isinstance(item, bytes) else np.asarray(item)
        state.update(f"{array.shape} {array.dtype};".encode())
        state.update(np.ascontiguousarray(array).tobytes())
    return state.digest()


def _arrays(jaxpr: Jaxpr | ClosedJaxpr) -> Iterator[np.ndarray]:
    """With jax_use_simplified_jaxpr_constants, the arrays that are inputs instead of text."""
    inner = jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr
    for atom in itertools.chain(*(eqn.invars for eqn in inner.eqns), inner.outvars):
        if isinstance(atom, Literal) and np.ndim(atom.val):
            yield np.asarray(atom.val)
    for eqn in inner.eqns:
        for nested in jaxprs_in_params(eqn.params):
            yield from _arrays(nested)
