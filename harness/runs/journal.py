"""The journal of a sweep: how each trial ended, appended to segment files, from which the same
command resumes.

Each process that writes has its own segment, so that shards may share a folder and journals merge
by appending. A segment begins with its version; further lines are entries with a checksum. Torn or
altered lines are ignored."""

import errno
import hashlib
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from harness.runs.jobs import STATES, Ended, State
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import RECORD_BYTES, explained, open_plain, strict_json
from harness.vocabulary.provenance import check_version, stamp_of, stamped
from harness.vocabulary.seeds import canonical_json

# raised with every change to records or to what a trial computes: older trials then run again
JOURNAL_VERSION = 8
SEGMENT_NAME = re.compile(r"[0-9]{6}-[0-9a-f]{8}\.jsonl")
THRESHOLDS = "thresholds-"  # prefix of the keys of entries that hold thresholds
DESIGNS = "design-"  # prefix of the keys of entries that hold the boards of a study's next batch
PICTURES = "pictures-"  # prefix of the keys of entries that hold a set-up's pictures
NOT_TRIALS = (THRESHOLDS, DESIGNS, PICTURES)
NOTHING = "null"  # replaces the record of a trial that is not done
KEPT = ("state", "why", "is_bug", "seconds", "peak_mb", "worker")


class _Location(NamedTuple):
    """The location of an entry: segment, offset and length of its line in bytes; and the entry's
    state."""

    segment: str
    start: int
    length: int
    state: State


class Journal:
    """Entries in a folder, by key: how a trial ended, and its record as text. Raises UserError for
    links, for a segment that cannot be written or is of a newer tofpod. ``damaged``: torn or
    altered lines, segments of other versions."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.damaged: list[str] = []
        self._places: dict[str, _Location] = {}
        self._read_to: dict[str, int] = {}
        self._own: Path | None = None
        self._is_read = False

    def __len__(self) -> int:
        return sum(not key.startswith(NOT_TRIALS) for key in self._known())

    def thresholds(self) -> list[str]:
        """Return the keys of the stored thresholds, sorted."""
        return sorted(key for key in self._known() if key.startswith(THRESHOLDS))

    def state(self, key: str) -> State | None:
        """Return how a trial ended; None if there is no entry."""
        location = self._known().get(key)
        return None if location is None else location.state

    def read(self, key: str) -> Ended | None:
        """Return the entry of a trial; None if there is none."""
        location = self._known().get(key)
        if location is None:
            return None
        try:
            with open_plain(self.folder / location.segment, os.O_RDONLY) as file:
                file.seek(location.start)
                record = _parsed(file.read(location.length))
        except OSError:
            return None
        return record[1] if record is not None and record[0] == key else None

    def records(self, keys: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Yield the records of finished trials, read one by one to save memory. Raises UserError
        if one is gone."""
        for key in keys:
            entry = self.read(key)
            if entry is None or entry.record is None:
                raise UserError(
                    f"{self.folder}: the record {key} is gone or damaged since it was written",
                    fix="run the same command again: what is missing is run again",
                )
            yield entry.record

    def entries(self) -> Iterator[tuple[str, Ended]]:
        """Yield (key, entry) of all trials, thresholds and designs, in the order of the
        segments."""
        for key, _ in sorted(self._known().items(), key=lambda item: item[1][:2]):
            if (entry := self.read(key)) is not None:
                yield key, entry

    def write(self, key: str, entry: Ended) -> None:
        """Append how a trial ended. Raises UserError if the folder cannot be written or the disk
        is full."""
        self._known()
        fields = {name: getattr(entry, name) for name in KEPT} | {
            "key": key,
            "seconds": round(entry.seconds, 4),
        }
        text = (
            f"{canonical_json(fields)}\t{NOTHING if entry.value is None else entry.value}".encode()
        )
        line = _digest(text) + b" " + text + b"\n"
        try:
            if (
                self._own is None
            ):  # ascending numbers sort segments by the time at which they were begun
                self.folder.mkdir(parents=True, exist_ok=True)
                numbers = [
                    int(name[:6])
                    for name in os.listdir(self.folder)
                    if SEGMENT_NAME.fullmatch(name)
                ]
                segment = (
                    self.folder / f"{max(numbers, default=0) + 1:06d}-{secrets.token_hex(4)}.jsonl"
                )
                with open_plain(segment, os.O_WRONLY | os.O_CREAT | os.O_EXCL) as file:
                    file.write(stamped("journal", JOURNAL_VERSION).encode())
                self._own = segment
            with open_plain(self._own, os.O_WRONLY | os.O_APPEND) as file:
                start = os.fstat(file.fileno()).st_size
                if os.write(file.fileno(), line) < len(line):
                    os.ftruncate(file.fileno(), start)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise explained(error, self.folder) from error
        self._remember(key, _Location(self._own.name, start, len(line), entry.state))
        self._read_to[self._own.name] = start + len(line)

    def sync(self) -> None:
        """Flush this process's entries to the disk, so that a power failure does not lose them."""
        if self._own is not None:
            with suppress(OSError), open_plain(self._own, os.O_WRONLY) as file:
                os.fsync(file.fileno())

    def refresh(self) -> None:
        """Read the entries that other processes have appended since."""
        if self.folder.is_symlink():
            raise UserError(
                f"{self.folder}: is a link; a journal is not read through a link",
                fix="remove the link",
            )
        self._is_read = True
        with suppress(FileNotFoundError, NotADirectoryError):
            for name in sorted(filter(SEGMENT_NAME.fullmatch, os.listdir(self.folder))):
                self._read_segment(self.folder / name)

    def _known(self) -> dict[str, _Location]:
        if not self._is_read:
            self.refresh()
        return self._places

    def _read_segment(self, path: Path) -> None:
        try:
            with open_plain(path, os.O_RDONLY) as file:
                start = self._read_to.get(path.name, 0)
                if os.fstat(file.fileno()).st_size <= start:
                    return
                if not start and not self._is_ours(path, file.readline(200)):
                    self._read_to[path.name] = 1 << 62  # never read again
                    return
                file.seek(start := max(start, file.tell()))
                while (line := file.readline(RECORD_BYTES)).endswith(b"\n"):
                    record = _parsed(line)
                    if record is None:
                        self.damaged.append(f"{path}: byte {start}")
                    else:
                        self._remember(
                            record[0], _Location(path.name, start, len(line), record[1].state)
                        )
                    start += len(line)
                if line and path.name not in self._read_to:
                    self.damaged.append(f"{path}: byte {start}")  # torn, or being written now
                self._read_to[path.name] = start
        except OSError:
            self.damaged.append(str(path))

    def _is_ours(self, path: Path, first: bytes) -> bool:
        """Return whether a segment's first line states this version."""
        version = (
            stamp_of(first.decode("utf-8", "replace"), "journal") if first.endswith(b"\n") else None
        )
        if type(version) is int and version > JOURNAL_VERSION:
            check_version(version, JOURNAL_VERSION, path, "a journal's segment")
        if version != JOURNAL_VERSION:
            self.damaged.append(str(path))
        return version == JOURNAL_VERSION

    def _remember(self, key: str, location: _Location) -> None:
        """Store an entry's location. A later entry replaces an earlier one, unless only the
        earlier one is done."""
        before = self._places.get(key)
        if before is None or before.state != "done" or location.state == "done":
            self._places[key] = location


def _parsed(line: bytes) -> tuple[str, Ended] | None:
    """Return the key and the entry of a line; None if it is damaged."""
    digest, _, text = line.rstrip(b"\n").partition(b" ")
    if digest != _digest(text):
        return None
    try:
        head, _, record = text.decode().partition("\t")
        fields = strict_json(head)
        key = fields.pop("key")
        entry = Ended(value=None if record == NOTHING else record, **fields)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    is_whole = entry.state in STATES and (entry.value is not None) == (entry.state == "done")
    return (key, entry) if is_whole and isinstance(key, str) else None


def _digest(text: bytes) -> bytes:
    return hashlib.blake2b(text, digest_size=16).hexdigest().encode()


def record_text(record: dict[str, Any]) -> str:
    """Return a trial's record as one line of JSON; NaN, which JSON cannot hold, becomes null."""
    return canonical_json(_without_nan(record))


def _without_nan(record: Any) -> Any:
    if isinstance(record, dict):
        return {key: _without_nan(value) for key, value in record.items()}
    if isinstance(record, list):
        return [_without_nan(value) for value in record]
    return None if isinstance(record, float) and record != record else record
