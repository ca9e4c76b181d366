"""Where the drivable area and the vehicles differ from their labels: what do people say?

    python benchmarks/people.py --data DATA --road DATA/human_road/val --vehicles DATA/human_vehicle/val

Both folders hold people's masks (NAME.png, not zero is road or vehicle), for some of the split's images.

``--road``: the whole road, both directions, so wider than what is drivable. For each model, prints the IoU with the
labels on those images, how much of the area found lies on the road, and how much of what is too much and too little
against the labels does.

``--vehicles``: for the labels and for each model at its own confidence, prints how many boxes hold a vehicle (people's
pixels cover a third of them), how many of the vehicles (connected pixels, `SMALLEST` or more of them at the size of the
image) lie in boxes for the most part, and how much of all vehicle pixels do.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import trilitenet
from trilitenet.data.description import MaskMeaning
from trilitenet.data.reading import DrivingDataset, decode_mask
from trilitenet.data.sample import Sample
from trilitenet.metrics.segmentation import as_binary, confusion, confusion_figures

Mask = NDArray[np.uint8]
Figures = dict[str, NDArray[np.float64]]

COVERED: Final = 1 / 3
"""A box holds a vehicle if people's vehicle pixels cover so much of it."""

SMALLEST: Final = 100
"""Fewer connected pixels are no vehicle of their own."""


def read_people(path: Path, size: tuple[int, int]) -> Mask:
    """Return people's mask at the (height, width) of the label."""
    mask, _ = decode_mask(path.read_bytes(), str(path), MaskMeaning(above=0))
    return np.asarray(cv2.resize(mask, size[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)


def read_both(dataset: DrivingDataset, folder: Path, wanted: Callable[[Sample], bool]) -> list[tuple[Sample, Mask]]:
    """Return the wanted images that people have marked, with their masks."""
    both = []
    for index, name in enumerate(dataset.names):
        path = folder / f"{name}.png"
        if path.is_file() and wanted(sample := dataset[index]):
            both.append((sample, read_people(path, sample.size)))
    if not both:
        raise SystemExit(f"no labelled image of {dataset.split} has a mask in {folder}")
    return both


def figures(masks: Sequence[Mask], truths: Sequence[Mask]) -> Figures:
    """Return the figures of all masks together; ``precision`` is how much of them lies on the truths."""
    return confusion_figures(np.sum([confusion(*pair) for pair in zip(masks, truths, strict=True)], axis=0))


def compare_road(dataset: DrivingDataset, folder: Path, models: Sequence[str]) -> None:
    """Print the figures of the drivable area."""
    both = read_both(dataset, folder, lambda sample: sample.drivable is not None)
    labels = [as_binary(sample.drivable) for sample, _ in both if sample.drivable is not None]
    roads = [road for _, road in both]
    on_road = figures(labels, roads)["precision"]
    print(f"{len(both)} images, {100 * on_road:.1f}% of the labels' drivable area is road")
    for name in models:
        predictor = trilitenet.load(name)
        masks = [predictor(sample.image).drivable for sample, _ in both]
        found = [as_binary(mask) for mask in masks if mask is not None]
        if len(found) < len(both):
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


def vehicle_figures(boxes: Sequence[NDArray[np.float32]], vehicles: Sequence[Mask]) -> str:
    """Return what the boxes (N, 4; left, top, right, bottom in pixels) of each image hold, as one line."""
    held, parts, pixels = [], [], np.zeros(2, np.int64)
    for here, mask in zip(boxes, vehicles, strict=True):
        inside = np.zeros_like(mask)
        for left, top, right, bottom in np.rint(here).astype(int).clip(0).tolist():
            held.append(mask[top:bottom, left:right].mean() > COVERED if bottom > top and right > left else False)
            inside[top:bottom, left:right] = 1
        _, regions, statistics, _ = cv2.connectedComponentsWithStats(mask)
        covered = np.bincount(regions.ravel(), inside.ravel(), minlength=len(statistics))
        areas = statistics[:, cv2.CC_STAT_AREA]
        parts.extend((covered / areas)[1:][areas[1:] >= SMALLEST] > 0.5)
        pixels += [int((inside & mask).sum()), int(mask.sum())]
    return (
        f"{len(held)} boxes, {100 * np.mean(held):.1f}% of them vehicles; {100 * np.mean(parts):.1f}% of {len(parts)} "
        f"vehicles and {100 * pixels[0] / pixels[1]:.1f}% of their pixels lie in boxes"
    )


def compare_vehicles(dataset: DrivingDataset, folder: Path, models: Sequence[str]) -> None:
    """Print the figures of the boxes."""
    both = read_both(dataset, folder, lambda sample: sample.boxes is not None)
    vehicles = [mask for _, mask in both]
    labelled = [sample.boxes for sample, _ in both if sample.boxes is not None]
    with_ignored = [np.concatenate([boxes, sample.ignored]) for boxes, (sample, _) in zip(labelled, both, strict=True)]
    print(f"{len(both)} images")
    print(f"labels: {vehicle_figures(labelled, vehicles)}")
    print(f"labels, with what is ignored: {vehicle_figures(with_ignored, vehicles)}")
    for name in models:
        predictor = trilitenet.load(name)
        found = [predictor(sample.image).boxes for sample, _ in both]
        print(f"{name:6} {vehicle_figures([boxes.xyxy for boxes in found if boxes is not None], vehicles)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--split", default="val")
    parser.add_argument("--road", type=Path)
    parser.add_argument("--vehicles", type=Path)
    parser.add_argument("--models", nargs="+", default=["tiny", "small", "base"])
    options = parser.parse_args()
    dataset = DrivingDataset(options.data, options.split)
    if options.road is not None:
        compare_road(dataset, options.road, options.models)
    if options.vehicles is not None:
        compare_vehicles(dataset, options.vehicles, options.models)


if __name__ == "__main__":
    main()
