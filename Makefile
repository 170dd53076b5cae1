# Every target that needs Python first creates the virtual environment below, if it does not exist.
PYTHON ?= python3
VENV ?= .venv
OLDEST ?= .venv-oldest
JOBS ?= 2
EXTRAS ?= zoo,postgres,ray,hub,export,tests,plots,mujoco,docs,dev
HTML ?= docs/_build/html

BIN := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
PY := $(VENV)/$(BIN)/python
STAMP := $(VENV)/.installed

# The names of targets are not files: docs/ exists, but the target docs must not count as "up to date".
.PHONY: help venv demo test test-slow test-oldest mutants soak lint type format docs pictures bench reproduce reproduce-lava reproduce-ball reproduce-ball-controls reproduce-ball-paper reproduce-ball-varying reproduce-grasp reproduce-grasp-camera reproduce-pays reproduce-pays-controls reproduce-panda-squeeze records wheel release-check clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' Makefile | sed -E 's/^([a-z-]+):.*## /\1|/' | awk -F'|' '{ printf "  %-24s %s\n", $$1, $$2 }'
	@echo "Variables: PYTHON=$(PYTHON) VENV=$(VENV) JOBS=$(JOBS) EXTRAS=$(EXTRAS)"

venv: $(STAMP) ## create the virtual environment (every target that needs Python does so)

$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "PYTHON=$(PYTHON) is missing or older than 3.10: install Python 3.10 or later, or choose one with 'make PYTHON=python3.11 ...'." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "$(PYTHON) cannot make virtual environments: install its venv module (Debian, Ubuntu: 'apt install python3-venv')." >&2; exit 1; }
	@echo "Installing into $(VENV); PyTorch is large, so the first time takes a few minutes."
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

demo: $(STAMP) ## train TDPG and policy gradient on the lava problem, and compare them in results/lava
	$(PY) -m sb3_tdpg demo --out results/lava

# One thread per worker: the networks are small, and the workers already use all cores.
test: $(STAMP) ## run all tests except the slow ones
	OMP_NUM_THREADS=1 $(PY) -m pytest -m "not slow" -n $(JOBS) --dist loadfile

test-slow: $(STAMP) ## run the slow tests
	OMP_NUM_THREADS=1 $(PY) -m pytest -m slow -n $(JOBS) --dist worksteal

test-oldest: $(OLDEST)/.installed ## run the tests with the lowest versions that setup.cfg allows
	OMP_NUM_THREADS=1 $(OLDEST)/$(BIN)/python -m pytest -m "not slow" -n $(JOBS) --dist loadfile

# The extra "hub" is left out, because rl-zoo3 2.8 needs an older huggingface_hub.
$(OLDEST)/.installed: setup.cfg constraints.txt constraints-oldest.txt
	mkdir -p build
	grep -v -i -E "^($$(sed -n 's/[=<].*//p' constraints-oldest.txt | paste -s -d '|' -))==" constraints.txt > build/constraints-oldest.txt
	cat constraints-oldest.txt >> build/constraints-oldest.txt
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/$(BIN)/python -m pip install --disable-pip-version-check -c build/constraints-oldest.txt -e '.[zoo,postgres,tests,plots]'
	@touch $@

mutants: $(STAMP) ## make small changes to the code and count the changes that the tests detect (an hour)
	$(PY) tests/mutants.py

soak: $(STAMP) ## test for leaks, and with killed trainings and killed workers (ten minutes)
	$(PY) tests/soak.py

lint: $(STAMP) ## check style and format
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

type: $(STAMP) ## check the types
	$(PY) tests/check_types.py

format: $(STAMP) ## correct style and format in place
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: $(STAMP) ## build the documentation into docs/_build/html
	$(PY) -m sphinx -W --keep-going -b html docs $(HTML)

pictures: $(STAMP) ## draw the pictures of the documentation (PICTURES="lava.gif when.png" draws only these)
	$(PY) docs/make_pictures.py $(PICTURES)

bench: $(STAMP) ## measure the speed of the environments, the critics and an epoch
	$(PY) tests/benchmarks/run.py

reproduce: reproduce-lava reproduce-ball-controls reproduce-ball-paper reproduce-ball-varying reproduce-grasp reproduce-grasp-camera reproduce-pays reproduce-pays-controls reproduce-panda-squeeze ## reproduce every experiment (days)

reproduce-lava: $(STAMP) ## reproduce the lava problem's figures and table
	$(PY) -m sb3_tdpg reproduce lava --out results/lava_reproduction --publish docs/results/lava

reproduce-ball: $(STAMP) ## reproduce Table II: TDPG, policy gradient and RecurrentPPO on ball catching
	$(PY) -m sb3_tdpg reproduce ball --no-controls --out results/ball_catch --publish docs/results/ball_catch

reproduce-ball-controls: $(STAMP) ## add ablations, PPO, and RecurrentPPO with our encoder to Table II
	$(PY) -m sb3_tdpg reproduce ball --out results/ball_catch --publish docs/results/ball_catch

reproduce-ball-paper: $(STAMP) ## reproduce Table II with the paper's own algorithm, starting from policy gradient
	$(PY) -m sb3_tdpg reproduce ball-paper --out results/ball_catch_paper --publish docs/results/ball_catch_paper

reproduce-ball-varying: $(STAMP) ## run the ball-catching experiment with a varying launch (not in the paper)
	$(PY) -m sb3_tdpg reproduce ball-varying --out results/ball_catch_varying --publish docs/results/ball_catch_varying

reproduce-grasp: $(STAMP) ## reproduce Table III: policy gradient, TDPG and its ablation on grasping
	$(PY) -m sb3_tdpg reproduce grasp --out results/panda_grasp --publish docs/results/panda_grasp

reproduce-grasp-camera: $(STAMP) ## run the grasping experiment with a varying camera height (not in the paper)
	$(PY) -m sb3_tdpg reproduce grasp-camera --out results/panda_grasp_camera --publish docs/results/panda_grasp_camera

reproduce-pays: $(STAMP) ## test TDPG and baselines on squeeze, cue, peg and lava under undeclared faults
	$(PY) -m sb3_tdpg reproduce pays --no-controls --out results/pays --publish docs/results/pays
	$(PY) -m sb3_tdpg reproduce pays-cue --out results/pays_cue --publish docs/results/pays_cue

reproduce-pays-controls: $(STAMP) ## add PPO and RecurrentPPO, also trained with noise and with the faults
	$(PY) -m sb3_tdpg reproduce pays --out results/pays --publish docs/results/pays

reproduce-panda-squeeze: $(STAMP) ## test policies of the batched model on the Panda in PyBullet under sensor faults
	$(PY) -m sb3_tdpg reproduce panda-squeeze --n-seeds 5 --out results/panda_squeeze --publish docs/results/panda_squeeze

records: $(STAMP) ## check the records of single episodes and pack them for a release
	$(PY) docs/make_records.py

wheel: $(STAMP) ## build the wheel into dist/
	@rm -rf build/lib
	$(PY) -m pip wheel --no-deps --wheel-dir dist .

release-check: $(STAMP) ## build wheel and sdist in dist/, and test each in a new environment
	$(PY) tests/release_check.py $(if $(BORROW),--borrow)

clean: ## remove build files, but keep results and the virtual environment
	rm -rf build dist docs/_build *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
