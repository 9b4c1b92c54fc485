"""The option of XLA that small loops are one function."""

import os
import subprocess
import sys

import jax
import pytest

from cfjax._measure.small_loops import compile_small_loops

IS_NEW = jax.__version_info__ >= (0, 12)


@pytest.mark.parametrize("flags", ["", "--xla_force_host_platform_device_count=2"])
def test_other_flags_stay(flags):
    environ = {"XLA_FLAGS": flags} if flags else {}
    compile_small_loops(environ)
    added = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1048576"
    assert environ.get("XLA_FLAGS", "").split() == [*flags.split(), *([] if IS_NEW else [added])]


def test_options_of_the_user_stay():
    environ = {"XLA_FLAGS": "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"}
    expected = dict(environ)
    compile_small_loops(environ)
    assert environ == expected


@pytest.mark.slow
@pytest.mark.skipif(IS_NEW, reason="XLA does so without an option.")
def test_a_loop_is_one_function():
    """The loop over steps of 60 spins, in processes with the option and without."""
    code = """
import sys
from cfjax._measure.small_loops import compile_small_loops
if sys.argv[1:]:
    compile_small_loops()
import jax, jax.numpy as jnp
import cfjax
term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.sin(y)))
solve = lambda y: cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y, num_steps=100).ys
text = jax.jit(solve).lower(jnp.ones((60, 3))).compile().as_text()
print(text.count("xla_cpu_small_call"))
"""
    environ = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}

    def calls(*argv: str) -> int:
        command = [sys.executable, "-c", code, *argv]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environ)
        return int(done.stdout)

    assert calls("set") > 0
    assert calls() == 0
