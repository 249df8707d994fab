# Bare `make` installs the package, with all that the other targets need, into .venv; `make help` lists them.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := .venv
.PHONY: .venv gl screens demo test test-all test-oldest check docs dist bench mutation notebooks clean help

# $(call pip_install,PYTHON,ARGUMENTS) installs into the virtual environment of a Python. Without an NVIDIA GPU it takes
# torch's build for the CPU, if its index can be reached: the default one brings gigabytes of CUDA libraries.
CPU_TORCH := https://download.pytorch.org/whl/cpu/
define pip_install
	index=
	if ! command -v nvidia-smi >/dev/null && \
		$(1) -c 'import urllib.request; urllib.request.urlopen("$(CPU_TORCH)", timeout=10)' 2>/dev/null; then
		index=--extra-index-url=$(CPU_TORCH)
	fi
	$(1) -m pip install -q --disable-pip-version-check $$index $(2)
endef

# The first Python that runs and is 3.11 or 3.12. Finding its name is not enough: pyenv puts a name
# on the PATH for every version it has, and those that are not active only print an error.
SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))
PYTHON ?= $(shell for python in python3 python3.12 python3.11; do \
	$$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)

export MUJOCO_GL ?= egl
RUN := .venv/bin/python -m
PYTEST_ARGS ?=
MUTATION_ARGS ?=

# $(call apt_install,PACKAGES) installs them as root on Debian and Ubuntu and stops elsewhere: the sentence
# printed before it has named them. On a machine that has just booted, apt is often busy updating it: wait.
define apt_install
	if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then exit 1; fi
	echo "Installing $(1)"
	exec 8<>Makefile  # only to lock it: of two at a time, apt refuses the second
	flock 8
	export DEBIAN_FRONTEND=noninteractive
	apt-get update -qq || true
	apt-get install -y -qq --no-install-recommends -o DPkg::Lock::Timeout=300 $(1) >/dev/null
endef

.venv: .venv/.installed  ## install into .venv, the default (with another Python: make clean, then make PYTHON=python3.12)

# pip, killed half-way, can leave packages that look complete. So .venv carries the mark `.unfinished` from before
# its creation until the end, where it becomes the stamp; a .venv found with the mark is made anew.
.venv/.installed: setup.cfg pyproject.toml constraints.txt
	@exec 9<>constraints.txt  # only to lock it: a second make at the same time waits here
	flock 9
	if [ -z "$$(find $^ -newer $@ 2>&1)" ]; then exit; fi  # and finds that the first has done the work
	if [ -e .venv/.unfinished ] || ! .venv/bin/python -c 'import pip; $(SUPPORTED)' 2>/dev/null; then
		rm -rf .venv
		python="$(PYTHON)"
		if ! "$$python" -c '$(SUPPORTED)' 2>/dev/null; then
			echo "sb3_cure needs a Python 3.11 or 3.12 that runs; name one: make PYTHON=/path/to/python3.12" >&2
			exit 1
		fi
		if ! "$$python" -c 'import ensurepip' 2>/dev/null; then
			package=$$("$$python" -c 'import sys; print("python{}.{}-venv".format(*sys.version_info))')
			echo "$$python cannot make virtual environments; on Debian and Ubuntu this needs: apt-get install $$package" >&2
			$(call apt_install,$$package)
		fi
		mkdir .venv
		touch .venv/.unfinished
		"$$python" -m venv .venv
	fi
	rm -f $@
	touch .venv/.unfinished
	echo "Installing sb3_cure into .venv (some minutes the first time) ..."
	$(call pip_install,.venv/bin/python,-c constraints.txt -e '.[dev]')
	mv .venv/.unfinished $@

# Prints the OpenGL renderer in use, or one sentence about what is missing.
gl: .venv/.installed
	@if ! $(RUN) sb3_cure.envs; then
		$(call apt_install,libegl1 libopengl0 libgl1-mesa-dri)
		$(RUN) sb3_cure.envs
	fi

# A browser that opens the report as its readers do, and a display for windows; without them those tests are skipped.
screens:
	@if ! { command -v chromium && command -v Xvfb; } >/dev/null; then $(call apt_install,chromium xvfb); fi

demo: gl  ## train on cartpole-swingup from pixels and write demo/ (about ten minutes on two cores)
	$(RUN) sb3_cure.experiments.demo --out demo

test: gl  ## run the tests in two processes (options for pytest: make test PYTEST_ARGS="-x -k buffer")
	$(RUN) pytest -n 2 --dist worksteal $(PYTEST_ARGS)

test-all: export SB3_CURE_TEST_ALL := 1
test-all: test  ## the same, with all combinations of algorithms, heads, rewards and sensors, and with long tests

# What runs with the lowest versions of setup.cfg's ranges and without the extras: parity with SB3, SB3's habits, the
# replay buffer, CuRe's own arguments, and the pixels of dm_control.
SMOKE := tests/cure/test_update_equals_sb3.py tests/cure/test_compatibility.py tests/data/test_buffers.py \
	tests/cure/test_arguments.py tests/envs/test_envs.py::test_frames_and_rewards_are_those_of_dm_control

.venv-oldest/.installed: .venv/.installed setup.cfg constraints-oldest.txt
	@rm -rf .venv-oldest
	$(RUN) venv .venv-oldest
	echo "Installing the oldest supported versions into .venv-oldest ..."
	$(call pip_install,.venv-oldest/bin/python,-c constraints-oldest.txt -e . pytest hypothesis)
	touch $@

test-oldest: gl .venv-oldest/.installed  ## run some tests with the oldest versions that are supported (.venv-oldest)
	.venv-oldest/bin/python -m pytest $(PYTEST_ARGS) $(SMOKE)

check: .venv/.installed  ## lint, formatting and types
	$(RUN) ruff check
	$(RUN) ruff format --check
	$(RUN) mypy

docs: .venv/.installed  ## build the documentation site, docs/_build/html/index.html (warnings are errors)
	$(RUN) sphinx -q -W --keep-going docs docs/_build/html

dist: .venv/.installed  ## build and check the wheel and the source archive, into dist/
	rm -rf build dist *.egg-info
	$(RUN) build --no-isolation
	$(RUN) twine check --strict dist/*

bench: gl  ## measure speed and memory and write results/benchmarks/ (an hour and more; leave the machine alone)
	$(RUN) benchmarks

mutation: gl  ## mutation testing of the method, into results/robustness/ (hours; make mutation MUTATION_ARGS="--jobs 8")
	$(RUN) benchmarks.mutation $(MUTATION_ARGS)

notebooks: gl  ## execute the notebooks in place
	$(RUN) nbconvert --to notebook --execute --inplace notebooks/*.ipynb

clean:  ## remove .venv, caches and build products
	rm -rf .venv .venv-oldest build dist docs/_build docs/notebooks docs/results *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

help:  ## list the targets
	@sed -nE 's/^([a-z.-]+):[^#]*##/\1:/p' Makefile
