"""Whether the tests see mistakes: plants defects in cfjax one at a time, and runs the tests.

    python tests/planted_defects.py [--first] [WORD ...]

Every defect goes into a copy of the repository of its own. There the tests that should see it run
first, up to the first failure, and if none fails all the tests of `make test`. A defect is caught
if a test fails. With WORDs, only defects with one of them in the file's name or in what they are.
With --first, the rest of the tests is left out, and what it would have caught counts as missed.

The exit status is 1 if fewer than 95 % are caught.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
NEEDED = 0.95


class Defect(NamedTuple):
    """In `file`, below cfjax, `old` becomes `new`; the tests below `tests` run first."""

    file: str
    old: str
    new: str
    what: str
    tests: str


DEFECTS = [
    Defect(
        "_step_back.py",
        "of_step = jtu.tree_map(jnp.add, of_step, more)",
        "of_step = more",
        "a gradient by steps backwards that has the last step's part alone",
        "test_step_back.py",
    ),
    Defect(
        "_step_back.py",
        "jnp.maximum(own, size(move))",
        "jnp.max(jnp.stack(jtu.tree_leaves(allowed)))",
        "a way back that is judged by the largest array of the state",
        "test_step_back.py",
    ),
    Defect(
        "_step_back.py",
        "jnp.maximum(own, size(move))",
        "own",
        "a way back that misses zeros which are rounding of the rest",
        "test_step_back.py -k rounding",
    ),
    Defect(
        "_integrate.py",
        "throw_in_reverse=throw and step_back,",
        "throw_in_reverse=throw and is_compiled,",
        "NaN for an error of the way back, in a gradient from Python",
        "test_step_back.py -k derivative",
    ),
    Defect(
        "_solvers/fixed_point.py",
        "jnp.maximum(size(new), own)",
        "jnp.max(jnp.stack(list(map(size, jtu.tree_leaves(turn.new)))))",
        "an iteration that is judged by the largest array of the state",
        "solvers/test_fixed_point.py",
    ),
    Defect(
        "_solvers/fixed_point.py",
        "jnp.where(k, *pair) for k",
        "jnp.where(False, *pair) for k",
        "small numbers that the rounding of large ones keeps moving",
        "solvers/test_fixed_point.py",
    ),
    Defect(
        "_solvers/fixed_point.py",
        "~jnp.all(are_done(turn)) & is_number",
        "~jnp.all(are_done(turn)) & ((turn.number < 4) "
        "| (turn.changes[0][0] < turn.changes[2][0]))",
        "an iteration that gives up where changes grow before they fall",
        "solvers/test_fixed_point.py",
    ),
    Defect(
        "_solvers/fixed_point.py",
        "jnp.where(has_converged, x, jnp.nan)",
        "x",
        "a derivative of the midpoint that did not converge",
        "solvers/test_fixed_point.py",
    ),
    Defect(
        "_solvers/stacked.py",
        "_product(weights, fields.imag))",
        "_product(weights, fields.real))",
        "combinations of large complex fields with the real part twice",
        "solvers/test_stages.py",
    ),
    Defect(
        "_xla/in_two.py",
        "len(live) > MAX_RESULTS_IN_BATCHES and",
        "len(live) > 99 and",
        "parts of a program that have too many results",
        "xla/test_materialise.py",
    ),
    # Methods: coefficients and what is made of them.
    Defect(
        "_methods/tableau.py",
        "[[_half], [-_half, 0, 1]]]",
        "[[_half], [-_third, 0, Fraction(5, 6)]]]",
        "a wrong coefficient in a stage of CF4",
        "methods/test_order_conditions.py",
    ),
    Defect(
        "_methods/tableau.py",
        "0.0659864263556022]",
        "0.0659864263556122]",
        "a wrong 14th digit in CG4",
        "methods/test_order_conditions.py",
    ),
    Defect(
        "_methods/tableau.py",
        "1 / (2 * x * (3 * x - 1))]",
        "1 / (2 * x * (3 * x + 1))]",
        "a wrong sign in the first family of order 3",
        "methods/test_tableau.py",
    ),
    Defect(
        "_methods/order_conditions.py",
        "return exact_weight(word[:-1]) * exact_weight(word[-1]) / _order_of(word)",
        "return exact_weight(word[:-1]) * exact_weight(word[-1]) / len(word)",
        "a wrong weight in the order conditions",
        "methods/test_order_conditions.py",
    ),
    Defect(
        "_solvers/low_storage.py",
        "orders: ClassVar = (5, None)",
        "orders: ClassVar = (4, None)",
        "a wrong order that is stored",
        "methods/test_order_conditions.py",
    ),
    Defect(
        "_fields/low_rank.py",
        "half.T - half",
        "half - half.T",
        "fields of the wrong sign in a loop over coordinates of a step",
        "solvers/test_stages.py -k grow",
    ),
    Defect(
        "_methods/continuous_extension.py",
        "found += ((total - found.sum(axis=1)) / num_powers)[:, None]",
        "found += 0 * ((total - found.sum(axis=1)) / num_powers)[:, None]",
        "output within a step that misses its end",
        "methods/test_derive.py",
    ),
    Defect(
        "_methods/extensions.json",
        "-0.02430107528043082",
        "-0.02430108528043082",
        "a wrong digit in the stored continuous extension of CF54",
        "methods/test_derive.py",
    ),
    Defect(
        "_methods/magnus.py",
        "-0.093651787353457374390425",
        "-0.093651787353447374390425",
        "a wrong 14th digit in Magnus6",
        "methods/test_magnus.py",
    ),
    Defect(
        "_methods/magnus.py",
        "0.2655756032646428930981140590456168352972",
        "0.2655756132646428930981140590456168352972",
        "a wrong node of Magnus8",
        "methods/test_magnus.py",
    ),
    Defect(
        "_solvers/dependence.py",
        "to_chart(frozen, y, ())[0]",
        "frozen",
        "a Magnus method that takes fields frozen at the state",
        "solvers/test_magnus.py -k frozen",
    ),
    Defect(
        "_methods/stability.py",
        "points[rows[: j + 1]] = np.exp(a * z) * points[rows[:j]] + _phi_1(a * z) * b",
        "points[rows[: j + 1]] = np.exp(a * z) * points[rows[:j]] + _phi_1(z) * b",
        "a missing factor in the stability function",
        "test_stability.py",
    ),
    # Solvers.
    Defect(
        "_solvers/commutator_free.py",
        "points = reached(rows[:-1], stages)\n"
        "    return {**points, rows: chart.flow(_combined(rows[-1], fields), points[rows[:-1]])}",
        "points = reached(rows[1:], stages)\n"
        "    return {**points, rows: chart.flow(_combined(rows[0], fields), points[rows[1:]])}",
        "flows of a product in the wrong order",
        "solvers/test_stages.py -k a_step",
    ),
    Defect(
        "_solvers/stages.py",
        "flows.append(_Flow(place[product[:-1]], product[-1],",
        "flows.append(_Flow(place[product[:-1]], product[0],",
        "the first row in place of the last one in rolled stages",
        "solvers/test_one_step.py",
    ),
    Defect(
        "_solvers/commutator_free.py",
        "last = chart.value_at(1.0, end)\n            fields",
        "last = chart.value_at(1.0, points[trimmed(tableau.alpha[-1])])\n            fields",
        "the field at the last stage in place of that at the end",
        "solvers/test_commutator_free.py -k order_on_matrices",
    ),
    Defect(
        "_solvers/commutator_free.py",
        "return jnp.where(factor * factor * apart_square > error_square, other, error)",
        "return error",
        "a dropped floor of CF4's estimate",
        "solvers/test_one_step.py -k driven_line",
    ),
    Defect(
        "_solvers/commutator_free.py",
        "rest = [[-entry for entry in row]",
        "rest = [[entry for entry in row]",
        "a sum for a difference in the estimate in the algebra",
        "solvers/test_one_step.py -k algebra",
    ),
    Defect(
        "_solvers/base.py",
        "return velocity(terms, terms.vf(t0, y0, args), y0)",
        "return terms.vf(t0, y0, args)",
        "a frozen field in place of the velocity, for diffrax's events",
        "solvers/test_events.py -k func",
    ),
    Defect(
        "_xla/pack.py",
        "(*spec[:axis], None, *spec[axis:])",
        "(None, *spec)",
        "entries of a batch spread along another axis than the batch",
        "xla/test_pack.py -k mesh",
    ),
    Defect(
        "_solvers/base.py",
        "return t1 if c == 1 else t0 + c * (t1 - t0)",
        "return t0 + c * (t1 - t0)",
        "a last stage behind the end of the step by rounding",
        "solvers/test_commutator_free.py::test_the_last_stage_is_at_the_end_exactly",
    ),
    Defect(
        "_solvers/step.py",
        "if first is None or made_jump is False:",
        "if first is None or made_jump is not None:",
        "a stale field after a jump",
        "solvers/test_pairs.py -k jump",
    ),
    Defect(
        "_solvers/step.py",
        "State(compensation, last, solver_state.zero)",
        "State(compensation, solver_state.first, solver_state.zero)",
        "a stale field after a step",
        "solvers/test_one_step.py",
    ),
    Defect(
        "_solvers/sums.py",
        "b = end + lax.stop_gradient(c)",
        "b = end",
        "a dropped compensation of rounding",
        "test_integrate.py -k compensation",
    ),
    Defect(
        "_solvers/dense.py",
        "total = (total + coefficients) * theta",
        "total = total * theta + coefficients",
        "a missing factor theta within a step",
        "solvers/test_one_step.py",
    ),
    Defect(
        "_solvers/low_storage.py",
        "combine((float(a), 1.0), (total, fields[-1]))",
        "combine((1.0, float(a)), (total, fields[-1]))",
        "swapped weights of a low-storage method",
        "solvers/test_low_storage.py -k observed_order",
    ),
    Defect(
        "_solvers/low_storage.py",
        "total = combine((a, 1.0), (total, here))",
        "total = combine((a, 1.0), (here, total))",
        "a swapped sum in the loop of a low-storage method",
        "solvers/test_low_storage.py -k in_a_loop",
    ),
    Defect(
        "_solvers/low_storage.py",
        "-567301805773 / 1357537059087",
        "-567301805773 / 1357537059078",
        "two digits swapped in CK54",
        "solvers/test_low_storage.py -k orders",
    ),
    Defect(
        "_solvers/munthe_kaas.py",
        "[k1, k2, k3, bracket(k1, k2)]",
        "[k1, k2, k3, bracket(k2, k1)]",
        "a bracket of the wrong sign in RKMK3",
        "solvers/test_munthe_kaas.py::test_one_step_is_the_published_formula",
    ),
    Defect(
        "_field.py",
        "weights.append(float(_bernoulli(k) / factorial(k)))",
        "weights.append(float(_bernoulli(k)))",
        "a missing factorial in the series of RKMK",
        "solvers/test_munthe_kaas.py::test_one_step_is_the_published_formula",
    ),
    Defect(
        "_solvers/munthe_kaas.py",
        "return self.order(None) - 2",
        "return self.order(None) - 3",
        "one commutator too few in RKMK",
        "solvers/test_munthe_kaas.py::test_one_step_is_the_published_formula",
    ),
    Defect(
        "_solvers/munthe_kaas.py",
        "b_error: ClassVar[Row] = _sixths(1, -2, 1, -1)",
        "b_error: ClassVar[Row] = _sixths(1, -2, 1, 0)",
        "an estimate of RKMK3 without its commutator",
        "solvers/test_munthe_kaas.py -k embedded_method_says",
    ),
    Defect(
        "_numerics/stumpff.py",
        "excess * b - a / 2",
        "excess * b + a / 2",
        "a wrong sign in the closed form of dexpinv",
        "fields/test_contract.py -k inverse_derivative",
    ),
    Defect(
        "_solvers/retraction.py",
        "g = v - matmul(q, matmul(q.T, v)) / 2",
        "g = v - matmul(q, matmul(q.T, v))",
        "a missing half in the Cayley retraction",
        "solvers/test_retraction.py",
    ),
    Defect(
        "_solvers/retraction.py",
        "w = matmul(along + matmul(x.T, self.middle), inverse)",
        "w = matmul(along - matmul(x.T, self.middle), inverse)",
        "a wrong sign in the differential of the retraction",
        "solvers/test_retraction.py",
    ),
    Defect(
        "_solvers/richardson.py",
        "(a - b) / (2**order - 1)",
        "(a - b) / 2**order",
        "a wrong factor of Richardson's estimate",
        "solvers/test_richardson.py -k estimate",
    ),
    Defect(
        "_solvers/richardson.py",
        "step(middle, t1, y_half, state_half, False)",
        "step(middle, t1, y_half, solver_state, False)",
        "a stale state in the second half of a step",
        "solvers/test_richardson.py",
    ),
    Defect(
        "_solvers/richardson.py",
        "return self.order(terms) + (1 if self.as_in_paper else 0)",
        "return self.order(terms) + 1",
        "a wrong order of the estimate for the controller",
        "solvers/test_richardson.py -k estimate",
    ),
    Defect(
        "_solvers/error_control.py",
        "squares.append(square / jnp.square(scale.astype(square.dtype)))",
        "squares.append(square / scale.astype(square.dtype))",
        "a scale that is not squared",
        "solvers/test_error_control.py",
    ),
    # Fields.
    Defect(
        "_fields/matrix.py",
        "act(self.a, other.a) - act(other.a, self.a)",
        "act(other.a, self.a) - act(self.a, other.a)",
        "the bracket of the other side",
        "fields/test_matrix.py -k bracket",
    ),
    Defect(
        "_fields/matrix.py",
        "return small_product(*promoted(x, a))",
        "return small_product(*promoted(a, x))",
        "a matrix on the wrong side",
        "fields/test_matrix.py -k flow",
    ),
    Defect(
        "_fields/matrix.py",
        "return (weight - 1) * point + moved",
        "return weight * point + moved",
        "an increment that holds the point itself",
        "fields/test_matrix.py -k steps_add",
    ),
    Defect(
        "_fields/rotation.py",
        "(self.omega, other.omega))",
        "(other.omega, self.omega))",
        "a bracket of rotations of the wrong sign",
        "fields/test_rotation.py fields/test_matrix.py -k bracket",
    ),
    Defect(
        "_fields/elementwise.py",
        "is_fixed = [bool(others) and x.shape[0] == 1 for x in distinct]",
        "is_fixed = [False for x in distinct]",
        "leading axes of 1 that are not broadcast",
        "fields/test_leading_axes.py -k broadcast",
    ),
    Defect(
        "_fields/rigid_motion.py",
        '"xyz_xyzw": (6, 3, 4, 5, 0, 1, 2)',
        '"xyz_xyzw": (3, 4, 5, 6, 0, 1, 2)',
        "a pose of ROS with the scalar part first",
        "fields/test_rigid_motion.py -k ros",
    ),
    Defect(
        "_fields/quaternion.py",
        'sign = 1 if self.frame == "fixed" else -1',
        'sign = -1 if self.frame == "fixed" else 1',
        "a bracket of quaternions in the wrong frame",
        "fields/test_contract.py -k Quat",
    ),
    Defect(
        "_numerics/rigid_motion.py",
        "pitch = (exponential.c3 * dot(w, v)) * weight",
        "pitch = (exponential.d2 * dot(w, v)) * weight",
        "a screw of the wrong pitch",
        "fields/test_contract.py -k Rigid",
    ),
    Defect(
        "_fields/affine.py",
        "combine((self.alpha, -other.alpha), (other.b, self.b))",
        "combine((other.alpha, -self.alpha), (other.b, self.b))",
        "swapped coefficients in the bracket of affine fields",
        "fields/test_affine.py -k bracket",
    ),
    Defect(
        "_fields/affine.py",
        "_times(phi_1(z), b)",
        "_times(jnp.exp(z), b)",
        "an exponential for phi_1",
        "fields/test_affine.py -k flow",
    ),
    Defect(
        "_fields/affine.py",
        "return super()._point(super().tangent(super()._coefficients(point)))",
        "return super()._point(super().tangent(point))",
        "a velocity within a step at a point instead of its coefficients",
        "fields/test_affine.py -k solve",
    ),
    Defect(
        "_fields/low_rank.py",
        "point = SpanPoint(frozen_at + correction(span.gram), span.blocks)",
        "point = SpanPoint(frozen_at, span.blocks)",
        "a dropped correction of the columns",
        "fields/test_low_rank.py -k orthonormality",
    ),
    Defect(
        "_fields/low_rank.py",
        "span, frozen_at = earlier[-1].span, point.z",
        "span, frozen_at = earlier[-1].span, jnp.eye(*point.z.shape, dtype=point.z.dtype)",
        "a field frozen at the start of the step, the wrong frame",
        "fields/test_low_rank.py -k full_matrices",
    ),
    Defect(
        "_fields/low_rank.py",
        "half = matmul(x.a, y.k)",
        "half = matmul(y.a, x.k)",
        "a bracket of the wrong sign on a span",
        "fields/test_low_rank.py -k bracket",
    ),
    Defect(
        "_fields/conjugation.py",
        "w * (first + _times(whole, b)) + _times(whole, t)",
        "w * (first + _times(x, b)) + _times(whole, t)",
        "two sides without what they do together",
        "fields/test_conjugation.py -k flow",
    ),
    Defect(
        "_fields/conjugation.py",
        "mean + (x - lax.stop_gradient(x))",
        "mean + (x + _adjoint(x) - 2 * mean) / 2",
        "derivatives of a congruence for Hermitian directions only",
        "fields/test_conjugation.py -k direction",
    ),
    Defect(
        "_fields/linear_affine.py",
        "- self._times(other.a, self.b)",
        "+ self._times(other.a, self.b)",
        "a bracket of affine fields that is not antisymmetric",
        "fields/test_linear_affine.py -k bracket",
    ),
    # Functions.
    Defect(
        "_numerics/expm_both.py",
        "return even + odd, even - odd",
        "return even + odd, even + odd",
        "exp(-a) with the even and odd part of exp(a)",
        "numerics/test_exponentials.py -k accuracy_of_both",
    ),
    Defect(
        "_numerics/expm_source.py",
        "g + small_product(small_product(e, g), _adjoint(e))",
        "g + small_product(small_product(e, g), e)",
        "a source doubled without the conjugate transpose",
        "numerics/test_exponentials.py -k with_a_source",
    ),
    Defect(
        "_numerics/expm.py",
        "s = jnp.maximum((exponent(size / theta**2) + 1) // 2, 0)",
        "s = jnp.maximum(exponent(size / theta**2) // 2, 0)",
        "one squaring too few",
        "numerics/test_expm.py",
    ),
    Defect(
        "_numerics/cayley_hamilton.py",
        "_plus(*(slopes[k + n - j - 1] * c_dot[j] for j in range(n)))",
        "_plus(*(slopes[k + j] * c_dot[j] for j in range(n)))",
        "a derivative of a characteristic polynomial backwards",
        "numerics/test_cayley_hamilton.py -k derivatives",
    ),
    Defect(
        "_numerics/cayley_hamilton.py",
        "x if (len(c) - j) % 2 == 0 else -x",
        "-x",
        "the characteristic polynomial of -a",
        "numerics/test_exponentials.py -k both_of_sizes",
    ),
    Defect(
        "_numerics/phi.py",
        "term = _times(a, term) / k",
        "term = _times(a, term) / (k + 1)",
        "a wrong factorial in phi_1 times a few columns",
        "numerics/test_phi_1_times.py",
    ),
    Defect(
        "_numerics/expm_multiply.py",
        "new + _by_real(before, lambda x: of_before * x), last",
        "new - _by_real(before, lambda x: of_before * x), last",
        "Chebyshev's recurrence for a real interval instead of an imaginary one",
        "numerics/test_kernels.py -k exponentials",
    ),
    Defect(
        "_fields/operator_sum.py",
        "bounds.append(jnp.minimum(of_sum, of_each))",
        "bounds.append(jnp.minimum(of_sum, of_each) / 2)",
        "a norm of matrices that is too small",
        "fields/test_operator_sum.py",
    ),
    Defect(
        "_fields/matrix.py",
        "return max_over_batch(off) <= 8",
        "return -max_over_batch(-off) <= 8",
        "a batch that is skew if one of its matrices is",
        "fields/test_few_columns.py",
    ),
    Defect(
        "_numerics/loop.py",
        "lax.cond(k < length, run,",
        "lax.cond(k <= length, run,",
        "a loop that is too long where it is differentiated",
        "numerics/test_kernels.py -k powers",
    ),
    Defect(
        "_numerics/phi.py",
        "_RADIUS = 4.0",
        "_RADIUS = 0.4",
        "a recursion upwards of phi functions where it cancels",
        "numerics/test_phi.py",
    ),
    Defect(
        "_numerics/phi.py",
        "doubled.append(functools.reduce(jnp.add, terms, small_product(e, phis[k])) * 0.5**k)",
        "doubled.append(functools.reduce(jnp.add, terms, phis[k]) * 0.5**k)",
        "phi functions of a matrix doubled without the exponential",
        "solvers/test_exponential.py -k one_step",
    ),
    Defect(
        "_fields/affine.py",
        "more = (self.alpha - first.alpha).astype",
        "more = (self.alpha - self.alpha).astype",
        "a linear part that is taken not to change within a step",
        "solvers/test_exponential.py -k one_step",
    ),
    Defect(
        "_solvers/exponential.py",
        "((1, ((1, c, c),)), *row)",
        "((1, ((1, Fraction(1), c),)), *row)",
        "the first column of a stage at the end of the step",
        "solvers/test_exponential.py -k one_step",
    ),
    Defect(
        "_solvers/exponential.py",
        "m: combine([theta**m], [change])",
        "m: combine([theta], [change])",
        "output within a step that forgets the powers of the time",
        "solvers/test_exponential.py -k one_step",
    ),
    Defect(
        "_solvers/exponential.py",
        "return jnp.zeros_like(self.equal_length), self.equal_length",
        "return t0, t1",
        "equal steps whose lengths differ by rounding, so that nothing is the same in all of them",
        "solvers/test_exponential.py -k compute_functions_once",
    ),
    Defect(
        "_solvers/exponential.py",
        "None if k in changing else part for k, part in made",
        "None for k, part in made",
        "nothing computed before a loop of equal steps",
        "solvers/test_exponential.py -k functions",
    ),
    Defect(
        "_methods/stiff_order.py",
        "below = (_conditions(tableau, q, _exactly, _exactly)",
        "below = (_conditions(tableau, q, _exactly, _at_zero)",
        "conditions of lower orders that hold weakly only",
        "methods/test_stiff_order.py",
    ),
    Defect(
        "_numerics/phi.py",
        "return _moment(m, z), _moment(m + 1, z) * z_dot",
        "return _moment(m, z), _moment(m, z) * z_dot",
        "a wrong derivative of phi_1",
        "numerics/test_phi.py",
    ),
    Defect(
        "_numerics/stumpff.py",
        "(k * c[k + 2] - c[k + 1]) / 2 * s_dot",
        "(k * c[k + 2] - c[k + 1]) * s_dot",
        "a missing half in the derivative of a rotation",
        "numerics/test_stumpff.py fields/test_rotation.py",
    ),
    Defect(
        "_numerics/transforms.py",
        "weights = n * _cosine_scale(n) * np.where(np.arange(n) == 0, 2, 1)",
        "weights = n * _cosine_scale(n)",
        "a missing factor in the fast cosine transform",
        "numerics/test_transforms.py",
    ),
    Defect(
        "_numerics/diagonalised.py",
        "np.where(np.imag(eigenvalues) > 0, 2, 1)",
        "np.where(np.imag(eigenvalues) > 0, 2, 2)",
        "a real eigenvalue that counts twice",
        "numerics/test_diagonalised.py",
    ),
    Defect(
        "_numerics/diagonalised.py",
        "return eigenvalues, q / scale[:, None], q.conj().T * scale, condition",
        "return eigenvalues, q, q.conj().T, condition",
        "the eigenvectors of the symmetric matrix for those of the given one",
        "numerics/test_diagonalised.py",
    ),
    # Integration, batches, measuring, scenes.
    Defect(
        "_term.py",
        "        _check_precision(place, part, point)\n",
        "",
        "a dropped check of the precision",
        "test_term.py",
    ),
    Defect(
        "_integrate.py",
        "return jnp.where(n == num_steps, t1, t0 + n.astype(t0.dtype) * ((t1 - t0) / intervals))",
        "return t0 + n.astype(t0.dtype) * ((t1 - t0) / intervals)",
        "a last step that misses the end by rounding",
        "test_integrate.py",
    ),
    Defect(
        "_integrate.py",
        "        return repeat(step, carry, rest)[0]",
        "        return carry",
        "dropped steps behind the last checkpoint",
        "test_integrate.py -k checkpoint",
    ),
    Defect(
        "_batch/program.py",
        "index = np.minimum(np.arange(start, start + self.chunk_size), stop - 1)",
        "index = np.minimum(np.arange(self.chunk_size), stop - 1)",
        "the first chunk of a batch in place of every other",
        "batch/test_batch.py -k chunks",
    ),
    Defect(
        "_arguments.py",
        "return len(program.jaxpr.in_avals) != len(jtu.tree_leaves(inputs))",
        "return False",
        "a batch that captures what is traced",
        "batch/test_batch.py -k traced",
    ),
    Defect(
        "_batch/failure.py",
        "(first, middle) if _fails(program, first, middle)",
        "(middle, last) if _fails(program, first, middle)",
        "a search for the member that failed in the wrong half",
        "batch/test_batch.py -k names_the_member",
    ),
    Defect(
        "_batch/store.py",
        'path.with_suffix(f".{secrets.token_hex(8)}.part")',
        'path.with_suffix(".part")',
        "a partial file that all processes write",
        "batch/test_batch.py -k another_process_writes",
    ),
    Defect(
        "_batch/store.py",
        "if belongs != digest(self.fingerprint, *inputs):",
        "if False:",
        "kept results that do not know their members",
        "batch/test_batch.py -k values_of_members",
    ),
    Defect(
        "_integrate.py",
        "    return is_short | (num_steps > _most_steps(t0.dtype))",
        "    return is_short & False",
        "steps shorter than the rounding of their times",
        "test_integrate.py -k shorter",
    ),
    Defect(
        "_numerics/squaring.py",
        "max_over_batch(jnp.max(s, initial=0, where=s == s))",
        "max_over_batch(jnp.max(s, where=s == s))",
        "an empty batch without a maximum",
        "fields/test_leading_axes.py -k motions_of_an_empty",
    ),
    Defect(
        "_solvers/error_control.py",
        "    size = jnp.maximum(size, jnp.sqrt(way))\n",
        "",
        "a first step that takes zero for the size of a state",
        "solvers/test_error_control.py -k at_zero",
    ),
    Defect(
        "_numerics/attitude.py",
        "    return [w, x, y, z], 2 * inverse\n",
        "    return [w, x, y, z], 2 + 0 * inverse\n",
        "a quaternion taken for one of length 1",
        "numerics/test_attitude.py -k length_of_a_quaternion",
    ),
    Defect(
        "_measure/flops.py",
        "return 2 * _size(eqn.outvars[0]) *",
        "return _size(eqn.outvars[0]) *",
        "a missing factor 2 in the flops of a product",
        "measure/test_flops.py",
    ),
    Defect(
        "_measure/cost.py",
        "return self.first + (num_steps - 1) * self.later",
        "return self.first + num_steps * self.later",
        "one step too many in the counts",
        "measure/test_work_precision.py",
    ),
    Defect(
        "scenes/heat.py",
        "b = _operator(mu - constant, to_grid(y))",
        "b = _operator(mu, to_grid(y))",
        "a part of the diffusivity that acts twice",
        "scenes/test_heat.py",
    ),
    Defect(
        "scenes/spins.py",
        "jnp.roll(y, 1, k) + jnp.roll(y, -1, k)",
        "jnp.roll(y, 1, k) + jnp.roll(y, 1, k)",
        "spins that feel two neighbours on one side",
        "scenes/test_spins.py",
    ),
    Defect(
        "scenes/spacecraft.py",
        'return {"q": _quaternion(attitude), "m": m}',
        'return {"q": _quaternion(attitude.swapaxes(-1, -2)), "m": m}',
        "a reference that turns the spacecraft the other way",
        "scenes/test_spacecraft.py",
    ),
    Defect(
        "scenes/heavy_top.py",
        "v = jnp.cross(omega, jnp.asarray(args.center, q.dtype))",
        "v = jnp.cross(jnp.asarray(args.center, q.dtype), omega)",
        "a center of mass that moves backwards",
        "scenes/test_heavy_top.py",
    ),
    Defect(
        "scenes/toda.py",
        "return Conjugation(jnp.triu(y, 1) - jnp.tril(y, -1))",
        "return Conjugation(jnp.tril(y, -1) - jnp.triu(y, 1))",
        "a Toda lattice that runs backwards",
        "scenes/test_toda.py",
    ),
    Defect(
        "scenes/zeitlin.py",
        "(0.5j * (len(y) ** 2 - 1) ** 0.5)",
        "(0.5j * len(y))",
        "a scale of Zeitlin's bracket that is right for large matrices only",
        "scenes/test_zeitlin.py",
    ),
    Defect(
        "scenes/covariance.py",
        "return Congruence(a - y @ s / 2, q)",
        "return Congruence(a - y @ s, q)",
        "measurements that count twice",
        "scenes/test_covariance.py",
    ),
    Defect(
        "scenes/wilson_flow.py",
        "return real, imaginary - trace[None, None] * eye",
        "return real, imaginary",
        "a force with a trace, off SU(3)",
        "scenes/test_wilson_flow.py",
    ),
    # Programs for XLA.
    Defect(
        "_solvers/sums.py",
        "moving, error = materialised_together((moving, error))",
        "moving = materialised_together(moving)",
        "an error that XLA computes together with its norm",
        "xla/test_materialise.py -k error_of_a_step",
    ),
    Defect(
        "_xla/step.py",
        "            return num_operations > FLAT_IN_BATCHES",
        "            return bool(self.linear) and num_operations > FLAT_IN_BATCHES",
        "long values of a batch that are not cut",
        "xla/test_turns.py -k cut_at",
    ),
    Defect(
        "_solvers/commutator_free.py",
        "end = materialised_if_long(end)",
        "end = end",
        "a long step that is not cut",
        "xla/test_materialise.py -k long_step",
    ),
    Defect(
        "_xla/step.py",
        "together([operands[k] for k in single])",
        "[operands[k] for k in single]",
        "the time of a long step in a batch that each function computes",
        "xla/test_materialise.py -k long_step_in_a_batch",
    ),
    Defect(
        "_xla/step.py",
        "return FLAT_MANY if self.is_batch else values",
        "return values",
        "a long step that is not scalarised in batches",
        "xla/test_turns.py -k in_batches",
    ),
    Defect(
        "_xla/program.py",
        "turn = [_entry(x, k) for x in values[m:]]",
        "turn = [_entry(x, 0) for x in values[m:]]",
        "every stage has the weights of the first",
        "xla/test_turns.py -k solve_agrees",
    ),
    Defect(
        "_xla/moves.py",
        "if any(part[k] != x.shape[k] for k in x.long):",
        "if False:",
        "parts of leading axes that are taken for the whole",
        "xla/test_struct_of_arrays.py -k windows",
    ),
    Defect(
        "_solvers/stacked.py",
        "lambda: _sum(row, fields), lambda",
        "lambda: 2 * _sum(row, fields), lambda",
        "combinations on leading axes that are twice as large",
        "xla/test_struct_of_arrays.py -k many_vectors",
    ),
    Defect(
        "_xla/understood.py",
        "or _is_of_stages(eqn)",
        "or True",
        "loops of a user's own are unrolled",
        "xla/test_turns.py -k of_a_field",
    ),
    Defect(
        "_xla/step.py",
        "results[k] = jnp.sum(x, shared) if shared else x",
        "results[k] = x[0] if shared else x",
        "a derivative in what a batch shares that is of its first member",
        "xla/test_step.py",
    ),
    Defect(
        "_xla/step.py",
        "return [jnp.moveaxis(x, 0, len(levels) - 1 - k) for x in outs]",
        "return outs",
        "directions inside of a batch that come out around it",
        "xla/test_step.py",
    ),
    Defect(
        "_xla/step.py",
        "moving = tuple(of.moving[k - first] for k in unknown)",
        "moving = of.moving[-len(unknown) :]",
        "a derivative in one operand that is taken in another",
        "xla/test_step.py",
    ),
    Defect(
        "_xla/step.py",
        "return of.derive(fun, shapes, of.moving, of.smooth)",
        "return of.derive(fun, shapes, of.moving[::-1], of.smooth)",
        "derivatives of numbers in the wrong operands",
        "xla/test_step.py",
    ),
    Defect(
        "_xla/program.py",
        'eqn.params["in_derivatives"] or form.calls is _LAST_CALLS',
        "True",
        "a derivative of a step that fails, in which zero is multiplied by NaN",
        "solvers/test_full_turns.py -k taken_again",
    ),
    Defect(
        "_xla/rules.py",
        "key = eqn.primitive, parameters(eqn), given",
        "key = eqn.primitive, given",
        "what is known of one operation that is taken for another",
        "xla/test_scalars.py -k known",
    ),
    Defect(
        "_xla/moves.py",
        "firsts = [min(max(int(k), 0), n - size)",
        "firsts = [min(int(k), n - size)",
        "a slice that begins before the first entry",
        "xla/test_scalars.py -k moved_as_jax",
    ),
    Defect(
        "_xla/moves.py",
        "n - max(-high, 0)",
        "n",
        "padding that takes nothing away at the end",
        "xla/test_scalars.py -k moved_as_jax",
    ),
    Defect(
        "_xla/turns.py",
        "return len(v.aval.shape) > 1 and v.aval.size > MAX_LENGTH",
        "return False",
        "tables of all stages that are scalarised in each turn",
        "xla/test_turns.py -k each_turn",
    ),
    Defect(
        "_xla/jaxprs.py",
        "np.asarray(v.val).tobytes()",
        "repr(v.val)",
        "constants that differ in the ninth digit are one",
        "xla/test_step.py -k nine_digits",
    ),
    Defect(
        "_numerics/quaternion.py",
        'cross(a, v) if frame == "fixed" else cross(v, a)',
        'cross(v, a) if frame == "fixed" else cross(a, v)',
        "angular velocities of quaternions in the other frame",
        "fields/test_quaternion.py",
    ),
    Defect(
        "_numerics/stumpff.py",
        "near * (u - s / 2 * a) + (d1 * u - d2 * a)",
        "near * (u - s / 2 * a) + (d1 * u - d2 / 2 * a)",
        "a stray half in the flow of quaternions",
        "fields/test_quaternion.py",
    ),
    Defect(
        "_numerics/stumpff.py",
        "d1, d2 = d1 - part * c1, d2 + part * c0",
        "d2 = d2 + part",
        "a length led back along the old quaternion instead of the turned one",
        "fields/test_many_steps.py",
    ),
    Defect(
        "_solvers/munthe_kaas.py",
        "y1 = found.or_nan(chart.end(end))",
        "y1 = chart.end(end)",
        "a step of more than a full turn that counts",
        "solvers/test_full_turns.py",
    ),
    Defect(
        "_xla/loop.py",
        "keeps = None if keep is None else lambda parts: parts",
        "keeps = None if keep is None else lambda parts: [2 * parts[0], *parts[1:]]",
        "what is kept of each step that is not the state",
        "test_integrate.py",
    ),
    Defect(
        "_xla/arithmetic.py",
        "sides[k] = x.sides[k]",
        "pass",
        "in a sum, entries that are equal along an axis count once",
        "xla/test_struct_of_arrays.py",
    ),
    Defect(
        "_xla/moves.py",
        "places.append(np.asarray(len(entries) + x.places))",
        "places.append(x.places)",
        "joined arrays that all have the entries of the first",
        "xla/test_struct_of_arrays.py",
    ),
    Defect(
        "_xla/understood.py",
        'frozenset((("reshape", "dimensions"), (',
        'frozenset((("reshape", "new_sizes"), (',
        "a rule that takes a parameter for granted",
        "xla/test_understood.py",
    ),
    Defect(
        "_xla/moves.py",
        'params | {"fill_value": -1, "mode": mode}',
        'params | {"mode": mode}',
        "what fills out of bounds is taken for an entry",
        "xla/test_understood.py",
    ),
    Defect(
        "_xla/smooth.py",
        "_is_smooth(eqn, reached):\n                raise _NotSmooth",
        "_is_smooth(eqn, reached):\n                pass",
        "products with reciprocals before a floor",
        "xla/test_understood.py",
    ),
    Defect(
        "_xla/smooth.py",
        "lax.full_like(a, 2.0**-half)",
        "lax.full_like(a, 1)",
        "reciprocals of numbers so large that XLA takes them for zero",
        "xla/test_understood.py",
    ),
    Defect(
        "_xla/arithmetic.py",
        "return extreme, total / functools.reduce(operator.add, shares)",
        "return extreme, total",
        "a derivative of a maximum that counts each of its ties",
        "xla/test_understood.py",
    ),
    Defect(
        "_xla/program.py",
        "is_in_place(eqn):\n        raise Declined",
        "is_in_place(eqn):\n        pass",
        "updates in place within a program that is scalarised",
        "xla/test_understood.py",
    ),
    # Noise.
    Defect(
        "_solvers/pieces.py",
        "((1 / 2, 1 / 2, sqrt(6)), (1 / 2, 1 / 2, -sqrt(6)))",
        "((1 / 2, 1 / 2, 2.0), (1 / 2, 1 / 2, -2.0))",
        "too little area of the noise in WeakOrder2",
        "noise/test_weak.py",
    ),
    Defect(
        "_solvers/pieces.py",
        "((1 / 2, 1 / 2, sqrt(6)), (1 / 2, 1 / 2, -sqrt(6)))",
        "((1.0, 1 / 2, sqrt(6)), (0.0, 1 / 2, -sqrt(6)))",
        "all of the drift in one of the pieces that follow the noise",
        "noise/test_weak.py",
    ),
    Defect(
        "_solvers/pieces.py",
        "b * w + c * jnp.sign(h).astype(w.dtype) * area",
        "b * w + c * area",
        "the area of noise that is followed backwards, with the other sign",
        "noise/test_control_term.py -k there_and_back",
    ),
    Defect(
        "_solvers/pieces.py",
        "((0.0, 0.0, sqrt(3) + 1), (1.0, 1.0, -2 * sqrt(3)), (0.0, 0.0, sqrt(3) - 1))",
        "((0.0, 0.0, sqrt(3) - 1), (1.0, 1.0, -2 * sqrt(3)), (0.0, 0.0, sqrt(3) + 1))",
        "the area of the noise in ShiftedNoise, with the other sign",
        "noise/test_strong.py",
    ),
    Defect(
        "_term.py",
        """strict=True)]
        return combine([1.0] * len(parts), parts)
    if not any""",
        """strict=True)]
        return jtu.tree_map(lambda *arrays: sum(arrays[1:], arrays[0]), *parts)
    if not any""",
        "terms, of noise for example, that are added array by array",
        "noise/test_control_term.py -k operator",
    ),
    Defect(
        "_control_term.py",
        "return jtu.tree_map(lambda x: jnp.where(is_back, -x, x), value)",
        "return value",
        "noise that does not turn round when it is followed backwards",
        "noise/test_control_term.py -k backwards",
    ),
    Defect(
        "_solvers/splitting.py",
        "turns += [(k, x.back, x.end) for k in reversed(range(1, last))]",
        "turns += [(k, x.back, x.end) for k in range(1, last)]",
        "a splitting whose way back is not the mirror image",
        "solvers/test_symmetric.py -k four_terms",
    ),
]


def planted(defect: Defect) -> str:
    """The file's text with the defect; an error where the table is stale."""
    text = (ROOT / "cfjax" / defect.file).read_text()
    if text.count(defect.old) != 1:
        raise ValueError(f"{defect.file} has {text.count(defect.old)} times {defect.old!r}.")
    return text.replace(defect.old, defect.new)


def caught_by(defect: Defect, only_first: bool) -> str:
    """The first test that fails, or nothing."""
    ignored = shutil.ignore_patterns(".*", "figures", "__pycache__", "*.egg-info")
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(ROOT, Path(folder) / "cfjax", ignore=ignored)
        (copy / "cfjax" / defect.file).write_text(planted(defect))
        words = defect.tests.split()
        first = [f"tests/{word}" if ".py" in word else word for word in words]
        everything = ["--numprocesses", "auto", "--dist", "worksteal"]
        runs = [first] if only_first else [first, everything]
        return next(filter(None, (failure(copy, arguments) for arguments in runs)), "")


def failure(folder: Path, arguments: list[str]) -> str:
    """The first test that fails with these arguments, or nothing."""
    # The copy and not what is installed, also in processes that the tests start.
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode == 0:
        return ""
    if "ImportError while loading conftest" in done.stdout + done.stderr:
        return "the import of cfjax"
    # FAILED and a test, or ERROR and a file that cannot be imported. Else no test has run.
    found = re.findall("^(?:FAILED|ERROR) (?:tests/)?(.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if not found:
        raise RuntimeError(f"{' '.join(command)}:\n{done.stdout}{done.stderr}")
    return found[0]


def main() -> int:
    parser = argparse.ArgumentParser(description="Whether the tests see planted defects.")
    parser.add_argument("words", nargs="*", metavar="WORD")
    parser.add_argument("--first", action="store_true")
    options = parser.parse_args()
    texts = [f"{defect.file}: {defect.what}" for defect in DEFECTS]
    chosen = [
        (defect, text)
        for defect, text in zip(DEFECTS, texts, strict=True)
        if not options.words or any(word in text for word in options.words)
    ]
    if not chosen:
        parser.error("no defect has one of these words")
    for defect, _ in chosen:
        planted(defect)
    caught = 0
    for defect, text in chosen:
        begin = time.perf_counter()
        test = caught_by(defect, options.first)
        caught += bool(test)
        seconds = time.perf_counter() - begin
        print(f"{'caught' if test else 'MISSED'}  {seconds:4.0f} s  {text}", flush=True)
        if test:
            print(f"                by {test}", flush=True)
    print(f"{caught} of {len(chosen)} defects caught: {caught / len(chosen):.0%}")
    return int(caught < NEEDED * len(chosen))


if __name__ == "__main__":
    sys.exit(main())
