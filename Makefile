# Everything happens in .venv, and each target installs only what it needs. Needed beforehand: Python 3.11, git and make.
PYTHON ?= python3
RUN := .venv/bin/python
PACKAGE := setup.cfg pyproject.toml constraints.txt
INSTALL = $(RUN) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

.PHONY: study test test-all lint docs docs-outputs pictures benchmark clean

study: .venv/installed
	$(RUN) -m safevar_sumo study rain

test: .venv/installed-test
	$(RUN) -m pytest

test-all: test
	$(RUN) -m pytest -m slow

lint: .venv/installed-test
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check --quiet .
	$(RUN) -m mypy
	.venv/bin/lint-imports --no-logo

docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --quiet --strict

docs-outputs: .venv/installed-test
	$(RUN) -m tests.pages

pictures: .venv/installed-test
	$(RUN) docs/pictures.py

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

.venv/installed-%: .venv/installed
	$(INSTALL) ".[$*]"
	touch $@

clean:
	rm -rf .venv
