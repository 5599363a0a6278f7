"""A package that a plain installation lacks is told with the line to type."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from harness.vocabulary import extras, provenance
from harness.vocabulary.errors import UserError

ROOT = Path(__file__).resolve().parents[3]
DISTRIBUTIONS = {"dask_jobqueue": "dask-jobqueue"}
"""Names of packages that differ from their modules'."""


@pytest.mark.parametrize("module", extras.EXTRAS)
def test_the_extra_of_each_module_installs_it(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=f"a test needs the package {module}") as caught:
        extras.load_extra(module, "a test")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = extras.EXTRAS[module]
    assert caught.value.fix == f"pip install 'tofpod[{extra}]'"
    package = DISTRIBUTIONS.get(module, module)
    wanted = project["optional-dependencies"][extra]
    assert any(requirement.startswith(package) for requirement in wanted)
    assert not any(requirement.startswith(package) for requirement in project["dependencies"])
    assert extra in "".join(project["optional-dependencies"]["all"])


def test_a_module_that_an_import_refuses_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(UserError, match="openpyxl"):
        extras.load_extra("openpyxl", "a test")


def test_the_digest_of_code_does_without_an_extra() -> None:
    code = ("harness.vocabulary.seeds",)
    absent = provenance.source_digest(code, ("no-such-package",))
    assert absent != provenance.source_digest(code, ("numpy",))
    assert absent == provenance.source_digest(code, ("no-such-package",))
