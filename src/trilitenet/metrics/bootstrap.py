"""Bootstrap by image or by group of images: how far a figure would move had others of the same kind been drawn.

Images are drawn with replacement as many times as there are (Efron, 1979); each draw gives every figure anew, and the
95% interval is the range of the middle 95% of them (percentile method). Frames of one drive are much alike: where
images come in groups, whole groups are drawn, as many as there are, or the interval would be too narrow (the cluster
bootstrap; Field and Welsh, 2007). To compare two models the same draws are used for both, so that hard images are hard
for both: a difference is real when its interval leaves out 0.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from trilitenet.metrics.arithmetic import FloatArray
from trilitenet.processing.cores import usable_cores

__all__ = ["bootstrap", "draws", "interval"]

_CHUNK = 100
_THREADS = 2


def draws(
    images: int, resamples: int, seed: int = 0, groups: Sequence[int] | None = None
) -> Iterator[NDArray[np.int32]]:
    """Yield (up to 100, images) arrays of how often each image is drawn, ``resamples`` rows in all.

    Args:
        images: How many images there are.
        resamples: How often to resample.
        seed: The same seed gives the same draws.
        groups: The group of each image, 0, 1, ...; a draw takes all images of a group. By default each is its own.
    """
    rng = np.random.default_rng(seed)
    member: NDArray[np.int64] = np.arange(images) if groups is None else np.asarray(groups, np.int64)
    count = int(member.max(initial=-1)) + 1
    for start in range(0, resamples, _CHUNK):
        rows = min(_CHUNK, resamples - start)
        weights = np.zeros((rows, images), np.int32)
        for row in weights:
            row += np.bincount(rng.integers(0, count, count), minlength=count).astype(np.int32)[member]
        yield weights


def bootstrap(
    figures: Callable[[NDArray[np.int32]], Mapping[str, FloatArray]],
    images: int,
    resamples: int,
    seed: int = 0,
    groups: Sequence[int] | None = None,
) -> dict[str, FloatArray]:
    """Compute figures on resampled images.

    Args:
        figures: (R, images) weights -> name -> (R,) values; called from two threads at once.
        images: How many images there are.
        resamples: How often to resample.
        seed: The same seed gives the same draws, so that models can be compared pairwise.
        groups: The group of each image; see `draws`.

    Returns:
        Name -> (resamples,) values; NaN from a single image or group, which says nothing of others.
    """
    alone = images == 1 if groups is None else len(set(groups)) == 1
    numbered = enumerate(draws(images, resamples, seed, groups))
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
    values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}
    return {name: np.full_like(drawn, np.nan) for name, drawn in values.items()} if alone else values


def interval(values: FloatArray) -> tuple[float, float]:
    """Return the range of the middle 95% of the values, NaN left out; NaN if nothing is left."""
    known = values[~np.isnan(values)]
    if not len(known):
        return float("nan"), float("nan")
    low, high = np.quantile(known, [0.025, 0.975])
    return float(low), float(high)
