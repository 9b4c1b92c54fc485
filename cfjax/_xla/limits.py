"""What is small and what is long: the numbers that decide what is rewritten, and how.

`python benchmarks/NAME.py` of the benchmark that is named with one shows what a change of it does.
They were set on two cores with AVX-512. What follows from one of them is below it.
"""

import jax

# The longest vector that is scalarised. A pose is a quaternion and a position. (attitude,
# leading_axes)
MAX_LENGTH = 7
# A product of two arrays is scalarised into at most this many products of numbers, those of two
# 6 x 6 matrices. (fields)
MAX_PRODUCT = (MAX_LENGTH - 1) ** 3

# The largest array all of whose entries are scalarised. Within a step come up the 4 x 4 matrix of
# a quaternion, and the 4 x 4 x 4 numbers that multiply two. A loop over stages copies the fields of
# all of them in each turn, which takes longer than the flow if a field has more numbers, and more
# than four times those that it moves. (fields)
MAX_SIZE = 64
# The vectors of at most this many stages are scalarised in a table, though the table is larger than
# `MAX_SIZE`. (batch)
MAX_STAGES = 16

# The most numbers in the state of a step: the time to compile grows with them, and more so
# in derivatives. What a loop carries may have what sums have lost of each entry too, the number of
# the step and a result. As many directions or parameters are few, too. (chain)
MAX_ENTRIES = {"step": 16, "loop": 2 * 16 + 2}

# XLA takes what more entries are made of apart, and computes all that leads there for each of them.
# (scenes, adaptive steps)
MAX_RESULTS = 15
# The most entries that are materialised together in a batch. If there are more, XLA does not
# compute several members at once in a vector, which takes three times as long, and from 18 entries
# on five times or more. (batch)
MAX_RESULTS_IN_BATCHES = 13

# About as many operations XLA puts into one function.
_FUNCTION = 2000
# From jax 0.12 on XLA compiles a loop of one system as one function, and on single numbers it gains
# nothing. Before, what two functions need it computes in both, in long programs exponentially
# often.
_IS_NEW = jax.__version_info__ >= (0, 12)
# The most operations of one system. (gradients, compile)
FLAT_ONE = 0 if _IS_NEW else 2 * _FUNCTION
# The most operations of many systems: of a batch, or of short vectors along leading axes.
# (gradients, batch, chain)
FLAT_MANY = (20 if _IS_NEW else 2) * _FUNCTION
