# make demo | make test | make lint (style, types, layers) | make bench | make figures: each sets itself up on a machine with Python 3.11+ only.
# make test-all: every test, those that `make test` leaves out for their length as well; weekly and before a release.
# make coverage: the tests of make test, and which share of the package's lines they run; in out/coverage.json by file.
# make soak SOAK=HOURS PRESSES=10000 KILLS=10: damaged files for so many hours, jobs killed, random sensors pressed; all hours long.
# make fuzz FUZZ=HOURS SEED=N: damaged files of every kind, models and bags as well, for so many hours.
# make test-lowest: the quick start with the lowest versions that pyproject.toml allows, in .venv-lowest.
# make test-lerobot: the plugin for LeRobot against LeRobot 0.6 in .venv-lerobot; needs Python 3.12 and 6 GB.
# make test-ros: the node of ROS 2 under rclpy of PyPI in .venv-ros; needs Python 3.11, on Linux.
# make test-dist: sdists and wheels of the three packages in out/dist, used from empty environments; of what is committed.
# make docs: the site in out/site, links checked.
# make measure PARTS="frame training" INDEPENDENT=FOLDER RECORDINGS=FOLDER: measures what the documents quote and writes their tables; without PARTS
#   what has changed since it was measured, hours in all. make measured says what was measured when, and what is old.
# make web | make test-web: the page in the browser; they need Node.js 20+ with npm too, and get the rest themselves.
# make test-cpp | make test-arm: the C++ example (needs cmake); the edge package on an emulated aarch64. On Debian.
PYTHON ?= python3
SOAK ?= 1
FUZZ ?= 1
PRESSES ?= 10000
KILLS ?= 10
SEED ?= $(shell date +%s)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SOURCES := $(shell find torchmembrane -name "*.py")
LOWEST := .venv-lowest
LEROBOT := .venv-lerobot
PLUGIN := integrations/lerobot_camera_torchmembrane
ROS := .venv-ros
PYTHON311 ?= $(shell for each in python3.11 ~/.pyenv/versions/3.11*/bin/python3.11; do \
	$$each -c '' 2> /dev/null && echo $$each && break; done)
PYTHON312 ?= $(shell for each in python3.12 ~/.pyenv/versions/3.12*/bin/python3.12; do \
	$$each -c '' 2> /dev/null && echo $$each && break; done)

WEB := export/web
CPP := out/cpp
PAGE := $(WEB)/dist/index.html
PACKAGES := $(WEB)/node_modules/.package-lock.json
SENSOR := examples/sensor.toml examples/rest_grid.npz examples/dots.csv examples/rest.png
# Compiled modules are kept whatever the environment says: some hundred tests start a Python of their own.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder \
	--durations=8
IMAGES := examples/two_contacts.png examples/press_on_axis.png examples/flat_plate.png

.PHONY: demo test test-all coverage checked test-lowest test-lerobot test-ros test-dist lint style types layers bench measure measured fuzz soak figures docs web test-web test-cpp test-arm clean

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

test: $(READY) checked
	$(PYTEST)

test-all: $(READY) checked
	@echo 'Every test: those of make test, and those marked full (pytest -m full --collect-only -q lists them).'
	$(PYTEST) -m ""

coverage: $(VENV)/.coverage
	mkdir -p out && COVERAGE_FILE=out/.coverage $(PYTEST) --cov=torchmembrane --cov-report=term:skip-covered --cov-report=json:out/coverage.json

$(VENV)/.coverage: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt pytest-cov
	touch $@

checked: $(READY)
	export OMP_NUM_THREADS=1; $(BIN)/python tests/compile.py float32 & single=$$!; \
		$(BIN)/python tests/compile.py float64 & double=$$!; \
		$(MAKE) --no-print-directory lint; found=$$?; wait $$single && wait $$double && exit $$found

test-lowest: $(LOWEST)/.ready
	$(LOWEST)/bin/python tests/lowest.py

$(LOWEST)/.ready: pyproject.toml constraints-lowest.txt
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet --constraint constraints-lowest.txt --editable .
	touch $@

test-lerobot: $(LEROBOT)/.ready
	HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(LEROBOT)/bin/python -m pytest --override-ini addopts= $(PLUGIN)/tests --durations=5

$(LEROBOT)/.ready: pyproject.toml $(PLUGIN)/pyproject.toml
	@test -n "$(PYTHON312)" || { echo "LeRobot 0.6 needs Python 3.12: make test-lerobot PYTHON312=/path/to/python3.12"; exit 1; }
	$(PYTHON312) -m venv --clear $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet "lerobot[core-scripts]==0.6.1" pytest --editable ".[rerun]" --editable $(PLUGIN)
	touch $@

test-ros: $(ROS)/.ready
	OMP_NUM_THREADS=1 $(ROS)/bin/python -m pytest --override-ini addopts= ros/torchmembrane_ros/test --durations=5

$(ROS)/.ready: pyproject.toml constraints.txt
	@test -n "$(PYTHON311)" || { echo "rclpy of PyPI needs Python 3.11: make test-ros PYTHON311=/path/to/python3.11"; exit 1; }
	$(PYTHON311) -m venv --clear $(ROS)
	$(ROS)/bin/python -m pip install --quiet --constraint constraints.txt "torch" "setuptools"
	$(ROS)/bin/python -m pip install --quiet ros-rclpy ros-rmw-fastrtps-cpp ros-sensor-msgs ros-geometry-msgs ros-std-srvs ros-diagnostic-msgs
	$(ROS)/bin/python -m pip install --quiet --constraint constraints.txt pytest --editable ".[ros]"
	touch $@

test-dist: out/web/model.onnx $(VENV)/.dist
	$(BIN)/python tests/dist.py out/dist out/web/model.onnx

$(VENV)/.dist: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt build
	touch $@

lint: style types layers

style: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

layers: $(READY)
	$(BIN)/lint-imports

bench: $(READY)
	$(BIN)/python -m bench.speed.speed --json out/bench/speed.json

measure: $(READY)
	$(BIN)/python -m bench.measure.measure $(PARTS) $(if $(INDEPENDENT),--independent $(INDEPENDENT)) $(if $(RECORDINGS),--recordings $(RECORDINGS))

measured: $(READY)
	$(BIN)/python -m bench.measure.measure --list

fuzz: $(READY)
	PYTHONPATH=export $(BIN)/python -m bench.robustness.fuzz --hours $(FUZZ) --seed $(SEED) --json out/bench/fuzz.json

soak: $(READY)
	$(MAKE) fuzz FUZZ=$(SOAK) SEED=$(SEED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[ray]"
	for way in --format=npz --format=parquet --engine=ray; do $(BIN)/python -m bench.robustness.crash_recovery --kills $(KILLS) $$way || exit 1; done
	$(BIN)/python -m bench.data.random_sensors out/bench/random --sensors $$(( ($(PRESSES) + 3) / 4 )) --presses 4
	$(BIN)/python -m bench.accuracy.range out/bench/random --json out/bench/range.json

figures: $(READY)
	$(BIN)/python docs/figures.py

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

$(VENV)/.docs: $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $(VENV)/.docs

web: $(PAGE)

test-web: $(PAGE) out/web/tracking.onnx
	PYTHONPATH=export $(BIN)/python $(WEB)/test/reference.py out/web/sensor.toml out/web/model.onnx $(IMAGES) \
		--tracking out/web/tracking.onnx --out out/web/test
	CHROMIUM=$$($(WEB)/chromium.sh) && export CHROMIUM && \
		PYTHON=$(BIN)/python REFERENCE=out/web/test TRACKING=out/web/tracking.onnx node --test --test-reporter=spec $(WEB)/test/page.test.js

test-cpp: $(CPP)/frame out/web/model.onnx
	$(BIN)/python export/cpp/test.py $(CPP)/frame out/web/model.onnx $(IMAGES)

$(CPP)/frame: export/cpp/main.cpp export/cpp/CMakeLists.txt | $(CPP)/debian/usr/include/onnxruntime $(CPP)/lib
	cmake -S export/cpp -B $(CPP) -DONNXRUNTIME_LIBRARY=$(CURDIR)/$(CPP)/lib/libonnxruntime.so \
		-DONNXRUNTIME_INCLUDE=$(CURDIR)/$(CPP)/debian/usr/include/onnxruntime
	cmake --build $(CPP)

$(CPP)/debian/usr/include/onnxruntime:
	export/debian.sh $(CPP)/debian $$(dpkg --print-architecture) -n libonnxruntime-dev

$(CPP)/lib: | $(READY)
	mkdir -p $@
	for name in libonnxruntime.so libonnxruntime.so.1; do \
		ln -sf $(CURDIR)/$(VENV)/lib/python3*/site-packages/onnxruntime/capi/libonnxruntime.so.* $@/$$name; done

test-arm: out/web/model.onnx
	$(BIN)/python export/arm/test.py out/arm out/web/model.onnx $(IMAGES)

$(PAGE): out/web/model.onnx $(IMAGES) $(PACKAGES) $(WEB)/build.js $(wildcard $(WEB)/src/*)
	node $(WEB)/build.js out/web/model.onnx $(IMAGES)

out/web/model.onnx: out/web/sensor.toml $(SOURCES)
	$(BIN)/torchmembrane export $< --out $@ --force

out/web/tracking.onnx: out/web/sensor.toml $(SOURCES)
	$(BIN)/torchmembrane export $< --tracking --out $@ --force

out/web/sensor.toml: $(SENSOR) | $(READY)
	mkdir -p out/web
	cp $(SENSOR) out/web
	awk '{ print } /^\[membrane\]/ { print "grid = [17, 17]" }' examples/sensor.toml > $@

$(PACKAGES): $(WEB)/package.json $(WEB)/package-lock.json
	@node -e 'process.exit(+(parseInt(process.versions.node) < 20))' && npm --version > /dev/null || \
		{ echo "Node.js 20 or newer with npm is needed: https://nodejs.org"; exit 1; }
	cd $(WEB) && npm ci

clean:
	rm -rf $(VENV) $(LOWEST) $(LEROBOT) $(ROS) out build *.egg-info $(WEB)/dist $(WEB)/node_modules
