# make demo   train on the embedded scene for 20 seconds, and leave pictures
# make test   the tests that every change has to pass; make test-fast those of them that take under a second
# make mutants   plant every bug of tests/mutants, one at a time: does its test fail? ONLY='poses exports' for some
# make docs   the documentation, into site/
# make sanitize   the kernels' tests, on kernels that watch every read, write and sum
# make release-check   build both distributions, look into them, install and use them
# make test-versions   the tests of make test under every Python and torch that can be had here
# All make .venv first. Running them again is quick: the installation is redone only when its inputs change.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
INPUTS := pyproject.toml setup.py constraints.txt $(wildcard framework/kernels/*/*.cpp framework/kernels/*/*.h)

.PHONY: demo test test-fast test-all mutants lint docs sanitize release-check test-versions clean

demo: .venv/installed
	@run=outputs/demo/instant-ngp/$$(date +%Y-%m-%d_%H%M%S); \
	$(BIN)/ns-train instant-ngp --max-seconds 20 --experiment-name demo --timestamp $$(basename $$run) && \
	$(BIN)/ns-render orbit --load-config $$run/config.yml --output-path $$run/orbit.gif \
		--num-frames 48 --fps 16 && \
	echo "held-out views (photograph, render, error, depth, opacity):" && ls $$run/pictures/*_comparison.png && \
	echo "turntable:" && ls $$run/orbit.gif

test: .venv/installed-test
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow"

test-fast: .venv/installed-test
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not medium"

test-all: .venv/installed-test .venv/installed-docs
	$(BIN)/python -m pytest

mutants: .venv/installed-test
	$(BIN)/python -m tests.mutants $(ONLY)

lint: .venv/installed-test .venv/links
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: .venv/installed-docs .venv/links
	$(BIN)/python docs/building/prose.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python docs/building/check_links.py site

sanitize: .venv/installed-test
	$(BIN)/python -m tests.sanitize

release-check: .venv/installed-release
	$(BIN)/python -m tests.release

test-versions: .venv/installed-release
	$(BIN)/nox --no-error-on-missing-interpreters

.venv/bin/python:
	$(PYTHON) -m venv .venv

# Quick: with the kernels of this processor alone, and without compiling modules that nobody imports.
.venv/installed: .venv/bin/python $(INPUTS)
	@echo "installing nerfloom into .venv"
	$(PIP) --no-compile -e .
	@touch $@

# All that `.venv/installed` has, in one installation: two would compile the kernels of this processor twice.
.venv/installed-test: .venv/bin/python $(INPUTS)
	@echo "installing nerfloom and the test extra into .venv"
	NERFLOOM_VARIANTS=all $(PIP) --no-compile -e '.[test]'
	@touch .venv/installed $@

.venv/installed-release: .venv/installed-test
	@echo "installing the release extra into .venv"
	NERFLOOM_VARIANTS=all $(PIP) -e '.[release]'
	@touch $@

.venv/installed-docs: .venv/installed
	@echo "installing the docs extra into .venv"
	$(PIP) -e '.[docs]'
	@touch $@

# The package as one folder, for the type checker and for editors, which follow no editable installation.
.venv/links: .venv/bin/python $(wildcard framework/*)
	@rm -rf $@ && mkdir -p $@/nerfloom
	@ln -s $(CURDIR)/methods $(CURDIR)/dataparsers $(addprefix $(CURDIR)/,$(filter-out %/__pycache__,$(wildcard framework/*))) $@/nerfloom

clean:
	rm -rf .venv outputs site
