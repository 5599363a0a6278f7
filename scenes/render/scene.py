"""Mitsuba: loads it, builds a target's scene in the camera's frame, and answers the queries of
light transport."""

import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from harness.vocabulary.errors import UserError
from scenes.optics import Optics
from scenes.target.mesh import TargetPart

VARIANTS = ("cuda_ad_mono", "llvm_ad_mono")
LEGAL = "LLVM 17 or newer (14 to 16 abort the process with Dr.Jit 1.5)"
FIX = "pip install karellen-llvm-core (Linux x86-64), or set DRJIT_LIBLLVM_PATH to the path of such a library"


def load_mitsuba() -> Any:
    """Return the mitsuba module with a variant set. Raises UserError, with the package to install,
    if none works."""
    # Dr.Jit looks for LLVM when it is imported, so set the path first; it only matters without a
    # GPU.
    missing = _point_to_llvm()
    import mitsuba as mi

    if mi.variant() in VARIANTS or _works(mi, "cuda_ad_mono"):
        return mi
    if missing is not None:
        raise missing
    if _works(mi, "llvm_ad_mono"):
        return mi
    if "open3d" in sys.modules:
        # Both wheels contain a libc++.so.1; the first loaded serves both, and Open3D's is too old
        # for LLVM.
        message = "Mitsuba cannot run: Open3D was imported before it, and Open3D's C++ library replaces LLVM's"
        fix = "call scenes.render.scene.load_mitsuba() before importing open3d, or render in a process of its own"
        raise UserError(message, fix=fix)
    raise UserError(
        "Mitsuba cannot run: no NVIDIA GPU answers and no usable LLVM was found",
        legal=LEGAL,
        fix=FIX,
    )


def _works(mi: Any, name: str) -> bool:
    """Return whether the variant finds a ray's hit. A GPU whose driver lacks OptiX computes, but
    casts no rays."""
    if name not in mi.variants() or (name.startswith("cuda") and not _has_nvidia_driver()):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mi.set_variant(name)
            scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
            return bool(
                scene.ray_test(mi.Ray3f(mi.Point3f(0.1, 0.2, 1.0), mi.Vector3f(0.0, 0.0, -1.0)))[0]
            )
        except Exception:
            # Dr.Jit reports a missing backend by various exceptions; any of them means that this
            # variant does not work
            return False


def _has_nvidia_driver() -> bool:
    """Return whether there is an NVIDIA driver. Without it, Dr.Jit prints warnings that look like
    errors to a user."""
    return (
        Path("/proc/driver/nvidia/version").exists()
        or Path("/dev/nvidiactl").exists()
        or sys.platform == "win32"
    )


def _point_to_llvm() -> UserError | None:
    """Set DRJIT_LIBLLVM_PATH, if it is not set, to the LLVM of the wheel karellen-llvm-core;
    Dr.Jit's own search may choose one that aborts the process. Return the UserError to raise if no
    LLVM can be used."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        message = f"DRJIT_LIBLLVM_PATH names {named}, which does not exist"
        legal = "the path of LLVM 17 or newer"
        return (
            None
            if Path(named).exists()
            else UserError(message, legal=legal, fix="set or unset DRJIT_LIBLLVM_PATH")
        )
    for folder in (Path(sys.prefix) / "lib", Path(sys.base_prefix) / "lib"):
        found = sorted(folder.glob("libLLVM.so.*"), key=lambda p: (len(p.name), p.name))
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(found[-1])
            return None
    return UserError("no LLVM was found that Dr.Jit can use", legal=LEGAL, fix=FIX)


# of inputs: Dr.Jit uses memory of NumPy as it is, and compiles a kernel anew for other alignments
ALIGNED_BYTES = 64


def on_device(kind: Any, values: np.ndarray) -> Any:
    """Return values (n,) as a Dr.Jit array of ``kind``, aligned, so that kernels are compiled once
    for all boards."""
    room = np.empty(
        values.size + ALIGNED_BYTES // 4, np.uint32 if kind.__name__ == "UInt" else np.float32
    )
    placed = room[-room.ctypes.data % ALIGNED_BYTES // 4 :][: values.size]
    placed[:] = values
    return kind(placed)


# of a ray's start from a surface: float32 places hits within 1e-6 m; Mitsuba's default is 0.15 mm
LIFT_M = 1e-5


class Met(NamedTuple):
    """Hits of rays, as Dr.Jit arrays: whether there is a hit, its distance and position, the unit
    normal towards the ray's origin, the indices of surface and triangle, and the direction back
    along the ray."""

    valid: Any
    distance: Any
    place: Any
    normal: Any
    surface: Any
    triangle: Any
    viewer: Any


@dataclass(frozen=True)
class LitScene:
    """A target's parts as one Mitsuba mesh, and the emitter: a point with uniform intensity in a
    soft-edged cone. Mitsuba only finds the hits of rays: one shape without materials needs no
    virtual calls, so that all scenes share their compiled kernels. ``surface_of`` (index into
    ``parts``), ``normal_of`` and ``on_face`` are by triangle; ``albedos`` and, if any surface is
    glossy, ``gloss`` (share and exponent of the lobes) by surface. The part ``textured`` has
    ``texture``; -1 and None if there is none. Its coordinates are affine in position, by the eight
    ``uv_factors``: data, because constants would compile the kernels anew for each board. ``mi``,
    ``dr``: Mitsuba and Dr.Jit, loaded."""

    mi: Any
    dr: Any
    scene: Any
    parts: tuple[TargetPart, ...]
    emitter_m: np.ndarray
    cos_full: float
    cos_cutoff: float
    surface_of: Any
    normal_of: Any
    on_face: Any
    albedos: Any
    gloss: tuple[Any, Any] | None
    textured: int
    texture: Any
    uv_factors: list[Any]

    def meet(self, origin: Any, direction: Any, coherent: bool = False) -> Met:
        """Return the first hits of rays along unit directions. ``coherent``: neighbours are alike,
        which is a third of the time then, and twice the time otherwise, with the same hits."""
        mi = self.mi
        dr = self.dr
        found = self.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent)
        valid = found.is_valid()
        triangle = found.prim_index
        normal = dr.gather(mi.Normal3f, self.normal_of, triangle, valid)
        surface = dr.gather(mi.UInt32, self.surface_of, triangle, valid)
        normal = dr.mulsign(normal, -dr.dot(normal, direction))
        distance = dr.select(valid, found.t, 0)
        place = mi.Point3f(origin + distance * direction)
        return Met(valid, distance, place, normal, surface, triangle, -direction)

    def uv(self, place: Any) -> Any:
        """Return the texture coordinates of points on the textured part."""
        ux, uy, uz, u0, vx, vy, vz, v0 = self.uv_factors
        x = place.x
        y = place.y
        z = place.z
        return self.mi.Point2f(ux * x + uy * y + uz * z + u0, vx * x + vy * y + vz * z + v0)

    def albedo(self, met: Met) -> Any:
        """Return the albedo at hits; 0 if a ray met nothing."""
        dr = self.dr
        plain = dr.gather(self.mi.Float, self.albedos, met.surface, met.valid)
        if self.texture is None:
            return plain
        here = met.valid & (met.surface == self.textured)
        return dr.select(here, self.texture.eval(self.uv(met.place), here)[0], plain)

    def lobe(self, surface: Any, normal: Any, viewer: Any, direction: Any) -> Any:
        """Return the light that a surface reflects from ``direction`` to ``viewer``, over that of
        a Lambertian one of the same albedo: 1 - share + share (exponent + 2) / 2 cos^exponent. All
        directions leave the surface."""
        if self.gloss is None:
            return 1.0
        dr = self.dr
        share, exponent = (dr.gather(self.mi.Float, each, surface) for each in self.gloss)
        cosine = dr.dot(2 * dr.dot(normal, viewer) * normal - viewer, direction)
        return 1 - share + share * (exponent + 2) / 2 * dr.power(dr.maximum(cosine, 1e-6), exponent)

    def arriving(self, met: Met, coherent: bool = False, clear: Any = None) -> tuple[Any, Any]:
        """Return the light from the emitter at each hit: (irradiance, distance). The irradiance is
        cone(direction) cos(incidence) / d^2 times the `lobe`: 1 on a facing surface at 1 m, 0
        behind an occluder and without a hit. ``clear``: where nothing is between, if that is
        known."""
        mi = self.mi
        dr = self.dr
        emitter = mi.Point3f(*self.emitter_m.tolist())
        towards = emitter - met.place
        squared = dr.squared_norm(towards)
        distance = dr.sqrt(squared)
        towards /= distance
        cosine = dr.dot(met.normal, towards)
        on_axis = -towards.z
        cone = dr.clip((on_axis - self.cos_cutoff) / (self.cos_full - self.cos_cutoff), 0, 1)
        lit = met.valid & (cosine > 0) & (cone > 0)
        # occluders between the emitter and the side of the surface from which the ray came
        origin = met.place + LIFT_M * met.normal
        way = emitter - origin
        reach = dr.norm(way)
        ray = mi.Ray3f(origin, way / reach)
        ray.maxt = reach - 2 * LIFT_M
        lit &= ~self.scene.ray_test(ray, coherent, lit) if clear is None else clear
        lobe = self.lobe(met.surface, met.normal, met.viewer, towards)
        return dr.select(lit, cone * cosine / squared * lobe, 0), distance


def lit_scene(
    mi: Any,
    parts: Sequence[TargetPart],
    optics: Optics,
    on_face: Sequence[np.ndarray] | None = None,
) -> LitScene:
    """Build the scene from a target's parts, each with its albedo at 850 nm and its gloss; at most
    one has a texture. ``on_face``: for each part, which of its triangles (n,) lie on the undamaged
    face; None means none."""
    import drjit as dr

    whole: Any = trimesh.util.concatenate([part.mesh for part in parts])
    counts = [len(part.mesh.faces) for part in parts]
    vertices = np.asarray(whole.vertices, np.float32)
    faces = np.asarray(whole.faces, np.uint32)
    mesh = mi.Mesh("target", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel()
    parameters.update()
    corners = np.asarray(whole.vertices)[whole.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    textured = next((k for k, part in enumerate(parts) if part.texture_850 is not None), -1)
    texture = None
    uv_of = np.zeros((2, 4))
    if textured >= 0:
        part: Any = parts[textured]
        image = mi.TensorXf(np.ascontiguousarray(part.texture_850[..., None], np.float32))
        texture = mi.Texture2f(image, wrap_mode=dr.WrapMode.Clamp)
        places = np.column_stack([part.mesh.vertices, np.ones(len(part.mesh.vertices))])
        uv_of = np.linalg.lstsq(places, part.uv, rcond=None)[0].T
    flags = np.zeros(len(faces), bool) if on_face is None else np.concatenate(list(on_face))
    full = float(np.cos(np.deg2rad(optics.full_half_angle_deg)))
    cutoff = float(np.cos(np.deg2rad(optics.cutoff_half_angle_deg)))
    shares, exponents = (mi.Float([part.gloss[k] for part in parts]) for k in (0, 1))
    return LitScene(
        mi=mi,
        dr=dr,
        scene=mi.load_dict({"type": "scene", "target": mesh}),
        parts=tuple(parts),
        emitter_m=optics.emitter_m,
        cos_full=full,
        cos_cutoff=cutoff,
        surface_of=mi.UInt32(np.repeat(np.arange(len(parts)), counts).astype(np.uint32)),
        normal_of=mi.Float(normals.astype(np.float32).ravel()),
        on_face=mi.Bool(flags),
        albedos=mi.Float([float(part.albedo_850) for part in parts]),
        gloss=(shares, exponents) if any(part.gloss[0] > 0 for part in parts) else None,
        textured=textured,
        texture=texture,
        uv_factors=[dr.opaque(mi.Float, float(each)) for each in uv_of.ravel()],
    )
