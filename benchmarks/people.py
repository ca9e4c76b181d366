"""Where the drivable area differs from its labels: is that road to people?

    python benchmarks/people.py --data DATA --road DATA/human_road/val --models tiny small base

``--road`` holds masks of the whole road drawn by people (NAME.png, not zero is road), both directions, so wider than
what is drivable. For each model, prints the IoU with the labels on those images, how much of the area found lies on the
road, and how much of what is too much and too little against the labels does.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.commands.load import load
from trilitenet.data.reading import DrivingDataset
from trilitenet.inference.predictor import Predictor

Mask = NDArray[np.bool_]


def read_road(path: Path, shape: tuple[int, ...]) -> Mask:
    """Return people's mask of the road at the size of the label."""
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise SystemExit(f"{path} is no readable image")
    return np.asarray(cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST)) > 0


def count(found: Mask, label: Mask, road: Mask) -> list[int]:
    """Count pixels: right, in either, found, too much, too little; of the last three also those on the road."""
    much, little = found & ~label, label & ~found
    masks = (found & label, found | label, found, much, little, found & road, much & road, little & road)
    return [int(mask.sum()) for mask in masks]


def drivable(model: Predictor, image: NDArray[np.uint8]) -> Mask:
    """Return the drivable area that a model finds in an RGB image."""
    mask = model.perceive([image])[0].drivable
    if mask is None:
        raise SystemExit("the model finds no drivable area")
    return mask > 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--split", default="val")
    parser.add_argument("--road", type=Path, required=True)
    parser.add_argument("--models", nargs="+", default=["tiny", "small", "base"])
    options = parser.parse_args()
    dataset = DrivingDataset(options.data, options.split)
    samples = [dataset[index] for index, name in enumerate(dataset.names) if (options.road / f"{name}.png").is_file()]
    labelled = [(sample, sample.drivable == 1) for sample in samples if sample.drivable is not None]
    if not labelled:
        raise SystemExit(f"no labelled image of {options.data} ({options.split}) has a mask in {options.road}")
    samples, labels = [sample for sample, _ in labelled], [label for _, label in labelled]
    roads = [read_road(options.road / f"{sample.name}.png", label.shape) for sample, label in labelled]
    print(f"{len(samples)} images, {100 * share(labels, roads):.1f}% of the labels' drivable area is road")
    for name in options.models:
        model = load(name)
        found = [drivable(model, sample.image) for sample in samples]
        sums = np.sum([count(*masks) for masks in zip(found, labels, roads, strict=True)], axis=0)
        right, either, area, much, little, area_road, much_road, little_road = sums
        print(
            f"{name:6} IoU {right / either:.3f}; of the area found {100 * area_road / area:.1f}% is road, "
            f"of what is too much {100 * much_road / much:.0f}%, "
            f"of what is too little {100 * little_road / little:.0f}%",
            flush=True,
        )


def share(masks: list[Mask], roads: list[Mask]) -> float:
    """Return how much of the masks lies on the roads."""
    inside = sum(int((mask & road).sum()) for mask, road in zip(masks, roads, strict=True))
    return inside / sum(int(mask.sum()) for mask in masks)


if __name__ == "__main__":
    main()
