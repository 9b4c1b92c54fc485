"""The table of planted defects is up to date. To run it: `make defects`."""

import ast

import planted_defects
import pytest


@pytest.mark.parametrize("defect", planted_defects.DEFECTS, ids=lambda d: d.what)
def test_a_defect_is_in_its_place_and_still_python(defect):
    # Raises where the old text is not there exactly once.
    changed = planted_defects.planted(defect)
    before = (planted_defects.ROOT / "cfjax" / defect.file).read_text()
    # Not a comment, and not only another layout.
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(before))
    for word in defect.tests.split():
        if ".py" in word:
            assert (planted_defects.ROOT / "tests" / word.partition("::")[0]).exists()


def test_there_are_enough():
    assert len(planted_defects.DEFECTS) >= 40
    assert len({defect.what for defect in planted_defects.DEFECTS}) == len(planted_defects.DEFECTS)
