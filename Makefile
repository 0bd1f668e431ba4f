# Every target sets up what it needs first; a second run starts in seconds.
BIN := .venv/bin
SOURCES := avp_habitat avp_sb3 avp_nerfstudio avp_experiment examples benchmarks scripts tests
# One process of tests per core; the tests of a file stay together, because they share what they have made.
PARALLEL := --numprocesses auto --dist loadfile

.PHONY: help setup demo test test-all check lint format docs clean

help:
	@echo "make demo      the whole chain on the built-in room, at most 15 minutes"
	@echo "make test      set-up and the tests"
	@echo "make test-all  the slow tests too"
	@echo "make check     format, lint, types and the tests: what CI runs"
	@echo "make format    rewrite the code in the project's format"
	@echo "make docs      the documentation as pages, in site/"
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

# The variable silences one notice, which is no warning of the build: fixes for Material for MkDocs end on 5 May 2027, and
# Zensical, which reads the same mkdocs.yml, follows it.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open site/index.html, or with a search box: $(BIN)/mkdocs serve"

clean:
	rm -rf .venv build site *.egg-info .pytest_cache .ruff_cache .hypothesis
