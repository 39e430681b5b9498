# make demo   build the virtual environment, run the thesis comparison, say where the report is
# make test   lint, types and tests
# make quick  the tests that take less than ten seconds each
# make system the Debian packages that the video tests need (as root); without them those tests are skipped
# make bench  the speed and memory table (docs/benchmarks.md)

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO := pd_joint_p2.5 pd_joint_p1.25 pd_joint_p2.5_physical pd_joint_p1.25_next_sync ct_joint_T1.5 ct7_joint pd7_one_gain

.PHONY: demo test quick check system bench clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@

demo: $(VENV)/installed
	$(BIN)/lwa4d-sim run $(DEMO) -o runs

check: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: check
	$(BIN)/pytest -n auto

quick: $(VENV)/installed
	$(BIN)/pytest -n auto -m "not slow"

system:
	apt-get install --yes --quiet libegl1 libosmesa6

bench: $(VENV)/installed
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) runs build dist
