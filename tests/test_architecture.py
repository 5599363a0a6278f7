"""Who may import whom, read from the sources; and that detectors run without Mitsuba."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("harness", "scenes", "detectors")
ALLOWED = {
    # the first matching prefix of a module decides; "" means every room
    "harness/vocabulary": ("harness.vocabulary",),
    "scenes": ("harness.vocabulary", "scenes"),
    "detectors": ("harness.vocabulary", "detectors"),
    "harness/experiment": ("harness.vocabulary", "harness.experiment", "scenes", "detectors"),
    "harness/exchange": ("harness.vocabulary", "harness.programs.dataset.exchange"),
    "harness/tables": ("harness.vocabulary", "harness.evaluation", "harness.tables"),
    "harness/evaluation": ("harness.vocabulary", "harness.evaluation", "harness.records.trials"),
    "harness/thesis": (
        "harness.vocabulary",
        "harness.evaluation",
        "harness.tables",
        "harness.thesis",
    ),
    "harness/report": (
        "harness.vocabulary",
        "harness.evaluation",
        "harness.tables",
        "harness.thesis",
        "harness.report",
        "detectors.interface",
    ),
    "harness": ("",),
}
"""Imports inside functions count as well, but for a version number that a leaf may ask for."""
FRAGMENTS = {
    *(
        "Of",
        "For",
        "With",
        "By",
        "In",
        "At",
        "On",
        "To",
        "As",
        "From",
        "Into",
        "Without",
        "Beyond",
        "Between",
        "Under",
    ),
    *(
        "What",
        "How",
        "Where",
        "Whether",
        "That",
        "Which",
        "Why",
        "When",
        "Per",
        "Among",
        "Within",
        "Because",
    ),
}
PROGRAMS = [
    path.stem for path in sorted((ROOT / "harness").glob("*.py")) if "@program(" in path.read_text()
]


def sources() -> list[Path]:
    return sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(path.read_text())))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {
        name
        for name in names
        if name.split(".")[0] in ROOMS and name not in ("harness", "harness.__version__")
    }


def test_imports_go_one_way():
    wrong = []
    for path in sources():
        here = path.relative_to(ROOT).as_posix()
        allowed = next(
            rule
            for prefix, rule in ALLOWED.items()
            if here.startswith((f"{prefix}/", f"{prefix}.py"))
        )
        for name in imported(path):
            if not any(
                rule == "" or name == rule or name.startswith(rule + ".") for rule in allowed
            ):
                wrong.append(f"{here}: {name}")
    assert not wrong


def test_the_rule_sees_a_forbidden_import(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text(
        "from scenes.optics import NoiseFreeView\ndef f():\n    import detectors.averages.average\n"
    )
    assert {"scenes.optics", "detectors.averages.average"} <= imported(path)


def test_no_further_code_folder():
    folders = {path.parts[0] for path in (p.relative_to(ROOT) for p in ROOT.glob("*/*.py"))}
    assert folders <= {*ROOMS, "tests"}


def test_help_loads_nothing_heavy():
    """All programs in one process: what one of them loads is there after the next as well."""
    code = (
        "import contextlib, importlib, io, sys\n"
        "heavy = {'mitsuba', 'drjit', 'open3d', 'matplotlib', 'pandas', 'scipy', 'numba', 'av', 'cv2', 'rosbags'}\n"
        f"for name in {PROGRAMS}:\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):\n"
        "        importlib.import_module(f'harness.{name}').main(['--help'])\n"
        "    assert 'usage: python -m harness.' in said.getvalue(), name\n"
        "    assert not heavy & set(sys.modules), (name, heavy & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_detectors_and_their_program_never_import_mitsuba():
    code = (
        "import sys\n"
        "class Wall:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('mitsuba', 'drjit'): raise ImportError(name)\n"
        "sys.meta_path.insert(0, Wall())\n"
        "import detectors, detectors.averages.average, detectors.findings.measure, detectors.methods.thesis\n"
        "import detectors.recordings, harness.detect\n"
        "assert 'mitsuba' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_drawing_is_imported_where_something_is_drawn():
    """Matplotlib takes half a second, which no program needs that draws nothing."""
    for path in sources():
        for node in nodes(path)[0].body:  # type: ignore[attr-defined]
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.split(".")[0] == "matplotlib" for name in names), path


def test_class_names_have_one_meaning():
    homes: dict[str, list[str]] = {}
    for path in sources():
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(path.relative_to(ROOT).as_posix())
    assert not {name: where for name, where in homes.items() if len(where) > 1}


def test_docstrings_begin_as_sentences_do():
    """A verb or a noun comes first; a preposition or a relative word makes a fragment."""
    fragments = []
    for path in sources():
        for node in nodes(path):
            body = getattr(node, "body", None)
            for each in body if isinstance(body, list) else ():
                if (
                    isinstance(each, ast.Expr)
                    and isinstance(each.value, ast.Constant)
                    and isinstance(each.value.value, str)
                ) and each.value.value.split(maxsplit=1)[0] in FRAGMENTS:
                    fragments.append(f"{path.relative_to(ROOT).as_posix()}:{each.lineno}")
    assert not fragments
