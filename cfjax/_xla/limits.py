"""What is small and what is long: the numbers that decide what is rewritten, and how.

`python benchmarks/NAME.py` of the benchmark that is named with one shows what a change of it does.
They were set on two cores with AVX-512. What follows from one of them is below it.
"""

import jax

# The longest vector that is scalarised. A pose is a quaternion and a position. (batch)
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

# The most numbers that are materialised together. If there are more, XLA does not compute several
# members of a batch at once in a vector, which takes three times as long, and from 18 numbers on
# five times or more. (batch)
MAX_RESULTS = 13

# The most operations on single numbers of a step, with its loops unrolled. Before jax 0.12 XLA
# computes what two of its functions need in both, in long programs exponentially often, and a
# function has some 2000. (gradients, batch, chain)
MAX_OPERATIONS = 40_000 if jax.__version_info__ >= (0, 12) else 4000
