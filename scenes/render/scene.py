"""Mitsuba: how it runs, a target as its scene in the camera's frame, and what light transport asks of it."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.vocabulary.errors import UserError
from scenes.optics import Optics
from scenes.target.mesh import TargetPart

VARIANTS = ("cuda_ad_mono", "llvm_ad_mono")
LEGAL = "LLVM 17 or newer (14 to 16 abort the process with Dr.Jit 1.5)"
FIX = "pip install karellen-llvm-core (Linux x86-64), or apt install libllvm19, or set DRJIT_LIBLLVM_PATH"


def load_mitsuba() -> Any:
    """Return the mitsuba module with a variant set. Raises UserError that names what to install where none works.
    Dr.Jit 1.5 aborts the process at the first kernel with LLVM 14 to 16, so the LLVM of the wheel karellen-llvm-core is
    preferred to the system's; a path in DRJIT_LIBLLVM_PATH has the last word."""
    # Dr.Jit looks for LLVM when it is imported, so the path comes first; that there is none matters without a GPU only.
    missing = _point_to_llvm()
    import mitsuba as mi

    if mi.variant() in VARIANTS or _works(mi, "cuda_ad_mono"):
        return mi
    if missing is not None:
        raise missing
    if _works(mi, "llvm_ad_mono"):
        return mi
    if "open3d" in sys.modules:
        # Both wheels bring a libc++.so.1; the first that is loaded serves both, and Open3D's is too old for LLVM.
        raise UserError(
            "Mitsuba cannot run: Open3D was imported before it, and its C++ library stands in for the one of LLVM",
            fix="call scenes.render.scene.load_mitsuba() before importing open3d, or render in a process of its own",
        )
    raise UserError("Mitsuba cannot run: no NVIDIA GPU answers and no usable LLVM was found", legal=LEGAL, fix=FIX)


def _works(mi: Any, name: str) -> bool:
    """Tell whether a small kernel runs in the variant."""
    if name not in mi.variants() or (name.startswith("cuda") and not _has_nvidia_driver()):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mi.set_variant(name)
            import drjit as dr

            return bool(dr.sum(mi.Float(1.0, 2.0) * 2.0)[0] == 6.0)
        except Exception:
            # Dr.Jit reports a missing backend by exceptions of several types; any of them means "not this one".
            return False


def _has_nvidia_driver() -> bool:
    """Tell whether there is a driver: without it Dr.Jit prints warnings that a user would take for a fault."""
    return Path("/proc/driver/nvidia/version").exists() or Path("/dev/nvidiactl").exists() or sys.platform == "win32"


def _point_to_llvm() -> UserError | None:
    """Set DRJIT_LIBLLVM_PATH where it is not set, to the wheel's LLVM or the newest of the system, because Dr.Jit's own
    search may pick an older one. Returns the mistake to raise where no LLVM can be used."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        message, legal = f"DRJIT_LIBLLVM_PATH names {named}, which does not exist", "the path of LLVM 17 or newer"
        return None if Path(named).exists() else UserError(message, legal=legal, fix="mend or unset DRJIT_LIBLLVM_PATH")
    for folder in (Path(sys.prefix) / "lib", Path(sys.base_prefix) / "lib"):
        found = sorted(folder.glob("libLLVM.so.*"), key=lambda p: (len(p.name), p.name))
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(found[-1])
            return None
    recent = _system_llvm() if sys.platform == "linux" else None
    if recent is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(recent)
    elif sys.platform == "linux":
        return UserError("no LLVM was found that Dr.Jit can use", legal=LEGAL, fix=FIX)
    return None


def _system_llvm() -> Path | None:
    """Return the newest LLVM where distributions put it."""
    for version in range(30, 16, -1):
        for pattern in (f"*/libLLVM-{version}.so*", f"*/libLLVM.so.{version}*", f"llvm-{version}/lib/libLLVM*.so*"):
            for root in (Path("/usr/lib"), Path("/usr/lib64")):
                found = sorted(root.glob(pattern))
                if found:
                    return found[0]
    return None


LIFT_M = 1e-5
"""Distance from a surface at which a ray starts. float32 places hits within 1e-6 m in a room of metres; Mitsuba's own
lift, 0.15 mm at 0.7 m, is a tenth of the smallest hole."""


def facing(interaction: Any) -> Any:
    """The geometric normal on the side from which the ray came."""
    import drjit as dr

    return dr.mulsign(interaction.n, interaction.wi.z)


@dataclass(frozen=True)
class LitScene:
    """A Mitsuba scene with the emitter described beside it: a point with uniform intensity in a soft-edged cone.
    ``names`` are the surfaces in order; `surface_index` maps a hit to them. ``gloss``: share and exponent of their
    lobes, None where nothing is glossy. Mitsuba supplies geometry, textures and
    visibility; the emitter stays outside so that its phase and its connection to each vertex are ours."""

    mi: Any
    scene: Any
    names: tuple[str, ...]
    emitter_m: np.ndarray
    cos_full: float
    cos_cutoff: float
    gloss: tuple[Any, Any] | None
    _identity: Any
    _first_triangle: Any
    _on_face: Any

    def surface_index(self, interaction: Any) -> Any:
        """Return the index into ``names`` of each hit; meaningless where the ray met nothing."""
        import drjit as dr

        number: Any = dr.reinterpret_array(self.mi.UInt32, interaction.shape)
        return dr.gather(self.mi.UInt32, self._identity, number)

    def on_face(self, interaction: Any, active: Any) -> Any:
        """Tell whether each hit lies on a triangle that was said to belong to the undamaged face."""
        import drjit as dr

        first = dr.gather(self.mi.UInt32, self._first_triangle, self.surface_index(interaction), active)
        return dr.gather(self.mi.Bool, self._on_face, first + interaction.prim_index, active)

    def lobe(self, surface: Any, normal: Any, viewer: Any, direction: Any) -> Any:
        """Return what a surface reflects from ``direction`` to ``viewer``, as a multiple of what a Lambertian one of
        the same albedo would: 1 - share + share (exponent + 2) / 2 cos^exponent. All directions leave the surface."""
        import drjit as dr

        if self.gloss is None:
            return 1.0
        share, exponent = (dr.gather(self.mi.Float, each, surface) for each in self.gloss)
        cosine = dr.dot(2 * dr.dot(normal, viewer) * normal - viewer, direction)
        return 1 - share + share * (exponent + 2) / 2 * dr.power(dr.maximum(cosine, 1e-6), exponent)

    def reflected(self, interaction: Any, direction: Any) -> Any:
        """Return `lobe` of hits, from ``direction`` back along the ray that met them."""
        viewer = interaction.to_world(interaction.wi)
        return self.lobe(self.surface_index(interaction), facing(interaction), viewer, direction)

    def arriving(self, interaction: Any, active: Any) -> tuple[Any, Any]:
        """Light from the emitter at each hit: (irradiance, distance), irradiance 1 at 1 m facing; 0 where shadowed.
        irradiance = cone(direction) cos(incidence) / d^2, times `reflected`, and 0 behind an occluder."""
        import drjit as dr

        mi = self.mi
        emitter = mi.Point3f(*self.emitter_m.tolist())
        towards = emitter - interaction.p
        squared = dr.squared_norm(towards)
        distance = dr.sqrt(squared)
        towards /= distance
        cosine = dr.dot(facing(interaction), towards)
        on_axis = -towards.z
        cone = dr.clip((on_axis - self.cos_cutoff) / (self.cos_full - self.cos_cutoff), 0, 1)
        lit = active & (cosine > 0) & (cone > 0)
        # what stands between the surface, on the side from which the ray came, and the emitter
        origin = interaction.p + LIFT_M * facing(interaction)
        way = emitter - origin
        reach = dr.norm(way)
        ray = mi.Ray3f(origin, way / reach)
        ray.maxt = reach - 2 * LIFT_M
        lit &= ~self.scene.ray_test(ray, lit)
        return dr.select(lit, cone * cosine / squared * self.reflected(interaction, towards), 0), distance


def lit_scene(
    mi: Any, parts: Sequence[TargetPart], optics: Optics, on_face: Sequence[np.ndarray] | None = None
) -> LitScene:
    """Build the scene from a target's parts, each with its albedo at 850 nm and its gloss. ``on_face``: for each
    part which of its triangles (n,) lie on the undamaged face; None means none."""
    import drjit as dr

    names = tuple(part.name for part in parts)
    description = {"type": "scene", **{part.name: _mesh(mi, part) for part in parts}}
    scene = mi.load_dict(description)
    registered: np.ndarray = mi.UInt32(dr.reinterpret_array(mi.UInt32, scene.shapes_dr())).numpy()
    identity = np.zeros(int(registered.max()) + 1, np.uint32)
    for shape, number in zip(scene.shapes(), registered, strict=True):
        identity[number] = names.index(shape.id())
    triangles = [np.zeros(len(part.mesh.faces), bool) for part in parts] if on_face is None else list(on_face)
    first = np.cumsum([0, *(len(flags) for flags in triangles[:-1])]).astype(np.uint32)
    full, cutoff = (float(np.cos(np.deg2rad(a))) for a in (optics.full_half_angle_deg, optics.cutoff_half_angle_deg))
    faces = mi.UInt32(identity), mi.UInt32(first), mi.Bool(np.concatenate(triangles))
    shares, exponents = (mi.Float([part.gloss[k] for part in parts]) for k in (0, 1))
    gloss = (shares, exponents) if any(part.gloss[0] > 0 for part in parts) else None
    return LitScene(mi, scene, names, optics.emitter_m, full, cutoff, gloss, *faces)


def _mesh(mi: Any, part: TargetPart) -> Any:
    """Return one part as a Mitsuba mesh with face normals and a two-sided diffuse material."""
    reflectance: dict[str, Any] = {"type": "uniform", "value": float(part.albedo_850)}
    if part.texture_850 is not None:
        bitmap = mi.Bitmap(np.ascontiguousarray(part.texture_850[..., None], np.float32))
        reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    properties, textured = mi.Properties(), part.uv is not None
    material = {"type": "diffuse", "reflectance": reflectance}
    properties["material"] = mi.load_dict({"type": "twosided", "material": material})
    vertices, faces = np.asarray(part.mesh.vertices, np.float32), np.asarray(part.mesh.faces, np.uint32)
    mesh = mi.Mesh(part.name, len(vertices), len(faces), has_vertex_texcoords=textured, props=properties)
    mesh.set_id(part.name)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel()
    if part.uv is not None:
        parameters["vertex_texcoords"] = np.asarray(part.uv, np.float32).ravel()
    parameters.update()
    return mesh
