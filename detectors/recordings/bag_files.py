"""ROS bags as files: which of them hold the messages, and reading them by ``rosbags`` without trusting them."""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.declaration.problems import DeclarationError
from harness.vocabulary.declaration.yaml_source import MAX_BYTES, read_yaml
from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader

BAG_SUFFIXES = (".mcap", ".db3")
ROS1_SUFFIX = ".bag"
METADATA = "metadata.yaml"
LEGAL_BAG = "a ROS 2 bag (its folder with metadata.yaml, one .db3 or one .mcap) or a .bag of ROS 1"
MAX_MESSAGE_BYTES = 2**28
"""256 MiB: a cloud of four million points with 64 bytes each."""
MAX_CHUNK_BYTES = 2**30
"""Of an MCAP chunk, unpacked: recorders close a chunk at some MiB, or after the message that passes it."""
PIECE_BYTES = 2**20
COMPUTED = re.compile(r"\bvirtual\b|\bgenerated\b|\bas\s*\(|\bas\s+(select|with)\b", re.IGNORECASE)
"""Of an SQLite table's declaration: words that only a virtual table or a computed column has."""
MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_CHUNK = 6
ROS1_MAGIC = b"#ROSBAG V2.0\n"
ROS1_CHUNK = b"\x05"
ROS1_HEADER_BYTES = 1 << 20
"""Of a record's header: that of a connection holds the names of its topic and type."""


@dataclass(frozen=True)
class Bag:
    """``files`` hold the messages, in order; ``packed``: each message is compressed by itself (zstd)."""

    name: str
    files: tuple[Path, ...]
    metadata: Path | None = None
    packed: bool = False


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder holds a bag, whole or not. Raises OSError where it cannot be read."""
    if any(_holds_messages(path) for path in folder.iterdir()):
        return True
    metadata = folder / METADATA
    return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.open("rb").read(MAX_BYTES)


def find_bag(path: Path) -> Bag:
    """The bag that a folder or file is. Raises UserError where it has no metadata or its files are not there."""
    if path.is_file():
        return Bag(path.name, (path,))
    metadata = path / METADATA
    if not metadata.is_file():
        held = sorted(inside.name for inside in path.iterdir() if _holds_messages(inside))
        raise UserError(
            f"{path}: has no {METADATA} (the recorder writes it when it stops), but {', '.join(held)}",
            legal=LEGAL_BAG,
            fix="name that file itself, or run: ros2 bag reindex",
        )
    told = _metadata(metadata)
    mode = str(told.get("compression_mode") or "none").lower()
    files = tuple(path / Path(str(name)).name for name in told["relative_file_paths"])
    if mode == "file":
        raise UserError(
            f"{path}: its files are compressed whole",
            legal=LEGAL_BAG + ", with compressed messages or chunks",
            fix=f"unpack it (zstd -d {files[0] if files else path}) and name the unpacked file",
        )
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None or not files:
        what = f"{METADATA} names {missing.name}, which is not there" if missing else f"{METADATA} names no file"
        raise UserError(f"{path}: {what}", legal=LEGAL_BAG, fix="copy the whole folder again")
    odd = next((file for file in files if file.suffix.lower() not in BAG_SUFFIXES), None)
    if odd is not None:
        raise UserError(f"{odd}: bags stored as '{odd.suffix}' are not read", legal=LEGAL_BAG)
    return Bag(path.name, files, metadata, packed=mode == "message")


def topics_of(bag: Bag) -> dict[str, str]:
    """Topic to message type, sorted; of a topic with several types the last."""
    found: dict[str, str] = {}
    for file in bag.files:
        with _opened(file) as reader:
            found |= {connection.topic: connection.msgtype for connection in reader.connections}
    return dict(sorted(found.items()))


def messages(bag: Bag, topic: str) -> Iterator[tuple[str, Any]]:
    """(what to call it, message) of a topic in the order of their times within each file, one held at a time.

    Raises UserError where a file is damaged or a message is larger than `MAX_MESSAGE_BYTES`.
    """
    from rosbags.typesys import Stores, get_typestore

    number = 0
    for file in bag.files:
        is_ros1 = file.suffix.lower() == ROS1_SUFFIX
        types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
        decode = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
        with _opened(file) as reader:
            wanted = [connection for connection in reader.connections if connection.topic == topic]
            found = reader.messages(wanted) if wanted else iter(())
            while True:
                with _readable(file):
                    item = next(found, None)
                if item is None:
                    break
                name = f"{bag.name} {topic} message {number}"
                connection, _, content = item
                content = _unpacked(name, content) if bag.packed else content
                _refuse_huge(name, len(content))
                with _readable(file):
                    message = decode(content, connection.msgtype)
                yield name, message
                number += 1


def _holds_messages(path: Path) -> bool:
    return path.name.lower().removesuffix(".zstd").endswith(BAG_SUFFIXES)


def _metadata(path: Path) -> dict[str, Any]:
    """What metadata.yaml says of the bag. Raises UserError where it is no such file."""
    try:
        told = read_yaml(path).data["rosbag2_bagfile_information"]
        if not all(isinstance(name, str) for name in told["relative_file_paths"]):
            raise TypeError("relative_file_paths")
    except (DeclarationError, KeyError, TypeError) as error:
        raise UserError(
            f"{path}: is no description of a ROS 2 bag, or is cut off ({type(error).__name__})",
            legal=LEGAL_BAG,
            fix="copy it again, name the .db3 or .mcap itself, or run: ros2 bag reindex",
        ) from error
    described: dict[str, Any] = told
    return described


@contextmanager
def _opened(file: Path) -> Iterator[Reader | Ros1Reader]:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader

    suffix, stat = file.suffix.lower(), file.stat()
    if suffix == ".mcap":
        _refuse_bad_chunks(file, stat.st_size, stat.st_mtime_ns)
    elif suffix == ROS1_SUFFIX:
        _refuse_bad_ros1_chunks(file, stat.st_size, stat.st_mtime_ns)
    else:
        _refuse_programs(file)
    with _readable(file):
        reader = Ros1Reader(file) if suffix == ROS1_SUFFIX else Reader(file)
        reader.open()
    try:
        yield reader
    finally:
        reader.close()


@contextmanager
def _readable(file: Path) -> Iterator[None]:
    """Tell a user what the library's exceptions mean; it leaves many of its checks to Python."""
    from apsw import Error as SqliteError
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError
    from rosbags.serde import SerdeError

    # what reading past an end, a wrong length or a wrong byte raises in the library
    python = (struct.error, TypeError, ValueError, LookupError, OSError, EOFError, AssertionError, OverflowError)
    try:
        yield
    except (ReaderError, Ros1Error, SerdeError, SqliteError, RuntimeError, *python) as error:
        raise _damaged(file, str(error) or type(error).__name__) from error


def _damaged(file: Path, why: str) -> UserError:
    mend = f"rosbag reindex {file}" if file.suffix.lower() == ROS1_SUFFIX else "ros2 bag reindex, or mcap recover"
    return UserError(
        f"{file}: is truncated or damaged, or is no bag ({why})",
        legal=LEGAL_BAG,
        fix=f"copy it again; of a recording that was cut off: {mend}",
    )


# ---- what a hostile or broken file could do --------------------------------------------------------------------------


def _refuse_huge(name: str, size: int) -> None:
    if size > MAX_MESSAGE_BYTES:
        raise UserError(
            f"{name}: has more than {MAX_MESSAGE_BYTES >> 20} MiB",
            legal=f"messages up to {MAX_MESSAGE_BYTES >> 20} MiB",
        )


def _unpacked(name: str, content: bytes) -> bytes:
    """A message that was compressed by itself, unpacked no further than `MAX_MESSAGE_BYTES`."""
    pieces, size = [], 0
    for piece in _pieces(name, "zstd", content):
        pieces.append(piece)
        size += len(piece)
        _refuse_huge(name, size)
    return b"".join(pieces)


def _pieces(name: str, form: str, content: bytes) -> Iterator[bytes]:
    """Compressed content (zstd, lz4 or bz2 frames, one after the other) unpacked piece by piece."""
    import bz2

    import lz4.frame  # type: ignore[import-untyped]

    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd

    makers = {"zstd": zstd.ZstdDecompressor, "lz4": lz4.frame.LZ4FrameDecompressor, "bz2": bz2.BZ2Decompressor}
    while content:
        unpacker = makers[form]()
        while not unpacker.eof:
            try:
                piece = unpacker.decompress(content, max_length=PIECE_BYTES)
            except (zstd.ZstdError, RuntimeError, EOFError, OSError) as error:
                raise UserError(f"{name}: compressed data cannot be unpacked ({error})", legal=LEGAL_BAG) from error
            if not piece and not unpacker.eof:
                raise UserError(f"{name}: compressed data end too early", legal=LEGAL_BAG)
            content = b""
            yield piece
        content = unpacker.unused_data or b""


def _refuse_programs(file: Path) -> None:
    """A database may hold programs: a view or a computed column called ``messages`` that never ends or fills the
    memory when it is read. Recorders write tables of plain columns."""
    import apsw

    with _readable(file):
        database = apsw.Connection(str(file), flags=apsw.SQLITE_OPEN_READONLY)
        try:
            found = database.execute("select type, name, coalesce(sql, '') from sqlite_master limit 1000").fetchall()
        finally:
            database.close()
    for kind, name, sql in found:
        plain = kind == "index" or (kind == "table" and not COMPUTED.search(str(sql)))
        if not plain:
            raise UserError(f"{file}: holds a program ({kind} {str(name)[:40]!r}), not only tables", legal=LEGAL_BAG)


@lru_cache(maxsize=1000)
def _refuse_bad_chunks(file: Path, size: int, changed_ns: int) -> None:
    """Walk an MCAP's records: none may pass the file's end, no chunk may unpack to more than it says or than we hold.

    The library unpacks a chunk whole before it compares sizes, so compressed chunks are unpacked here first, in pieces;
    once for each file, of which ``size`` and ``changed_ns`` tell whether it is still the same.
    """
    with file.open("rb") as stream:
        if stream.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise _damaged(file, "it does not begin as MCAP does" if size else "it is empty")
        while stream.tell() < size - len(MCAP_MAGIC):
            start = stream.tell()
            head = stream.read(9)
            kind, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, size)
            if start + 9 + length > size - len(MCAP_MAGIC):
                raise _damaged(file, f"the record at byte {start} is cut off")
            if kind == MCAP_CHUNK:
                _refuse_bad_chunk(file, start, stream.read(length))
            stream.seek(start + 9 + length)


def _refuse_bad_chunk(file: Path, start: int, record: bytes) -> None:
    try:
        _, _, promised, _, letters = struct.unpack_from("<QQQII", record)
        form = record[32 : 32 + letters].decode()
        (packed,) = struct.unpack_from("<Q", record, 32 + letters)
    except (struct.error, UnicodeDecodeError) as error:
        raise _damaged(file, f"the chunk at byte {start}") from error
    content = record[40 + letters : 40 + letters + packed]
    _refuse_bomb(f"{file}: the chunk at byte {start}", promised, form, content, ("", "zstd", "lz4"))


@lru_cache(maxsize=1000)
def _refuse_bad_ros1_chunks(file: Path, size: int, changed_ns: int) -> None:
    """The same of a ROS 1 bag's records: a header of named fields, and data, each after its length."""
    with file.open("rb") as stream, _readable(file):
        if stream.read(len(ROS1_MAGIC)) != ROS1_MAGIC:
            raise _damaged(file, "it does not begin as a bag of ROS 1 does" if size else "it is empty")
        while (start := stream.tell()) < size:
            (length,) = struct.unpack("<I", stream.read(4))
            if length > ROS1_HEADER_BYTES:
                raise _damaged(file, f"the record at byte {start} has a header of {length} bytes")
            fields = _ros1_fields(stream.read(length))
            (length,) = struct.unpack("<I", stream.read(4))
            end = stream.tell() + length
            if end > size or length > MAX_CHUNK_BYTES:
                raise _damaged(file, f"the record at byte {start} is cut off, or states {length} bytes")
            if fields.get(b"op") == ROS1_CHUNK:
                (promised,) = struct.unpack("<I", fields[b"size"])
                form = fields[b"compression"].decode().replace("none", "")
                content = stream.read(length) if form else b""
                _refuse_bomb(f"{file}: the chunk at byte {start}", promised, form, content, ("", "bz2", "lz4"))
            stream.seek(end)


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name] = value
        at += 4 + length
    return fields


def _refuse_bomb(name: str, promised: int, form: str, content: bytes, known: tuple[str, ...]) -> None:
    if promised > MAX_CHUNK_BYTES:
        raise UserError(f"{name}: has {promised} bytes", legal=f"up to {MAX_CHUNK_BYTES >> 20} MiB, unpacked")
    if form not in known:
        raise UserError(f"{name}: is compressed by {form!r}", legal=f"{' or '.join(known[1:])}, or no compression")
    unpacked = 0
    for piece in _pieces(name, form, content) if form else ():
        unpacked += len(piece)
        if unpacked > promised:
            raise UserError(f"{name}: unpacks to more than the {promised} bytes that it states", legal=LEGAL_BAG)
