# The two commands are `make train` and `make test`; both set up what they need, once.
PYTHON ?= python3
VENV ?= .venv
# The versions to install; the newest ones with CONSTRAINTS=/dev/null.
CONSTRAINTS ?= constraints.txt
CONFIG ?= configs/jetbot.yaml
# What `make test-slow` runs: a folder or a file.
TESTS ?= tests
RUN ?= runs/$(notdir $(basename $(CONFIG)))-$(shell date +%Y%m%d-%H%M%S)

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.installed-docs
SB3_STAMP := $(VENV)/.installed-sb3

.PHONY: setup sb3 train test test-gpu test-slow check notebooks format benchmark docs wasm wheel release-check clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "error: jetbot_mjx needs Python 3.11 or later, not %d.%d; say make PYTHON=python3.11" % sys.version_info[:2])'
	$(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV): pip takes a few minutes and prints nothing unless something is wrong"
	$(BIN)/python -m pip install --quiet --constraint $(CONSTRAINTS) --editable '.[dev]'
	@touch $@

# Stable-Baselines3, whose tests are otherwise left out. Not part of `setup`: on Linux pip takes torch
# with gigabytes of CUDA, unless torch's build for CPUs is there already.
sb3: $(SB3_STAMP)

$(SB3_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint $(CONSTRAINTS) --editable '.[sb3]'
	@touch $@

# Trains the tutorial's task on whatever device JAX finds, then evaluates and renders it. A machine
# without OpenGL still gets its policy and its metrics: render then says what to install.
train: RUN := $(RUN)
train: setup
	$(BIN)/jetbot-mjx train $(CONFIG) --run-dir $(RUN)
	$(BIN)/jetbot-mjx evaluate $(RUN)
	-$(BIN)/jetbot-mjx render $(RUN) --episodes 4
	@echo "everything is in $(RUN); to use the commands in this shell: source $(BIN)/activate"
	@echo "then: jetbot-mjx runs --open latest   the report"
	@echo "      jetbot-mjx play latest          the robot, live in the browser"

test: setup
	$(BIN)/python -m pytest -m 'not slow' --numprocesses logical --maxprocesses 8 --dist loadfile \
		--no-loadscope-reorder

# Every command and the tests, on this machine's NVIDIA GPU.
test-gpu: setup
	$(BIN)/python -m pip install --quiet --constraint $(CONSTRAINTS) --editable '.[cuda]'
	$(BIN)/python tests/on_gpu.py

test-slow: setup
	$(BIN)/python -m pytest -m slow -o faulthandler_timeout=7200 $(TESTS)

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/zizmor --offline --quiet --strict-collection .github

# Runs the notebooks and stores their outputs in them.
notebooks: setup
	$(BIN)/jupyter-execute --inplace $(sort $(wildcard notebooks/*.ipynb))

format: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

benchmark: setup
	$(BIN)/python benchmarks/steps_per_second.py

# Writes the WebAssembly modules of the policies that come with the package; needs LLVM's linker, wasm-ld.
wasm: $(STAMP)
	$(BIN)/python -c 'from jetbot_mjx.deployment.web_modules import store_modules; store_modules()'

# Into site/index.html, with pages of the policies that come with the package in site/demo/; a warning is an error. The
# variable silences an advertisement.
docs: $(DOCS_STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint $(CONSTRAINTS) --editable '.[docs]'
	@touch $@

# Builds the wheel, and uses it as its users do: in an empty folder, under the newest Python there is, with the newest of
# everything. Then the tests of what new versions break first: are the kernels on, does the page of `play` load.
NEWEST ?= $(shell ls -d $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.*/bin/python 2>/dev/null | sort -V | tail -n 1)
WHEEL_PYTHON := $(or $(NEWEST),$(PYTHON))
USE := cd .cache/wheel/elsewhere && ../venv/bin/jetbot-mjx

wheel: $(STAMP)
	rm -rf .cache/wheel && mkdir -p .cache/wheel/elsewhere
	$(BIN)/python -m hatchling build -t wheel -d .cache/wheel
	@$(WHEEL_PYTHON) -c 'import sys; print("the wheel runs under Python", sys.version.split()[0])'
	$(WHEEL_PYTHON) -m venv .cache/wheel/venv
	.cache/wheel/venv/bin/python -m pip install --quiet pytest pytest-xdist beartype \
		"$$(echo .cache/wheel/*.whl)[export,play]"
	$(USE) configs
	$(USE) train smoke
	$(USE) evaluate latest --episodes 64
	$(USE) evaluate pretrained:jetbot_egocentric --episodes 64 --output report
	$(USE) export latest --format all
	$(USE) runs
	$(USE) new-task my_task.py
	$(USE) check-env my_task.yaml
	$(USE) train obstacle --run-dir runs/obstacle --set ppo.num_timesteps=131_072
	.cache/wheel/venv/bin/python -m pytest -p no:cacheprovider --numprocesses 2 --dist loadfile \
		tests/end_to_end/test_kernels_are_on.py tests/onekernel/test_lower_jaxpr.py tests/viewers/test_viser_server.py

# What would be released, in dist/: complete for PyPI, and small. Nothing is uploaded.
release-check: $(STAMP)
	rm -rf dist
	$(BIN)/python -m hatchling build -d dist
	$(PYTHON) -m venv .cache/twine
	.cache/twine/bin/python -m pip install --quiet twine
	.cache/twine/bin/python -m twine check --strict dist/*
	@$(PYTHON) -c 'import pathlib, sys; [wheel] = pathlib.Path("dist").glob("*.whl"); size = wheel.stat().st_size / 1e6; \
		print(f"{wheel}: {size:.1f} MB"); sys.exit(size > 8 and "error: the wheel is larger than 8 MB")'

clean:
	rm -rf $(VENV) .cache site
