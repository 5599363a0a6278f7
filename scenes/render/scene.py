"""A target as a Mitsuba scene in the camera's frame, and the questions that light transport asks of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenes.optics import Optics
from scenes.target.mesh import TargetPart

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

    ``names`` are the surfaces in order; `surface_index` maps a hit to them. Mitsuba supplies geometry, textures and
    visibility; the emitter stays outside so that its phase and its connection to each vertex are ours.
    """

    mi: Any
    scene: Any
    names: tuple[str, ...]
    emitter_m: np.ndarray
    cos_full: float
    cos_cutoff: float
    _identity: Any
    _first_triangle: Any
    _on_face: Any

    def surface_index(self, interaction: Any) -> Any:
        """Index into ``names`` of each hit; meaningless where the ray met nothing."""
        import drjit as dr

        number: Any = dr.reinterpret_array(self.mi.UInt32, interaction.shape)
        return dr.gather(self.mi.UInt32, self._identity, number)

    def on_face(self, interaction: Any, active: Any) -> Any:
        """Tell whether each hit lies on a triangle that was said to belong to the undamaged face."""
        import drjit as dr

        mi = self.mi
        first = dr.gather(mi.UInt32, self._first_triangle, self.surface_index(interaction), active)
        return dr.gather(mi.Bool, self._on_face, first + interaction.prim_index, active)

    def arriving(self, interaction: Any, active: Any) -> tuple[Any, Any]:
        """Light from the emitter at each hit: (irradiance, distance), irradiance 1 at 1 m facing; 0 where shadowed.

        irradiance = cone(direction) cos(incidence) / d^2, and 0 behind an occluder.
        """
        import drjit as dr

        mi = self.mi
        towards = mi.Point3f(*self.emitter_m.tolist()) - interaction.p
        squared = dr.squared_norm(towards)
        distance = dr.sqrt(squared)
        towards /= distance
        cosine = dr.dot(facing(interaction), towards)
        on_axis = -towards.z
        cone = dr.clip((on_axis - self.cos_cutoff) / (self.cos_full - self.cos_cutoff), 0, 1)
        lit = active & (cosine > 0) & (cone > 0)
        lit &= ~self.blocked(interaction.p, facing(interaction), mi.Point3f(*self.emitter_m.tolist()), lit)
        return dr.select(lit, cone * cosine / squared, 0), distance

    def blocked(self, point: Any, normal: Any, target: Any, active: Any) -> Any:
        """Tell whether something stands between a surface's point, on the side of ``normal``, and a point in front of
        it."""
        import drjit as dr

        mi = self.mi
        origin = point + LIFT_M * normal
        towards = target - origin
        distance = dr.norm(towards)
        ray = mi.Ray3f(origin, towards / distance)
        ray.maxt = distance - 2 * LIFT_M
        return self.scene.ray_test(ray, active)


def lit_scene(
    mi: Any, parts: Sequence[TargetPart], optics: Optics, on_face: Sequence[np.ndarray] | None = None
) -> LitScene:
    """Build the scene from a target's parts, each a Lambertian surface with its 850 nm albedo.

    ``on_face``: for each part which of its triangles (n,) lie on the undamaged face; None means none.
    """
    import drjit as dr

    description: dict[str, Any] = {"type": "scene"}
    names = tuple(part.name for part in parts)
    for part in parts:
        description[part.name] = _mesh(mi, part)
    scene = mi.load_dict(description)
    shapes = scene.shapes()
    registered: np.ndarray = mi.UInt32(dr.reinterpret_array(mi.UInt32, scene.shapes_dr())).numpy()
    identity = np.zeros(int(registered.max()) + 1, np.uint32)
    for shape, number in zip(shapes, registered, strict=True):
        identity[number] = names.index(shape.id())
    triangles = [np.zeros(len(part.mesh.faces), bool) for part in parts] if on_face is None else list(on_face)
    first = np.cumsum([0, *(len(flags) for flags in triangles[:-1])])
    return LitScene(
        mi=mi,
        scene=scene,
        names=names,
        emitter_m=optics.emitter_m,
        cos_full=float(np.cos(np.deg2rad(optics.full_half_angle_deg))),
        cos_cutoff=float(np.cos(np.deg2rad(optics.cutoff_half_angle_deg))),
        _identity=mi.UInt32(identity),
        _first_triangle=mi.UInt32(first.astype(np.uint32)),
        _on_face=mi.Bool(np.concatenate(triangles)),
    )


def _mesh(mi: Any, part: TargetPart) -> Any:
    """One part as a Mitsuba mesh with face normals and a two-sided diffuse material."""
    material = mi.load_dict(
        {"type": "twosided", "material": {"type": "diffuse", "reflectance": _reflectance(mi, part)}}
    )
    properties = mi.Properties()
    properties["material"] = material
    vertices = np.asarray(part.mesh.vertices, np.float32)
    faces = np.asarray(part.mesh.faces, np.uint32)
    mesh = mi.Mesh(
        part.name,
        vertex_count=len(vertices),
        face_count=len(faces),
        has_vertex_texcoords=part.uv is not None,
        props=properties,
    )
    mesh.set_id(part.name)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel()
    parameters["faces"] = faces.ravel()
    if part.uv is not None:
        parameters["vertex_texcoords"] = np.asarray(part.uv, np.float32).ravel()
    parameters.update()
    return mesh


def _reflectance(mi: Any, part: TargetPart) -> dict[str, Any]:
    if part.texture_850 is None:
        return {"type": "uniform", "value": float(part.albedo_850)}
    bitmap = mi.Bitmap(np.ascontiguousarray(part.texture_850[..., None], np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
