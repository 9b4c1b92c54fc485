PYTHON ?= python3
BIN := .venv/bin
# The whole suite, in as many processes as there are cores.
PYTEST := -m pytest --numprocesses auto --dist worksteal
# Each solver and each field once, what the code relies on in jax, equinox and diffrax, and imports.
QUICK := tests/test_quick.py tests/xla/test_scalars.py tests/test_canary.py tests/test_public.py tests/test_architecture.py

.PHONY: paper lint suite test test-all test-quick test-lowest test-newest coverage mutations benchmarks benchmark-gpu benchmark-older pages docs clean

# Tables and figures of the paper, in figures/.
paper: .venv/paper
	$(BIN)/python -m cfjax paper

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# Lint, types, tests: types, which take one core, beside the tests.
test: .venv/dev
	@$(MAKE) --no-print-directory --jobs=2 lint suite

suite: .venv/dev
	$(BIN)/python $(PYTEST)

# The slow ones too, with the emitters of XLA that users' programs are compiled with.
test-all: .venv/dev
	XLA_FLAGS= $(BIN)/python $(PYTEST) -m "slow or not slow"

# Whether a version works at all, with these emitters too.
test-quick: .venv/dev
	XLA_FLAGS= $(BIN)/python $(PYTEST) -m "slow or not slow" $(QUICK)

# The tests on exactly the lowest versions in pyproject.toml.
test-lowest: .venv-lowest/dev
	.venv-lowest/bin/python $(PYTEST)

# The tests on the newest versions of everything, looked up anew each time.
# Another Python: make test-newest PYTHON=python3.14
test-newest:
	test -x .venv-newest/bin/python || $(PYTHON) -m venv .venv-newest
	.venv-newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager --editable '.[dev]'
	.venv-newest/bin/python $(PYTEST)

# Measures everything anew, one after the other, for the pages: on Python 3.12 or newer, for the
# newest jax, and on a machine with nothing else to do. ARGS=--quick is rough, and quicker.
BENCHMARKS := rigid_body equal_error tolerances million_steps gradients fits fields leading_axes compile first_call second_process getting_started chain expm heat stiff stabilised coordinates batch charts stability energy noise noise_steps noise_lattice quantum lindblad operators variations peers scenes
benchmarks: .venv/dev
	@$(BIN)/python benchmarks/results.py
	for name in $(BENCHMARKS); do $(BIN)/python benchmarks/$$name.py $(ARGS) || exit 1; done
	$(MAKE) pages

# For the page on older JAX, with a Python whose newest jax is below 0.12.
benchmark-older: .venv/dev
	$(BIN)/python benchmarks/older_jax.py $(ARGS)

# On a machine with a GPU, whose results are stored too.
benchmark-gpu: .venv/dev
	$(BIN)/python benchmarks/gpu.py $(ARGS)

# The pages' tables, numbers and pictures, from what has been measured.
pages: .venv/dev
	$(BIN)/python benchmarks/pages.py

# The site, in site/. A warning is an error: a broken link, a page that nothing leads to.
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# The tests of `make test`, with lines and branches of cfjax that they do not reach.
coverage: .venv/dev
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal --cov --cov-report=term-missing

# Whether the tests see mistakes, planted one at a time. ARGS='--count 20 cfjax/_solvers'
mutations: .venv/dev
	$(BIN)/python tests/mutations.py $(ARGS)

.venv/paper .venv/docs .venv/dev: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv, which takes some minutes the first time."
	$(BIN)/python -m pip install --quiet --editable '.[$(notdir $@)]'
	touch $@

# Only uv resolves to the lowest versions. It keeps what is installed, so from the start.
.venv-lowest/dev: pyproject.toml
	rm -rf .venv-lowest
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet uv
	.venv-lowest/bin/uv pip install --quiet --python .venv-lowest/bin/python \
		--resolution lowest-direct --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv .venv-lowest .venv-newest figures site
