# Two commands are enough: `make run` and `make test`. Everything lives in .venv; nothing else on the machine is touched.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
TOPOLOGY ?= topologies/partitioned.yaml

.PHONY: help run test check lint types schema bench scale soak scaling reliability losses clean

help: ## this list
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 10

run: $(VENV)/ready ## install if need be, then run the nine-room building on two islands (TOPOLOGY=... for another file)
	$(PY) launch.py $(TOPOLOGY)

test: $(VENV)/tests ## install if need be, then run all tests
	$(PY) -m pytest -n 2 --dist loadfile

check: lint types test ## everything that CI checks

lint: $(VENV)/tests ## style
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

types: $(VENV)/tests ## mypy, strict
	$(PY) -m mypy

schema: $(VENV)/ready ## rewrite the JSON schema that editors use for topology files
	$(PY) -m duio_mesh.schema topologies/schema.json

bench: $(VENV)/tests ## speed, as ratios inside one interleaved run; the tables of docs/performance.md
	-$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(PY) bench/exchange.py --repeat 3 --rounds 4000
	$(PY) bench/admm.py
	$(PY) bench/startup.py
	$(PY) bench/design.py
	$(PY) bench/tape.py

scale: $(VENV)/ready ## rings of up to 128 sensor processes on this machine: speed, start, memory; into docs/scaling.md
	$(PY) bench/scale.py --write

soak: $(VENV)/ready ## a million rounds: nothing grows, nothing is lost, the oracle's estimates; into docs/scaling.md
	$(PY) bench/soak.py --write

scaling: $(VENV)/ready ## the model of rounds per second, fitted and tested (as root: network namespaces); into docs/scaling.md
	$(PY) bench/network.py --write

reliability: $(VENV)/tests ## every observer under every fault, in the mesh and out of it; tables and figure of docs/reliability.md
	OPENBLAS_NUM_THREADS=1 $(PY) bench/admm_loss.py --write
	OPENBLAS_NUM_THREADS=1 $(PY) bench/reliability.py --mesh --write
	$(PY) bench/losses.py --kills 10 --freezes 2

losses: $(VENV)/tests ## 100 kills and 20 freezes of random nodes at random moments; into docs/reliability.md
	$(PY) bench/losses.py --write

clean: ## remove the virtual environment and caches, keep runs/
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV) || { echo "python3 -m venv failed; on Debian or Ubuntu: apt install python3-venv"; rm -rf $(VENV); exit 1; }

$(VENV)/ready: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

$(VENV)/tests: $(VENV)/ready
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@
