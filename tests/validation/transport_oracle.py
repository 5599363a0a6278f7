"""Light transport by mitransient (Royo, Crespo and Garcia-Sierra: transient rendering for Mitsuba
3), as an oracle.

Its ``transient_path`` walks the same meshes with its own path tracer, its own emitters and its own
films: one that sums phasors, and one that keeps a time histogram. What is ours here is a list of
frequencies in place of the former's contiguous ones, the Fourier sum over the latter, and the way
from the lens to the near clip plane, on which a perspective camera's rays start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR
from scenes.optics import Optics
from scenes.render.scene import LitScene
from scenes.target.mesh import TargetPart

NEAR_CLIP_M = 1e-3
BINS = 3_000
BIN_M = 4e-3
"""The histogram's: 12 m of path. A bin is 0.017 rad at 198 MHz, so the place of a path within it
matters: a mean over a hundred pixels errs by 5e-4 rad, alike in all runs unless their bins start
at different places."""


@dataclass(frozen=True)
class Oracle:
    """mitransient's view of a scene by a lens without distortion and with its centre in the
    middle.

    The emitter is isotropic where the optics' cone is all directions, else a spot whose edge falls
    linearly in the angle (ours: in its cosine).
    """

    mi: Any
    optics: Optics
    _scene: Any
    _frequencies: tuple[float, ...]
    _histogram_from_m: float | None

    def phasors(
        self,
        paths: int,
        seed: int,
        bounces: int,
    ) -> np.ndarray:
        """(f, h, w) phasors of all light, in the units and with the sign of `scenes.optics`, from
        ``paths`` a pixel."""
        import drjit as dr

        integrator = self.mi.load_dict(
            {
                "type": "transient_path",
                "max_depth": bounces + 2,
                "rr_depth": 1000,
                "temporal_filter": "box",
                "gaussian_stddev": 0.0,
            }
        )
        _, raw = integrator.render(
            self._scene,
            seed=seed,
            spp=paths,
        )
        dr.eval(raw)
        if self._histogram_from_m is not None:
            values = self._transformed(np.array(raw)[..., 0])
        else:
            pairs = np.array(raw)
            values = pairs[..., 0] - 1j * pairs[..., 1]  # its film turns the other way
        slopes = self.optics.lens.region_slopes(self.optics.lens.whole)
        clipped_m = NEAR_CLIP_M * np.sqrt(1 + (slopes**2).sum(axis=-1))
        wave = 2 * np.pi * np.array(self._frequencies) / SPEED_OF_LIGHT_AIR
        return np.moveaxis(values, -1, 0) * np.exp(1j * wave[:, None, None] * clipped_m)

    def _transformed(self, histogram: np.ndarray) -> np.ndarray:
        """(h, w, f): the histogram (h, w, BINS) of path lengths as phasors; light is spread evenly
        over its bin."""
        wave = 2 * np.pi * np.array(self._frequencies) / SPEED_OF_LIGHT_AIR
        middle_m = self._histogram_from_m + (np.arange(BINS) + 0.5) * BIN_M
        turned = np.exp(1j * middle_m[:, None] * wave) * np.sinc(wave * BIN_M / (2 * np.pi))
        return np.asarray(histogram @ turned)


def oracle(
    lit: LitScene,
    optics: Optics,
    frequencies_hz: tuple[float, ...],
    *,
    histogram_from_m: float | None = None,
) -> Oracle:
    """An oracle for a scene that stands in Mitsuba already, by its phasor film or by a histogram
    of path lengths.

    Raises ImportError where mitransient is not installed.
    """
    import mitransient  # type: ignore[import-untyped]  # registers its plugins
    from mitransient.utils import ArrayXf  # type: ignore[import-untyped]

    mi = lit.mi
    lens = optics.lens
    assert mitransient.__name__
    assert not any(lens.distortion)
    assert (lens.cx, lens.cy) == ((lens.width - 1) / 2, (lens.height - 1) / 2)
    assert lens.fx == lens.fy
    is_histogram = histogram_from_m is not None
    film = mi.load_dict(
        {
            "type": "transient_hdr_film" if is_histogram else "phasor_hdr_film",
            "width": lens.width,
            "height": lens.height,
            "temporal_bins": BINS if is_histogram else 64,
            "bin_width_opl": BIN_M if is_histogram else 0.5,
            "start_opl": histogram_from_m or 0.0,
            "rfilter": {"type": "box"},
        }
    )
    if not is_histogram:
        film.frequencies = ArrayXf([mi.Float(f / SPEED_OF_LIGHT_AIR) for f in frequencies_hz])
    upright = mi.ScalarTransform4f().look_at(
        origin=[0, 0, 0],
        target=[0, 0, 1],
        up=[0, -1, 0],
    )
    sensor = {
        "type": "perspective",
        "fov": float(np.rad2deg(2 * np.arctan(lens.width / 2 / lens.fx))),
        "fov_axis": "x",
        "near_clip": NEAR_CLIP_M,
        "far_clip": 100.0,
        "to_world": upright,
        "film": film,
        "sampler": {"type": "independent"},
    }
    shapes = {f"shape_{k}": _mesh(mi, part) for k, part in enumerate(lit.parts)}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor,
            "emitter": _emitter(mi, optics),
            **shapes,
        }
    )
    return Oracle(mi, optics, scene, frequencies_hz, histogram_from_m)


def _mesh(mi: Any, part: TargetPart) -> Any:
    """One part as a Mitsuba mesh with face normals and a two-sided diffuse material."""
    reflectance: dict[str, Any] = {"type": "uniform", "value": float(part.albedo_850)}
    if part.texture_850 is not None:
        bitmap = mi.Bitmap(np.ascontiguousarray(part.texture_850[..., None], np.float32))
        reflectance = {
            "type": "bitmap",
            "bitmap": bitmap,
            "raw": True,
            "wrap_mode": "clamp",
        }
    properties = mi.Properties()
    textured = part.uv is not None
    material = {"type": "diffuse", "reflectance": reflectance}
    properties["material"] = mi.load_dict({"type": "twosided", "material": material})
    vertices = np.asarray(part.mesh.vertices, np.float32)
    faces = np.asarray(part.mesh.faces, np.uint32)
    mesh = mi.Mesh(
        part.name,
        len(vertices),
        len(faces),
        has_vertex_texcoords=textured,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel()
    parameters["faces"] = faces.ravel()
    if part.uv is not None:
        parameters["vertex_texcoords"] = np.asarray(part.uv, np.float32).ravel()
    parameters.update()
    return mesh


def _emitter(mi: Any, optics: Optics) -> dict[str, Any]:
    """An intensity of pi: an albedo of 1 then returns 1 from a plane at 1 m."""
    intensity = {"type": "uniform", "value": float(np.pi)}
    where = optics.emitter_m
    if optics.full_half_angle_deg >= 179:
        return {"type": "point", "position": where.tolist(), "intensity": intensity}
    x, y, z = where.tolist()
    ahead = mi.ScalarTransform4f().look_at(
        origin=[x, y, z],
        target=[x, y, z + 1],
        up=[0, -1, 0],
    )
    return {
        "type": "spot",
        "to_world": ahead,
        "intensity": intensity,
        "beam_width": optics.full_half_angle_deg,
        "cutoff_angle": optics.cutoff_half_angle_deg,
    }
