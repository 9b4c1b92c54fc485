"""Packages of the extra `cfjax[paper]`."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def paper_extra() -> Iterator[None]:
    """Within it, a missing package of the extra is an error that says how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in ("matplotlib", "rich"):
            raise
        message = f"{package} is missing: pip install 'cfjax[paper]'"
        raise ModuleNotFoundError(message, name=package) from None
