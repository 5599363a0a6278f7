"""Words that a user may have meant."""

import difflib
from collections.abc import Iterable

LEAST_HELD = 3
"""Least letters of a word that is searched for within others; shorter words match too often."""


def nearest(word: object, words: Iterable[object]) -> str | None:
    """Return which of ``words`` the user most likely meant, ignoring case and dashes: the most
    similar spelling, else the shortest that contains the word (three letters or more), as
    realsense_l515 contains l515; None if neither."""
    folded = {str(word).lower().replace("-", "_"): str(word) for word in words}
    sought = str(word).lower().replace("-", "_")
    matches = difflib.get_close_matches(sought, folded, n=1)
    if not matches and len(sought) >= LEAST_HELD:
        matches = sorted(
            (candidate for candidate in folded if sought in candidate),
            key=lambda candidate: (len(candidate), candidate),
        )
    return folded[matches[0]] if matches else None
