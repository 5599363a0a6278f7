"""A pytest plug-in that is installed with tofpod. Its fixture ``tofpod_gate`` guards the limit of
a detector:

    def test_the_limit_holds(tofpod_gate):
        tofpod_gate("limit.yaml")

This test runs the study beside it and compares it with ``limit.baseline.json`` there, as `tofpod
check` does. ``pytest --tofpod-update`` writes the baseline. Renders and finished trials are kept
in pytest's cache folder."""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option ``--tofpod-update``."""
    help = "write new baselines for tofpod_gate; commit them with the reason"
    parser.getgroup("tofpod").addoption("--tofpod-update", action="store_true", help=help)


@pytest.fixture
def tofpod_gate(request: pytest.FixtureRequest) -> Callable[..., Path]:
    """Return ``gate(experiment, *changes)``, which returns a study's folder or fails as `tofpod
    check` does."""

    def gate(experiment: str, *changes: str) -> Path:
        from harness.experiment.load import load_experiment
        from harness.programs.gate import check

        path = Path(request.path).parent / experiment
        assert request.config.cache is not None
        out = request.config.cache.mkdir("tofpod")
        printed = io.StringIO()
        arguments = [
            str(path),
            "--baseline",
            str(path.with_suffix(".baseline.json")),
            "--out",
            str(out),
        ]
        arguments += [word for change in changes for word in ("--set", change)]
        arguments += ["--update"] if request.config.getoption("--tofpod-update") else []
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            code = check.main(arguments)
        if code:
            message = printed.getvalue().replace("with --update", "with pytest --tofpod-update")
            pytest.fail(message.strip(), pytrace=False)
        return load_experiment(path, changes).folder(out)

    return gate
