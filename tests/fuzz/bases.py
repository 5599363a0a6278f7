"""Valid inputs of every format that the programs read, as small as they may be."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from contextlib import redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import scipy.io
import trimesh
from rosbags.rosbag2 import CompressionMode

from tests.support import bag_of_a_plane as bags
from tests.support import recorded_plane as plane
from tests.support import tiny_dataset, tiny_sweep
from tests.support.exr_files import write_exr
from tests.support.synthetic_study import study_record

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 3
MANY = 24
"""Frames of the captures from which a camera is measured."""
LIST = 40
"""Side of the part of the plane that is written as text."""
TARGET = """\
name: custom
board: {width_mm: 130, height_mm: 90, thickness_mm: 12.7}
flaws: [{kind: slot, id: 1, centre_mm: [10, 5], width_mm: 2, length_mm: 30, depth_mm: 5}]
"""
PART = """\
name: mesh
file: parts/part.stl
unit: mm
front: "+z"
flaws: [{kind: slot, id: 1, centre_mm: [10, 5], width_mm: 2, length_mm: 30, depth_mm: 5}]
pose: {distance_m: 0.7, tilt_x_deg: 10}
"""
FAMILY = """\
name: drawn
damage: {kind: blind, per_board: 3, diameter_mm: [4, 12], depth_mm: [2, 6]}
board: {width_mm: 200, height_mm: 150, thickness_mm: 12.7}
"""
VIEWS = """\
  views: {kind: arc, count: 3, spread_deg: 30.0, about: y}
mapping: {registration: {method: icp}}
"""


def written_bases(folder: Path) -> Path:
    """Write all valid inputs into a folder, unless they are there already."""
    if (folder / "finished").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    _write_captures(folder)
    _write_clouds(folder)
    _write_bags(folder)
    _write_beside(folder)
    _write_tables(folder)
    _write_runs(folder)
    (folder / "finished").touch()
    return folder


def _write_captures(base: Path) -> None:
    plane.write_open3d_folder(base / "pngs", FRAMES, noise_mm=0.6)
    frames = np.stack([plane.depth_mm(i, noise_mm=0.6) for i in range(FRAMES)])
    many = np.stack([plane.depth_mm(i, hole=False, noise_mm=0.6) for i in range(MANY)])
    noise_mm = np.random.default_rng(3).normal(0, 0.6, (MANY // 2, 288, 320))
    binned = np.rint(800 + noise_mm).astype(np.uint16)
    np.save(_new(base, "binned") / "depth.npy", binned)
    for name, stack in (("depth", frames), ("wall", many), ("far", many + 300)):
        (base / name).mkdir()
        np.save(base / name / "depth.npy", stack)
        plane.write_lens(base / name / "intrinsics.json")
    arrays = {"depth": frames, "amplitude": np.ones(frames.shape, np.float32)}
    np.savez(_new(base, "npz") / "depth.npz", **arrays)
    scipy.io.savemat(_new(base, "mat") / "depth.mat", {"depth": frames[0]})
    cv2.imwritemulti(str(_new(base, "tiff") / "depth.tiff"), list(frames))
    cv2.imwrite(str(_new(base, "pfm") / "depth.pfm"), frames[0].astype(np.float32) / 1e3)
    write_exr(_new(base, "exr") / "depth.exr", {"Z": frames[0].astype(np.float32) / 1e3})
    frames.astype("<u2").tofile(_new(base, "raw") / "depth.bin")
    for name in ("npz", "mat", "tiff", "pfm", "exr", "raw"):
        plane.write_lens(base / name / "intrinsics.json")
    heights = (1e3 - frames[0].astype(np.float32)) / 1e3
    np.save(_new(base, "height") / "height.npy", heights)
    plane.write_stray(base / "stray", FRAMES)
    _write_r3d(_new(base, "r3d") / "a.r3d")
    picture = np.zeros((288, 320), np.uint16) + 800
    pictures = [{"DEPTH": picture, "IR": picture}] * 2
    mkv = _new(base, "mkv") / "a.mkv"
    plane.write_mkv(mkv, pictures, "NFOV_2X2BINNED", plane.calibration())


def _write_r3d(path: Path) -> None:
    """Write Record3D's archive, with a package that is an extra; without it, unpacked depth, which
    is refused, but only after the archive's description has been read."""
    if find_spec("lzfse") is not None:
        plane.write_r3d(path, FRAMES)
        return
    matrix = [2 * plane.LENS.fx, 0, 0, 0, 2 * plane.LENS.fy, 0, 94.5, 72.5, 1]
    size = {"w": 192, "h": 144, "dw": 96, "dh": 72, "fps": 30}
    poses = [[0, 0, 0, 1, 0, 0, 0]] * FRAMES
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps({"K": matrix, **size, "poses": poses}))
        for i in range(FRAMES):
            depth_m = plane.depth_mm(i).astype("<f4") / 1e3
            archive.writestr(f"rgbd/{i}.depth", depth_m.tobytes())


def _write_clouds(base: Path) -> None:
    points = plane.points_m(plane.depth_mm(noise_mm=0.6))
    plane.write_ply(_new(base, "ply") / "a.ply", points)
    plane.write_pcd(_new(base, "pcd") / "a.pcd", points)
    few = points[:LIST, :LIST]
    plane.write_points(_new(base, "xyz") / "a.xyz", few)
    plane.write_points(_new(base, "csv") / "a.csv", few, head="x,y,z\n", separator=",")
    height, width = few.shape[:2]
    lines = [" ".join(f"{x:.6f}" for x in point) for point in few.reshape(-1, 3)]
    header = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {width * height}\nDATA ascii\n"
    )
    path = _new(base, "pcd_text") / "a.pcd"
    path.write_text(header + "\n".join(lines) + "\n")


def _write_bags(base: Path) -> None:
    clouds = bags.clouds(2)
    images = []
    for i in range(2):
        depth = bags.depth_image(plane.depth_mm(i, noise_mm=0.6))
        images.append(("/depth/image_raw", bags.IMAGE, depth))
        images.append(("/depth/camera_info", bags.INFO, bags.info()))
    packed = bags.packed_depth(plane.depth_mm(), form="rvl")
    compressed = [("/depth/compressedDepth", bags.PACKED, packed), images[1]]
    bags.write_bag(base / "bag_clouds", clouds)
    bags.write_bag(base / "bag_images", images, mcap=True)
    mode = CompressionMode.MESSAGE
    bags.write_bag(base / "bag_packed", compressed, compression=mode)
    bags.write_ros1(_new(base, "ros1") / "a.bag", images)


def _write_beside(base: Path) -> None:
    """Write meshes, poses, lenses, cameras, declarations and experiments."""
    folder = _new(base, "parts")
    box = trimesh.creation.box((400.0, 300.0, 12.0))
    for suffix in ("stl", "ply", "obj", "glb", "off"):
        box.export(folder / f"part.{suffix}")
    (folder / "text.stl").write_text(trimesh.exchange.stl.export_stl_ascii(box))
    pose = np.eye(4)
    pose[0, 3] = 0.01
    poses = [np.eye(4).tolist(), pose.tolist()]
    (folder / "poses.json").write_text(json.dumps(poses))
    (folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n1 0.01 0 0 0 0 0 1\n")
    (folder / "calibration.json").write_bytes(plane.calibration())
    intr = {"_fx": 150.0, "_fy": 151.0, "_cx": 47.0, "_cy": 36.0, "_width": 96, "_height": 72}
    (folder / "camera.intr").write_text(json.dumps(intr))
    scipy.io.savemat(folder / "meta.mat", {"intrinsic_matrix": plane.LENS.matrix})
    (folder / "lens.yaml").write_text("fx: 150\nfy: 151\ncx: 47\ncy: 36\nwidth: 96\nheight: 72\n")
    (folder / "target.yaml").write_text(TARGET)
    (folder / "mesh.yaml").write_text(PART)
    (folder / "study.yaml").write_text(tiny_sweep.STUDY)
    views = tiny_sweep.TINY.replace("capture:", f"{VIEWS}capture:", 1)
    (folder / "views.yaml").write_text(views)
    (folder / "boards.yaml").write_text(FAMILY)
    (folder / "family.yaml").write_text(tiny_dataset.FAMILY)
    (folder / "sweep.yaml").write_text(tiny_sweep.TINY)
    for name in ("azure_kinect_nfov", "realsense_l515", "kinect_v2"):
        shutil.copy(ROOT / "scenes" / "cameras" / f"{name}.yaml", folder)
    binned = ROOT / "scenes" / "cameras" / "azure_kinect_nfov_binned.yaml"
    shutil.copy(binned, folder / "binned.yaml")
    figures = ROOT / "harness" / "programs" / "scorecard" / "figures.yaml"
    shutil.copy(figures, folder / "figures.yaml")


def _write_tables(base: Path) -> None:
    """Write what the programs on inspections and studies read."""
    from harness.evaluation.study.record import record_text

    folder = _new(base, "tables")
    shutil.copy(ROOT / "results" / "baselines" / "atlas.json", folder)
    shutil.copy(ROOT / "results" / "baselines" / "regression.json", folder)
    sizes = np.linspace(0.5, 12.0, 60)
    rng = np.random.default_rng(4)
    found = (rng.random(len(sizes)) < 1 / (1 + np.exp(4 - sizes))).astype(int)
    lines = ["size,found,signal,target"]
    for number, (size, hit) in enumerate(zip(sizes, found, strict=True)):
        lines.append(f"{size:.2f},{hit},{size + rng.normal():.3f},t{number}")
    (folder / "inspections.csv").write_text("\n".join(lines) + "\n")
    for name in ("a", "b"):
        (folder / name).mkdir()
        (folder / name / "study.json").write_text(record_text(study_record()))


def _write_runs(base: Path) -> None:
    """Write a study's results, a data set with maps, a gauge and a flat field, by the programs."""
    from harness.__main__ import main

    runs = _new(base, "runs")
    folder = _new(base, "made")
    data = _new(base, "data")
    (runs / "tiny.yaml").write_text(tiny_sweep.STUDY)
    commands = [
        ["sweep", str(runs / "tiny.yaml"), "--out", str(runs / "out"), "--serial"],
        [
            "gauge",
            "--diameters",
            "2:12",
            "--a50",
            "5",
            "--a90",
            "7",
            "--out",
            str(folder / "gauge"),
        ],
        ["flatfield", str(base / "wall" / "depth.npy"), "--out", str(folder / "unit.npz")],
    ]
    for words in commands:
        printed = io.StringIO()
        with redirect_stdout(io.StringIO()), redirect_stderr(printed):
            code = main(words)
        assert code == 0, (words, printed.getvalue())
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        assert tiny_dataset.write(data, "boards") == 0
    for name in tiny_dataset.names_in(data / "boards"):
        if name.split("/")[1] == "train":
            continue
        inspected = tiny_dataset.arrays_of(data / "boards", name)["inspected"]
        path = (data / "maps" / name).with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.random.default_rng(1).normal(size=inspected.shape))


def _new(base: Path, name: str) -> Path:
    folder = base / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder
