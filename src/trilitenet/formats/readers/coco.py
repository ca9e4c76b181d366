"""COCO's annotation file: boxes, polygons and run-length masks in one JSON a split.

Format: https://cocodataset.org/#format-data. Found are ``annotations/*_{split}*.json`` (COCO itself),
``{split}/_annotations.coco.json`` (Roboflow) and single files, whose images belong to one split.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from trilitenet.data.records import AreaLabel, CocoRuns, ImageRecord, LaneLabel, ListedRecords, ObjectLabel
from trilitenet.errors import DataError, brief
from trilitenet.formats.readers.mapping import LabelMapping, Shapes, find_image, read_json

__all__ = ["read_coco"]

_SPLIT_NAMES = {"train": "train", "val": "val", "valid": "val", "validation": "val", "test": "test"}


def read_coco(root: str | Path, mapping: LabelMapping | None = None) -> ListedRecords:
    """Read a data set with COCO annotations.

    Args:
        root: The data set's folder, or one annotation file.
        mapping: What the categories mean.

    Raises:
        DataError: If there is no annotation file, or a broken one.
    """
    mapping = mapping or LabelMapping()
    root = Path(root)
    records: dict[str, list[ImageRecord]] = defaultdict(list)
    found = []
    for path, split in _annotation_files(root, mapping.split):
        items, missing = _read_file(path, split, root if root.is_dir() else root.parent, mapping)
        records[split] += items
        found.append(f"{split}: {len(items)} images of {path.name}; {missing} more are not there")
    if not any(records.values()):
        raise DataError(f"{root}: none of the images of its annotation files is there")
    return ListedRecords(records, tuple(found))


def _annotation_files(root: Path, default: str) -> list[tuple[Path, str]]:
    if root.is_file():
        return [(root, default)]
    files = sorted({*root.glob("*.json"), *root.glob("annotations/*.json"), *root.glob("*/_annotations.coco.json")})
    chosen = [(path, _split_of(path, default)) for path in files if _is_coco(path)]
    if not chosen:
        raise DataError(
            f"{root}: no COCO annotations; looked for *.json, annotations/*.json and */_annotations.coco.json with "
            "the keys 'images' and 'annotations'"
        )
    return chosen


def _is_coco(path: Path) -> bool:
    content = read_json(path)
    return isinstance(content, dict) and {"images", "annotations"} <= set(content)


def _split_of(path: Path, default: str) -> str:
    words = [*re.split(r"[^a-z]+", path.stem.lower()), path.parent.name.lower()]
    return next((_SPLIT_NAMES[word] for word in reversed(words) if word in _SPLIT_NAMES), default)


def _read_file(path: Path, split: str, root: Path, mapping: LabelMapping) -> tuple[list[ImageRecord], int]:
    content = read_json(path)
    try:
        names = {item["id"]: str(item["name"]) for item in content.get("categories", ())}
        labels: dict[Any, list[dict[str, Any]]] = defaultdict(list)
        for item in content["annotations"]:
            labels[item["image_id"]].append(item)
        tasks = mapping.labelled(set(names.values()))
        folders = [path.parent, root, root / "images", root / split, root / "images" / split]
        folders += [folder for folder in sorted(root.glob(f"*{split}*")) if folder.is_dir()]
        records, missing = [], 0
        for image in content["images"]:
            place = find_image(str(image["file_name"]), folders)
            if place is None:
                missing += 1
                continue
            size = (int(image["height"]), int(image["width"]))
            objects, shapes, dropped = _read_labels(labels[image["id"]], names, size, mapping)
            records.append(
                ImageRecord(
                    name=place.stem,
                    image=place,
                    objects=tuple(objects) if "detection" in tasks else None,
                    drivable=tuple(shapes.areas) if "drivable" in tasks else None,
                    lane=tuple(shapes.lanes) if "lane" in tasks else None,
                    attributes={str(key): str(value) for key, value in (image.get("attributes") or {}).items()},
                    dropped=dict(dropped),
                )
            )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{path}: not as COCO has it ({brief(error)})") from error
    return records, missing


def _read_labels(
    items: list[dict[str, Any]], names: dict[Any, str], size: tuple[int, int], mapping: LabelMapping
) -> tuple[list[ObjectLabel], Shapes, Counter[str]]:
    objects: list[ObjectLabel] = []
    shapes = Shapes()
    dropped: Counter[str] = Counter()
    for item in items:
        category = names.get(item["category_id"], str(item["category_id"]))
        kind = mapping.area_kind(category)
        if category not in mapping.lane and (kind is None or (kind == "ignore" and not item.get("segmentation"))):
            left, top, width, height = (float(value) for value in item["bbox"])
            crowd = bool(item.get("iscrowd"))
            objects.append(ObjectLabel(category, (left, top, left + width, top + height), crowd))
            continue
        segmentation = item.get("segmentation")
        if not segmentation:
            dropped[f"{category}: without a segmentation"] += 1
        elif isinstance(segmentation, dict):
            counts = segmentation["counts"]
            runs = CocoRuns(
                kind or "direct",
                (int(segmentation["size"][0]), int(segmentation["size"][1])),
                counts if isinstance(counts, str) else tuple(int(count) for count in counts),
            )
            (shapes.lanes if category in mapping.lane else shapes.areas).append(runs)
        else:
            for polygon in segmentation:
                points = np.array(polygon, np.float64).reshape(-1, 2)
                if category in mapping.lane:
                    shapes.lanes.append(LaneLabel(category, points, closed=True))
                else:
                    shapes.areas.append(AreaLabel(kind or "direct", points))
    return objects, shapes, dropped
