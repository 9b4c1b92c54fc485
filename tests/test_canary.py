"""What the code relies on in jax, equinox and diffrax beyond what these promise.

A new release that changes one of these fails here, with a sentence, and not in a user's solve.
"""

import ast
import importlib
import inspect
import pkgutil
import re
from functools import cache
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Literal, Primitive, jaxpr_as_fun, jaxprs_in_params
from jax.interpreters import ad, batching, mlir

import cfjax
import cfjax._xla
from cfjax._batch import fingerprint
from cfjax._measure import flops, lowered
from cfjax._numerics import jumps
from cfjax._paper import rigid_body, stiefel
from cfjax._xla import understood

PACKAGE = Path(cfjax.__file__).parent
HOSTS = "jax", "jaxlib", "equinox", "diffrax"

# Names


def names_in(path: Path) -> set[str]:
    """Every dotted name of the host libraries that a file uses, by what it imports."""
    tree = ast.parse(path.read_text())
    roots, found = {}, set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                roots[alias.asname or alias.name.partition(".")[0]] = (
                    alias.name if alias.asname else alias.name.partition(".")[0]
                )
                found.add(alias.name)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                roots[alias.asname or alias.name] = f"{node.module}.{alias.name}"
                found.add(f"{node.module}.{alias.name}")
    for node in ast.walk(tree):
        names = []
        while isinstance(node, ast.Attribute):
            names.append(node.attr)
            node = node.value
        if names and isinstance(node, ast.Name) and node.id in roots:
            found.add(".".join([roots[node.id], *reversed(names)]))
    return {name for name in found if name.partition(".")[0] in HOSTS}


@cache
def exists(name: str) -> bool:
    """Attributes of what is no module and no class are of values, such as those of a setting."""
    value, parts = None, name.split(".")
    for n, part in enumerate(parts, 1):
        try:
            value = getattr(value, part) if n > 1 else importlib.import_module(part)
        except AttributeError:
            try:
                value = importlib.import_module(".".join(parts[:n]))
            except ImportError:
                return not (inspect.ismodule(value) or inspect.isclass(value))
    return True


USED = {
    str(path.relative_to(PACKAGE)): names_in(path)
    for path in sorted(PACKAGE.rglob("*.py"))
    if names_in(path)
}


def test_every_name_of_a_host_library_exists():
    missing = {place: [x for x in sorted(names) if not exists(x)] for place, names in USED.items()}
    missing = {place: names for place, names in missing.items() if names}
    assert not missing, f"cfjax uses names that this version lacks, in these files: {missing}"


def test_the_names_are_found():
    """The list above is not empty, and a name that is gone would be seen."""
    assert "jax.interpreters.mlir.register_lowering" in set().union(*USED.values())
    assert not exists("jax.interpreters.mlir.no_such_name")
    assert not exists("jax.no_such_module.name")


# Primitives, by name: a program that has one, and the parameters that are read.

X = np.linspace(0.1, 0.9, 3)
M = np.eye(3) + 0.1
A, FIRST = jnp.asarray(X), jnp.asarray([0])
Z = X + 1j * X
UNARY = (
    "abs acos acosh asin asinh atan atanh cbrt ceil cos cosh erf exp exp2 expm1 floor is_finite "
    "log log1p logistic neg round rsqrt sign sin sinh sqrt square tan tanh cumsum cumprod"
)
BINARY = "add sub mul div atan2 eq ge gt le lt max min ne pow rem complex"


def _linear_solve(x: Any) -> Any:
    return lax.custom_linear_solve(lambda v: 2 * v, x, lambda f, b: b / 2, symmetric=True)


@jax.custom_jvp
def _with_jvp(x):
    return x


_with_jvp.defjvp(lambda primals, tangents: (primals[0], tangents[0]))


@jax.custom_vjp
def _with_vjp(x):
    return x


_with_vjp.defvjp(lambda x: (x, None), lambda _, g: (g,))


@custom_vmap
def _with_vmap(x):
    return x


_with_vmap.def_vmap(lambda axis_size, in_batched, x: (x, in_batched[0]))

SCATTER = "dimension_numbers", "update_jaxpr", "indices_are_sorted", "unique_indices", "mode"
SLICE, SCAN = ("start_indices", "limit_indices", "strides"), ("length", "jaxpr", "reverse")
EXAMPLES: dict[str, tuple[Any, tuple[Any, ...], tuple[str, ...]]] = {
    **{name: (getattr(lax, name), (X,), ()) for name in UNARY.split()},
    **{name: (getattr(lax, name), (X, X), ()) for name in BINARY.split()},
    **{name: (getattr(lax, name), (Z,), ()) for name in ("real", "imag", "conj")},
    "add_any": (jax.grad(lambda x: jnp.sum(jnp.sin(x) * jnp.cos(x))), (X,), ()),
    "and": (lax.bitwise_and, (X > 0, X > 0), ()),
    "or": (lax.bitwise_or, (X > 0, X > 0), ()),
    "xor": (lax.bitwise_xor, (X > 0, X > 0), ()),
    "not": (lax.bitwise_not, (X > 0,), ()),
    "argmax": (jnp.argmax, (X,), ()),
    "argmin": (jnp.argmin, (X,), ()),
    "bitcast_convert_type": (lambda x: lax.bitcast_convert_type(x, jnp.int64), (X,), ()),
    "broadcast_in_dim": (
        lambda x: lax.broadcast_in_dim(x, (2, 3), (1,)),
        (X,),
        ("broadcast_dimensions",),
    ),
    "cholesky": (lax.linalg.cholesky, (M,), ()),
    "clamp": (lax.clamp, (X, X, X), ()),
    "concatenate": (lambda x: jnp.concatenate([x, x]), (X,), ("dimension",)),
    "cond": (lambda x: lax.cond(x[0] > 0, lambda: x, lambda: 2 * x), (X,), ("branches",)),
    "convert_element_type": (lambda x: x.astype(jnp.float32), (A,), ()),
    "copy": (lax.copy_p.bind, (X,), ()),
    "cumprod": (lax.cumprod, (X,), ("axis",)),
    "cumsum": (lax.cumsum, (X,), ("axis",)),
    "custom_jvp_call": (_with_jvp, (X,), ("call_jaxpr",)),
    "custom_linear_solve": (_linear_solve, (X,), ("const_lengths", "jaxprs")),
    "custom_vjp_call": (_with_vjp, (X,), ("call_jaxpr",)),
    "custom_vmap_call": (_with_vmap, (X,), ("call",)),
    "dot_general": (jnp.dot, (M, X), ("dimension_numbers",)),
    "dynamic_slice": (lambda x: lax.dynamic_slice(x, (0,), (2,)), (X,), ()),
    "dynamic_update_slice": (lambda x: lax.dynamic_update_slice(x, x[:2], (0,)), (X,), ()),
    "eigh": (jnp.linalg.eigh, (M,), ()),
    "fft": (jnp.fft.fft, (X,), ("fft_lengths",)),
    "gather": (lambda x: x[jnp.asarray([0, 1])], (A,), ()),
    "integer_pow": (lambda x: lax.integer_pow(x, 3), (X,), ("y",)),
    "iota": (lambda: lax.iota(jnp.float32, 3), (), ("dtype", "shape", "dimension")),
    "lu": (lax.linalg.lu, (M,), ()),
    "optimization_barrier": (lax.optimization_barrier, (X,), ()),
    "pad": (lambda x: lax.pad(x, 0.0, [(1, 1, 0)]), (X,), ()),
    "pure_callback": (lambda x: jax.pure_callback(np.sin, x, x), (X,), ("callback",)),
    "qr": (jnp.linalg.qr, (M,), ("full_matrices",)),
    "reduce_and": (jnp.all, (X > 0,), ("axes",)),
    "reduce_or": (jnp.any, (X > 0,), ("axes",)),
    "reduce_max": (jnp.max, (X,), ()),
    "reduce_min": (jnp.min, (X,), ()),
    "reduce_prod": (jnp.prod, (X,), ()),
    "reduce_sum": (jnp.sum, (X,), ("axes",)),
    "reshape": (lambda x: lax.reshape(x, (3, 1)), (X,), ()),
    "rev": (lambda x: lax.rev(x, (0,)), (X,), ("dimensions",)),
    "scan": (lambda x: lax.scan(lambda c, b: (c + b, c), x[0], x), (X,), SCAN),
    "scatter": (lambda x: x.at[FIRST].set(1.0), (A,), SCATTER),
    "select_n": (lambda x: lax.select(x > 0, x, x), (X,), ()),
    "slice": (lambda x: lax.slice(x, (0,), (2,)), (X,), SLICE),
    "split": (lambda x: lax.split(x, (1, 2)), (X,), ()),
    "squeeze": (lambda x: lax.squeeze(x, (0,)), (X[None],), ()),
    "transpose": (lambda x: lax.transpose(x, (1, 0)), (M,), ("permutation",)),
    "triangular_solve": (
        lambda a: lax.linalg.triangular_solve(a, a, left_side=True),
        (M,),
        ("unit_diagonal",),
    ),
    "unstack": (jnp.unstack, (M,), ("axis",)),
    "while": (lambda x: lax.while_loop(lambda v: v[0] < 1, lambda v: v + 1, x), (X,), ()),
}
# One of these names, whichever this version has, with the parameters.
NAMED = {(name,): example for name, example in EXAMPLES.items()} | {
    ("jit", "pjit"): (jax.jit(jnp.sin), (X,), ("jaxpr",)),
    ("scatter-add", "scatter_add"): (lambda x: x.at[FIRST].add(1.0), (A,), SCATTER[:2]),
    ("scatter-mul", "scatter_mul"): (lambda x: x.at[FIRST].mul(2.0), (A,), SCATTER[:1]),
    ("checkpoint", "remat2"): (jax.checkpoint(jnp.sin), (X,), ("jaxpr",)),
}
# Written down beside the others, for versions and programs in which they occur.
ELSEWHERE = {
    "closed_call": "what `jax.core.closed_call` makes",
    "stack": "a call in later versions",
    "stop_gradient": "a call in earlier versions",
}


def equations(jaxpr: Any) -> dict[str, Any]:
    """By name, one equation of each kind in a program and in those within it."""
    found = {}
    for eqn in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        for inner in jaxprs_in_params(eqn.params):
            found.update(equations(inner))
        found[eqn.primitive.name] = eqn
    return found


def test_a_primitive_has_its_name_and_parameters(subtests):
    """An operation with one that the rules do not know is not scalarised, and programs are slow."""
    for names, (fun, args, parameters) in NAMED.items():
        with subtests.test(names=names):
            found = equations(jax.make_jaxpr(fun)(*args))
            name = next((name for name in names if name in found), None)
            assert name, (
                "cfjax/_xla and cfjax/_measure/flops.py know an operation by a name that it has no "
                f"more: expected {' or '.join(names)}, got {', '.join(sorted(found))}."
            )
            known = found[name].params
            missing = set(parameters) - known.keys()
            assert not missing, (
                f"cfjax/_xla or cfjax/_measure/flops.py reads parameters that {name} has no more: "
                f"expected {', '.join(sorted(missing))}, got {', '.join(sorted(known))}."
            )
            for name in found.keys() & RULES:
                assert understood.is_understood(found[name]), (
                    f"{name} has the parameters {found[name].params}, which "
                    "cfjax/_xla/understood.py does not know all."
                )


RULES = {*understood.ELEMENTWISE, *understood.REDUCTIONS, *understood._PARAMETERS}
# What is at the top of a module of names of parameters.
PARAMETERS = {"_GATHER", "_HANDED_ON", "_PARAMETERS_OF_A_PRODUCT", "_SCATTER"}


def tables():
    """Every set or table at the top of a module that is of names of primitives."""
    modules = [
        flops,
        jumps,
        *(
            importlib.import_module(f"cfjax._xla.{found.name}")
            for found in pkgutil.iter_modules(cfjax._xla.__path__)
        ),
    ]
    for module in modules:
        for name, value in vars(module).items():
            is_table = isinstance(value, dict | frozenset | set) and value
            is_table = is_table and set(value) != {"loop", "step"} and name not in PARAMETERS
            if is_table and not name.startswith("__") and all(isinstance(x, str) for x in value):
                yield f"{module.__name__}.{name}", value


def test_every_primitive_in_a_table_is_tried_above():
    known = {*ELSEWHERE, *(name for names in NAMED for name in names)}
    tried = list(tables())
    assert len(tried) >= 5, "The tables of primitives are not found where they were."
    for place, table in tried:
        unknown = sorted(x for x in table if x not in known and not x.startswith("cfjax_"))
        assert not unknown, f"{place} names {unknown}, of which there is no example here."


# What they are lowered to

# These move entries, compare or round. Those that cost something only where they are complex, and
# ours, which are lowered to sums that keep XLA from fusing, are not told by that.
WITHOUT_ARITHMETIC = frozenset(
    "and argmax argmin bitcast_convert_type broadcast_in_dim ceil clamp complex concatenate conj "
    "convert_element_type copy custom_jvp_call custom_vjp_call custom_vmap_call dynamic_slice "
    "dynamic_update_slice eq floor gather ge gt imag iota is_finite le lt max min ne neg not "
    "optimization_barrier or pad real reduce_and reduce_max reduce_min reduce_or reshape rev round "
    "scatter select_n slice split squeeze stack stop_gradient tile transpose unstack xor".split()
)


def test_what_an_operation_is_lowered_to_tells_whether_it_computes():
    computing = {
        name: lowered.arithmetic_of(fun, *args)
        for name, (fun, args, _) in EXAMPLES.items()
        if name not in ("abs", "sign")
    }
    wrong = {x: found for x, found in computing.items() if (not found) != (x in WITHOUT_ARITHMETIC)}
    assert not wrong, f"cfjax/_measure/lowered.py says what these compute, and is wrong: {wrong}"


def test_what_is_counted_as_nothing_computes_nothing():
    free = {name for name in flops._FREE.split() if not name.startswith("cfjax_")}
    assert free <= WITHOUT_ARITHMETIC


@pytest.mark.slow
def test_the_flops_of_the_paper_are_counted():
    """`make paper` prints them: each operation in its programs has a rule, or computes nothing."""
    for method in rigid_body.METHODS.values():
        assert rigid_body.flops_of_step(method) > 0
    scene: Any = stiefel.stiefel.problem("second", 24)
    # Of shapes, as all branches count and no value is computed.
    shapes = jax.eval_shape(lambda: (0.0, 0.1, jnp.asarray(scene["y0"]), scene["args"]))
    # The full series has no other operations.
    for name in ("RKMK4", "CF4", "RKR-C4"):
        solver: Any = stiefel.METHODS[name]
        solver = solver.without_estimate().unrolled()

        def step(t0, t1, y0, args, solver=solver):
            state = solver.init(scene["term"], t0, t1, y0, args)
            return solver.step(scene["term"], t0, t1, y0, args, state, made_jump=False)[0]

        assert flops.count_flops(step, *shapes) > 0


# What they mean


def test_a_program_can_be_taken_apart():
    """cfjax/_xla reads programs, cuts pieces out of them, and runs the pieces."""
    made = jax.make_jaxpr(lambda x: (jnp.sin(x) * 2.0, 3.0))(1.0)
    sine, product = made.jaxpr.eqns
    literal: Any = product.invars[1]
    assert isinstance(literal, Literal) and literal.val == 2, "A number in a program is a Literal."
    aval: Any = literal.aval
    assert (aval.shape, aval.dtype) == ((), X.dtype), "A Literal has a shape and a dtype."
    assert isinstance(made.jaxpr.outvars[1], Literal), "A result that is a number is a Literal."
    assert not sine.effects, "An equation tells its effects."
    part = made.jaxpr.replace(
        eqns=[product],
        constvars=[],
        invars=list(sine.outvars),
        outvars=list(product.outvars),
        debug_info=made.jaxpr.debug_info.with_unknown_names(),
    )
    (result,) = jaxpr_as_fun(ClosedJaxpr(part, []))(5.0)
    assert result == 10, "A piece of a program runs on its own."
    assert product.replace(params={}).params == {}, "An equation can be changed."
    assert part.constvars == [] and made.consts == [], "Constants are apart from inputs."


def test_programs_are_found_in_parameters():
    def fun(x):
        return lax.cond(x > 0, lambda: jnp.sin(x), lambda: jnp.cos(x))

    (eqn,) = (e for e in jax.make_jaxpr(fun)(1.0).jaxpr.eqns if e.primitive.name == "cond")
    assert len(list(jaxprs_in_params(eqn.params))) == 2, "jaxprs_in_params finds every branch."
    assert len(eqn.params["branches"]) == 2, "cfjax/_measure/flops.py takes the branch by number."
    branch: Any = eqn.invars[0].aval
    assert branch.dtype == jnp.int32, "The first operand of cond is the branch."


@pytest.mark.parametrize("reverse", [False, True])
def test_a_scan_has_constants_the_carry_and_what_is_scanned_over_in_this_order(reverse):
    made = jax.make_jaxpr(
        lambda k, c, xs: lax.scan(lambda c, x: (c + k, (c * x)[None]), c, xs, reverse=reverse)
    )(1.0, 2.0, X)
    eqn = equations(made)["scan"]
    assert eqn.params["length"] == 3 and eqn.params["reverse"] is reverse
    inner = eqn.params["jaxpr"].jaxpr
    ranks = [v.aval.ndim for v in inner.invars], [v.aval.ndim for v in inner.outvars]
    assert ranks == ([0, 0, 0], [0, 1]), (
        "cfjax/_measure/flops.py tells what is scanned over by its rank, after constants and carry."
    )


def test_a_linear_solve_keeps_its_solver_third():
    eqn = equations(jax.make_jaxpr(_linear_solve)(X))["custom_linear_solve"]
    lengths = eqn.params["const_lengths"]
    assert lengths[2] == lengths.solve and lengths._fields[:3] == ("matvec", "vecmat", "solve"), (
        "cfjax/_measure/flops.py takes the solver's constants after those of matvec and vecmat."
    )
    assert equations(eqn.params["jaxprs"].solve), "The solver is a program."


def test_a_product_names_what_is_contracted_first():
    eqn = equations(jax.make_jaxpr(jnp.dot)(M, X))["dot_general"]
    contracted, batched = eqn.params["dimension_numbers"]
    assert tuple(map(tuple, contracted)) == ((1,), (0,)), "Contracted axes, left and right."
    assert tuple(map(tuple, batched)) == ((), ()), "Axes of a batch, after the contracted ones."


def test_a_primitive_of_our_own_is_lowered_differentiated_and_batched():
    double_p = Primitive("canary_double")
    double_p.def_impl(lambda x: 2 * x)
    double_p.def_abstract_eval(lambda x: jax.core.ShapedArray(x.shape, x.dtype))
    mlir.register_lowering(double_p, mlir.lower_fun(lambda x: 2 * x, multiple_results=False))
    seen = []

    def jvp(primals, tangents):
        seen.append(type(tangents[0]) is ad.Zero)
        return double_p.bind(*primals), double_p.bind(*map(ad.instantiate_zeros, tangents))

    def transpose(cotangent, x):
        seen.append(ad.is_undefined_primal(x))
        return [double_p.bind(ad.instantiate_zeros(cotangent))]

    ad.primitive_jvps[double_p] = jvp
    ad.primitive_transposes[double_p] = transpose
    batching.primitive_batchers[double_p] = lambda args, dims: (double_p.bind(*args), dims[0])
    assert jax.jit(double_p.bind)(3.0) == 6, "mlir.lower_fun and register_lowering."
    assert jax.grad(double_p.bind)(3.0) == 2, "ad.primitive_jvps and ad.primitive_transposes."
    assert seen == [False, True], "ad.Zero and ad.is_undefined_primal tell what is known."
    np.testing.assert_array_equal(jax.vmap(double_p.bind)(X), 2 * X)
    zero = ad.Zero(jax.core.ShapedArray((), X.dtype).to_tangent_aval())
    assert ad.instantiate_zeros(zero) == 0, "ad.Zero is made of an abstract value."


def test_a_function_learns_that_it_is_batched():
    @custom_vmap
    def is_batched(x):
        return jnp.asarray(False)

    @is_batched.def_vmap
    def _(axis_size, in_batched, x):
        assert (axis_size, in_batched) == (3, [True])
        return jnp.asarray(True), False

    assert not is_batched(1.0)
    assert jax.vmap(is_batched, out_axes=None)(X), "cfjax/_numerics/squaring.py asks custom_vmap."


def test_metadata_reaches_a_call():
    @jax.jit
    def identity(x):
        return x

    def fun(x):
        with set_xla_metadata(inlineable="false"):
            return identity(x)

    text = jax.jit(fun).lower(X).as_text()
    assert re.search(r'call @identity.*inlineable = "false"', text), (
        "cfjax/_xla/materialise.py keeps a call from being inlined by this attribute of the call."
    )


# The text of a program, which the folder of `map_batch` tells computations apart by.


def lowered_text(fun):
    return jax.jit(fun).lower(X).as_text()


def bodies(text):
    _, *found = fingerprint._FUNCTION.split(text)
    return dict(zip(found[::2], found[1::2], strict=True))


def test_the_text_of_a_program_is_functions():
    found = bodies(lowered_text(lambda x: jax.jit(jnp.sin)(x) + 1))
    assert "main" in found and len(found) == 2, "fingerprint.py finds `func.func` by its line."
    assert all("\n  }\n" in body for body in found.values()), "A function ends in a line `  }`."


def test_functions_of_the_host_are_seen_and_checks_told_from_them():
    found = bodies(lowered_text(lambda x: jax.pure_callback(np.sin, x, x)))
    assert any(map(fingerprint._HOST_FUNCTION.search, found.values())), (
        "fingerprint.py knows a call of the host by the name of its custom call."
    )
    found = bodies(lowered_text(lambda x: eqx.error_if(x, x[0] > 1, "message")))
    calling = [name for name, body in found.items() if fingerprint._HOST_FUNCTION.search(body)]
    assert calling and all(map(fingerprint._EQUINOX_CHECK.fullmatch, calling)), (
        f"fingerprint.py lets checks of equinox pass by the name of their function, got {calling}."
    )


def test_a_check_of_equinox_is_a_function_of_equinox():
    made = jax.make_jaxpr(lambda x: eqx.error_if(x, x[0] > 1, "message"))(X)
    callback = equations(made)["pure_callback"].params["callback"]
    callback = getattr(callback, "callback_func", callback)
    assert callback.__module__.startswith("equinox."), (
        "cfjax/_measure/flops.py counts a call of the host as nothing if equinox makes it."
    )


# diffrax


def test_a_solver_is_what_diffrax_calls():
    assert diffrax.AbstractSolver.__abstractmethods__ <= {"order", "init", "step", "func"}, (
        "cfjax/_solvers/base.py has every method that diffrax wants of a solver."
    )
    assert set(diffrax.AbstractSolver.__abstractvars__) <= {"term_structure", "interpolation_cls"}
    expected = {
        "init": "self terms t0 t1 y0 args",
        "step": "self terms t0 t1 y0 args solver_state made_jump",
        "func": "self terms t0 y0 args",
        "order": "self terms",
        "error_order": "self terms",
    }
    for name, parameters in expected.items():
        found = list(inspect.signature(getattr(diffrax.AbstractSolver, name)).parameters)
        assert found == parameters.split(), f"diffrax calls {name} with {found}."
    assert cfjax.CF4().term_compatible_contr_kwargs == {}, "The default: nothing for the control."


def test_a_term_is_what_diffrax_calls():
    assert diffrax.AbstractTerm.__abstractmethods__ == {"vf", "contr", "prod"}
    for name, parameters in {
        "vf": "self t y args",
        "contr": "self t0 t1 kwargs",
        "prod": "self vf control",
        "vf_prod": "self t y args control",
    }.items():
        found = list(inspect.signature(getattr(diffrax.AbstractTerm, name)).parameters)
        assert found == parameters.split(), f"diffrax calls {name} of a term with {found}."


def test_an_interpolation_is_made_of_times_and_of_what_the_step_tells():
    expected = {"t0", "t1"}
    assert set(diffrax.AbstractLocalInterpolation.__abstractvars__) == expected, (
        "cfjax/_solvers/dense.py has every variable that diffrax wants of an interpolation."
    )
    found = list(inspect.signature(diffrax.AbstractLocalInterpolation.evaluate).parameters)
    assert found == ["self", "t0", "t1", "left"], f"diffrax calls evaluate with {found}."


def test_results_can_be_chosen_and_raised():
    results: Any = diffrax.RESULTS
    bad = results.where(jnp.asarray(False), results.successful, results.nonfinite)
    assert bad == results.nonfinite and bad != results.successful
    assert not diffrax.is_okay(bad)
    with pytest.raises(RuntimeError):
        bad.error_if(jnp.asarray(1.0), True)


def test_a_tableau_of_diffrax_has_its_coefficients():
    tableau = diffrax.Dopri5.tableau
    assert (tableau.a_lower[0].tolist(), tableau.c.tolist()[0]) == ([0.2], 0.2)
    assert sum(tableau.b_sol.tolist()) == pytest.approx(1, abs=1e-15)
    assert tableau.implicit is False


def test_a_step_of_diffrax_fails_with_the_result_of_the_solver():
    """A solve ends where a step says `nonfinite`: so our solvers report a blow-up."""

    def field(t, y, args):
        return jnp.where(t > 0.5, jnp.nan, 1.0) * y

    arguments = cfjax.LieTerm(field), cfjax.LieEuler(), 0.0, 1.0, 0.25, jnp.asarray(X)
    forward = diffrax.ForwardMode()
    solution = diffrax.diffeqsolve(*arguments, max_steps=8, adjoint=forward, throw=False)
    assert solution.result == diffrax.RESULTS.nonfinite
