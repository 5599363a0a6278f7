"""A stranger's recording: a view with a camera's faults, its true damage, and the files that a
stranger would keep."""

from __future__ import annotations

import contextlib
import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy.io

from harness.programs.camera import flatfield
from tests.strangers.world import Camera, CastView, Damage, Surface, cast

CLEAR_D = 3 * 5.5
"""A damage is clearly visible from three times the d' that an ideal observer needs (90 % found at
about one false call a view: d' 5.5) ..."""
CLEAR_PIXELS = 9
CLEAR_PEAK = 3.0
CLEAR_SHARE = 0.15
"""... where it has that many pixels, stands out of an averaged pixel's noise by that factor, and its radius is at most
that share of the target's half width (wider is shape of the target, not damage)."""
CLEAR_LOG_ODDS = 36.0
"""A hole without return is clearly visible where chance alone would leave such a gap with odds of
e^-36 or less."""


@dataclass(frozen=True)
class Noise:
    """A camera's faults. ``white_m`` of one pixel in one frame; ``blur_px`` > 0 correlates it over
    neighbours and keeps its size; ``tail``: Student's t with 3 degrees in place of a Gaussian;
    ``fixed_m`` the same in every frame."""

    white_m: float = 1e-3
    blur_px: float = 0.0
    tail: bool = False
    fixed_m: float = 0.0
    fixed_px: float = 1.5
    dropout: float = 0.0
    clusters: int = 0
    mixing_px: float = 0.0


@dataclass(frozen=True)
class Format:
    """The files: ``kind`` png, npy, npz, mat, ply, pcd or xyz; one stored unit in metres (floats
    store ``unit_m`` too); what stands for no return; more arguments that the stranger would know
    to give."""

    kind: str = "png"
    unit_m: float = 1e-3
    invalid: float = 0
    arguments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Truth:
    """One true damage. Lengths in metres, camera frame; ``depth_m`` ranges over what may rightly
    be called its depth (along the normal, along z), ``diameter_m`` likewise (at half depth, at the
    rim)."""

    centre_m: tuple[float, float, float]
    radius_m: float
    kind: str
    depth_m: tuple[float, float]
    diameter_m: tuple[float, float]
    clear: bool
    noise_m: float


@dataclass(frozen=True)
class Stranger:
    """A scene and how it was recorded. ``ignored`` (h, w): pixels where a finding is neither right
    nor false, because something real is there; ``doubtful``: no answer is right without a warning;
    ``per_frame(k, depth)`` changes the noise-free depth of frame k; ``louder`` (h, w) multiplies
    the noise; from ``gone`` (h, w) nothing returns; ``offset_m`` (h, w) is added to the depth.
    ``flat_field``: a flat field that must not correct it, made of its own frames ("own") or of
    other frames from the same place ("same place").
    ``model``: the project's own camera that takes the frames, from phasors without
    interreflection; ``noise`` then says only what is clearly visible in them."""

    surfaces: list[Surface]
    camera: Camera
    noise: Noise = Noise()
    format: Format = Format()
    frames: int = 8
    doubtful: bool = False
    ignored: np.ndarray | None = None
    louder: np.ndarray | None = None
    gone: np.ndarray | None = None
    offset_m: np.ndarray | None = None
    per_frame: Callable[[int, np.ndarray], np.ndarray] | None = None
    model: str = ""
    flat_field: str = ""


def recorded(
    stranger: Stranger, rng: np.random.Generator
) -> tuple[np.ndarray, CastView, tuple[Truth, ...]]:
    """(frames (n, h, w) in metres with NaN for no return, the noise-free view, the truth)."""
    view = cast(stranger.surfaces, stranger.camera)
    if stranger.model:
        return _simulated(stranger, int(rng.integers(1000))), view, _truths(stranger, view)
    noise = stranger.noise
    shape = view.depth_m.shape
    clean = view.depth_m if stranger.offset_m is None else view.depth_m + stranger.offset_m
    if noise.mixing_px:
        clean = _mixed(clean, noise.mixing_px)
    clean = clean + noise.fixed_m * _field(rng, shape, noise.fixed_px) if noise.fixed_m else clean
    gone = np.zeros(shape, bool) if stranger.gone is None else stranger.gone
    gone = gone | _clusters(rng, shape, noise.clusters)
    louder = 1.0 if stranger.louder is None else stranger.louder
    stack = np.empty((stranger.frames, *shape), np.float32)
    for k in range(stranger.frames):
        depth = clean if stranger.per_frame is None else stranger.per_frame(k, clean)
        frame = depth + noise.white_m * louder * _field(rng, shape, noise.blur_px, noise.tail)
        frame[gone | (rng.random(shape) < noise.dropout)] = np.nan
        stack[k] = frame
    return stack, view, _truths(stranger, view)


def _simulated(stranger: Stranger, unit: int, finer: int = 3) -> np.ndarray:
    """Frames of the project's own camera model: phasors of ``finer`` x ``finer`` rays a pixel,
    light by r^-2."""
    from harness.vocabulary.geometry import Region
    from scenes.optics import NoiseFreeView
    from scenes.sensor.camera import load_camera
    from scenes.sensor.common.config import CameraConfig
    from scenes.sensor.source import SimulatedUnit

    camera, (h, w) = stranger.camera, (stranger.camera.height, stranger.camera.width)
    model = load_camera(stranger.model)
    slopes = camera.slopes(finer)
    range_m = cast(stranger.surfaces, camera, finer).depth_m * np.sqrt(1 + (slopes**2).sum(axis=-1))
    light = np.where(np.isfinite(range_m), 0.7 / range_m**2, 0.0)
    turn = 4j * np.pi / 299_792_458.0 * np.nan_to_num(range_m)

    def pixels(fine: np.ndarray) -> np.ndarray:
        return fine.reshape(h, finer, w, finer).mean(axis=(1, 3))

    phasor = np.stack([pixels(light * np.exp(turn * f)) for f in model.frequencies_hz]).astype(
        np.complex64
    )
    middle = range_m[finer // 2 :: finer, finer // 2 :: finer]
    view = NoiseFreeView(
        region=Region(0, h, 0, w),
        frequencies_hz=model.frequencies_hz,
        phasor=phasor,
        phasor_direct=phasor,
        intensity=pixels(light).astype(np.float32),
        indirect_noise_m=np.zeros((h, w), np.float32),
        range_m=middle.astype(np.float32),
        surface=np.where(np.isfinite(middle), 0, -1).astype(np.int16),
        surface_names=("scene",),
        coverage=np.ones((h, w), np.float32),
        rgb=np.full((h, w, 3), 0.7, np.float32),
        slopes=camera.slopes(),
        seconds=0.0,
        variant="",
    )
    unit_of = SimulatedUnit(model, CameraConfig(name=stranger.model, unit_seed=unit), view)
    return np.stack([frame.z_m for frame in unit_of.capture(stranger.frames, unit).frames()])


def _field(
    rng: np.random.Generator, shape: tuple[int, ...], blur_px: float, tail: bool = False
) -> np.ndarray:
    """A random field of deviation 1."""
    drawn = rng.standard_t(3, shape) / np.sqrt(3) if tail else rng.normal(size=shape)
    if not blur_px:
        return drawn
    size = 2 * int(np.ceil(2.5 * blur_px)) + 1
    kernel = cv2.getGaussianKernel(size, blur_px)
    return cv2.sepFilter2D(drawn, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT) / float(
        (kernel**2).sum()
    )


def _gain(blur_px: float) -> float:
    """How many times more a correlated field of deviation 1 holds at the lowest frequencies than a
    white one."""
    return max(1.0, 2 * np.sqrt(np.pi) * blur_px)


def _mixed(depth: np.ndarray, blur_px: float) -> np.ndarray:
    """Depth averaged over the pixel's footprint: flying pixels at every edge. Beyond the image it
    goes on straight."""
    beyond = 4
    depth = np.pad(depth, beyond, mode="reflect", reflect_type="odd")
    reference = np.isfinite(depth)
    weight = cv2.GaussianBlur(reference.astype(float), (0, 0), blur_px)
    total = cv2.GaussianBlur(np.where(reference, depth, 0.0), (0, 0), blur_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0.5, total / weight, np.nan)[beyond:-beyond, beyond:-beyond]


def _clusters(rng: np.random.Generator, shape: tuple[int, ...], count: int) -> np.ndarray:
    """Ragged patches of 2 to 6 pixels' radius from which nothing returns: a frame's bad spots, not
    holes."""
    seeds = np.zeros(shape)
    for _ in range(count):
        cv2.circle(
            seeds,
            (int(rng.integers(shape[1])), int(rng.integers(shape[0]))),
            int(rng.integers(2, 7)),
            1.0,
            -1,
        )
    return (seeds > 0) & (rng.random(shape) < 0.6)


def _truths(stranger: Stranger, view: CastView) -> tuple[Truth, ...]:
    """Every damage, and whether it is clearly visible in this recording."""
    noise = stranger.noise
    n = stranger.frames
    step = stranger.format.unit_m if stranger.format.kind == "png" else 0.0
    rounding = step**2 / 12 / (n if noise.white_m > step / 2 else 1)
    pixel = float(np.sqrt(noise.white_m**2 / n / (1 - noise.dropout) + noise.fixed_m**2 + rounding))
    white = noise.white_m * _gain(noise.blur_px)
    fixed = noise.fixed_m * _gain(noise.fixed_px)
    broad = float(np.sqrt(white**2 / n / (1 - noise.dropout) + fixed**2 + rounding))
    louder = np.ones(view.depth_m.shape) if stranger.louder is None else stranger.louder
    rate = min(max(noise.dropout**n, 1e-3), 1.0)
    gone = np.zeros(view.depth_m.shape, bool) if stranger.gone is None else stranger.gone
    truths = []
    i = 0
    for surface in stranger.surfaces:
        half = min(surface.half_x_m, surface.half_y_m)
        half = min(half, _seen_half_m(surface, stranger.camera))
        for damage in surface.damages:
            (pixels, signal), hidden = view.footprints[i], view.hidden[i]
            i += 1
            lost = ~np.isfinite(signal)
            complete = hidden < 0.05 and pixels.size and not gone.reshape(-1)[pixels].any()
            loud = float(louder.reshape(-1)[pixels].mean()) if pixels.size else 1.0
            reference = signal[~lost]
            absent = lost.sum() > 0.5 * max(pixels.size, 1)
            if absent:
                observed = (
                    lost.sum() >= CLEAR_PIXELS and lost.sum() * np.log(1 / rate) >= CLEAR_LOG_ODDS
                )
            else:
                d = np.sqrt(np.sum(reference**2)) / broad / loud if reference.size else 0.0
                peak = (
                    float(np.percentile(np.abs(reference), 90)) / pixel / loud
                    if reference.size
                    else 0.0
                )
                observed = d >= CLEAR_D and peak >= CLEAR_PEAK and reference.size >= CLEAR_PIXELS
            truths.append(
                _truth(
                    surface,
                    damage,
                    reference,
                    absent,
                    bool(complete and observed),
                    half,
                    pixel * loud,
                )
            )
    return tuple(truths)


def _seen_half_m(surface: Surface, camera: Camera) -> float:
    """Half the view's smaller side at the surface."""
    return float(surface.origin_m[2]) * min(camera.width, camera.height) / camera.f_px / 2


def _truth(
    surface: Surface,
    damage: Damage,
    known: np.ndarray,
    absent: bool,
    seen: bool,
    half_m: float,
    noise_m: float,
) -> Truth:
    extent = damage.radius_m + damage.length_m / 2
    along_z = float(np.percentile(np.abs(known), 90)) if known.size else abs(damage.depth_m)
    least = abs(damage.depth_m)
    if damage.profile == "through":  # from its wall to what is behind
        least, along_z = np.percentile(np.abs(known), [25, 98]) if known.size else (np.inf, np.inf)
    depths = sorted((float(least), float(along_z)))
    tapered = damage.profile in ("bowl", "cosine", "cone")
    inner = (0.5 if tapered else 1.0) * 2 * damage.radius_m
    kind = "bump" if damage.depth_m < 0 else "hole"
    if absent:
        kind = "no return"
    return Truth(
        centre_m=tuple(float(v) for v in surface.point_m(damage.x_m, damage.y_m)),  # type: ignore[arg-type]
        radius_m=extent,
        kind=kind,
        depth_m=(depths[0], depths[1]),
        diameter_m=(inner, 2 * extent),
        clear=seen
        and (
            absent
            or damage.profile in ("flat", "through", "slot")
            or extent <= CLEAR_SHARE * 2 * half_m
        ),
        noise_m=noise_m,
    )


# ---- files
# -----------------------------------------------------------------------------------------------------------


def written(stranger: Stranger, stack: np.ndarray, folder: Path) -> Path:
    """Write the frames as the stranger keeps them; returns the path that `tofpod detect` is
    given."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = stranger.camera
    form = stranger.format
    lens: dict[str, object] = {
        "fx": camera.f_px,
        "fy": camera.f_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
    }
    lens |= {"width": camera.width, "height": camera.height}
    if any(camera.distortion):
        lens["distortion"] = list(camera.distortion)
    if form.kind in ("png", "npy", "npz", "mat"):
        (folder / "intrinsic.json").write_text(json.dumps(lens))
    stored = np.where(np.isfinite(stack), stack / form.unit_m, form.invalid)
    if form.kind == "png":
        for k, image in enumerate(stored):
            cv2.imwrite(
                str(folder / f"depth_{k:03d}.png"),
                np.clip(np.round(image), 0, 65535).astype(np.uint16),
            )
        return folder
    path = folder / f"depth.{form.kind}"
    stored = stored.astype(np.float32)
    if form.kind == "npy":
        np.save(path, stored)
    elif form.kind == "npz":
        np.savez_compressed(path, depth=stored)
    elif form.kind == "mat":
        scipy.io.savemat(path, {"depth": stored[0]}, do_compression=True)
    else:
        return _clouds(stranger, stored, folder)
    return path


def flat_field_arguments(
    stranger: Stranger, rng: np.random.Generator, path: Path
) -> tuple[str, ...]:
    """Make the flat field that the stranger uses for the recording at ``path``; returns the
    arguments that name it."""
    if not stranger.flat_field:
        return ()
    source = path
    if stranger.flat_field == "same place":
        again, _, _ = recorded(stranger, rng)
        source = written(stranger, again, path.with_name("again"))
    field = path.with_name("unit.npz")
    with contextlib.redirect_stdout(io.StringIO()):
        code = flatfield.main([str(source), "--out", str(field)])
    assert code == 0, f"no flat field of {source}"
    return ("--flat-field", str(field))


def _clouds(stranger: Stranger, stored: np.ndarray, folder: Path) -> Path:
    """Each frame as a cloud: binary PLY without a grid, organised binary PCD, or one text file of
    points."""
    slopes = stranger.camera.slopes().astype(np.float32)
    kind, (h, w) = stranger.format.kind, stored.shape[1:]
    for k, z in enumerate(stored):
        points = np.dstack([slopes * z[..., None], z]).astype("<f4").reshape(-1, 3)
        if kind != "pcd":
            points = points[np.isfinite(z.reshape(-1))]
        path = folder / f"cloud_{k:03d}.{kind}"
        if kind == "ply":
            names = "".join(f"property float {axis}\n" for axis in "xyz")
            head = (
                "ply\nformat binary_little_endian 1.0\nelement vertex "
                f"{len(points)}\n{names}end_header\n"
            )
            path.write_bytes(head.encode() + points.tobytes())
        elif kind == "pcd":
            head = (
                "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
                f"WIDTH {w}\nHEIGHT {h}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {w * h}\nDATA binary\n"
            )
            path.write_bytes(
                head.encode() + struct.pack(f"<{points.size}f", *points.ravel().tolist())
            )
        else:
            np.savetxt(path, points, fmt="%.5f")
            return path
    return folder
