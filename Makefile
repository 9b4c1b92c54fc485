PYTHON ?= python3
BIN := .venv/bin

.PHONY: paper test test-all benchmarks readme clean

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

# Measures everything anew, one after the other, for README. ARGS=--quick is rough, and quicker.
BENCHMARKS := rigid_body tolerances gradients fields compile chain expm heat batch charts stability
benchmarks: .venv/dev
	@$(BIN)/python benchmarks/results.py
	for name in $(BENCHMARKS); do $(BIN)/python benchmarks/$$name.py $(ARGS) || exit 1; done
	$(MAKE) readme

# README's tables, numbers and pictures, from what has been measured.
readme: .venv/dev
	$(BIN)/python benchmarks/readme.py

.venv/paper .venv/dev: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv, which takes some minutes the first time."
	$(BIN)/python -m pip install --quiet --editable '.[$(notdir $@)]'
	touch $@

clean:
	rm -rf .venv figures
