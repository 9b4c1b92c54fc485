"""The Landau-Zener problem: its closed form at any time, its limit, and the norm."""

import diffrax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems

import cfjax
from cfjax.scenes import landau_zener

TERM = cfjax.LieTerm(landau_zener.field)
SWEEPS = [landau_zener.slow, landau_zener.Sweep(3.0, 0.2)]


def closed_form(t, t_start, args):
    """By parabolic cylinder functions, in 30 digits.

    With `n = -i coupling^2 / rate` and `z = exp(i pi / 4) sqrt(rate) t`, `D_n(z)` and `D_n(-z)` are
    the first amplitudes of two solutions.
    """
    with mpmath.workdps(30):
        rate, coupling = mpmath.mpf(args.rate), mpmath.mpf(args.coupling)
        n = -1j * coupling**2 / rate
        unit = mpmath.exp(1j * mpmath.pi / 4) * mpmath.sqrt(rate)

        def solutions(t):
            columns = []
            for slope in (unit, -unit):
                z = slope * t
                d = mpmath.pcfd(n, z)
                change = slope * (z / 2 * d - mpmath.pcfd(n + 1, z))
                columns.append([d, (1j * change - rate * t / 2 * d) / coupling])
            return mpmath.matrix(columns).T

        weights = mpmath.lu_solve(solutions(mpmath.mpf(t_start)), mpmath.matrix([1, 0]))
        end = solutions(mpmath.mpf(t)) * weights
        return np.array([complex(end[0]), complex(end[1])])


def test_the_reference_is_the_closed_form(subtests):
    for args in SWEEPS:
        for t_start, t in [(-10.0, 10.0), (-3.0, 2.0), (4.0, -1.0)]:
            found = landau_zener.reference(t, args=args, t_start=t_start)
            with subtests.test(case=f"{args} {t_start} {t}"):
                # A hundred steps or three hundred, of a few roundings each.
                np.testing.assert_allclose(found, closed_form(t, t_start, args), rtol=0, atol=1e-13)


def test_the_limit():
    args = landau_zener.Sweep(2.0, 0.4)
    exact = landau_zener.reference(30.0, args=args, t_start=-30.0)
    # From -T to T the probability is off by some `coupling / (rate T)`.
    off = float(landau_zener.staying(exact)) - float(landau_zener.limit(args))
    assert 1e-5 < abs(off) < 2 * 0.4 / (2 * 30)
    # Without coupling it stays, and slowly swept it does not.
    assert landau_zener.limit(landau_zener.Sweep(1.0, 0.0)) == 1
    assert landau_zener.limit(landau_zener.Sweep(0.1, 1.0)) < 1e-27


def test_a_propagator_has_its_order_and_stays_unitary_where_plain_space_loses_the_norm():
    exact = landau_zener.reference(landau_zener.t1)
    given = landau_zener.t0, landau_zener.t1, np.eye(2, dtype=complex), landau_zener.slow, 80
    # 80, 160 and 400 steps by one program.
    some, more, u = (
        np.asarray(problems.in_pieces(TERM, cfjax.Magnus6(), *given, n)) for n in (1, 2, 5)
    )
    errors = [np.abs(y @ landau_zener.y0() - exact).max() for y in (some, more)]
    assert 0.7 * 2**6 < errors[0] / errors[1] < 1.4 * 2**6
    problem = landau_zener.problem() | dict(term=diffrax.ODETerm(landau_zener.velocity))
    off = cfjax.integrate(**problem, solver=diffrax.Tsit5(), num_steps=400).ys[-1]
    # Sums over the steps are compensated: a few roundings.
    np.testing.assert_allclose(np.conj(u.T) @ u, np.eye(2), rtol=0, atol=4e-15)
    # The error of the method, of order 6, with steps of 1/20.
    np.testing.assert_allclose(u @ landau_zener.y0(), exact, rtol=0, atol=1e-7)
    assert abs(np.linalg.norm(off) - 1) > 1e-9


def test_energies():
    t = np.array([-3.0, 0.0, 0.7])
    for s, levels in zip(t, landau_zener.energies(t, landau_zener.slow), strict=True):
        a = landau_zener.field(s, jnp.zeros(2, complex), landau_zener.slow).a
        np.testing.assert_allclose(levels, np.linalg.eigvalsh(1j * np.asarray(a)), atol=1e-15)
