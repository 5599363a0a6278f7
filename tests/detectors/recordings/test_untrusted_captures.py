"""Captures that somebody made to harm: each is one clear message, in little time and little
memory.

Every file is opened in a process whose memory is limited to what its libraries need and 1 GiB
more.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
import scipy.io

from detectors.recordings import open_capture
from detectors.recordings.depth_images import decoded, read_depth_png
from harness.vocabulary import files
from tests.support import bag_of_a_plane as bags
from tests.support import recorded_plane as plane
from tests.support.hostile_files import BOMB, capture_refusal, little_memory, refusal

STORED = plane.depth_mm()


@pytest.fixture(autouse=True)
def limited() -> Iterator[None]:
    with little_memory():
        yield


# ---- arrays
# ---------------------------------------------------------------------------------------------------------


def npy_header(shape: str, dtype: str = "<u2") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def npz(
    path: Path, content: bytes, stated: int | None = None, method: int = zipfile.ZIP_DEFLATED
) -> Path:
    """An archive with one entry; ``stated`` replaces its size in the list of contents."""
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("depth.npy", content)
    if stated is not None:
        raw = bytearray(path.read_bytes())
        start = raw.rindex(b"PK\x01\x02")
        raw[start + 24 : start + 28] = struct.pack("<I", stated)
        path.write_bytes(raw)
    return path


def test_an_archive_that_says_ten_gigabytes(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("depth.npy", npy_header("(50000, 100000)"))
        archive.filelist[0].file_size = 10 << 30
    assert "unpacks to 10 GiB" in capture_refusal(path)


@pytest.mark.parametrize(
    ("content", "stated", "message"),
    [
        (
            npy_header("(30000, 60000)") + bytes(100),
            None,
            "not enough memory for the size that it states",
        ),
        (
            npy_header("(30000, 60000)") + bytes(100),
            3_600_000_128,
            "not enough memory for the size that it states",
        ),
        (npy_header("(72, 96)") + bytes(100), None, "cannot be read as arrays"),
        (b"\x93NUMPY\x01\x00\x10\x00{'descr': [('<u2'", None, "cannot be read as arrays"),
        (npy_header("(-72, -96)") + STORED.tobytes(), None, "cannot be read as arrays"),
        (npy_header("(72, 96)", "|O") + bytes(8), None, "objects"),
        (npy_header("(" + "9" * 30 + ",)"), None, "cannot be read as arrays"),
        (b"\x93NUMPY\x01\x00\xff\xff" + bytes(100), None, "cannot be read as arrays"),
        (b"", None, "not numbers"),
    ],
)
def test_arrays_whose_header_lies(tmp_path, content, stated, message):
    assert message in capture_refusal(npz(tmp_path / "a.npz", content, stated))


def test_a_bomb_of_zeros(tmp_path, monkeypatch):
    """Truthful sizes, packed a thousand times: refused by what it unpacks to."""
    monkeypatch.setattr(files, "ARRAYS_BYTES", 64 << 20)
    path = npz(tmp_path / "a.npz", npy_header("(64, 1024, 1024)") + bytes(128 << 20))
    assert path.stat().st_size < 1 << 20
    assert "unpacks to 128 MiB\n  legal: at most 64 MiB" in capture_refusal(path)


def test_other_archives(tmp_path):
    good = io.BytesIO()
    np.save(good, STORED)
    (tmp_path / "d.npz").write_bytes(good.getvalue())
    assert "cannot be read" in capture_refusal(tmp_path / "d.npz")
    damaged = bytearray(npz(tmp_path / "e.npz", good.getvalue()).read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (tmp_path / "e.npz").write_bytes(damaged)
    assert "cannot be read" in capture_refusal(tmp_path / "e.npz")


@pytest.mark.parametrize(
    "content",
    [
        npy_header("(30000, 60000)"),
        npy_header("(-2, -3)") + bytes(12),
        npy_header("()") + bytes(2),
        npy_header("(72, 96"),
        npy_header("(72, 96)", "<u2', ["),
        b"PK\x03\x04",
    ],
)
def test_hostile_npy(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    assert str(tmp_path / "a.npy") in capture_refusal(tmp_path / "a.npy")


def test_a_frame_of_too_many_pixels(tmp_path):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        file.write(npy_header("(10000, 10000)"))
        file.truncate(file.tell() + 2 * 10**8)
    assert "10000 x 10000 pixels\n  legal: 1 to 64 million" in capture_refusal(path)


# ---- MATLAB
# ---------------------------------------------------------------------------------------------------------

MAT_HEAD = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\x00\x01IM"


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def mat_variable(rows: int, columns: int, stated: int, numbers: bytes = b"") -> bytes:
    head = (
        element(6, struct.pack("<II", 6, 0))
        + element(5, struct.pack("<ii", rows, columns))
        + element(1, b"depth")
    )
    return element(14, head + struct.pack("<II", 9, stated) + numbers)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (mat_variable(30_000, 60_000, 0xFFFFFFF0), "not enough memory for the size that it states"),
        (mat_variable(3, 4, 0xFFFFFFF0, bytes(96)), "cannot be read"),
        (struct.pack("<II", 14, 0xFFFFFFF0), "could not read bytes"),
        (element(15, b"no zlib")[:-1], "while decompressing"),
    ],
)
def test_hostile_matlab_files(tmp_path, content, message):
    (tmp_path / "a.mat").write_bytes(MAT_HEAD + content)
    assert message in capture_refusal(tmp_path / "a.mat")


def test_a_compressed_matlab_bomb(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "READING_BYTES", 64 << 20)
    packed = zlib.compress(mat_variable(4096, 4096, 128 << 20, bytes(128 << 20)))
    (tmp_path / "a.mat").write_bytes(MAT_HEAD + struct.pack("<II", 15, len(packed)) + packed)
    assert "not enough memory for the size that it states" in capture_refusal(tmp_path / "a.mat")


def test_cells_beside_numbers_are_left_unread(tmp_path):
    cells = np.array([[1, 2], ["a", {"b": 1}]], object)
    scipy.io.savemat(tmp_path / "a.mat", {"depth": STORED, "notes": cells}, do_compression=True)
    assert open_capture([tmp_path / "a.mat"], lens=plane.LENS).region.shape == STORED.shape


def test_cells_in_cells_in_a_mat_file_are_not_followed(tmp_path: Path) -> None:
    """A hundred thousand deep, which ends a process that follows them."""
    inner = struct.pack("<IIIIIIiiIIIId", 6, 8, 6, 0, 5, 8, 1, 1, 1, 0, 9, 8, 1.0)
    level = struct.pack("<IIIIIIii", 6, 8, 1, 0, 5, 8, 1, 1)
    heads = [struct.pack("<II", 14, len(inner))]
    size = len(inner) + 8
    for depth in range(100_000):
        name = (
            struct.pack("<II5s3x", 1, 5, b"depth") if depth == 99_999 else struct.pack("<II", 1, 0)
        )
        size += len(level) + len(name)
        heads.append(struct.pack("<II", 14, size) + level + name)
        size += 8
    (tmp_path / "a.mat").write_bytes(MAT_HEAD + b"".join(reversed(heads)) + inner)
    assert "holds no numeric array" in capture_refusal(tmp_path / "a.mat")


# ---- phones and lists of points
# --------------------------------------------------------------------------------------


def test_an_archive_of_a_phone_that_unpacks_to_much(tmp_path):
    path = plane_archive(tmp_path / "a.r3d", bytes(64 << 20))
    assert path.stat().st_size < 1 << 20
    assert "metadata: has 64 MiB\n  legal: at most 16 MiB" in capture_refusal(path)


def plane_archive(path: Path, metadata: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", metadata)
        archive.writestr("rgbd/0.depth", b"bvx$")
    return path


def test_a_list_of_points_that_is_too_long(tmp_path):
    with (tmp_path / "a.xyz").open("wb") as file:
        file.write(b"1 2 3\n")
        file.truncate(10 << 30)
    assert "has more than 256 MiB" in capture_refusal(tmp_path / "a.xyz")


# ---- pictures
# -------------------------------------------------------------------------------------------------------


def png_of(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    data = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_a_png_of_60000_x_60000(tmp_path):
    path = tmp_path / "1.png"
    path.write_bytes(png_of(60_000, 60_000))
    message = "60000 x 60000 pixels\n  legal: 1 to 64 million"
    assert message in refusal(lambda: read_depth_png(path)) and message in capture_refusal(path)
    assert message in refusal(lambda: decoded("a", path.read_bytes(), 1))
    path.write_bytes(png_of(0, 5))
    assert "0 x 5 pixels" in capture_refusal(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"\xff\xd8\xff\xe0\x00\x04ab\xff\xc2\x00\x11\x08\xff\xff\xff\xff\x03"
            + bytes(9)
            + b"\xff\xda\x00\x02",
            "65535 x 65535 pixels",
        ),
        (b"II*\x00" + bytes(100), "neither PNG nor JPEG"),
        (b"\x76\x2f\x31\x01" + bytes(100), "neither PNG nor JPEG"),
        (b"\xff\xd8\xff\xff\xff\xff", "truncated"),
    ],
)
def test_pictures_are_decoded_only_as_what_they_are(content, message):
    assert message in refusal(lambda: decoded("a.jpg", content, 1))


def test_the_sizes_of_true_pictures():
    import cv2

    for suffix in (".png", ".jpg"):
        content = cv2.imencode(suffix, np.zeros((30, 50, 3), np.uint8))[1].tobytes()
        assert decoded("a", content, cv2.IMREAD_COLOR).shape == (30, 50, 3)


# ---- clouds
# ---------------------------------------------------------------------------------------------------------


def ply(*lines: str) -> bytes:
    return "\n".join(("ply", "format binary_little_endian 1.0", *lines, "end_header", "")).encode(
        "latin1"
    )


XYZ = ("property float x", "property float y", "property float z")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ply("element vertex 4000000000", *XYZ), "4000000000 x 1 pixels"),
        (ply("element vertex 40000000", *XYZ), "truncated"),
        (ply("element vertex 4000000000"), "lack x, y or z"),
        (ply(f"element vertex {'9' * 5000}", *XYZ), "no points"),
        (ply("element vertex \xb2", *XYZ), "no points"),
        (ply("element vertex 1", "property", *XYZ), "truncated"),
        (ply("element vertex 1", *XYZ, "element vertex 9", *XYZ), "twice"),
        (ply(f"comment width {'9' * 5000}", "element vertex 1", *XYZ), "truncated"),
    ],
)
def test_hostile_ply(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content)
    assert message in capture_refusal(tmp_path / "a.ply")


def pcd(
    width: object, height: object, data: str = "binary", size: str = "4 4 4", count: str = "1 1 1"
) -> bytes:
    lines = (
        "VERSION 0.7",
        "FIELDS x y z",
        f"SIZE {size}",
        "TYPE F F F",
        f"COUNT {count}",
        f"WIDTH {width}",
    )
    return "\n".join((*lines, f"HEIGHT {height}", f"DATA {data}", "")).encode()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pcd(100_000, 100_000), "100000 x 100000 pixels"),
        (pcd(1000, 1000), "truncated"),
        (pcd(-5, -5), "is not a count"),
        (pcd("9" * 5000, 1), "is not a count"),
        (pcd(2, 2, size="4 4 -4"), "is not a count"),
        (pcd(2, 2, size="4 4 1000000"), "cannot be read"),
        (pcd(2, 2, count="1 1 1000000"), "cannot be read"),
        (pcd(2, 2, count="1"), "differ in length"),
        (
            pcd(1000, 1000, "binary_compressed") + struct.pack("<II", 10, 12_000_000) + bytes(10),
            "packed into 10",
        ),
        (
            pcd(10, 10, "binary_compressed") + struct.pack("<II", 100, 4 << 29) + bytes(100),
            "would have 1200 bytes",
        ),
    ],
)
def test_hostile_pcd(tmp_path, content, message):
    (tmp_path / "a.pcd").write_bytes(content)
    assert message in capture_refusal(tmp_path / "a.pcd")


# ---- recordings
# -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        b"#EXTM3U\n#EXTINF:1,\nother.mkv\n#" + bytes.fromhex("1853806781") + b"\n",
        b"ffconcat version 1.0\nfile 'other.mkv'\n#" + bytes.fromhex("1853806781") + b"\n",
    ],
)
def test_a_playlist_called_mkv_opens_nothing_else(tmp_path, content):
    plane.write_mkv(tmp_path / "other.mkv", [{"DEPTH": STORED}], attached=plane.calibration())
    (tmp_path / "a.mkv").write_bytes(content)
    assert "a.mkv" in capture_refusal(tmp_path / "a.mkv")


def test_a_name_that_is_a_protocol_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plane.write_mkv(tmp_path / "a.mkv", [{"DEPTH": STORED}], attached=plane.calibration())
    Path("concat:a.mkv").write_bytes(Path("a.mkv").read_bytes())
    assert open_capture([Path("concat:a.mkv")], lens=plane.LENS).region.shape == STORED.shape


def test_a_recording_of_too_large_pictures(tmp_path):
    from detectors.recordings import devices

    path = tmp_path / "a.mkv"
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=5)
        stream.width = 96
        stream.height = 72
        stream.pix_fmt = "gray16le"
        stream.metadata["title"] = "DEPTH"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(STORED, format="gray16le")))
        container.mux(stream.encode())
    content = path.read_bytes()
    width = content.index(b"\xb0\x81\x60\xba\x81\x48")
    path.write_bytes(
        content[:width]
        + b"\xb0\x81\x60\xba\x81\x48".replace(b"\x60", b"\x7f")
        + content[width + 6 :]
    )
    assert "127 x 72" in capture_refusal(path)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(files, "FRAME_PIXELS", 1000)
        assert "127 x 72 pixels\n  legal: 1 to" in capture_refusal(path)
        path.write_bytes(content)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(devices, "FRAME_PIXELS", 1000)
        assert "cannot be decoded" in capture_refusal(path)


def test_a_bag_whose_description_is_hostile(tmp_path):
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    described = folder / "metadata.yaml"
    description = described.read_text()
    for text in (
        BOMB + "rosbag2_bagfile_information: *a20\n",
        "rosbag2_bagfile_information: !!python/name:os.system\n",
    ):
        described.write_text(text)
        assert "metadata.yaml" in capture_refusal(folder)
    described.write_text(
        description.replace(next(folder.glob("*.db3")).name, "../../../etc/passwd")
    )
    assert "passwd, which is missing" in capture_refusal(folder)
