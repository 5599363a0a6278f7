"""What a stranger sees first: one version, forms and a workflow that parse, commands that exist."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from harness import __version__
from harness.__main__ import main

ROOT = Path(__file__).resolve().parents[1]
FORGE = ROOT / ".github"
FORM_KINDS = ("bug", "feature", "question")
RELEASE = re.compile(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d{2}-\d{2})$", re.MULTILINE)
KINDS_OF_CHANGES = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
TYPED_PACKAGES = ("harness", "scenes", "detectors")
FILES_WITH_COMMANDS = (
    ".ci/run",
    ".github/PULL_REQUEST_TEMPLATE.md",
    ".github/workflows/ci.yml",
    ".pre-commit-config.yaml",
    "CONTRIBUTING.md",
    "README.md",
    "SECURITY.md",
    "docs/releasing.md",
)


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def yaml_of(name: str) -> Any:
    """YAML 1.2, in which a workflow's key ``on`` is a text; a key that occurs twice is an error."""
    return YAML(typ="safe", pure=True).load(text_of(name))


def toml_of(name: str) -> Any:
    return tomllib.loads(text_of(name))


# ---- one version ---------------------------------------------------------------------------------


def test_the_package_reads_its_version_from_the_code():
    pyproject = toml_of("pyproject.toml")
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)
    assert "version" not in pyproject["project"], "a second source"
    assert pyproject["project"]["dynamic"] == ["version"]
    assert pyproject["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "harness.__version__"}


def test_the_command_states_the_version_of_the_code_that_runs(capsys):
    """Not of the metadata that some earlier installation left in the environment."""
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"tofpod {__version__}\n"


def test_documents_repeat_the_version_of_the_code():
    citation = yaml_of("CITATION.cff")
    newest, release_date = RELEASE.findall(text_of("CHANGELOG.md"))[0]
    assert newest == __version__
    assert citation["version"] == __version__
    assert str(citation["date-released"]) == release_date
    assert re.findall(r"version = \{([^}]*)\}", text_of("README.md")) == [__version__]


def test_documents_name_the_wheel_of_this_version():
    documents = [path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md")]
    versions = re.findall(r"tofpod-(\d[^-]*)-py3", "\n".join(documents))
    assert set(versions) == {__version__}


# ---- changelog and citation ----------------------------------------------------------------------


def test_the_changelog_has_the_form_of_keep_a_changelog():
    text = text_of("CHANGELOG.md")
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    releases = RELEASE.findall(text)
    assert headings[0] == "[Unreleased]"
    assert len(releases) == len(headings) - 1, "each further heading is a version with its date"
    numbers = [tuple(map(int, version.split("."))) for version, _ in releases]
    assert numbers == sorted(set(numbers), reverse=True)
    assert set(re.findall(r"^### (.+)$", text, re.MULTILINE)) <= KINDS_OF_CHANGES


def test_the_citation_has_what_the_format_requires():
    citation = yaml_of("CITATION.cff")
    readme = text_of("README.md")
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= set(citation)
    assert citation["type"] == "software"
    assert citation["license"] == toml_of("pyproject.toml")["project"]["license"]
    assert f"title = {{{citation['title']}}}" in readme
    for author in citation["authors"]:
        assert f"author = {{{{{author['name']}}}}}" in readme


# ---- forms ---------------------------------------------------------------------------------------


def form_of(kind: str) -> Any:
    return yaml_of(f".github/ISSUE_TEMPLATE/{kind}.yml")


def required_fields(form: Any) -> set[str]:
    fields = [field for field in form["body"] if field.get("validations", {}).get("required")]
    return {field["id"] for field in fields}


@pytest.mark.parametrize("kind", FORM_KINDS)
def test_a_form_is_one_that_the_forge_shows(kind: str):
    form = form_of(kind)
    assert set(form) <= {"name", "description", "title", "labels", "body"}
    assert form["name"]
    assert form["description"]
    assert required_fields(form)
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields)
    for field in fields:
        assert field["type"] in ("textarea", "input", "dropdown", "checkboxes")
        assert field["attributes"]["label"]
        assert set(field) <= {"type", "id", "attributes", "validations"}
        assert ("options" in field["attributes"]) == (field["type"] in ("dropdown", "checkboxes"))


def test_a_bug_cannot_be_reported_without_command_versions_and_provenance():
    required = required_fields(form_of("bug"))
    assert {"command", "happened", "versions", "provenance"} <= required


def test_each_kind_of_issue_has_a_form():
    files = {path.stem for path in (FORGE / "ISSUE_TEMPLATE").iterdir()}
    assert files == {*FORM_KINDS, "config"}
    assert form_of("config") == {"blank_issues_enabled": False}


def test_nothing_names_a_person_or_an_address_that_nobody_knows():
    """No URL of a repository is known; forms and citation must not invent one."""
    forms = sorted((FORGE / "ISSUE_TEMPLATE").iterdir())
    texts = [FORGE / "PULL_REQUEST_TEMPLATE.md", ROOT / "CITATION.cff", ROOT / "SECURITY.md"]
    for path in [*forms, *texts]:
        content = path.read_text(encoding="utf-8")
        assert not re.search(r"https?://|[\w.]+@[\w.]+\.\w+", content), path.name
    assert "repository-code" not in yaml_of("CITATION.cff")


# ---- workflow and hooks --------------------------------------------------------------------------


def test_the_workflow_runs_all_checks_on_linux_and_the_light_tests_elsewhere():
    jobs = yaml_of(".github/workflows/ci.yml")["jobs"]
    linux = jobs["linux"]
    light = jobs["light"]
    assert linux["runs-on"].startswith("ubuntu-")
    assert linux["strategy"]["matrix"]["python"] == ["3.11", "3.12"]
    assert ".ci/run" in [step.get("run") for step in linux["steps"]]
    systems = {system.partition("-")[0] for system in light["strategy"]["matrix"]["system"]}
    assert systems == {"macos", "windows"}
    assert light["steps"][-1]["run"].endswith('--noconftest -m "not slow" @tests/light.txt')


def test_the_lock_constrains_the_versions_on_other_systems(tmp_path: Path):
    """Run the workflow's step that takes them, as it stands."""
    steps = yaml_of(".github/workflows/ci.yml")["jobs"]["light"]["steps"]
    commands = {step.get("name"): step.get("run") for step in steps}
    command = commands["Take the versions from the lock"]
    (tmp_path / "requirements.lock").symlink_to(ROOT / "requirements.lock")
    subprocess.run(["bash", "-c", command], cwd=tmp_path, check=True)
    constraints = (tmp_path / "constraints.txt").read_text().splitlines()
    locked = re.findall(r"^[a-z][^ ]*==", text_of("requirements.lock"), re.MULTILINE)
    assert len(constraints) == len(locked)
    for line in constraints:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9._!+-]+", line)


def test_the_light_tests_exist():
    listed = text_of("tests/light.txt").splitlines()
    assert listed == sorted(set(listed))
    assert [name for name in listed if not (ROOT / name).is_file()] == []


PYTEST_WITHOUT_LINUX = """
import os, sys
for module in ("fcntl", "resource", "termios", "grp", "pwd", "mitsuba", "drjit"):
    sys.modules[module] = None  # an import of it raises ModuleNotFoundError
del os.fork
import pytest
raise SystemExit(pytest.main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_the_light_tests_load_nothing_that_other_systems_lack():
    """Collect them as the workflow does, in a process with neither Mitsuba nor modules of POSIX.

    All of them also pass in it, which takes a minute: leave out ``--collect-only`` to see that."""
    command = [sys.executable, "-c", PYTEST_WITHOUT_LINUX, "--noconftest", "--collect-only"]
    command += ["-p", "no:cacheprovider", "@tests/light.txt"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stdout[-2000:] + ran.stderr[-2000:]


def test_all_hooks_are_local_and_run_what_make_lint_runs():
    repositories = yaml_of(".pre-commit-config.yaml")["repos"]
    assert [repository["repo"] for repository in repositories] == ["local"]
    hooks = {hook["id"]: hook for hook in repositories[0]["hooks"]}
    assert set(hooks) == {"ruff-format", "ruff-check", "mypy"}
    assert hooks["ruff-format"]["entry"].startswith(".venv/bin/ruff format")
    assert hooks["ruff-check"]["entry"].startswith(".venv/bin/ruff check")
    assert hooks["mypy"]["entry"] == ".venv/bin/mypy"
    assert {hook["language"] for hook in hooks.values()} == {"system"}


# ---- commands ------------------------------------------------------------------------------------


def targets() -> set[str]:
    """The targets of the Makefile."""
    return set(re.findall(r"^([a-z][a-z-]*|\.venv/\.[a-z]+):", text_of("Makefile"), re.MULTILINE))


@pytest.mark.parametrize("name", FILES_WITH_COMMANDS)
def test_every_target_that_is_named_exists(name: str):
    commands = re.findall(r"(?:^ {4}|^|`|run: )make ([^`#\n]+)", text_of(name), re.MULTILINE)
    for command in commands:
        words = shlex.split(command)
        by_name = [word for word in words if not word.startswith("-") and "=" not in word]
        assert set(by_name) <= targets(), f"make {command}"


def test_all_phony_targets_have_a_recipe():
    phony = re.findall(r"^\.PHONY: (.+)$", text_of("Makefile"), re.MULTILINE)
    assert set(" ".join(phony).split()) <= targets()


# ---- types ---------------------------------------------------------------------------------------


def test_each_package_says_that_it_is_typed():
    """PEP 561: checkers read the annotations of a package whose wheel holds this marker."""
    data = toml_of("pyproject.toml")["tool"]["setuptools"]["package-data"]
    for package in TYPED_PACKAGES:
        assert (ROOT / package / "py.typed").read_bytes() == b""
        assert "py.typed" in data[package]
