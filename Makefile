# `make demo` and `make test` set up everything that they need.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
NO_PYTHON = No Python found. Install 3.11, 3.12 or 3.13, or give its path: make PYTHON=/path/to/python3.11
BIN := .venv/bin
# additional pytest options for `make test`, for example PYTEST="-k texture"
PYTEST ?=
TILE ?= data_samples/tile
OUT ?= demo-out

.PHONY: demo test test-all lint docs bench gate sample-tile

# the sample's points have their true classes, which are ignored to show the network's
demo: .venv/.installed
	$(BIN)/scan2sim run $(TILE) --out $(OUT) --hold-out 8 --set segment.overwrite=true --set splats.when=auto

# in parallel, then those in real time one at a time, then those that failed once more
test: .venv/.installed-dev .venv-ros .venv-triton tests/fakes/gazebo/build/.built
	$(BIN)/python -m tests.suite $(PYTEST)

test-all: .venv/.installed-dev .venv-ros .venv-triton
	$(BIN)/python -m pytest

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2

# builds the documentation into site/; broken links are errors
docs: .venv/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

bench: .venv/.installed-dev
	$(BIN)/python -m bench.tile

# acceptance gate: runs exports in the programs that use them; GATE="--worlds demo" for the demo tile only
gate: .venv/.installed-dev
	$(BIN)/python -m bench.gate $(GATE)

sample-tile: .venv/.installed
	$(BIN)/python -m scan2sim.data_samples.make_tile

# both targets install missing system packages if permitted, see deploy/install.py
.venv/.installed: pyproject.toml constraints.txt
	@$(or $(PYTHON),$(error $(NO_PYTHON))) deploy/install.py
	@touch $@

# rclpy in a separate environment; its tests are skipped if there are no wheels for this Python
.venv-ros: tests/services/ros-requirements.txt
	@$(PYTHON) -m venv $@ && $@/bin/python -m pip install --quiet --disable-pip-version-check -r $< \
	  || echo "No rclpy for this Python: tests between it and cyclonedds are skipped."
	@touch $@

# Triton's client in a separate environment: it needs older versions of protobuf and others
.venv-triton: tests/services/toolboxes/triton-requirements.txt
	@$(PYTHON) -m venv $@ && $@/bin/python -m pip install --quiet --disable-pip-version-check -r $< \
	  || echo "Triton's client can't be installed here: tests with it are skipped."
	@touch $@

# programs that check worlds with Gazebo's own libraries; their tests are skipped if these aren't installed
tests/fakes/gazebo/build/.built: $(wildcard tests/fakes/gazebo/*.cpp tests/fakes/gazebo/*.hpp) tests/fakes/gazebo/CMakeLists.txt
	@mkdir -p $(@D)
	@cmake -S tests/fakes/gazebo -B $(@D) -DCMAKE_BUILD_TYPE=Release >/dev/null 2>&1 && cmake --build $(@D) >/dev/null \
	  || echo "Gazebo's libraries aren't installed: tests with them are skipped."
	@touch $@

.venv/.installed-dev: .venv/.installed
	@$(or $(PYTHON),$(error $(NO_PYTHON))) deploy/install.py dev
	@touch $@
