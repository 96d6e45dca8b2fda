# Everything that one does with this repository. `make help` lists it; each target installs what it needs.
#
#   PYTHON=python3.12 make test      another interpreter for .venv
#   PSSFLOW_SCENES=DIR make test     third-party scenes for the tests that use them
#
# The extension is built by maturin, into .venv, when a source is newer than the stamp .venv/.built. The Rust tests use
# the same profile and the same features, so that nothing is compiled twice (tests/unit/test_build.py watches that).

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
REPORTS := out/tests
# Files of tests; each is run by a process of its own, see PYTEST.
PARTS := $(sort $(wildcard tests/*/test_*.py))

# rustup's own place, for shells that have not read its profile.
export PATH := $(PATH):$(HOME)/.cargo/bin
export VIRTUAL_ENV := $(abspath $(VENV))
export PIP_DISABLE_PIP_VERSION_CHECK := 1

ifneq ($(wildcard ../shared/scenes/.),)
export PSSFLOW_SCENES ?= $(abspath ../shared/scenes)
endif

SOURCES := $(shell find rust -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock pyproject.toml
EXTENSION := $(wildcard python/pssflow/_core*.so)

# Embree comes from the wheel `embreex` where the system has none; Rust tests are told where that lies.
RUST_TEST = PSSFLOW_EMBREE_DIRS="$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("platlib"))')" \
	cargo test --release --workspace

# Runs the tests, a process for each file, and all files even if one fails. Mitsuba makes thousands of classes anew with
# each change of variant, and Python's garbage collector came upon one that was gone: once after 1,200 tests in one
# process, once after 200. Without the collector scenes of other tests stay alive, and LLVM's kernels call their plugins.
# Status 5 is a file of which all tests are deselected.
define PYTEST
@rm -rf $(REPORTS)/python
@status=0; for part in $(PARTS); do \
	echo "$$part"; \
	$(BIN)/python -m pytest $(1) --junitxml=$(REPORTS)/python/$$(echo $$part | tr / -).xml $$part || \
		{ code=$$?; test $$code = 5 || status=$$code; }; \
done; exit $$status
endef

.PHONY: help
help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | sort | expand -t 12

.PHONY: build
build: $(VENV)/.built ## the extension module, into .venv

.PHONY: demo
demo: build ## scenes/teapot with random and with learned numbers: the thesis' Table 2, EXRs and a picture in out/demo
	$(BIN)/python -m pssflow.study.demo -o out/demo

.PHONY: test
test: build ## the quick tier: Rust, Python, and whether as many tests ran as should
	@mkdir -p $(REPORTS)
	$(RUST_TEST) 2>&1 | tee $(REPORTS)/rust.log
	$(call PYTEST,-m "not long")
	$(BIN)/python tests/check_count.py rust-quick=$(REPORTS)/rust.log python-quick=$(REPORTS)/python

.PHONY: test-long
test-long: build $(VENV)/.browser ## every test, the long ones too
	@mkdir -p $(REPORTS)
	$(RUST_TEST) -- --include-ignored 2>&1 | tee $(REPORTS)/rust.log
	$(call PYTEST)
	$(BIN)/python tests/check_count.py rust-all=$(REPORTS)/rust.log python-all=$(REPORTS)/python

.PHONY: lint
lint: build $(VENV)/.lint ## rustfmt, clippy, ruff, pyright
	cargo fmt --all --check
	cargo clippy --workspace --all-targets -- -D warnings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

.PHONY: bench
bench: build ## what paths, guides and training cost, beside Mitsuba and candle: out/bench.json, 20 minutes
	cargo build --release -p pss-guide --example guide_cost
	$(BIN)/python -m pssflow.study.bench --kernels target/release/examples/guide_cost

.PHONY: study-scaling
study-scaling: build ## time and memory against spp, pixels, k, triangles, emitters, threads: out/study-scaling, 10 minutes
	$(BIN)/python -m pssflow.study.scaling -o out/study-scaling

.PHONY: coverage
coverage: build ## every scene beside Mitsuba, by mean and by speed: docs/coverage.md
	$(BIN)/python -m pssflow.study.coverage

.PHONY: study-guides
study-guides: build ## what each guide gains, costs and comes to at equal time: an hour, out/study-guides; resumes
	$(BIN)/python -m pssflow study guides -o out/study-guides

.PHONY: study-speed-accuracy
study-speed-accuracy: build $(VENV)/.studies ## error against wall time, Mitsuba and others beside the guides: an hour, out/study-speed-accuracy; resumes
	$(BIN)/python -m pssflow study speed-accuracy -o out/study-speed-accuracy

.PHONY: study-thesis
study-thesis: build ## the source thesis' tables and figures beside ours, what it left open: out/study-thesis; resumes
	$(BIN)/python -m pssflow study thesis -o out/study-thesis

.PHONY: study-capacity
study-capacity: build ## error and predicted gain against the size of the model, at equal time: out/study-capacity; resumes
	$(BIN)/python -m pssflow study capacity scenes/door-ajar -o out/study-capacity

# Our own scenes. 8 scenes × 4 methods × 3 seeds × 30 s are 48 minutes, and the references; more methods take longer.
RESULTS_SCENES ?= $(sort $(patsubst %/scene.xml,%,$(wildcard scenes/*/scene.xml)))
RESULTS_GUIDES ?= none,realnvp,table,auto
RESULTS_OPTIONS ?= --times 10,30 --seeds 3

.PHONY: results
results: build $(VENV)/.studies ## docs/results.md and its CSV from a study of our own scenes: an hour, out/results; resumes
	$(BIN)/python -m pssflow study guides $(RESULTS_SCENES) --guides $(RESULTS_GUIDES) $(RESULTS_OPTIONS) -o out/results
	$(BIN)/python -m pssflow study results out/results -o docs/results.md

.PHONY: study-light
study-light: build $(VENV)/.studies ## whole images against Mitsuba's path at the same depth: an hour, out/study-light; resumes
	$(BIN)/python -m pssflow study light -o out/study-light

.PHONY: study-gradients
study-gradients: build ## variance of gradients against uniform numbers at equal time: 20 minutes, out/study-gradients; resumes
	$(BIN)/python -m pssflow study gradients -o out/study-gradients

.PHONY: study-stability
study-stability: build ## planted failures with every guide: what holds, degrades or fails; out/study-stability; resumes
	$(BIN)/python -m pssflow study stability -o out/study-stability

.PHONY: docs
docs: build $(VENV)/.docs ## Rust API into target/doc, Python API into out/docs
	RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps
	$(BIN)/pdoc pssflow -o out/docs

.PHONY: clean
clean: ## what was built, rendered and installed here
	rm -rf target out $(VENV) .pytest_cache .ruff_cache python/pssflow/_core*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# --- stamps ---------------------------------------------------------------------------------------------------------

# The interpreter, system libraries and maturin. What is missing is said before anything is built.
$(VENV)/.ready: .ci/system
	PYTHON="$(PYTHON)" .ci/system
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet 'maturin>=1.9,<2'
	touch $@

# Builds the extension and installs it (editable) with what it needs to run and to be tested.
$(VENV)/.built: $(VENV)/.ready $(SOURCES) $(if $(EXTENSION),,missing-extension)
	$(BIN)/maturin develop --release --extras test
	touch $@

# Chromium, for the test of report.html in a browser, where apt may install it; without it that test is skipped.
$(VENV)/.browser: .ci/system | $(VENV)/.built
	PYTHON="$(PYTHON)" .ci/system browser
	touch $@

.PHONY: missing-extension
missing-extension:

# The extras of the package that is installed by now: pip adds what they ask for and builds nothing.
$(VENV)/.lint $(VENV)/.docs $(VENV)/.studies: $(VENV)/.%: pyproject.toml | $(VENV)/.built
	$(BIN)/python -m pip install --quiet 'pssflow[$*]'
	touch $@
