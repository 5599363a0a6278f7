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

from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from harness.vocabulary.extras import load_extra
from scenes.optics import Optics
from scenes.target.mesh import TargetPart

VARIANTS = ("cuda_ad_mono", "metal_ad_mono", "llvm_ad_mono")
"""Fastest first; Mitsuba's wheels contain those that their system may have."""
LEGAL = "LLVM 17 or newer (14 to 16 abort the process with Dr.Jit 1.5)"
FIX = (
    "pip install karellen-llvm-core (Linux x86-64), brew install llvm (macOS) or install LLVM from "
    "llvm.org (Windows), or set DRJIT_LIBLLVM_PATH to the path of such a library"
)
# Dr.Jit uses memory of NumPy as it is, and compiles a kernel for each alignment
ALIGNED_BYTES = 64
# of a ray's start from a surface: float32 places hits within 1e-6 m; Mitsuba's default is 0.15 mm
LIFT_M = 1e-5


def load_mitsuba() -> Any:
    """Return the mitsuba module with a variant set. Raises UserError, with the package to install,
    if none works."""
    # Dr.Jit looks for LLVM when it is imported, so set the path first; it only matters without a
    # GPU.
    missing = _point_to_llvm()
    mi = load_extra("mitsuba", "a render")
    if mi.variant() in VARIANTS:
        return mi
    for variant in VARIANTS:
        if variant == "llvm_ad_mono" and missing is not None:
            raise missing
        if _works(mi, variant):
            return mi
    if "open3d" in sys.modules:
        # Both wheels contain a libc++.so.1; the first loaded serves both, and Open3D's is too old
        # for LLVM.
        raise UserError(
            "Mitsuba cannot run: Open3D was imported before it, "
            "and Open3D's C++ library replaces LLVM's",
            fix="call scenes.render.scene.load_mitsuba() before importing open3d, "
            "or render in a process of its own",
        )
    raise UserError(
        "Mitsuba cannot run: no NVIDIA GPU answers and no usable LLVM was found",
        legal=LEGAL,
        fix=FIX,
    )


def _works(mi: Any, name: str) -> bool:
    """Return whether the variant finds a ray's hit. A GPU whose driver lacks OptiX computes, but
    casts no rays."""
    if name not in mi.variants() or (name.startswith("cuda") and not system.has_nvidia_driver()):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mi.set_variant(name)
            scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
            ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 1.0), mi.Vector3f(0.0, 0.0, -1.0))
            return bool(scene.ray_test(ray)[0])
        except Exception:
            # Dr.Jit reports a missing backend by various exceptions; any of them means that this
            # variant does not work
            return False


def _point_to_llvm() -> UserError | None:
    """Set DRJIT_LIBLLVM_PATH, if it is not set, to the LLVM of the wheel karellen-llvm-core or of
    the system's usual installer; Dr.Jit's own search may choose one that aborts the process.
    Return the UserError to raise if no LLVM can be used."""
    declared = os.environ.get("DRJIT_LIBLLVM_PATH")
    if declared and Path(declared).exists():
        return None
    if declared:
        return UserError(
            f"DRJIT_LIBLLVM_PATH names {declared}, which does not exist",
            legal="the path of LLVM 17 or newer",
            fix="set or unset DRJIT_LIBLLVM_PATH",
        )
    found = system.llvm_libraries()
    if found:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(found[0])
        return None
    return UserError(
        "no LLVM was found that Dr.Jit can use",
        legal=LEGAL,
        fix=FIX,
    )


def on_device(kind: Any, values: np.ndarray) -> Any:
    """Return values (n,) as a Dr.Jit array of ``kind``, aligned, so that kernels are compiled once
    for all boards."""
    dtype = np.uint32 if kind.__name__ == "UInt" else np.float32
    buffer = np.empty(values.size + ALIGNED_BYTES // 4, dtype)
    begin = -buffer.ctypes.data % ALIGNED_BYTES // 4
    aligned = buffer[begin:][: values.size]
    aligned[:] = values
    return kind(aligned)


class Met(NamedTuple):
    """Hits of rays, as Dr.Jit arrays."""

    valid: Any
    """True where there is a hit."""
    distance: Any
    """Metres from the ray's origin; 0 without a hit."""
    point: Any
    """Position in the camera's frame."""
    normal: Any
    """Unit normal of the surface, towards the ray's origin."""
    surface: Any
    """Index of the surface."""
    triangle: Any
    """Index of the triangle."""
    viewer: Any
    """Unit direction back along the ray."""


@dataclass(frozen=True)
class LitScene:
    """A target's parts as one Mitsuba mesh, and the emitter: a point with uniform intensity in a
    soft-edged cone.

    Mitsuba only finds the hits of rays: one shape without materials needs no virtual calls, so
    that all scenes share their compiled kernels."""

    mi: Any
    """Mitsuba, loaded."""
    dr: Any
    """Dr.Jit, loaded."""
    scene: Any
    """The mesh as a Mitsuba scene."""
    parts: tuple[TargetPart, ...]
    """The surfaces, by index."""
    emitter_m: np.ndarray
    """(3,): the emitter, in the camera's frame."""
    cos_full: float
    """Cosine of the angle from the axis up to which the emitter has its full intensity."""
    cos_cutoff: float
    """Cosine of the angle at which nothing is left of it."""
    surface_of: Any
    """Index of the surface, by triangle."""
    normal_of: Any
    """Unit normal, by triangle."""
    on_face: Any
    """True on the undamaged face, by triangle."""
    albedos: Any
    """Mean albedo, by surface."""
    gloss: tuple[Any, Any] | None
    """Share and exponent of the lobes, by surface; None if no surface is glossy."""
    textured: int
    """Index of the surface with a texture; -1 if there is none."""
    texture: Any
    """Its albedo as a Mitsuba texture, or None."""
    uv_factors: list[Any]
    """Eight factors by which texture coordinates are affine in position: data, because constants
    would compile the kernels anew for each board."""

    def meet(
        self,
        origin: Any,
        direction: Any,
        coherent: bool = False,
    ) -> Met:
        """Return the first hits of rays along unit directions. ``coherent``: neighbours are alike,
        which is a third of the time then, and twice the time otherwise, with the same hits."""
        mi = self.mi
        dr = self.dr
        hit = self.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent)
        valid = hit.is_valid()
        triangle = hit.prim_index
        normal = dr.gather(mi.Normal3f, self.normal_of, triangle, valid)
        distance = dr.select(valid, hit.t, 0)
        return Met(
            valid=valid,
            distance=distance,
            point=mi.Point3f(origin + distance * direction),
            normal=dr.mulsign(normal, -dr.dot(normal, direction)),
            surface=dr.gather(mi.UInt32, self.surface_of, triangle, valid),
            triangle=triangle,
            viewer=-direction,
        )

    def uv(self, point: Any) -> Any:
        """Return the texture coordinates of points on the textured part."""
        ux, uy, uz, u0, vx, vy, vz, v0 = self.uv_factors
        u = ux * point.x + uy * point.y + uz * point.z + u0
        v = vx * point.x + vy * point.y + vz * point.z + v0
        return self.mi.Point2f(u, v)

    def albedo(self, met: Met) -> Any:
        """Return the albedo at hits; 0 if a ray met nothing."""
        dr = self.dr
        plain = dr.gather(self.mi.Float, self.albedos, met.surface, met.valid)
        if self.texture is None:
            return plain
        on_textured = met.valid & (met.surface == self.textured)
        value = self.texture.eval(self.uv(met.point), on_textured)[0]
        return dr.select(on_textured, value, plain)

    def lobe(
        self,
        surface: Any,
        normal: Any,
        viewer: Any,
        direction: Any,
    ) -> Any:
        """Return the light that a surface reflects from ``direction`` to ``viewer``, over that of
        a Lambertian one of the same albedo: 1 - share + share (exponent + 2) / 2 cos^exponent. All
        directions leave the surface."""
        if self.gloss is None:
            return 1.0
        dr = self.dr
        shares, exponents = self.gloss
        share = dr.gather(self.mi.Float, shares, surface)
        exponent = dr.gather(self.mi.Float, exponents, surface)
        mirrored = 2 * dr.dot(normal, viewer) * normal - viewer
        cosine = dr.maximum(dr.dot(mirrored, direction), 1e-6)
        return 1 - share + share * (exponent + 2) / 2 * dr.power(cosine, exponent)

    def arriving(
        self,
        met: Met,
        coherent: bool = False,
        clear: Any = None,
    ) -> tuple[Any, Any]:
        """Return the light from the emitter at each hit: (irradiance, distance).

        The irradiance is cone(direction) cos(incidence) / d^2 times the `lobe`: 1 on a facing
        surface at 1 m, 0 behind an occluder and without a hit. ``clear``: where nothing is
        between, if that is known."""
        mi = self.mi
        dr = self.dr
        emitter = mi.Point3f(self.emitter_m.tolist())
        towards = emitter - met.point
        squared = dr.squared_norm(towards)
        distance = dr.sqrt(squared)
        towards /= distance
        cosine = dr.dot(met.normal, towards)
        on_axis = -towards.z
        cone = dr.clip((on_axis - self.cos_cutoff) / (self.cos_full - self.cos_cutoff), 0, 1)
        lit = met.valid & (cosine > 0) & (cone > 0)
        if clear is None:
            # occluders between the emitter and the side of the surface from which the ray came
            origin = met.point + LIFT_M * met.normal
            to_emitter = emitter - origin
            reach = dr.norm(to_emitter)
            ray = mi.Ray3f(origin, to_emitter / reach)
            ray.maxt = reach - 2 * LIFT_M
            clear = ~self.scene.ray_test(ray, coherent, lit)
        lobe = self.lobe(met.surface, met.normal, met.viewer, towards)
        return dr.select(lit & clear, cone * cosine / squared * lobe, 0), distance


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

    vertices = np.concatenate([part.mesh.vertices for part in parts])
    vertex_counts = [len(part.mesh.vertices) for part in parts]
    first_vertices = np.cumsum(vertex_counts) - vertex_counts
    faces = np.concatenate(
        [part.mesh.faces + first for part, first in zip(parts, first_vertices, strict=True)]
    )
    mesh = mi.Mesh("target", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(
        np.linalg.norm(
            across,
            axis=1,
            keepdims=True,
        ),
        1e-30,
    )
    face_counts = [len(part.mesh.faces) for part in parts]
    surface_of = np.repeat(np.arange(len(parts)), face_counts)
    flags = np.zeros(len(faces), bool)
    if on_face is not None:
        flags = np.concatenate(list(on_face))
    gloss = None
    if any(part.gloss[0] > 0 for part in parts):
        shares = mi.Float([part.gloss[0] for part in parts])
        exponents = mi.Float([part.gloss[1] for part in parts])
        gloss = (shares, exponents)
    textured = -1
    texture = None
    uv_factors = np.zeros((2, 4))
    for index, part in enumerate(parts):
        if part.texture_850 is not None:
            textured = index
            image = np.ascontiguousarray(part.texture_850[..., None], np.float32)
            texture = mi.Texture2f(mi.TensorXf(image), wrap_mode=dr.WrapMode.Clamp)
            uv_factors = _uv_factors(part)
    return LitScene(
        mi=mi,
        dr=dr,
        scene=mi.load_dict({"type": "scene", "target": mesh}),
        parts=tuple(parts),
        emitter_m=optics.emitter_m,
        cos_full=float(np.cos(np.deg2rad(optics.full_half_angle_deg))),
        cos_cutoff=float(np.cos(np.deg2rad(optics.cutoff_half_angle_deg))),
        surface_of=mi.UInt32(surface_of.astype(np.uint32)),
        normal_of=mi.Float(normals.astype(np.float32).ravel()),
        on_face=mi.Bool(flags),
        albedos=mi.Float([float(part.albedo_850) for part in parts]),
        gloss=gloss,
        textured=textured,
        texture=texture,
        uv_factors=[dr.opaque(mi.Float, factor) for factor in uv_factors.ravel().tolist()],
    )


def _uv_factors(part: Any) -> np.ndarray:
    """Return the factors (2, 4) of x, y, z and 1 in a part's texture coordinates."""
    vertices = part.mesh.vertices
    with_one = np.column_stack([vertices, np.ones(len(vertices))])
    return np.asarray(np.linalg.lstsq(with_one, part.uv, rcond=None)[0].T)
