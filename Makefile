# One command for people and for CI. `make` alone lists the targets.
#
# PIP_ARGS goes to every `pip install`: it chooses the source of wheels. Without an NVIDIA GPU, name the place of
# PyTorch's CPU build, to avoid 2 GB of CUDA libraries. PyTorch's page "Start locally" shows the ADDRESS, at the end of
# its command for Linux, Pip, CPU:
#     make demo PIP_ARGS="--extra-index-url ADDRESS"

PYTHON ?= python3
PIP_ARGS ?=
PYTEST_ARGS ?=
DEMO_ARGS ?=
BENCH_OUT ?= runs/bench

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-done
SOURCES := deal_hw calib drivers policies
SAFETY_FILES := deal_hw/control/safety/*.py,deal_hw/control/process/supervisor.py,deal_hw/control/process/watchdog.py,deal_hw/control/process/claim.py,deal_hw/control/process/run_end.py,deal_hw/signals.py
SAFETY_COVERAGE := --rcfile=/dev/null --data-file=build/safety.coverage

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow test-peers dds-peer avr-tools arm-tools firmware firmware-arm check dist docs coverage-safety mutation bench typing format clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-15s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## make .venv with everything (other targets do this when needed)

# torch is installed first and alone: its builds (CPU, CUDA) differ by gigabytes, so a wrong index shows at once. The
# stamp is touched last, so that the next call continues an interrupted set-up.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "make setup needs Python 3.11 or newer (3.10: base and sim only, by pip); name one: make setup PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
	  || { echo "this Python cannot make a venv; on Debian: apt-get install -y python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(PIP_ARGS) --constraint constraints.txt torch
	$(BIN)/python -m pip install $(PIP_ARGS) --constraint constraints.txt --editable '.[all,dev,docs]'
	@touch $@

demo: $(STAMP) ## the whole loop on an emulated cart-pole
	$(BIN)/deal-hw demo $(DEMO_ARGS)

# Tests that need a DDS peer or a chip's tools are skipped without them, and say what to install. One thread of
# OpenMP a process: with more, the workers' threads wait for each other on two cores. Three workers: the one with the
# tests in real time (tests/conftest.py) mostly waits, and the two that compute give way to it. Bytecode is written even
# where the environment forbids it: else each worker compiles all tests, and each of some hundred processes the package.
PYTEST := env -u PYTHONDONTWRITEBYTECODE OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3
test: $(STAMP) test-peers ## all tests that need no robot, but the slow ones
	$(PYTEST) -m 'not slow' $(PYTEST_ARGS)

test-slow: $(STAMP) test-peers ## the other tests: long searches and calibrations, the fault rows of the Go2, and fault tables
	$(PYTEST) -m slow $(PYTEST_ARGS)

test-peers:
	@tools/build_dds_peer.sh || true
	@tools/build_fastdds_peer.sh || true
	@tools/install_avr_tools.sh || true
	@tools/install_arm_tools.sh || true

dds-peer: ## build the test peers on Cyclone DDS 0.10.2 and Fast DDS 2.9, with what they need
	@tools/build_dds_peer.sh
	@tools/build_fastdds_peer.sh

avr-tools: ## install gcc-avr and simavr
	@tools/install_avr_tools.sh

arm-tools: ## install gcc-arm-none-eabi and qemu-system-arm (60 MB to fetch, 490 MB on the disk)
	@tools/install_arm_tools.sh

# The file and not the module: the package around it needs numpy, and a board needs no environment of 3 GB.
BUILD_FIRMWARE := PYTHONPATH=. $(PYTHON) drivers/cartpole/chips/native.py
firmware: avr-tools ## build/firmware/cartpole.hex for the ATmega328P, and its memory use
	@$(BUILD_FIRMWARE) avr build/firmware

firmware-arm: arm-tools ## cartpole-stm32.bin and pole-encoder-stm32.bin in build/firmware for the STM32F103C8, and their memory use
	@$(BUILD_FIRMWARE) stm32 build/firmware

check: $(STAMP) typing coverage-safety docs ## format, lint, types, declared imports, layers, safety coverage, docs, distributions
	$(BIN)/ruff format --check --output-format concise .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 --no-warn-return-any build/typing/deal_hw
	$(BIN)/deptry $(SOURCES)
	$(BIN)/python -m pytest -q tests/house/test_layers.py
	@$(MAKE) -s dist

dist: $(STAMP) ## build/dist: source distribution, and the wheel built from it; both are checked
	@rm -rf build/dist
	$(BIN)/python -m build --no-isolation --outdir build/dist >build/dist.log 2>&1 || { cat build/dist.log; exit 1; }
	$(BIN)/twine check --strict build/dist/*

# mkdocs needs no network, and the built pages load nothing from other hosts.
docs: $(STAMP) typing ## build the documentation into build/site and check its links
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/python tools/check_site.py build/site

# The repository's coverage settings measure all files; here every line and branch of a few files counts.
coverage-safety: $(STAMP) ## each line and branch of the safety module and of the exit path is tested
	@mkdir -p build
	$(BIN)/coverage run $(SAFETY_COVERAGE) --branch \
	  --include='$(SAFETY_FILES)' \
	  -m pytest -q tests/control/test_control_safety*.py tests/control/test_control_exit*.py
	$(BIN)/coverage report $(SAFETY_COVERAGE) --show-missing --fail-under=100

mutation: $(STAMP) ## change safety module and exit path, place by place; each change must break a test (half an hour)
	$(BIN)/python tools/mutate_safety.py

# One robot and a small budget each: enough to see that a bench works, not to judge a method. The commands of the
# published rows are in docs/measured/README.md. A stopped bench continues.
BENCH := $(BIN)/deal-hw bench
PAPER := --profile ideal --demonstration policy --population 60 --generations 15 --seeds 1010
bench: $(STAMP) ## every bench but the Go2's loop in small (9 minutes); rows and figures in BENCH_OUT
	@mkdir -p $(BENCH_OUT)
	$(BENCH) paper $(PAPER) --methods midpoint,midpoint-linear,deal-paper,deal-paper-fn,deal-paper-pn,easi,bo-critic --range-ratio 10 --out $(BENCH_OUT)/paper.json
	$(BENCH) paper $(PAPER) --methods deal-paper,ekf,ekf-one-pass,least-squares,least-squares-random --range-ratio 5 --out $(BENCH_OUT)/model_based.json
	$(BENCH) fixed-range $(PAPER) --methods midpoint,midpoint-linear,deal-paper,deal,eki,easi,default --out $(BENCH_OUT)/fixed_range.json
	$(BENCH) fixed-range $(PAPER) --task ant,go2,humanoid,allegro --methods midpoint,deal-paper,eki --out $(BENCH_OUT)/tasks.json
	$(BENCH) mismatch --methods midpoint,deal,eki,default --population 60 --generations 15 --seeds 1010 --out $(BENCH_OUT)/mismatch.json
	$(BENCH) verdict --problems pendulum --faults none,friction --seeds 2000 --out $(BENCH_OUT)/verdict.json
	$(BENCH) first-answer --problems double-pendulum --seeds 2000 --out $(BENCH_OUT)/first_answer.json
	$(BENCH) speed --task cartpole --seeds 1010 --out $(BENCH_OUT)/speed.json
	$(BENCH) loop --seeds 0 --profile sensor --out $(BENCH_OUT)/loop.json

format: $(STAMP) ## rewrite the sources in the one format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Type checkers cannot follow package-dir through an editable install, so they read this tree of links.
typing:
	@mkdir -p build/typing/deal_hw
	@find build/typing/deal_hw -xtype l -delete
	@for entry in deal_hw/*; do \
	  case $$entry in */__pycache__) ;; *) ln -sfn ../../../$$entry build/typing/deal_hw/ ;; esac; done
	@for leaf in calib drivers policies; do ln -sfn ../../../$$leaf build/typing/deal_hw/$$leaf; done

clean: ## remove generated files, but not .venv or runs/
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage htmlcov
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -print | xargs rm -rf
