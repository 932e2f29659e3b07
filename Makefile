# `make demo` and `make test` set everything up by themselves; the environment lands in .venv.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-rllib test-torchvision check docs results setup clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "covis needs Python 3.11: set PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(STAMP)
	$(BIN)/covis demo

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile $(PYTEST_ARGS)

# RLlib wants other versions of Gymnasium than the rest: it has an environment of its own.
test-rllib:
	test -x .venv-rllib/bin/python || $(PYTHON) -m venv .venv-rllib
	.venv-rllib/bin/python -m pip install --quiet --editable '.[envs]' 'ray[rllib]' torch==2.13.0 pytest
	COVIS_TEST_RLLIB=1 .venv-rllib/bin/python -m pytest tests/rllib

# torchvision wants a torch of its own build, and both are large (5.5 GB with CUDA builds): an environment of its own.
test-torchvision:
	test -x .venv-torchvision/bin/python || $(PYTHON) -m venv .venv-torchvision
	.venv-torchvision/bin/python -m pip install --quiet --editable '.[all,torchvision]' torch==2.14.1 torchvision==0.29.1 pytest
	.venv-torchvision/bin/python -m pytest tests/torchvision

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The book as a site; a broken link or a docstring that cannot be read fails. With SERVE=1 it is served, for its search.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build # not --quiet: warnings that are not shown do not fail
	@echo "build/site/index.html"
	$(if $(SERVE),$(BIN)/python -m http.server --bind 127.0.0.1 --directory build/site 8000)

# Everything under docs/results: hours on two cores. Interrupted, it goes on where it was; runs/ keeps the records.
# `make results EPISODES=1` is a rehearsal. page.html, since the site makes a report.html of report.md. Solves are timed one at a time.
SUITES ?= paper-table1 paper-case-study paper-fig7 matching-synthetic scaling-robots paper-runtime
WORKERS ?= 2
results: $(STAMP)
	for suite in $(SUITES); do \
	  workers=$(WORKERS); [ $$suite != paper-runtime ] || workers=1; \
	  mkdir -p docs/results/$$suite && \
	  $(BIN)/covis benchmark $$suite --out runs/$$suite --resume --workers $$workers $(if $(EPISODES),--episodes $(EPISODES)) \
	    --figure docs/results/$$suite/figure.png && \
	  $(BIN)/covis report runs/$$suite && \
	  cp runs/$$suite/rows.json runs/$$suite/report.md docs/results/$$suite/ && \
	  cp runs/$$suite/report.html docs/results/$$suite/page.html || exit 1; \
	done

clean:
	rm -rf $(VENV) .venv-rllib .venv-torchvision build *.egg-info covis-demo
