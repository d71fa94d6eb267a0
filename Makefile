# make run: run the simulated hand with its live page.
# make test: run the first test tier on all processors.  make test-extended: run the second tier (tests marked
# `extended`).  make test-all: run both tiers.  ARGS selects tests (ARGS=tests/unit) or adds pytest options (ARGS=-n0
# uses one process). Test files named in ARGS run with their extended tests.
# make lowest: run the tests of servos, settings and messages with the oldest packages that pyproject.toml allows.
# make docs: build the documentation site in build/site.
# make newest: run the numerical tests and a fast subset of the others with the newest Python on this machine and with
# different floating-point arithmetic.
# make release VERSION=1.2.3: set version and changelog, run all checks, build the packages, and print the publishing
# commands.
# Each target installs only its own requirements into .venv. PYTHON=python3.13 selects an interpreter (3.11 or later) with
# a separate environment, for example .venv-3.13.

PYTHON ?= python3
ifeq ($(origin PYTHON),command line)
VENV := .venv-$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
else
VENV := .venv
endif
BIN := $(VENV)/bin
# The option --no-compile keeps pip from compiling all modules, most of which are never imported.
PIP_INSTALL := -m pip --disable-pip-version-check install --no-compile
# `make CONSTRAINTS=` installs the newest dependencies instead of the tested versions.
CONSTRAINTS := --constraint constraints.txt
INSTALL := $(BIN)/python $(PIP_INSTALL) $(CONSTRAINTS)
WORKERS := $(shell expr $$(nproc) + 2) # more workers than processors, because some tests only wait
# Coverage is measured on Python 3.12 and later, where its overhead is small.
COVERAGE = $(shell $(BIN)/python -c "import sys; print('--cov' * (sys.version_info >= (3, 12)))")
PYTEST = $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal
# Compile the kernels for both kinds of tips in advance, so that the test processes do not all compile the same kernels.
COMPILE = $(BIN)/softfinger compile --all && $(BIN)/softfinger compile --all --config solid
LOWEST_PIP := build/lowest/bin/python $(PIP_INSTALL) --quiet
NEWEST_PIP := build/newest/bin/python $(PIP_INSTALL) --quiet $(CONSTRAINTS)
NEWEST := build/newest/bin/python -m tests.harness.arithmetic # different floating-point arithmetic
SERVO_TESTS := tests/process/test_servo_sdk.py tests/unit/test_servo_round_trip.py
LOWEST_TESTS := tests/process/test_servo_checks.py $(addprefix tests/unit/test_,settings.py schema.py)
NEWEST_TESTS := tests/unit/test_stream.py tests/process/test_client.py
# Tests that compare results of BLAS, NumPy loops and compiled kernels. Tests with processes or figures, and most tests
# of the whole hand, are excluded.
NUMERICAL := blur calibrate calibrated_hand calibration hand_estimator error_budget estimator \
	estimator_bad_frames estimator_kernels figure_runs grasp_state hand material measured \
	measurement_faults plant plant_agreement plant_shapes press_fit pressure_grid quadrature \
	sensor_effects simulated_backends solid solid_tip_data table view_pictures
NUMERICAL_TESTS := tests/process/test_replay_recording.py::test_the_golden_recording_gives_the_same_states \
	$(NUMERICAL:%=tests/unit/test_%.py)
TO_RUN := $(VENV)/.ready-run
TO_TEST := $(VENV)/.ready-test
TO_DOCUMENT := $(VENV)/.ready-docs
TO_RELEASE := $(VENV)/.ready-release

# Always write bytecode files, because a test run starts hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: run test test-extended test-all warm docs lowest newest lint format release clean

run: $(TO_RUN)
	@echo "Starting the simulated hand at work; q ends it."
	@$(BIN)/softfinger run --config demo --monitor $(ARGS)

test: $(TO_TEST)
	@$(COMPILE)
	$(PYTEST) $(COVERAGE) $(ARGS)

test-extended: $(TO_TEST)
	@$(COMPILE)
	$(PYTEST) -m extended $(ARGS)

test-all:
	@$(MAKE) test ARGS='-m "extended or not extended" $(ARGS)'

# Compile the bytecode in advance, so that the test processes do not all compile the same modules.
warm: $(TO_TEST)
	-@$(BIN)/python -m pytest --collect-only --quiet >/dev/null

docs: $(TO_DOCUMENT)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "Built build/site/index.html"

lowest:
	$(PYTHON) -m venv build/lowest
	@grep -o '^    "[a-z-]*>=[0-9.]*' pyproject.toml | sed 's/ *"//; s/>=/==/; s/$$/.*/' \
		| sort -u > build/lowest/constraints.txt
	$(LOWEST_PIP) --constraint build/lowest/constraints.txt . pytest pytest-timeout hypothesis
	build/lowest/bin/python -m pytest $(SERVO_TESTS) $(LOWEST_TESTS)
	$(LOWEST_PIP) dynamixel-sdk==3.8.4
	build/lowest/bin/python -m pytest $(SERVO_TESTS)

newest:
	"$$($(PYTHON) -m tests.harness.newest_python)" -m venv --clear build/newest
	$(NEWEST_PIP) --editable '.[plot,record]' scipy pytest pytest-timeout pytest-xdist hypothesis
	@$(NEWEST) softfinger compile --all
	@$(NEWEST) softfinger compile --all --config solid
	$(NEWEST) pytest --numprocesses $$(nproc) --dist worksteal -m 'not extended' \
		$(SERVO_TESTS) $(LOWEST_TESTS) $(NEWEST_TESTS) $(NUMERICAL_TESTS) $(ARGS)

lint: $(TO_TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(TO_TEST)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

release: $(TO_RELEASE)
	@$(BIN)/python .ci/release.py prepare "$(VERSION)"
	@$(MAKE) lint docs test
	@$(BIN)/python .ci/release.py build "$(VERSION)"

$(TO_RUN): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "softfinger needs Python 3.11 or later; say which with PYTHON=…"; exit 1; }
	@echo "Setting up $(VENV) once: numpy, numba and seven small packages, about 100 MB to fetch."
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) --quiet 'pip>=25.1' # the first version that supports dependency groups
	@$(INSTALL) --editable .
	@$(BIN)/softfinger compile --config demo
	@touch $@

$(TO_TEST): $(TO_RUN)
	@echo "Adding what the tests need to $(VENV) once: pyarrow, scipy and others."
	@$(INSTALL) --editable . --group dev
	@$(COMPILE)
	@touch $@

$(TO_DOCUMENT): $(TO_RUN)
	@echo "Adding MkDocs and its theme to $(VENV) once."
	@$(INSTALL) --editable . --group docs
	@touch $@

$(TO_RELEASE): $(TO_TEST) $(TO_DOCUMENT)
	@$(INSTALL) --group release
	@touch $@

clean:
	rm -rf .venv .venv-* build *.egg-info .pytest_cache .mypy_cache .ruff_cache
