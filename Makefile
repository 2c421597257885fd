# One command each on a fresh machine: every target makes .venv and installs what it needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PORT ?= 14550
POLICY ?= toge
# toge-rates flies races.
COURSE ?= $(if $(filter toge-rates,$(POLICY)),1001000007,1000007)
# Longest flight in seconds: it ends with the course.
DURATION ?= 60
# Rounds of a loop, as in COURSE=2001000007 LAPS=10 DURATION=300.
LAPS ?= 1
# Flags of mavbridge for this flight, as in FLAGS="--takeoff 5".
FLAGS ?=
# Firmware of the simulated vehicle: ardupilot or px4.
AUTOPILOT ?= ardupilot
# ArduPilot would hold the last sticks or setpoint for 3 s if this computer died.
BRIEF := $(if $(filter ardupilot,$(AUTOPILOT)),--set RC_OVERRIDE_TIME=0.5 --set GUID_TIMEOUT=0.5)
# ArduPilot takes the thrust of body rates for a climb rate without this.
BY_RATES := $(if $(filter toge-rates/ardupilot,$(POLICY)/$(AUTOPILOT)),--set GUID_OPTIONS=8)
# One viewer a flight: FLAGS="--rerun connect" shows it and writes no file.
SAVED := $(if $(findstring --rerun,$(FLAGS)),,--rerun out/flight.rrd)
LANDED := $(if $(findstring --then,$(FLAGS)),,--then land)

UNITS = $(BIN)/pytest --numprocesses auto --maxprocesses 8 --dist loadfile -m 'not system' --ignore tests/system
# Flights in real time have the machine for themselves: they are judged by the millisecond.
FLIGHTS = $(BIN)/pytest --numprocesses auto --maxprocesses 2 --dist worksteal -m system \
	$(shell grep -rl mark.system tests --include='test_*.py') tests/system
# Else each of the processes that tests start would compile the sources again.
unexport PYTHONDONTWRITEBYTECODE

# Modules whose mutants are tried, as in MODULES=mavbridge/guard/guard.py; none = all of
# tests/mutation/reasons.toml. ONLY=Guard.step: mutants whose name begins so.
MODULES ?=
ONLY ?=

.PHONY: fly check test lint style types docs bench faults fuzz mutants dist clean

%/bin/pip:
	$(PYTHON) -m venv $*

# $(call install,ENVIRONMENT,PACKAGES): pip would compile on one core. A few packages bring templates
# that are no Python.
define install
$(1)/bin/pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt $(2)
$(1)/bin/python -m compileall -qq --workers 0 $(1)/lib || true
endef

# What flies, records and trains; `installed` adds what tests, plots and computes on many machines.
FLIES := sitl,record,remote,screen,pilot
$(VENV)/flies: pyproject.toml constraints.txt | $(VENV)/bin/pip
	$(call install,$(VENV),--editable '.[$(FLIES)]')
	touch $@

ALL := $(FLIES),bench,onnx,mcap,cluster,docs,dev
$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)/bin/pip
	$(call install,$(VENV),--editable '.[$(ALL)]')
	touch $(VENV)/flies $@

# The peers live apart: MAVProxy brings the OpenCV build with a GUI, which shadows the headless one.
.venv-peers/installed: constraints.txt | .venv-peers/bin/pip
	$(call install,.venv-peers,MAVProxy mavsdk)
	touch $@

.venv-release/installed: constraints.txt | .venv-release/bin/pip
	$(call install,.venv-release,build check-wheel-contents pip-licenses twine)
	touch $@

fly: $(VENV)/flies  ## a simulated vehicle in its own process, and a policy flying its course over UDP
	@mkdir -p out && rm -f out/report.json out/fc.json out/flight.rrd
	@$(BIN)/python -m sitl course --course $(COURSE) --laps $(LAPS) --json > out/gates.json
	@$(BIN)/python -m sitl --autopilot $(AUTOPILOT) --connect udpout:127.0.0.1:$(PORT) \
		--camera shm:fpv-$(PORT) --course $(COURSE) --laps $(LAPS) --fly-on 10 --report out/fc.json & sitl=$$!; \
	trap 'kill $$sitl 2>/dev/null' EXIT; trap : INT; \
	$(BIN)/mavbridge --connect udp:127.0.0.1:$(PORT) --policy $(POLICY) \
		--camera shm:fpv-$(PORT) --arm --duration $(DURATION) $(LANDED) $(BRIEF) $(BY_RATES) $(FLAGS) \
		$(SAVED) --gates out/gates.json --report out/report.json; status=$$?; \
	kill $$sitl 2>/dev/null; wait $$sitl 2>/dev/null; trap - EXIT; \
	[ ! -e out/report.json ] || echo "wrote out/report.json and out/fc.json"; \
	[ ! -e out/flight.rrd ] || echo "wrote out/flight.rrd (open it with: $(BIN)/rerun out/flight.rrd)"; \
	exit $$status

lint: style types  ## format, lint, types, import direction

style: $(VENV)/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

types: $(VENV)/installed
	$(BIN)/mypy

check: lint  ## all of lint, then every test that needs no second process
	$(UNITS)

test:  ## all of lint, the site, then every test
	$(MAKE) --jobs 2 --output-sync .venv-peers/installed lint docs
	$(UNITS)
	$(FLIGHTS)

docs: $(VENV)/installed  ## the documentation as a site in out/site; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

bench: $(VENV)/installed .venv-peers/installed  ## engines, a flight and the link here, beside eager torch and peers
	$(BIN)/python -m benchmarks.compare --json out/bench.json

mutants: $(VENV)/installed  ## small changes of the safety core, each of which a test must notice; not part of test
	PYTHONPATH=.:tests $(BIN)/python -m mutation $(MODULES) $(if $(ONLY),--only $(ONLY))

FAULTS ?=
JOBS ?= 1
faults: $(VENV)/installed  ## every fault with every vehicle, and docs/dev/faults.md; FAULTS="kill stop" flies those alone
	PYTHONPATH=.:tests $(BIN)/python -m faults --jobs $(JOBS) $(or $(FAULTS),--out docs/dev/faults.md)

FUZZ_DATAGRAMS ?= 10000000
FUZZ_SEED ?=
fuzz: $(VENV)/installed  ## hostile datagrams on all cores: FUZZ_DATAGRAMS=N, FUZZ_SEED=N repeats a run
	PYTHONPATH=.:tests $(BIN)/python -m fuzz --datagrams $(FUZZ_DATAGRAMS) $(if $(FUZZ_SEED),--seed $(FUZZ_SEED))
	GUARD_EXAMPLES=1000 $(BIN)/pytest -q tests/properties/test_guard.py

EPOCH = $(shell git log -1 --format=%ct)
dist: .venv-release/installed  ## wheel and sdist of HEAD in dist/, checked; one commit gives the same bits anywhere
	rm -rf dist && mkdir -p dist/tree
	git -c tar.umask=0022 archive HEAD | tar -xp -C dist/tree
	umask 022; cd dist/tree; SOURCE_DATE_EPOCH=$(EPOCH) PIP_CONSTRAINT=constraints.txt \
		../../.venv-release/bin/python -m build --outdir .. > ../build.log 2>&1 || { cat ../build.log; exit 1; }
	# setuptools dates and owns the files of an sdist by the moment and the person of its build
	cd dist && tar -xzf mavbridge-*.tar.gz && rm -r mavbridge-*.tar.gz tree build.log && for tree in mavbridge-*/; do \
		tar --sort=name --mtime=@$(EPOCH) --owner=0 --group=0 --numeric-owner --mode=u=rwX,go=rX \
			-cf - $$tree | gzip -n > $${tree%/}.tar.gz; rm -r $$tree; done
	.venv-release/bin/twine check --strict dist/*
	.venv-release/bin/check-wheel-contents dist/*.whl
	cd dist && sha256sum *

clean:  ## forget the environments and outputs
	rm -rf $(VENV) .venv-peers .venv-release dist out
