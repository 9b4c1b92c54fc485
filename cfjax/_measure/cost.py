"""The cost of a step of a solver: evaluations of the field, flows, brackets and flops."""

import functools
from collections import Counter
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._field import AbstractAlgebraElement, bracket, combine, flow, is_field, tangent
from .._solvers.base import AbstractLieSolver
from .._solvers.stabilised import AbstractStabilised
from .flops import count_flops


class Problem(NamedTuple):
    """In the order of the arguments of `diffrax.diffeqsolve`."""

    term: PyTree
    solver: diffrax.AbstractSolver
    t0: Array
    t1: Array
    dt0: Array
    y0: PyTree
    args: PyTree


class Calls(NamedTuple):
    """How often a step calls each. Flows, or brackets, of all parts of a state count as one."""

    evaluations: float
    flows: float
    brackets: float


class Cost(NamedTuple):
    """Evaluations, flows and flops of the first step with initialisation, and of a later one."""

    first: Float[np.ndarray, "3"]
    later: Float[np.ndarray, "3"]

    def of(self, num_steps: float) -> Float[np.ndarray, "3"]:
        return self.first + (num_steps - 1) * self.later


def cost_of_steps(problem: Problem, is_adaptive: bool) -> Cost:
    solver = problem.solver
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    chooses_stages = isinstance(solver, AbstractStabilised) and solver.stages is None
    if isinstance(solver, diffrax.AbstractImplicitSolver) or chooses_stages:
        # The iterations of its steps depend on a tolerance that the controller may set, the stages
        # on the length of a step.
        unknown = np.full(3, np.nan)
        return Cost(unknown, unknown)
    # First: it raises its errors before anything is compiled.
    flops = flops_of_steps(problem, is_adaptive)
    calls = calls_of_steps(problem)
    first, later = (
        np.array([call.evaluations, call.flows, number])
        for call, number in zip(calls, flops, strict=True)
    )
    return Cost(first, later)


def _unrolled(solver: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        return eqx.tree_at(lambda s: s.solver, solver, _unrolled(solver.solver))
    return solver.unrolled() if isinstance(solver, AbstractLieSolver) else solver


def flops_of_steps(problem: Problem, is_adaptive: bool = False) -> tuple[float, float]:
    """Flops of the first step, initialisation included, and of a later one."""
    # A loop whose iterations differ cannot be counted.
    problem = problem._replace(solver=_unrolled(problem.solver))
    arrays, static = eqx.partition(problem, eqx.is_array)

    def init(arrays):
        term, solver, t0, _, dt0, y0, args = eqx.combine(arrays, static)
        return solver.init(term, t0, t0 + dt0, y0, args)

    state = eqx.filter_eval_shape(init, arrays)
    state, static_state = eqx.partition(state, lambda x: isinstance(x, jax.ShapeDtypeStruct))

    def step(arrays, t1, state):
        term, solver, t0, _, _, y0, args = eqx.combine(arrays, static)
        state = eqx.combine(state, static_state)
        y, y_error, _, state, _ = solver.step(term, t0, t1, y0, args, state, made_jump=False)
        if is_adaptive and y_error is None:
            name = type(solver).__name__
            raise ValueError(
                f"tolerances need a solver with an error estimate, and {name} has none: use "
                f"diffrax.HalfSolver({name}()), or give num_steps."
            )
        return y, y_error if is_adaptive else None, eqx.filter(state, eqx.is_array)

    try:
        later = float(count_flops(step, arrays, problem.t0 + problem.dt0, state))
        initialisation = count_flops(lambda x: eqx.filter(init(x), eqx.is_array), arrays)
        return initialisation + later, later
    except NotImplementedError:
        return np.nan, np.nan


def calls_of_steps(problem: Problem) -> tuple[Calls, Calls]:
    """Calls of the first step, initialisation included, and of a later one."""
    try:
        return _counted_steps(problem, counts_flows=True)
    except (AttributeError, TypeError, ValueError):
        # The solver asks more of a field than a flow and a bracket.
        calls = _counted_steps(problem, counts_flows=False)
        first, later = (call._replace(flows=np.nan, brackets=np.nan) for call in calls)
        return first, later


def _counted_steps(problem: Problem, counts_flows: bool) -> tuple[Calls, Calls]:
    """Calls are counted while the steps run, as the trace of a loop does not show repetitions."""
    term, solver, t0, _, dt0, y0, args = problem
    tally = _Tally()

    def is_term(x: Any) -> bool:
        # A sum of terms must be seen as one: solvers add its frozen fields themselves.
        return isinstance(x, diffrax.AbstractTerm) and not isinstance(x, diffrax.MultiTerm)

    term = jtu.tree_map(lambda t: _CountingTerm(t, tally, counts_flows), term, is_leaf=is_term)
    step = eqx.filter_jit(functools.partial(solver.step, made_jump=False))
    t1, t2 = t0 + dt0, t0 + 2 * dt0
    state = eqx.filter_jit(solver.init)(term, t0, t1, y0, args)
    y, _, _, state, _ = step(term, t0, t1, y0, args, state)
    first = tally.read()
    step(term, t1, t2, y, args, state)
    return first, tally.read()


class _Tally:
    """Counts calls while a program runs."""

    def __init__(self):
        self.counts = Counter()

    def add(self, event: str) -> None:
        jax.debug.callback(lambda: self.counts.update([event]))

    def read(self) -> Calls:
        """The calls since the previous reading."""
        jax.effects_barrier()
        calls = Calls(*(float(self.counts[event]) for event in Calls._fields))
        self.counts.clear()
        return calls


class _CountingTerm(diffrax.AbstractTerm):
    term: diffrax.AbstractTerm
    tally: _Tally = eqx.field(static=True)
    counts_flows: bool = eqx.field(static=True)

    def vf(self, t, y, args):
        self.tally.add("evaluations")
        value = self.term.vf(t, y, args)
        has_field = any(map(is_field, jtu.tree_leaves(value, is_leaf=is_field)))
        return _CountedField(value, self.tally) if self.counts_flows and has_field else value

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        return self.term.prod(vf, control)

    def vf_prod(self, t, y, args, control):
        self.tally.add("evaluations")
        return self.term.vf_prod(t, y, args, control)


class _CountedField(AbstractAlgebraElement):
    """The field of a whole state, all of whose parts move in one flow."""

    field: PyTree
    tally: _Tally = eqx.field(static=True)

    acts_on_subtree: ClassVar[bool] = True

    def flow(self, point):
        self.tally.add("flows")
        return flow(self.field, point)

    def tangent(self, point):
        return tangent(self.field, point)

    @classmethod
    def combine(cls, weights, fields):
        return cls(combine(weights, [f.field for f in fields]), fields[0].tally)

    def bracket(self, other):
        self.tally.add("brackets")
        return type(self)(bracket(self.field, other.field), self.tally)
