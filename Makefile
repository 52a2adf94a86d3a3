# Two commands do their own set-up: `make demo` and `make test`. PYTHON chooses the interpreter.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

# How many tests run at once; most of them wait. Each has a domain of its own, tests/ros/conftest.py.
WORKERS ?= 3
PYTEST  := $(BIN)/python -m pytest
# Editable in compat mode puts the package on sys.path, ahead of any folder named lifecycle: each install must say so again.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --config-settings editable_mode=compat --editable

# Tests start hundreds of programs: where nothing may be compiled ahead, each compiles the whole package again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-thorough test-kilted test-engines outside check check-static soak soak-tests bench bench-all hostile mutate docs schemas findings clean help

help:
	@echo "make demo    bring up a small robot from its manifest, verified, then shut it down"
	@echo "make test    set up and run the tests, real DDS included; no privilege needed; five minutes"
	@echo "make test-kilted  try the verbs on ROS 2 Kilted, in a venv of its own; two minutes"
	@echo "make test-engines  have podman and systemd run an exported system; three minutes"
	@echo "make outside try the promise from outside: every attack, the nine systems, ros2 clients, faults; eight minutes."
	@echo "             LIFECYCLE=path/to/lifecycle make outside asks another installation"
	@echo "make check   everything CI runs: lint, types, import contracts, all tests"
	@echo "make soak    a hundred rounds of seeded faults against supervision, judged from outside; a quarter of an hour"
	@echo "make soak-tests  the faults and the gate twenty times in a row; an hour"
	@echo "make bench   measure bring-up and data path against a floor and plain rclpy; one table, five minutes"
	@echo "make bench-all  every benchmark, bring-up with up to 100 nodes; an hour"
	@echo "make hostile attack everything that reads what others wrote, and list what was not handled"
	@echo "make mutate  change what judges, one small change at a time, and list what no test notices"
	@echo "make schemas write the JSON Schemas from their types, into schemas/, and docs/keys.md"
	@echo "make findings write all that tests of rules find, which they compare with: read the difference"
	@echo "make docs    build the documentation site, with the Python API, into build/site"

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("lifecycle needs CPython 3.10 to 3.13, this is " + sys.version.split()[0]) if not (3, 10) <= sys.version_info[:2] <= (3, 13) else None'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) '.[dev]'
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/lifecycle up manifests/teleop.lifecycle.yaml --stop-after 5

test: $(STAMP)
	$(PYTEST) -n $(WORKERS) --dist worksteal -m "not thorough" tests/unit
	$(PYTEST) -n $(WORKERS) --dist worksteal -m "not thorough and not alone" tests/ros tests/outside

# What `test` leaves out: first side by side as well (what only computes by itself: it takes the time of others), then one
# after the other.
test-thorough: $(STAMP)
	$(PYTEST) -n $(WORKERS) --dist worksteal -m thorough tests/unit
	$(PYTEST) -n $(WORKERS) --dist worksteal -m "thorough and not alone" tests/ros tests/net tests/outside
	$(PYTEST) -m alone tests/ros tests/net tests/engines

# The same tests on the other distribution: what is asked, and what asks, run on it.
KILTED    := $(VENV)-kilted
ON_KILTED := $(addprefix tests/ros/,test_distribution.py middleware/test_abi_and_conversions.py \
  middleware/test_network_flow_endpoints_on_dds.py)
$(KILTED)/.installed: pyproject.toml
	$(PYTHON) -m venv $(KILTED)
	$(INSTALL:$(BIN)/%=$(KILTED)/bin/%) '.[kilted,examples,test]' ros-kilted-test-msgs
	touch $@

test-kilted: $(KILTED)/.installed
	$(KILTED)/bin/python -m pytest -n $(WORKERS) --dist worksteal $(ON_KILTED)

# The nine systems need root and network namespaces, and skip without. `$(BIN)/python -m tests.outside` prints the table of attacks.
outside: $(STAMP)
	$(PYTEST) -n $(WORKERS) --dist worksteal tests/outside tests/ros/faults tests/net/test_nine_systems.py

check-static: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: check-static test test-kilted test-thorough docs

# ROUNDS=20 SEED=7 chooses; `$(BIN)/python -m tests.soak --list --seed 7` prints what a seed stands for.
ROUNDS ?= 100
SEED   ?= 1
soak: $(STAMP)
	$(BIN)/python -m tests.soak --seed $(SEED) --rounds $(ROUNDS)

# The pods of an exported system, run by podman as a kubelet would; skips without root and podman. Three minutes.
test-engines: $(STAMP)
	$(PYTEST) tests/engines

# What holds must hold each time: the faults and the gate, TIMES over and without a second try, then bring-ups on a busy machine.
TIMES ?= 20
soak-tests: $(STAMP)
	for each in $$(seq $(TIMES)); do \
	  $(PYTEST) -n $(WORKERS) --dist worksteal -p no:rerunfailures tests/ros/faults tests/ros/supervisor/test_gate_holds.py || exit 1; \
	done
	$(BIN)/python benchmarks/soak_bring_up.py --times $(TIMES)

bench: $(STAMP)
	$(BIN)/python benchmarks/summary.py

# What needs root and network namespaces says so where it cannot run; the others go on.
bench-all: $(STAMP)
	@failed=; \
	for each in "bring_up.py" "bring_up.py --shape chain" data_path.py graph_changes.py changed_endpoint.py \
	  idle.py unique_flows.py soak_bring_up.py congested_link.py liveliness.py; do \
	  echo "== $$each"; $(BIN)/python benchmarks/$$each || failed="$$failed $$each,"; \
	done; \
	[ -z "$$failed" ] || { echo "failed:$$failed"; exit 1; }

# Under ten minutes. HOSTILE='--seed 7 --class files --only report' chooses; each failure says its own.
HOSTILE ?=
hostile: $(STAMP)
	$(BIN)/python -m tests.hostile $(HOSTILE)

# MUTANTS='lifecycle.verify.rules.qos*' tries some only. What no test has killed is tried again each time; `make clean`
# forgets all results.
MUTANTS ?=
mutate: $(STAMP)
	$(INSTALL) '.[mutate]'
	CI=1 $(BIN)/python -m tests.mutation.run $(MUTANTS) > mutants.log 2>&1 || { tail -n 40 mutants.log; exit 1; }
	$(BIN)/python -m tests.mutation.report --at-least 95

# Offline once the extra is installed. The variable hides the theme's notice of its own end of life (May 2027), which it
# prints at each build; Zensical, its successor, reads the same mkdocs.yml.
$(VENV)/.docs: $(STAMP)
	$(INSTALL) '.[docs]'
	touch $@

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "read build/site/index.html"

schemas: $(STAMP)
	$(BIN)/python -m tests.result_schemas
	$(BIN)/python -m tests.keys_page

findings: $(STAMP)
	WRITE_FINDINGS=1 CI=1 $(PYTEST) -p no:xdist tests/unit/verify

clean:
	rm -rf mutants mutants.log $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
