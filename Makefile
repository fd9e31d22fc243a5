# Two commands are all the set-up there is: `make demo` and `make test`.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
TILE ?= data_samples/tile
OUT ?= demo-out

.PHONY: demo test test-all lint bench sample-tile

demo: .venv/.installed
	$(BIN)/scan2sim run $(TILE) --out $(OUT) --hold-out 8 --set segment.overwrite=true

test: .venv/.installed-dev lint
	$(BIN)/python -m pytest -m "not slow" -n 2 --dist loadfile

test-all: .venv/.installed-dev lint
	$(BIN)/python -m pytest

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/.installed-dev
	$(BIN)/python -m bench.tile

sample-tile: .venv/.installed
	$(BIN)/python -m scan2sim.data_samples.make_tile

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[segmentation]'
	@$(BIN)/python -c "import open3d" || { \
		echo "Open3D can't be loaded: on Debian or Ubuntu, apt-get install $$(tr '\n' ' ' < packages.txt)"; exit 1; }
	touch $@

.venv/.installed-dev: .venv/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@
