# make run does all set-up and then everything; make help lists what there is.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
EXTRAS := trainer,log,live,export,experiment,cluster,examples,docs,dev
# Passed on to tandem, e.g. make run ARGS="--seconds 60 --oracle l2nw"
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help setup run simulate paper examples bench test test-long compose-test wheel-test remote-test
.PHONY: cluster-test faults fuzz soak docs docs-test lint format clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' Makefile

setup: $(READY)  ## a virtual environment in .venv with everything in it

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "Tandem needs Python 3.11 or later; try: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
# Python compiles a file when it is first imported, and only one in seven is.
	$(BIN)/pip install --no-compile --quiet --disable-pip-version-check -e '.[$(EXTRAS)]'
	@touch $(READY)

run: $(READY)  ## controller, trainer, plant and recorder, live, for 20 s
	$(BIN)/tandem run $(ARGS)

simulate: $(READY)  ## the same in lock-step, faster than real time
	$(BIN)/tandem simulate $(ARGS)

paper: $(READY)  ## the paper's experiment and beyond, into paper/report.html
	$(BIN)/tandem experiment paper --out paper $(ARGS)

EXAMPLES := runs/examples
examples: $(READY)  ## every example, one of them live, with pictures into runs/examples: 5 minutes
	rm -rf $(EXAMPLES)
	mkdir -p $(EXAMPLES)
	cd $(EXAMPLES) && $(CURDIR)/$(BIN)/python $(CURDIR)/examples/compressor/compressor.py
	$(BIN)/python examples/compare.py examples/tanks/tanks.toml --steps 60 --out $(EXAMPLES)/tanks.png
	$(BIN)/python examples/compare.py examples/reactor/reactor.toml --steps 100 --episodes 3 --out $(EXAMPLES)/reactor.png
	$(BIN)/python examples/compare.py examples/quadrotor/quadrotor.toml --steps 250 --out $(EXAMPLES)/quadrotor.png
	$(BIN)/python examples/compare.py examples/mujoco_crane/crane.toml --steps 500 --out $(EXAMPLES)/crane.png
	$(BIN)/python examples/compare.py examples/gymnasium_pendulum/pendulum.toml --steps 100 --out $(EXAMPLES)/pendulum.png
	$(BIN)/tandem run --config examples/mujoco_crane/crane.toml --seconds 20 --log $(EXAMPLES)/crane-live.mcap
	$(BIN)/tandem replay $(EXAMPLES)/crane-live.mcap
	$(BIN)/tandem simulate --config examples/tanks/tanks.toml --oracle constant --steps 60 --log $(EXAMPLES)/tanks.mcap
	$(BIN)/python examples/replay/what_if.py $(EXAMPLES)/tanks.mcap controller.oracle=linear --out $(EXAMPLES)/what_if.png
	$(BIN)/tandem simulate --set network.architecture=examples/architecture/gru.py:GRU --set network.hidden='[16,16]'

bench: $(READY)  ## time the solver beside others, and rewrite docs/results/performance.md: about 10 minutes
	$(BIN)/python -m benchmarks.solver --document docs/results/performance.md $(ARGS)

test: $(READY)  ## the tests; for some, .venv/bin/pytest PATH
	$(BIN)/pytest -n auto --dist loadfile -m "not live and not long"
# Real processes run apart from these: what they show depends on when they get a core. They wait most of the time.
	$(BIN)/pytest -n 2 --dist loadfile -m "live and not long" --ignore tests/verification
# Faults on real processes count every message: they run alone.
	$(BIN)/pytest -m "live and not long" tests/verification

test-long: $(READY)  ## the tests that make test leaves out, since they take long: 3 minutes
	$(BIN)/pytest -n auto -m long $(ARGS)

compose-test: $(READY)  ## the containers for real; needs a Docker engine
	$(BIN)/pytest -x -s tests/compose/live_compose.py $(ARGS)

wheel-test: $(READY)  ## the wheel, built and installed in bare environments, in an empty folder: some minutes
	$(BIN)/pytest -x -s tests/packaging/live_wheel.py $(ARGS)

remote-test: $(READY)  ## docs/tutorials/remote.md, the trainer in another network namespace: 2 minutes; needs root
	$(BIN)/pytest -x -s tests/remote/live_remote.py $(ARGS)

cluster-test: $(READY)  ## sweeps on a Dask scheduler under faults, and their cost: 20 minutes; root for the full disk
	$(BIN)/pytest -x -s tests/cluster/live_cluster.py $(ARGS)

faults: $(READY)  ## faults on real processes, into docs/results/faults.md: hours; root; ARGS=--list names them
	$(BIN)/python -m verification.faults --document docs/results/faults.md $(ARGS)

fuzz: $(READY)  ## 10 million bad payloads through all readers of bytes, into docs/results/faults.md: minutes
	$(BIN)/python -m verification.fuzz --document docs/results/faults.md $(ARGS)

soak: $(READY)  ## 30 minutes live at 50 Hz, into docs/results/faults.md; ARGS="--minutes 1" for a short one
	$(BIN)/python -m verification.soak --document docs/results/faults.md $(ARGS)

docs: $(READY)  ## the site, into site/: open site/index.html; for one that follows edits, .venv/bin/mkdocs serve
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

docs-test: $(READY)  ## every command of every page, run: 20 minutes; ARGS="-k first-plant" for one page
	$(BIN)/pytest -x -s tests/docs/live_pages.py $(ARGS)

lint: $(READY)  ## style, types, and which package may import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(READY)  ## put the code into the one style
	$(BIN)/ruff format .

clean:  ## remove the environment and all caches; logs stay
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
