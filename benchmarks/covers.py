"""How much of a bonnet or dashboard in view is taken for drivable area, or for lane markings?

    python benchmarks/covers.py --data DATA

Every ``--every``-th image of the split by day is shown to each model as it is, and with its lower part covered by an
arched, slightly noisy surface: black, grey or beige. Prints, over these images, which share of the cover is marked as
drivable and as lane, in how many images more than half of it is drivable, and the IoU of the drivable area with the
label above where the cover ends: without a cover, with it, with it and an ego mask of it (``--ego-mask`` of `predict`),
and of the image without its lower part.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import trilitenet
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.sample import Sample
from trilitenet.inference.predictor import Predictor
from trilitenet.processing.ego_mask import EgoMask
from trilitenet.structures import Perception

COVERS: Final = {"black": 15.0, "grey": 90.0, "beige": 170.0}
"""Brightness of each at half height, of 255."""


def place(size: tuple[int, int], middle: float) -> NDArray[np.bool_]:
    """Return where the cover is on an image of (height, width), from a share of its height on in the middle."""
    height, width = size
    top = height * (middle + 0.06 * np.linspace(-1, 1, width) ** 2)
    return np.asarray(np.arange(height)[:, None] >= top[None])


def covered(image: NDArray[np.uint8], mask: NDArray[np.bool_], brightness: float, seed: int) -> NDArray[np.uint8]:
    """Return a (H, W, 3) uint8 RGB image with the cover drawn over it."""
    rows = brightness + np.linspace(-8, 25, image.shape[0])[:, None]
    surface = rows + np.random.default_rng(seed).normal(0, 3, mask.shape)
    return np.where(mask[..., None], np.clip(surface, 0, 255).astype(np.uint8)[..., None], image)


def find(predictor: Predictor, image: NDArray[np.uint8], rows: int) -> NDArray[np.bool_]:
    """Return the drivable area of an image that was cut below so many rows."""
    found = np.zeros(image.shape[:2], np.bool_)
    found[:rows] = _drivable(predictor(np.ascontiguousarray(image[:rows])))
    return found


def _drivable(perception: Perception) -> NDArray[np.bool_]:
    assert perception.drivable is not None
    return perception.drivable


class Above:
    """The IoU of the drivable area with the label above the cover, over several images."""

    def __init__(self) -> None:
        self._both = self._either = 0

    def add(self, found: NDArray[np.bool_], sample: Sample, mask: NDArray[np.bool_]) -> None:
        assert sample.drivable is not None
        truth, above = sample.drivable > 0, ~mask
        self._both += int((found & truth)[above].sum())
        self._either += int((found | truth)[above].sum())

    def __str__(self) -> str:
        return f"{self._both / max(self._either, 1):.3f}"


def show(predictor: Predictor, samples: list[Sample], top: float) -> None:
    """Print the rows of one model."""
    plain, cut = Above(), Above()
    for sample in samples:
        mask = place(sample.size, top)
        plain.add(find(predictor, sample.image, sample.size[0]), sample, mask)
        cut.add(find(predictor, sample.image, int(mask.any(axis=1).argmax())), sample, mask)
    print(f"  no cover: drivable IoU above it {plain}; of the image without its lower part {cut}")
    for cover, brightness in COVERS.items():
        drivable, lane = [], []
        bare, masked = Above(), Above()
        for seed, sample in enumerate(samples):
            mask = place(sample.size, top)
            image = covered(sample.image, mask, brightness, seed)
            found = predictor(image)
            assert found.lane is not None
            drivable.append(_drivable(found)[mask].mean())
            lane.append(found.lane[mask].mean())
            bare.add(_drivable(found), sample, mask)
            predictor.ego_mask = EgoMask(mask)
            masked.add(_drivable(predictor(image)), sample, mask)
            predictor.ego_mask = None
        most = np.mean(np.array(drivable) > 0.5)
        print(
            f"  {cover:<6} drivable {np.mean(drivable):.3f}, over half in {most:.2f}, lane {np.mean(lane):.3f}; "
            f"above it drivable IoU {bare}, with an ego mask {masked}"
        )


def main() -> None:
    """Print a table for each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="root of a data set in the published layout")
    parser.add_argument("--split", default="val")
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--top", type=float, default=0.76, help="share of the height at which the cover begins")
    parser.add_argument("--weights", nargs="+", default=["tiny", "small", "base"])
    options = parser.parse_args()
    dataset = DrivingDataset(options.data, options.split)
    samples = [dataset[index] for index in range(0, len(dataset), options.every)]
    samples = [each for each in samples if each.drivable is not None and each.attributes.get("timeofday") != "night"]
    for name in options.weights:
        with trilitenet.load(name) as predictor:
            print(f"{name}, {len(samples)} images of {options.split}, cover from {options.top} of the height on")
            show(predictor, samples, options.top)


if __name__ == "__main__":
    main()
