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

# About as many operations XLA puts into one function. What is longer is cut, and materialised in
# between: a step takes 20 ms where it is not. (attitude)
FUNCTION = 2000
# Values of many that are scalarised as a whole are cut in a loop over many stages if they are
# longer. XLA computes what a turn needs of all turns before it in each of its functions, up to
# thousands of times over, depending on what else is known of a program. What is known of it before
# are its operations times the turns of its loop: values with more than this are cut, as a cut that
# is not needed costs up to a factor of three (gradients, batch).
CUT_VALUES = 5 * FUNCTION // 2
UNCUT_VALUES = 32 * FUNCTION
# But for those that turn out to have at most so many: in a loop over stages all weights are
# counted, and many are zero. (batch)
UNCUT = 3 * FUNCTION // 2
# The most operations of one system. From jax 0.12 on XLA compiles its loop as one function, and on
# single numbers it gains nothing. (gradients, compile)
FLAT_ONE = 0 if jax.__version_info__ >= (0, 12) else 2 * FUNCTION
# The most operations in batches, which short vectors along leading axes are too. A gradient of this
# length takes some 12 s to compile (gradients, batch, chain).
FLAT_MANY = 9 * FUNCTION
# The most operations of a derivative that is differentiated again, and of that derivative. (fits,
# gradients)
FLAT_SECOND = 2 * FUNCTION
# Whatever is longer is cut where a method says, and a derivative at the turns of a loop:
# what two functions need, XLA computes in both, and in long programs exponentially often. Some
# derivatives of 4800 operations never end, and others of 6000 do not need the cut, which makes them
# two to four times as long. Nothing that is known before tells them apart. (attitude, leading_axes)
FLAT_WHOLE = 2 * FUNCTION
# Few directions of a Jacobian of many systems are computed one after the other if each has at most
# so many operations; up to four of them if it is longer, too. More of them take less time together.
# (compile)
FLAT_DIRECTIONS, FEW_DIRECTIONS = 3 * FUNCTION, 4
# The numbers of a large point. If a loop over stages is differentiated, it keeps the points of all
# stages for each of its turns, which is too much memory for larger ones; and unrolled, XLA keeps
# several fields to add them up at once, which is too much for those of twice as many. (scenes)
LARGE = 2048
# The numbers of a large array of a field. In a loop over stages, combinations of larger ones are
# matrix products: with 1000 numbers a step takes a twentieth to a quarter less, with 64 as long.
# (scenes)
LARGE_TERM = 512

# More stages of a method are many. It is mostly not scalarised as a whole, and unrolled its time to
# compile grows as the square of their number. (compile)
MANY = 9
