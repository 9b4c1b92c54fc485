"""What checks calls against signatures, for jaxtyping's import hook."""

from beartype import beartype

_CHECKED = {}


def checked(fn):
    """`beartype(fn)`, made once for all functions of one signature.

    jaxtyping's import hook hands over a function of the signature alone, which closes over nothing.
    A function within a function is defined, and handed over, in every call of the outer one.
    """
    key = (fn.__module__, fn.__qualname__, fn.__code__, *fn.__annotations__.items())
    try:
        found = _CHECKED.get(key)
    except TypeError:  # An annotation has no hash.
        return beartype(fn)
    if found is None:
        found = _CHECKED[key] = beartype(fn)
    return found
