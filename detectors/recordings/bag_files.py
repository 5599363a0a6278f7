"""ROS bags as files: which of them hold the messages, and reading them by ``rosbags`` without trusting them.

The library checks that records and chunks lie within the file and unpack to what they state, but unpacks them whole
first: it runs within `limits.limited_memory`.
"""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.declaration.problems import DeclarationError
from harness.vocabulary.declaration.yaml_source import MAX_BYTES, read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import limited_memory

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader

BAG_SUFFIXES = (".mcap", ".db3")
ROS1_SUFFIX = ".bag"
METADATA = "metadata.yaml"
LEGAL_BAG = "a ROS 2 bag (its folder with metadata.yaml, one .db3 or one .mcap) or a .bag of ROS 1"
MAX_MESSAGE_BYTES = 2**28
"""256 MiB: a cloud of four million points with 64 bytes each."""
COMPUTED = re.compile(r"\bvirtual\b|\bgenerated\b|\bas\s*\(|\bas\s+(select|with)\b", re.IGNORECASE)
"""Words in an SQLite table's declaration that only a virtual table or a computed column has."""


@dataclass(frozen=True)
class Bag:
    """``files`` hold the messages, in order; ``packed``: each message is compressed by itself (zstd)."""

    name: str
    files: tuple[Path, ...]
    metadata: Path | None = None
    packed: bool = False

    def topics(self) -> dict[str, str]:
        """Return topic to message type, sorted; of a topic with several types the last."""
        found: dict[str, str] = {}
        for file in self.files:
            with _opened(file) as reader:
                found |= {connection.topic: connection.msgtype for connection in reader.connections}
        return dict(sorted(found.items()))

    def first(self, topic: str) -> Any:
        """Return the first message of a topic, None where it has none."""
        return next(self.messages(topic), ("", None))[1]

    def messages(self, topic: str) -> Iterator[tuple[str, Any]]:
        """Yield (what to call it, message) of a topic in the order of their times within each file, one held at a time.

        Raises UserError where a file is damaged or a message is larger than `MAX_MESSAGE_BYTES`.
        """
        from rosbags.typesys import Stores, get_typestore

        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd

        number = 0
        for file in self.files:
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
                    name = f"{self.name} {topic} message {number}"
                    connection, _, content = item
                    with _readable(file):
                        content = zstd.decompress(content) if self.packed else content
                        if len(content) > MAX_MESSAGE_BYTES:
                            most = f"{MAX_MESSAGE_BYTES >> 20} MiB"
                            raise UserError(f"{name}: has more than {most}", legal=f"messages up to {most}")
                        message = decode(content, connection.msgtype)
                    yield name, message
                    number += 1


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag's file, or a folder with a bag, whole or not."""
    if path.is_file():
        return path.suffix.lower() in (*BAG_SUFFIXES, ROS1_SUFFIX)
    try:
        if any(_holds_messages(inside) for inside in path.iterdir()):
            return True
        metadata = path / METADATA
        return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.open("rb").read(MAX_BYTES)
    except OSError:
        return False


def find_bag(path: Path) -> Bag:
    """Return a folder or file as a bag. Raises UserError where its description or one of its files is missing."""
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
    try:
        told = read_yaml(metadata).data["rosbag2_bagfile_information"]
        files = tuple(path / Path(name).name for name in told["relative_file_paths"])
        mode = str(told.get("compression_mode") or "none").lower()
    except (DeclarationError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{metadata}: is no description of a ROS 2 bag, or is cut off ({type(error).__name__})",
            legal=LEGAL_BAG,
            fix="copy it again, name the .db3 or .mcap itself, or run: ros2 bag reindex",
        ) from error
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


def _holds_messages(path: Path) -> bool:
    return path.name.lower().removesuffix(".zstd").endswith(BAG_SUFFIXES)


@contextmanager
def _opened(file: Path) -> Iterator[Reader | Ros1Reader]:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader

    suffix = file.suffix.lower()
    if suffix == ".db3":
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
    """Turn the library's exceptions, and those of Python that it lets through, into a UserError; limit its memory."""
    from apsw import Error as SqliteError
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError
    from rosbags.serde import SerdeError

    # reading past an end, a wrong length or a wrong byte, and more memory than there is
    python = (struct.error, TypeError, ValueError, LookupError, OSError, EOFError, AssertionError, OverflowError)
    try:
        with limited_memory():
            yield
    except (ReaderError, Ros1Error, SerdeError, SqliteError, RuntimeError, MemoryError, *python) as error:
        why = "it unpacks to more than the memory holds" if isinstance(error, MemoryError) else str(error)
        mend = f"rosbag reindex {file}" if file.suffix.lower() == ROS1_SUFFIX else "ros2 bag reindex, or mcap recover"
        raise UserError(
            f"{file}: is truncated or damaged, or is no bag ({why or type(error).__name__})",
            legal=LEGAL_BAG,
            fix=f"copy it again; of a recording that was cut off: {mend}",
        ) from error


def _refuse_programs(file: Path) -> None:
    """Refuse a database that holds programs: a view or a computed column called ``messages`` may never end or fill the
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
