from __future__ import annotations

import platform
import subprocess
import sys

import pytest


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_the_memory_of_an_image_is_used_again() -> None:
    script = """
import resource, sys
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from trilitenet.processing.memory import IMAGES, keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory(IMAGES)

def picture(_):
    return len([np.ones((720, 1280, 3), np.uint8) for _ in range(4)])

with ThreadPoolExecutor(1) as pool:
    list(pool.map(picture, range(10)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    list(pool.map(picture, range(10)))
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) // 10)
"""
    faults = {
        how: int(subprocess.run([sys.executable, "-c", script, how], capture_output=True, check=True).stdout)
        for how in ("keep", "as ever")
    }
    assert faults["keep"] < 50
    assert faults["as ever"] > 500
