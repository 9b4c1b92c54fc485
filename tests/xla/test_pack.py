"""`pack` and `unpack`: the numbers of `jnp.stack`."""

import jax
import jax.numpy as jnp
import numpy as np

from cfjax._xla.pack import pack, unpack

RNG = np.random.default_rng(0)


def test_pack_is_stack_and_unpack_its_inverse(subtests):
    cases = (
        (np.float32, 1, 0), (np.float64, 4, 1), (np.float64, 11, 0), (np.complex128, 11, 1),
        (np.int32, 4, 0), (np.bool_, 1, 1), (np.float64, 3, 2),
    )  # fmt: skip

    def there_and_back(given):
        packed = [pack(entries, axis) for entries, (_, _, axis) in zip(given, cases, strict=True)]
        return packed, [unpack(x, axis) for x, (_, _, axis) in zip(packed, cases, strict=True)]

    given = [
        [jnp.asarray(RNG.normal(size=(2, 5)) * 3, dtype) for _ in range(count)]
        for dtype, count, _ in cases
    ]
    for (dtype, count, axis), entries, whole, again in zip(
        cases, given, *jax.jit(there_and_back)(given), strict=True
    ):
        with subtests.test(dtype=dtype.__name__, count=str(count)):
            assert whole.dtype == dtype
            np.testing.assert_array_equal(whole, np.stack(entries, axis))
            np.testing.assert_array_equal(again, entries)
