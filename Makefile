# make sweep: run the averaging experiment and write its report.   make test: run the tests.
# Both set up .venv from the lock first, once.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: sweep test lint smoke validate check benchmarks strangers lock clean
sweep: .venv/.ready
	$(BIN)/python -m harness.sweep experiments/averaging.yaml

test: .venv/.ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

lint: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

smoke: .venv/.ready
	$(BIN)/python -m harness.sweep experiments/smoke.yaml

validate: .venv/.ready
	$(BIN)/python -m harness.validate

check: .venv/.ready
	$(BIN)/python -m harness.check experiments/regression.yaml

benchmarks: .venv/.ready
	$(BIN)/python -m pytest tests/benchmarks --benchmark-only -o python_files='bench_*.py' -o addopts=''
	$(BIN)/python tests/benchmarks/trials.py --peers

# Recordings of many kinds of scene with known truth, answered by the default command: right, warned or wrong.
strangers: .venv/.ready
	PYTHONPATH=tests OMP_NUM_THREADS=1 nice -n 10 $(BIN)/python -m strangers

# Five minutes; needed after a change of pyproject.toml's dependencies only.
lock: .venv/.ready
	$(BIN)/pip-compile --quiet --extra dev --extra cluster --generate-hashes --strip-extras --allow-unsafe \
	  --no-emit-index-url --no-emit-trusted-host --no-emit-find-links -o requirements.lock pyproject.toml

.venv/.ready: requirements.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	$(BIN)/python -m harness.prepare
	touch $@

clean:
	rm -rf .venv results/.cache
