"""A tilted plane with one blind hole, written in every format that is read; its true points are
known."""

from __future__ import annotations

import json
import struct
import zipfile
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from harness.vocabulary.geometry import Lens

LENS = Lens(width=96, height=72, fx=150.0, fy=151.0, cx=47.0, cy=36.0)
HOLE_U = 60
HOLE_V = 30
HOLE_RADIUS_PX = 6.0
HOLE_DEPTH_MM = 14.0
DISTANCE_M = 0.5
NO_RETURN = (3, 5)
"""(row, column) that every frame leaves out."""


def slopes() -> np.ndarray:
    """(h, w, 2) x/z and y/z."""
    return LENS.region_slopes(LENS.whole)


def depth_mm(frame: int = 0, hole: bool = True, noise_mm: float = 0.0) -> np.ndarray:
    """(h, w) whole millimetres, uint16, 0 at `NO_RETURN`."""
    x = slopes()[..., 0]
    z_mm = 1e3 * DISTANCE_M / (1.0 - 0.2 * x)
    v, u = np.mgrid[: LENS.height, : LENS.width]
    if hole:
        z_mm = z_mm + HOLE_DEPTH_MM * (np.hypot(u - HOLE_U, v - HOLE_V) < HOLE_RADIUS_PX)
    noise = noise_mm * np.random.default_rng([7, frame]).normal(size=z_mm.shape)
    stored = np.rint(z_mm + noise).astype(np.uint16)
    stored[NO_RETURN] = 0
    return stored


def points_m(stored_mm: np.ndarray) -> np.ndarray:
    """(h, w, 3) points of a depth image, NaN where it holds 0."""
    z = np.where(stored_mm == 0, np.nan, stored_mm / 1e3)
    return np.concatenate([slopes() * z[..., None], z[..., None]], axis=-1)


def rgb(frame: int = 0) -> np.ndarray:
    """(h, w, 3) uint8, different in each frame."""
    v, u = np.mgrid[: LENS.height, : LENS.width]
    return np.stack([u, v, np.full_like(u, 10 * frame)], axis=-1).astype(np.uint8)


def write_open3d_folder(
    folder: Path, frames: int = 3, noise_mm: float = 0.0, hole: bool = True
) -> Path:
    """depth/*.png, color/*.png and intrinsic.json as Open3D's recorder leaves them."""
    for name in ("depth", "color"):
        (folder / name).mkdir(parents=True)
    for i in range(frames):
        cv2.imwrite(str(folder / "depth" / f"{i:05d}.png"), depth_mm(i, hole, noise_mm))
        cv2.imwrite(str(folder / "color" / f"{i:05d}.png"), rgb(i)[..., ::-1])
    matrix = LENS.matrix.T.ravel().tolist()
    text = json.dumps({"width": LENS.width, "height": LENS.height, "intrinsic_matrix": matrix})
    (folder / "intrinsic.json").write_text(text)
    return folder


def write_lens(path: Path) -> Path:
    path.write_text(json.dumps({"fx": LENS.fx, "fy": LENS.fy, "cx": LENS.cx, "cy": LENS.cy}))
    return path


def _pcd_header(points: np.ndarray, organised: bool, kind: str) -> bytes:
    height, width = points.shape[:2] if organised else (1, points[..., 0].size)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {width * height}\nDATA {kind}\n"
    )
    return header.encode()


def write_pcd(path: Path, points: np.ndarray, organised: bool = True, cut: int = 0) -> Path:
    """A binary PCD with colour; ``cut`` bytes are missing at the end."""
    rows = np.zeros(points[..., 0].size, dtype=[("xyz", "<f4", 3), ("rgb", "<u4")])
    rows["xyz"] = points.reshape(-1, 3)
    rows["rgb"] = 0x102030
    content = _pcd_header(points, organised, "binary") + rows.tobytes()
    path.write_bytes(content[: len(content) - cut])
    return path


def write_packed_pcd(path: Path, points: np.ndarray, organised: bool = True) -> Path:
    """A PCD in the form of compressed ones, with all x first, then all y, z and colours."""
    fields = points.reshape(-1, 3).T.astype("<f4").tobytes()
    colours = np.full(points[..., 0].size, 0x102030, "<u4").tobytes()
    plain = fields + colours
    packed = lzf_literals(plain)
    sizes = struct.pack("<II", len(packed), len(plain))
    path.write_bytes(_pcd_header(points, organised, "binary_compressed") + sizes + packed)
    return path


def lzf_literals(plain: bytes) -> bytes:
    """Bytes in LZF as they are: in runs of at most 32, each behind its length less one."""
    runs = [plain[start : start + 32] for start in range(0, len(plain), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def write_ply(path: Path, points: np.ndarray, grid: bool = True, cut: int = 0) -> Path:
    """A binary PLY with colour, its grid in obj_info as range scanners state it."""
    height, width = points.shape[:2]
    info = f"obj_info num_cols {width}\nobj_info num_rows {height}\n" if grid else ""
    header = (
        f"ply\nformat binary_little_endian 1.0\n{info}element vertex {width * height}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    rows = np.zeros(width * height, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"] = points.reshape(-1, 3)
    rows["rgb"] = (16, 32, 48)
    content = header.encode() + rows.tobytes()
    path.write_bytes(content[: len(content) - cut])
    return path


def write_points(
    path: Path,
    points: np.ndarray,
    head: str = "",
    separator: str = " ",
    ending: str = "",
    decimal: str = ".",
    before: str = "",
) -> Path:
    """A point a line, with something ``before`` and after its three numbers."""
    start = f"{before}{separator}" if before else ""
    lines = []
    for point in points.reshape(-1, 3).tolist():
        row = separator.join(f"{x:.9f}".replace(".", decimal) for x in point)
        lines.append(f"{start}{row}{ending}\n")
    path.write_text(head + "".join(lines))
    return path


def write_stray(folder: Path, frames: int, step_m: float = 0.0) -> Path:
    """Stray Scanner's folder: the lens of 1920 x 1440 pixels, poses ``step_m`` apart."""
    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    across = 1920 / LENS.width
    down = 1440 / LENS.height
    cx = (LENS.cx + 0.5) * across - 0.5
    cy = (LENS.cy + 0.5) * down - 0.5
    matrix = f"{LENS.fx * across}, 0, {cx}\n0, {LENS.fy * down}, {cy}\n0, 0, 1\n"
    (folder / "camera_matrix.csv").write_text(matrix)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(frames):
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), depth_mm(i))
        sure = np.full((LENS.height, LENS.width), 2, np.uint8)
        cv2.imwrite(str(folder / "confidence" / f"{i:06d}.png"), sure)
        lines.append(f"{i / 60}, {i:06d}, {i * step_m}, 0, 0, 0, 0, 0, 1")
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    return folder


def write_r3d(path: Path, frames: int, step_m: float = 0.0) -> Path:
    """Record3D's archive, its depth packed by the LZFSE package."""
    import lzfse

    k = [2 * LENS.fx, 0, 0, 0, 2 * LENS.fy, 0, 2 * LENS.cx + 0.5, 2 * LENS.cy + 0.5, 1]
    poses = [[0, 0, 0, 1, i * step_m, 0, 0] for i in range(frames)]
    size = {"w": 2 * LENS.width, "h": 2 * LENS.height, "dw": LENS.width, "dh": LENS.height}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps({"K": k, **size, "fps": 30, "poses": poses}))
        for i in range(frames):
            depth = np.where(depth_mm(i) == 0, np.nan, depth_mm(i) / 1e3).astype("<f4")
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(depth.tobytes()))
            sure = np.full(depth.shape, 2, np.uint8)
            archive.writestr(f"rgbd/{i}.conf", lzfse.compress(sure.tobytes()))
    return path


def write_opaque_mat(path: Path) -> Path:
    """What ``save('x.mat', 'pc')`` leaves of a pointCloud: an MCOS object (MAT-file level 5, class
    17)."""

    def element(kind: int, content: bytes) -> bytes:
        padded = content + bytes(-len(content) % 8)
        return np.array([kind, len(content)], "<u4").tobytes() + padded

    def words(*values: int) -> bytes:
        return np.array(values, "<u4").tobytes()

    header = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\x00\x01IM"
    reference = element(6, words(13, 0)) + element(5, words(6, 1)) + element(1, b"")
    reference += element(6, words(0xDD000000, 2, 1, 1, 1, 1))
    names = element(1, b"pc") + element(1, b"MCOS") + element(1, b"pointCloud")
    content = element(6, words(17, 0)) + names + element(14, reference)
    path.write_bytes(header + element(14, content))
    return path


def calibration(purposes: tuple[str, ...] = ("Depth", "PhotoVideo")) -> bytes:
    """A factory calibration with round numbers; the colour camera 50 mm to the right, without
    distortion."""
    depth = [0.51, 0.52, 0.49, 0.5, 0.55, -0.02, -0.003, 0.89, 0.086, -0.014, 0.0, 0.0, -7e-5, 2e-5]
    colour = [0.5, 0.5, 0.48, 0.64] + [0.0] * 10
    cameras = []
    for purpose, numbers, size, shift in (
        ("Depth", depth, (1024, 1024), [0.0, 0.0, 0.0]),
        ("PhotoVideo", colour, (4096, 3072), [-0.05, 0.0, 0.0]),
    ):
        if purpose in purposes:
            cameras.append(
                {
                    "Intrinsics": {
                        "ModelParameters": numbers,
                        "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                    },
                    "Purpose": f"CALIBRATION_CameraPurpose{purpose}",
                    "Rt": {"Rotation": np.eye(3).ravel().tolist(), "Translation": shift},
                    "SensorWidth": size[0],
                    "SensorHeight": size[1],
                }
            )
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}}).encode() + b"\0"


def write_mkv(
    path: Path,
    frames: list[dict[str, np.ndarray]],
    mode: str = "NFOV_UNBINNED",
    attached: bytes | None = None,
) -> Path:
    """Tracks titled as k4arecorder does, losslessly coded, one picture of each title a frame at 5
    Hz."""
    import av

    with av.open(str(path), "w", format="matroska") as container:
        streams = {}
        for title, picture in frames[0].items():
            stream = container.add_stream("ffv1", rate=5)
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "gray16le" if picture.ndim == 2 else "bgr0"
            stream.metadata["title"] = title
            if title == "DEPTH":
                stream.metadata["K4A_DEPTH_MODE"] = mode
            streams[title] = stream
        if attached is not None:
            container.add_attachment("calibration.json", "application/octet-stream", attached)
        for i, pictures in enumerate(frames):
            for title, picture in pictures.items():
                form = "gray16le" if picture.ndim == 2 else "rgb24"
                image = av.VideoFrame.from_ndarray(picture, format=form)
                image = image.reformat(format=streams[title].pix_fmt)
                image.pts = i
                image.time_base = Fraction(1, 5)
                container.mux(streams[title].encode(image))
        for stream in streams.values():
            container.mux(stream.encode())
    return path
