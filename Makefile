# Everything runs in .venv, which the first target that needs it makes.
# Another interpreter:   make test PYTHON=python3.12
# Other pytest options:  make test PYTEST_ARGS="-m slow"

VENV := .venv
BIN := $(VENV)/bin
IS_NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
# The first of these that runs and is new enough; a recursive variable, so only looked for when .venv is made.
PYTHON = $(shell for python in python3 python3.13 python3.12 python3.11; do \
	if $$python -c '$(IS_NEW_ENOUGH)' 2>/dev/null; then echo $$python; break; fi; done)
PYTEST_ARGS = --numprocesses 2 --dist loadfile
# Processors and GPUs whose kernels are compiled; a wheel for everybody wants
# make wheel KERNELS="--levels x86-64-v3 x86-64-v4 --architectures 80 90 100 120"
KERNELS = --levels x86-64-v3
INSTALL = $(BIN)/python -m pip install --constraint constraints.txt
PACKAGE := pyproject.toml constraints.txt

.PHONY: help demo test kernels check format docs wheel bench-check clean

help:
	@echo "make demo     install dano and show a first simulation"
	@echo "make test     install everything and run the tests"
	@echo "make kernels  compile the kernels that tests share and the wheel brings"
	@echo "make check    lint, format check, import layers, types"
	@echo "make format   apply the formatter and the safe lint fixes"
	@echo "make docs     build the documentation into site/"
	@echo "make wheel    build the wheel, install it into an empty environment and simulate"
	@echo "make bench-check   which stored accuracies miss their targets, which tables are out of date"
	@echo "make clean    remove .venv, caches and build products"

demo: $(VENV)/.demo
	$(BIN)/dano demo

test: kernels
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# What was made from the same sources stays.
kernels: $(VENV)/.dev
	$(BIN)/python assets/make_kernels.py $(KERNELS)

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/basedpyright

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.docs
	$(BIN)/mkdocs build --strict

# Without the clone in sight, nor a home: what the wheel lacks is missed.
wheel: kernels
	rm -rf build dist $(VENV)/empty
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	$(BIN)/python -m venv $(VENV)/empty
	$(VENV)/empty/bin/python -m pip install --quiet --constraint constraints.txt dist/*.whl
	cp tests/wheel/first_step.py $(VENV)/empty
	cd $(VENV)/empty && mkdir home && export HOME=$$PWD/home && bin/python first_step.py \
		&& bin/dano --version && bin/dano check bunny && bin/dano simulate bunny -o bunny.npz
	rm -rf build $(VENV)/empty

bench-check: $(VENV)/.dev
	$(BIN)/python -m benchmarks.figures --check
	$(BIN)/python -m benchmarks.check

clean:
	rm -rf $(VENV) build dist site src/dano/compiled .pytest_cache .ruff_cache .import_linter_cache .hypothesis

# Each stamp is touched last, so an interrupted installation is taken up again.
$(VENV)/.pip:
	@python="$(PYTHON)"; \
	if ! "$${python:-python3}" -c '$(IS_NEW_ENOUGH)' 2>/dev/null; then \
		echo "dano needs Python 3.11 or newer, but $${python:-python3} is" \
			"$$("$${python:-python3}" --version 2>/dev/null || echo 'not there')." >&2; \
		echo "Install one, or name it: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11" >&2; \
		exit 1; \
	fi; \
	"$$python" -m venv $(VENV)
	$(BIN)/python -m pip install --upgrade pip
	@touch $@

$(VENV)/.demo: $(VENV)/.pip $(PACKAGE)
	$(INSTALL) --editable '.[view]'
	@touch $@

$(VENV)/.dev: $(VENV)/.pip $(PACKAGE)
	$(INSTALL) --editable '.[dev,gym,view,mesh,mujoco,import,train,poses,batch,export,usd,pybullet,step]'
	@touch $@

$(VENV)/.docs: $(VENV)/.pip $(PACKAGE)
	$(INSTALL) --editable '.[docs]'
	@touch $@
