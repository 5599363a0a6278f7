"""Prints how the folders of code depend on each other: ``python tests/structure.py [ROOT]``.

A room is a folder with code; each file directly in `harness`, `scenes` or `detectors` stands alone,
because these files are doors that others come in by. An arrow leads from a room to another one that
it imports, also inside functions and for type checks. A circle is a set of modules, or of rooms,
each of which reaches all others along imports. ``from a.b import c`` imports the module ``a.b.c`` if there is one, and
otherwise ``a.b``. Asking a package for its version is no import here. Modules that are loaded by a
name in a text are not seen.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

CODE_FOLDERS = ("harness", "scenes", "detectors")
PROGRAMS = "harness.programs"
VERSION = "__version__"
Graph = dict[str, set[str]]


def modules_in(root: Path) -> dict[str, Path]:
    """Return the source files of a checkout by module name."""
    modules: dict[str, Path] = {}
    for folder in CODE_FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            name = ".".join(parts).removesuffix(".__init__")
            modules[name] = path
    return modules


def imports_of(module: str, path: Path, modules: Mapping[str, Path]) -> Iterator[str]:
    """Yield the project's modules that a module imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in modules:
                    yield alias.name
        elif isinstance(node, ast.ImportFrom):
            package = absolute_name(module, path, node)
            for alias in node.names:
                if alias.name == VERSION:
                    continue
                submodule = f"{package}.{alias.name}"
                if submodule in modules:
                    yield submodule
                elif package in modules:
                    yield package


def absolute_name(module: str, path: Path, node: ast.ImportFrom) -> str:
    """Return the full name of what ``from .. import`` imports from."""
    if node.level == 0:
        return node.module or ""
    parts = module.split(".")
    dropped = node.level - (path.name == "__init__.py")
    start = parts[: len(parts) - dropped]
    return ".".join([*start, node.module] if node.module else start)


def module_graph(modules: Mapping[str, Path]) -> Graph:
    """Return the imports of each module, without those of itself."""
    graph: Graph = {}
    for module, path in modules.items():
        graph[module] = set(imports_of(module, path, modules)) - {module}
    return graph


def room_graph(graph: Graph, modules: Mapping[str, Path]) -> Graph:
    """Return the arrows of each room."""
    room_names = {module: room_of(module, modules) for module in graph}
    rooms: Graph = {}
    for module, imported in graph.items():
        room = room_names[module]
        targets = {room_names[target] for target in imported}
        rooms.setdefault(room, set()).update(targets - {room})
    return rooms


def room_of(module: str, modules: Mapping[str, Path]) -> str:
    """Return the dotted name of a module's folder, or its own name if it is a door."""
    is_package = modules[module].name == "__init__.py"
    folder = module if is_package else module.rpartition(".")[0]
    return module if folder in CODE_FOLDERS else folder


def circles(graph: Graph) -> list[list[str]]:
    """Return the strongly connected components of two members and more, the largest first."""
    reached = {start: reachable(graph, start) for start in graph}
    components: list[list[str]] = []
    grouped: set[str] = set()
    for start in sorted(graph):
        if start in grouped or start not in reached[start]:
            continue
        circle = [name for name in sorted(reached[start]) if start in reached[name]]
        grouped.update(circle)
        components.append(circle)
    return sorted(components, key=len, reverse=True)


def reachable(graph: Graph, start: str) -> set[str]:
    """Return what can be reached along one arrow and more; the start itself only by a circle."""
    reached: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting.extend(graph[name])
    return reached


def program_of(module: str) -> str | None:
    """Return the program's room that a module belongs to, or None."""
    below = module.removeprefix(f"{PROGRAMS}.")
    return None if below == module else below.split(".")[0]


def arrows_to_programs(graph: Graph) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
    """Return the arrows among programs, and the imports of programs by modules of the core."""
    among_programs: set[tuple[str, str]] = set()
    from_core: set[tuple[str, str]] = set()
    for module, imported in graph.items():
        program = program_of(module)
        for target in imported:
            target_program = program_of(target)
            if target_program is None or target_program == program:
                continue
            if program is None:
                from_core.add((module, target))
            else:
                among_programs.add((program, target_program))
    return among_programs, from_core


def report_lines(root: Path) -> Iterator[str]:
    """Yield the figures of a checkout."""
    modules = modules_in(root)
    graph = module_graph(modules)
    rooms = room_graph(graph, modules)
    among_programs, from_core = arrows_to_programs(graph)
    yield f"modules: {len(modules)}"
    yield f"rooms: {len(rooms)}"
    yield f"arrows between rooms: {sum(map(len, rooms.values()))}"
    yield from _circle_lines("modules", circles(graph))
    yield from _circle_lines("rooms", circles(rooms))
    yield f"arrows among the rooms of programs: {len(among_programs)}"
    yield from (f"    {program} -> {target}" for program, target in sorted(among_programs))
    yield f"imports of programs by the core: {len(from_core)}"
    yield from (f"    {module} -> {target}" for module, target in sorted(from_core))


def _circle_lines(kind: str, components: list[list[str]]) -> Iterator[str]:
    yield f"circles of {kind}: {len(components)}"
    for circle in components:
        yield f"    {len(circle)}: {', '.join(circle)}"


def main() -> int:
    """Print the figures. Returns 0."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    root = Path(__file__).resolve().parents[1]
    parser.add_argument("root", type=Path, nargs="?", default=root, help="another checkout")
    options = parser.parse_args()
    for line in report_lines(options.root):
        print(line)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
