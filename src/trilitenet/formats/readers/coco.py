"""COCO's annotation file: boxes, polygons and run-length masks in one JSON a split.

Format: https://cocodataset.org/#format-data. Found are ``annotations/*_{split}*.json`` (COCO itself),
``{split}/_annotations.coco.json`` (Roboflow) and single files, whose images belong to one split. Where a split has
``instances_*`` files, others of it are left out, and so are files without categories (captions).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilitenet.data.reading import check_root, parse_attributes
from trilitenet.data.records import (
    AreaLabel,
    BrokenRecord,
    CocoRuns,
    ImageRecord,
    LaneLabel,
    ListedRecords,
    ObjectLabel,
    named_apart,
)
from trilitenet.errors import DataError, brief, few
from trilitenet.formats.readers.mapping import SPLIT_NAMES, LabelMapping, Labels, find_image, read_json, visible

__all__ = ["read_coco"]


def read_coco(root: str | Path, mapping: LabelMapping | None = None) -> ListedRecords:
    """Read a data set with COCO annotations.

    Args:
        root: The data set's folder, or one annotation file.
        mapping: What the categories mean.

    Raises:
        DataError: If there is no annotation file, or a broken one, or one whose annotations are of no image in it; if
            one picture would be that of two images; or if the categories mean nothing.
    """
    mapping = mapping or LabelMapping()
    root = Path(root)
    records: dict[str, list[ImageRecord]] = defaultdict(list)
    found = []
    categories: set[str] = set()
    taken: dict[Path, str] = {}
    folders = [root if root.is_dir() else root.parent]
    if root.is_file() and folders[0].resolve().name == "annotations":
        folders.append(folders[0].resolve().parent)
    chosen, unused = _annotation_files(root, mapping.split)
    for path, split, content in chosen:
        items, missing, stray = _read_file(content, path, split, folders, mapping, categories, taken)
        records[split] += items
        found.append(f"{split}: {len(items)} images of {path.name}; {missing} more are not there")
        if stray:
            found.append(f"{split}: {stray} annotations of {path.name} left out: their image_id is no image's id")
    if not any(records.values()):
        raise DataError(f"{root}: none of the images of its annotation files is there")
    mapping.check_categories(categories, root)
    found += mapping.tell_empty(records)
    if unused:
        found.append(f"not used: {few([path.name for path in unused], most=10)}")
    splits = {split: named_apart(items) for split, items in records.items() if items}
    return ListedRecords(splits, tuple(found), mapping.origin("coco", root))


def _annotation_files(root: Path, default: str) -> tuple[list[tuple[Path, str, Any]], list[Path]]:
    """Return (file, split, content) of the files to read, and the files that are left out for them."""
    if root.is_file():
        return [(root, default, read_json(root))], []
    check_root(root)
    files = visible({*root.glob("*.json"), *root.glob("annotations/*.json"), *root.glob("*/_annotations.coco.json")})
    chosen: list[tuple[Path, str, Any]] = []
    for whole in (True, False):  # COCO's own captions and key points are of the images of instances_*.json
        taken = {split for _, split, _ in chosen}
        for path in files:
            split = _split_of(path, default)
            if path.name.startswith("instances_") != whole or split in taken:
                continue
            content = read_json(path)
            if _is_coco(content):
                chosen.append((path, split, content))
    if not chosen:
        raise DataError(
            f"{root}: no COCO annotations; looked for *.json, annotations/*.json and */_annotations.coco.json with "
            "the keys 'images' and 'annotations', and a 'category_id' in these"
        )
    read = {path for path, _, _ in chosen}
    return chosen, [path for path in files if path not in read]


def _is_coco(content: Any) -> bool:
    if not isinstance(content, dict) or not {"images", "annotations"} <= set(content):
        return False
    items = content["annotations"]
    if not isinstance(items, list):
        return not items
    return not items or any(isinstance(item, dict) and "category_id" in item for item in items)


def _split_of(path: Path, default: str) -> str:
    stem = path.parent.name if path.name == "_annotations.coco.json" else path.stem
    words = re.split(r"[^a-z]+", stem.lower())
    return next((SPLIT_NAMES[word] for word in reversed(words) if word in SPLIT_NAMES), default)


def _read_file(
    content: Any,
    path: Path,
    split: str,
    roots: list[Path],
    mapping: LabelMapping,
    categories: set[str],
    taken: dict[Path, str],
) -> tuple[list[ImageRecord], int, int]:
    """Return the images, how many more are not there, and how many annotations are of no image that is listed.

    What its categories are called is added to ``categories``, and its images' files and names to ``taken``.
    """
    try:
        names = {item["id"]: str(item["name"]) for item in content.get("categories", ())}
        labels: dict[Any, list[dict[str, Any]]] = defaultdict(list)
        for item in content["annotations"]:
            labels[item["image_id"]].append(item)
        known = {image["id"] for image in content["images"]}
        stray = labels.keys() - known
        strays = sum(len(labels[number]) for number in stray)
        if content["images"] and stray and stray == labels.keys():
            raise DataError(
                f"{path}: no annotation has the id of an image (image_id {min(map(repr, stray))}, but images "
                f"{content['images'][0]['id']!r}, ...); {_cure(stray, known, 'they are of other images')}"
            )
        told = {item.get("category_id") for item in content["annotations"]}
        if names and told and told.isdisjoint(names):
            raise DataError(
                f"{path}: no annotation has the id of a category (category_id {min(map(repr, told))}, but categories "
                f"{few([repr(name) for name in names])}); {_cure(told, names, 'number both alike')}"
            )
        tasks = mapping.labelled(set(names.values()))
        categories.update(names.values())
        folders = [path.parent]
        for root in roots:
            folders += [root, root / "images"]
            folders.append(root / "images" / path.stem.removeprefix("instances_"))  # of CVAT's and Datumaro's subsets
            for word in dict.fromkeys([_split_of(path, split), split]):  # a single file's name may say where to look
                folders += [root / word, root / "images" / word]
                folders += [folder for folder in sorted(root.glob(f"*{word}*")) if folder.is_dir()]
        records: list[ImageRecord] = []
        missing = 0
        for image in content["images"]:
            place = find_image(str(image["file_name"]), folders, taken)
            if place is None:
                missing += 1
                continue
            size = (int(image["height"]), int(image["width"]))
            try:
                own = _read_labels(labels[image["id"]], names, mapping)
            except DataError as error:
                reason = f"{path}: image {image['file_name']!r}, {error}"
                records.append(BrokenRecord(place.stem, place, reason=reason))
                continue
            own.attributes = parse_attributes(image)
            records.append(own.record(place.stem, place, mapping.labelled_in(own, tasks), size))
    except DataError:
        raise
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise DataError(f"{path}: not as COCO has it ({brief(error)})") from error
    return records, missing, strays


def _cure(given: Iterable[Any], known: Iterable[Any], otherwise: str) -> str:
    """Return what to do about ids of which none is known."""
    alike = not set(map(str, given)).isdisjoint(map(str, known))
    return "write both alike, as numbers or as text" if alike else otherwise


def _read_labels(items: list[dict[str, Any]], names: dict[Any, str], mapping: LabelMapping) -> Labels:
    labels = Labels()
    for item in items:
        try:
            _read_label(item, names, mapping, labels)
        except DataError as error:
            raise DataError(f"annotation {item.get('id', '')!r}: {error}") from error
    return labels


def _read_label(item: dict[str, Any], names: dict[Any, str], mapping: LabelMapping, labels: Labels) -> None:
    number = item.get("category_id")
    if not isinstance(number, (int, float, str)):
        raise DataError("category_id must be the id of a category")
    category = names.get(number, str(number))
    kind = mapping.area_kind(category)
    segmentation = item.get("segmentation")
    if category not in mapping.lane and kind in {None, "ignore"}:
        crowd = bool(item.get("iscrowd")) or kind == "ignore"
        labels.objects.append(ObjectLabel(category, _box(item.get("bbox")), crowd))
        if kind is None or not segmentation:
            return
    if not segmentation:
        labels.dropped[f"{category}: without a segmentation"] += 1
    elif isinstance(segmentation, dict):
        runs = _runs(segmentation, kind or "direct")
        (labels.lanes if category in mapping.lane else labels.areas).append(runs)
    elif isinstance(segmentation, list):
        for points in map(_points, segmentation):
            if category in mapping.lane:
                labels.lanes.append(LaneLabel(category, points, closed=True))
            else:
                labels.areas.append(AreaLabel(kind or "direct", points))
    else:
        raise DataError("segmentation must be a list of polygons, or run lengths")


def _box(bbox: Any) -> tuple[float, float, float, float]:
    try:
        left, top, width, height = map(float, bbox)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError("bbox must be 4 numbers (left, top, width, height)") from error
    return left, top, left + width, top + height


def _runs(segmentation: dict[str, Any], kind: str) -> CocoRuns:
    try:
        height, width = map(int, segmentation["size"])
        counts = segmentation["counts"]
        return CocoRuns(kind, (height, width), counts if isinstance(counts, str) else tuple(map(int, counts)))
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise DataError("run lengths need a size (height, width) and counts") from error


def _points(polygon: Any) -> NDArray[np.float64]:
    try:
        return np.array(polygon, np.float64).reshape(-1, 2)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError("a polygon must be an even number of coordinates (x, y, x, y, ...)") from error
