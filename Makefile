# setup · demo · test · check · bench · results · proto · docs · dist: each brings the environment up to date first, which costs nothing when it is.

PYTHON ?= python3
# Any pip requirement, also with options: TORCH="torch==2.13.0 --index-url …" for a build without CUDA.
TORCH ?= torch==2.13.0

# Interpreters that make dist installs the wheel for; those that are not there are left out. Of pyenv, name the versions:
# PYENV_VERSION=3.11.7:3.12.1:3.13.0 make dist
PYTHONS ?= python3.11 python3.12 python3.13

BIN := .venv/bin
READY := .venv/.ready
PROTOS := $(shell cd proto && find curio_proto -name '*.proto' | sort)
PROTOC := $(BIN)/python -m grpc_tools.protoc -Iproto
# Those that need no argument, no container engine and no photographs of others, and end within the hour.
BENCHMARKS := $(addprefix benchmarks/,detection.py image.py own_part.py serving.py video.py closed_form/landscape.py closed_form/validation_experiment.py \
	closed_form/watching.py paper/basins.py pictures/viewing.py rendering/renderer.py rendering/renderer_faces.py rendering/renderer_profile.py rendering/training.py)

# Every recipe is one bash script that stops at the first failure.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.PHONY: setup demo test check bench results proto docs dist

setup: $(READY)

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
		echo "setup: found $$($(PYTHON) --version 2>&1), need Python 3.11 or newer: make setup PYTHON=python3.11" >&2; exit 1; }
	# Dr.Jit loads the newest libLLVM of the system and aborts the whole process where that is older than 17.
	usable_llvm() { [[ -n "$${DRJIT_LIBLLVM_PATH:-}" ]] ||
		compgen -G '/usr/lib/*-linux-gnu/libLLVM*.so.*' | grep -E 'libLLVM(-|\.so\.)(1[7-9]|[2-9][0-9])' > /dev/null; }
	if ! usable_llvm; then
		echo "setup: installing libllvm19, which the renderer compiles its kernels with"
		apt="env DEBIAN_FRONTEND=noninteractive apt-get -qq"; (( EUID == 0 )) || apt="sudo -n $$apt"
		{ $$apt update && $$apt install -y --no-install-recommends libllvm19 > /dev/null && usable_llvm; } || {
			echo "setup: no libLLVM of version 17 or newer, and it could not be installed from here. Type" >&2
			echo "    sudo apt-get update && sudo apt-get install -y libllvm19" >&2
			echo "or set DRJIT_LIBLLVM_PATH to a libLLVM.so of that age, then run make again." >&2; exit 1; }
	fi
	echo "setup: installing into .venv (a few minutes the first time)"
	[[ -x $(BIN)/pip ]] || $(PYTHON) -m venv .venv || {
		echo "setup: python's venv module is missing or incomplete: sudo apt-get install -y python3-venv, then run make again." >&2; exit 1; }
	# torch first and then held fast: an open requirement would pull the newest CUDA build.
	$(BIN)/pip install --quiet $(TORCH)
	$(BIN)/pip freeze --quiet | grep -E '^torch[ =]' > .venv/torch.txt
	$(BIN)/pip install --quiet --constraint .venv/torch.txt --editable '.[train,capture,view,usd,rerun,cad,robots,cloud,hub,dev]'
	touch $@

demo: $(READY)
	@$(BIN)/python benchmarks/demo.py

# Two processes of one thread each: the tests train tiny networks beside the renderer's own threads, which waiting threads
# would only slow down. They start hundreds of processes, each of which would compile the sources anew where the
# environment forbids to write compiled ones.
test: $(READY)
	@PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(BIN)/pytest -n 2 --dist loadfile

check: $(READY)
	@$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	# Serving runs on other systems, too: a name that only POSIX has is an error here.
	for system in win32 darwin; do $(BIN)/mypy --package curio_serve --platform $$system; done
	$(BIN)/lint-imports
	fresh=$$(mktemp -d); trap 'rm -r "$$fresh"' EXIT
	$(PROTOC) --python_out="$$fresh" --pyi_out="$$fresh" --grpc_python_out="$$fresh" $(PROTOS)
	$(BIN)/pytest -q tests/contract/test_docs.py
	diff -r -x '*.proto' -x __init__.py -x __pycache__ "$$fresh/curio_proto" proto/curio_proto || {
		echo "check: the generated code above is not what the .proto files give: make proto, then commit" >&2; exit 1; }

proto: $(READY)
	@$(PROTOC) --python_out=proto --pyi_out=proto --grpc_python_out=proto $(PROTOS)

# One script a figure; the last line of each is its result.
bench: $(READY)
	@for script in $(BENCHMARKS); do
		name=$$(basename "$$script" .py)
		echo "bench: $$name" >&2
		$(BIN)/python "$$script" --json | tee /dev/stderr | tail -n 1 > "docs/results/$$name.json"
	done

# Tables 2 and 3, hours in all; goes on where it stopped. One world: make results ONLY=circles; other flags in FLAGS.
results: $(READY)
	@$(BIN)/python benchmarks/results.py $(if $(ONLY),--only $(ONLY)) $(FLAGS)

# The documentation as a site with API pages, in build/site. Dead links are found by tests/contract/test_docs.py.
docs: $(READY)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	echo "docs: build/site/index.html"

# Source distribution and wheel in dist/, the wheel built from the former; checked, then installed afresh and tried.
dist: $(READY)
	@rm -rf dist
	$(BIN)/python -m build --outdir dist . > /dev/null
	$(BIN)/twine check --strict dist/*
	fresh=$$(mktemp -d); trap 'rm -r "$$fresh"' EXIT
	for python in $(PYTHONS); do
		"$$python" -c "" 2> /dev/null || { echo "dist: $$python is not here, so the wheel was not tried with it"; continue; }
		"$$python" -m venv --clear "$$fresh/venv"
		"$$fresh/venv/bin/pip" install --quiet dist/*.whl
		"$$fresh/venv/bin/pip" check
		"$$fresh/venv/bin/curio-serve" --help > /dev/null
		"$$fresh/venv/bin/curio-detect" models/ape samples/ --camera samples/camera.json --out "$$fresh/poses.jsonl" --overwrite
		echo "dist: $$("$$python" --version): installed and tried, $$("$$fresh/venv/bin/pip" list 2> /dev/null | tail -n +3 | wc -l) packages and $$(du -sm "$$fresh/venv" | cut -f1) MiB, pip among them"
	done
