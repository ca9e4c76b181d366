"""Bootstrap by image: how far a figure would move had other images of the same kind been drawn.

Images are drawn with replacement as many times as there are (Efron, 1979); each draw gives every figure anew, and the
95% interval is the range of the middle 95% of them (percentile method). To compare two models the same draws are used
for both, so that hard images are hard for both: a difference is real when its interval leaves out 0.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from trilitenet.processing.cores import usable_cores

__all__ = ["bootstrap", "draws", "interval"]

FloatArray = NDArray[np.float64]
_CHUNK = 100
_THREADS = 2


def draws(images: int, resamples: int, seed: int = 0) -> Iterator[NDArray[np.int32]]:
    """Yield (up to 100, images) arrays of how often each image is drawn, ``resamples`` rows in all."""
    rng = np.random.default_rng(seed)
    for start in range(0, resamples, _CHUNK):
        rows = min(_CHUNK, resamples - start)
        weights = np.zeros((rows, images), np.int32)
        for row in weights:
            row += np.bincount(rng.integers(0, images, images), minlength=images).astype(np.int32)
        yield weights


def bootstrap(
    figures: Callable[[NDArray[np.int32]], Mapping[str, FloatArray]], images: int, resamples: int, seed: int = 0
) -> dict[str, FloatArray]:
    """Compute figures on resampled images.

    Args:
        figures: (R, images) weights -> name -> (R,) values; called from two threads at once.
        images: How many images there are.
        resamples: How often to resample.
        seed: The same seed gives the same draws, so that models can be compared pairwise.

    Returns:
        Name -> (resamples,) values.
    """
    numbered = enumerate(draws(images, resamples, seed))
    lock = threading.Lock()
    done: dict[int, Mapping[str, FloatArray]] = {}

    def work() -> None:
        while True:
            with lock:
                number, weights = next(numbered, (0, None))
            if weights is None:
                return
            done[number] = figures(weights)

    # NumPy lets other threads run while it computes; a thread holds one chunk of draws at a time.
    workers = min(_THREADS, usable_cores())
    with ThreadPoolExecutor(workers, thread_name_prefix="bootstrap") as pool:
        for future in [pool.submit(work) for _ in range(workers)]:
            future.result()
    parts = [done[number] for number in sorted(done)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


def interval(values: FloatArray) -> tuple[float, float]:
    """Return the range of the middle 95% of the values, NaN left out; NaN if nothing is left."""
    known = values[~np.isnan(values)]
    if not len(known):
        return float("nan"), float("nan")
    low, high = np.quantile(known, [0.025, 0.975])
    return float(low), float(high)
