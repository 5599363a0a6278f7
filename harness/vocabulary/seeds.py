"""Random streams and digests derived from content, so that order, processes and resumption cannot
change a result."""

import hashlib
import json
from typing import Any

import numpy as np


def canonical_json(value: Any) -> str:
    """Return the unique JSON text of plain data: sorted keys, no white space, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """Return the first 16 hexadecimal digits of the BLAKE2b digest of plain data."""
    return hashlib.blake2b(canonical_json(value).encode(), digest_size=32).hexdigest()[:16]


def random_stream(seed: int, *labels: str | int) -> np.random.Generator:
    """Return the random stream of (seed, labels): equal labels give equal numbers in any process
    and order. SFC64 is the fastest of NumPy's generators that passes PractRand; streams are
    separated by a 128-bit hash."""
    key = hashlib.blake2b(canonical_json([seed, *labels]).encode(), digest_size=16).digest()
    return np.random.Generator(
        np.random.SFC64(np.random.SeedSequence(int.from_bytes(key, "little")))
    )
