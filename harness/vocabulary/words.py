"""Words that a user may have meant."""

import difflib
from collections.abc import Iterable

from harness.vocabulary.errors import UserError

DAMAGE = {
    "hole": "through",
    "through-hole": "through",
    "blind-hole": "blind",
    "crack": "slot",
    "scratch": "gouge",
    "bump": "pressed_bump",
    "rust": "corrosion",
}
"""Kinds of damage, as experiments name them, by words that people use."""
LEAST_HELD = 3
"""Least letters of a word that is searched for within others; shorter words match too often."""


def nearest(word: object, words: Iterable[object]) -> str | None:
    """Return which of ``words`` the user most likely meant, ignoring case and dashes: the kind of
    damage that people call so, else the most similar spelling, else the shortest that contains the
    word (three letters or more), as realsense_l515 contains l515; None if neither."""
    folded = {_folded(word): str(word) for word in words}
    sought = _folded(word)
    kind = kind_called(str(word))
    if kind != str(word) and kind in folded:
        return folded[kind]
    matches = difflib.get_close_matches(sought, folded, n=1)
    if not matches and len(sought) >= LEAST_HELD:
        matches = sorted(
            (candidate for candidate in folded if sought in candidate),
            key=lambda candidate: (len(candidate), candidate),
        )
    return folded[matches[0]] if matches else None


def damage_kind(option: str, word: str, kinds: Iterable[str]) -> str:
    """Return which of the ``kinds`` of damage a user means, by their names or the words of
    `DAMAGE`. Raises UserError that names the option."""
    legal = list(kinds)
    kind = kind_called(word)
    if kind in legal:
        return kind
    words = [*(said for said, meant in DAMAGE.items() if meant in legal), *legal]
    meant = nearest(word, words)
    hint = f"; did you mean {meant!r}?" if meant else ""
    raise UserError(f"{option} {word}: no such damage here{hint}", legal=", ".join(words))


def kind_called(word: str) -> str:
    """Return the kind of damage that people call so, else the word itself."""
    kind_of_word = {_folded(said): kind for said, kind in DAMAGE.items()}
    return kind_of_word.get(_folded(word), word)


def _folded(word: object) -> str:
    return str(word).lower().replace("-", "_")
