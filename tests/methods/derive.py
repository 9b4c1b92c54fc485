"""Derives the continuous extensions of the named methods, and stores them in the package.

python tests/methods/derive.py
"""

import json
from typing import Any

import cfjax
from cfjax._methods.continuous_extension import (
    STORED,
    derived_extension,
    derived_runge_kutta_extension,
    identity,
)
from cfjax._methods.tableau import Tableau


def named() -> dict[str, tuple[Any, ...]]:
    """By name, the coefficients of the methods whose sources have no continuous extension."""
    found = {}
    for name in dir(cfjax):
        solver: Any = getattr(cfjax, name)
        tableau = getattr(solver, "tableau", None)
        if isinstance(tableau, Tableau) and tableau.continuous_extension is None:
            found[name] = (tableau,)
    for solver in (cfjax.RKMK5(), cfjax.RKMK8(), cfjax.CayleyRK4()):
        coefficients = solver.a[: len(solver.b)], solver.b, solver.order(None)
        found[type(solver).__name__] = coefficients
    return found


def derived() -> dict[str, dict[str, Any]]:
    return {
        name: {
            "of": identity(*method),
            "extension": derived_extension(*method)
            if len(method) == 1
            else derived_runge_kutta_extension(*method),
        }
        for name, method in named().items()
    }


def text() -> str:
    """A line for each method."""
    lines = (f"{json.dumps(name)}: {json.dumps(each)}" for name, each in derived().items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


if __name__ == "__main__":
    STORED.write_text(text())
