"""Who may import whom, read from the sources; and that detectors run without Mitsuba."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

from harness.__main__ import MODULES
from tests import structure

ROOT = Path(__file__).resolve().parents[1]
CORE = (
    "harness.vocabulary",
    "harness.experiment",
    "harness.records",
    "harness.evaluation",
    "harness.tables",
    "harness.stills",
    "harness.report",
    "harness.testing",
    "harness.inspection",
    "harness.trials",
    "harness.runs",
)
"""Rooms of the core, lowest first: none imports one that stands below it in this list but those
that `ALLOWED` names."""
ALLOWED = {
    "harness.vocabulary": (),
    "harness.experiment": ("scenes", "detectors"),
    "harness.records": (),
    "harness.evaluation": ("harness.records",),
    "harness.tables": ("harness.records", "harness.evaluation"),
    "harness.stills": ("harness.evaluation", "scenes.closed_form"),
    "harness.report": (
        "harness.records",
        "harness.evaluation",
        "harness.tables",
        "detectors.interface",
    ),
    "harness.testing": ("detectors",),
    "harness.inspection": (
        "harness.records",
        "harness.evaluation",
        "harness.report",
        "scenes.sensor",
        "detectors",
    ),
    "harness.trials": (
        "harness.records",
        "harness.evaluation",
        "harness.experiment",
        "scenes",
        "detectors",
    ),
    "harness.runs": (
        "harness.records",
        "harness.evaluation",
        "harness.tables",
        "harness.experiment",
        "harness.report",
        "harness.inspection",
        "harness.trials",
        "scenes",
        "detectors",
    ),
    "scenes": (),
    "detectors": (),
}
"""What a room imports beside itself and `harness.vocabulary`. Front doors and programs: any room of
the core. Imports inside functions and for type checks count as well."""
PROGRAMS_THAT_IMPORT_A_PROGRAM = {
    ("keeping", "atlas"): "`ls` and `clean` know the files that each program writes",
    ("keeping", "coverage"): "likewise",
    ("keeping", "efficiency"): "likewise",
    ("keeping", "filters"): "likewise",
    ("keeping", "artefacts"): "`ls artefacts` lists the age of stored answers",
    ("scorecard", "camera"): "`validate --capture` measures a capture as `characterise` does",
}
FRAGMENTS = {
    *("Of", "For", "With", "By", "In", "At", "On", "To", "As", "From", "Into", "Without", "Beyond"),
    *("Between", "Under", "What", "How", "Where", "Whether", "That", "Which", "Why", "When", "Per"),
    *("Among", "Within", "Because"),
}


@cache
def graph() -> structure.Graph:
    return structure.module_graph(structure.modules_in(ROOT))


def sources() -> list[Path]:
    return sorted(path for room in structure.CODE_FOLDERS for path in (ROOT / room).rglob("*.py"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(path.read_text())))


def is_in(module: str, room: str) -> bool:
    return module == room or module.startswith(f"{room}.")


def test_imports_go_one_way():
    wrong = []
    for module, imported in graph().items():
        room = next((room for room in ALLOWED if is_in(module, room)), None)
        if room is None:
            continue  # a front door or a program
        legal = (room, "harness.vocabulary", *ALLOWED[room])
        for target in imported - {"harness"}:
            if not any(is_in(target, legal_room) for legal_room in legal):
                wrong.append(f"{module} imports {target}")
    assert not wrong


def test_the_core_imports_no_program_and_programs_import_none_but_with_a_reason():
    among_programs, from_core = structure.arrows_to_programs(graph())
    assert not from_core
    assert among_programs == set(PROGRAMS_THAT_IMPORT_A_PROGRAM)


def test_there_is_no_circle_of_modules_or_of_rooms():
    modules = structure.modules_in(ROOT)
    assert structure.circles(graph()) == []
    assert structure.circles(structure.room_graph(graph(), modules)) == []


def test_the_rules_see_a_forbidden_import_and_a_circle(tmp_path):
    texts = {
        "harness/__init__.py": "",
        "harness/core.py": "def f():\n    from harness.programs.one import first\n",
        "harness/programs/one/first.py": (
            "import harness.core\nimport harness.programs.two.second\n"
        ),
        "harness/programs/two/second.py": "",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    created = structure.module_graph(structure.modules_in(tmp_path))
    assert structure.circles(created) == [["harness.core", "harness.programs.one.first"]]
    assert structure.arrows_to_programs(created) == (
        {("one", "two")},
        {("harness.core", "harness.programs.one.first")},
    )


def test_tests_have_the_same_folders_as_the_product():
    """A folder of tests that has no room of the product would be of code that has moved."""
    own_folders = {"support", "strangers", "validation", "benchmarks", "mutants", "fuzz"}
    for path in (ROOT / "tests").rglob("test_*.py"):
        folder = path.parent.relative_to(ROOT / "tests")
        if folder.parts and folder.parts[0] not in own_folders:
            assert (ROOT / folder).is_dir(), path


def test_a_program_loads_no_other_program():
    code = (
        "import contextlib, importlib, io, sys\n"
        "from harness.__main__ import MODULES\n"
        "assert not [name for name in sys.modules if name.startswith('harness.programs')]\n"
        "for name, module in MODULES.items():\n"
        "    importlib.import_module(module)\n"
        "    loaded = {name for name in sys.modules if name.startswith('harness.programs.')}\n"
        "    own_room = module.rpartition('.')[0]\n"
        "    others = {other for other in loaded if not other.startswith(own_room)}\n"
        "    assert not others, (name, others)\n"
        "    for name in loaded:\n"
        "        del sys.modules[name]\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_further_code_folder():
    folders = {path.parts[0] for path in (p.relative_to(ROOT) for p in ROOT.glob("*/*.py"))}
    assert folders <= {*structure.CODE_FOLDERS, "tests"}


def test_help_loads_nothing_heavy():
    """All programs in one process: what one of them loads is there after the next as well."""
    code = (
        "import contextlib, importlib, io, sys\n"
        "heavy = {'mitsuba', 'drjit', 'open3d', 'matplotlib', 'pandas', 'scipy', 'numba', 'av'}\n"
        "heavy |= {'cv2', 'rosbags'}\n"
        f"for name, module in {MODULES}.items():\n"
        "    said = io.StringIO()\n"
        "    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):\n"
        "        importlib.import_module(module).main(['--help'])\n"
        "    assert f'usage: tofpod {name} ' in said.getvalue(), name\n"
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
        "import detectors, detectors.averages.average, detectors.findings.measure\n"
        "import detectors.methods.thesis\n"
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


OF_A_PLATFORM = {"fcntl", "resource", "signal", "select", "msvcrt", "multiprocessing"}
"""Modules that differ between operating systems; the type of a pipe's end does not."""


def test_only_one_module_asks_for_the_operating_system():
    for path in sources():
        if path == ROOT / "harness" / "vocabulary" / "system.py":
            continue
        for node in nodes(path):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                imported = [node.module or ""]
            for name in set(imported) - {"multiprocessing.connection"}:
                assert name.split(".")[0] not in OF_A_PLATFORM, path
            if isinstance(node, ast.Attribute):
                asked = ast.unparse(node)
                assert asked not in ("sys.platform", "os.name", "os.fork", "os.kill"), path
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not node.value.startswith(("/proc/", "/dev/")), path


STORED_PATH = re.compile(r'"(?:path|file|files|folder|recordings)": \[?str\(')


def test_stored_paths_are_written_alike_on_every_system():
    assert STORED_PATH.search('{"path": str(path)}')
    for path in sources():
        assert not STORED_PATH.search(path.read_text()), f"{path}: as_posix() writes slashes"


def test_class_names_have_one_meaning():
    homes: dict[str, list[str]] = {}
    for path in sources():
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(path.relative_to(ROOT).as_posix())
    assert not {name: where for name, where in homes.items() if len(where) > 1}


def test_docstrings_begin_as_sentences_do():
    """A verb or a noun comes first; a preposition or a relative word makes a fragment. The notes
    of fields may be fragments: "Whether x is the logarithm of the size."."""
    fragments = []
    for path in sources():
        for node in nodes(path):
            if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                continue
            text = ast.get_docstring(node) or ""
            if text and text.split(maxsplit=1)[0] in FRAGMENTS:
                line = getattr(node, "lineno", 1)
                fragments.append(f"{path.relative_to(ROOT).as_posix()}:{line}: {text[:50]}")
    assert not fragments
