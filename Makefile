# Targets first create .venv and install into it, if needed.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
# The run folder that ARGS names, else the default.
run_dir = $(or $(patsubst hydra.run.dir=%,%,$(lastword $(filter hydra.run.dir=%,$(ARGS)))),$(1))
RUN ?= outputs/quick_$(shell date +%Y-%m-%d_%H-%M-%S)
DEMO ?= outputs/demo_$(shell date +%Y-%m-%d_%H-%M-%S)
ARGS ?=
PYTEST := $(BIN)/python -m pytest -q -n logical --maxprocesses 4 --dist worksteal

.PHONY: help install demo train test test-slow test-extras coverage chaos fuzz memory camera mutations bench paper docs walk release lock audit lint format clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(STAMP)  ## create .venv and install the package with its development tools (LOCK=.ci/requirements.lock: locked versions)

$(STAMP): pyproject.toml $(LOCK)
	@echo "Installing into .venv takes a few minutes."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check $(if $(LOCK),-c $(LOCK)) -e '.[dev]'
	@touch $@

demo: RUN_DIR := $(call run_dir,$(DEMO))
demo: $(STAMP)  ## pack totes with shipped weights, and write a replay page
	$(BIN)/pickplace-evaluate checkpoint=pretrained/r4 evaluation.episodes=20 hydra.run.dir=$(RUN_DIR) $(ARGS)
	@echo "Open $(RUN_DIR)/replay.html in a browser."

train: RUN_DIR := $(call run_dir,$(RUN))
train: $(STAMP)  ## train experiment=quick, and evaluate it (ARGS="key=value ..." adds overrides)
	$(BIN)/pickplace-train experiment=quick hydra.run.dir=$(RUN_DIR) $(ARGS)
	$(BIN)/pickplace-evaluate checkpoint=$(RUN_DIR) hydra.run.dir=$(RUN_DIR)/evaluation
	@printf '\n%s\n' "Run folder $(RUN_DIR):"
	@printf '  %-32s%s\n' \
	  checkpoints/best 'the policy, for pickplace-evaluate checkpoint=$(RUN_DIR)' \
	  metrics.csv 'every metric over frames' \
	  learning_curve.png 'occupancy over frames, also of each tote height; .pdf and .svg for a paper' \
	  report.html 'the run on one page: a full tote, curves, tables, best and worst episode' \
	  evaluation/evaluation.md 'the table above; evaluation.json has every episode' \
	  evaluation/tote.png 'a packed tote; also .pdf and .svg' \
	  evaluation/replay.html 'a replay in 3D'

test: export OMP_NUM_THREADS ?= 1
test: $(STAMP)  ## run the tests in one process a core, at most 4 (minutes; ARGS="tests/envs -k stuck" for a part)
	$(PYTEST) $(ARGS)

test-extras: export OMP_NUM_THREADS ?= 1
test-extras: $(STAMP)  ## install every optional extra (a gigabyte), and run the tests that need them
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev,wandb,mlflow,optuna,joblib,submitit,ray,serve,onnx]'
	$(BIN)/python -m pytest -q tests/runs/test_loggers.py tests/training/test_sweep.py tests/training/test_ray.py \
	  tests/serve/test_serve.py tests/policies/test_export.py $(ARGS)

test-slow: export OMP_NUM_THREADS ?= 2
test-slow: $(STAMP)  ## run the tests marked slow (an hour)
	$(BIN)/python -m pytest -q -m slow --timeout 7200 $(ARGS)

coverage: $(STAMP)  ## run the tests, and list the lines that they do not reach
	OMP_NUM_THREADS=1 $(PYTEST) --cov --cov-report=term

chaos: export OMP_NUM_THREADS ?= 1
chaos: $(STAMP)  ## kill a training 100 times with each collector, and compare it with an undisturbed one (half an hour)
	$(BIN)/python tests/long/chaos.py 100 single
	$(BIN)/python tests/long/chaos.py 100 multi_sync

fuzz: $(STAMP)  ## give the commands 3,000 random bad inputs (an hour)
	$(BIN)/python tests/long/fuzz.py 3000

memory: export OMP_NUM_THREADS ?= 1
memory: $(STAMP)  ## check that a planner and two trainings do not grow in memory (an hour and a half)
	$(BIN)/python tests/long/memory.py

camera: export OMP_NUM_THREADS ?= 1
camera: $(STAMP)  ## judge plans from 2,000 bad depth images against the true scenes (half an hour)
	$(BIN)/python tests/long/camera_truth.py 2000

mutations: $(STAMP)  ## change the code at 40 random places, and see whether the tests notice (an hour; ARGS="--seed 1")
	$(BIN)/pip install --quiet --disable-pip-version-check 'cosmic-ray>=8.3,<9'
	$(BIN)/python tests/long/mutations.py $(ARGS)

bench: $(STAMP)  ## run the benchmarks on a quiet machine (up to an hour), and write docs/performance.md
	$(BIN)/pip install --quiet --disable-pip-version-check 'jumanji>=1.1,<2' || echo "jumanji cannot be installed; its part is skipped"
	for part in training environment decision answers report; do \
		$(BIN)/python benchmarks/$$part.py || exit 1; \
	done

paper: $(STAMP)  ## run the paper's comparison: train, play, draw (35 hours of one core; goes on where it was stopped; ARGS=figures only draws)
	$(BIN)/python benchmarks/paper.py $(ARGS)

docs: $(STAMP)  ## build the site of the docs, with a page of all settings, in outputs/site
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --config-file .ci/mkdocs.yml
	@echo "Open outputs/site/index.html; with its search: $(BIN)/python -m http.server --directory outputs/site"

walk:  ## run the commands of README and docs in a fresh clone with a fresh .venv (half an hour)
	$(PYTHON) tests/long/walk.py $(ARGS)

release: $(STAMP)  ## build wheel and sdist, check them, and try the wheel in its own environment; uploads nothing
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	$(PYTHON) -m venv --clear dist/.venv
	dist/.venv/bin/pip install --quiet --disable-pip-version-check dist/*.whl
	cd dist && .venv/bin/pickplace-plan --help >/dev/null && .venv/bin/pickplace-evaluate planner=joint_dbl evaluation.episodes=2 threads=1 hydra.run.dir=tried
	rm -rf dist/.venv dist/tried
	@ls -l dist

lock: $(STAMP)  ## write the installed versions to .ci/requirements.lock
	$(BIN)/pip freeze --exclude-editable | sed 's/+cpu//' > .ci/requirements.lock

audit: $(STAMP)  ## check the locked versions for known vulnerabilities (needs the internet)
	$(BIN)/pip install --quiet --disable-pip-version-check 'pip-audit>=2.7,<3'
	$(BIN)/pip-audit --requirement .ci/requirements.lock --no-deps

lint: $(STAMP)  ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)  ## fix style
	$(BIN)/ruff check --fix --exit-zero --quiet .
	$(BIN)/ruff format .
	$(BIN)/ruff check .

clean:  ## remove .venv and caches; outputs stay
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
