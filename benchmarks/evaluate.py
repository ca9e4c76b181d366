"""How much longer evaluating takes than inference alone, and how much memory it needs.

    python benchmarks/evaluate.py MODEL [--frames 1000] [--unique 100] [--protocol fair]
    python benchmarks/evaluate.py MODEL --growth 100 1000 10000

Synthetic scenes of 1280x720 are written to a temporary folder first, ``--unique`` of them, and taken round and round.
Inference alone reads each image file and calls the predictor (letterbox, network, masks and boxes at native size).
Evaluation reads the labels too, scores everything, keeps pictures of the worst images, and computes intervals. The two
alternate in rounds within one process, so that whatever else the machine does hits both.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from trilitenet.commands.load import load
from trilitenet.data.reading import DrivingDataset, decode_image
from trilitenet.data.sample import Sample
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.provenance import describe_hardware, peak_memory


class Repeated:
    """The first ``count`` images of a data set that starts again when it ends."""

    def __init__(self, dataset: DrivingDataset, count: int) -> None:
        self._dataset, self._count = dataset, count
        self.class_names = dataset.class_names

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Sample:
        return self._dataset[index % len(self._dataset)]


def clock() -> tuple[float, float]:
    """Seconds on the clock, and of processor time over all threads."""
    return time.perf_counter(), time.process_time()


def infer(model: object, dataset: DrivingDataset, count: int) -> None:
    for index in range(count):
        path = dataset.image_path(index % len(dataset))
        model.perceive([decode_image(path.read_bytes(), path.name)])  # type: ignore[attr-defined]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default="tiny")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--unique", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--protocol", default="fair")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--growth", type=int, nargs="+", help="instead: peak memory after so many frames, rising")
    parser.add_argument("--data", type=Path, help="a data set to use instead of synthetic scenes")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = arguments.data
        if root is None:
            root = Path(folder)
            write_dataset(root, "val", arguments.unique, 0, size=(720, 1280))
        dataset = DrivingDataset(root, "val")
        height, width = dataset[0].size
        model = load(arguments.model, backend=arguments.backend)
        count = arguments.frames // arguments.rounds
        infer(model, dataset, 10)
        evaluate(model, Repeated(dataset, 10), protocol=arguments.protocol)
        if arguments.growth:
            for frames in arguments.growth:
                evaluate(model, Repeated(dataset, frames), protocol=arguments.protocol)
                print(f"{frames} frames: peak memory {peak_memory():.0f} MiB", flush=True)
            return
        before = peak_memory()
        alone, scored = [], []
        for _ in range(arguments.rounds):
            start = clock()
            infer(model, dataset, count)
            middle = clock()
            evaluate(model, Repeated(dataset, count), protocol=arguments.protocol)
            end = clock()
            alone.append([b - a for a, b in zip(start, middle, strict=True)])
            scored.append([b - a for a, b in zip(middle, end, strict=True)])
        print(f"{arguments.model} ({model.backend.name}), {width}x{height}, {describe_hardware(model.backend.name)}")
        for which, name in enumerate(("clock", "processor")):
            first, second = ([1000 * row[which] / count for row in rows] for rows in (alone, scored))
            ratios = [after / before for before, after in zip(first, second, strict=True)]
            print(
                f"{name:9}  inference alone {statistics.median(first):6.1f} ms a frame, "
                f"evaluation ({arguments.protocol}) {statistics.median(second):6.1f} ms, "
                f"ratio {statistics.median(ratios):.2f} (rounds {', '.join(f'{one:.2f}' for one in ratios)})"
            )
        print(f"peak memory {peak_memory():.0f} MiB (before the rounds {before:.0f})")


if __name__ == "__main__":
    main()
