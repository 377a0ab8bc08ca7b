# Two commands matter: `make run` and `make test`. Everything they need beyond Python 3.11+, venv, make and a C compiler
# is installed into .venv by the rule below.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TYPED := $(shell find thermoctl hal -name '*.pxd')
SOURCES := pyproject.toml setup.py $(shell find thermoctl hal -name '*.pyx') $(TYPED) $(wildcard $(TYPED:.pxd=.py))
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: run rig-hour bench-law test lint format install clean reproduce bench-identification test-identification prove
run: install
	$(BIN)/thermoctl demo --config config/simulated.yaml

# An hour of rig time in the paper's trapezoids, compensation on and off, judged by the reference encoder.
rig-hour: install
	$(BIN)/thermoctl run --config config/simulated.yaml --simulated-time --hours 1
	-$(BIN)/thermoctl run --config config/simulated.yaml --simulated-time --hours 1 --no-compensation

bench-law: install                 # what a call of the law costs, by compiler
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python tests/bench/law_call.py

test: install lint
	$(BIN)/python -m pytest -m "not slow" tests

# The full proof on concealed cases: made, sealed, diagnosed on all cores, scored. Takes hours; goes on where it stopped.
PROOF ?= build/proof
SEED ?= 7
NUMBER ?= 600
prove: install
	$(BIN)/python -m tests.concealed.generate --out $(PROOF)/cases --answers $(PROOF)/answers --number $(NUMBER) --seed $(SEED)
	$(BIN)/thermoctl prove $(PROOF)/cases --answers $(PROOF)/answers --out $(PROOF)/result

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(VENV)/.installed
$(VENV)/.installed: $(SOURCES)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip setuptools wheel
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@

reproduce: install                 # the paper's tests, and the better method beside them
	$(BIN)/thermoctl reproduce

bench-identification: install      # all bars in one run; 18 million samples take 4 GB for the peer and some minutes
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python tests/bench/identification.py --scale

test-identification: install       # experiments, identification, model in the daemon and back, on a rig in simulated time
	$(BIN)/python -m pytest tests/evaluate/test_experiment.py

clean:
	rm -rf $(VENV) build *.egg-info
	find thermoctl hal -name '*.so' -delete
	find thermoctl hal -name '*.pyx' -o -name '*.pxd' | sed 's/p.x*d*$$/c/' | xargs rm -f

# The compensator's models that are shipped, computed from the plant file.
.PHONY: models
models: install
	$(BIN)/thermoctl plant linearise config/plants/actuator_thermal.yaml --rig simulated --out config/models/simulated.yaml --replace
	$(BIN)/thermoctl plant linearise config/plants/actuator_thermal.yaml --rig wire --out config/models/wire.yaml --replace

.PHONY: bench
bench: install
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python tests/bench/plant.py

.PHONY: prove-refit refit-recordings
prove-refit: install               # do 95 % intervals hold the truth? 100 truths a kind of rig and noise
	nice -n 15 $(BIN)/python tests/prove_refit.py

refit-recordings: install          # every fit quoted for the naive plants of the real recordings, and ours
	$(BIN)/python -m pytest -m slow -s tests/test_refit_recordings.py

.PHONY: test-resolve
test-resolve: install              # two explanations that look alike, decided by the experiment that was proposed
	$(BIN)/python -m pytest -m slow tests/diagnose/test_next_experiment.py

.PHONY: test-wire
test-wire: install                 # pulled cables and killed programs, with the daemon and the virtual rig as two programs
	$(BIN)/python -m pytest -m slow tests/hal/test_wire_daemon.py

.PHONY: test-browser
test-browser: install              # pages in headless Chromium (Debian: apt-get install chromium)
	$(BIN)/python -m pytest -m slow tests/people/test_dashboard.py tests/people/test_pages.py

.PHONY: pictures
pictures: install                  # the same, and its screenshots into docs/images
	THERMOCTL_PICTURES=docs/images $(BIN)/python -m pytest -m slow tests/people/test_dashboard.py tests/people/test_pages.py tests/people/test_calibrate.py

.PHONY: test-fleet
test-fleet: install                # many rigs' recordings, from a folder and an object store, also spread by Dask
	$(BIN)/python -m pytest -m "slow or not slow" tests/people/test_fleet.py

.PHONY: test-wizard
test-wizard: install               # thermoctl calibrate from doctor to proof, with shortened tests
	$(BIN)/python -m pytest -m slow tests/people/test_calibrate.py

# The diagnosis beside its peers on the same cases; CASES= takes other folders of cases with answers.
.PHONY: bench-diagnosis
bench-diagnosis: install
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python tests/bench/diagnosis.py $(CASES)

# Six and more effects concealed in rigs of the judge's own making: diagnosed, modelled, compensated; one page.
.PHONY: demo-concealed
demo-concealed: install
	$(BIN)/python tests/demo_concealed.py

.PHONY: hazards
hazards: install                   # every hazard with its limit; the table of what was measured goes to docs/proof/hazards.md
	THERMOCTL_HAZARDS=docs/proof/hazards.md $(BIN)/python -m pytest -m "slow or not slow" tests/hazards

.PHONY: causes
causes: install                    # 27 broken things, the first line that is shown, its remedy: docs/proof/causes.md
	THERMOCTL_CAUSES=docs/proof/causes.md $(BIN)/python -m pytest -m slow tests/people/test_causes.py

.PHONY: walkthrough
walkthrough:                       # a new user's walk: a clean clone, every command of README, a diagnosed recording
	$(PYTHON) tests/walkthrough/walk.py

.PHONY: test-scale
test-scale: install                # a Dask scheduler and workers started by hand, one killed; diagnose over a folder of rigs
	$(BIN)/python -m pytest -m slow tests/test_prove.py

.PHONY: mutants
mutants: install                   # protection and arming: every branch reached, every mutant of the source broken or explained
	$(BIN)/python -m pytest -m slow tests/control/test_protection.py
	$(BIN)/python -m tests.control.mutants --page docs/proof/mutants.md

# The loop beside cyclictest, a paired C reference, a C twin and a plain pyserial + python-can loop: idle and under stress.
# Then whether memory or descriptors grow. Needs root and Debian's rt-tests and stress-ng; about 20 minutes.
.PHONY: bench-realtime
bench-realtime: install
	$(BIN)/python -m tests.bench.realtime.run
	$(BIN)/python -m tests.bench.realtime.steady

.PHONY: systemd-test
systemd-test: install              # the unit in a really booted systemd (root; Debian: systemd-container, mmdebstrap)
	$(BIN)/python -m pytest -q -s -m slow tests/systemd

.PHONY: qemu-test
qemu-test: install                 # SocketCAN for real in a qemu guest (root; Debian: qemu-system-x86, mmdebstrap)
	$(BIN)/python -m pytest -q -s -m slow tests/qemu

.PHONY: diagnose-recordings
diagnose-recordings: install       # real rigs from their naive plants: what is named, where, and its worth on unseen data
	$(BIN)/python -m pytest -m slow -s --no-header tests/diagnose/test_recordings.py

.PHONY: fuzz
FUZZ_S ?= 20
TARGETS := plant config expression serial slcan modbus csv parquet arrow arrows commands metadata
fuzz: install                      # FUZZ_S seconds for each that reads bytes from outside, twice; a find ends it, its input stays in build/fuzz
	for target in $(TARGETS); do $(BIN)/python -m tests.fuzz.targets $$target --seconds $(FUZZ_S) || exit 1; done
	-$(BIN)/python -m pip install --quiet --editable '.[fuzz]'
	if $(BIN)/python -c "import atheris" 2>/dev/null; then for target in $(TARGETS); do \
		$(BIN)/python -m tests.fuzz.targets $$target --atheris --seconds $(FUZZ_S) || exit 1; done; fi

.PHONY: scenarios armed-hour
scenarios: install                 # every fault scenario at the wire, twice, idle and loaded (about 20 minutes); docs/proof/scenarios.md
	$(BIN)/python -m tests.scenarios.run --page docs/proof/scenarios.md

armed-hour: install                # both rigs armed for an hour of real time on slow, lossy Modbus; docs/proof/armed-hour.md
	$(BIN)/python -m tests.scenarios.armed_hour --page docs/proof/armed-hour.md
