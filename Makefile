# Everything happens in .venv, and each target installs only what it needs. Needed beforehand: Python 3.11, git and make.
PYTHON ?= python3
RUN := .venv/bin/python
PARALLEL := -n auto --dist worksteal
PACKAGE := setup.cfg pyproject.toml constraints.txt
INSTALL = $(RUN) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

.PHONY: study plain test slow test-all test-lowest lint docs docs-outputs pictures benchmark clean

study: .venv/installed
	$(RUN) -m safevar_sumo study rain

plain:
	$(PYTHON) -m tools.plain_machine

test: .venv/installed-test
	$(RUN) -m pytest $(PARALLEL) --durations=15

test-all: test slow

slow: .venv/installed-test-all
	$(RUN) -m pytest $(PARALLEL) -m slow --durations=40

test-lowest: .venv/installed-lowest
	.venv/lowest/bin/python -m pytest $(PARALLEL)

lint: .venv/installed-test
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check --quiet .
	$(RUN) -m mypy
	.venv/bin/lint-imports --no-logo

docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --quiet --strict

docs-outputs: .venv/installed-test
	$(RUN) -m tools.pages
	$(RUN) docs/generate.py

pictures: .venv/installed-test
	$(RUN) docs/scripts/pictures.py

benchmark: .venv/installed-test
	$(RUN) benchmarks/evaluation.py
	$(RUN) benchmarks/campaign.py
	$(RUN) benchmarks/growth.py
	$(RUN) benchmarks/answers.py

.venv/installed: $(PACKAGE)
	$(PYTHON) -m venv .venv
	$(INSTALL) .
	touch $@

# ASAM's checks of OpenSCENARIO and OpenDRIVE need older versions of libraries than this package: their own environment.
.venv/installed-asam: tests/replay/asam.txt .venv/installed
	$(RUN) -m venv .venv/asam
	.venv/asam/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	touch $@

# The lowest versions that setup.cfg allows, where it says `name >= version`.
.venv/installed-lowest: setup.cfg
	$(PYTHON) -m venv .venv/lowest
	sed -n 's/^    \([A-Za-z0-9_-]*\) >= \([0-9.]*\).*/\1 == \2/p' $< > .venv/lowest/versions.txt
	.venv/lowest/bin/python -m pip install --quiet --disable-pip-version-check \
		--constraint .venv/lowest/versions.txt --editable ".[test]"
	touch $@

.venv/installed-%: .venv/installed
	$(INSTALL) ".[$*]"
	touch $@

clean:
	rm -rf .venv
