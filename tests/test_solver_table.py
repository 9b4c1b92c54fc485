"""The table of solvers: none is left out, and each is and takes what its row says."""

import inspect
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import problems
import pytest
from jax.extend.core import Literal, jaxprs_in_params
from solver_table import COMMUTATOR_FREE, MUNTHE_KAAS, SOLVERS

import cfjax

ROWS = SOLVERS | COMMUTATOR_FREE | MUNTHE_KAAS
START = jnp.array([0.5, 0.7])
DENSITY = jnp.eye(2, dtype=complex) / 2


def test_the_table_has_every_solver():
    public = {
        name
        for name, value in inspect.getmembers(cfjax, inspect.isclass)
        if issubclass(value, diffrax.AbstractSolver) and not name.startswith("Abstract")
    }
    assert public == SOLVERS.keys()
    for name, row in SOLVERS.items():
        assert type(row.make()) is getattr(cfjax, name)


# Terms whose evaluations a program shows by an operation that nothing else uses. Translations,
# which every solver takes.


def marked(x):
    return jax.lax.lgamma(x)


def translation(t, y, args):
    return marked(y + t)


def beside_it(t, y, args):
    return -y


PATH = diffrax.UnsafeBrownianPath((), jax.random.key(0), levy_area=diffrax.SpaceTimeLevyArea)
TRANSLATION = cfjax.LieTerm(translation)
TERMS = {
    "time only": cfjax.LieTerm(lambda t, y, args: marked(t * jnp.ones(2))),
    "density matrices": cfjax.LieTerm(
        lambda t, y, args: cfjax.Lindblad(marked(t) * jnp.eye(2), [jnp.eye(2)])
    ),
    "terms": diffrax.MultiTerm(TRANSLATION, cfjax.LieTerm(beside_it)),
    "noise": diffrax.MultiTerm(
        TRANSLATION, cfjax.LieControlTerm(lambda t, y, args, dw: y * dw, PATH)
    ),
}


def num_marked(jaxpr, used=None):
    """How often the marked operation runs for those results of a program that are used."""
    used = {x for x in jaxpr.outvars if not isinstance(x, Literal)} if used is None else used
    total = 0
    for eqn in reversed(jaxpr.eqns):
        if not used.intersection(eqn.outvars):
            continue
        used.update(x for x in eqn.invars if not isinstance(x, Literal))
        total += eqn.primitive.name == "lgamma"
        # All results of a loop count as used.
        times = eqn.params["length"] if eqn.primitive.name == "scan" else 1
        total += times * sum(map(num_marked, jaxprs_in_params(eqn.params)))
    return total


def test_evaluations_of_a_step(subtests):
    for name, row in ROWS.items():
        with subtests.test(name=name):
            check_evaluations(row)


def check_evaluations(row):
    solver, term = row.make(), TERMS.get(row.takes, TRANSLATION)
    y0 = DENSITY if row.takes == "density matrices" else START

    def start(y0):
        return solver.init(term, 0.0, 0.1, y0, None)

    def step(y0, state):
        y1, error, _, state, _ = solver.step(term, 0.0, 0.1, y0, None, state, made_jump=False)
        return y1, error, state

    with cfjax.rewriting(False):
        first, state = jax.make_jaxpr(start, return_shape=True)(y0)
        later, (_, error, _) = jax.make_jaxpr(step, return_shape=True)(y0, state)
    assert (error is None) == (row.embedded is None)
    assert num_marked(first.jaxpr) == row.first
    if row.evaluations is not None:
        assert num_marked(later.jaxpr) == row.evaluations


def test_a_solver_says_its_orders_and_whether_it_is_symmetric(subtests):
    for name, row in ROWS.items():
        with subtests.test(name=name):
            solver, term = row.make(), TERMS.get(row.takes, TRANSLATION)
            assert solver.order(term) == row.order
            if row.embedded is not None:
                assert solver.error_order(term) == row.embedded + 1
            assert solver.is_symmetric == row.is_symmetric


def growth(t, y, args):
    """A field of a class of a user's own, which depends on the state and has no bracket."""
    return problems.Growth(-y)


def test_which_solvers_take_any_field(subtests):
    term = cfjax.LieTerm(growth)

    def solve(y0, solver):
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=1, throw=False).ys

    def step(y0, solver):
        return problems.first_step(solver, term, 0.0, 1.0, y0, None)[0]

    # The families of the other tables are of classes of this one.
    for name, row in SOLVERS.items():
        with subtests.test(name=name):
            if row.takes == "any":
                assert jax.eval_shape(partial(step, solver=row.make()), START).shape == (2,)
            else:
                with pytest.raises(TypeError):
                    jax.eval_shape(partial(solve, solver=row.make()), START)
