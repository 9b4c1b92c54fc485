"""What is small and what is long: the numbers that decide what is rewritten, and how.

The benchmark that is named with one shows what a change of it does. They were set on two cores with
AVX-512.
"""

import math

# Of vectors that are scalarised. A pose is a quaternion and a position.
# (`benchmarks/attitude.py`, `benchmarks/leading_axes.py`)
MAX_LENGTH = 7

# Of arrays all of whose entries are scalarised, as they come up within a step: the 4 x 4 matrix of
# a quaternion, and the 4 x 4 x 4 numbers that multiply two. (`benchmarks/fields.py`)
MAX_SIZE = 64

# Of the products of numbers that a product of two arrays is scalarised into: those of 6 x 6
# matrices. (`benchmarks/fields.py`)
MAX_PRODUCT = 216

# Of the numbers in the state of a step, together: the time to compile grows with them, and more so
# in derivatives. What a loop carries may have what sums have lost of each entry too, the number of
# the step and a result. As many directions or parameters are few, too. (`benchmarks/chain.py`)
MAX_ENTRIES = {"step": 16, "loop": 34}

# XLA takes what more entries are made of apart, and computes all that leads there for each of them.
# (`benchmarks/scenes.py`, controlled steps)
MAX_RESULTS = 15

# Of the operations of a step on single numbers. The time to compile grows with them, and more so in
# derivatives. (`benchmarks/compile.py`, `benchmarks/chain.py`)
MAX_OPERATIONS = 4000

# About as many operations XLA puts into one function. What is longer is cut, and materialised in
# between. (`benchmarks/attitude.py`; 20 ms a step where it is not)
FUNCTION = 2000

# What two of its functions need, XLA computes in both. In long programs it then computes single
# operations exponentially often: in values never as measured, in first derivatives from some 8000
# operations on, counted as they are written, within diffrax's loop from 4000, in batches from 5000,
# and in second ones earlier. So many are compiled as they are, for values, first and second
# derivatives; longer ones in groups, though to materialise what these share takes time.
# (`benchmarks/gradients.py`, `benchmarks/fits.py`)
WHOLE = {"loop": (math.inf, 6000, 3000), "step": (math.inf, 3500, 3000)}
WHOLE_IN_BATCHES = (math.inf, 4500, 3000)
