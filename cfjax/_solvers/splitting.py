"""Splitting: the exact flows of the terms of a sum, in turn."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._control_term import fault_of_increments, is_driven
from .._field import Rest, combine, is_field
from .._methods.splitting import BLANES_MOAN_4, BLANES_MOAN_6, STRANG, splitting_order
from .._term import product
from .base import (
    AbstractLieSolver,
    State,
    evaluation_times,
    fault_of_fields,
    fault_of_start,
    first_value,
    time_at,
)
from .compiled import control_of, scan_list
from .dense import AbstractPath, Interpolation
from .dependence import time_dependent, unknown_dependence
from .step import Step, begin_step, finish_step
from .sums import Sums


class _Replay(AbstractPath):
    """The flows of a step, each for the same part of its time: on the manifold, of order 1."""

    start: PyTree
    first: PyTree
    # The fields of each pair of stages.
    pairs: list[tuple[PyTree, ...]]

    def point(self, theta: Any) -> PyTree:
        sums = Sums(self.start)

        def pair_end(y: PyTree, fields: tuple[PyTree, ...]) -> tuple[PyTree, None]:
            for field in fields:
                y = sums.flow_frozen(combine((theta,), (field,)), y)
            return y, None

        y, _ = pair_end(self.start, (self.first,))
        return scan_list(pair_end, y, self.pairs)[0]


class AbstractSplitting(AbstractLieSolver, diffrax.AbstractStratonovichSolver):
    """The flows of the terms of a sum, in turn."""

    stages: eqx.AbstractVar[tuple[float, ...]]

    term_structure: ClassVar = diffrax.MultiTerm
    interpolation_cls: ClassVar[Any] = Interpolation

    @property
    def is_symmetric(self):
        # The stages are sums of rounded coefficients.
        pairs = zip(self.stages, reversed(self.stages), strict=True)
        return all(abs(a - b) < 1e-14 for a, b in pairs)

    def order(self, terms):
        return splitting_order(self.stages)

    def for_terms(self, terms):
        name, summands = type(self).__name__, terms.terms
        if len(summands) < 2:
            raise TypeError(
                f"{name} takes a diffrax.MultiTerm of two or more terms, got {len(summands)}."
            )
        if is_driven(summands[:-1]):
            raise TypeError(
                f"{name} supports noise and other path-driven terms only as its last term: move "
                "them there, together with what acts at the same time, as a diffrax.MultiTerm."
            )
        return self

    def start(self, terms, t0, t1, y0, args):
        self.for_terms(terms)
        control = terms.contr(t0, t1)
        last = terms.terms[-1]
        dependent = time_dependent(
            lambda t: product(last, last.vf(t, y0, args), control[-1]), t0, y0
        )
        if dependent:
            cause = f" {unknown_dependence('t')}." if dependent[0][1] is None else ""
            raise TypeError(
                f"The last term of {type(self).__name__} must not depend on time, as the clock "
                "advances while it acts: put another term last, or append one that returns zeros "
                f"for each part.{cause}"
            )

        def at_start(y0: PyTree) -> tuple[list[PyTree], PyTree]:
            parts = zip(terms.terms, control, strict=True)
            fields = [product(term, term.vf(t0, y0, args), x) for term, x in parts]
            return fields, _compensation(fields, y0)

        fields, compensation = eqx.filter_eval_shape(at_start, y0)
        compensation = Sums(y0, compensation).zeros()
        first = first_value(terms.terms[0], t0, t1, y0, args)
        fault = fault_of_start(t0, t1, fields, y0)
        fault = fault_of_fields(fault, fields, terms, t0, y0, args)
        fault = fault_of_increments(fault, terms, t0, t1, y0, args)
        return State(compensation, first, None), fault

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        summands = terms.terms

        def evaluate(t0: Any) -> PyTree:
            return summands[0].vf(evaluation_times(t0, t1)[0], y0, args)

        t0, first = begin_step(solver_state, t0, evaluate, made_jump)
        times = evaluation_times(t0, t1)
        controls = control_of(terms, t0, t1)

        def step_from(y0: PyTree) -> Step:
            sums = Sums(y0, solver_state.compensation)

            def value(k: int, c: Any, z: PyTree) -> PyTree:
                return summands[k].vf(time_at(c, *times), sums.state(z), args)

            def apply_flow(k: int, value: PyTree, s: Any, z: PyTree) -> tuple[PyTree, PyTree]:
                field = product(summands[k], value, _scaled(s, controls[k]))
                return field, sums.flow_frozen(field, z)

            def pair(carry: tuple[PyTree, PyTree], x: _StagePair) -> Any:
                z, _ = carry
                last, fields = len(summands) - 1, []
                flows = [(k, x.there, x.start) for k in range(1, last)]
                flows += [(last, x.there + x.back, x.start)]
                flows += [(k, x.back, x.end) for k in reversed(range(1, last))]
                for k, s, c in flows:
                    field, z = apply_flow(k, value(k, c, z), s, z)
                    fields.append(field)
                next_value = value(0, x.end, z)
                field, z = apply_flow(0, next_value, x.kick, z)
                return (z, next_value), (*fields, field)

            start = value(0, 0.0, sums.start) if first is None else first
            field, z = apply_flow(0, start, self.stages[0], sums.start)
            (z, last), later = scan_list(pair, (z, start), _stage_pairs(self.stages))
            end, _ = sums.materialised(z, None, is_followed=True)
            return Step(end, _Replay(y0, field, later), last=None if first is None else last)

        return finish_step(solver_state, step_from, y0)


class Splitting(AbstractSplitting):
    """Flows of the terms of a `diffrax.MultiTerm` in turn: symplectic where the terms are.

    Each term has a frozen field that does not change along its own flow, such as a force, which
    moves only momenta. So its flow is exact, and where the term is Hamiltonian, the step is
    symplectic. All symmetric methods are reversible. `cfjax.check_terms` checks that the fields do
    not change.

    ```python
    term = diffrax.MultiTerm(cfjax.LieTerm(kick), cfjax.LieTerm(drift))
    sol = cfjax.integrate(term, cfjax.Strang(), 0.0, 100.0, y0, num_steps=10_000)
    ```

    Each field acts on the whole state, with None for a part at rest. The first term is outermost,
    as in kick, drift, kick: it has one evaluation in each pair of stages, the last term one, and
    those between two. The clock advances only during the last term, so the last term must not
    depend on t: if every term depends on t, append a term that returns zeros. Only the last term
    may be driven by noise, as in Langevin dynamics by BAOAB, which is `cfjax.Strang` of kick,
    drift, and a `diffrax.MultiTerm` of friction and noise.

    There is no error estimate, as steps of different lengths would not be symplectic. Output within
    a step is on the manifold and meets both ends, with order 1 between them.

    **Arguments:** `stages`, an even number of numbers s1, s2, ... with sum 1. With X the flows of
    all terms in their order and X* in the reverse one, a step of length h is
    X(s1 h) X*(s2 h) X(s3 h) ....

    **Raises** `ValueError` for other stages; when traced `TypeError` for less than two terms, for a
    term before the last that a path drives, and for a last term that depends on time.

    Source: McLachlan & Quispel, Splitting methods, Acta Numer. 11 (2002).
    """

    stages: tuple[float, ...] = eqx.field(static=True, converter=tuple)

    def __check_init__(self):
        is_number = [isinstance(s, int | float) for s in self.stages]
        if not all(is_number) or len(self.stages) % 2 or not abs(sum(self.stages) - 1) < 1e-12:
            raise ValueError(
                f"stages must be an even number of numbers with sum 1, got {self.stages!r}."
            )


class Strang(AbstractSplitting):
    """The Störmer-Verlet method, or leapfrog: order 2, 1 evaluation of the first term a step.

    Source: Strang, SIAM J. Numer. Anal. 5 (1968), doi:10.1137/0705041; Hairer, Lubich & Wanner,
    Geometric Numerical Integration, Section II.5.
    """

    stages: ClassVar[tuple[float, ...]] = STRANG


class BlanesMoan4(AbstractSplitting):
    """Order 4, 6 evaluations of the first term a step; an error constant of 1.9e-4.

    Source: Blanes & Moan, J. Comput. Appl. Math. 142 (2002), doi:10.1016/S0377-0427(01)00492-7.
    """

    stages: ClassVar[tuple[float, ...]] = BLANES_MOAN_4


class BlanesMoan6(AbstractSplitting):
    """Order 6, 10 evaluations of the first term a step; an error constant of 1.2e-5.

    Source: Blanes & Moan, J. Comput. Appl. Math. 142 (2002), doi:10.1016/S0377-0427(01)00492-7.
    """

    stages: ClassVar[tuple[float, ...]] = BLANES_MOAN_6


class _StagePair(NamedTuple):
    """Two stages: the parts of the step of the terms on the way there and back, of the first term
    at the end, and the times before and after, as parts of the step.
    """

    there: Any
    back: Any
    kick: Any
    start: Any
    end: Any


def _stage_pairs(stages: Sequence[float]) -> list[_StagePair]:
    pairs, start = [], 0.0
    for k in range(0, len(stages), 2):
        there, back = stages[k : k + 2]
        is_last = k + 2 == len(stages)
        end = 1.0 if is_last else start + there + back
        kick = back if is_last else back + stages[k + 2]
        pairs.append(_StagePair(there, back, kick, start, end))
        start = end
    return pairs


def _scaled(s: Any, control: PyTree) -> PyTree:
    return jtu.tree_map(lambda x: jnp.asarray(s, jnp.result_type(x)) * x, control)


def _compensation(fields: Sequence[PyTree], y0: PyTree) -> PyTree:
    """Zeros for each array of the state that one term moves by increments and the others can."""

    def kind(f: Any, y: PyTree) -> PyTree:
        if not is_field(f) or isinstance(f, Rest):
            return jtu.tree_map(lambda _: "any", y)
        is_sum = jtu.tree_leaves(Sums.of(f, y).compensation) != []
        return jtu.tree_map(lambda _: "sum" if is_sum else "state", y)

    def part(y: Array, *kinds: str) -> Array | None:
        return jnp.zeros_like(y) if "sum" in kinds and "state" not in kinds else None

    kinds = [jtu.tree_map(kind, field, y0, is_leaf=is_field) for field in fields]
    return jtu.tree_map(part, y0, *kinds)
