# make train and make test do everything on a fresh machine: they create .venv and install into it.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
RUN ?= outputs/quick_$(shell date +%Y-%m-%d_%H-%M-%S)
ARGS ?=
PYTEST := $(BIN)/python -m pytest -q -n logical --maxprocesses 4 --dist worksteal

.PHONY: help install demo train test test-slow test-extras coverage chaos fuzz memory bench reproduce results docs walk release lock audit lint format clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(STAMP)  ## create .venv and install the package and what the tests need (LOCK=.ci/requirements.lock: these versions)

$(STAMP): pyproject.toml $(LOCK)
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check $(if $(LOCK),-c $(LOCK)) -e '.[dev]'
	@touch $@

demo: $(STAMP)  ## pack totes with the weights that come along, and show it in a browser
	$(BIN)/pickplace-evaluate checkpoint=pretrained/r4 evaluation.episodes=20 hydra.run.dir=outputs/demo $(ARGS)
	@echo "Open outputs/demo/replay.html in a browser."

train: RUN_DIR := $(RUN)
train: $(STAMP)  ## train (experiment=quick; ARGS="key=value ..." adds overrides), evaluate, and show a packed tote
	$(BIN)/pickplace-train experiment=quick hydra.run.dir=$(RUN_DIR) $(ARGS)
	$(BIN)/pickplace-evaluate checkpoint=$(RUN_DIR) hydra.run.dir=$(RUN_DIR)/evaluation
	@printf '\n%s\n' "Run folder $(RUN_DIR):"
	@printf '  %-32s%s\n' \
	  checkpoints/best 'the policy, for pickplace-evaluate checkpoint=$(RUN_DIR)' \
	  metrics.csv 'every metric over frames' \
	  learning_curve.png 'occupancy and tote height over frames' \
	  report.html 'the whole run on one page: curves, tables, best and worst episode' \
	  evaluation/evaluation.md 'the table above; evaluation.json has every episode' \
	  evaluation/tote.png 'a packed tote' \
	  evaluation/replay.html 'how it was packed, in 3D'

test: export OMP_NUM_THREADS ?= 1
test: $(STAMP)  ## run the test suite (minutes), in as many processes as there are cores, at most 4
	$(PYTEST) $(ARGS)

test-extras: export OMP_NUM_THREADS ?= 1
test-extras: $(STAMP)  ## install every optional extra (a gigabyte), and run the tests that need them
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev,wandb,mlflow,optuna,joblib,submitit,ray]'
	$(BIN)/python -m pytest -q tests/runs/test_loggers.py tests/training/test_sweep.py tests/training/test_ray.py $(ARGS)

test-slow: export OMP_NUM_THREADS ?= 2
test-slow: $(STAMP)  ## run the long checks (an hour)
	$(BIN)/python -m pytest -q -m slow --timeout 7200 $(ARGS)

coverage: $(STAMP)  ## run the test suite, and tell which lines it never reaches
	OMP_NUM_THREADS=1 $(PYTEST) --cov --cov-report=term

chaos: $(STAMP)  ## kill trainings a hundred times with either collector, and compare how they end (half an hour)
	$(BIN)/python tests/chaos.py 100 single
	$(BIN)/python tests/chaos.py 100 multi_sync

fuzz: $(STAMP)  ## feed the planner with damaged requests (an hour)
	$(BIN)/python tests/fuzz.py 60

memory: $(STAMP)  ## watch the memory of a planner and of two trainings (an hour and a half)
	OMP_NUM_THREADS=1 $(BIN)/python tests/memory.py

bench: $(STAMP)  ## run the benchmarks on a quiet machine (half an hour), and write docs/performance.md
	$(BIN)/pip install --quiet --disable-pip-version-check 'jumanji>=1.1,<2' || echo "jumanji: not to be had, its part is skipped"
	$(BIN)/pip install --quiet --disable-pip-version-check 'sb3-contrib>=2.3,<3' || echo "sb3-contrib: not to be had, its part is skipped"
	for part in learning training workers environment collector conv4d decision startup report; do \
		$(BIN)/python benchmarks/$$part.py || exit 1; \
	done

reproduce: $(STAMP)  ## compute what is missing of the paper's comparison (days; ARGS="--figure candidates --jobs 2")
	$(BIN)/pip install --quiet --disable-pip-version-check 'py3dbp>=1.1,<2' 'rectpack>=0.2,<1' || echo "placement-only packers: not to be had"
	$(BIN)/python benchmarks/reproduce/run.py $(ARGS)
	$(BIN)/python benchmarks/reproduce/results.py

results: $(STAMP)  ## draw the comparison's figures, and write docs/results.md
	$(BIN)/python benchmarks/reproduce/results.py

docs: $(STAMP)  ## write docs/reference.md, and build the site of docs/ in outputs/site
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[docs]'
	$(BIN)/python docs/reference.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --config-file .ci/mkdocs.yml
	@echo "Open outputs/site/index.html; with its search: $(BIN)/python -m http.server --directory outputs/site"

walk:  ## follow README and docs in a fresh clone and a fresh virtual environment, as a newcomer would (half an hour)
	$(PYTHON) tests/walk.py $(ARGS)

release: $(STAMP)  ## build wheel and sdist, check them, and try the wheel in an environment of its own; uploads nothing
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	$(PYTHON) -m venv --clear dist/.venv
	dist/.venv/bin/pip install --quiet --disable-pip-version-check dist/*.whl
	cd dist && .venv/bin/pickplace-plan --help >/dev/null && .venv/bin/pickplace-evaluate planner=joint_dbl evaluation.episodes=2 threads=1 hydra.run.dir=tried
	rm -rf dist/.venv dist/tried
	@ls -l dist

lock: $(STAMP)  ## write down the versions that are installed, for make install LOCK=.ci/requirements.lock
	$(BIN)/pip freeze --exclude-editable | sed 's/+cpu//' > .ci/requirements.lock

audit: $(STAMP)  ## look the locked versions up in the database of known vulnerabilities (needs the internet)
	$(BIN)/pip install --quiet --disable-pip-version-check 'pip-audit>=2.7,<3'
	$(BIN)/pip-audit --requirement .ci/requirements.lock --no-deps

lint: $(STAMP)  ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)  ## mend style
	$(BIN)/ruff check --fix --exit-zero --quiet .
	$(BIN)/ruff format .
	$(BIN)/ruff check .

clean:  ## remove .venv and caches; outputs stay
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
