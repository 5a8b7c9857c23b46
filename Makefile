# Two commands for a fresh checkout: `make demo` and `make test`. They need python3 (3.10 or newer, with venv) and a
# package index; PYTHON=... picks another interpreter.
PYTHON ?= python3
JOBS ?= 2
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
# Each pytest takes all cores. What takes one runs beside others of its kind: ALONGSIDE=1 is for `make test` itself. With one
# process for each, the tests are imported once, and no two compile the same kernel.
ifndef ALONGSIDE
.NOTPARALLEL:
endif
WORKERS = $(if $(ALONGSIDE),0,$(JOBS))
# Without .pyc files, each of the tests' processes would compile what it imports.
unexport PYTHONDONTWRITEBYTECODE
.DEFAULT_GOAL := help

BIN := .venv/bin
TEST := .venv-test/bin
MINIMAL := .venv-minimal/bin
LOWEST := .venv-lowest/bin
NEWEST := .venv-newest/bin
ALONE := .venv-extra/bin

# Of make fuzz: time for all kinds together, the kinds (all), the seed (the time; it is printed). Of make soak: scans.
SECONDS = 300
KINDS ?=
SEED ?=
SCANS ?= 20000
# Of make test-extra.
EXTRA ?= ros

.PHONY: help demo test check test-full test-kernels test-interpreted test-bounds test-wheel test-minimal test-lowest test-ahead test-newest test-extra test-arm docs fuzz search soak release sbom clean

help:
	@echo "make demo          perceive the bundled scene: a table, and a picture in demo/"
	@echo "make test          all of these: check, test-interpreted, test-full, test-minimal, test-wheel, docs"
	@echo "make check         ruff, mypy"
	@echo "make test-full     pytest with every extra"
	@echo "make test-kernels  the kernels' tests again: interpreted (test-interpreted), and with array bounds checked (test-bounds)"
	@echo "make test-wheel    build the wheel, run the demo from it outside the checkout"
	@echo "make test-minimal  pytest with nothing but the runtime: no torch, no onnx, no matplotlib"
	@echo "make test-lowest   pytest with the lowest versions that pyproject.toml allows"
	@echo "make test-ahead    a wheel with compiled kernels, without numba; needs a C compiler"
	@echo "make test-newest  kernels and their cache with the newest numba and numpy, above the bound in pyproject.toml"
	@echo "make test-extra    pytest with EXTRA=ros alone, or another extra"
	@echo "make test-arm      edgeperc on aarch64 under qemu, compared with x86; skipped without qemu"
	@echo "make docs          build the documentation into docs/_build/html; warnings are errors"
	@echo "make fuzz          hostile scans, captures, models, boxes, commands, images; SECONDS=300 SEED=7 KINDS='scans models'"
	@echo "make search        the property tests with a thousand other examples each"
	@echo "make soak          whether memory grows over SCANS=20000 scans with stream, tracker and pictures"
	@echo "make release       the packages, their SBOM and SHA256SUMS in dist/; make sbom does the same"
	@echo "make clean         remove the environments and whatever else is made here"

demo: .venv/installed
	$(BIN)/edgeperc demo --out demo

# One environment is installed beside the other, and what takes longest comes first, so that no core waits at the end.
test:
	$(MAKE) --no-print-directory --jobs $(JOBS) ALONGSIDE=1 test-minimal test-interpreted check test-wheel docs
	$(MAKE) --no-print-directory test-full

check: .venv-test/installed
	$(TEST)/ruff check .
	$(TEST)/ruff format --check .
	$(TEST)/mypy

# A process more than cores works where another waits for its child or for time to pass: 94 in place of 89 % of the cores' time.
test-full: .venv-test/installed
	$(TEST)/pytest -n $$(($(JOBS) + 1)) --dist worksteal

# Interpreted, a kernel answers as it does compiled, and Python raises an IndexError outside of an array, as bounds checks do:
# of ten loops made one too long, each fails the same tests either way. So `make test` runs them interpreted alone.
# To import the other tests took 11 s.
test-kernels: .venv-test/installed
	$(MAKE) --no-print-directory --jobs $(JOBS) ALONGSIDE=1 test-interpreted test-bounds

test-interpreted test-bounds: KERNEL = -q -m kernel $$(grep --recursive --files-with-matches --include='test_*.py' -E 'twins|mark\.kernel' tests)
test-interpreted: .venv-test/installed
	NUMBA_DISABLE_JIT=1 $(TEST)/pytest --every-kernel $(KERNEL)

test-bounds: .venv-test/installed
	NUMBA_BOUNDSCHECK=1 NUMBA_OPT=0 NUMBA_CACHE_DIR=$(CURDIR)/.venv-test/bounds-checked $(TEST)/pytest $(KERNEL)

docs: .venv-test/installed
	$(TEST)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

test-wheel: .venv-test/installed
	PYTHON=$(TEST)/python tests/wheel_demo.sh

# Packages with a module that loads an extra (tests/test_layering.py holds the others to loading none), and the whole: all other
# tests would run the same code again, and so would those of ALIKE, whose modules load none, and of the worker processes here.
test-minimal: WHOLE = live public_api silence zoo
test-minimal: LOADING = bench cli datasets readers ros2 sinks system view
test-minimal: ALIKE = cli/test_cli_info cli/test_programs readers/test_alternation readers/test_identify
test-minimal: ALIKE += readers/test_livox_packets readers/test_mems_packets readers/test_mirror_packets readers/test_pcap
test-minimal: ALIKE += readers/test_ports readers/test_spinning_packets readers/test_origin readers/test_times
test-minimal: ALIKE += readers/test_files readers/test_packets datasets/test_trees
test-minimal: ALIKE += sinks/test_run_file system/test_atomic system/test_clock
test-minimal: ALIKE += system/test_compilation system/test_fields system/test_interpreter system/test_kernel_cache
test-minimal: ALIKE += system/test_kernels system/test_lanes system/test_machine system/test_pool
test-minimal: .venv-minimal/installed
	$(MINIMAL)/python -c "import importlib.util as u; assert not any(map(u.find_spec, ['torch', 'onnx', 'matplotlib']))"
	$(MINIMAL)/pytest -q -n $(WORKERS) --dist worksteal -m 'not kernel and not compiled' $(WHOLE:%=tests/test_%.py) $(LOADING:%=tests/%) \
		$(ALIKE:%=--ignore tests/%.py) --deselect tests/system/test_ray_cluster.py::test_workers_give_the_same

# An old matplotlib uses what newer packages below it deprecate.
test-lowest: .venv-lowest/installed
	$(LOWEST)/pytest -W ignore::DeprecationWarning -n $(JOBS) --dist worksteal

# A wheel with compiled kernels, in an environment without numba; and the tests of the kernels and of perceivers with them.
test-ahead: .venv-test/installed
	$(TEST)/python .ci/kernels
	PYTHON=$(TEST)/python KERNELS=ahead tests/wheel_demo.sh
	EDGEPERC_KERNELS=ahead $(TEST)/pytest -q -n $(JOBS) --dist worksteal -m kernel
	EDGEPERC_KERNELS=ahead $(TEST)/pytest -q -n $(JOBS) --dist worksteal tests/test_perceiver.py tests/tracking tests/road

# Green with a new numba: raise the bound.
test-newest: pyproject.toml
	$(call environment,.venv-newest)
	.ci/install .venv-newest --editable '.[cpu]' filelock hypothesis pytest pytest-xdist
	$(NEWEST)/pip install --quiet --upgrade numba numpy
	$(NEWEST)/pytest -n $(JOBS) --dist worksteal -m kernel
	$(NEWEST)/pytest -n $(JOBS) --dist worksteal tests/system/test_kernel_cache.py tests/test_warm_up.py

test-extra: pyproject.toml
	$(call environment,.venv-extra)
	.ci/install .venv-extra --editable '.[$(EXTRA)]' filelock hypothesis pytest pytest-xdist
	$(ALONE)/pip check
	$(ALONE)/python tests/smoke.py $(EXTRA)

test-arm: .venv-test/installed
	$(TEST)/python -m tests.arm

fuzz: .venv-test/installed
	$(TEST)/python -m tests.fuzz $(KINDS) --jobs $(JOBS) --seconds $(SECONDS) $(if $(SEED),--seed $(SEED))

search: .venv-test/installed
	$(TEST)/pytest -q -m hypothesis --hypothesis-profile search -n $(JOBS) --dist worksteal

soak: .venv-test/installed
	$(TEST)/edgeperc-bench soak --application --scans $(SCANS)

release sbom:
	PYTHON=$(PYTHON) bash .ci/release

# The stamp inside each environment is as new as what it was installed from, so a second `make` installs nothing.
.venv/installed: pyproject.toml
	$(call environment,.venv)
	.ci/install .venv --editable '.[cpu,view]'
	@touch $@

.venv-test/installed: pyproject.toml constraints.txt
	$(call environment,.venv-test)
	.ci/install .venv-test --constraint constraints.txt --editable '.[cpu,openvino,view,io,ouster,peers,database,argoverse,ray,slam,tensorboard,docs,test]'
	@touch $@

.venv-minimal/installed: pyproject.toml constraints.txt
	$(call environment,.venv-minimal)
	.ci/install .venv-minimal --constraint constraints.txt --editable '.[cpu]' filelock hypothesis pytest pytest-xdist shapely
	@touch $@

# uv finds the lowest versions; pip finds the highest alone.
.venv-lowest/installed: pyproject.toml
	$(call environment,.venv-lowest)
	$(LOWEST)/pip install --quiet uv
	$(LOWEST)/uv pip compile --quiet --resolution lowest-direct --only-binary :all: --python $(LOWEST)/python \
		--extra cpu --extra view --extra camera --extra io --extra progress --extra bench --extra completion \
		--output-file .venv-lowest/requirements.txt pyproject.toml >/dev/null
	$(LOWEST)/pip install --quiet --only-binary :all: --requirement .venv-lowest/requirements.txt \
		filelock hypothesis pytest pytest-xdist 'shapely>=2'
	$(LOWEST)/pip install --quiet --no-deps --editable .
	$(LOWEST)/pip check
	@touch $@

define environment
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and \
		f"edgeperc needs Python 3.10 or newer and $(PYTHON) is {sys.version.split()[0]}. Run: make PYTHON=python3.12 $(MAKECMDGOALS)")'
	rm -rf $(1)
	$(PYTHON) -m venv $(1)
endef

clean:
	rm -rf edgeperc/system/compiled .venv .venv-test .venv-minimal .venv-lowest .venv-newest .venv-extra build dist demo docs/_build docs/reference/generated *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find bench edgeperc export models tests -name __pycache__ -type d -exec rm -rf {} +
