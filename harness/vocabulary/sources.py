"""The program's own text as part of a key: stored results are not taken for those of changed code."""

from __future__ import annotations

import hashlib
import importlib.metadata
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@lru_cache
def source_digest(folders: tuple[str, ...], packages: tuple[str, ...]) -> str:
    """Digest of every Python source below ``folders`` (from the project's root) and of the versions of ``packages``."""
    state = hashlib.blake2b(digest_size=8)
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            state.update(path.relative_to(ROOT).as_posix().encode())
            state.update(path.read_bytes())
    for name in packages:
        state.update(f"{name} {importlib.metadata.version(name)}".encode())
    return state.hexdigest()
