# Every target sets up what it needs: a virtual environment in .venv with the package in it.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/runs
INSTALLED := $(VENV)/installed
CODE := cli.py infgen pipeline benchmarks examples docs/hooks tests

.PHONY: demo test test-slow test-slow-sample test-all check format bench notebooks docs clean

demo: $(RUNS)
	$(BIN)/infgen demo

# Tests run in random order; pytest prints the seed, `--randomly-seed=N` repeats it.
test: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 -m "not slow"

# The tests that take more than ten seconds each.
test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 -m slow

# One case each of a tenth of them, drawn by the seed that pytest prints, as CI does.
test-slow-sample: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 -m slow --slow-share 0.1

test-all: test test-slow

check: $(INSTALLED)
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/codespell $(CODE) docs README.md CHANGELOG.md CONTRIBUTING.md stages.yaml
	$(BIN)/mypy
	$(BIN)/mkdocs build --quiet --strict

format: $(INSTALLED)
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

# Those that look at an experiment, or at checkouts, want to be told which; one is a part of another.
OF_A_ROOT := $(addprefix benchmarks/,accelerations.py cells.py contacts.py conflicts.py creeping.py ego_standing.py expected_speeds.py rate_variation.py removals.py score_ratios.py setting_off.py simulated_counts.py traffic_drift.py towns_pictures.py tune_radius.py two_versions.py vehicle_flow.py census_steps.py)

bench: $(INSTALLED)
	for script in $(filter-out $(OF_A_ROOT),$(wildcard benchmarks/*.py)); do \
		$(BIN)/python $$script || exit 1; \
	done

# Runs the notebooks again, and keeps what they show.
notebooks: $(INSTALLED)
	$(BIN)/python tests/examples/run_notebooks.py examples/*.ipynb

# The site of docs/, in site/. Nothing is fetched; a dead link is an error.
docs: $(INSTALLED)
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) site .mypy_cache .ruff_cache .pytest_cache

# What is needed to run it, and on top of that what is needed to work on it.
$(RUNS): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(INSTALLED): $(RUNS)
	$(BIN)/python -m pip install --quiet --editable '.[dev,docs]'
	touch $@
