"""Random JAX programs, run as they are and rewritten.

    python tests/xla/random_programs.py --first 0 --count 1000 [--jit]

runs programs, prints each that differs, in a form to paste, and ends with counts. A program is
text: one operation a line, drawn from the templates below, whose fields are drawn too. While it is
made it runs, so that the next line knows shapes and dtypes; a line that raises is drawn again.
"""

import argparse
import functools
import itertools
import random
import re
import string
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

import cfjax
from cfjax._xla import scalarised, step

sys.path.insert(0, str(Path(__file__).parents[1]))
from xla.interpreter import num_rewritten, run

# The module that decides by the length of a program; a test may change the limit there.
lowering = step

# What the text of a program may use.


def draw(seed, shape, dtype, values):
    """Numbers of one kind: "ints" has ties and exact quotients, "special" infinities and NaN."""
    rng = np.random.default_rng(seed)
    kind = np.dtype(dtype).kind

    def real():
        if kind in "iub":
            return rng.integers(0 if kind in "ub" else -3, 4, shape)
        if values == "ints":
            return rng.integers(-2, 3, shape).astype(float)
        x = rng.normal(size=shape)
        if values == "special":
            ends = np.finfo(dtype)
            some = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, ends.tiny, ends.max / 2]
            some = rng.choice(np.array(some, float), shape)
            x = np.where(rng.random(shape) < 0.2, some, x)
        return x

    return np.asarray(real() + 1j * real() if kind == "c" else real()).astype(dtype)


@jax.custom_jvp
def odd(x):
    """A function whose derivative is not that of its code."""
    return x * x + 1


odd.defjvp(lambda p, t: (odd(*p), 7 * t[0] * p[0]))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def power_of(n, x):
    return x**n


power_of.defjvp(lambda n, p, t: (power_of(n, *p), n * t[0] * p[0] + 1))


@jax.jit
def both(a, b):
    return a * b, jnp.where(a > b, a, b) if not jnp.iscomplexobj(a) else a - b


# Templates, apart by " | " and by lines. Fields: x is a value, f a real or complex one, r a real
# one, i an integer one, v a vector, m a square matrix, s a number; like broadcasts with x, same has
# its shape and dtype; axis is one of x, and at an index along it, far one that may be outside.
# Names in `ONCE` are drawn once a line.

ARITHMETIC = """
{x} + {like} | {x} - {like} | {x} * {like} | {f} / {like} | {like} / {f} | -{x} | {x} ** {small}
{f} ** -1 | {f} / {number} | {number} / {f} | {x} + {number} | {number} - {x} | {x} % {like}
{x} // {like} | jnp.power({r}, {like}) | jnp.abs({x}) ** 0.5 | jnp.fmod({r}, {like})
jnp.remainder({r}, {number}) | jnp.hypot({r}, {like}) | jnp.arctan2({r}, {like})
jnp.maximum({x}, {like}) | jnp.minimum({x}, {like}) | {x} * {x} - {x} | jnp.reciprocal({f})
jnp.divmod({r}, {like})[{zero_or_one}] | {x} / jnp.max(jnp.abs({x})) | lax.div({f}, {same})
{x} * {x} + {like} | jnp.logaddexp({r}, {like}) | jnp.float_power({r}, 2) | lax.rem({x}, {same})
jnp.heaviside({r}, 0.5) | lax.nextafter({r}, {same}) | jnp.copysign({r}, {like}) | lax.pow({f}, {f})
jnp.ldexp({r}, 2) | jnp.square({x}) - {like} | both({x}, {like})[{zero_or_one}] | odd({f})
jnp.true_divide({x}, {like}) | {x} / {column} | {x} * {column} | {column} / {x}
"""

ELEMENTARY = """
jnp.sin({f}) | jnp.cos({f}) | jnp.exp({f}) | jnp.log({f}) | jnp.sqrt({f}) | jnp.tanh({f})
jnp.abs({x}) | jnp.sign({x}) | jnp.floor({r}) | jnp.ceil({r}) | jnp.round({f}) | jnp.trunc({r})
jnp.round({r}, 1) | jnp.expm1({f}) | jnp.log1p({f}) | jnp.arctan({f}) | jnp.cbrt({r})
lax.rsqrt({f}) | jax.scipy.special.erf({r}) | jnp.exp2({r}) | jnp.arcsinh({f}) | jnp.sinc({f})
jnp.square({x}) | jnp.rint({r}) | jnp.deg2rad({r}) | jnp.cosh({f}) | jnp.i0({r}) | lax.erf_inv({r})
jnp.conj({x}) | jnp.real({x}) | jnp.imag({x}) | jnp.angle({f}) | lax.complex({r}, {r})
jnp.nan_to_num({f}) | jnp.nan_to_num({f}, nan=2.0, posinf=1.0) | lax.reduce_precision({r}, 8, 7)
lax.stop_gradient({f}) | {f} * lax.stop_gradient({f}) | jnp.frexp({r})[{zero_or_one}]
lax.lgamma({r}) | jnp.modf({r})[{zero_or_one}] | jnp.positive({x})
lax.round({r}, lax.RoundingMethod.TO_NEAREST_EVEN)
lax.round({r}, lax.RoundingMethod.AWAY_FROM_ZERO) | lax.integer_pow({f}, {small}) | jnp.log2({f})
jnp.arccos({r} / 4) | jnp.tan({f}) | jax.scipy.special.xlogy({r}, {r}) | lax.digamma({r})
"""

CHOICES = """
jnp.where({bool}, {x}, {like}) | jnp.where({bool}, {x}, 0) | jnp.where({bool}, {number}, {x})
jnp.where({s} > 0, {x}, {like}) | jnp.clip({x}, -1, 1) | jnp.clip({r}, {number}, {number} + 1)
jnp.clip({x}, {like}) | lax.clamp({number}, {r}, {number} + 2.0) | {x} > {like} | {x} == {like}
{x} != {like} | {x} <= {like} | jnp.isfinite({f}) | jnp.isnan({f}) | jnp.isclose({x}, {like})
jnp.logical_and({bool}, {bool}) | jnp.logical_not({x}) | jnp.logical_xor({x}, {like}) | ~{bool}
{bool} * {x} | {bool} + {x} | lax.select({bool}, {x}, {same}) | jnp.where({bool}, {f} / {f}, 1)
jnp.where({x} > 0, jnp.log(jnp.where({x} > 0, {x}, 1)), 0)
jnp.select([{bool}, {x} > 0], [{x}, -{x}]) | jnp.piecewise({r}, [{r} > 0, {r} < -1], [jnp.sin, 2.0])
jnp.where(jnp.isnan({f}), 0, {f}) | jnp.where({x} > {like}, {x}, {like})
jnp.choose(({s} > 0).astype(int), [{x}, -{x}]) | jnp.signbit({r})
lax.select_n(({s} > 0).astype(jnp.int32), {x}, {same}) | jnp.array_equal({x}, {like})
lax.select_n({index_array_of_x}, {x}, {same}, {x}) | jnp.isinf({f}) | jnp.iscomplex({f})
"""

REDUCTIONS = """
jnp.sum({x}) | jnp.sum({x}, {axis}) | jnp.sum({x}, {axis}, keepdims=True) | jnp.prod({x}, {axis})
jnp.prod({x}) | jnp.max({x}) | jnp.max({x}, {axis}) | jnp.min({x}, {axis}, keepdims=True)
jnp.mean({f}) | jnp.mean({f}, {axis}, keepdims=True) | jnp.var({f}) | jnp.std({f}, {axis})
jnp.median({r}) | jnp.any({x} > 0) | jnp.all({x} > 0, {axis}) | jnp.any({x}, {axis}) | jnp.all({x})
jnp.cumsum({x}, {axis}) | jnp.cumprod({x}, {axis}) | lax.cumsum({x}, {axis}, reverse=True)
lax.cumprod({x}, {axis}, reverse=True) | lax.cummax({r}, {axis})
lax.cummin({r}, {axis}, reverse=True) | lax.cumlogsumexp({r}, {axis}) | jnp.argmax({r})
jnp.argmax({r}, {axis}) | jnp.argmin({r}, {axis}) | lax.argmax({r}, {axis}, jnp.int32)
jnp.count_nonzero({x}) | jnp.ptp({r}) | jnp.nansum({x}) | jnp.nanmax({r})
jnp.average({f}, weights={same}) | jnp.quantile({r}, 0.3) | jnp.diff({x}, axis={axis})
lax.reduce({x}, np.asarray(1, {x}.dtype), lax.mul, ({axis},))
lax.reduce({r}, np.asarray(0, {r}.dtype), lax.max, ({axis},))
lax.reduce({x}, {x}.ravel()[0], lax.add, ({axis},)) | jnp.sum({x}, where={bool})
jnp.max({r}, where={bool}, initial=0)
lax.reduce_window({r}, np.asarray(-9, {r}.dtype), lax.max, {windows}, {strides}, "SAME")
lax.reduce_window({x}, np.asarray(0, {x}.dtype), lax.add, {windows}, {strides}, "VALID")
lax.reduce_and({bool}, ({axis},)) | lax.reduce_or({bool}, ({axis},))
jnp.trapezoid({f}, axis={axis}) | jnp.prod({x}, where={bool}) | jnp.cumsum({bool}, {axis})
jnp.ediff1d({x}) | jnp.gradient({f}, axis={axis}) | lax.reduce_xor({i}, ({axis},)) | jnp.sum({bool})
jnp.mean({x}, dtype=jnp.float32) | jnp.sum({x}, dtype=complex)
lax.reduce(({r}, {r} + 1), (np.asarray(0, {r}.dtype), np.asarray(1, {r}.dtype)), lambda a, b: \
(a[0] + b[0], a[1] * b[1]), ({axis},))[{zero_or_one}]
"""

MOVES = """
jnp.roll({x}, {shift}) | jnp.roll({x}, {shift}, {axis}) | jnp.flip({x}, {axis}) | jnp.flip({x})
{x}[::-1] | jnp.tile({x}, 2) | jnp.tile({x}, (2, 1)) | jnp.repeat({x}, 2, {axis})
jnp.repeat({x}, 2) | jnp.ravel({x})
jnp.repeat({v}, np.arange({v}.size) % 3, total_repeat_length=4) | jnp.ravel({x}, order="F") | {x}.T
jnp.reshape({x}, (1, *{x}.shape)) | jnp.reshape({x}, (-1, 1)) | jnp.reshape({x}, {shape_of_x})
jnp.reshape({x}, {shape_of_x}, order="F") | lax.reshape({x}, {shape_of_x}, {permutation})
lax.transpose({x}, {permutation}) | jnp.moveaxis({x}, {axis}, {another})
jnp.swapaxes({x}, {axis}, {another}) | jnp.stack([{x}, {same}]) | jnp.stack([{x}, {same}, {x}], -1)
jnp.stack([{x}, {same}], {axis}) | jnp.concatenate([{x}, {same}], {axis})
jnp.concatenate([{x}, {x}[:0], {same}]) | jnp.hstack([{x}, {same}])
jnp.concatenate([{x}[1:], {x}[:1]]) | jnp.concatenate([{x}[..., :0], {x}], -1)
jnp.split({x}, [1], {axis})[{zero_or_one}] | jnp.concatenate([{x}[..., 1:], {x}[..., :2]], -1)
jnp.split({x}, [0, 2], {axis})[{zero_or_one}] | jnp.array_split({x}, 2, {axis})[{zero_or_one}]
jnp.unstack({x}, axis={axis})[-1] | jnp.expand_dims({x}, {axis}) | jnp.squeeze({x})
jnp.broadcast_to({x}, (2, *{x}.shape)) | jnp.broadcast_to({x}[:1], {x}.shape) | {x}[None]
lax.broadcast_in_dim({x}, ({x}.shape[0], 2, *{x}.shape[1:]), (0, *range(2, {x}.ndim + 1)))
{x}[..., None] | lax.rev({x}, ({axis},)) | jnp.rot90({m}) | jnp.pad({x}, {pads}, mode="{pad_mode}")
jnp.pad({x}, 1) | jnp.pad({x}, {pads}, constant_values=2)
lax.pad({x}, np.asarray(2, {x}.dtype), {lax_pads}) | lax.pad({x}, {x}.ravel()[0], {lax_pads})
jnp.delete({v}, 0) | jnp.insert({v}, 1, 2) | jnp.append({v}, {s}) | jnp.diag({v}) | jnp.diag({v}, 1)
jnp.diag({m}) | jnp.tril({m}) | jnp.triu({m}, 1) | jnp.diagonal({m}) | jnp.vander({v}, 3)
jnp.resize({x}, (2, 3)) | jnp.atleast_2d({x}) | jnp.meshgrid({v}, {v})[{zero_or_one}]
jnp.block([[{v}, {v}], [{v}, {v}]]) | jnp.fft.fftshift({x}, {axis}) | {x}.at[{at}].get()
jnp.stack([{s}, {s}, {s} * 2]) | jnp.array([{s}, 1, {s}]) | jnp.full((3,), {s})
jnp.full_like({x}, {s}) | jnp.zeros_like({x}) | jnp.linspace({s}, 1, 4) | jnp.arange({x}.size) * {s}
jnp.eye({x}.shape[-1]) * {s} | jnp.ones_like({x}) | lax.full_like({x}, 3)
jnp.linspace({v}, 2 * {v}, 3) | jnp.column_stack([{v}, {v}])
jnp.geomspace(1.0 + {s} * {s}, 2.0, 3) | jnp.vstack([{x}, {same}]) | lax.tile({x}, (2,) * {x}.ndim)
jnp.rollaxis({x}, {axis}) | lax.broadcasted_iota({x}.dtype, (3, 2), {zero_or_one}) * {s}
lax.reshape({x}, (int(np.prod({x}.shape)),), {permutation}) | jnp.transpose({x})
lax.squeeze({x}[None], (0,)) | lax.expand_dims({x}, (0, {x}.ndim + 1))
"""

INDEXING = """
{x}[{at}] | {x}[..., {last_at}] | {x}[1:] | {x}[::2] | {x}[::-1] | {x}[-2:] | {x}[{index_array}]
{x}[..., ::-1] | {x}[..., 1:] | {x}[..., ::-2] | {x}[..., {last_array}] | {x}[{traced_at}]
{x}[..., {traced_at}] | {x}[{traced_array}]
jnp.take({x}, {index_array}, axis={axis}, mode="{take_mode}") | jnp.take({x}, {far})
jnp.take({x}, {traced_array}, axis={axis})
jnp.take({x}, {far}, axis={axis}, mode="fill", fill_value=7) | jnp.take({x}, {far}, axis={axis})
jnp.take({x}, {index_array}, mode="wrap")
jnp.take_along_axis({r}, jnp.argsort({r}, {axis}), {axis})
jnp.take_along_axis({x}, {index_array_of_x}, {axis}, mode="clip") | {x}.at[{far}].get(mode="{mode}")
{x}.at[{far}].get(mode="fill", fill_value=3) | {x}.at[{index_array}].get(mode="promise_in_bounds")
{x}.at[{far_array}].get(mode="{mode}") | {x}.at[{far_array}].get(mode="fill", fill_value=-1)
{x}.at[..., {far}].get(mode="{mode}", fill_value=2)
{x}.at[{traced_at}].get(mode="{mode}", fill_value=5) | {x}.at[..., {far_array}].get(mode="{mode}")
{x}[{far}] | {x}[{far_array}] | lax.dynamic_slice({x}, {starts}, {sizes})
lax.dynamic_slice({x}, {traced_starts}, {sizes}) | lax.dynamic_index_in_dim({x}, {far}, {axis})
lax.dynamic_index_in_dim({x}, {traced_at}, {axis}, keepdims=False)
lax.dynamic_slice_in_dim({x}, {far}, 1, {axis}) | lax.index_take({x}, ({index_array},), (0,))
lax.slice_in_dim({x}, 0, 2, 1, {axis})
lax.slice({x}, {low_limits}, {high_limits}, {slice_strides}) | {x}[jnp.argmax({r})]
{x}[np.array([True] * 1 + [False] * ({x}.shape[0] - 1))]
jnp.compress([False, True], {x}, axis={axis}) | jnp.extract({bool}, {x}, size=2, fill_value=1)
{x}[({x} > 0).astype(int)] | {v}[{m}.astype(int) % {v}.size] | jnp.nonzero({x}, size=2)[0]
lax.gather({x}, {gather_indices}, lax.GatherDimensionNumbers(tuple(range(1, {x}.ndim)), (0,), \
(0,)), (1, *{x}.shape[1:]), mode="{mode}")
lax.gather({x}, {gather_indices}, lax.GatherDimensionNumbers(tuple(range(1, {x}.ndim + 1)), (), \
(0,)), (1, *{x}.shape[1:]), mode="{gather_mode}", fill_value=4) | jnp.trace({m})
{m}[{index_array}, {index_array}] | {m}[:, {at}] | {m}[{at}] | {m}[np.ix_([0, 1], [1, 0])]
{m}[jnp.triu_indices({m}.shape[-1])] | {x}[{at}:] | {m}[{at}, 1:]
jax.ops.segment_sum({v}, np.arange({v}.size) % 2, 3)
jax.ops.segment_max({v}, np.arange({v}.size) % 2, 2) | jnp.bincount({i}.ravel() % 3, length=4)
jnp.bincount({i}.ravel(), length=3)
"""

UPDATES = """
{x}.at[{at}].set({number}) | {x}.at[{at}].add({s}) | {x}.at[{at}].multiply({number})
{x}.at[{at}].divide({number}) | {x}.at[{at}].set({x}[{at}]) | {x}.at[{at}].power(2)
{x}.at[{at}].min({number}) | {x}.at[{at}].max({s}) | {x}.at[{at}].apply(jnp.sin)
{x}.at[{at}].apply(lambda a: a * a + 1) | {x}.at[{index_array}].set({number})
{x}.at[{index_array}].add({number}) | {x}.at[{index_array}].multiply({number})
{x}.at[{index_array}].max({number}) | {x}.at[{index_array}].apply(jnp.square)
{x}.at[{far}].set({number}) | {x}.at[{far}].add({number}, mode="{mode}")
{x}.at[{far_array}].add({number}, mode="{mode}") | {x}.at[{far_array}].set({number}, mode="{mode}")
{x}.at[{far_array}].multiply({s}, mode="{mode}") | {x}.at[{far_array}].min({number}, mode="{mode}")
{x}.at[{far_array}].apply(jnp.cos, mode="{mode}") | {x}.at[{traced_at}].set({number})
{x}.at[{traced_at}].add({s}) | {x}.at[{traced_array}].add({number})
{x}.at[{traced_array}].set({number}, mode="{mode}") | {x}.at[..., {last_at}].set({number})
{x}.at[..., {last_at}].add({x}[..., 0]) | {x}.at[..., {last_array}].add({number})
{x}.at[..., {last_at}].multiply({s}) | {x}.at[..., {last_at}].set({x}[..., -1])
{x}.at[..., {last_array}].set({number}) | {x}.at[..., {last_at}].max({number})
{x}.at[..., {last_array}].apply(jnp.square) | {x}.at[1:].set({number}) | {x}.at[:2].add({x}[-2:])
{x}.at[::2].multiply({number}) | {x}.at[::-1].set({same}) | {x}.at[...].add({like})
{x}.at[..., 1:].set({x}[..., :-1]) | {x}.at[..., :1].divide({number}) | {x}.at[..., :2].power(2)
{x}.at[{bool}].set({number}) | {x}.at[{at}].add({s}, unique_indices=True)
{x}.at[{at}].subtract({s}) | lax.dynamic_update_slice({x}, {same}[:1], {starts})
lax.dynamic_update_slice({x}, {same}[:1], {traced_starts})
lax.dynamic_update_index_in_dim({x}, {number}, {far}, {axis})
{x}.at[{at}].set(lax.dynamic_slice({x}, {starts}, (1,) * {x}.ndim).ravel()[0])
{x}.at[:1].set(lax.dynamic_slice({x}, {traced_starts}, (1,) * {x}.ndim))
{x}.at[{index_array}, {index_array}].add({number})
lax.scatter({x}, {gather_indices}, {x}[:2], lax.ScatterDimensionNumbers(tuple(range(1, {x}.ndim)), \
(0,), (0,)), mode="{mode}") | {m}.at[{index_array}, {index_array}].add({number})
{m}.at[{at}].set({number})
lax.scatter_add({x}, {gather_indices}, {x}[:2], lax.ScatterDimensionNumbers(tuple(range(1, \
{x}.ndim)), (0,), (0,)), mode="{mode}") | {m}.at[jnp.diag_indices({m}.shape[-1])].multiply({number})
lax.scatter_mul({x}, {gather_indices}, {x}[:2], lax.ScatterDimensionNumbers(tuple(range(1, \
{x}.ndim)), (0,), (0,)), mode="{mode}") | {m}.at[:, {at}].set({number})
jnp.put({x}, {index_array}, {number}, inplace=False)
lax.scatter_max({r}, {gather_indices}, {r}[:2], lax.ScatterDimensionNumbers(tuple(range(1, \
{r}.ndim)), (0,), (0,)), mode="{mode}") | jnp.fill_diagonal({m}, {number}, inplace=False)
lax.scatter_min({r}, {gather_indices}, {r}[:2], lax.ScatterDimensionNumbers(tuple(range(1, \
{r}.ndim)), (0,), (0,)), mode="{mode}") | {x}.at[{at}].mul({x}[{at}])
"""

PRODUCTS = """
{v} @ {v} | jnp.dot({x}, {x}.T) | {m} @ {m} | {m} @ {rowvector} | {x} @ {square} | {square} @ {x}
jnp.vdot({x}, {same}) | jnp.outer({v}, {v}) | jnp.inner({x}, {same}) | jnp.vecdot({x}, {same})
jnp.cross({x}, {same}) | jnp.cross({x}, {triple}) | jnp.kron({v}, {v})
jnp.einsum("...i,...i->...", {x}, {same}) | jnp.einsum("...i,ij->...j", {x}, {square})
jnp.einsum("...i,ji,...j->...", {x}, {square}, {same}) | jnp.einsum("i,j->ji", {v}, {v})
jnp.einsum("ii->i", {m}) | jnp.einsum("ij->", {m}) | jnp.einsum("ij,jk,kl->il", {m}, {m}, {m})
jnp.tensordot({x}, {same}, {x}.ndim) | jnp.tensordot({v}, {v}, 0) | jnp.einsum("...i->i", {x})
lax.dot_general({x}, {same}, ((({axis},), ({axis},)), ((), ())))
lax.dot_general({x}, {same}, (((), ()), (({axis},), ({axis},))))
lax.dot_general({x}, {same}, (((), ()), (tuple(range({x}.ndim)),) * 2))
lax.dot_general({v}, {v}, (((0,), (0,)), ((), ())), preferred_element_type=jnp.{float_type})
lax.dot_general({x}, {same}, ((({axis},), ({axis},)), ((), ())), precision="highest", \
preferred_element_type=jnp.{float_type}) | lax.dot({v}, {v}, precision=lax.Precision.HIGHEST)
jnp.matmul({m}, {rowvector}, preferred_element_type=jnp.{float_type}) | jnp.convolve({v}, {v})
jnp.convolve({v}, {v}, mode="same") | jnp.correlate({v}, {v}) | jnp.polyval({v}, {s})
lax.conv_general_dilated({v}[None, None], {v}[None, None, :2], (1,), "SAME")
lax.conv_general_dilated({v}[None, None], {v}[None, None, :2], (2,), [(1, 0)], rhs_dilation=(2,))
jnp.polyfit(np.arange(3.0), {v}[:3], 1) | jnp.linalg.multi_dot([{m}, {m}, {rowvector}])
jnp.interp({r}, np.array([-1.0, 0.5, 2.0]), {table}) | jnp.interp({r}, {table_sorted}, {table})
jnp.searchsorted({table_sorted}, {r}) | jnp.searchsorted(jnp.sort({v}), {r}, side="right")
jnp.digitize({r}, {table_sorted}) | jnp.cov({v}) | jnp.corrcoef({v}, {v}) | jnp.fft.fft({f})
jnp.fft.ifft({f}).real | jnp.fft.fft({f}, axis={axis}) | jnp.fft.rfft({r}) | jnp.fft.irfft({f})
jnp.fft.fft2({m}) | jnp.apply_along_axis(jnp.cumsum, {axis}, {x}) | jnp.matvec({m}, {rowvector})
{m} @ {m}.T | jnp.einsum("...i,...j->...ij", {x}, {same})
jnp.einsum("...i,...j->...", {x}, {same}) | jnp.cross({x}, {triple}) + {x}
jnp.cross({triple}, jnp.cross({triple}, {x})) | jnp.einsum("a...,a...->...", {x}, {same})
jnp.einsum("a...,b...->ab", {x}, {same})
"""

ALGEBRA = """
jnp.linalg.norm({f}) | jnp.linalg.norm({f}, axis=-1, keepdims=True)
{f} / jnp.linalg.norm({f}, axis=-1, keepdims=True) | jnp.linalg.norm({r}, 1, {axis})
jnp.linalg.norm({r}, jnp.inf, {axis}) | jnp.linalg.norm({m}) | jnp.linalg.inv({regular})
jnp.linalg.det({m}) | jnp.linalg.solve({regular}, {rowvector}) | jnp.linalg.eigh({m} + {m}.T)[0]
jnp.linalg.matrix_power({m}, 3) | jnp.linalg.cholesky({m} @ {m}.T + 4 * jnp.eye({m}.shape[-1]))
jnp.linalg.slogdet({regular})[1]
jax.scipy.linalg.solve_triangular({regular}, {rowvector}, lower=True) | jnp.linalg.qr({regular})[1]
jnp.linalg.svd({m}, compute_uv=False) | jax.scipy.linalg.expm({m}) | jnp.linalg.trace({m})
jnp.linalg.pinv({regular})
"""

NETWORKS = """
jax.nn.softmax({r}) | jax.nn.softmax({r}, axis={axis}) | jax.nn.log_softmax({r}) | jax.nn.relu({r})
jax.nn.gelu({r}) | jax.nn.silu({f}) | jax.nn.logsumexp({r})
jax.nn.logsumexp({r}, axis={axis}, keepdims=True) | jax.nn.one_hot({i}, 3) | jax.nn.sigmoid({f})
jax.nn.softplus({r}) | jax.nn.elu({r}) | jax.nn.leaky_relu({r}) | jax.nn.relu6({r})
jax.nn.standardize({r}) | jax.nn.one_hot(jnp.argmax({r}), 3) | jax.nn.selu({r})
jax.nn.hard_tanh({r}) | jax.nn.glu(jnp.concatenate([{r}, {r}], -1)) | jax.nn.celu({r})
jax.nn.soft_sign({r}) | jax.nn.mish({r}) | jax.nn.squareplus({r}) | jax.nn.log_sigmoid({r})
"""

SORTING = """
jnp.sort({r}) | jnp.sort({r}, {axis}, descending=True) | jnp.argsort({r})
jnp.argsort({r}, {axis}, descending=True) | jnp.sort({r}, {axis}) | lax.top_k({r}, 1)[{zero_or_one}]
jnp.partition({v}, 0) | lax.sort([{r}, {x}], num_keys=1)[1]
lax.sort([{r}, -{r}, {r} + 1], dimension={axis}, num_keys=2)[2]
lax.top_k({v}, {v}.size)[{zero_or_one}] | jnp.unique({v}, size=3, fill_value=0)
jnp.lexsort(({v}, {v})) | {v}[jnp.argsort({v})] | jnp.isin({x}, {table})
jnp.setdiff1d({v}, {table}, size=2) | jnp.flatnonzero({v}, size=3, fill_value=1)
jnp.percentile({r}, 50, axis={axis})
jnp.median({r}, {axis}) | jnp.nanmedian({r}) | jnp.histogram({v}, 3, (-2.0, 2.0))[0]
jnp.argwhere({v}, size=2)[:, 0]
"""

CONVERSIONS = """
{x}.astype(int) | {r}.astype(jnp.int32) | {x}.astype(bool) | {i}.astype(float) | {i} + 1.0
{i} * {x} | {x}.astype(jnp.float32) | {x}.astype(jnp.float64) | {x}.astype(complex)
{r}.astype(jnp.int8) | {r}.astype(jnp.uint8) | {r}.astype(jnp.float16) | {x}.astype(jnp.bfloat16)
{i} // 2 | {i} % 3 | {i} & 1 | {i} << 1 | {i} >> 1 | {i} ^ {i} | jnp.sign({i}) | jnp.abs({i})
{i} // {int_table} | {i} @ {i}.T | lax.bitcast_convert_type({r}, jnp.uint8)
lax.bitcast_convert_type(jnp.asarray({r}, jnp.float32), jnp.int32) | lax.population_count({i})
lax.clz({i}) | jnp.bitwise_not({i}) | lax.convert_element_type({x}, jnp.float32) * 2.0
jnp.asarray({s}).astype(int) | jnp.round({r}).astype(int) | lax.shift_right_logical({i}, {i})
{i} ** 2 | {i} / 2 | {i}.sum() | jnp.float32({s}) * {x} | np.float32(2) * {x}
np.float64(0.1) * {x} | 0.1 * {i} | True * {x} | jnp.asarray(2.5) * {x}
jnp.asarray([0.5], jnp.float32) * {x} | 2 ** {i} | {x} + 1j | jnp.invert({bool})
({bool}).astype({x}.dtype) * {x} | jnp.int32(1) + {i}
lax.bitcast_convert_type(lax.bitcast_convert_type(jnp.asarray({r}, jnp.float32), jnp.int32) + 1, \
jnp.float32) | jnp.bool_({bool}) ^ {bool} | jnp.uint8(250) + {i}.astype(jnp.uint8)
{i}.astype(jnp.int8) * np.int8(100) | {r}.astype(int).astype(float) | -{i}.astype(jnp.uint32)
"""

CONTROL = """
power_of({small}, {f}) | jax.jit(odd)({f}) | jax.checkpoint(jnp.sin)({f})
jax.vmap(lambda a: a * 2 - jnp.sum(a))({x}) | jax.vmap(jnp.dot)({x}, {same})
jax.grad(lambda a: jnp.sum(jnp.abs(a) ** 3))({r}) | jax.jit(jnp.dot)({v}, {v})
jax.vmap(lambda a, b: jnp.where(a > 0, a, b), (0, None))({r}, 1.0)
jax.jvp(jnp.tanh, ({f},), ({f},))[1] | jax.jit(lambda a: a[0] * a)({x})
jax.random.normal(key, {x}.shape) * {x} | jax.random.uniform(key, {x}.shape) + {x}
jax.random.permutation(key, {x}) | jax.random.choice(key, {v})
jax.random.bernoulli(key, 0.5, {x}.shape) * {x} | jax.random.randint(key, (3,), 0, 5)
jax.jacfwd(lambda a: a * a[::-1])({v}) | jax.vmap(lambda a: jax.nn.softmax(a))({r})
jax.lax.map(lambda a: a * 2, {x}) | lax.cond({s} > 0, lambda a: a, lambda a: -a, {x})
lax.fori_loop(0, 2, lambda k, a: a * a - 1, {x}) | lax.scan(lambda c, a: (c + a, c), {x}[0], {x})[1]
lax.associative_scan(jnp.add, {x}) | lax.switch(({s} > 0).astype(int), [jnp.sin, jnp.cos], {f})
lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * 0.5), (0, {f}))[1]
lax.map(jnp.sum, {x})
"""

# What has more axes than the state.
MATRICES = """
jnp.outer({v}, {v}) | {v} * {pair} | {x}[..., None, :] * {pair} | jnp.stack([{x}, {same}], -2)
jnp.stack([{x}, {same}, {x} * 2], -1) | {x}[..., None] * {x}[..., None, :] | {v}[:, None] - {v}
jnp.einsum("...i,ji->...ij", {x}, {pair}) | {v}[:, None, None] * {pair}
"""

CATEGORIES = {
    name.lower(): [t.strip() for line in text.strip().split("\n") for t in line.split(" | ")]
    for name, text in list(globals().items())
    if name.isupper() and isinstance(text, str)
}
WEIGHTS = {name: 1.0 for name in CATEGORIES} | {
    "arithmetic": 2.0, "indexing": 1.5, "updates": 1.5, "moves": 2.0, "algebra": 0.3,
    "sorting": 0.6, "control": 0.5,
}  # fmt: skip

SMALL = [{"": (n,)} for n in (3, 3, 3, 3, 1, 2, 4, 5, 6, 7)] + [
    {"a": (), "b": (3,)}, {"a": (3,), "b": (2,)}, {"a": (3,), "b": (3,)},
    {"a": (4,), "b": (3,), "c": ()}, {"a": (3,), "b": (3,), "c": (3,)},
    {"a": (), "b": (), "c": (2,)}, {"a": (1,), "b": (3,)},
]  # fmt: skip
MAX_SIZE = 400


class Unfit(Exception):
    """A template asks for what there is not."""


class Value(NamedTuple):
    text: str
    x: Any
    is_exact: bool

    def __str__(self):
        return self.text


class Program(NamedTuple):
    """A program, its text, and its arguments."""

    seed: int
    lines: list[str]
    exact: list[bool]
    result: str
    state: Any
    parameters: list[Any]
    arguments: str

    def text(self) -> str:
        body = "".join(f"    {line}\n" for line in self.lines)
        return f"{self.arguments}def fun(y, p):\n{body}    return {self.result}\n"

    def function(self, nudge: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """The program; with `nudge`, each of its values goes through that."""
        body = ["y = nudge(y, 0, True)"] if nudge else []
        for k, line in enumerate(self.lines):
            body.append(line)
            if nudge:
                name = line.split(" = ")[0]
                body.append(f"{name} = nudge({name}, {k + 1}, {self.exact[k]})")
        code = "def fun(y, p):\n" + "".join(f"    {line}\n" for line in body)
        namespace = dict(globals(), nudge=nudge)
        exec(code + f"    return {self.result}\n", namespace)
        return namespace["fun"]


def is_dyadic(x: Any, xp: Any = jnp) -> Any:
    """Whether sums and products of such numbers have no rounding."""
    if xp.iscomplexobj(x):
        return is_dyadic(x.real, xp) & is_dyadic(x.imag, xp)
    return (x * 8 == xp.round(x * 8)) & (xp.abs(x) < 2**12) | ~xp.isfinite(x)


def is_exact(x: Any) -> bool:
    x = np.asarray(x)
    if x.dtype.kind in "iub":
        return True
    with np.errstate(all="ignore"):
        return bool(np.all(is_dyadic(x if x.dtype.kind == "c" else x.astype(float), np)))


class Maker(string.Formatter):
    """Draws a program line by line. `get_value` draws the fields of a template."""

    def __init__(self, seed: int):
        self.rng = random.Random(seed)
        self.seed = seed
        self.lines, self.exact = [], []
        self.parameters, self.parameter_texts = [], []
        self.kind = self.rng.choices(["ints", "normal", "special"], [0.5, 0.4, 0.1])[0]
        self.dtype = self.rng.choices(
            ["float64", "float32", "complex128", "complex64"], [0.6, 0.25, 0.12, 0.03]
        )[0]
        shapes = self.rng.choice(SMALL)
        texts = {}
        self.values: list[Value] = []
        state = {}
        for k, (name, shape) in enumerate(shapes.items()):
            dtype = self.dtype
            if shape == () and self.rng.random() < 0.2:
                dtype = "int64"
            x = draw(seed * 10 + k, shape, dtype, self.kind)
            state[name] = jnp.asarray(x)
            texts[name] = f"jnp.asarray({self._literal(x, seed * 10 + k)})"
            self.values.append(Value(f'y["{name}"]' if name else "y", state[name], is_exact(x)))
        if "" in shapes:
            self.state, self.state_text = state[""], texts[""]
        else:
            self.state = state
            self.state_text = "{" + ", ".join(f'"{k}": {v}' for k, v in texts.items()) + "}"
        self.made: dict[str, Any] = {}

    def _literal(self, x: np.ndarray, seed: int) -> str:
        if x.size > 16 or not np.all(np.isfinite(x)):
            return f'draw({seed}, {x.shape}, "{x.dtype}", "{self.kind}")'
        return f'np.array({x.tolist()!r}, "{x.dtype}")'

    # Fields.

    def get_value(self, key, args, kwargs):
        if key not in self.fields:
            method = getattr(self, f"_{key}", None)
            if key in DRAWN:
                value = self.rng.choice(DRAWN[key])
            else:
                value = method() if method else self._pick(PICKS[key])
            if key not in ONCE:
                return value
            self.fields[key] = value
            if key in BASES:
                self.fields.setdefault("x", value)
        return self.fields[key]

    def _pick(self, fits: Callable[[Any], bool]) -> Value:
        """A value that fits, with more chance for late ones."""
        fitting = [v for v in self.values if fits(v.x)]
        if not fitting:
            raise Unfit
        return self.rng.choice(fitting[-3:] if self.rng.random() < 0.7 else fitting)

    @property
    def x(self) -> Any:
        if "x" not in self.fields:
            self.fields["x"] = self._pick(PICKS["x"])
        return self.fields["x"].x

    def _parameter(self, shape: tuple[int, ...], dtype: str, kind: str | None = None) -> str:
        old = [
            k for k, x in enumerate(self.parameters) if (x.shape, str(x.dtype)) == (shape, dtype)
        ]
        if old and kind is None:
            return f"p[{self.rng.choice(old)}]"
        seed = 1000000 + self.seed * 10 + len(self.parameters)
        x = draw(seed, shape, dtype, kind or self.kind)
        self._add(x, f"jnp.asarray({self._literal(x, seed)})")
        return f"p[{len(self.parameters) - 1}]"

    def _add(self, x: np.ndarray, text: str) -> None:
        self.parameters.append(jnp.asarray(x))
        self.parameter_texts.append(text)
        self.inexact_used |= not is_exact(x)

    def _int(self) -> Value:
        return self._pick(PICKS["i"])

    def _like(self) -> str:
        x, rng = self.x, self.rng
        choice = rng.random()
        shape = tuple(np.shape(x))
        if choice < 0.35:
            fits = [v for v in self.values if np.shape(v.x) == shape or np.shape(v.x) == ()]
            return str(rng.choice(fits)) if fits else self.rng.choice(DRAWN["number"])
        if choice < 0.5:
            return self.rng.choice(DRAWN["number"])
        if choice < 0.8:
            sides = [shape, shape[-1:], (), (*shape[:-1], 1), (1, *shape[1:])]
            return self._parameter(rng.choice(sides) if shape else (), self.dtype)
        if shape and choice < 0.9:
            return f"{self.fields['x']}[..., :1]"
        return f"({self.fields['x']} * 2)"

    def _same(self) -> str:
        x = self.x
        fits = [
            v for v in self.values
            if np.shape(v.x) == np.shape(x) and v.x.dtype == x.dtype
        ]  # fmt: skip
        kind = x.dtype.kind
        if self.rng.random() < 0.4 and kind in "fci" and x.dtype.itemsize > 2:
            return self._parameter(tuple(x.shape), str(x.dtype))
        return str(self.rng.choice(fits)) if fits else str(self.fields["x"])

    def _column(self) -> str:
        shape = tuple(np.shape(self.x))
        if not shape:
            raise Unfit
        return self._parameter((*shape[:-1], 1), self.dtype)

    def _bool(self) -> str:
        shape = np.shape(self.x)
        fits = [v for v in self.values if v.x.dtype == bool and np.shape(v.x) == shape]
        if fits and self.rng.random() < 0.5:
            return str(self.rng.choice(fits))
        x = str(self.fields["x"])
        if self.x.dtype.kind == "c":
            x += ".real"
        return f"({x} {self.rng.choice(['>', '>=', '==', '<'])} {self.rng.choice([0, 1, -0.5])})"

    def _axis(self) -> int:
        n = np.ndim(self.x)
        if not n:
            raise Unfit
        return self.rng.randrange(n)

    _another = _axis

    def _length(self, axis: int) -> int:
        shape = np.shape(self.x)
        if not shape or not shape[axis]:
            raise Unfit
        return min(shape[axis], 9)

    def _at(self) -> int:
        n = self._length(0)
        return self.rng.randrange(-n, n)

    def _last_at(self) -> int:
        n = self._length(-1)
        return self.rng.randrange(-n, n)

    def _far(self) -> int:
        n = np.shape(self.x)[0] if np.ndim(self.x) else 1
        return self.rng.choice([0, n - 1, -1, n, n + 3, -n, -n - 1, -n - 4])

    def _indices(self, indices: list[int]) -> str:
        if self.rng.random() < 0.3:
            x = np.array(indices)
            self._add(x, f"jnp.asarray({indices})")
            return f"p[{len(self.parameters) - 1}]"
        return f"np.array({indices})"

    def _few(self, one: Callable[[], int]) -> str:
        return self._indices([one() for _ in range(self.rng.randint(1, 3))])

    def _index_array(self) -> str:
        self._length(0)
        return self._few(self._at)

    def _last_array(self) -> str:
        self._length(-1)
        return self._few(self._last_at)

    def _far_array(self) -> str:
        return self._few(self._far)

    def _index_array_of_x(self) -> str:
        if not np.ndim(self.x):
            raise Unfit
        x = self.fields["x"]
        real = f"{x}.real" if self.x.dtype.kind == "c" else str(x)
        return f"({real} > 0).astype(jnp.int32)"

    def _traced_at(self) -> str:
        fits = [v for v in self.values if v.x.dtype.kind == "i" and np.ndim(v.x) == 0]
        if fits and self.rng.random() < 0.5:
            return str(self.rng.choice(fits))
        s = self._pick(lambda x: np.ndim(x) <= 2 and x.size and x.dtype.kind == "f")
        entry = "" if np.ndim(s.x) == 0 else f"[{', '.join('0' * np.ndim(s.x))}]"
        scale = self.rng.choice(["", " * 5", " + 2"])
        return f"jnp.nan_to_num({s}{entry}{scale}).astype(int)"

    def _traced_array(self) -> str:
        fits = [v for v in self.values if v.x.dtype.kind == "i" and 1 <= np.ndim(v.x) <= 2]
        if fits and self.rng.random() < 0.5:
            return str(self.rng.choice(fits))
        s = self._pick(lambda x: np.ndim(x) == 1 and x.size and x.dtype.kind == "f")
        return f"jnp.nan_to_num({s}[:2] * 2).astype(int)"

    def _gather_indices(self) -> str:
        self._length(0)
        if self.rng.random() < 0.2:
            return f"jnp.stack([{self._traced_at()}, {self._traced_at()}])[:, None].astype(int)"
        return f"np.array([[{self._far()}], [{self._far()}]])"

    def _starts(self) -> str:
        return "(" + "".join(f"{self._far()}, " for _ in range(np.ndim(self.x))) + ")"

    def _traced_starts(self) -> str:
        at = self._traced_at()
        n = np.ndim(self.x)
        moving = self.rng.randrange(max(n, 1))
        starts = (at if k == moving else f"jnp.zeros_like({at})" for k in range(n))
        return "(" + "".join(f"{start}, " for start in starts) + ")"

    def _sizes(self) -> str:
        sizes = [self.rng.choice([1, n, max(n - 1, 0)]) for n in np.shape(self.x)]
        return repr(tuple(sizes))

    def _low_limits(self) -> str:
        return repr(tuple(min(n, self.rng.randint(0, 1)) for n in np.shape(self.x)))

    def _high_limits(self) -> str:
        return repr(tuple(max(n - self.rng.randint(0, 1), 1) for n in np.shape(self.x)))

    def _slice_strides(self) -> str:
        return repr(tuple(self.rng.randint(1, 2) for _ in np.shape(self.x)))

    def _windows(self) -> str:
        return repr(tuple(self.rng.randint(1, 2) for _ in np.shape(self.x)))

    _strides = _windows

    def _shape_of_x(self) -> str:
        n, rng = int(np.size(self.x)), self.rng
        shape = np.shape(self.x)
        options = [(n,), (1, n), (n, 1), (*shape, 1), shape[::-1], (*shape[:1], 1, *shape[1:])]
        options += [(n // k, k) for k in (2, 3, 4) if n % k == 0]
        options += [(k, n // k) for k in (2, 3) if n % k == 0]
        return repr(tuple(rng.choice(options)))

    def _permutation(self) -> str:
        order = list(range(np.ndim(self.x)))
        self.rng.shuffle(order)
        return repr(tuple(order))

    def _pads(self) -> str:
        return repr([(self.rng.randint(0, 2), self.rng.randint(0, 2)) for _ in np.shape(self.x)])

    def _lax_pads(self) -> str:
        one, rng = lambda: self.rng.randint(-1, 2), self.rng
        return repr([(one(), one(), rng.choice([0, 0, 1])) for _ in np.shape(self.x)])

    def _square(self) -> str:
        shape = np.shape(self.x)
        if not shape or not 1 <= shape[-1] <= 9:
            raise Unfit
        return self._parameter((shape[-1],) * 2, self.dtype)

    def _pair(self) -> str:
        if not np.ndim(self.x) or np.shape(self.x)[-1] > 9:
            raise Unfit
        return self._parameter((2, np.shape(self.x)[-1]), self.dtype)

    def _triple(self) -> str:
        return self._parameter((3,), self.dtype)

    def _table(self) -> str:
        return self._parameter((3,), "float64")

    def _table_sorted(self) -> str:
        return "np.array([-1.0, 0.5, 2.0])"

    def _int_table(self) -> str:
        shape = np.shape(self.x)
        return self._parameter(shape[-1:], "int64")

    def _m(self) -> str:
        """A square matrix: a value, a parameter, or made of a vector."""
        rng = self.rng
        fits = [
            v for v in self.values
            if np.ndim(v.x) == 2 and v.x.shape[0] == v.x.shape[1] and 0 < v.x.shape[0] <= 6
        ]  # fmt: skip
        if fits and rng.random() < 0.6:
            value = rng.choice(fits)
            self.side = value.x.shape[0]
            return str(value)
        v = self._pick(lambda x: np.ndim(x) == 1 and 0 < x.size <= 5 and x.dtype.kind in "fc")
        self.side = int(v.x.size)
        matrix = self._parameter((self.side, self.side), self.dtype)
        return rng.choice(
            [f"jnp.outer({v}, {v})", f"({matrix} + {v})", f"({matrix} * {v}[:, None])"]
        )

    def _regular(self) -> str:
        m = self.get_value("m", (), {})
        return f"({m} + 9 * jnp.eye({self.side}))"

    def _rowvector(self) -> str:
        if "m" not in self.fields:
            self.get_value("m", (), {})
        fits = [v for v in self.values if np.shape(v.x) == (self.side,)]
        if fits and self.rng.random() < 0.7:
            return str(self.rng.choice(fits))
        return self._parameter((self.side,), self.dtype)

    # Lines.

    def line(self, among: list[str] | None = None) -> None:
        """One more, of some template, or of one of those given; none if nothing fits."""
        for _ in range(30):
            category = self.rng.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
            template = self.rng.choice(among or CATEGORIES[category])
            self.fields: dict[str, Any] = {}
            self.inexact_used = False
            number = len(self.parameters)
            name = f"x{len(self.lines)}"
            try:
                text = self.vformat(template, (), {})
                if "key" in text:
                    text = text.replace("(key", f"(jax.random.key({self.rng.randint(0, 9)})")
                moving = {"y": self.state, "p": self.parameters} | self.made
                x = run(lambda given, t=text: eval(t, globals() | given), moving)
                if not isinstance(x, np.ndarray) or x.size > MAX_SIZE or x.ndim > 4:
                    raise Unfit
                exact = is_exact(x) and not self.inexact_used
            except Exception:
                del self.parameters[number:], self.parameter_texts[number:]
                continue
            used = [v for v in self.values if v.text in text]
            exact = exact and all(v.is_exact for v in used)
            if "p[" in text:
                exact = exact and all(
                    is_exact(q) for k, q in enumerate(self.parameters) if f"p[{k}]" in text
                )
            self.lines.append(f"{name} = {text}")
            self.exact.append(exact)
            self.made[name] = x
            self.values.append(Value(name, x, exact))
            return

    def program(self, last: str) -> Program:
        if self.rng.random() < 0.3:
            self.line(CATEGORIES["matrices"])
        for _ in range(self.rng.choice([0, 0, 1, 1, 2, 2, 3, 4])):
            self.line()
        # Each template in turn, so that rare ones have their share.
        templates = [t for t in itertools.chain(*CATEGORIES.values()) if re.search(last, t)]
        self.line([templates[self.seed % len(templates)]])
        if not self.lines:
            self.line()
        code = " ".join(self.lines)
        names = [line.split(" = ")[0] for line in self.lines]
        results = [name for name in names if not _uses(code.replace(f"{name} = ", ""), name)]
        if self.rng.random() < 0.3:
            results.append(self.rng.choice(self.values).text)
        if self.parameters and self.rng.random() < 0.05:
            results.append("p[0]")
        arguments = f"y = {self.state_text}\np = [{', '.join(self.parameter_texts)}]\n"
        return Program(
            self.seed,
            self.lines,
            self.exact,
            "(" + ", ".join(results) + ",)",
            self.state,
            self.parameters,
            arguments,
        )


def _of_kind(kinds: str, ndim: int | None = None) -> Callable[[Any], bool]:
    return lambda x: x.dtype.kind in kinds and (ndim is None or x.ndim == ndim)


PICKS: dict[str, Callable[[Any], bool]] = {
    "x": lambda x: True,
    "f": _of_kind("fc"),
    "r": _of_kind("fib"),
    "i": _of_kind("iu"),
    "v": lambda x: x.ndim == 1 and 0 < x.size <= 20,
    "s": _of_kind("fc", 0),
}
DRAWN: dict[str, Sequence[Any]] = {
    "number": "0 1 2 -1 3 0.5 -2.0 1.5 0.3 0.0 7.0".split(),
    "small": [0, 1, 2, 3, -1, -2],
    "zero_or_one": range(2),
    "shift": range(-3, 4),
    "pad_mode": (
        "edge reflect symmetric wrap mean maximum minimum median linear_ramp empty".split()
    ),
    "mode": ["fill", "clip", "drop"],
    "gather_mode": ["fill", "clip", "drop"],
    "take_mode": ["fill", "clip", "wrap"],
    "float_type": ["float32", "float64"],
}
# Drawn once a line.
ONCE = frozenset(["x", "f", "r", "i", "v", "m", "s", "axis"])
# These take the place of x where it is not yet drawn.
BASES = frozenset(["f", "r", "i", "v"])


def _uses(text: str, name: str) -> bool:
    return re.search(rf"\b{name}\b", text) is not None


def smaller(program: Program) -> Iterator[Program]:
    """Each value of a program alone, with the lines that it needs."""
    for k, line in enumerate(program.lines):
        name = line.split(" = ")[0]
        kept = [k]
        for j in reversed(range(k)):
            earlier = program.lines[j].split(" = ")[0]
            if any(_uses(program.lines[i].split(" = ", 1)[1], earlier) for i in kept):
                kept.insert(0, j)
        yield program._replace(
            lines=[program.lines[j] for j in kept],
            exact=[program.exact[j] for j in kept],
            result=f"({name},)",
        )


def make(seed: int, last: str = "") -> Program:
    """The program of a seed. `last` matches its end."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Maker(seed).program(last)


# What is compared.


def _inexact(tree: Any) -> list[int]:
    leaves = jtu.tree_leaves(tree)
    return [k for k, x in enumerate(leaves) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.inexact)]


def _along(fun: Callable[..., Any], y: Any, p: Any) -> tuple[Callable[..., Any], list[Any]]:
    """The results that have derivatives, as a function of the arguments that have them."""
    leaves, structure = jtu.tree_flatten((y, p))
    moving = _inexact((y, p))

    def along(*some):
        given = list(leaves)
        for k, x in zip(moving, some, strict=True):
            given[k] = x
        outs = jtu.tree_leaves(fun(*jtu.tree_unflatten(structure, given)))
        return [outs[k] for k in _inexact(outs)]

    return along, [leaves[k] for k in moving]


def _weights(x: Any, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=x.shape)
    if jnp.iscomplexobj(x):
        weights = weights + 1j * rng.normal(size=x.shape)
    return weights.astype(x.dtype)


def gradient(fun: Callable[..., Any]) -> Callable[..., Any]:
    """The gradient of a weighted sum, by all arguments."""

    def of(y, p):
        along, some = _along(fun, y, p)

        def loss(*some):
            terms = [
                jnp.sum((x * _weights(x, k)).real).astype(float) for k, x in enumerate(along(*some))
            ]
            return sum(terms, jnp.zeros((), float))

        return jax.grad(loss, tuple(range(len(some))))(*some)

    return of


def tangent(fun: Callable[..., Any]) -> Callable[..., Any]:
    def of(y, p):
        along, some = _along(fun, y, p)
        return jax.jvp(along, some, [_weights(x, k) for k, x in enumerate(some)])

    return of


def batch(fun: Callable[..., Any]) -> Callable[..., Any]:
    def of(y, p):
        def some(x):
            other = jnp.roll(x, 1) if x.ndim else x + 1
            return jnp.stack([x, other, -x])

        return jax.vmap(lambda y: fun(y, p))(jtu.tree_map(some, y))

    return of


# What of a program is compared, and whether XLA compiles it. What it does not, NumPy evaluates.
KINDS: dict[str, tuple[Callable[[Callable[..., Any]], Callable[..., Any]], bool]] = {
    "value": (lambda fun: fun, False),
    "grad": (gradient, False),
    "jvp": (tangent, False),
    "vmap": (batch, False),
    "grad of vmap": (lambda fun: gradient(batch(fun)), False),
    "jvp of grad": (lambda fun: tangent(gradient(fun)), False),
    "jit": (lambda fun: fun, True),
    "jit of grad": (gradient, True),
    "jit of vmap": (batch, True),
}


CHANCES = {
    "value": 1.0, "grad": 0.3, "jvp": 0.1, "vmap": 0.1, "grad of vmap": 0.03, "jvp of grad": 0.03,
    "jit": 0.02, "jit of grad": 0.01, "jit of vmap": 0.01,
}  # fmt: skip


def rewritten(fun: Callable[..., Any]) -> Callable[..., Any]:
    """As a step in a batch of one, since one system is compiled as it was traced."""
    return lambda y, p: in_a_batch(lambda y: scalarised(lambda y: fun(y, p), y))(y)


def in_a_batch(fun: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def first_of_one(y: Any) -> Any:
        ys = jax.tree.map(lambda x: jnp.asarray(x)[None], y)
        return jax.tree.map(lambda x: x[0], jax.vmap(fun)(ys))

    return first_of_one


@functools.partial(jax.custom_jvp, nondiff_argnums=(1, 2, 3))
def _nudged(x: Any, run: int, exact: bool, unit: float) -> Any:
    largest = jnp.max(jnp.where(jnp.isfinite(x), jnp.abs(x), 0), initial=0).astype(x.real.dtype)
    part = _part(x, run, unit)
    moved = x * (1 + 2 * part) + part * jnp.where(x == 0, 0, largest)
    keep = ~jnp.isfinite(x) | (is_dyadic(x) if exact else False)
    zero = jnp.asarray(-0.0 if run % 2 else 0.0, x.dtype)
    return jnp.where(x == 0, zero, jnp.where(keep, x, moved.astype(x.dtype)))


@_nudged.defjvp
def _(run, exact, unit, primals, tangents):
    (x,), (t,) = primals, tangents
    moved = t * (1 + 2 * _part(x, run + 0.5, unit))
    return _nudged(x, run, exact, unit), moved.astype(x.dtype)


def _part(x: Any, run: float, unit: float) -> Any:
    """Up to a unit of rounding, the same for equal numbers, so that ties stay ties."""
    part = jnp.where(jnp.abs(x) < 1e6, x.real, 1)
    unit = max(unit, float(jnp.finfo(x.dtype).eps))
    return (unit * jnp.sin((part * 1e3 + 1) * (run + 1))).astype(part.dtype)


def nudge(run: int, unit: float) -> Callable[..., Any]:
    """Changes numbers by units of rounding, but not those that are computed exactly.

    A unit is that of the number's dtype, and at least `unit`.
    """

    def nudged(tree: Any, line: int, exact: bool) -> Any:
        tree = jtu.tree_map(jnp.asarray, tree)
        run_of_line = run + 5 * line
        return jtu.tree_map(
            lambda x: (
                _nudged(x, run_of_line, exact, unit) if jnp.issubdtype(x.dtype, jnp.inexact) else x
            ),
            tree,
        )

    return nudged


RUNS = 4


def difference(
    got: Any, want: Any, noise: Callable[[], list[Any]] | None, is_derivative: bool = False
) -> str | None:
    """What is different, beyond rounding; None if nothing is.

    Numbers may differ by 16 units of rounding of the largest in their array, for sums in another
    order, and by 100 times what nudges of each value by some units of rounding change: the
    rewritten program rounds every value differently, and a few times more often. What these nudges
    change in kind, a comparison or an infinity, is not compared, and nor are numbers of one sign
    near the largest of their dtype, which a sum in another order may exceed. A derivative may be
    finite where that of the program is NaN: an entry that is overwritten is dead code when it is
    scalarised, where the program multiplies its infinite derivative by zero.
    """
    got, want = jtu.tree_leaves(got), jtu.tree_leaves(want)
    if len(got) != len(want):
        return f"{len(got)} results, not {len(want)}"
    others: list[list[Any]] | None = None
    for k, (a, b) in enumerate(zip(got, want, strict=True)):
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            return f"result {k}: {a.dtype}{a.shape}, not {b.dtype}{b.shape}"
        if jnp.issubdtype(b.dtype, jax.dtypes.prng_key):
            continue
        a, b = _array(a), _array(b)
        tolerance = _rounding(b)
        dead = np.isnan(b) if is_derivative and b.dtype.kind in "fc" else False
        if _agree(a, b, tolerance, dead).all():
            continue
        if noise is None:
            agree = _agree(a, b, tolerance, dead)
        else:
            if others is None:
                others = [jtu.tree_leaves(tree) for tree in noise()]
            moved = [_array(tree[k]) for tree in others]
            unstable = ~np.logical_and.reduce([_agree(c, b, np.inf, False) for c in moved])
            if b.dtype.kind in "fc":
                with np.errstate(all="ignore"):
                    spread = np.max([np.abs(c - b) for c in moved], axis=0)
                tolerance = tolerance + 100 * np.nan_to_num(spread, nan=0.0)
            agree = _agree(a, b, tolerance, unstable | dead)
        if not agree.all():
            place = np.argwhere(~agree)[0]
            index = tuple(map(int, place))
            return (
                f"result {k}: {(~agree).sum()} of {b.size} differ, {b.dtype}{b.shape}, "
                f"at {index}: {a[index]!r}, not {b[index]!r}"
            )
    return None


def _array(x: Any) -> np.ndarray:
    x = np.asarray(x)
    if x.dtype.kind == "V" or (x.dtype.itemsize <= 2 and x.dtype.kind == "f"):
        x = x.astype(np.float32)
    return x


def _rounding(x: np.ndarray) -> Any:
    if x.dtype.kind not in "fc":
        return 0
    finite = np.abs(x[np.isfinite(x)])
    return 16 * np.finfo(x.dtype).eps * (finite.max() if finite.size else 0)


def _agree(a: np.ndarray, b: np.ndarray, tolerance: Any, unstable: Any) -> np.ndarray:
    if a.dtype.kind not in "fc":
        return (a == b) | unstable
    huge = np.finfo(a.dtype).max / 1e3
    if a.dtype.kind == "c":
        wild = ~(np.abs(a) <= huge) & ~(np.abs(b) <= huge)
        return wild | _agree(np.abs(a - b), np.zeros(a.shape), tolerance, unstable)
    with np.errstate(all="ignore"):
        near = np.isfinite(a) & np.isfinite(b) & (np.abs(a - b) <= tolerance)
    near = near | ((a > huge) & (b > huge)) | ((a < -huge) & (b < -huge))
    return near | (a == b) | (np.isnan(a) & np.isnan(b)) | unstable


def failure(program: Program, kind: str, found: Counter | None = None) -> str | None:
    """How the rewritten program differs, under one transformation; None if it does not."""
    transform, is_compiled = KINDS[kind]
    y, p = program.state, program.parameters
    is_known = program.seed % 2 == 1

    def result(change: Callable[..., Any], compiled: bool, nudge: Any = None) -> Any:
        fun = program.function(nudge)
        execute = (lambda fun, *args: jax.jit(fun)(*args)) if compiled else run
        if is_known:
            return execute(lambda y: transform(change(lambda y, _: fun(y, p)))(y, []), y)
        return execute(transform(change(fun)), y, p)

    def as_it_is(fun):
        return fun

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with cfjax.rewriting(False):
            try:
                want = result(as_it_is, False)
            except Exception:
                if found is not None:
                    found["cannot be run"] += 1
                return None
        warnings.filterwarnings("error", message="cfjax could not")
        try:
            with cfjax.rewriting(True):
                got = result(rewritten, is_compiled)
        except Exception as error:
            lines = traceback.extract_tb(error.__traceback__)
            where = [f"{line.name}:{line.lineno}" for line in lines if "/_xla/" in line.filename]
            return f"{type(error).__name__}: {str(error)[:400]} ({where[-1:]})"

        def noise() -> list[Any]:
            with cfjax.rewriting(False):
                # What is rounded to single precision on its way is no more exact than that.
                unit = np.finfo(np.float32).eps if "float32" in program.text() else 0.0
                trees = [result(as_it_is, False, nudge(k, float(unit))) for k in range(RUNS)]
                # XLA's own liberties are no fault of the rewriting.
                return trees + ([result(as_it_is, True)] if is_compiled else [])

        return difference(got, want, noise, "grad" in kind or "jvp" in kind)


def kinds_of(program: Program, always_jit: bool = False) -> Iterator[str]:
    rng = random.Random(-program.seed)
    yield "value"
    for kind, (_, is_compiled) in KINDS.items():
        chance = CHANCES[kind]
        if always_jit and is_compiled:
            chance = 1.0 if kind == "jit" else 10 * chance
        if kind != "value" and rng.random() < chance:
            yield kind


def _num_maps() -> int:
    try:
        with open("/proc/self/maps") as file:
            return sum(1 for _ in file)
    except OSError:
        return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--jit", action="store_true", help="compile each program")
    parser.add_argument("--only", metavar="REGEX", help="operations to end with, by their text")
    parser.add_argument("--skip", metavar="REGEX", help="operations not to draw, by their text")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if args.skip:
        for templates in CATEGORIES.values():
            templates[:] = [t for t in templates if not re.search(args.skip, t)]
    found: Counter = Counter()
    start, start_cpu = time.perf_counter(), time.process_time()
    for number, seed in enumerate(range(args.first, args.first + args.count)):
        program = make(seed, args.only or "")
        for kind in kinds_of(program, args.jit):
            found[kind] += 1
            before = num_rewritten()
            message = failure(program, kind, found)
            found["rewritten"] += kind == "value" and num_rewritten() > before
            if message:
                found["failures"] += 1
                found[f"failures: {kind}"] += 1
                for part in smaller(program):
                    if less := failure(part, kind):
                        program_to_print, message = part, less
                        break
                else:
                    program_to_print = program
                known = ", parameters known" if seed % 2 else ""
                text = program_to_print.text()
                print(f"# seed {seed}, {kind}{known}: {message}\n{text}", flush=True)
        # A compiled program keeps memory maps; a process may have 65 530.
        if number % 2000 == 1999 or (number % 50 == 49 and _num_maps() > 40000):
            jax.clear_caches()
    seconds = time.perf_counter() - start
    speed = args.count / seconds, args.count / (time.process_time() - start_cpu)
    speeds = "{:.1f} a second, {:.1f} a second of the processor".format(*speed)
    print(f"{args.count} programs, {speeds}:", dict(found))
    return bool(found["failures"])


if __name__ == "__main__":
    sys.exit(main())
