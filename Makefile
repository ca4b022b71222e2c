# Two commands set up everything: `make demo` and `make test`. Both use a private .venv.
PYTHON ?= python3
BIN := .venv/bin

# Compiled files are kept whatever the shell says: the tests start Python some hundred times.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo check quick test test-long lowest lint page docs dist try-wheel coverage mutants clean

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "mauvecl needs Python 3.11 or newer, found " + sys.version.split()[0])'
	@command -v ld >/dev/null || { echo "mauvecl needs the linker ld: install binutils (Debian, Ubuntu: apt-get install binutils)"; exit 1; }
	$(PYTHON) -m venv .venv

# One stamp per extra: installed again only when pyproject.toml changes.
.venv/%.stamp: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch $@

demo: .venv/plot.stamp
	$(BIN)/mauvecl detect --paper --output demo/paper
	$(BIN)/mauvecl detect --output demo/realistic

# A file's tests stay in one process, which makes its fixtures and builds its kernels once. There are as many processes
# as cores and more: threads of OpenBLAS would only wait for each other.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder

# What must hold of every change, in minutes; with TESTS=all those that take long as well, as .ci/run has it.
test: .venv/test.stamp
	$(PYTEST) -n 3 $(if $(filter all,$(TESTS)),,-m "not long")

# Coverage studies, attacks, executed documentation and whatever else takes long.
test-long: .venv/test.stamp
	$(PYTEST) -n 3 -m long

lint: .venv/test.stamp .venv/lint.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy
	$(BIN)/zizmor --offline --quiet .github
	@if command -v npm >/dev/null && $(MAKE) --silent $(PAGE)/.stamp; then $(MAKE) --no-print-directory page; \
	else echo "the page's script is not checked: that needs npm (Debian, Ubuntu: apt-get install npm) and its packages"; fi

# Style and types of the page's script; the page itself needs no package of npm's.
PAGE := tools/page/node_modules
page: $(PAGE)/.stamp
	$(PAGE)/.bin/eslint --config tools/page/eslint.config.js mauvecl/web/assets
	$(PAGE)/.bin/tsc --project tools/page/jsconfig.json

$(PAGE)/.stamp: tools/page/package-lock.json
	@cd tools/page && npm ci --silent
	@touch $@

# While editing, in a minute: lint, and the short tests of what everything stands on. Types are checked while they run.
check: .venv/test.stamp .venv/lint.stamp
	@$(MAKE) --no-print-directory -j 2 lint quick

QUICK := $(addprefix tests/,kernels noise detection host study test_golden.py test_corpus.py)
quick: .venv/test.stamp
	$(PYTEST) -n 2 -q -m 'not long' $(QUICK)

docs: .venv/docs.stamp
	OPENBLAS_NUM_THREADS=1 $(BIN)/sphinx-build -W -q -b html docs docs/_build

# The oldest versions that pyproject.toml admits, in an environment of their own; uv resolves what pip cannot.
# Golden tables hold rounding errors and roots to nine digits, which other versions of scipy compute otherwise.
lowest: .venv/test.stamp
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/python -m venv --clear build/lowest
	$(BIN)/uv pip install --quiet --python build/lowest/bin/python --resolution lowest-direct '.[all]'
	$(BIN)/uv pip freeze --python build/lowest/bin/python --exclude mauvecl >build/lowest.txt
	$(BIN)/uv pip install --quiet --python build/lowest/bin/python --constraint build/lowest.txt '.[test]'
	OPENBLAS_NUM_THREADS=1 build/lowest/bin/python -m pytest --dist loadfile -n 2 -q -m 'not long' --ignore tests/test_golden.py

# Wheel and sdist, twice: the same files give the same bytes.
dist: .venv/dist.stamp
	rm -rf dist build/again
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m build --outdir build/again .
	diff -r dist build/again
	$(BIN)/twine check --strict dist/*
	cd dist && sha256sum *

# The wheel in an empty environment, from outside the checkout. Nothing but it and the linker is in the path: no compiler.
WHEEL := build/wheel
ALONE = env -i HOME="$$PWD" PATH="$$PWD/../bin" $(if $(OCL_ICD_VENDORS),OCL_ICD_VENDORS=$(OCL_ICD_VENDORS))
try-wheel:
	$(PYTHON) -m venv --clear $(WHEEL)
	$(WHEEL)/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	mkdir $(WHEEL)/home && ln -s "$$(command -v ld)" $(WHEEL)/bin/ld
	cd $(WHEEL)/home && $(ALONE) mauvecl selftest
	cd $(WHEEL)/home && $(ALONE) mauvecl detect

# Lines and branches that the tests run, with the processes that they start; kernels do not count.
coverage: .venv/coverage.stamp
	$(PYTEST) -n 2 -q --cov --cov-report term:skip-covered --cov-report xml:build/coverage.xml

mutants: .venv/test.stamp
	$(BIN)/python tools/mutation_check.py

clean:
	rm -rf .venv tools/page/node_modules demo build dist docs/_build docs/_generated docs/commands docs/jupyter_execute *.egg-info
