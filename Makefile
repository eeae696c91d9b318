# Everything is installed into .venv, and built into build/, install/ and log/; nothing else is touched.

PYTHON ?= python3
ARGS ?=
comma := ,
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check

# Where this is set, as in many container images, each process would compile all that it imports: half of its start.
unexport PYTHONDONTWRITEBYTECODE

# A sourced ROS 2 provides rclpy through PYTHONPATH, also inside .venv; otherwise rclpy comes as wheels.
SOURCED := $(and $(ROS_DISTRO),$(AMENT_PREFIX_PATH))
EXTRAS := benchmarks$(comma)$(if $(SOURCED),test,ros$(comma)test)
OWN := -e '.[$(EXTRAS)]'
STAMP := $(VENV)/.installed-$(if $(SOURCED),$(ROS_DISTRO),wheels)

# Some tests need a browser or a compiler. $(call SYSTEM,is it there?,package,tests) installs what is
# missing through the system's package manager where that may be used without a password.
define SYSTEM
{ $(1); } >/dev/null 2>&1 || { \
  if ! command -v apt-get >/dev/null; then echo "No $(2): $(3) are skipped; install it to run them."; \
  elif [ "$$(id -u)" = 0 ]; then as_root=; elif sudo -n true 2>/dev/null; then as_root="sudo -n"; \
  else echo "No $(2), and no permission to install it: $(3) are skipped. Run: sudo apt-get install $(2)"; \
  fi; \
  if [ -n "$${as_root+set}" ]; then echo "Installing $(2) for $(3) ..."; \
    { $$as_root apt-get -qq update && $$as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -y --no-install-recommends -o DPkg::Lock::Timeout=300 \
    install $(2) >/dev/null; } || echo "$(2) could not be installed: $(3) are skipped."; fi; }
endef
CHROMIUM := command -v chromium || command -v chromium-browser || command -v google-chrome
COMPILER := command -v g++ && $(BIN)/python -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")'

.DEFAULT_GOAL := help
.PHONY: help venv demo bench test lint build clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST)
	@echo "PYTHON=python3.12 chooses the interpreter when .venv is made; ARGS='...' goes to demo, bench and test."

venv: $(STAMP) ## create .venv and install the package into it

demo: $(STAMP) ## run the demonstration
	@$(BIN)/contact-reach demo $(ARGS)

bench: $(STAMP) ## run a benchmark, as NAME=table1; without NAME, list them
	@test -n "$(NAME)" || { echo "NAME is one of these (benchmarks/README.md):"; grep -l "^def main" benchmarks/*.py | sed 's/.*\//  /; s/\.py//'; exit 1; }
	@$(BIN)/python -m benchmarks.$(NAME) $(ARGS)

test: $(STAMP) ## run the tests; with ARGS=test also those that take minutes
	@$(call SYSTEM,$(CHROMIUM),chromium,the tests of the viewer's page)
	@$(call SYSTEM,$(COMPILER),g++ python3-dev,the tests with the messages of real drivers)
ifeq ($(strip $(ARGS)),)
	@$(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder --quick
else
	@$(BIN)/python -m pytest $(ARGS)
endif

lint: $(STAMP) ## check style, types and imports between rooms
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo

build: $(STAMP) ## build the ROS 2 package into install/ with colcon
	@PATH="$(CURDIR)/$(BIN):$$PATH" colcon build

clean: ## remove what build, test and lint leave; .venv stays
	rm -rf build install log *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

FAIL = { echo "error: $(1)" >&2; exit 1; }
FOREIGN = ROS 2 $(ROS_DISTRO) is sourced, but $(1) cannot import its rclpy (see above). Remove $(VENV) and name \
  the interpreter that ROS uses, as in make venv PYTHON=/usr/bin/python3, or use a shell without ROS.

$(STAMP): setup.py setup.cfg package.xml constraints.txt | $(BIN)/pip
ifeq ($(SOURCED),)
	@test "$$(uname -sm)" = "Linux x86_64" || $(call FAIL,the rclpy wheels are for Linux on x86-64$(comma) \
	  and this is $$(uname -sm). Install ROS 2 Jazzy$(comma) source its setup.bash and run make again.)
endif
	@echo "Installing into $(VENV); the first time takes about a minute ..."
	@{ $(PIP) -c constraints.txt uv && $(BIN)/python -m uv pip install -q --python $(BIN)/python -c constraints.txt $(OWN); } || { \
	  echo "uv could not install it (see above), for instance since only pip knows your index: trying pip ..."; \
	  $(PIP) -c constraints.txt $(OWN); }
ifneq ($(SOURCED),)
	@$(BIN)/python -c 'import rclpy' || $(call FAIL,$(call FOREIGN,$(BIN)/python))
endif
	@touch $@

$(BIN)/pip:
	@command -v $(PYTHON) >/dev/null || $(call FAIL,there is no $(PYTHON). Install Python 3.11 or newer \
	  (Debian and Ubuntu: sudo apt install python3 python3-venv).)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || $(call FAIL,Python 3.11 or newer is needed$(comma) \
	  and $(PYTHON) is $$($(PYTHON) --version 2>&1). Name a newer one: make venv PYTHON=python3.12)
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || $(call FAIL,$(PYTHON) cannot create environments. Install its \
	  venv module (Debian and Ubuntu: sudo apt install \
	  $$($(PYTHON) -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')).)
ifneq ($(SOURCED),)
	@$(PYTHON) -c 'import rclpy' || $(call FAIL,$(call FOREIGN,$(PYTHON)))
endif
	@$(PYTHON) -m venv --clear $(VENV)
