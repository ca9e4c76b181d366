"""Samples a second of the training loader: 1280x720 JPEG and PNG files against the prepared copies, in turns.

    trilitenet data synthesize DIR --count 160 --size 720 1280
    python benchmarks/loader.py DIR

Everything is read once before, so it is decoding and augmentation that is measured, not the disk; one core, no workers.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import cv2
import torch

from trilitenet.data.loader import Loader, build_loader
from trilitenet.data.prepared import PreparedDataset, prepare
from trilitenet.data.reading import DrivingDataset, SampleSource
from trilitenet.data.transforms import TrainTransform


def rate(loader: Loader, epoch: int) -> float:
    """Samples a second over one epoch."""
    start = time.perf_counter()
    count = sum(len(batch) for batch in loader.epoch(epoch))
    return count / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="train")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        sources: dict[str, SampleSource] = {"files": DrivingDataset(options.data, options.split)}
        sizes = {}
        for images in ("jpeg", "raw"):
            out = Path(folder) / images
            prepare(options.data, out, splits=[options.split], images=images)
            sources[f"prepared, {images}"] = PreparedDataset(out, options.split)
            sizes[f"prepared, {images}"] = sum(path.stat().st_size for path in out.iterdir())
        loaders = {
            name: build_loader(source, TrainTransform(), batch_size=16, seed=0) for name, source in sources.items()
        }
        for loader in loaders.values():
            rate(loader, 0)
        rates: dict[str, list[float]] = {name: [] for name in loaders}
        for round_ in range(options.rounds):
            for name, loader in loaders.items():
                rates[name].append(rate(loader, round_))
        ratios = {n: statistics.median(a / b for a, b in zip(v, rates["files"], strict=True)) for n, v in rates.items()}
        for name, values in rates.items():
            size = f", {sizes[name] / len(sources[name]) / 1024:.0f} KiB a sample" if name in sizes else ""
            print(f"{name:16} {statistics.median(values):6.1f} samples/s, {ratios[name]:.2f}x{size}")


if __name__ == "__main__":
    main()
