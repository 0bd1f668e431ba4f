# Every target sets up what it needs first; a second run starts in seconds.
BIN := .venv/bin
SOURCES := avp_habitat avp_sb3 avp_nerfstudio examples benchmarks scripts tests
# One process of tests per core; the tests of a file stay together, because they share what they have made.
PARALLEL := --numprocesses auto --dist loadfile

.PHONY: help setup demo test test-all check lint format clean

help:
	@echo "make demo      the whole chain on the built-in room, at most 15 minutes"
	@echo "make test      set-up and the tests"
	@echo "make test-all  the slow tests too"
	@echo "make check     format, lint, types and the tests: what CI runs"
	@echo "make format    rewrite the code in the project's format"
	@echo "make clean     remove the environment (runs/ is kept)"

setup:
	@scripts/setup.sh

demo: setup
	@$(BIN)/python examples/demo.py

test: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL) -m "not slow"

test-all: setup
	$(BIN)/python -m pytest

check: lint test

lint: setup
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/pyright

format: setup
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache .hypothesis
