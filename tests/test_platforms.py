"""Programs for CUDA and TPU can be made here, on a CPU: `jax.export` lowers them."""

import json
import os
import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import pytest
from jax import export

import cfjax

PLATFORMS = "cuda", "tpu"


def rotation(t, y, args):
    return cfjax.Rotation(-y / args)


def matrix(t, y, args):
    return cfjax.LeftMatrix(jnp.outer(args, args) * y[0] - jnp.diag(args))


def complex_matrix(t, y, args):
    a = jnp.outer(args, args).astype(y.dtype)
    return cfjax.LeftMatrix(1j * a * jnp.abs(y[0]).astype(y.dtype))


def affine(t, y, args):
    return cfjax.Affine(-(y**3), -jnp.square(args), cfjax.SineTransform())


def low_rank(t, y, args):
    return cfjax.LowRankSkew(jnp.sin(y) * args[:, None])


VECTOR = [0.6, 0.0, 0.8]
# Each family of fields, with a start. All take three parameters.
FAMILIES = {
    "Rotation": (rotation, VECTOR),
    "LeftMatrix": (matrix, VECTOR),
    "LeftMatrix, complex": (complex_matrix, [0.6 + 0j, 0j, 0.8j]),
    "Affine with a transform": (affine, VECTOR),
    "LowRankSkew": (low_rank, [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]),
}


def by_integrate(term, y0, args, throw):
    solution = cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, y0, args, num_steps=3, throw=throw)
    return solution.ys


def by_diffeqsolve(term, y0, args, throw):
    controller = diffrax.PIDController(rtol=0.0, atol=1e-3)
    solution = diffrax.diffeqsolve(
        term,
        cfjax.CF4(),
        0.0,
        1.0,
        0.1,
        y0,
        args,
        stepsize_controller=controller,
        max_steps=16,
        throw=throw,
    )
    return solution.ys


def exported(field, y0, solve, platforms, throw=False, has_gradient=True):
    """The program of a value, and of its gradients in the start and the parameters."""
    term = cfjax.LieTerm(field)

    def loss(y0, args):
        return jnp.sum(jnp.abs(solve(term, y0, args, throw)) ** 4)

    program = jax.value_and_grad(loss, argnums=(0, 1)) if has_gradient else loss
    args = jnp.array([0.9, 0.6, 0.3])
    return export.export(jax.jit(program), platforms=platforms)(jnp.asarray(y0), args)


def is_whole(program):
    """Whether it is for both platforms, and calls nothing on the host."""
    return program.platforms == PLATFORMS and "callback" not in program.mlir_module()


def failures():
    """By family and solve, why a program could not be made."""
    found = {}
    # The loop is diffrax's and its derivative equinox's: with one field as with another.
    cases = [*((name, by_integrate) for name in FAMILIES), ("Rotation", by_diffeqsolve)]
    for name, solve in cases:
        try:
            program = exported(*FAMILIES[name], solve, PLATFORMS)
        except Exception as error:
            found[f"{name}, {solve.__name__}"] = repr(error)
            continue
        if not is_whole(program):
            found[f"{name}, {solve.__name__}"] = "made, but not as it should be"
    return found


@pytest.mark.slow
def test_programs_lower_for_cuda_and_tpu():
    """In a process of its own: equinox reads its setting when it is imported."""
    done = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "EQX_ON_ERROR": "nan", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {}


def test_an_error_for_the_host_to_raise_keeps_a_program_on_its_platform():
    """The limit that the site names. An error is a call of Python, which jax ties to a backend."""
    assert is_whole(exported(rotation, VECTOR, by_integrate, PLATFORMS))
    with pytest.raises(ValueError, match=r"platform .* is different from the lowering platform"):
        exported(rotation, VECTOR, by_integrate, ["cuda"], throw=True, has_gradient=False)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(failures()))
