"""The allocator: freed memory is kept for what needs the same again; and errors that say that none is left."""

from __future__ import annotations

import ctypes
import sys
from typing import Final

__all__ = ["IMAGES", "STEPS", "keep_freed_memory", "lacks_memory"]

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -2, -3, -4, -8
"""Options of glibc's ``mallopt``."""

STEPS: Final = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 2**28))
"""Keeps all that a training step took for the next one: on a CPU a step is a tenth faster."""
IMAGES: Final = ((_ARENA_MAX, 2), (_MMAP_THRESHOLD, 2**25), (_TRIM_THRESHOLD, 2**27), (_TOP_PAD, 2**24))
"""Keeps the buffers of one image for the next, in few arenas: getting them again page by page takes 4,500 faults for
1280x720, a quarter of all processor time under load. Those of larger images are still given back at once."""


def keep_freed_memory(options: tuple[tuple[int, int], ...]) -> bool:
    """Set `STEPS` or `IMAGES`; return whether the C library took them: one that is not glibc does not."""
    mallopt = getattr(ctypes.CDLL(None) if sys.platform == "linux" else None, "mallopt", None)
    return mallopt is not None and all(mallopt(option, value) for option, value in options)


def lacks_memory(error: BaseException | None) -> bool:
    """Return whether an error of Python, NumPy or PyTorch says that memory is used up.

    PyTorch has a class of errors for devices, and names its allocator where a CPU has no memory left.
    """
    return (
        isinstance(error, MemoryError)
        or type(error).__name__ == "OutOfMemoryError"
        or (isinstance(error, RuntimeError) and "DefaultCPUAllocator" in str(error))
    )
