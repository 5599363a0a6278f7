"""``python -m harness.target``: build a target, print its truth, write its mesh and its truth."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError, exit_code_of

if TYPE_CHECKING:
    from pydantic import ValidationError

    from scenes.target.declaration import TargetConfig
    from scenes.target.mesh import Target

NAMED_TARGETS = ("thesis",)


def main(argv: list[str] | None = None) -> int:
    """Run the program; returns its exit code (0, or 2 for the user's mistake)."""
    arguments = _parser().parse_args(argv)
    return exit_code_of(lambda: _run(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.target",
        description="Build a damage target from its declaration; print its truth, write its mesh.",
        epilog="example: python -m harness.target thesis --out board.glb --truth truth.json",
    )
    parser.add_argument(
        "target", help=f"a named target ({', '.join(NAMED_TARGETS)}) or a YAML or JSON file that declares one"
    )
    parser.add_argument("--out", type=Path, metavar="MESH", help="where to write the mesh: .glb (textured) or .ply")
    parser.add_argument("--truth", type=Path, metavar="JSON", help="where to write each damage's size, place and axis")
    parser.add_argument("--hole-free", action="store_true", help="leave out holes and dents")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    config = _declared(arguments.target)

    from scenes.target.export import write_mesh, write_truth
    from scenes.target.mesh import build_target

    target = build_target(config.hole_free() if arguments.hole_free else config)
    for path, write in ((arguments.out, write_mesh), (arguments.truth, write_truth)):
        if path is not None:
            write(target, path)
            print(f"wrote {path}")
    print(_summary(target))
    return 0


def _summary(target: Target) -> str:
    """The truth as a table, one damage a line, and what else was built."""
    titles = ("id", "kind", "diameter mm", "depth mm", "volume mm3", "x camera mm", "y camera mm", "z camera mm")
    lines = ["  ".join(f"{title:>11}" for title in titles)]
    for damage in target.truth:
        row = damage.to_row()
        numbers = [row["diameter_mm"], row["depth_mm"], row["volume_mm3"], *(row[f"{a}_camera_mm"] for a in "xyz")]
        lines.append("  ".join([f"{row['id']:>11}  {row['kind']:>11}", *(f"{number:11.3f}" for number in numbers)]))
    if not target.truth:
        lines = ["no holes, no dents"]
    triangles = sum(len(part.mesh.faces) for part in target.parts)
    return "\n".join([*lines, f"{triangles} triangles: {', '.join(part.name for part in target.parts)}"])


# ---- reading a declaration -------------------------------------------------------------------------------------------


def _declared(name_or_path: str) -> TargetConfig:
    from pydantic import ValidationError

    from scenes.target.declaration import target_from_data

    if name_or_path in NAMED_TARGETS:
        return target_from_data({"name": name_or_path}).declare()
    path = Path(name_or_path)
    data = _read(path)
    try:
        json.dumps(data)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: holds something that is no number, text, list or mapping ({error})") from error
    try:
        return target_from_data(data).declare()
    except ValidationError as error:
        raise UserError(
            "the declaration is not valid:\n" + "\n".join(_problems(path, data, error)),
            legal="name: thesis with its open facts, or name: custom with board, holes, dents, tapes, ...",
            fix="mend the places named above; millimetres, metres and degrees are in the keys' names",
        ) from error


def _read(path: Path) -> Any:
    """Data of a YAML or JSON file. JSON is read as YAML 1.2, which contains it, so that places are known in both."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(
            f"{path}: no such file, and no target of that name", legal=f"{', '.join(NAMED_TARGETS)} or a file"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as text ({error})") from error
    try:
        return YAML(typ="rt").load(text.replace("\t", "  ") if path.suffix.lower() == ".json" else text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise UserError(f"{place}: {error.problem or 'not valid YAML'}", fix="mend the file's syntax") from error
    except YAMLError as error:
        raise UserError(f"{path}: not valid YAML ({error})") from error


def _problems(path: Path, data: Any, error: ValidationError) -> list[str]:
    """One line a problem: file:line:column, the key, what is wrong."""
    lines = []
    for problem in error.errors():
        line, column, keys = _place(data, problem["loc"])
        where = f"{path}:{line}:{column}" if line else str(path)
        lines.append(f"  - {where}: {'.'.join(keys) or 'the whole file'}: {problem['msg']}")
    return lines


def _place(data: Any, loc: tuple[int | str, ...]) -> tuple[int, int, list[str]]:
    """Line and column (from 1; 0 if unknown) of the deepest node on pydantic's path that exists, and the path's keys.

    The path also names which kind of a union was tried; such steps are no keys of the data and are passed over.
    """
    line = column = 0
    keys: list[str] = []
    for depth, step in enumerate(loc):
        if isinstance(data, dict) and step in data:
            place = data.lc.key(step)  # type: ignore[attr-defined]
        elif isinstance(data, list) and isinstance(step, int) and step < len(data):
            place = data.lc.item(step)  # type: ignore[attr-defined]
        elif depth == len(loc) - 1:
            # A key that is missing: the message is about it, its place is its parent's.
            return line, column, [*keys, str(step)]
        else:
            continue
        line, column = place[0] + 1, place[1] + 1
        data = data[step]
        keys.append(str(step))
    return line, column, keys


if __name__ == "__main__":
    sys.exit(main())
