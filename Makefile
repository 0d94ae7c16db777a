# One entry for everything. `make` alone tells what there is.

# the first Python that is new enough; name another with `make PYTHON=/path/to/python3.12 run`
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# folder of the TRAS record
RECORDS ?= tras
# jobs of the test run
JOBS ?= 2
# folder of the blind sets, and their seed
BLIND ?= outputs/blind
SEED ?= 1
# of the rigs that probabilities are fitted to, which no proof may hold
OTHER_SEED ?= 1001
# a model of your own for the proof, and the folder of its rig
MODEL ?=
RIG ?= examples/$(MODEL)
OWN = $(abspath $(BLIND))/$(MODEL)
# what a diagnosis is compared with on the full set
BASELINES ?= parameter_refit sparse_regression white_noise_bic classifier flexible_residual

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export REASON

.DEFAULT_GOAL := help
.PHONY: help setup run rig test slow package docs docs-links docs-check notebook fuzz lint format check bench regression regression-update \
	interface chapter2 chapter3 chapter4 chapter5 chapter6 chapter7 chapter8 model-study tournament robustness coverage closing-loop network-correction tras-fit aero-fit blind blind-full blind-imperfect blind-severity calibration docs-figures lock clean

help: ## tell what each target does
	@echo 'usage: make TARGET'
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  %-18s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY) ## make .venv with the locked dependencies and trms itself (all targets do it by themselves)

$(READY): requirements.lock pyproject.toml
	@test -n '$(PYTHON)' || { echo 'trms needs Python 3.11 or newer and finds none here: install it, or name one with `make PYTHON=/path/to/python3.12 run`.' >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo 'trms needs Python 3.11 or newer, and $(PYTHON) is not: name another with `make PYTHON=/path/to/python3.12 run`.' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo 'This Python cannot make virtual environments: install its venv package (Debian, Ubuntu: `apt install python3-venv`) and try again.' >&2; exit 1; }
	@echo 'Setting up $(VENV) with the locked dependencies, once; this takes a few minutes ...'
	@$(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip install --quiet -r requirements.lock
	@$(BIN)/python -m pip install --quiet --no-deps --editable .
	@touch $(READY)

run: $(READY) ## set up and close the loop: newton_mpc follows a square (ARGS="ref=sine" changes it)
	@$(BIN)/trms run controller=newton_mpc ref=square $(ARGS)

rig: $(READY) ## a simulated rig in a process of its own, driven over UDP, watched and landed (40 s)
	@$(BIN)/python -m experiments.rig $(ARGS)

# most of these are short loops of many structures: what they wait for is the compiler
test: $(READY) ## set up and run the tests
	@TRMS_RUNS=off TRMS_CFLAGS=-O0 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal --durations 10 -m 'not slow' -q $(ARGS)

slow: $(READY) ## the long tests, but for those of `make package`
	@TRMS_RUNS=off $(BIN)/python -m pytest -n $(JOBS) --dist worksteal --durations 40 -m slow -q --ignore=tests/packaging $(ARGS)

package: $(READY) ## wheel and source distribution, built, installed under lowest and newest dependencies, used
	@$(BIN)/python -m pytest -n $(JOBS) --dist loadgroup -q -m slow tests/packaging $(ARGS)

docs: $(READY) ## build the documentation site into build/site; a broken link fails
	@$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site
	@echo 'build/site/index.html'

docs-links: $(READY) ## ask for every address outside that the documentation names (needs a network)
	@$(BIN)/python -m sphinx -q -b linkcheck docs build/links

docs-check: $(READY) ## make every table and picture of the pages anew; fails when one moved (hours; ARGS="--only chapter5", --cheap, --list, "--records DIR")
	@$(BIN)/python -m experiments.docs_check $(ARGS)

notebook: $(READY) ## execute the tour and the lessons of docs/course, and keep their outputs (ARGS=model)
	@$(BIN)/python -m docs.notebooks $(ARGS)

fuzz: $(READY) ## attack the readers of files: make fuzz TARGET=log MINUTES=10 (TARGET=all)
	@$(BIN)/python -m pip install --quiet 'atheris>=2.3'
	@OMP_NUM_THREADS=1 TRMS_RUNS=off $(BIN)/python -m tests.fuzz $(or $(TARGET),all) --minutes $(or $(MINUTES),10)

lint: $(READY) ## formatting, lint and types; code of third parties fails
	@$(BIN)/python .ci/borrowed_code.py
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy

format: $(READY) ## format the code and mend what the linter can mend
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

check: lint test regression ## all that CI checks

bench: $(VENV)/.ready-bench ## speed against peers and limits, as ratios
	@$(BIN)/python -m benchmarks $(ARGS)

$(VENV)/.ready-bench: $(READY) requirements-bench.lock
	@$(BIN)/python -m pip install --quiet -r requirements-bench.lock
	@touch $@

regression: $(READY) ## tracking errors against the baseline; fails when one got worse
	@$(BIN)/python -m experiments.regression

regression-update: $(READY) ## rewrite the baseline: make regression-update REASON="why"
	@test -n "$$REASON" || { echo 'A baseline changes with a reason: make regression-update REASON="why"' >&2; exit 2; }
	@$(BIN)/python -m experiments.regression --update --reason "$$REASON"

interface: $(READY) ## add what is new to the promised interface; stops where something promised is gone
	@$(BIN)/python -m tests.compatibility.interface

chapter2: $(READY) ## study: white-box models, rotors alone, Newtonian against Lagrangian
	@$(BIN)/python -m experiments.chapter2 $(ARGS)

chapter3: $(READY) ## study: neural networks, thirteen training algorithms, structure
	@$(BIN)/python -m experiments.chapter3 $(ARGS)

chapter4: $(READY) ## study: grey-box fits, genetic algorithm and better, white against grey
	@$(BIN)/python -m experiments.chapter4 $(ARGS)

chapter5: $(READY) ## study: equilibria, modes, phase portraits, limit cycles, Lyapunov functions, margins
	@$(BIN)/python -m experiments.chapter5 $(ARGS)

chapter6: $(READY) ## study: Newton-type MPC, its stability and its feasible set
	@$(BIN)/python -m experiments.chapter6 $(ARGS)

chapter7: $(READY) ## study: observers, output feedback, a rig with withheld parameters
	@$(BIN)/python -m experiments.chapter7 $(ARGS)

chapter8: $(READY) ## study: robust MPC by linear matrix inequalities
	@$(BIN)/python -m experiments.chapter8 $(ARGS)

model-study: $(READY) ## study: which model is best for control, on rigs of other code (RECORDS=folder of the TRAS record)
	@$(BIN)/python -m experiments.model_study --record '$(RECORDS)' $(ARGS)

tournament: $(READY) ## all controllers, observers, references and rigs crossed and ranked (20 minutes on two quiet cores)
	@$(BIN)/python -m experiments.tournament $(ARGS)

robustness: $(READY) ## study: three controllers on 200 rigs drawn from the priors, a tuned newton_mpc
	@$(BIN)/python -m experiments.robustness $(ARGS)

coverage: $(READY) ## study: do the intervals of a fit hold the truth? (half an hour)
	@$(BIN)/python -m experiments.coverage $(ARGS)

closing-loop: $(READY) ## study: rigs controlled with nominal, diagnosed and true models (a quarter of an hour)
	@$(BIN)/python -m experiments.gap $(ARGS)

network-correction: $(READY) ## study: a network beside the equations, on rigs of other code and in the loop (half an hour)
	@$(BIN)/python -m experiments.gap.network_correction $(ARGS)

tras-fit: $(READY) ## study: a fit to the real TRAS (RECORDS=folder with closed_loop.csv)
	@$(BIN)/python -m experiments.tras '$(RECORDS)' $(ARGS)

blind: $(READY) ## proof, small: 24 sealed rigs made, diagnosed and judged (ARGS="effort=quick" is faster); MODEL=servo_drive: 96 rigs drawn from that model, in examples/ or RIG=FOLDER
ifneq ($(MODEL),)
	@cd '$(RIG)' && export TRMS_ALLOW='$(MODEL)' && trms='$(abspath $(BIN))/trms' && \
		{ test -f '$(OWN)/commitment.json' || $$trms blind make model=$(MODEL) data=$(MODEL) seed=$(SEED) fresh=0 out='$(OWN)'; } && \
		$$trms blind run in='$(OWN)' out='$(OWN).found' $(ARGS) && \
		$$trms blind score in='$(OWN)' diagnoses='$(OWN).found'
else
	@test -f $(BLIND)/small/commitment.json || $(BIN)/trms blind make set=small seed=$(SEED) out=$(BLIND)/small
	@$(BIN)/trms blind run in=$(BLIND)/small out=$(BLIND)/small.found $(ARGS)
	@$(BIN)/trms blind score in=$(BLIND)/small diagnoses=$(BLIND)/small.found
endif

blind-full: $(READY) ## proof, whole: 300 sealed rigs, with baselines; hours, and called again it goes on
	@test -f $(BLIND)/final/commitment.json || $(BIN)/trms blind make set=final seed=$(SEED) out=$(BLIND)/final
	@$(BIN)/trms blind run in=$(BLIND)/final out=$(BLIND)/final.found $(ARGS)
	@for method in $(BASELINES); do $(BIN)/python -m experiments.gap.baselines method=$$method in=$(BLIND)/final out=$(BLIND)/final.$$method || exit; done
	@for method in oracle true_values; do $(BIN)/python -m experiments.gap.baselines method=$$method key=$(BLIND)/final.key in=$(BLIND)/final out=$(BLIND)/final.$$method || exit; done
	@$(BIN)/trms blind score in=$(BLIND)/final oracle=oracle "diagnoses=[trms=$(BLIND)/final.found,$(foreach method,$(BASELINES),$(method)=$(BLIND)/final.$(method),)oracle=$(BLIND)/final.oracle,true_values=$(BLIND)/final.true_values]"

blind-severity: $(READY) ## how large effects have to be for gaps of 1.3, 2 and 4 times the floor (ten minutes)
	@$(BIN)/python -m experiments.gap.blind.severity

blind-imperfect: $(READY) ## proof on 180 rigs whose laws are others than the model's; hours, and called again it goes on
	@for set in imperfect imperfect_curves; do \
		test -f $(BLIND)/$$set/commitment.json || $(BIN)/trms blind make set=$$set seed=$(SEED) out=$(BLIND)/$$set || exit; \
		$(BIN)/trms blind run in=$(BLIND)/$$set out=$(BLIND)/$$set.found $(ARGS) || exit; \
		$(BIN)/trms blind score in=$(BLIND)/$$set diagnoses=$(BLIND)/$$set.found || exit; \
	done

calibration: $(READY) ## features of 1000 simulated rigs, and how far probabilities can be trusted; hours, and called again it goes on; MODEL=my_rig: probabilities for that model, from 120 rigs
ifneq ($(MODEL),)
	@cd '$(RIG)' && export TRMS_ALLOW='$(MODEL)' && trms='$(abspath $(BIN))/trms' && \
		{ test -f '$(OWN).calibration/commitment.json' || $$trms blind make model=$(MODEL) data=$(MODEL) seed=$(OTHER_SEED) cases=120 fresh=0 out='$(OWN).calibration'; } && \
		$$trms blind run in='$(OWN).calibration' out='$(OWN).calibration.found' 'with=["advise=false"]' $(ARGS)
	@$(BIN)/python -m experiments.gap.calibrate --any-rig --blind '$(OWN).calibration.key' '$(OWN).calibration.found' --out '$(RIG)/configs/calibration/$(MODEL).json'
else
	@$(BIN)/python -m experiments.gap.simulate $(BLIND)/calibration --seed $(SEED) $(ARGS)
	@$(BIN)/python -m experiments.gap.calibrate $(BLIND)/calibration
endif

aero-fit: $(READY) ## study: the normal state of a real Quanser Aero (RECORDS=folder with nominal_a.csv)
	@$(BIN)/python -m experiments.aero '$(RECORDS)' $(ARGS)

docs-figures: $(READY) ## draw the figures of docs/ with the program itself
	@$(BIN)/python -m docs.figures

lock: $(READY) ## renew the locked versions from pyproject.toml
	@$(BIN)/python -m pip install --quiet uv
	@UV_CUSTOM_COMPILE_COMMAND='make lock' $(BIN)/uv pip compile --quiet --upgrade --universal --fork-strategy fewest --python-version 3.11 --no-emit-index-url --no-emit-find-links --extra dev pyproject.toml -o requirements.lock
	@UV_CUSTOM_COMPILE_COMMAND='make lock' $(BIN)/uv pip compile --quiet --upgrade --universal --fork-strategy fewest --python-version 3.11 --no-emit-index-url --no-emit-find-links --extra bench -c requirements.lock pyproject.toml -o requirements-bench.lock

clean: ## remove the virtual environment and caches, never outputs/
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
