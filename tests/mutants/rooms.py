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
    """Return the test files of a module's room: those that import the module, and the others. The
    room's tests stand in the folder of ``tests`` with the module's path, or else in the nearest
    folder around it that has tests. If that is ``tests`` itself, only files that import the module
    count or, without any, those that import something of its package."""
    folder = tree / "tests" / Path(file).parent
    while not list(folder.glob("test_*.py")):
        folder = folder.parent
    paths = sorted(folder.glob("test_*.py"))
    direct = [path for path in paths if module_name(file) in imported(path)]
    further = [path for path in paths if path not in direct]
    if folder == tree / "tests":
        further = [] if direct else [path for path in paths if _imports_package(path, file)]
    return _relative(direct, tree), _relative(further, tree)


def _imports_package(path: Path, file: str) -> bool:
    """Return whether a test file imports something of the package of a module."""
    package = module_name(str(Path(file).parent))
    return any(f"{name}.".startswith(f"{package}.") for name in imported(path))


def _relative(paths: list[Path], tree: Path) -> list[str]:
    return [path.relative_to(tree).as_posix() for path in paths]
