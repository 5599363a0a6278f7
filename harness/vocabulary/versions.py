"""Versions of stored files: every file says which it is, a newer one is refused, an older one is read or made anew.

Each kind of file has its number beside the code that writes it (`RESULTS_VERSION` here is of a result folder's tables
and pages). How it stands there: in JSON and Parquet by a key; in CSV by a column, which every reader keeps and
which survives joining; in YAML by a comment on the first line; in HTML by ``<meta name="generator">``.
"""

from __future__ import annotations

import re
from pathlib import Path

from harness.vocabulary.errors import UserError

RESULTS_VERSION = 1
"""Stands in every file of a result folder that has no version of its own; raised when the tables' meaning changes."""
GENERATOR = f"tofpod results {RESULTS_VERSION}"
"""Stands in pages."""
STAMP = re.compile(r"#\s*tofpod (\w+)(.*)")


def check_version(
    found: object, known: int, path: Path, what: str, *, oldest: int | None = None, again: str | None = None
) -> int:
    """The version of a file that can be read: from ``oldest`` (default: ``known``) to ``known``.

    ``what`` the file is, with its article ("a record"). ``again``: what makes an older one anew, for the message.
    Raises UserError where it is newer, older, missing or no version at all.
    """
    first = known if oldest is None else oldest
    legal = f"version {known}" if first == known else f"versions {first} to {known}"
    if isinstance(found, bool) or not isinstance(found, int) or found < 0:
        said = "states no version" if found is None else f"states the version {str(found)[:40]!r}, which is none"
        raise UserError(f"{path}: {said} of {what}", legal=legal, fix=again)
    if found > known:
        raise UserError(
            f"{path}: was written by a newer tofpod: it is {what} of version {found}",
            legal=legal,
            fix="upgrade tofpod, or use the one that wrote it",
        )
    if found < first:
        raise UserError(f"{path}: is {what} of version {found}", legal=legal, fix=again)
    return found


def stamped(kind: str, version: int) -> str:
    """The first line of a text file of ours, with its end."""
    return f"# tofpod {kind} {version}\n"


def stamp_of(text: str, kind: str) -> object:
    """The version that a text's first line states: an int; the text after the kind where it is no number; None where
    the line is no stamp of this kind, as in a file that somebody wrote by hand."""
    line = text.partition("\n")[0]
    match = STAMP.match(line.removeprefix("\ufeff").strip())
    if match is None or match[1] != kind:
        return None
    number = match[2].strip()
    return int(number) if re.fullmatch(r"[0-9]{1,9}", number) else number
