"""JSON from files that somebody else may have written: each key once, no NaN, no deeper than Python reads."""

from __future__ import annotations

import json
from typing import Any


def strict_json(content: bytes | str, *, nan: bool = False) -> Any:
    """The value of a JSON text (UTF-8). Raises ValueError, saying why, for whatever is no JSON: a key that stands
    twice in an object, NaN and Infinity (unless ``nan``), too deep nesting, too long integers."""
    text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_constant=None if nan else _no_number)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {twice[:60]} stands twice")
    return found


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is no number of JSON")
