# Sets up .venv and runs the common commands in it. Needs make and Python 3.11 or newer, nothing else.
# .venv belongs to this file: one that is half-made, too old or without pip is made again from nothing.

# The first of these that is new enough makes .venv; `make PYTHON=/path/to/python …` names one.
PYTHON ?= python3 python3.13 python3.12 python3.11
# Further options of the command: make fewshot ARGS="--target mass=x1.2 --oracle"
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
COMMA := ,
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
USABLE := $(shell $(BIN)/python -c 'import pip; $(NEW_ENOUGH)' 2>/dev/null && echo yes)

.PHONY: help fewshot test lint format docs clean FORCE
.DEFAULT_GOAL := help

help: ## list these commands
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s  %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# --overwrite so that a second run replaces the first; never in a folder that the caller named.
fewshot: $(VENV)/.installed ## fly, learn from 1000 transitions, fly better (options: ARGS="--target mass=x1.2")
	$(BIN)/python -m adapt.fewshot --samples 1000 $(if $(findstring --out,$(ARGS)),,--overwrite) $(ARGS)

test: $(VENV)/.installed-test ## run the tests, slow ones left out (pytest's options: ARGS="-k quadrotor")
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile $(ARGS)

lint: $(VENV)/.installed-test ## check style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.installed-test ## mend style and format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Warnings of the docstring parser count, too. The variable silences the theme's note on its successor (see mkdocs.yml).
docs: $(VENV)/.installed-docs ## build the API reference into site/; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict $(ARGS)

clean: ## remove .venv, builds and caches; runs/ stays
	rm -rf $(VENV) build dist site *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamps are newer than pyproject.toml exactly while what it asks for is installed.
$(VENV)/.installed: pyproject.toml $(if $(USABLE),,FORCE)
	$(call install,.,$@)

$(VENV)/.installed-test: pyproject.toml $(if $(USABLE),,FORCE)
	$(call install,.[test],$@ $(VENV)/.installed)

# With the test tools, so that `make docs` and `make test` in turn install nothing.
$(VENV)/.installed-docs: pyproject.toml $(if $(USABLE),,FORCE)
	$(call install,.[test$(COMMA)docs],$@ $(VENV)/.installed-test $(VENV)/.installed)

# $(1) what pip installs, $(2) the stamps that say so. The mark .installing outlives an install that was cut off, and
# then nothing in .venv is trusted; pip's own refusals (status 1 or 2) leave .venv as it was.
define install
@if [ -e $(VENV)/.installing ] || [ -z "$(USABLE)" ]; then \
  for python in $(PYTHON); do \
    "$$python" -c '$(NEW_ENOUGH)' 2>/dev/null && break; \
    python=; \
  done; \
  [ -n "$$python" ] || { echo "Python 3.11 or newer is needed and none of these is: $(PYTHON). Install one, or name it: make PYTHON=/path/to/python" >&2; exit 1; }; \
  echo "Making $(VENV) with $$("$$python" --version)"; \
  "$$python" -m venv --clear $(VENV) || exit; \
fi
@rm -f $(VENV)/.installed $(VENV)/.installed-test $(VENV)/.installed-docs && touch $(VENV)/.installing
@echo "Installing $(1) into $(VENV)"; $(BIN)/python -m pip install --disable-pip-version-check --editable '$(1)' \
  || { status=$$?; [ $$status -gt 2 ] || rm $(VENV)/.installing; exit $$status; }
@rm $(VENV)/.installing && touch $(2)
endef
