# make demo | make test | make lint | make bench | make figures: each sets itself up on a machine with Python 3.11+ only.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test lint bench figures clean

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt "torch" "setuptools"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	touch $(READY)

demo: $(READY)
	$(BIN)/torchmembrane check examples/sensor.toml --out out/demo/sensor.png
	$(BIN)/torchmembrane reconstruct examples/sensor.toml examples/press_on_axis.png examples/two_contacts.png \
		examples/flat_plate.png --out out/demo --figures

test: $(READY) lint
	$(BIN)/python -m pytest --durations=8

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

bench: $(READY)
	$(BIN)/python bench/speed.py --json out/bench/speed.json

figures: $(READY)
	$(BIN)/python docs/figures.py

clean:
	rm -rf $(VENV) out build *.egg-info
