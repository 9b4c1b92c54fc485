import pytest

import cfjax


@pytest.fixture(autouse=True)
def as_written(request):
    """Quick tests compile the programs of scenes as they are written, which takes half as long.

    tests/xla rewrites programs, and so do the slow tests of scenes.
    """
    if request.node.get_closest_marker("slow"):
        yield
    else:
        with cfjax.rewriting(False):
            yield
