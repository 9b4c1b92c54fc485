"""Large batches: chunks, files, devices, processes."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax
from cfjax import _batch

TERM = cfjax.LieTerm(problems.rigid_body)
SIZE, CHUNK = 23, 5  # A last chunk of three.


def solve(member):
    y0, inertia = member
    return cfjax.integrate(TERM, cfjax.CF4(), 0.0, 1.0, y0, inertia, num_steps=10).ys[-1]


def members(size=SIZE):
    rng = np.random.default_rng(3)
    return rng.standard_normal((size, 3)), rng.uniform(1, 2, (size, 3))


@pytest.fixture
def computed(monkeypatch):
    """The chunks that are computed, by the first entry of their members."""
    calls = []
    call = _batch._Program.__call__

    def counted(self, inputs):
        calls.append(float(inputs[0].flat[0]))
        return call(self, inputs)

    monkeypatch.setattr(_batch._Program, "__call__", counted)
    return calls


def test_chunks_have_the_values_of_one_vmap():
    expected = jax.jit(jax.vmap(solve))(tuple(map(jnp.asarray, members())))
    for chunk_size in (1, CHUNK, SIZE, 1000):
        values, failed = cfjax.map_batch(solve, members(), chunk_size=chunk_size)
        assert isinstance(values, np.ndarray)
        # The compiler orders the operations of a vector and of a scalar loop differently: rounding.
        np.testing.assert_allclose(values, expected, rtol=0, atol=1e-14)
        assert failed.shape == (0,)


def test_one_trace_for_all_chunks():
    traces = 0

    def traced(x):
        nonlocal traces
        traces += 1
        return {"twice": 2 * x, "name": "kept"}

    x = np.arange(SIZE)
    values, _ = cfjax.map_batch(traced, x, chunk_size=CHUNK)
    assert traces == 1
    assert values["name"] == "kept"
    np.testing.assert_array_equal(values["twice"], 2 * x)


def test_a_solution_of_diffrax_and_members_that_fail():
    y0, rate = np.ones((SIZE, 1)), np.ones(SIZE)
    rate[[4, 17]] = 1e4  # Too fast for so few steps.

    def solve(member):
        y0, rate = member
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: -args * y),
            diffrax.Tsit5(),
            0.0,
            1.0,
            0.1,
            y0,
            rate,
            stepsize_controller=diffrax.PIDController(rtol=0, atol=1e-8),
            max_steps=64,
            throw=False,
        )

    values, failed = cfjax.map_batch(solve, (y0, rate), chunk_size=CHUNK)
    np.testing.assert_array_equal(failed, [4, 17])
    assert isinstance(values, diffrax.Solution)
    good = np.delete(values.ys[:, 0, 0], failed)
    np.testing.assert_allclose(good, np.exp(-1), rtol=0, atol=1e-7)


def test_a_blow_up_with_constant_steps_is_a_failure_and_room_left_is_none():
    """Of these diffrax gives no result for each member, and fills 2 of 10 places with infinity."""
    y0 = np.full((SIZE, 1), 0.1)
    y0[[4, 17]] = 3.0

    def solve(y0):
        return diffrax.diffeqsolve(
            cfjax.LieTerm(lambda t, y, args: y * y),
            cfjax.CF4(),
            0.0,
            1.0,
            0.125,
            y0,
            saveat=diffrax.SaveAt(subs=diffrax.SubSaveAt(steps=True)),
            max_steps=10,
        )

    values, failed = cfjax.map_batch(solve, y0, chunk_size=CHUNK)
    np.testing.assert_array_equal(failed, [4, 17])
    assert np.isinf(values.ts[0, 8:]).all()
    # The error of CF4 is some 1e-9 here.
    np.testing.assert_allclose(values.ys[0, 7], 0.1 / 0.9, rtol=1e-7)


def test_entries_that_are_not_finite_are_failures():
    x = np.array([1.0, 0.0, 2.0, 0.0])
    values, failed = cfjax.map_batch(lambda x: {"a": x, "b": 1 / x, "c": 1}, x, chunk_size=3)
    np.testing.assert_array_equal(failed, [1, 3])
    np.testing.assert_array_equal(values["b"], [1, np.inf, 0.5, np.inf])


# Files.


def test_what_is_finished_is_read_and_not_computed_again(tmp_path, computed):
    folder = tmp_path / "some" / "results"
    first, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=folder)
    assert len(computed) == 5
    assert sorted(os.listdir(folder)) == [f"chunk_{i:06}.npz" for i in range(5)]
    again, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=str(folder))
    assert len(computed) == 5
    np.testing.assert_array_equal(again, first)


def test_an_interrupted_batch_goes_on_where_it_stopped(tmp_path, computed, monkeypatch):
    write = _batch._Store.write

    def interrupted(self, number, inputs, outputs):
        if number == 2:
            raise KeyboardInterrupt
        write(self, number, inputs, outputs)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(_batch._Store, "write", interrupted)
        cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["chunk_000000.npz", "chunk_000001.npz"]
    values, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=tmp_path)
    y0 = members()[0][:, 0]
    assert computed == list(y0[[0, 5, 10, 10, 15, 20]])
    expected, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK)
    np.testing.assert_array_equal(values, expected)


def test_an_interrupted_write_leaves_no_file(tmp_path, monkeypatch):
    def interrupted(file, **arrays):
        file.write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=tmp_path)
    assert os.listdir(tmp_path) == []


def cut_short(content):
    return content[: len(content) // 2]


def one_bit_changed(content):
    # In the numbers of the first array: past the headers of the zip file and of the array.
    place = content.index(b"\n", content.index(b"NUMPY")) + 9
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


def empty(content):
    return b""


def something_else(content):
    return b"not a file of ours"


@pytest.mark.parametrize("damage", [cut_short, one_bit_changed, empty, something_else])
def test_a_damaged_file_is_computed_again(tmp_path, computed, damage):
    first, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=tmp_path)
    del computed[:]
    path = tmp_path / "chunk_000003.npz"
    content = path.read_bytes()
    assert damage(content) != content
    path.write_bytes(damage(content))
    again, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=tmp_path)
    assert computed == [members()[0][15, 0]]
    np.testing.assert_array_equal(again, first)
    cfjax.map_batch(solve, members(), chunk_size=CHUNK, folder=tmp_path)
    assert len(computed) == 1


def test_results_of_other_members_or_another_solve_are_not_taken(tmp_path, computed):
    def scaled(factor):
        return lambda member: factor * solve(member)

    factor = jnp.asarray(2.0)
    cfjax.map_batch(scaled(factor), members(), chunk_size=CHUNK, folder=tmp_path)
    for constant in (2.5, jnp.asarray(3.0)):
        del computed[:]
        values, _ = cfjax.map_batch(scaled(constant), members(), chunk_size=CHUNK, folder=tmp_path)
        assert len(computed) == 5
        expected, _ = cfjax.map_batch(scaled(constant), members(), chunk_size=CHUNK)
        np.testing.assert_array_equal(values, expected)
    del computed[:]
    y0, inertia = members()
    y0[7, 0] += 1
    cfjax.map_batch(scaled(jnp.asarray(3.0)), (y0, inertia), chunk_size=CHUNK, folder=tmp_path)
    assert computed == [y0[5, 0]]


def test_members_of_a_memory_map(tmp_path):
    y0, inertia = members()
    np.save(tmp_path / "y0.npy", y0)
    mapped = np.load(tmp_path / "y0.npy", mmap_mode="r")
    values, _ = cfjax.map_batch(solve, (mapped, inertia), chunk_size=CHUNK)
    expected, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK)
    np.testing.assert_array_equal(values, expected)


# Many devices. Each needs a process of its own, as jax fixes its devices when it starts.

PROGRAM = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}]
import jax
jax.config.update("jax_enable_x64", True)
if len(sys.argv) > 4:
    jax.distributed.initialize(sys.argv[4], num_processes=2, process_id=int(sys.argv[5]))
import numpy as np
import cfjax
import test_batch
shape = tuple(map(int, sys.argv[2].split("x")))
mesh = jax.make_mesh(shape, ("i", "j")[: len(shape)])
assert mesh.size == jax.device_count()
values, failed = cfjax.map_batch(
    test_batch.solve, test_batch.members(), chunk_size=test_batch.CHUNK, mesh=mesh,
    folder=sys.argv[3],
)
again, failed = cfjax.map_batch(
    test_batch.solve, test_batch.members(), chunk_size=test_batch.CHUNK, mesh=mesh,
    folder=sys.argv[3],
)
np.testing.assert_array_equal(again, values)
np.save(sys.argv[1], values)
"""


def start(devices, *arguments):
    flags = f"--xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *map(str, arguments)],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        stderr=subprocess.PIPE,
        text=True,
    )


def check_against_one_device(path):
    expected, _ = cfjax.map_batch(solve, members(), chunk_size=CHUNK)
    # Parts of other lengths may be compiled to other vectors: rounding, as above.
    np.testing.assert_allclose(np.load(path), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", ["8", "4x2"])
def test_eight_devices(tmp_path, shape):
    process = start(8, tmp_path / "values.npy", shape, tmp_path / "chunks")
    _, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    assert len(os.listdir(tmp_path / "chunks")) == 3  # Of eight members instead of five.
    check_against_one_device(tmp_path / "values.npy")


def test_two_processes(tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    processes = [
        start(2, tmp_path / f"values{i}.npy", "4", tmp_path / "chunks", address, i)
        for i in range(2)
    ]
    for process in processes:
        _, error = process.communicate(timeout=300)
        assert process.returncode == 0, error
    assert len(os.listdir(tmp_path / "chunks")) == 3
    for i in range(2):
        check_against_one_device(tmp_path / f"values{i}.npy")


# Wrong inputs.


@pytest.mark.parametrize(
    "wrong, kind, message",
    [
        ((), TypeError, "at least one array"),
        ((np.ones(2), 1.0), TypeError, r"members\[1\] must be an array"),
        ((np.ones(2), np.ones(())), TypeError, r"members\[1\] must be an array"),
        ((np.ones(2), np.ones((3, 2))), ValueError, r"members\[0\]': 2, 'members\[1\]': 3"),
        ((np.ones((0, 2)),), ValueError, "must not be empty"),
        (jax.random.split(jax.random.key(0), 2), TypeError, "array of numbers"),
    ],
)
def test_wrong_members(wrong, kind, message):
    with pytest.raises(kind, match=message):
        cfjax.map_batch(lambda x: x, wrong)


@pytest.mark.parametrize("chunk_size", [0, -1, 2.0, True])
def test_wrong_chunk_size(chunk_size, no_shape_hook):
    with pytest.raises(ValueError, match="chunk_size must be an integer of at least 1, got"):
        cfjax.map_batch(solve, members(), chunk_size=chunk_size)


def test_a_folder_that_is_a_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        cfjax.map_batch(solve, members(), folder=path)
    assert path.read_text() == "mine"
