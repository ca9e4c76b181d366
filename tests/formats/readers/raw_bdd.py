"""A miniature BDD100K as it is downloaded, in each form of its labels, with masks worked out by hand.

Two train images and one val image of 64 x 36 pixels, so that all labels are small enough to check on paper. A width of
"8 px at 1280" is 0.4 px here, so the tests draw lanes at 40 px, which is 2 px.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = (36, 64)
WIDTH_AT_1280 = 40.0
WIDTH = 2.0

ATTRIBUTES = {"weather": "rainy", "scene": "highway", "timeofday": "night"}

CATEGORIES_OLD = (
    "car", "truck", "bus", "train", "person", "rider", "bike", "motor", "traffic light", "traffic sign",
)  # fmt: skip
CATEGORIES_NEW = (
    "car", "truck", "bus", "train", "pedestrian", "rider", "bicycle", "motorcycle", "traffic light", "traffic sign",
)  # fmt: skip

DIRECT = [[10.0, 20.0], [30.0, 20.0], [30.0, 30.0], [10.0, 30.0]]
ALTERNATIVE = [[40.0, 16.0], [56.0, 16.0], [56.0, 32.0]]
# The two edges of one upright marking, drawn in opposite directions: its centre line is x = 20.
EDGE_ONE = [[18.0, 4.0], [18.0, 16.0]]
EDGE_TWO = [[22.0, 16.0], [22.0, 4.0]]
# A Bezier curve (a straight one, so that the mask can be worked out) and its other edge: centre line y = 10.
BEZIER_ONE = [[34.0, 9.0], [38.0, 9.0], [44.0, 9.0], [50.0, 9.0]]
BEZIER_TWO = [[34.0, 11.0], [38.0, 11.0], [44.0, 11.0], [50.0, 11.0]]
CURB = [[4.0, 34.0], [60.0, 34.0]]
CROSSWALK = [[2.0, 2.0], [12.0, 2.0]]
STOP_LINE = [[2.0, 6.0], [12.0, 6.0]]


def drivable_truth(alternative: int = 255) -> NDArray[np.uint8]:
    mask = np.zeros(SIZE, np.uint8)
    mask[20:30, 10:30] = 255
    for row in range(16, 32):
        for column in range(40, 56):
            # The triangle is right of the diagonal x - 40 = y - 16, at pixel centres.
            if column + 0.5 - 40 >= row + 0.5 - 16:
                mask[row, column] = alternative
    return mask


def disc_line(mask: NDArray[np.uint8], start: tuple[float, float], end: tuple[float, float], radius: float) -> None:
    """The slow, obvious rule: a pixel belongs to a line when its centre is at most ``radius`` from it."""
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            x, y = column + 0.5, row + 0.5
            dx, dy = end[0] - start[0], end[1] - start[1]
            run = ((x - start[0]) * dx + (y - start[1]) * dy) / (dx * dx + dy * dy)
            run = min(max(run, 0.0), 1.0)
            if (x - start[0] - run * dx) ** 2 + (y - start[1] - run * dy) ** 2 <= radius**2 + 1e-9:
                mask[row, column] = 255


def lane_truth(*, crosswalk: bool = False, vertical: bool = False, radius: float = WIDTH / 2) -> NDArray[np.uint8]:
    mask = np.zeros(SIZE, np.uint8)
    disc_line(mask, (20, 4), (20, 16), radius)
    disc_line(mask, (34, 10), (50, 10), radius)
    disc_line(mask, (4, 34), (60, 34), radius)
    if crosswalk:
        disc_line(mask, (2, 2), (12, 2), radius)
    if vertical:
        disc_line(mask, (2, 6), (12, 6), radius)
    return mask


def boxes(categories: tuple[str, ...]) -> list[tuple[str, dict[str, float]]]:
    """One box of each category; the car reaches out of the image on the right."""
    items = [("car", {"x1": 50.0, "y1": 20.0, "x2": 70.0, "y2": 30.0})]
    for index, category in enumerate(categories[1:]):
        items.append((category, {"x1": 1.0 + 5 * index, "y1": 3.0, "x2": 4.0 + 5 * index, "y2": 8.5}))
    items.append(("car", {"x1": 80.0, "y1": 3.0, "x2": 90.0, "y2": 8.0}))  # outside
    return items


def old_poly(points: list[list[float]], types: str) -> list[list[Any]]:
    return [[*point, letter] for point, letter in zip(points, types, strict=True)]


def new_poly(points: list[list[float]], types: str, *, closed: bool) -> list[dict[str, Any]]:
    return [{"vertices": points, "types": types, "closed": closed}]


LANES = (
    ("single white", "dashed", "parallel", EDGE_ONE, "LL"),
    ("single white", "solid", "parallel", BEZIER_ONE, "LCCC"),
    ("single white", "dashed", "parallel", EDGE_TWO, "LL"),
    ("single white", "solid", "parallel", BEZIER_TWO, "CCCL"),
    ("road curb", "solid", "parallel", CURB, "LL"),
    ("crosswalk", "solid", "vertical", CROSSWALK, "LL"),
    ("single white", "solid", "vertical", STOP_LINE, "LL"),
)


def write_images(root: Path, *, prefix: str = "images/100k") -> None:
    for split, names in (("train", ("a1", "a2")), ("val", ("b1",))):
        folder = root / prefix / split
        folder.mkdir(parents=True)
        for index, name in enumerate(names):
            image = np.full((*SIZE, 3), 60 * (index + 1), np.uint8)
            cv2.imwrite(str(folder / f"{name}.jpg"), image)


def write_2018_documents(root: Path) -> None:
    """One JSON an image; ``a2`` has none."""
    objects: list[dict[str, Any]] = [
        {"category": category, "id": i, "attributes": {"occluded": False, "truncated": False}, "box2d": box}
        for i, (category, box) in enumerate(boxes(CATEGORIES_OLD))
    ]
    objects.append({"category": "area/alternative", "attributes": {}, "poly2d": old_poly(ALTERNATIVE, "LLL")})
    objects.append({"category": "area/drivable", "attributes": {}, "poly2d": old_poly(DIRECT, "LLLL")})
    for category, style, direction, points, types in LANES:
        objects.append(
            {
                "category": f"lane/{category}",
                "attributes": {"direction": direction, "style": style},
                "poly2d": old_poly(points, types),
            }
        )
    for split, name, items in (("train", "a1", objects), ("val", "b1", [])):
        folder = root / "labels/100k" / split
        folder.mkdir(parents=True)
        content = {"name": name, "frames": [{"timestamp": 10000, "objects": items}], "attributes": ATTRIBUTES}
        (folder / f"{name}.json").write_text(json.dumps(content))


def _scalabel_boxes(categories: tuple[str, ...]) -> list[dict[str, Any]]:
    return [
        {"id": str(i), "category": category, "attributes": {"occluded": False}, "box2d": box}
        for i, (category, box) in enumerate(boxes(categories))
    ]


def _scalabel_lanes(category: str | None) -> list[dict[str, Any]]:
    type_key = "laneTypes" if category is None else "laneType"
    return [
        {
            "id": str(i),
            "category": category or lane,
            "attributes": {"laneDirection": direction, "laneStyle": style, type_key: lane},
            "poly2d": new_poly(points, types, closed=False),
        }
        for i, (lane, style, direction, points, types) in enumerate(LANES)
    ]  # fmt: skip


def write_2018_merged(root: Path) -> None:
    """One Scalabel file a split with everything, as the second download of 2018 had it."""
    labels = _scalabel_boxes(CATEGORIES_OLD)
    labels += [
        {"category": "drivable area", "attributes": {"areaType": kind}, "poly2d": new_poly(points, types, closed=True)}
        for kind, points, types in (("alternative", ALTERNATIVE, "LLL"), ("direct", DIRECT, "LLLL"))
    ]
    labels += _scalabel_lanes("lane")
    folder = root / "labels"
    folder.mkdir(parents=True)
    entry = {"name": "a1.jpg", "attributes": ATTRIBUTES, "timestamp": 10000, "labels": labels}
    (folder / "bdd100k_labels_images_train.json").write_text(json.dumps([entry], indent=2))
    empty = {"name": "b1.jpg", "attributes": ATTRIBUTES, "timestamp": 10000, "labels": labels[:1]}
    (folder / "bdd100k_labels_images_val.json").write_text(json.dumps([empty]))


def write_2020(root: Path, *, polygons: bool = True, masks: str = "") -> None:
    """One Scalabel file a task and split; ``det`` has ``a1`` alone, ``lane`` calls ``a2`` empty."""

    def entry(name: str, labels: list[dict[str, Any]] | None) -> dict[str, Any]:
        whole: dict[str, Any] = {"name": f"{name}.jpg", "attributes": ATTRIBUTES, "timestamp": 10000}
        return whole if labels is None else {**whole, "labels": labels}

    areas = [
        {"id": "0", "category": kind, "attributes": {}, "poly2d": new_poly(points, types, closed=True)}
        for kind, points, types in (("alternative", ALTERNATIVE, "LLL"), ("direct", DIRECT, "LLLL"))
    ]
    content: dict[str, Any] = {"labels/det_20/det": [entry("a1", _scalabel_boxes(CATEGORIES_NEW))]}
    if polygons:
        content["labels/drivable/polygons/drivable"] = {"frames": [entry("a1", areas)], "config": {}}
        content["labels/lane/polygons/lane"] = [entry("a1", _scalabel_lanes(None)), entry("a2", None)]
    for stem, whole in content.items():
        for split in ("train", "val"):
            path = root / f"{stem}_{split}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(whole if split == "train" else []))
    if masks:
        write_masks(root, masks)


def write_masks(root: Path, kind: str) -> None:
    """Drivable masks of ``a1`` as IDs or colours of either generation."""
    truth = drivable_truth(alternative=127)
    ids = {"ids 2018": (0, 1, 2), "ids 2020": (2, 0, 1)}
    colours = {
        "colours 2018": ((0, 0, 0), (217, 83, 79), (91, 192, 222)),
        "colours 2020": ((0, 0, 0), (219, 94, 86), (86, 211, 219)),
    }
    paths = {
        "ids 2018": "drivable_maps/labels/train/a1_drivable_id.png",
        "ids 2020": "labels/drivable/masks/train/a1.png",
        "colours 2018": "drivable_maps/color_labels/train/a1_drivable_color.png",
        "colours 2020": "labels/drivable/colormaps/train/a1.png",
    }
    path = root / paths[kind]
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind in ids:
        background, direct, alternative = ids[kind]
        picture: NDArray[np.uint8] = np.full(SIZE, background, np.uint8)
        picture[truth == 255] = direct
        picture[truth == 127] = alternative
    else:
        picture = np.zeros((*SIZE, 3), np.uint8)
        picture[truth == 255] = colours[kind][1][::-1]
        picture[truth == 127] = colours[kind][2][::-1]
    cv2.imwrite(str(path), picture)
