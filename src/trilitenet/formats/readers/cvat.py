"""CVAT's XML of the kind *CVAT for images 1.1*: boxes, polygons, polylines and masks.

Format: https://docs.cvat.ai/docs/dataset_management/formats/format-cvat/. An image's ``subset`` is its split; the
attributes of an image's tags become the image's.
"""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from trilitenet.data.reading import check_root
from trilitenet.data.records import (
    AreaLabel,
    BrokenRecord,
    ImageRecord,
    LaneLabel,
    ListedRecords,
    ObjectLabel,
    RowRuns,
    named_apart,
)
from trilitenet.errors import DataError, brief
from trilitenet.formats.readers.mapping import SPLIT_NAMES, LabelMapping, Labels, find_image, hull, visible

__all__ = ["read_cvat"]

_NEEDED: Final = {
    "box": "xtl, ytl, xbr, ybr and rotation must be numbers",
    "polygon": "points must be numbers 'x,y;x,y;...'",
    "polyline": "points must be numbers 'x,y;x,y;...'",
    "mask": "left, top, width, height and rle must be whole numbers",
}
_NO_SUBSET: Final = "default"
"""The subset that an export of a project gives the tasks that have none."""
_SHAPES = {"box", "polygon", "polyline", "mask", "points", "ellipse", "cuboid", "skeleton", "tag"}


class _OfVideoError(DataError):
    """A file of the kind *CVAT for video*, whose frames are no pictures that could be read."""


def read_cvat(root: str | Path, mapping: LabelMapping | None = None) -> ListedRecords:
    """Read a data set exported from CVAT. Files of videos are left out where there are files of images.

    Args:
        root: The folder with ``annotations.xml`` (or any ``.xml`` of this kind) and the images, or the file.
        mapping: What the labels mean.

    Raises:
        DataError: If there is no such file, a broken one, or one of videos; if one picture would be that of two
            images; or if the labels mean nothing.
    """
    mapping = mapping or LabelMapping()
    root = Path(root)
    files = [root] if root.is_file() else visible(root.glob("*.xml"))
    if not files:
        check_root(root)
        raise DataError(f"{root}: no .xml file; export the task from CVAT as 'CVAT for images 1.1'")
    folder = root.parent if root.is_file() else root
    records: dict[str, list[ImageRecord]] = defaultdict(list)
    categories: set[str] = set()
    taken: dict[Path, str] = {}
    missing = videos = 0
    for path in files:
        try:
            missing += _read_file(path, folder, mapping, records, categories, taken)
        except _OfVideoError:
            videos += 1
            if videos == len(files):
                raise
    if not any(records.values()):
        raise DataError(f"{root}: none of the images that the .xml lists is there; put them beside it or in images/")
    mapping.check_categories(categories, root)
    found = [f"{split}: {len(items)} images" for split, items in records.items()]
    found += mapping.tell_empty(records)
    if missing:
        found.append(f"{missing} listed images are not there")
    if videos:
        found.append(f"files of the kind 'CVAT for video', left out: {videos}")
    splits = {split: named_apart(items) for split, items in records.items()}
    return ListedRecords(splits, tuple(found), mapping.origin("cvat", root))


def _read_file(
    path: Path,
    folder: Path,
    mapping: LabelMapping,
    records: dict[str, list[ImageRecord]],
    every: set[str],
    taken: dict[Path, str],
) -> int:
    """Return how many images are not there.

    The others are added to ``records``, their files and names to ``taken``, and the labels' names to ``every``.
    """
    categories: set[str] = set()
    images: list[ElementTree.Element] = []
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag == "label" and element.find("name") is not None:
                categories.add(element.findtext("name") or "")
            elif element.tag == "track":
                raise _OfVideoError(f"{path}: is of the kind 'CVAT for video'; export it as 'CVAT for images 1.1'")
            elif element.tag == "image":
                images.append(element)
                categories |= {shape.get("label", "") for shape in element}
    except DataError:
        raise
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two of its encoding
        raise DataError(f"{path}: not XML ({error})") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    every |= categories
    tasks = mapping.labelled(categories)
    missing = 0
    for element in images:
        name = element.get("name", "")
        subset = element.get("subset") or ""
        own = "" if subset.lower() == _NO_SUBSET else subset.lower()
        split = SPLIT_NAMES.get(own, own or mapping.split)
        tops = [folder, folder / "images"]
        folders = [*tops, *(top / part for part in (split, subset) for top in tops), folder / "data"]
        place = find_image(name, folders, taken)
        if place is None:
            missing += 1
            continue
        try:
            labels = _read_image(element, mapping)
            size = (int(element.get("height") or 0), int(element.get("width") or 0))
        except (KeyError, ValueError) as error:
            what = str(error) if isinstance(error, DataError) else f"not as CVAT has it ({brief(error)})"
            records[split].append(BrokenRecord(place.stem, place, reason=f"{path}: image {name!r}, {what}"))
            continue
        records[split].append(labels.record(place.stem, place, mapping.labelled_in(labels, tasks), size))
    return missing


def _read_image(element: ElementTree.Element, mapping: LabelMapping) -> Labels:
    labels = Labels()
    for shape in sorted(element, key=lambda item: int(item.get("z_order") or 0)):
        try:
            _read_shape(shape, mapping, labels)
        except (KeyError, ValueError) as error:
            raise DataError(f"{shape.tag} of label {shape.get('label', '')!r}: {_NEEDED[shape.tag]}") from error
    return labels


def _read_shape(shape: ElementTree.Element, mapping: LabelMapping, labels: Labels) -> None:
    label = shape.get("label", "")
    own = {item.get("name", ""): item.text or "" for item in shape.findall("attribute")}
    kind = mapping.area_kind(label)
    if shape.tag == "tag":
        labels.attributes |= own
    elif shape.tag == "box":
        # Text, of which "false" would be true.
        crowd = own.pop("crowd", "").strip().lower() == "true"
        more: dict[str, str | bool | float] = {**own, "crowd": crowd, "occluded": shape.get("occluded") == "1"}
        labels.objects.append(ObjectLabel(label, _box(shape), crowd, more))
    elif shape.tag in {"polygon", "polyline"}:
        points = _points(shape.attrib["points"])
        closed = shape.tag == "polygon"
        if label in mapping.lane:
            labels.lanes.append(LaneLabel(label, points, closed=closed, edge=mapping.lane_edges and not closed))
        elif closed:
            labels.add(AreaLabel(kind or "direct", points), ObjectLabel(label, hull(points)), kind)
        else:
            labels.objects.append(ObjectLabel(label, hull(points), crowd=kind == "ignore"))
    elif shape.tag == "mask":
        left, top, width, height = (int(shape.attrib[key]) for key in ("left", "top", "width", "height"))
        lengths = tuple(int(run) for run in shape.attrib["rle"].split(","))
        runs = RowRuns(kind or "direct", left, top, width, height, lengths)
        if label in mapping.lane:
            labels.lanes.append(runs)
        else:
            corners = (float(left), float(top), float(left + width), float(top + height))
            labels.add(runs, ObjectLabel(label, corners), kind)
    elif shape.tag in _SHAPES:
        labels.dropped[f"shape of kind {shape.tag!r}"] += 1


def _box(shape: ElementTree.Element) -> tuple[float, float, float, float]:
    """Return a box; of a turned one, the upright box around it."""
    x1, y1, x2, y2 = (float(shape.attrib[key]) for key in ("xtl", "ytl", "xbr", "ybr"))
    angle = math.radians(float(shape.get("rotation") or 0))
    if not angle:
        return x1, y1, x2, y2
    cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
    width, height = (x2 - x1) * cos + (y2 - y1) * sin, (x2 - x1) * sin + (y2 - y1) * cos
    x, y = (x1 + x2) / 2, (y1 + y2) / 2
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _points(text: str) -> NDArray[np.float64]:
    pairs = (pair.split(",") for pair in text.split(";"))
    return np.array([(float(x), float(y)) for x, y in pairs], np.float64)
