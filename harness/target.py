"""``tofpod target``: builds a target, prints its truth, and writes its mesh and truth."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program
from harness.vocabulary.words import nearest

if TYPE_CHECKING:
    from scenes.target.custom import TargetConfig

NAMED_TARGETS = ("thesis",)


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "target",
        help=(
            f"a named target ({', '.join(NAMED_TARGETS)}) or a YAML or JSON file that declares one"
        ),
    )
    add("--out", type=Path, metavar="MESH", help="file for the mesh: .glb (textured) or .ply")
    add("--truth", type=Path, metavar="JSON", help="file for each damage's size, place and axis")
    add(
        "--board",
        type=int,
        default=0,
        metavar="N",
        help="number of the damaged board of a family (default: 0)",
    )
    add("--hole-free", action="store_true", help="leave out all damage")


@program(
    _options,
    "Build a target with damage from its declaration, print its truth, and write its mesh.",
    "tofpod target thesis --out board.glb --truth truth.json",
    "tofpod target thesis --hole-free --out board.ply",
)
def main(arguments: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake."""
    config = declared(arguments.target, arguments.board)

    from harness.vocabulary.text import Grid, show
    from scenes.target.mesh import build_target, write_mesh, write_truth

    target = build_target(config.hole_free() if arguments.hole_free else config)
    for path, write in ((arguments.out, write_mesh), (arguments.truth, write_truth)):
        if path is not None:
            write(target, path)
            print(f"wrote {path}")
    rows = [damage.to_row() for damage in target.truth]
    keys = ("diameter_mm", "depth_mm", "volume_mm3", *(f"{axis}_camera_mm" for axis in "xyz"))
    cells = [(row["id"], row["kind"], *(f"{row[key]:.3f}" for key in keys)) for row in rows]
    heads = ("id", "kind", *(key.replace("_", " ") for key in keys))
    show([Grid.of(heads, cells, left=2)] if rows else ["no damage"])
    triangles = sum(len(part.mesh.faces) for part in target.parts)
    print(f"{triangles} triangles: {', '.join(part.name for part in target.parts)}")
    return 0


def declared(what: str | Path | Mapping[str, Any], board: int) -> TargetConfig:
    """Return a target by name, from a file or from a declaration; of a family, the ``board``.
    Raises UserError."""
    from harness.vocabulary.declaration.diagnose import read_as, settings_of
    from harness.vocabulary.declaration.yaml_source import read_yaml
    from scenes.target.drawn import DrawnTargetConfig
    from scenes.target.thesis import TARGETS

    what = {"name": what} if what in NAMED_TARGETS else what
    if isinstance(what, Mapping):
        if what.get("name") not in TARGETS:
            raise UserError(
                f"there is no target {what.get('name')!r}", legal=f"name: {', '.join(TARGETS)}"
            )
        config = settings_of(TARGETS[what["name"]], what, "target")
    elif not Path(what).exists():
        meant = nearest(what, NAMED_TARGETS)
        raise UserError(
            f"{what}: there is no such file or named target"
            + (f"; did you mean {meant!r}?" if meant else ""),
            legal=f"{', '.join(NAMED_TARGETS)} or a file",
        )
    else:
        config = read_as(TARGETS, "name", read_yaml(Path(what)))
    if isinstance(config, DrawnTargetConfig):
        if board < 0:
            raise UserError(f"board {board}: is not a number from 0 upwards")
        return config.drawn("damaged", board)
    if board:
        raise UserError(
            f"board {board}: the target is a single board, not a family", legal="board 0"
        )
    return config.declare()


if __name__ == "__main__":
    raise SystemExit(main())
