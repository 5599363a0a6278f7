"""A built target as files: PLY or GLB for viewers, JSON for its truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes, write_text
from harness.vocabulary.provenance import RESULTS_VERSION
from scenes.target.mesh import Target

MESH_SUFFIXES = (".glb", ".ply")


def write_mesh(target: Target, path: Path) -> None:
    """Write all parts, in metres, by the suffix of ``path``; colours are sRGB. ``.ply``: one binary mesh in the
    camera's frame (z forward, y down), each part's mean colour at its vertices. ``.glb``: one node a part, the grain as
    a texture, in glTF's frame (y up, the camera at the origin looks along -z). Raises UserError for another suffix or
    where the file cannot be written."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise UserError(f"{path}: no mesh format is called {suffix or 'nothing'!r}", legal=" or ".join(MESH_SUFFIXES))
    write_bytes(path, _ply(target) if suffix == ".ply" else _glb(target))


def write_truth(target: Target, path: Path) -> None:
    """Write as JSON: version, declaration, ``T_camera_board`` (metres) and one row in millimetres per damage."""
    data = {"results_version": RESULTS_VERSION, "target": target.config.to_data()}
    data |= {"T_camera_board": target.T_camera_board.tolist(), "damages": [each.to_row() for each in target.truth]}
    write_text(path, json.dumps(data, indent=2) + "\n")


def _ply(target: Target) -> bytes:
    import trimesh

    coloured = []
    for part in target.parts:
        colours = np.tile(np.append(_srgb_bytes(part.rgb), np.uint8(255)), (len(part.mesh.vertices), 1))
        coloured.append(trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, vertex_colors=colours, process=False))
    return trimesh.util.concatenate(coloured).export(None, file_type="ply")


def _glb(target: Target) -> bytes:
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    for part in target.parts:
        rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "name": part.name}
        if part.uv is None or part.texture_rgb is None:
            material = PBRMaterial(baseColorFactor=[*part.rgb, 1.0], **rough)
            visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(part.mesh.vertices), 2)), material=material)
        else:
            material = PBRMaterial(baseColorTexture=Image.fromarray(_srgb_bytes(part.texture_rgb)), **rough)
            # trimesh counts v upwards from the image's lower edge.
            visual = trimesh.visual.TextureVisuals(uv=part.uv * (1, -1) + (0, 1), material=material)
        mesh = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, visual=visual, process=False)
        # No normals: glTF viewers then shade each facet flat, which keeps the rims of holes sharp.
        scene.add_geometry(mesh, node_name=part.name, geom_name=part.name, transform=upright)
    return scene.export(file_type="glb", include_normals=False)


def _srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """Return linear reflectance in 0..1 as 8-bit sRGB (IEC 61966-2-1)."""
    linear = np.asarray(linear, dtype=float)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)
