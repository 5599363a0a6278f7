"""Which test files belong to the room of a module."""

import ast
from functools import cache
from pathlib import Path


@cache
def imported(path: Path) -> set[str]:
    """Return the modules, and the names in modules, that a file imports anywhere."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def module_name(file: str) -> str:
    """Return the dotted name of a module by its path in the checkout."""
    return file.removesuffix(".py").replace("/", ".")


def room_tests(tree: Path, file: str) -> tuple[list[str], list[str]]:
    """Return the test files of a module's room: those that import the module, and the others.

    The room's tests stand in the folder of ``tests`` with the module's path, or else in the nearest
    folder around it that has tests. Files in the folders around count if they import the module,
    but for those of ``tests`` itself, which look at the whole."""
    folders = (tree / "tests", tree)
    folder = tree / "tests" / Path(file).parent
    while not list(folder.glob("test_*.py")):
        folder = folder.parent
    in_room = sorted(folder.glob("test_*.py"))
    candidates = list(in_room)
    while folder.parent not in folders:
        folder = folder.parent
        candidates += sorted(folder.glob("test_*.py"))
    direct = [path for path in candidates if module_name(file) in imported(path)]
    indirect = [path for path in in_room if path not in direct]
    return _relative(direct, tree), _relative(indirect, tree)


def _relative(paths: list[Path], tree: Path) -> list[str]:
    return [path.relative_to(tree).as_posix() for path in paths]
