"""How much of a bonnet or dashboard in view is taken for drivable area, or for lane markings?

    python benchmarks/covers.py --data DATA

Every ``--every``-th image of the split by day is shown to each model as it is, and with its lower part covered by an
arched, slightly noisy surface: black, grey or beige. Prints, over these images, which share of the cover is marked as
drivable and as lane, in how many images more than half of it is drivable, and the IoU of the drivable area with the
label above where the cover ends, without it and with it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import trilitenet
from trilitenet.data.reading import DrivingDataset

COVERS: Final = {"black": 15.0, "grey": 90.0, "beige": 170.0}
"""Brightness of each at half height, of 255."""
TOP: Final = (0.76, 0.82)
"""Share of the height at which the cover begins, in the middle and at the sides."""


def place(size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return where the cover is on an image of (height, width)."""
    height, width = size
    middle, side = TOP
    top = height * (middle + (side - middle) * np.linspace(-1, 1, width) ** 2)
    return np.asarray(np.arange(height)[:, None] >= top[None])


def covered(image: NDArray[np.uint8], mask: NDArray[np.bool_], brightness: float, seed: int) -> NDArray[np.uint8]:
    """Return a (H, W, 3) uint8 RGB image with the cover drawn over it."""
    rows = brightness + np.linspace(-8, 25, image.shape[0])[:, None]
    surface = rows + np.random.default_rng(seed).normal(0, 3, mask.shape)
    return np.where(mask[..., None], np.clip(surface, 0, 255).astype(np.uint8)[..., None], image)


def main() -> None:
    """Print a table for each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="root of a data set in the published layout")
    parser.add_argument("--split", default="val")
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--weights", nargs="+", default=["tiny", "small", "base"])
    options = parser.parse_args()
    dataset = DrivingDataset(options.data, options.split)
    samples = [dataset[index] for index in range(0, len(dataset), options.every)]
    samples = [each for each in samples if each.drivable is not None and each.attributes.get("timeofday") != "night"]
    for name in options.weights:
        with trilitenet.load(name) as predictor:
            print(f"{name}, {len(samples)} images of {options.split}")
            for cover, brightness in {"none": None, **COVERS}.items():
                drivable, lane, both, either = [], [], 0, 0
                for seed, sample in enumerate(samples):
                    mask = place(sample.size)
                    image = sample.image if brightness is None else covered(sample.image, mask, brightness, seed)
                    found = predictor(image)
                    assert sample.drivable is not None
                    assert found.drivable is not None
                    assert found.lane is not None
                    drivable.append(found.drivable[mask].mean())
                    lane.append(found.lane[mask].mean())
                    truth, above = sample.drivable > 0, ~mask
                    both += int((found.drivable & truth)[above].sum())
                    either += int((found.drivable | truth)[above].sum())
                most = np.mean(np.array(drivable) > 0.5)
                print(
                    f"  {cover:<6} drivable {np.mean(drivable):.3f}, over half in {most:.2f}, "
                    f"lane {np.mean(lane):.3f}; above it drivable IoU {both / max(either, 1):.3f}"
                )


if __name__ == "__main__":
    main()
