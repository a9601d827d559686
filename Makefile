# make book   install, execute the notebooks, build the edition     make test   run the tests     make help   the rest
PYTHON  ?= python3
PROFILE ?= laptop
JOBS    ?= 2

BIN     := .venv/bin
# Modules are compiled when they are first imported: most never are.
INSTALL := $(BIN)/python -m pip --disable-pip-version-check install --no-compile --constraint constraints.txt --editable
NEEDS   := pyproject.toml constraints.txt

.DEFAULT_GOAL := help
.PHONY: help install install-dev book pdf reproduce figures readme test lab lint clean

help: ## show the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  options: PROFILE=laptop|ci|paper  JOBS=2  PYTHON=python3 (3.11 or 3.12)"

book: .venv/installed ## execute what is not fresh under PROFILE (laptop: the edition), build book/_build/html
	$(BIN)/inflate book --profile $(PROFILE) --jobs $(JOBS)

pdf: book ## the same as one PDF file, printed by Chromium: book/_build/pdf/book.pdf
	$(BIN)/inflate pdf

reproduce: .venv/installed ## execute what is not fresh under PROFILE, without the book
	$(BIN)/inflate reproduce --profile $(PROFILE) --jobs $(JOBS)

figures: .venv/installed ## execute the profile laptop and publish its figures in figures/laptop, which git keeps
	$(BIN)/inflate reproduce --profile laptop --jobs $(JOBS) --publish

readme: .venv/installed ## write what README.md and the first page of the book take from other files anew
	$(BIN)/python -m inflate_lib.book.readme

test: .venv/installed-dev ## run the tests that need neither minutes nor an executed book
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

lint: .venv/installed-dev ## check the style, the direction of imports, and the types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

lab: .venv/installed-lab ## open JupyterLab on the notebooks
	$(BIN)/jupyter lab notebooks

install: .venv/installed ## create .venv with the pinned packages

install-dev: .venv/installed-dev ## the same, with what the tests and make lint need

clean: ## remove the book, the executed notebooks and their figures (the cache in data/cache stays)
	rm -rf book/_build book/notebooks figures/runs

.venv/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' || { \
	  echo "Python 3.11 or 3.12 is needed, and $(PYTHON) is $$($(PYTHON) --version 2>&1). Try: make book PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv .venv
	touch $@

.venv/installed: .venv/python $(NEEDS)
	$(INSTALL) '.[book,design]'
	touch $@

.venv/installed-%: .venv/python $(NEEDS)
	$(INSTALL) '.[book,design,$*]'
	touch .venv/installed $@
