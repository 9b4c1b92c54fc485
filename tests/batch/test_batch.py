"""Large batches: chunks, files, devices, processes."""

import json
import math
import os
import socket
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib.version
import lineax
import ml_dtypes
import numpy as np
import pytest
from jax.experimental import io_callback

import cfjax

TERM = cfjax.LieTerm(lambda t, y, args: -jnp.sin(y) / args)
SIZE, CHUNK = 23, 5  # A last chunk of three.


def solve(member):
    y0, args = member
    return cfjax.integrate(TERM, cfjax.LieEuler(), 0.0, 1.0, y0, args, num_steps=10).ys[-1]


def scaled(factor):
    return lambda member: factor * member[0]


def members(size=SIZE):
    rng = np.random.default_rng(3)
    return rng.standard_normal((size, 3)), rng.uniform(1, 2, (size, 3))


@pytest.fixture
def computed(monkeypatch):
    """The chunks that are computed, by the first entry of their members."""
    calls = []
    call = jax.stages.Compiled.__call__

    def counted(self, inputs):
        calls.append(float(np.asarray(inputs[0]).flat[0]))
        return call(self, inputs)

    monkeypatch.setattr(jax.stages.Compiled, "__call__", counted)
    return calls


def test_chunks_have_the_values_of_one_vmap(tmp_path, no_shape_hook):
    """Of members in memory and in a file."""
    y0, args = members()
    np.save(tmp_path / "y0.npy", y0)
    mapped = np.load(tmp_path / "y0.npy", mmap_mode="r")
    expected = jax.jit(jax.vmap(solve))((y0, args))
    values, failed = cfjax.map_batch(solve, (mapped, args), chunk_size=np.int64(CHUNK))
    assert isinstance(values, np.ndarray)
    # The compiler orders the operations of a vector and of a scalar loop differently: rounding.
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-14)
    assert failed.shape == (0,)


def test_one_trace_for_all_chunks():
    traces = 0

    def traced(x):
        nonlocal traces
        traces += 1
        return {"twice": 2 * x, "name": "kept", "none": None}

    x = np.arange(SIZE)
    for number, chunk_size in enumerate((1, CHUNK, SIZE, 1000), 1):
        values, _ = cfjax.map_batch(traced, x, chunk_size=chunk_size)
        assert traces == number
        assert values["name"] == "kept" and values["none"] is None
        np.testing.assert_array_equal(values["twice"], 2 * x)
    assert cfjax.map_batch(lambda x: None, x).values is None


def test_solutions_of_diffrax_and_members_that_fail():
    """By too few steps, and by a blow-up with constant steps, each with a result of its own.

    diffrax fills 2 of 10 places with infinity, which is no failure.
    """
    fast, large = np.ones((2, SIZE, 1))
    fast[[4, 17]] = 1e4
    large[[4, 17]] = 1e30

    def adaptive(rate):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: -args * y),
            diffrax.Tsit5(),
            0.0,
            1.0,
            0.1,
            jnp.ones(1),
            rate,
            stepsize_controller=diffrax.PIDController(rtol=0, atol=1e-8),
            max_steps=64,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )

    def constant(size):
        return diffrax.diffeqsolve(
            cfjax.LieTerm(lambda t, y, args: y * y),
            cfjax.LieEuler(),
            0.0,
            1.0,
            0.125,
            size / 10,
            saveat=diffrax.SaveAt(subs=diffrax.SubSaveAt(steps=True)),
            max_steps=10,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )

    by_euler = 0.1
    for _ in range(8):
        by_euler += by_euler**2 / 8
    # The tolerance of 1e-8 is one of each step.
    for solve, x, last, end in ((adaptive, fast, 0, np.exp(-1)), (constant, large, 7, by_euler)):
        values, failed = cfjax.map_batch(solve, x, chunk_size=CHUNK)
        np.testing.assert_array_equal(failed, [4, 17])
        assert isinstance(values, diffrax.Solution)
        is_bad = np.asarray(values.result != diffrax.RESULTS.successful)
        np.testing.assert_array_equal(np.flatnonzero(is_bad), [4, 17])
        np.testing.assert_allclose(np.delete(values.ys[:, last, 0], failed), end, rtol=0, atol=1e-7)
        assert np.isinf(values.ts[0, last + 1 :]).all()


def test_entries_that_are_not_finite_are_failures():
    x = np.array([1.0, 0.0, 2.0, 0.0])
    values, failed = cfjax.map_batch(lambda x: {"a": x, "b": 1 / x, "c": 1}, x, chunk_size=3)
    np.testing.assert_array_equal(failed, [1, 3])
    np.testing.assert_array_equal(values["b"], [1, np.inf, 0.5, np.inf])


def every_kind(x):
    return {
        "none": None,
        "float": 0.5,
        "bool": x % 2 == 0,
        "empty": jnp.zeros((0, 2)),
        # NumPy and its files know nothing of this one.
        "bfloat16": jnp.where(x == 7, jnp.nan, x.astype(jnp.bfloat16)),
        "negative zero": -jnp.zeros(2, complex),
        "key": jax.random.fold_in(jax.random.key(3), x),
    }


def check_every_kind(result, x):
    values, failed = result
    np.testing.assert_array_equal(failed, np.flatnonzero(x == 7))
    assert values["none"] is None
    np.testing.assert_array_equal(values["float"], np.full(len(x), 0.5))
    np.testing.assert_array_equal(values["bool"], x % 2 == 0)
    assert values["empty"].shape == (len(x), 0, 2)
    assert values["bfloat16"].dtype == ml_dtypes.bfloat16
    # Small integers are exact.
    np.testing.assert_array_equal(values["bfloat16"].astype(float), np.where(x == 7, np.nan, x))
    assert np.signbit(values["negative zero"].real).all()
    keys = jax.vmap(lambda x: jax.random.fold_in(jax.random.key(3), x))(x)
    assert values["key"].dtype == keys.dtype
    np.testing.assert_array_equal(*map(jax.random.key_data, (values["key"], keys)))


def test_a_round_trip_of_every_kind(tmp_path, computed):
    x = np.arange(SIZE)
    swapped = x.astype(x.dtype.newbyteorder())  # As files of other machines have it.
    check_every_kind(cfjax.map_batch(every_kind, swapped, chunk_size=CHUNK), x)
    del computed[:]
    run = lambda: cfjax.map_batch(every_kind, x, chunk_size=CHUNK, folder=tmp_path)  # noqa: E731
    check_every_kind(run(), x)
    result = run()
    check_every_kind(result, x)
    assert len(computed) == 5
    # The description says where each array is, for those who have not the function.
    expected, batch = result.values, json.loads((tmp_path / "batch.json").read_text())
    assert batch["members"] == SIZE and batch["chunk_size"] == CHUNK
    found = {}
    for array in batch["arrays"]:
        dtype, shape = jnp.dtype(array["dtype"]), array["shape"]
        chunks = [
            np.fromfile(path, dtype, CHUNK * math.prod(shape), offset=array["offset"])
            for path in sorted(tmp_path.glob("chunk_*.bin"))
        ]
        # -1 says nothing of an array without entries.
        size = len(chunks) * CHUNK
        found[array["path"]] = np.concatenate(chunks).reshape(size, *shape)[:SIZE]
    assert sorted(found) == [
        f"[{name!r}]" for name in sorted(expected) if expected[name] is not None
    ]
    (key,) = [array for array in batch["arrays"] if "key" in array]
    found["['key']"] = jax.random.wrap_key_data(found["['key']"], impl=key["key"])
    for name, values in found.items():
        kept = expected[name[2:-2]]
        assert values.dtype == kept.dtype and values.shape == kept.shape
        if name == "['key']":
            values, kept = jax.random.key_data(values), jax.random.key_data(kept)
        assert np.asarray(values).tobytes() == np.asarray(kept).tobytes()


def test_keys_captured_among_the_members_and_returned(tmp_path, computed):
    captured, keys = jax.random.key(1, impl="rbg"), jax.random.split(jax.random.key(2), 3)

    def solve(member):
        key, x = member
        return key, captured, x + jax.random.normal(key, (2,)) + jax.random.normal(captured, (2,))

    members = (keys, np.zeros((3, 2)))
    noise = jax.jit(jax.vmap(solve))((keys, jnp.zeros((3, 2))))[2]
    mesh = jax.make_mesh((1,), ("i",))
    for options in ({"mesh": mesh}, {"folder": tmp_path}, {"folder": tmp_path}):
        returned, same, values = cfjax.map_batch(solve, members, chunk_size=2, **options).values
        for array, expected in ((returned, keys), (same, captured)):
            assert array.dtype == expected.dtype
            assert array.shape == (3,)
            assert (array == expected).all()
        # The compiler may join operations in different ways: rounding.
        np.testing.assert_allclose(values, noise, rtol=0, atol=1e-14)
    assert len(computed) == 4  # The last two chunks are read.


# Files.


def test_an_interrupted_batch_goes_on_where_it_stopped(tmp_path, computed, monkeypatch):
    replace, folder = os.replace, tmp_path / "some" / "results"

    def run(folder):
        return cfjax.map_batch(scaled(2.0), members(), chunk_size=CHUNK, folder=folder).values

    def interrupted(old, new):
        if Path(new).name == "chunk_000002.bin":
            raise KeyboardInterrupt
        replace(old, new)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(os, "replace", interrupted)
        run(folder)
    chunks = [f"chunk_{i:06}.bin" for i in range(5)]
    assert sorted(os.listdir(folder)) == ["batch.json", *chunks[:2]]
    expected = 2 * members()[0]
    np.testing.assert_array_equal(run(folder), expected)
    assert computed == list(members()[0][[0, 5, 10, 10, 15, 20], 0])
    assert sorted(os.listdir(folder)) == ["batch.json", *chunks]
    # What is finished is read, and nothing is compiled for it.
    monkeypatch.setattr(jax.stages.Lowered, "compile", None)
    np.testing.assert_array_equal(run(str(folder)), expected)


def test_an_interrupted_write_leaves_no_file(tmp_path, monkeypatch):
    def interrupted(descriptor):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cfjax.map_batch(lambda x: x, np.ones(3), folder=tmp_path)
    assert os.listdir(tmp_path) == []


def test_no_damage_is_taken_for_results(tmp_path, computed, monkeypatch):
    """As many chunks as there are kinds of damage: every length, and a bit of every byte."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)

    def solve(x):
        return x, x > 1

    cfjax.map_batch(solve, np.arange(2, dtype=np.float32), folder=tmp_path / "one")
    length = (tmp_path / "one" / "chunk_000000.bin").stat().st_size
    damages = [lambda content, n=n: content[:n] for n in range(length)]
    damages += [lambda content: content + b"\0", lambda content: b"something else"]
    for n in range(length):

        def flipped(content, n=n):
            changed = bytearray(content)
            changed[n] ^= 1 << n % 8
            return bytes(changed)

        damages.append(flipped)
    x = np.arange(2 * len(damages), dtype=np.float32)
    run = lambda x=x: cfjax.map_batch(solve, x, chunk_size=2, folder=tmp_path / "many").values  # noqa: E731
    expected = run()
    paths = sorted((tmp_path / "many").glob("chunk_*.bin"))
    before = [path.read_bytes() for path in paths]
    assert {len(content) for content in before} == {length}
    for path, damage, content in zip(paths, damages, before, strict=True):
        path.write_bytes(damage(content))
        assert path.read_bytes() != content
    del computed[:]
    with pytest.warns(
        UserWarning, match=r"chunk_\d{6}\.bin is damaged, and is computed again"
    ) as warned:
        found = run()
    assert len(warned) == len(damages)
    assert computed == list(x[::2])
    np.testing.assert_array_equal(found, expected)
    assert [path.read_bytes() for path in paths] == before
    # What is missing is computed without a warning.
    paths[0].unlink()
    np.testing.assert_array_equal(run(), expected)
    assert computed[-1] == x[0] and paths[0].read_bytes() == before[0]
    # What is no file is not written over, and nothing is computed first.
    paths[0].unlink()
    paths[0].mkdir()
    del computed[:]
    text = r"folder must hold files, but in '.*many' chunk_000000\.bin is a folder\. Remove it"
    with pytest.raises(IsADirectoryError, match=text):
        run()
    assert computed == []
    paths[0].rmdir()
    paths[0].write_bytes(before[0])
    del computed[:]
    with pytest.raises(ValueError, match="other members"):
        run(x + 1)
    np.testing.assert_array_equal(run(), expected)
    assert computed == []


@pytest.mark.skipif(os.name != "posix", reason="Modes of files are of POSIX.")
def test_files_have_the_mode_that_the_user_wants(tmp_path):
    old = os.umask(0o027)
    try:
        cfjax.map_batch(lambda x: x, np.ones(3), folder=tmp_path)
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "chunk_000000.bin").stat().st_mode) == 0o640


def test_what_a_killed_process_leaves_is_removed(tmp_path, monkeypatch):
    replace = os.replace
    for name, left in [("batch", ["batch"]), ("chunk", ["batch", "chunk_000000"])]:
        folder = tmp_path / name

        def killed(part, path, name=name):
            if name in Path(path).name:
                raise KeyboardInterrupt
            replace(part, path)

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(os, "replace", killed)
            patch.setattr(Path, "unlink", lambda path, missing_ok: None)
            cfjax.map_batch(lambda x: x, np.ones(3, np.float32), folder=folder)
        found = sorted(os.listdir(folder))
        assert [path.split(".")[0] for path in found] == left and found[-1].endswith(".part")
        # Another batch too may have a folder in which no chunk is finished.
        cfjax.map_batch(lambda x: x, np.ones(3), folder=folder)
        assert sorted(os.listdir(folder)) == ["batch.json", "chunk_000000.bin"]


def test_another_process_writes_the_same_chunk_at_the_same_time(tmp_path, monkeypatch):
    x = np.arange(3.0)
    run = lambda: cfjax.map_batch(lambda x: 2 * x, x, folder=tmp_path).values  # noqa: E731
    run()
    path = tmp_path / "chunk_000000.bin"
    path.unlink()
    sync, others, parts = os.fsync, [run], []

    def other_comes_between(descriptor):
        sync(descriptor)
        parts.append(len(list(tmp_path.glob("*.part"))))
        while others:
            np.testing.assert_array_equal(others.pop()(), 2 * x)
            assert path.exists()

    monkeypatch.setattr(os, "fsync", other_comes_between)
    np.testing.assert_array_equal(run(), 2 * x)
    assert others == []
    # Each has a file of its own. If one began the file that another one gave its name, a third one
    # would read less than all of it.
    assert max(parts) == 2
    assert sorted(os.listdir(tmp_path)) == ["batch.json", "chunk_000000.bin"]
    # What is there is read.
    monkeypatch.setattr(jax.stages.Lowered, "compile", None)
    np.testing.assert_array_equal(run(), 2 * x)


def test_another_process_begins_the_same_batch_at_the_same_time(tmp_path, monkeypatch):
    """Between two looks at the folder it writes the description and all chunks."""
    x = np.arange(3.0)
    run = lambda: cfjax.map_batch(lambda x: 2 * x, x, folder=tmp_path).values  # noqa: E731
    others, read = [run], Path.read_bytes

    def missing(path):
        if path.name == "batch.json" and others:
            others.pop()()
            raise FileNotFoundError(path)
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", missing)
    np.testing.assert_array_equal(run(), 2 * x)
    assert others == []


def test_a_file_that_another_process_holds(tmp_path, monkeypatch, computed):
    """Some file systems refuse to read or replace it at that moment."""
    x = np.arange(3.0)
    run = lambda: cfjax.map_batch(lambda x: 2 * x, x, folder=tmp_path).values  # noqa: E731
    run()
    read, refused = Path.read_bytes, []

    def once(path):
        if path not in refused:
            refused.append(path)
            raise OSError("Stale file handle")
        return read(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", once)
        np.testing.assert_array_equal(run(), 2 * x)
    assert len(refused) == 2 and len(computed) == 1

    def held(old, new):
        raise PermissionError(f"{new} is open")

    monkeypatch.setattr(os, "replace", held)
    # Written by another process after this one has looked for it.
    path = tmp_path / "chunk_000000.bin"
    content = path.read_bytes()
    path.unlink()
    sync = os.fsync

    def other_comes_between(descriptor):
        sync(descriptor)
        path.write_bytes(content)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", other_comes_between)
        np.testing.assert_array_equal(run(), 2 * x)
    assert sorted(os.listdir(tmp_path)) == ["batch.json", "chunk_000000.bin"]
    path.unlink()
    with pytest.raises(PermissionError, match="is open"):
        run()
    assert os.listdir(tmp_path) == ["batch.json"]


@pytest.mark.skipif(os.name != "posix", reason="Elsewhere no folder can be opened.")
def test_the_name_of_a_file_is_on_the_disk_too(tmp_path, monkeypatch):
    events = []
    sync, replace, open_ = os.fsync, os.replace, os.open

    def spied_sync(descriptor):
        events.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        sync(descriptor)

    def spied_replace(old, new):
        events.append("name")
        replace(old, new)

    monkeypatch.setattr(os, "fsync", spied_sync)
    monkeypatch.setattr(os, "replace", spied_replace)
    cfjax.map_batch(lambda x: x, np.ones(3), folder=tmp_path)
    # The description, then the chunk.
    assert events == 2 * ["file", "name", "folder"]

    def no_folders(path, *arguments, **options):
        if os.path.isdir(path):
            raise PermissionError
        return open_(path, *arguments, **options)

    monkeypatch.setattr(os, "open", no_folders)
    cfjax.map_batch(lambda x: x, np.ones(3), folder=tmp_path / "other")
    assert events[6:] == 2 * ["file", "name"]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_folder_belongs_to_one_batch(tmp_path, computed, subtests):
    """Nothing is read from another batch, nothing overwritten, and the way out is said."""
    call = {"solve": scaled(jnp.asarray(2.0)), "members": members(), "chunk_size": CHUNK}
    cfjax.map_batch(**call, folder=tmp_path)
    before = contents(tmp_path)
    del computed[:]
    others = members()
    others[0][7, 0] += 1
    another = "the results of another computation.*"
    for name, changes, message in (
        ("constant", {"solve": scaled(2.5)}, another),
        ("constant in an array", {"solve": scaled(jnp.asarray(3.0))}, another),
        ("chunk_size", {"chunk_size": 10}, "chunk_size 5 where 10 is expected"),
        ("number", {"members": members(30)}, "members 23 where 30 is expected"),
        (
            "all",
            {"members": members(30), "chunk_size": 10},
            "members 23 where 30 is expected, chunk_size 5 where 10 is expected",
        ),
        ("values", {"members": others}, "the results of other members in chunk_000001.bin"),
    ):
        text = rf"folder must be empty or hold this batch, but .* holds {message}\. It is left as"
        with subtests.test(other=name), pytest.raises(ValueError, match=text):
            cfjax.map_batch(**(call | changes), folder=tmp_path)
        assert computed == []
        assert contents(tmp_path) == before


def test_a_folder_of_another_version_or_without_its_description(tmp_path, monkeypatch, subtests):
    run = lambda: cfjax.map_batch(lambda x: x, np.ones(3), folder=tmp_path)  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(cfjax, "__version__", "0.1.0")
        run()
    with pytest.raises(ValueError, match=f"holds cfjax '0.1.0' where '{cfjax.__version__}' is"):
        run()
    for text, message in (
        (b"{", "a batch.json that is damaged"),
        (b"[]", "damaged"),
        (b"\xff", "a batch.json that is damaged"),
        (None, "chunks, but no batch.json"),
    ):
        if text is None:
            (tmp_path / "batch.json").unlink()
        else:
            (tmp_path / "batch.json").write_bytes(text)
        with subtests.test(text=str(text)), pytest.raises(ValueError, match=message):
            run()


# A folder's key: each of these captures its parameter in another place.


def decay(parameter):
    term = cfjax.LieTerm(lambda t, y, args: -y / parameter)
    return lambda y: cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, y, num_steps=10).ys[-1]


def network(parameter):
    mlp = eqx.nn.MLP(3, 3, 4, 1, key=jax.random.key(0))
    return jax.jit(lambda y: mlp(y) + parameter[0])


def jitted(parameter):
    return jax.jit(jax.jit(lambda y: jnp.where(y > 0, y * np.asarray(parameter), 1.0)))


def custom_derivative(parameter):
    @jax.custom_jvp
    def scaled(y):
        return parameter * y

    scaled.defjvp(lambda primals, tangents: (scaled(*primals), np.asarray(parameter) * tangents[0]))
    return jax.grad(lambda y: jnp.sum(jnp.where(y > 0, scaled(y), y)))


def branch(parameter):
    return lambda y: jax.lax.cond(y[0] > 0, lambda: y, lambda: y - parameter)


def loop(parameter):
    return lambda y: jax.lax.while_loop(lambda y: y[0] < 1, lambda y: y + parameter, y)


def operator(parameter):
    """The jaxpr shows where in memory the function lies, and the set in an order by chance."""
    tags = {lineax.symmetric_tag, lineax.positive_semidefinite_tag, lineax.diagonal_tag}
    scaled = lambda x, factor=float(parameter[0]): factor * x  # noqa: E731

    def solve(y):
        scale = lineax.FunctionLinearOperator(scaled, jax.eval_shape(lambda: y), tags)
        return lineax.linear_solve(scale, y, lineax.GMRES(1e-8, 1e-8)).value

    return solve


def one_of_many(parameter):
    table = np.zeros(1000)
    table[567] = parameter[1]
    return jax.jit(lambda y: y + jnp.asarray(table)[jnp.argmax(y)])


SOLVES = {
    "array in the field": decay,
    "number in the field": lambda parameter: decay(float(parameter[0])),
    "network": network,
    "jit": jitted,
    "custom derivative": custom_derivative,
    "branch": branch,
    "loop": loop,
    "operator": operator,
    "one of many": one_of_many,
}


class NotCompiled(Exception):
    pass


def key(solve, **options):
    """What tells the computation from others in a folder, which is there before it is compiled."""

    def not_compiled(self):
        raise NotCompiled

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.stages.Lowered, "compile", not_compiled)
        with pytest.raises(NotCompiled):
            cfjax.map_batch(solve, np.ones((4, 3)), folder=folder, **options)
        return json.loads(Path(folder, "batch.json").read_text())["computation"]


@pytest.mark.parametrize(
    "names",
    [
        ("array in the field", "operator", "one of many"),
        pytest.param(tuple(SOLVES), marks=pytest.mark.slow),
    ],
    ids=["some", "all"],
)
def test_a_key_knows_every_constant_to_the_last_bit(names, subtests):
    parameter = np.asarray([0.1, 0.2, 0.3])
    for name in names:
        with subtests.test(name=name):
            first = key(SOLVES[name](parameter))
            assert key(SOLVES[name](parameter.copy())) == first
            assert key(SOLVES[name](np.nextafter(parameter, 1))) != first


@pytest.mark.skipif(
    not hasattr(jax.config, "jax_use_simplified_jaxpr_constants"), reason="For a time only."
)
def test_a_key_knows_constants_that_jax_makes_inputs():
    jax.config.update("jax_use_simplified_jaxpr_constants", True)
    try:
        first, again, other = (key(one_of_many(np.arange(3.0) + x)) for x in (0, 0, 1))
    finally:
        jax.config.update("jax_use_simplified_jaxpr_constants", False)
    assert first == again != other


KEYS = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(Path(__file__).parents[1])!r}]
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
import numpy as np
import test_batch
for name in reversed(test_batch.SOLVES):
    solve = test_batch.SOLVES[name](np.asarray([0.1, 0.2, 0.3]))
    print(name, test_batch.key(solve), sep=":")
"""


@pytest.mark.slow
def test_a_key_is_the_same_in_every_process_and_after_other_programs():
    parameter = np.asarray([0.1, 0.2, 0.3])
    keys = {name: key(make(parameter)) for name, make in SOLVES.items()}
    for make in SOLVES.values():  # The same functions of jax and equinox in other programs.
        jax.eval_shape(jax.vmap(make(2 * parameter)), jnp.ones((2, 3)))
    assert {name: key(SOLVES[name](parameter)) for name in reversed(SOLVES)} == keys
    # Nor does the order of sets count, which is another one in every process.
    elsewhere = subprocess.run(
        [sys.executable, "-c", KEYS],
        env=os.environ
        | {"PYTHONHASHSEED": "7", "JAX_PLATFORMS": "cpu"}
        # As here: it decides the last bit of the network's first weights.
        | {
            "JAX_DISABLE_MOST_OPTIMIZATIONS": str(jax.config.read("jax_disable_most_optimizations"))
        },
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    assert dict(line.split(":") for line in elsewhere.stdout.splitlines()) == keys


def test_a_key_does_not_know_what_jax_remembers():
    """A function that jax knows is shared by its calls, and one that it has forgotten is not."""
    called = jax.jit(lambda y: jnp.where(y > 0, jnp.sin(y), y))

    def solve(y, forget):
        y = called(eqx.error_if(y, y > 2, "too large"))
        if forget:
            jax.clear_caches()
        return called(eqx.error_if(y, y > 2, "too large")) + called(y)

    texts = [jax.jit(solve, static_argnums=1).lower(jnp.ones(3), x).as_text() for x in (0, 1)]
    assert texts[0].count("func.func") < texts[1].count("func.func")
    assert key(lambda y: solve(y, False)) == key(lambda y: solve(y, True))


def test_a_key_knows_versions_precision_device_and_mesh(monkeypatch, no_shape_hook):
    matrix = np.ones((3, 3), np.float32)
    solve = lambda y: matrix @ y.astype(np.float32)  # noqa: E731
    keys = [key(solve)]
    with jax.default_matmul_precision("highest"):
        keys.append(key(solve))
    keys.append(key(solve, mesh=jax.make_mesh((1,), ("i",))))
    for module in (cfjax, jax, jaxlib.version):
        with monkeypatch.context() as patch:
            patch.setattr(module, "__version__", "another")
            keys.append(key(solve))

    (device,) = jnp.zeros(()).devices()
    with monkeypatch.context() as patch:
        patch.setattr(type(device), "device_kind", "H100")
        keys.append(key(solve))
    assert len(set(keys)) == len(keys)


# Functions of the host.


def on_host(y):
    return jax.pure_callback(np.sin, y, y, vmap_method="expand_dims")


def host_in_a_loop(y):
    return jax.lax.fori_loop(0, 3, lambda i, y: jax.jit(on_host)(y), y)


def host_in_an_operator(y):
    shape = jax.ShapeDtypeStruct(y.shape, y.dtype)
    return lineax.linear_solve(
        lineax.FunctionLinearOperator(host_in_a_loop, shape), y, lineax.GMRES(1e-8, 1e-8)
    ).value


def progress_meter(y):
    term, meter = diffrax.ODETerm(lambda t, y, args: -y), diffrax.TextProgressMeter()
    return diffrax.diffeqsolve(
        term, diffrax.Euler(), 0.0, 1.0, 0.5, y, progress_meter=meter, throw=False
    ).ys


def test_no_folder_where_the_host_gives_values(tmp_path, subtests):
    for name, solve in {
        "in a loop": host_in_a_loop,
        "in an operator": host_in_an_operator,
        "progress meter": progress_meter,
        "io": lambda y: io_callback(np.sin, y, y),
        "pure": lambda y: eqx.filter_pure_callback(
            np.sin, y, result_shape_dtypes=y, vmap_method="expand_dims"
        ),
    }.items():
        checked = lambda y, solve=solve: solve(eqx.error_if(y, y < 0, "negative"))  # noqa: E731
        with (
            subtests.test(solve=name),
            pytest.raises(ValueError, match="calls a function of the host"),
        ):
            cfjax.map_batch(checked, np.ones((4, 3)), folder=tmp_path / "none")
        assert os.listdir(tmp_path) == []


def test_prints_and_checks_of_equinox_give_no_values(tmp_path, capfd):
    def solve(y):
        jax.debug.print("y = {}", y)
        loss = lambda y: jnp.sum(eqx.error_if(y, y < 0, "negative") ** 2)  # noqa: E731
        return jax.grad(loss)(y), jax.hessian(loss)(y)

    for _ in range(2):
        values, _ = cfjax.map_batch(solve, np.ones((2, 1)), folder=tmp_path)
        jax.effects_barrier()
        np.testing.assert_array_equal(values[0], np.full((2, 1), 2.0))
    assert capfd.readouterr().out == 2 * "y = [1.]\n"
    with pytest.raises(Exception, match="negative"):
        cfjax.map_batch(solve, -np.ones((2, 1)), folder=tmp_path / "other")


# Many devices. Each needs a process of its own, as jax fixes its devices when it starts.

PROGRAM = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(Path(__file__).parents[1])!r}]
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
x = np.arange(test_batch.SIZE)
for _ in range(2):
    result = cfjax.map_batch(test_batch.every_kind, x, mesh=mesh, folder=sys.argv[3] + "_of_kinds")
    test_batch.check_every_kind(result, x)
# Every process says so, though one alone looks.
with test_batch.pytest.raises(ValueError, match="holds members 23 where 8 is expected"):
    cfjax.map_batch(lambda x: x, np.ones(8), mesh=mesh, folder=sys.argv[3])
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


def test_eight_devices(tmp_path):
    process = start(8, tmp_path / "values.npy", "4x2", tmp_path / "chunks")
    _, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    # The batch has eight members instead of five.
    assert len(list((tmp_path / "chunks").glob("chunk_*.bin"))) == 3
    check_against_one_device(tmp_path / "values.npy")


@pytest.mark.slow
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
    assert len(list((tmp_path / "chunks").glob("chunk_*.bin"))) == 3
    for i in range(2):
        check_against_one_device(tmp_path / f"values{i}.npy")


# Wrong inputs.


def test_wrong_arguments(tmp_path, monkeypatch, no_shape_hook, subtests):
    monkeypatch.chdir(tmp_path)
    no_array = r"members\[0\] must be an array of numbers"
    of_members = [
        ((), TypeError, "at least one array"),
        ((np.ones(2), 1.0), TypeError, r"members\[1\] must be an array"),
        ((np.ones(2), np.ones(())), TypeError, r"members\[1\] must be an array"),
        ((np.ones(2), np.ones((3, 2))), ValueError, r"members\[0\]': 2, 'members\[1\]': 3"),
        ((np.ones((0, 2)),), ValueError, "must not be empty"),
        (jax.random.key(0), TypeError, "members must be an array of numbers or of PRNG keys"),
        ((np.array(["a"]),), TypeError, no_array),
        ((np.array([None]),), TypeError, no_array),
        ((np.ones(2, "M8[s]"),), TypeError, no_array),
        ((np.ones(2, np.longdouble),), TypeError, no_array),
        ((np.ones(2, np.clongdouble),), TypeError, no_array),
        ([1.0, 2.0], TypeError, r"members\[0\] must be an array of numbers.*got 1\.0"),
        ((np.ma.masked_less(np.ones(2), 2),), TypeError, r"members\[0\] must not be masked"),
    ]
    cases = [(wrong, {}, kind, message) for wrong, kind, message in of_members]
    for chunk_size in (0, -1, 2.0, True):
        text = "chunk_size must be an integer of at least 1, got"
        cases.append((np.ones(2), {"chunk_size": chunk_size}, ValueError, text))
    cases += [
        (np.ones(2), {"mesh": 4}, TypeError, r"mesh must be a jax\.sharding\.Mesh, got 4\."),
        (np.ones(2), {"folder": ""}, ValueError, r"folder must not be empty, got ''\."),
        (np.ones(2), {"folder": 3}, TypeError, "folder must be a path or None, got 3"),
    ]
    for number, (wrong, options, kind, message) in enumerate(cases):
        with (
            subtests.test(case=f"{number}: {message}"),
            pytest.raises(kind, match=message),
        ):
            cfjax.map_batch(lambda x: x, wrong, **options)
    assert not any(tmp_path.iterdir())


def test_members_in_dtypes_that_jax_knows_by_another_name(monkeypatch):
    """`np.longdouble` is a double on macOS on ARM and on Windows; `np.longlong` is one everywhere.

    What jax takes has at most 64 bits, and in complex numbers twice as many.
    """
    x = np.arange(3, dtype=np.longlong)
    np.testing.assert_array_equal(cfjax.map_batch(lambda x: 2 * x, x).values, [0, 2, 4])
    monkeypatch.setattr(np, "longdouble", np.float64)
    monkeypatch.setattr(np, "clongdouble", np.complex128)
    for dtype in (np.float64, np.complex128):
        x = np.arange(3).astype(dtype)
        np.testing.assert_array_equal(cfjax.map_batch(lambda x: 2 * x, x).values, [0, 2, 4])


def test_what_is_no_folder_or_no_file(tmp_path):
    path, is_file = tmp_path / "file", r"folder must hold files, .* batch\.json is a fold"
    path.write_text("mine")
    (tmp_path / "folder" / "batch.json").mkdir(parents=True)
    no_folder = r"folder must be a folder, or a path where one .* got '"
    for folder, kind, text in (
        (path, OSError, no_folder),
        (path / "results", OSError, no_folder),
        (tmp_path / "folder", IsADirectoryError, is_file),
    ):
        with pytest.raises(kind, match=text):
            cfjax.map_batch(lambda x: x, np.ones(3), folder=folder)
    assert path.read_text() == "mine"


# Within transformations.


def test_no_traced_value_is_captured(tmp_path, no_shape_hook, subtests):
    captured = (
        "solve must not capture values that are traced, .* map_batch compiles and runs solve "
        r"itself: call it outside of jax\.jit, jax\.vmap, jax\.grad and loops"
    )

    def run(scale):
        return jnp.asarray(
            cfjax.map_batch(lambda x: scale * x, np.ones((4, 3)), folder=tmp_path / "no").values[0]
        )

    noise = lambda key: cfjax.map_batch(lambda x: x + jax.random.normal(key), np.ones(2)).values  # noqa: E731
    for name, transformed, x in (
        ("jit", jax.jit(run), jnp.ones(3)),
        ("vmap", jax.vmap(run), jnp.ones((1, 3))),
        ("jacrev", jax.jacrev(run), jnp.ones(3)),
        ("jacfwd", jax.jacfwd(run), jnp.ones(3)),
        ("scan", lambda x: jax.lax.scan(lambda y, _: (run(y), None), x, length=2), jnp.ones(3)),
        ("a key", jax.jit(noise), jax.random.key(0)),
    ):
        with subtests.test(transformed=name), pytest.raises(TypeError, match=captured):
            transformed(x)
    assert os.listdir(tmp_path) == []
    with pytest.raises(TypeError, match=r"members\['x'\] must be an array with values, .* traced"):
        jax.jit(lambda x: cfjax.map_batch(lambda m: m["x"], {"x": x}).values)(jnp.ones(2))
    # Without them it is a function of the host like others.
    found = jax.jit(lambda x: x + cfjax.map_batch(lambda m: 2 * m, np.ones(2)).values)(jnp.ones(2))
    np.testing.assert_array_equal(found, [3, 3])


# Errors within the solve.


def test_an_error_names_the_member(tmp_path, computed, capfd):
    """One in a chunk of five, two in the last chunk of three: the first of them."""

    def solve(x):
        return eqx.error_if(x, x < 0, "the member is negative:\n\nbe positive")

    x = np.arange(1.0, SIZE + 1)
    mesh = jax.make_mesh((1,), ("i",))
    for bad, chunks, options in [([7], 1, {}), ([22, 21], 4, {"mesh": mesh}), ([20], 4, {})]:
        del computed[:]
        changed = x.copy()
        changed[bad] *= -1
        folder = tmp_path / str(bad)
        text = rf"solve failed for member {min(bad)}: the member is negative:\n\nbe positive\n"
        with pytest.raises(eqx.EquinoxRuntimeError, match=text) as raised:
            cfjax.map_batch(solve, changed, chunk_size=CHUNK, folder=folder, **options)
        message = str(raised.value)
        assert "use throw=False in cfjax.integrate or diffrax.diffeqsolve" in message
        assert len(message.splitlines()) == 4
        assert raised.value.__cause__ is None and raised.value.__context__ is None
        # The chunks before are kept, and the search took few programs: log2(5) of them, and two.
        assert len(list(folder.glob("chunk_*.bin"))) == chunks
        assert len(computed) <= chunks + 1 + 3 + 1
    assert capfd.readouterr() == ("", "")


def test_a_failed_solve_names_the_member():
    y0 = np.full((SIZE, 1), 0.1)
    y0[17] = 3.0
    term = cfjax.LieTerm(lambda t, y, args: y * y)

    def solve(y0):
        return cfjax.integrate(term, cfjax.LieEuler(), 0.0, 9.0, y0, num_steps=90).ys

    with pytest.raises(eqx.EquinoxRuntimeError, match="solve failed for member 17: Nonfinite"):
        cfjax.map_batch(solve, y0, chunk_size=CHUNK)


def test_an_error_that_no_member_repeats_names_the_chunk(monkeypatch):
    checked = lambda x: eqx.error_if(x, x < 0, "negative")  # noqa: E731
    x = np.ones(SIZE)
    x[7] = -1
    run = lambda: cfjax.map_batch(checked, x, chunk_size=CHUNK)  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(jax, "process_count", lambda: 2)
        with pytest.raises(eqx.EquinoxRuntimeError, match="one of the members 5 to 9: negative"):
            run()
    call, calls = jax.stages.Compiled.__call__, []

    def once(self, inputs):
        calls.append(inputs)
        return call(self, inputs) if len(calls) < 3 else inputs

    monkeypatch.setattr(jax.stages.Compiled, "__call__", once)
    with pytest.raises(eqx.EquinoxRuntimeError, match="one of the members 5 to 9: negative"):
        run()


def test_another_error_has_the_members_in_a_note(capfd):
    def failing(x):
        if np.any(x < 0):
            raise ArithmeticError("not on my host")
        return x

    def solve(x):
        return jax.pure_callback(failing, x, x, vmap_method="expand_dims")

    x = np.ones(SIZE)
    x[7] = -1
    with pytest.raises(RuntimeError, match="not on my host") as raised:
        cfjax.map_batch(solve, x, chunk_size=CHUNK)
    assert raised.value.__notes__ == ["cfjax.map_batch was solving the members 5 to 9."]
