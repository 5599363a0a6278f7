# make sweep: run the averaging experiment and write its report.   make test: run the tests, all but the slow ones.
# Both set up .venv from the lock first, once.   make test-all: every test, with the long Monte Carlo and fault campaigns.
PYTHON ?= python3
BIN := .venv/bin
# Each of the many processes that tests start would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: sweep test test-all lint smoke validate check artefacts ages benchmarks strangers fuzz mutants docs lock clean
sweep: .venv/.ready
	$(BIN)/python -m harness.sweep experiments/averaging.yaml

# Four processes for two cores, as some tests wait for nodes and time limits.
test: .venv/.ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder -m "not slow"

test-all: .venv/.ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

lint: .venv/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

smoke: .venv/.ready
	$(BIN)/tofpod sweep experiments/smoke.yaml

validate: .venv/.ready
	$(BIN)/python -m harness validate

check: .venv/.ready
	$(BIN)/python -m harness check experiments/regression.yaml

# Stored answers that are older than the code, made again: `make artefacts ONLY=atlas`, `QUICK=1`, `make ages`.
artefacts: .venv/.ready
	$(BIN)/python -m harness artefacts $(addprefix --only ,$(ONLY)) $(if $(QUICK),--quick)

# Says in the documents which of their tables and pictures are older than the code; seconds.
ages: .venv/.ready
	$(BIN)/python -m harness artefacts --ages

benchmarks: .venv/.ready
	$(BIN)/python tests/benchmarks/performance.py

# Recordings of many kinds of scene with known truth, answered by the default command: right, warned or wrong.
strangers: .venv/.ready
	OMP_NUM_THREADS=1 nice -n 10 $(BIN)/python -m tests.strangers

# Malformed inputs for all programs: each is refused with one message or answered, and none ends in a traceback.
fuzz: .venv/.ready
	OMP_NUM_THREADS=1 nice -n 10 $(BIN)/python -m tests.fuzz --count 2000 --seed 1

# Small faults of the numeric modules, which the tests of their rooms must notice; hours. `python -m tests.mutants --help`.
mutants: .venv/.ready
	nice -n 10 $(BIN)/python -m tests.mutants --jobs 2 --page docs/mutants.md

# The documentation as a site that needs no network: site/index.html.
docs: .venv/.ready
	$(BIN)/python -m harness ls keys > docs/reference.md
	cp README.md docs/index.md
	sed -i "s#](docs/#](#g; s#](CONTRIBUTING.md)#](contributing.md)#g" docs/index.md
	sed "s#](docs/#](#g" CONTRIBUTING.md > docs/contributing.md
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# One lock for every platform and Python; needed after a change of pyproject.toml's dependencies only.
lock: .venv/.ready
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11.5 --extra all --extra dev --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" -o requirements.lock pyproject.toml

# pip would compile every file of every package, which takes as long as the rest; Python compiles what it imports.
.venv/.installed: requirements.lock pyproject.toml
	@echo "Setting up .venv: install the locked packages (1 of 3, the longest part) ..."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --no-deps --require-hashes -r requirements.lock
	@echo "Setting up .venv: install tofpod (2 of 3) ..."
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

.venv/.ready: .venv/.installed
	@echo "Setting up .venv: compile the inner loops (3 of 3) ..."
	$(BIN)/python -m harness prepare
	touch $@

clean:
	rm -rf .venv results/.cache
