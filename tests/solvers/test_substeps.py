"""Several steps of a solver in the place of one: their times, their output, and a failure."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems

import cfjax

# Suzuki's composition of order 4: four steps of this part, and one that goes back.
PART = 1 / (4 - 4 ** (1 / 3))
PARTS = np.array([PART, PART, 1 - 4 * PART, PART, PART])
ENDS = np.cumsum([0.0, *PARTS])
FOUR = cfjax.Composition(cfjax.ImplicitMidpoint(), 4)


def test_times_of_substeps_that_go_back():
    """For a translation by a function of time the midpoint rule is the rule for its integral."""
    t0, t1 = 0.3, 0.8

    def end(t0, t1):
        term = cfjax.LieTerm(lambda t, y, args: jnp.exp(t) * jnp.ones(2))
        return cfjax.integrate(term, FOUR, t0, t1, jnp.zeros(2), num_steps=1).ys[-1]

    middles = t0 + (t1 - t0) * (ENDS[:-1] + ENDS[1:]) / 2
    expected = (t1 - t0) * np.sum(PARTS * np.exp(middles))
    # The rule has order 4, so it is not the integral; five sums.
    assert 1e-7 < abs(expected - (np.exp(t1) - np.exp(t0))) < 1e-4
    np.testing.assert_allclose(end(t0, t1), [expected] * 2, rtol=0, atol=1e-15)


def test_output_has_the_same_part_of_the_time_for_each_substep():
    """The field is constant, so the output is the time that has passed at the place in a part."""
    term = cfjax.LieTerm(lambda t, y, args: jnp.ones(1))
    thetas = np.linspace(0.0, 1.0, 21)
    t0, t1 = jnp.zeros(()), jnp.ones(())

    @jax.jit
    def output(y0):
        info = problems.first_step(FOUR, term, t0, t1, y0, None)[2]
        path = FOUR.interpolation_cls(t0=t0, t1=t1, **info)
        return jax.vmap(path.evaluate)(jnp.asarray(thetas))

    found = output(jnp.zeros(1))
    expected = np.interp(thetas * len(PARTS), np.arange(6.0), ENDS)
    np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-15)


def test_a_failure_of_any_substep_is_one_of_the_step():
    """At the middle of one of them the field grows too fast for the iteration."""

    @jax.jit
    def result(middle, rate):
        def field(t, y, args):
            return jnp.where(jnp.abs(t - middle) < 1e-3, rate, -1.0) * y

        return cfjax.integrate(
            cfjax.LieTerm(field), FOUR, 0.0, 1.0, jnp.ones(1), num_steps=1, throw=False
        ).result

    for middle in (ENDS[:-1] + ENDS[1:]) / 2:
        assert result(middle, -1.0) == diffrax.RESULTS.successful
        assert result(middle, 100.0) == diffrax.RESULTS.nonlinear_divergence
