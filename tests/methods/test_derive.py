"""What is stored for the named methods is what the order conditions give."""

import json

import numpy as np
from methods import derive

import cfjax
from cfjax._methods.continuous_extension import (
    STORED,
    continuous_extension,
    derived_extension,
    runge_kutta_extension,
)

WRITE = "Run python tests/methods/derive.py."


def numbers(extension):
    if isinstance(extension, list | tuple):
        return [x for part in extension for x in numbers(part)]
    return [extension]


def test_what_is_stored_is_what_is_derived():
    stored, derived = json.loads(STORED.read_text()), derive.derived()
    assert [*stored] == [*derived], WRITE
    for name, found in stored.items():
        expected = derived[name]
        assert found["of"] == expected["of"], f"{name}: {WRITE}"
        # Singular values of the conditions are above 7e-6, and rounding is divided by them.
        atol = 1e-10 * np.abs(numbers(expected["extension"])).max()
        np.testing.assert_allclose(
            numbers(found["extension"]),
            numbers(expected["extension"]),
            rtol=0,
            atol=atol,
            err_msg=name,
        )


def test_what_is_stored_is_what_is_used():
    stored = json.loads(STORED.read_text())
    for name, method in derive.named().items():
        find = continuous_extension if len(method) == 1 else runge_kutta_extension
        assert json.loads(json.dumps(find(*method))) == stored[name]["extension"]


def test_that_of_a_users_own_method_is_derived():
    tableau = cfjax.third_order_a(0.4)
    assert continuous_extension(tableau) == derived_extension(tableau)
