"""LZF (Lehmann), by which PCD files are compressed."""

import numba
import numpy as np

LITERALS = 32
"""A control byte below it says how many bytes follow as they are, less one."""
LONG = 7  # a length of this many is continued by the next byte
SHORTEST = 2  # added to each length


def unpack(packed: bytes, size: int) -> bytes:
    """Return the ``size`` bytes that are packed. Raises ValueError unless there are as many."""
    unpacked = np.empty(size, np.uint8)
    if _unpack(np.frombuffer(packed, np.uint8), unpacked) != size:
        raise ValueError("its compressed data are damaged")
    return unpacked.tobytes()


@numba.njit(cache=True, nogil=True)
def _unpack(packed: np.ndarray, unpacked: np.ndarray) -> int:
    """Fill ``unpacked`` and return the number of bytes, -1 if they do not fit or the input ends
    within an instruction."""
    position = 0
    done = 0
    while position < len(packed):
        control = int(packed[position])
        position += 1
        if control < LITERALS:
            length = control + 1
            if position + length > len(packed) or done + length > len(unpacked):
                return -1
            for i in range(length):
                unpacked[done + i] = packed[position + i]
            position += length
            done += length
            continue
        length = control >> 5
        if length == LONG:
            if position >= len(packed):
                return -1
            length += int(packed[position])
            position += 1
        if position >= len(packed):
            return -1
        begin = done - ((control & 31) << 8) - int(packed[position]) - 1
        position += 1
        length += SHORTEST
        if begin < 0 or done + length > len(unpacked):
            return -1
        # one by one: a copy may overlap what it writes
        for i in range(length):
            unpacked[done + i] = unpacked[begin + i]
        done += length
    return done
