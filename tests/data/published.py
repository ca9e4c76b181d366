"""A small data set in the published layout, for tests: noise images with labels that differ from image to image."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np


def write_published(root: Path, split: str, count: int, size: tuple[int, int] = (72, 128), *, seed: int = 0) -> None:
    """Write ``count`` images; every 4th lacks its drivable mask, every 5th its lane mask, every 7th its boxes."""
    rng = np.random.default_rng([seed, count])
    height, width = size
    for folder in ("images", "det_annotations", "da_seg_annotations", "ll_seg_annotations"):
        (root / folder / split).mkdir(parents=True, exist_ok=True)
    for index in range(count):
        name = f"{split}_{index:04}"
        coarse = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
        image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(root / f"images/{split}/{name}.jpg"), image)
        mask = np.zeros(size, np.uint8)
        mask[height // 2 :, 4 + index % 9 : width - 4] = 255
        if index % 4 != 3:
            cv2.imwrite(str(root / f"da_seg_annotations/{split}/{name}.png"), mask)
        lane = np.zeros(size, np.uint8)
        lane[height // 3 :, 10 + index % 20 : 12 + index % 20] = 255
        if index % 5 != 4:
            cv2.imwrite(str(root / f"ll_seg_annotations/{split}/{name}.png"), lane)
        if index % 7 != 6:
            write_annotation(
                root, split, name, objects(rng, size, 1 + index % 3), timeofday=("day", "night")[index % 2]
            )


def objects(rng: np.random.Generator, size: tuple[int, int], count: int) -> list[dict[str, Any]]:
    items = []
    for number in range(count):
        x, y = rng.uniform(0, size[1] * 0.6), rng.uniform(0, size[0] * 0.6)
        box = {"x1": x, "y1": y, "x2": x + rng.uniform(8, size[1] * 0.3), "y2": y + rng.uniform(8, size[0] * 0.3)}
        items.append({"category": "car", "box2d": box, "attributes": {"crowd": number == 2}})
    return items


def write_annotation(root: Path, split: str, name: str, items: list[dict[str, Any]], **attributes: str) -> None:
    content = {"name": name, "attributes": attributes, "frames": [{"timestamp": 0, "objects": items}]}
    (root / f"det_annotations/{split}/{name}.json").write_text(json.dumps(content))
