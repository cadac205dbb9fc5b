# `make demo` and `make test` need Python 3.11-3.13, make and git; the rest is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
LOWEST := .venv-lowest
INSTALL := $(BIN)/python tools/install.py
# A worker takes up to 2 GB.
JOBS ?= $(shell n=$$(nproc 2>/dev/null || sysctl -n hw.ncpu 2>/dev/null || echo 2); echo $$((n < 8 ? n : 8)))

.PHONY: help demo docs docs-test test test-slow test-lowest bench lint wheel clean

help:
	@echo "make demo   set up, run a small suite of the shipped model on the shipped maps, write report and playback"
	@echo "make test   set up, run the tests"
	@echo "make test-slow  those that take minutes: whole suites with the shipped model"
	@echo "make test-lowest  the tests with the lowest versions that pyproject.toml allows, set up in $(LOWEST)"
	@echo "make docs   the documentation as a site in build/site; \`make docs-test\` runs all that its pages and the notebooks show"
	@echo "make bench  speed, side by side with peers"
	@echo "make lint   ruff and mypy"
	@echo "make wheel  source archive and wheel with the shipped maps and models, in dist/, checked"

# The stamp depends on what is installed, so a second run installs nothing.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null || { \
	  echo "benchnav: expected Python 3.11, 3.12 or 3.13, got \"$$($(PYTHON) --version 2>&1)\" from $(PYTHON); run make PYTHON=/path/to/python3.12" >&2; exit 2; }
	@echo "benchnav: setting up $(VENV) (one or two minutes and about 7 GB, once)"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) dev
	@touch $(STAMP)

demo: $(STAMP)
	$(BIN)/benchnav-eval run --config demo --out runs/demo --jobs $(JOBS)

# Tests run beside one another, and so do the commands that they start: a thread each. One process more than there are
# processors works while others wait for commands. They plan on many small maps, each of which would be compiled for; what
# is compiled is tried in tests of its own. Commands and workers share bytecode, even where the environment forbids it.
test: $(STAMP)
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 TORCH_COMPILE_DISABLE=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

# A page that is not well-formed, or a link that leads nowhere, fails the build.
docs: $(STAMP)
	$(INSTALL) docs
	$(BIN)/python tools/reference.py commands docs/reference/commands
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

# Every block of every page and every cell of every notebook, on so many maps where these have many.
MAPS ?= 2
docs-test: $(STAMP)
	$(INSTALL) notebook
	BENCHNAV_DOCS_MAPS=$(MAPS) OMP_NUM_THREADS=1 TORCH_COMPILE_DISABLE=1 $(BIN)/python -m pytest -n $(JOBS) -m docs tests/docs

test-slow: $(STAMP)
	$(BIN)/python -m pytest -n $(JOBS) -m slow

# Python 3.11 is the lowest that is allowed, and the lowest versions have no builds for the newest.
test-lowest:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || { \
	  echo "benchnav: expected Python 3.11, got \"$$($(PYTHON) --version 2>&1)\" from $(PYTHON); run make test-lowest PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "benchnav: setting up $(LOWEST) (one or two minutes and about 7 GB)"
	$(PYTHON) -m venv --clear $(LOWEST)
	$(PYTHON) tools/lowest.py > $(LOWEST)/constraints.txt
	$(LOWEST)/bin/python tools/install.py --constraint $(LOWEST)/constraints.txt dask,geo,test
	$(LOWEST)/bin/python -m pytest -n $(JOBS) --dist loadfile

bench: $(STAMP)
	$(BIN)/python -m benchmarks.datasets
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.engine bench.json
	$(BIN)/python -m benchmarks.parts
	$(BIN)/python -m benchmarks.knowledge
	$(BIN)/python -m benchmarks.physics

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tests.prose

# The wheel is built from the source archive. What *.egg-info lists of an earlier build would go into the archive.
wheel: $(STAMP)
	$(INSTALL) release
	rm -rf dist *.egg-info
	$(BIN)/python -m build --no-isolation
	$(BIN)/python -m twine check --strict dist/*
	@ls -lh dist

clean:
	rm -rf $(VENV) $(LOWEST) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
