# make demo   build the virtual environment, run the thesis comparison, say where the report is
# make test   lint, types and tests
# make quick  the tests that take less than ten seconds each
# make system the Debian packages that some tests need (as root): OpenGL, tshark, QEMU; without them those are skipped
# make bench  the speed and memory table (docs/benchmarks.md)

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO := pd_joint_p2.5 pd_joint_p1.25 pd_joint_p2.5_physical pd_joint_p1.25_next_sync ct_joint_T1.5 ct7_joint pd7_one_gain \
	canopen_pd_joint_p1.25

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
	DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet --no-install-recommends \
		libegl1 libosmesa6 tshark qemu-system-x86 cpio busybox-static kmod iproute2 can-utils

bench: $(VENV)/installed
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) runs build dist
