"""Bytes that LZF packs, against streams that are written by hand."""

import numpy as np
import pytest

from detectors.recordings.lzf import unpack
from tests.support.recorded_plane import lzf_literals

RANDOM = np.random.default_rng(1).integers(0, 256, 9000, dtype=np.uint8).tobytes()


def copied(length: int, back: int) -> bytes:
    """An instruction to repeat ``length`` bytes, 3 to 264, from ``back`` bytes before, 1 to 8192."""
    high, low = divmod(back - 1, 256)
    if length <= 8:
        return bytes([(length - 2) << 5 | high, low])
    return bytes([7 << 5 | high, length - 9, low])


def test_bytes_are_taken_lzf_literals() -> None:
    assert unpack(lzf_literals(RANDOM[:75]), 75) == RANDOM[:75]


@pytest.mark.parametrize("length", [3, 8, 9, 256])
@pytest.mark.parametrize("back", [256, 257, 4097, 8192])
def test_bytes_are_repeated_from_far_before(length: int, back: int) -> None:
    packed = lzf_literals(RANDOM) + copied(length, back)
    start = len(RANDOM) - back
    assert unpack(packed, len(RANDOM) + length) == RANDOM + RANDOM[start : start + length]


def test_a_repetition_may_overlap_what_it_writes() -> None:
    packed = lzf_literals(b"abc") + copied(8, 2)
    assert unpack(packed, 11) == b"abc" + b"bcbcbcbc"


@pytest.mark.parametrize(
    "packed",
    [
        lzf_literals(b"abcd")[:-1],
        lzf_literals(b"abcd") + copied(4, 4)[:1],
        lzf_literals(b"abcd") + copied(20, 4)[:1],
        lzf_literals(b"abcd") + copied(20, 4)[:2],
        lzf_literals(b"abcd") + copied(4, 5),
        lzf_literals(b"abcd") + copied(5, 4),
        lzf_literals(b"abcd"),
    ],
    ids=[
        "a run ends early",
        "no distance",
        "no length",
        "a length and no distance",
        "from before the first byte",
        "a byte too many",
        "bytes too few",
    ],
)
def test_damaged_bytes_are_refused(packed: bytes) -> None:
    with pytest.raises(ValueError, match="damaged"):
        unpack(packed, 8)
