PYTHON ?= python3
BIN := .venv/bin

.PHONY: paper test test-all coverage defects clean

# Tables and figures of the paper, in figures/.
paper: .venv/paper
	$(BIN)/python -m cfjax paper

# Lint, types, tests.
test: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal

# The slow ones too.
test-all: .venv/dev
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal -m "slow or not slow"

# The tests of `make test`, with lines and branches of cfjax that they do not reach.
coverage: .venv/dev
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal --cov --cov-report=term-missing

# Whether the tests see mistakes, planted one at a time.
defects: .venv/dev
	$(BIN)/python tests/planted_defects.py

.venv/paper .venv/dev: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv, which takes some minutes the first time."
	$(BIN)/python -m pip install --quiet --editable '.[$(notdir $@)]'
	touch $@

clean:
	rm -rf .venv figures
