# `make demo` and `make test` need only python3 (3.11 or newer) and make; everything else they install into .venv.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
RUNS   ?= runs

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PYGAME_HIDE_SUPPORT_PROMPT := 1

.DEFAULT_GOAL := help
.PHONY: help install demo browser test test-slow opponents trl bench format clean

help:
	@echo "make demo       train PPO on CartPole-v1 with 8 seeds, evaluate, plot and film it"
	@echo "make test       linter, formatter check, type checker, tests"
	@echo "make test-slow  the learning tests that take long"
	@echo "make opponents  install what agents are measured against into .venv-opponents"
	@echo "make trl        install what language models are measured beside into .venv-trl"
	@echo "make bench      measure against other libraries, write docs/performance.md"
	@echo "make format     format the code and mend what the linter can"
	@echo "make clean      remove .venv, caches and build files (runs/ stays)"

install: $(STAMP)

# On Debian python3 comes without ensurepip; its package python3-venv brings it.
$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "error: $(PYTHON) was not found: install Python 3.11 or newer, or say which: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: Thorndike needs Python 3.11 or newer, but $(PYTHON) is $$($(PYTHON) --version 2>&1): say which to use: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  run=; [ "$$(id -u)" = 0 ] || run="sudo -n"; \
	  echo "installing python3-venv, which $(PYTHON) lacks"; \
	  { $$run apt-get update -qq && $$run env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq python3-venv; } >/dev/null 2>&1; \
	  $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null; \
	} || { echo "error: $(PYTHON) cannot make virtual environments; type: sudo apt-get install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	PIP_CONSTRAINT=$(abspath constraints.txt) PIP_BUILD_CONSTRAINT=$(abspath constraints.txt) \
	  $(BIN)/python -m pip install --quiet --editable '.[all,dev]'
	@touch $@

demo: export SDL_VIDEODRIVER := dummy
demo: $(STAMP)
	@$(BIN)/thorndike train ppo CartPole-v1 --seeds 8 --name demo --output $(RUNS)
	@echo
	@$(BIN)/thorndike eval latest --output $(RUNS)
	@echo
	@$(BIN)/thorndike plot latest --output $(RUNS)
	@$(BIN)/thorndike watch latest --output $(RUNS) --video $(RUNS)/demo.mp4

# The studio is tested in a browser; where there is none and none can be installed, those tests say so and are skipped.
browser:
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    echo "installing chromium, in which the studio is tested"; \
	    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium; } >/dev/null 2>&1 || \
	      echo "chromium could not be installed: the tests in a browser are skipped" >&2; \
	  else echo "no chromium here: the tests in a browser are skipped; type: sudo apt-get install chromium" >&2; fi

test: $(STAMP) browser
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/pytest -q -n auto --dist loadfile -m "not slow"

test-slow: $(STAMP) browser
	@$(BIN)/pytest -q -m slow

# PyTorch's CPU build where there is one, else what the registry has: the peers run on the CPU either way.
.venv-peers/.installed: benchmarks/peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet torch==2.13.0+cpu || .venv-peers/bin/python -m pip install --quiet torch==2.13.0
	grep -v '^torch==' benchmarks/peers.txt > .venv-peers/peers.txt
	.venv-peers/bin/python -m pip install --quiet -r .venv-peers/peers.txt
	@touch $@

# Programs that nobody here wrote, to play against; each runs in a process of its own.
opponents: .venv-opponents/.installed

.venv-opponents/.installed: benchmarks/opponents.txt
	$(PYTHON) -m venv .venv-opponents
	.venv-opponents/bin/python -m pip install --quiet -r benchmarks/opponents.txt
	@touch $@

# TRL, transformers, peft; and beside it the last TRL that had PPO.
trl: .venv-trl/.installed

.venv-trl/.installed: benchmarks/trl.txt
	$(PYTHON) -m venv .venv-trl
	.venv-trl/bin/python -m pip install --quiet torch==2.13.0+cpu || .venv-trl/bin/python -m pip install --quiet torch==2.13.0
	grep -v '^torch==' benchmarks/trl.txt > .venv-trl/trl.txt
	.venv-trl/bin/python -m pip install --quiet -r .venv-trl/trl.txt
	.venv-trl/bin/python -m pip install --quiet --no-deps --target .venv-trl/trl-1.12.0 trl==1.12.0
	@touch $@

bench: $(STAMP) .venv-peers/.installed
	@$(BIN)/python benchmarks/run.py

format: $(STAMP)
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(VENV)-* build dist .pytest_cache .mypy_cache .ruff_cache .cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -name '*.egg-info' -type d -prune -exec rm -rf {} +
