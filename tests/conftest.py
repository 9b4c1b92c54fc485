import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """A program keeps memory maps; past the 65 530 of a process on Linux, compiling crashes."""
    yield
    jax.clear_caches()


@pytest.fixture
def no_shape_hook():
    """Wrong input meets our own checks, as it does for users, and not jaxtyping's import hook."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
