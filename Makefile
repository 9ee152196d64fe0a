# make latents TASK=hanoi        episode logs -> cached VQGAN latents, everything before it included
# make rollout TASK=pusht LOGS=… … -> planner and low-level policy -> VILP in the simulator, everything before it included
# make policy TASK=pusht SET=small … the low-level policy (bc, rollout too) learns from an action set's episodes alone
# make compare TASK=… dream …     do off-target labels help, with intervals; real beside imagined episodes as one page
# make test                      lint, types, import rules, tests
#
# TASK    a task in pipelines/: arrange_blocks, can, hanoi, move_the_stack, nut_assembly, pusht      PRESET  tiny | cpu | paper
# SET     an action set: small, hybrid, off_target, or a recipe TOML; without, all training episodes with actions give labels
# LOGS    your own logs (files or folders) instead of recorded ones
# SEEDS   which starts a rollout has, FIRST:END   TORCH   what pip installs as torch
# DATA    the dataset folder

TASK   ?= hanoi
PRESET ?= cpu
LOGS   ?=
SET    ?=
DATA   ?= data/$(TASK)$(if $(filter tiny,$(PRESET)),-tiny)
TORCH  ?= torch==2.13.0
PYTHON ?= python3

BIN   := .venv/bin
READY := .venv/.ready
RUN   := $(DATA)/runs/vqgan-$(PRESET)
MODEL := --data $(DATA) --task $(TASK) --preset $(PRESET)
SEEDS ?= $(if $(filter tiny,$(PRESET)),0:2,0:50)
LOGS_IN := $(if $(LOGS),$(LOGS),$(DATA)/logs)
LABELS := $(if $(SET),--set $(basename $(notdir $(SET))))
SECONDS ?= 120
SUDO  := $(if $(filter 0,$(shell id -u)),,$(shell command -v sudo >/dev/null && echo sudo -n))

export MUJOCO_GL ?= osmesa

.PHONY: setup record ingest split vqgan latents actions planner policy bc generate dream rollout compare view replay test test-slow fuzz lint bench docs clean help

help:
	@sed -n '1,12p' Makefile

# --- set-up ----------------------------------------------------------------------------------------------------------

setup: $(READY)

$(READY): pyproject.toml constraints.txt bootstrap.sh
	PYTHON='$(PYTHON)' TORCH='$(TORCH)' SUDO='$(SUDO)' sh bootstrap.sh
	@touch $@

# --- the walk of an episode; each step skips what is fresh -----------------------------------------------------------

record: $(READY)
	@$(if $(LOGS),echo "record: using LOGS=$(LOGS)",$(BIN)/vilp-data record --task $(TASK) --preset $(PRESET) --out $(DATA)/logs)

ingest: record
	@$(BIN)/vilp-data ingest $(LOGS_IN) --task $(TASK) --preset $(PRESET) --into $(DATA) || [ $$? -eq 1 ]  # 1: some logs could not be read; it says which

split: ingest
	@$(BIN)/vilp-data split $(DATA)

vqgan: split
	@$(BIN)/vilp-models train vqgan --data $(DATA) --task $(TASK) --preset $(PRESET)

latents: vqgan
	@$(BIN)/vilp-data latents $(DATA) --run $(RUN)
	@$(BIN)/vilp-models evaluate vqgan --data $(DATA) --run $(RUN) || [ $$? -eq 1 ]  # 1: it warns, in words

planner: latents
	@$(BIN)/vilp-models train planner $(MODEL)
	@$(BIN)/vilp-models evaluate planner $(MODEL) $(if $(filter tiny,$(PRESET)),--starts 4 --samples 2) || [ $$? -eq 1 ]

# which episodes give action labels; what is locked stays
actions: split
	@$(if $(SET),$(BIN)/vilp-data actions --recipe $(SET) --preset $(PRESET) --data $(DATA),echo "actions: SET=small, hybrid, off_target or a recipe TOML"; exit 2)

policy: latents $(if $(SET),actions)
	@$(BIN)/vilp-models train policy $(MODEL) $(LABELS)
	@$(BIN)/vilp-models evaluate policy $(MODEL) $(LABELS) || [ $$? -eq 1 ]

bc: split $(if $(SET),actions)
	@$(BIN)/vilp-models train bc $(MODEL) $(LABELS)

generate: planner
	@$(BIN)/vilp-models generate $(MODEL)

# whole held-out episodes as VILP would act on them, real beside imagined, on one page
dream: planner policy
	@$(BIN)/vilp-models generate $(MODEL) $(LABELS) --whole
	@$(BIN)/vilp-data view --generated planner-$(PRESET)$(if $(SET),-$(basename $(notdir $(SET)))) --data $(DATA) --html $(DATA)/dream.html

rollout: planner policy
	@$(BIN)/vilp-models rollout $(MODEL) --policy stay --seeds $(SEEDS) --no-logs
	@$(BIN)/vilp-models rollout $(MODEL) $(LABELS) --policy vilp --seeds $(SEEDS)

# do off-target labels help? three seeds of each model on both sets: hours, and it goes on where it stopped
compare: planner
	@for set in small hybrid; do $(BIN)/vilp-data actions --recipe $$set --preset $(PRESET) --data $(DATA) || exit 1; done
	@$(BIN)/vilp-models compare $(MODEL) --sets small,hybrid --seeds $(SEEDS)

# the newest log there is, of a policy or of the recorder; without any, the first ingested episode
view: $(READY)
	@log=$$(ls -t $(DATA)/rollouts/*/logs/*.mcap $(DATA)/logs/*.mcap 2>/dev/null | head -1); \
	episode=$$(ls $(DATA)/episodes/steps 2>/dev/null | head -1); \
	if [ -n "$$log" ]; then $(BIN)/vilp-data view "$$log" --task $(TASK); \
	else $(BIN)/vilp-data view "$${episode%.safetensors}" --data $(DATA); fi

replay: ingest
	@$(BIN)/vilp-models rollout --data $(DATA) --policy replay --episodes 3

# --- the project -----------------------------------------------------------------------------------------------------

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(BIN)/pytest

test-slow: $(READY)
	$(BIN)/pytest -m slow

fuzz: $(READY)
	@bad=0; for source in $$($(BIN)/python -c 'from tests.fuzz.seeds import SEEDS; print(*SEEDS)'); do \
	$(BIN)/python -m tests.fuzz.fuzz $$source --seconds $(SECONDS) --keep .fuzz || bad=1; done; exit $$bad

bench: $(READY)
	@for bench in benchmarks/bench_*.py; do echo "== $$bench"; PYTHONPATH=. $(BIN)/python $$bench || exit 1; done

docs: $(READY)
	$(BIN)/python docs/make_cli_reference.py

clean:
	rm -rf build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
