"""Where the drivable area differs from its labels: is that road to people?

    python benchmarks/people.py --data DATA --road DATA/human_road/val --models tiny small base

``--road`` holds masks of the whole road drawn by people (NAME.png, not zero is road), both directions, so wider than
what is drivable. For each model, prints the IoU with the labels on those images, how much of the area found lies on the
road, and how much of what is too much and too little against the labels does.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import trilitenet
from trilitenet.data.description import MaskMeaning
from trilitenet.data.reading import DrivingDataset, decode_mask
from trilitenet.metrics.segmentation import as_binary, confusion, confusion_figures

Mask = NDArray[np.uint8]
Figures = dict[str, NDArray[np.float64]]


def read_road(path: Path, size: tuple[int, int]) -> Mask:
    """Return people's mask of the road at the (height, width) of the label."""
    mask, _ = decode_mask(path.read_bytes(), str(path), MaskMeaning(above=0))
    return np.asarray(cv2.resize(mask, size[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)


def figures(masks: Sequence[Mask], truths: Sequence[Mask]) -> Figures:
    """Return the figures of all masks together; ``precision`` is how much of them lies on the truths."""
    return confusion_figures(np.sum([confusion(*pair) for pair in zip(masks, truths, strict=True)], axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--split", default="val")
    parser.add_argument("--road", type=Path, required=True)
    parser.add_argument("--models", nargs="+", default=["tiny", "small", "base"])
    options = parser.parse_args()
    dataset = DrivingDataset(options.data, options.split)
    images, labels, roads = [], [], []
    for index, name in enumerate(dataset.names):
        path = options.road / f"{name}.png"
        if path.is_file() and (sample := dataset[index]).drivable is not None:
            images.append(sample.image)
            labels.append(as_binary(sample.drivable))
            roads.append(read_road(path, sample.size))
    if not images:
        raise SystemExit(f"no labelled image of {options.data} ({options.split}) has a mask in {options.road}")
    on_road = figures(labels, roads)["precision"]
    print(f"{len(images)} images, {100 * on_road:.1f}% of the labels' drivable area is road")
    for name in options.models:
        predictor = trilitenet.load(name)
        masks = [predictor(image).drivable for image in images]
        found = [as_binary(mask) for mask in masks if mask is not None]
        if len(found) < len(images):
            raise SystemExit(f"{name} finds no drivable area")
        much = [mask & (1 - label) for mask, label in zip(found, labels, strict=True)]
        little = [label & (1 - mask) for mask, label in zip(found, labels, strict=True)]
        print(
            f"{name:6} IoU {figures(found, labels)['iou']:.3f}; "
            f"of the area found {100 * figures(found, roads)['precision']:.1f}% is road, "
            f"of what is too much {100 * figures(much, roads)['precision']:.0f}%, "
            f"of what is too little {100 * figures(little, roads)['precision']:.0f}%",
            flush=True,
        )


if __name__ == "__main__":
    main()
