# Two commands are all the set-up there is: `make demo` and `make test`.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
NO_PYTHON = There is no Python here. Install 3.11, 3.12 or 3.13, or say where it is: make PYTHON=/path/to/python3.11
BIN := .venv/bin
# more options for `make test`, e.g. PYTEST="-k texture"
PYTEST ?=
TILE ?= data_samples/tile
OUT ?= demo-out

.PHONY: demo test test-all lint bench gate sample-tile

demo: .venv/.installed
	$(BIN)/scan2sim run $(TILE) --out $(OUT) --hold-out 8 --set segment.overwrite=true

# in their order: else the longest files, which hold few tests, come last
test: .venv/.installed-dev .venv-ros
	$(BIN)/python -m pytest -m "not slow" -n 2 --dist loadfile --no-loadscope-reorder $(PYTEST)

test-all: .venv/.installed-dev .venv-ros
	$(BIN)/python -m pytest

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/.installed-dev
	$(BIN)/python -m bench.tile

# exports through those who use them: GATE="--worlds demo" for the committed tile alone
gate: .venv/.installed-dev
	$(BIN)/python -m bench.gate $(GATE)

sample-tile: .venv/.installed
	$(BIN)/python -m scan2sim.data_samples.make_tile

# both install what the system lacks, where they may: see deploy/install.py
.venv/.installed: pyproject.toml constraints.txt
	@$(or $(PYTHON),$(error $(NO_PYTHON))) deploy/install.py
	@touch $@

# rclpy, in an environment of its own; tests that want it are skipped where there are no wheels for this Python
.venv-ros: tests/services/ros-requirements.txt
	@$(PYTHON) -m venv $@ && $@/bin/python -m pip install --quiet --disable-pip-version-check -r $< \
	  || echo "No rclpy for this Python: tests between it and cyclonedds are skipped."
	@touch $@

.venv/.installed-dev: .venv/.installed
	@$(or $(PYTHON),$(error $(NO_PYTHON))) deploy/install.py dev
	@touch $@
