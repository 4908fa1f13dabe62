# Everything happens in .venv; `make study` and `make test` need Python 3.11, git and make, nothing else.
PYTHON ?= python3
RUN := .venv/bin/python

.PHONY: study test test-all lint docs benchmark clean

study: .venv/installed
	$(RUN) -m safevar_sumo study rain

test: .venv/installed
	$(RUN) -m pytest

test-all: test
	$(RUN) -m pytest -m slow

lint: .venv/installed
	$(RUN) -m ruff check .
	$(RUN) -m mypy
	.venv/bin/lint-imports --no-logo

docs: .venv/installed
	$(RUN) -m mkdocs build --quiet --strict

benchmark: .venv/installed
	$(RUN) benchmarks/evaluation.py
	$(RUN) benchmarks/campaign.py
	$(RUN) benchmarks/growth.py

.venv/installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(RUN) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[test,docs]"
	touch $@

clean:
	rm -rf .venv
