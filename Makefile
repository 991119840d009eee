# `make` lists the targets. They set up what they need on their own, in .venv.

VENV := .venv
BIN := $(VENV)/bin
REQUIREMENTS := requirements/ros.txt requirements/runtime.txt requirements/dev.txt
STAMP := $(VENV)/.setup-done
PIP := $(BIN)/python -m pip --disable-pip-version-check install -qq

# The first of these that really runs, with venv and pip, as Python 3.10 to 3.13.
PYTHONS := $(PYTHON) python3.12 python3.11 python3.13 python3.10 python3
USABLE := import ensurepip, sys, venv; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint bench bench-live docs colcon clean distclean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' Makefile
	@echo 'PYTHON=/path/to/python chooses the Python of .venv, 3.10 to 3.13 (distclean to change it)'

setup: $(STAMP) ## install everything into .venv

demo: $(STAMP) ## virtual vehicle, live estimator, recording, replay and report in two minutes
	$(BIN)/railtrack demo --output demo_output

test: lint ## check style and types, then run the tests
	ROS_PYTHON_CHECK_FIELDS=1 $(BIN)/python -m pytest -n 2

lint: $(STAMP) ## check style and types
	$(BIN)/ruff check
	$(BIN)/mypy

bench: $(STAMP) ## measure the speed figures of the README on this machine
	$(BIN)/railtrack benchmark

bench-live: $(STAMP) ## measure the live node for half an hour, into docs/live_node.md
	NUMBA_NUM_THREADS=1 $(BIN)/python benchmarks/live.py

docs: $(STAMP) ## write the reference pages and build the documentation into build/docs
	$(BIN)/python docs/generate.py
	$(BIN)/mkdocs build --strict

colcon: $(STAMP) ## build with colcon into install/
	PATH="$(CURDIR)/$(BIN):$$PATH" AMENT_PREFIX_PATH="$(CURDIR)/$(VENV)" \
	    $(BIN)/python -m colcon build --base-paths .

clean: ## remove caches, builds and results, keep .venv
	rm -rf build install log demo_output *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## remove .venv too
	rm -rf $(VENV)

# The stamp is written last, so a setup that failed or was interrupted is done again.
$(STAMP): $(REQUIREMENTS) setup.py setup.cfg
	@rm -f $@
	@if ! $(BIN)/python -c '$(USABLE)' 2>/dev/null; then \
	    found=; \
	    for python in $(PYTHONS); do \
	        if $$python -c '$(USABLE)' 2>/dev/null; then found=$$python; break; fi; \
	        [ "$$python" != "$(PYTHON)" ] || \
	            echo "$$python is not a Python 3.10 to 3.13 with venv and pip: looking for another"; \
	    done; \
	    if [ -z "$$found" ]; then \
	        echo 'no Python 3.10 to 3.13 with venv and pip found: install one, or name it with' \
	            'make setup PYTHON=/path/to/python' >&2; \
	        exit 1; \
	    fi; \
	    echo "creating $(VENV) with $$($$found --version)"; \
	    rm -rf $(VENV) && $$found -m venv $(VENV); \
	fi
	@echo 'installing the requirements into $(VENV): about a minute the first time'
	@$(PIP) $(addprefix -r ,$(REQUIREMENTS))
	@$(PIP) --no-build-isolation --no-deps --editable .
	@touch $@
	@echo 'ready: $(BIN)/railtrack --help'
