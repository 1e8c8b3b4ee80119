# Everything runs in .venv, which any target makes when it is missing and renews when pyproject.toml or constraints.txt change.
# There is one environment, with the development tools in it: users of `make run` download some 40 MB more and have one thing less to know.
# MAVProxy comes without what it asks for: its opencv-python breaks opencv-python-headless, and its VTK is large.
# A robot's board does not use this file: `pip install -c constraints.txt .` there installs the agent alone.

PYTHON ?= $(firstword $(foreach p,python3 python3.13 python3.12 python3.11,$(shell $(p) -c 'import sys; print("$(p)" if sys.version_info >= (3, 11) else "")' 2>/dev/null)) python3)
BIN := .venv/bin
INSTALLED := .venv/.installed

# More threads only make these matrices slower, and results must not depend on their number.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export MKL_NUM_THREADS = 1
# Programs and test processes start often: where Python may not keep what it compiled, each start costs up to twice as much.
unexport PYTHONDONTWRITEBYTECODE

# By file, for tests of a file share what is dear to make; in order, for the longest files come first (tests/closed_loop).
BY_FILE := --dist loadfile --no-loadscope-reorder
IN_PARALLEL := -n logical $(BY_FILE)
# Two at a time: what waits for programs and for the clock leaves the processors idle for most of its time, but not for more.
IN_PAIRS := -n 2 $(BY_FILE)

# The page's files with the longest flights begin first: none of them is left alone at the end.
LONG_PAGES := $(addprefix tests/page/test_,flight.py end.py setup.py)

# Folders in which every test flies or starts programs: they are not even collected for `make check`.
NO_UNITS := $(addprefix --ignore=tests/,closed_loop examples faults page)

.DEFAULT_GOAL := help
.PHONY: help page run check test test-units test-real-time test-page test-computing test-slow mutants firmware faults fuzz photoreal soak scenes evidence laws bench lint format docs lock clean

help: ## this list
	@echo "Targets (each sets up .venv by itself):"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "%-14s %s\n", $$1, $$2 }'

run: $(INSTALLED) ## fly the pool experiment in software, all processes for real; says where the report is. ARGS="--lockstep --seed 2"
	$(BIN)/sim-bridge sil pool $(ARGS)

check: $(INSTALLED) ## ruff, mypy, and the unit tests that start no process: less than a minute on two cores
	@$(MAKE) --no-print-directory --keep-going --jobs=2 lint test-units

test-units:
	$(BIN)/python -m pytest $(IN_PARALLEL) $(NO_UNITS) -m "not slow and not real_time and not long"

# What only computes fills the idle time of the tests that wait for programs, at a lower priority, so that it delays none of
# them. The page's tests come after: a browser, a flight and whatever else share two processors badly, and these need both.
test: $(INSTALLED) ## all tests but the slow ones. ARGS="tests/shoal -x"
ifdef ARGS
	$(BIN)/python -m pytest $(ARGS)
else
	@SHOAL_SKIPPED=$$(mktemp -d); export SHOAL_SKIPPED; failed=0; \
	$(MAKE) --no-print-directory --keep-going --jobs=2 test-real-time test-computing || failed=$$?; \
	$(MAKE) --no-print-directory test-page || failed=$$?; \
	$(BIN)/python -m tests.skipped $$SHOAL_SKIPPED; rm -rf $$SHOAL_SKIPPED; exit $$failed
endif

test-real-time: # only files that have the mark: to collect all of them takes ten seconds of each process
	$(BIN)/python -m pytest $(IN_PAIRS) -m "real_time and not slow" \
	    $$(grep -rlw real_time tests --include='test_*.py' | grep -v ^tests/page/ | sort)

test-page:
	$(BIN)/python -m pytest $(IN_PAIRS) -m "real_time and not slow" \
	    $(LONG_PAGES) $(filter-out $(LONG_PAGES),$(sort $(wildcard tests/page/test_*.py)))

test-computing:
	nice -n 15 $(BIN)/python -m pytest $(IN_PARALLEL) -m "not real_time and not slow" --ignore=tests/page

test-slow: $(INSTALLED) ## the long checks: fault campaigns, deep fuzzing, people who interrupt one another
	$(BIN)/python -m pytest -m slow --timeout=1800 $(ARGS)

faults: $(INSTALLED) ## break everything in docs/evidence/faults.md, many times, and measure (hours). ARGS="--row agent-killed --times 5"
	$(BIN)/python -m tests.faults $(ARGS)

fuzz: $(INSTALLED) ## a million payloads for every decoder, fewer for every step. ARGS="--target mavlink --runs 10000"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[fuzz]' || echo "atheris cannot be installed here: without it, then"
	$(BIN)/python -m tests.faults.fuzz $(ARGS)

photoreal: $(INSTALLED) ## render tests/localizer/photoreal/data again with Mitsuba 3. ARGS="tilt-4 --split tune" or "--missing"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[photoreal]'
	$(BIN)/python -m tests.localizer.photoreal.render $(ARGS)

soak: $(INSTALLED) ## fly for hours while things break, look for what grows. ARGS="--hours 8", "--simulated 10" or "--real-time 4"
	$(BIN)/python -m tests.faults.soak $(ARGS)

mutants: $(INSTALLED) ## change the thruster board's rules, in Python and in C, in every small way, and list what no test notices
	$(BIN)/python -m tests.firmware.mutants
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt mutmut==3.8.1
	$(BIN)/python -m mutmut run --max-children 2
	$(BIN)/python -m mutmut results

firmware: $(INSTALLED) ## the thruster board's firmware (gcc; avr-gcc for the Arduino Mega). ARGS="avr ROBOT=2", "fuzz"
	$(MAKE) -C firmware $(ARGS)

scenes: $(INSTALLED) ## fly every shipped scene whole, with its camera, ten seeds (half an hour); writes docs/evidence/scenes.md. ARGS="open-water --seeds 3"
	$(BIN)/python -m benchmarks.scenes $(or $(ARGS),--write)

evidence: $(INSTALLED) ## measure one benchmark and write its page in docs/evidence (docs/evidence/README.md lists them). ARGS="optimum"
	$(BIN)/python -m benchmarks $(ARGS) --evidence
	$(BIN)/python -m tools.pages

laws: $(INSTALLED) ## fly every control law on the same seeds; writes docs/evidence/laws.md. ARGS="--seeds 1-3"
	$(BIN)/python -m tools.laws $(ARGS)

bench: $(INSTALLED) ## benchmarks, each beside its peers. ARGS="codec --json rows.json"
	$(BIN)/python -m benchmarks $(ARGS)

lint: $(INSTALLED) ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy examples

format: $(INSTALLED) ## let ruff lay out and repair what it can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

page: ## build the pages of operator and camera setup again (needs Node 20 or newer; users have what is built, in static/)
	cd groundstation/web/page && npm ci --silent && npm run --silent build
	cp groundstation/web/page/node_modules/uplot/dist/uPlot.iife.min.js groundstation/report/templates/uplot.min.js
	cp groundstation/web/page/node_modules/uplot/dist/uPlot.min.css groundstation/report/templates/uplot.min.css

docs: $(INSTALLED) ## write the generated pages of docs/ again
	$(BIN)/python -m tools.pages

lock: ## resolve the newest versions pyproject.toml allows into constraints.txt
	rm -rf .venv-lock
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet -e '.[dev]'
	.venv-lock/bin/python -m pip install --quiet --no-deps MAVProxy
	.venv-lock/bin/python -m pip freeze --all --exclude pip --exclude-editable | LC_ALL=C sort -f > constraints.txt
	rm -rf .venv-lock

clean: ## remove the environments and caches; runs/ stays
	rm -rf .venv .venv-lock .bench-venv .mypy_cache .pytest_cache .ruff_cache .hypothesis build shoal.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	    echo "Python 3.11 or newer is needed; $(PYTHON) is $$($(PYTHON) --version 2>/dev/null || echo missing). Choose one: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@test -x $(BIN)/python || { echo "Making the environment .venv with $$($(PYTHON) --version) ..."; $(PYTHON) -m venv .venv; } || { \
	    rm -rf .venv; echo "$(PYTHON) cannot make environments; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@echo "Installing the pinned packages into .venv (a minute or two the first time) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps MAVProxy
	@$(BIN)/python -m shoal.kernels.build
	@touch $@
