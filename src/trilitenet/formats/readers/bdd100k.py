"""BDD100K as it is downloaded, in both generations of its labels.

1. 2018: one JSON an image (``labels/100k/{split}/NAME.json``: ``frames[0].objects``, categories ``car``,
   ``area/drivable``, ``lane/single white``), or one a split with the same content in Scalabel form
   (``bdd100k_labels_images_{split}.json``: ``labels``, categories ``drivable area`` and ``lane`` with ``areaType`` and
   ``laneType``), and masks as ``drivable_maps/labels/{split}/NAME_drivable_id.png`` or
   ``drivable_maps/color_labels/{split}/NAME_drivable_color.png``.
2. 2020: one Scalabel file a task and split (``det_20/det_{split}.json``, ``drivable/polygons/drivable_{split}.json``,
   ``lane/polygons/lane_{split}.json``), and masks as ``drivable/masks/{split}/NAME.png``,
   ``drivable/colormaps/{split}/NAME.png`` and ``lane/masks/{split}/NAME.png``.

The folders are found wherever they are below the given one, and so are images in folders of their own below that of a
split (``images/100k/train/trainA``, as some copies have them). Files of a whole split run to more than a gigabyte, so
they are indexed once and each image's part is read when it is wanted.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from trilitenet.config import TASKS, Task, parse_json
from trilitenet.data.rasterise import flatten
from trilitenet.data.reading import IMAGE_ENDINGS, check_root, is_crowd, parse_attributes
from trilitenet.data.records import AreaLabel, ImageRecord, LaneLabel, MaskFile, ObjectLabel, same_name
from trilitenet.errors import DataError, brief, few
from trilitenet.formats.readers.mapping import Labels, visible

__all__ = ["BDD100K_SPLITS", "BddSource", "parse_labels", "read_bdd100k"]

BDD100K_SPLITS: Final = ("train", "val", "test")

DRIVABLE_IDS_2018: Final = {0: "background", 1: "direct", 2: "alternative"}
DRIVABLE_IDS_2020: Final = {0: "direct", 1: "alternative", 2: "background"}
DRIVABLE_COLOURS: Final[dict[int | tuple[int, int, int], str]] = {
    (217, 83, 79): "direct",
    (91, 192, 222): "alternative",
    (219, 94, 86): "direct",
    (86, 211, 219): "alternative",
}
"""Colours of both generations, as (red, green, blue)."""

_LANE_CATEGORIES: Final = (
    "crosswalk",
    "double other",
    "double white",
    "double yellow",
    "road curb",
    "single other",
    "single white",
    "single yellow",
)
"""In the order of the lowest three bits of a 2020 lane mask; bit 3 is background, bit 4 dashed, bit 5 vertical."""

_AREA_KINDS: Final = {
    "area/drivable": "direct",
    "area/direct": "direct",
    "area/alternative": "alternative",
    "direct": "direct",
    "alternative": "alternative",
}
_DOCUMENTS_LOOKED_AT: Final = 300
_CHUNK = 1 << 24
_LABELS: Final = re.compile(r"labels?(?![a-z])")
"""In the path of a folder of labels, whose pictures are no images; a folder of ``labelled`` ones is none."""
_SKIPPED_AREAS: Final = {"area/unknown", "unknown", "background", "area/background"}


@dataclasses.dataclass(frozen=True)
class _Part:
    """Where an image's entry is in a file of a whole split."""

    path: Path
    start: int
    length: int


@dataclasses.dataclass(frozen=True)
class _Split:
    """What was found for one split."""

    images: dict[str, Path]
    parts: dict[str, tuple[_Part, ...]]
    documents: Path | None
    drivable_masks: tuple[Path, str, dict[int | tuple[int, int, int], str]] | None
    lane_masks: Path | None
    tasks: dict[Path, frozenset[Task]]


class BddSource:
    """BDD100K as a `RecordSource`; made by `read_bdd100k`.

    Attributes:
        found: One line for each thing that was found, for the user.
    """

    def __init__(
        self, root: Path, splits: Mapping[str, _Split], found: tuple[str, ...], *, crosswalk: bool, vertical: bool
    ) -> None:
        self._splits = dict(splits)
        self._crosswalk = crosswalk
        self._vertical = vertical
        self.found = found
        self.origin = {"kind": "bdd100k", "path": str(root.resolve())}

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits that have images."""
        return tuple(self._splits)

    def names(self, split: str) -> list[str]:
        """Return the names of a split's images, sorted."""
        return sorted(self._splits[split].images)

    def record(self, split: str, name: str) -> ImageRecord:
        """Read one image's labels.

        Raises:
            DataError: If they are broken.
        """
        files = self._splits[split]
        twice = [path for path, count in Counter(part.path for part in files.parts.get(name, ())).items() if count > 1]
        if twice:
            raise DataError(
                f"{twice[0]}: has several entries called {name!r}; give one of them, and its image, another name"
            )
        merged = ImageRecord(name, files.images[name])
        for content, path in _entries(files, name):
            if path.parent == files.documents:  # only the first few of these were looked at
                tasks = files.tasks[path.parent] | _tasks_in(content)
            else:
                tasks = files.tasks[path]
            merged = _merge(merged, parse_labels(content, merged.image, str(path), tasks))
        if merged.drivable is None and files.drivable_masks is not None:
            folder, suffix, values = files.drivable_masks
            mask = folder / f"{name}{suffix}.png"
            if mask.is_file():
                merged = dataclasses.replace(merged, drivable=MaskFile(mask, values))
        if merged.lane is None and files.lane_masks is not None:
            mask = files.lane_masks / f"{name}.png"
            if mask.is_file():
                values = _lane_values(crosswalk=self._crosswalk, vertical=self._vertical)
                merged = dataclasses.replace(merged, lane=MaskFile(mask, values))
        return merged


def read_bdd100k(raw: str | Path, *, crosswalk: bool = False, vertical: bool = False) -> BddSource:
    """Find BDD100K's images and labels below a folder.

    Args:
        raw: The folder, at any level: what is found in it decides.
        crosswalk: Keep crosswalks when lanes come from masks (with polygons, the conversion decides).
        vertical: Likewise for markings across the road (stop lines).

    Raises:
        DataError: If there are no images; the message says what was looked for.
    """
    root = Path(raw)
    check_root(root)
    folders, files = _survey(root)
    splits: dict[str, _Split] = {}
    found: list[str] = []
    read: set[Path] = set()
    for split in BDD100K_SPLITS:
        images = _images(folders, split)
        if not images:
            continue
        documents = _first(folders, rf"labels/100k/{split}", rf"labels/{split}", rf"100k/{split}", ending=".json")
        merged, passed_over = _merged_files(files, split)
        parts: dict[str, list[_Part]] = {}
        tasks: dict[Path, frozenset[Task]] = {}
        for path in merged:
            seen: set[Task] = set()
            for name, part, entry in _index(path):
                parts.setdefault(name, []).append(part)
                seen |= _tasks_in(entry)
            tasks[path] = _tasks_of(path) or frozenset(seen)
        if documents is not None:
            tasks[documents] = _tasks_of_documents(documents)
        drivable = _drivable_masks(folders, split)
        lane = _first(folders, rf"lane/masks/{split}", ending=".png")
        splits[split] = _Split(
            images, {name: tuple(items) for name, items in parts.items()}, documents, drivable, lane, tasks
        )
        read |= tasks.keys()
        sources = [f"{path.relative_to(root)} ({', '.join(sorted(tasks[path])) or 'nothing'})" for path in tasks]
        sources += [f"{path.relative_to(root)} (masks)" for path in (drivable and drivable[0], lane) if path]
        found.append(f"{split}: {len(images)} images; labels from {', '.join(sources) or 'nowhere'}")
        found += _unmatched(split, splits[split])
        for path, unread in passed_over.items():
            rest = few([str(other.relative_to(root)) for other in unread])
            found.append(f"{split}: of several files of one kind, {path.relative_to(root)} is read, not {rest}")
    if not splits:
        raise DataError(
            f"{root}: no BDD100K images; looked for folders images/100k/{{train,val,test}} (or images/train, ...) with "
            ".jpg files at any depth"
        )
    others = [str(path.relative_to(root)) for path in sorted(files) if not read & {path, path.parent}]
    if others:
        why = "another of that name is, no label file has it, or its split no images"
        found.append(f"not read ({why}): {few(others)}")
    return BddSource(root, splits, tuple(found), crosswalk=crosswalk, vertical=vertical)


def parse_labels(content: Any, image: Path, source: str, tasks: Collection[Task] = TASKS) -> ImageRecord:
    """Read one image's entry, of either generation.

    Args:
        content: The parsed JSON.
        image: The image's file.
        source: Where it came from, for messages.
        tasks: What the file labels: an entry without objects of these is labelled, with nothing in it; one whose
            labels of a task are all without a shape is not labelled for that task.

    Raises:
        DataError: If it is neither form.
    """
    if not isinstance(content, dict):
        raise DataError(f"{source}: an image's entry must be an object, got {type(content).__name__}")
    if content.get("frames") is None and not {"labels", "name"} & content.keys():
        raise DataError(f"{source}: neither 'frames' (2018, one file an image) nor 'labels' (Scalabel) in the entry")
    labels = Labels()
    shapeless: set[Task] = set()
    try:
        for item in _items(content):
            if not _parse_item(item, labels):
                shapeless |= _task_of(str(item["category"]))
        labels.attributes = parse_attributes(content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{source}: {image.stem}: {brief(error)} is not as BDD100K has it") from error
    read: dict[Task, bool] = {
        "detection": bool(labels.objects),
        "drivable": bool(labels.areas),
        "lane": bool(labels.lanes),
    }
    return labels.record(image.stem, image, [task for task in tasks if read[task] or task not in shapeless])


def _items(content: Mapping[str, Any]) -> list[Any]:
    """Return the labels of an image's entry, of either generation."""
    frames = content.get("frames")
    if frames is not None:
        return [item for frame in frames for item in (frame.get("objects") or ())]
    return [*(content.get("labels") or ())]


def _parse_item(item: dict[str, Any], labels: Labels) -> bool:
    """Add a label; return whether it has a shape."""
    category = str(item["category"])
    attributes = item.get("attributes") or {}
    if item.get("box2d") is not None:
        box = item["box2d"]
        corners = (float(box["x1"]), float(box["y1"]), float(box["x2"]), float(box["y2"]))
        crowd = is_crowd(item) or is_crowd({"attributes": {"crowd": attributes.get("ignored")}})
        kept = {str(k): v for k, v in attributes.items() if isinstance(v, (str, bool, int, float))}
        labels.objects.append(ObjectLabel(category, corners, crowd, kept))
    elif item.get("poly2d"):
        kind = _area_kind(category, attributes)
        if kind is None and not _is_lane(category):
            labels.dropped[f"polygon of category {category!r}"] += 1
            return True
        for vertices, types, closed in _polygons(item["poly2d"], closed=kind is not None):
            if len(vertices) < (3 if closed else 2):
                labels.dropped[f"{'area' if kind else 'lane'} with too few points"] += 1
                continue
            points = flatten(vertices, types, closed=closed)
            if kind is not None:
                labels.areas.append(AreaLabel(kind, points))
                continue
            lane_type = str(attributes.get("laneType") or attributes.get("laneTypes") or category.removeprefix("lane/"))
            labels.lanes.append(
                LaneLabel(
                    category=lane_type if category == "lane" or category.startswith("lane/") else category,
                    points=points,
                    closed=closed,
                    style=str(attributes.get("laneStyle") or attributes.get("style") or ""),
                    direction=str(attributes.get("laneDirection") or attributes.get("direction") or ""),
                    edge=not closed,
                )
            )
    else:
        labels.dropped[f"label without shape of category {category!r}"] += 1
        return False
    return True


def _area_kind(category: str, attributes: Mapping[str, Any]) -> str | None:
    """Return ``direct``, ``alternative``, or None if it is no drivable area."""
    if category == "drivable area":
        return _AREA_KINDS.get(str(attributes.get("areaType", "direct")))
    return None if category in _SKIPPED_AREAS else _AREA_KINDS.get(category)


def _polygons(poly2d: Any, *, closed: bool) -> Iterator[tuple[list[list[float]], str, bool]]:
    """Yield (vertices, types, closed) of a ``poly2d`` of either generation."""
    if isinstance(poly2d[0], dict):
        for shape in poly2d:
            yield shape["vertices"], str(shape.get("types") or ""), bool(shape.get("closed", closed))
    else:
        yield (
            [[float(x), float(y)] for x, y, *_ in poly2d],
            "".join(str(point[2]) if len(point) > 2 else "L" for point in poly2d),
            closed,
        )


def _merge(one: ImageRecord, two: ImageRecord) -> ImageRecord:
    """Join two records of an image; what the first lacks comes from the second."""
    return dataclasses.replace(
        one,
        objects=two.objects if one.objects is None else one.objects,
        drivable=two.drivable if one.drivable is None else one.drivable,
        lane=two.lane if one.lane is None else one.lane,
        attributes=two.attributes | one.attributes,
        dropped=dict(Counter(one.dropped) + Counter(two.dropped)),
    )


def _entries(files: _Split, name: str) -> Iterator[tuple[Any, Path]]:
    for part in files.parts.get(name, ()):
        with part.path.open("rb") as file:
            file.seek(part.start)
            yield _parse(file.read(part.length), part.path), part.path
    if files.documents is not None:
        path = files.documents / f"{name}.json"
        try:
            text = path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from error
        yield _parse(text, path), path


def _parse(text: bytes, path: Path) -> Any:
    try:
        return parse_json(text)
    except ValueError as error:
        raise DataError(f"{path}: not JSON ({brief(error)})") from error


def _tasks_of(path: Path) -> frozenset[Task]:
    """Return the task that a file of a whole split is about, by its name; empty = its name does not tell."""
    match = re.fullmatch(r"(det|drivable|lane)_(train|val|test)\.json", path.name)
    names: dict[str, Task] = {"det": "detection", "drivable": "drivable", "lane": "lane"}
    return frozenset({names[match[1]]}) if match else frozenset()


def _tasks_in(entry: Any) -> set[Task]:
    """Return the tasks that an image's entry has labels of; a broken one, told when it is read, has none."""
    tasks: set[Task] = set()
    try:
        items = [item for item in _items(entry) if isinstance(item, dict)]
    except (TypeError, AttributeError):
        return tasks
    for item in items:
        if item.get("box2d") is not None:
            tasks.add("detection")
        elif item.get("poly2d"):
            tasks |= _task_of(str(item.get("category"))) - {"detection"}
    return tasks


def _task_of(category: str) -> set[Task]:
    """Return the task that labels of a category are of; none for areas that nobody drives on."""
    if category == "drivable area" or category in _AREA_KINDS:
        return {"drivable"}
    if _is_lane(category):
        return {"lane"}
    return set() if category in _SKIPPED_AREAS else {"detection"}


def _tasks_of_documents(folder: Path) -> frozenset[Task]:
    """Return the tasks that one-an-image files label: those that the first few hundred have labels of."""
    tasks: set[Task] = set()
    for path in visible(folder.glob("*.json"))[:_DOCUMENTS_LOOKED_AT]:
        if len(tasks) == len(TASKS):
            break
        try:
            entry = parse_json(path.read_bytes())
        except ValueError:
            continue
        if isinstance(entry, dict):
            tasks |= _tasks_in(entry)
    return frozenset(tasks)


def _is_lane(category: str) -> bool:
    return category == "lane" or category.startswith("lane/") or category in _LANE_CATEGORIES


def _merged_files(files: list[Path], split: str) -> tuple[list[Path], dict[Path, list[Path]]]:
    """Return the files of a whole split, the newest generation first, and those that each is read instead of.

    Files in ``rles`` hold the masks once more, without polygons.
    """
    patterns = (
        rf"(^|/)det_{split}\.json$",
        rf"(^|/)drivable_{split}\.json$",
        rf"(^|/)lane_{split}\.json$",
        rf"(^|/)bdd100k_labels_images_(100k_)?{split}\.json$",
        rf"(^|/)bdd100k_labels_images_{split}_100k\.json$",
    )
    found = []
    passed_over: dict[Path, list[Path]] = {}
    for pattern in patterns:
        matching = sorted(path for path in files if re.search(pattern, path.as_posix()) and path.parent.name != "rles")
        if matching:
            found.append(matching[-1])
        if matching[1:]:
            passed_over[matching[-1]] = matching[:-1]
    return found, passed_over


def _index(path: Path) -> Iterator[tuple[str, _Part, dict[str, Any]]]:
    """Yield (image name, where its entry is, the entry) for a list of entries, or an object whose ``frames`` is one."""
    decoder = json.JSONDecoder()
    with path.open("rb") as file:
        # Latin-1 keeps one character a byte, so that positions in the text are positions in the file.
        text = file.read(_CHUNK).decode("latin-1")
        base = 0
        position = _list_start(text, path)
        while True:
            while position < len(text) and text[position] in " \t\r\n,":
                position += 1
            if len(text) - position < 2:
                more = file.read(_CHUNK).decode("latin-1")
                if not more and (position >= len(text) or text[position] != "]"):
                    raise DataError(f"{path}: ends in the middle of its list; download it again")
                text, base, position = text[position:] + more, base + position, 0
            if text[position] == "]":
                return
            if text[position] in " \t\r\n,":
                continue
            try:
                entry, end = decoder.raw_decode(text, position)
            except json.JSONDecodeError as error:
                more = file.read(_CHUNK).decode("latin-1")
                if not more:
                    raise DataError(f"{path}: not JSON near byte {base + position} ({error.msg})") from error
                text, base, position = text[position:] + more, base + position, 0
                continue
            except RecursionError as error:
                raise DataError(f"{path}: not JSON near byte {base + position} (nested too deeply)") from error
            if not isinstance(entry, dict) or "name" not in entry:
                raise DataError(f"{path}: an entry without 'name' near byte {base + position}")
            if not str(entry["name"]).isascii():
                entry = _parse(text[position:end].encode("latin-1"), path)
            yield Path(str(entry["name"])).stem, _Part(path, base + position, end - position), entry
            position = end


def _list_start(text: str, path: Path) -> int:
    """Return the position after the ``[`` of the list of entries."""
    match = re.match(r"\s*\[", text) or re.match(r"\s*\{.*?\"frames\"\s*:\s*\[", text, re.DOTALL)
    if match is None:
        raise DataError(f"{path}: neither a list of images nor an object with 'frames'")
    return match.end()


def _survey(root: Path) -> tuple[dict[str, Path], list[Path]]:
    """Return all folders by their path from the root, and all JSON files that may hold a whole split."""
    folders: dict[str, Path] = {}
    files: list[Path] = []
    for folder, names, entries in os.walk(root, followlinks=True):
        names.sort()
        names[:] = [name for name in names if not name.startswith(".")]
        path = Path(folder)
        folders[path.relative_to(root).as_posix()] = path
        files += [
            path / name
            for name in entries
            if not name.startswith(".")
            and name.endswith(".json")
            and ("train" in name or "val" in name or "test" in name)
        ]
    return folders, files


def _images(folders: dict[str, Path], split: str) -> dict[str, Path]:
    """Return image name -> path of a split: those in its folder and in all below, but in folders of another split.

    Of one name, that in a folder above others counts: below it are small copies, or pictures of its labels.

    Raises:
        DataError: If two images have one name, neither in a folder above the other.
    """
    others = "|".join(other for other in BDD100K_SPLITS if other != split)
    for pattern in (f"images/100k/{split}", f"100k/{split}", f"images/{split}", split):
        images: dict[str, Path] = {}
        for where, folder in folders.items():
            match = re.search(rf"(^|/){pattern}(?=/|$)(?!.*/({others})(/|$))", where)
            if match is None or _LABELS.search(where, match.end()):
                continue
            if pattern.startswith("images/") or not _LABELS.search(where[: match.start()]):
                for path in visible(folder.iterdir()):
                    if path.suffix.lower() in IMAGE_ENDINGS[:2]:
                        first = images.setdefault(path.stem, path)
                        above = first.parent in path.parent.parents
                        if not above and first.stat().st_size != path.stat().st_size:  # else it is a copy
                            raise same_name(path.stem, split, first, path)
        if images:
            return images
    return {}


def _first(folders: dict[str, Path], *patterns: str, ending: str) -> Path | None:
    """Return the first folder that ends in one of the patterns and holds a file with that ending."""
    for pattern in patterns:
        for where, folder in folders.items():
            if re.search(rf"(^|/){pattern}$", where):
                with os.scandir(folder) as entries:
                    if any(entry.name.endswith(ending) for entry in entries):
                        return folder
    return None


def _drivable_masks(
    folders: dict[str, Path], split: str
) -> tuple[Path, str, dict[int | tuple[int, int, int], str]] | None:
    """Return (folder, what follows the name, what the values mean) of the drivable masks there are."""
    kinds: tuple[tuple[str, str, dict[Any, str]], ...] = (
        (rf"drivable/masks/{split}", "", DRIVABLE_IDS_2020),
        (rf"drivable/colormaps/{split}", "", DRIVABLE_COLOURS),
        (rf"drivable_maps/labels/{split}", "_drivable_id", DRIVABLE_IDS_2018),
        (rf"drivable_maps/color_labels/{split}", "_drivable_color", DRIVABLE_COLOURS),
    )
    for pattern, suffix, values in kinds:
        folder = _first(folders, pattern, ending=f"{suffix}.png")
        if folder is not None:
            return folder, suffix, dict(values)
    return None


def _unmatched(split: str, files: _Split) -> list[str]:
    """Return a line on labels without their image, and one on images that no label file has."""
    labelled = {*files.parts, *_stems(files.documents, ".json"), *_stems(files.lane_masks, ".png")}
    if files.drivable_masks is not None:
        folder, suffix, _ = files.drivable_masks
        labelled |= _stems(folder, f"{suffix}.png")
    without, bare = labelled - files.images.keys(), files.images.keys() - labelled
    lines = []
    if without:
        lines.append(f"{split}: labels of {len(without)} images that are not there, such as {min(without)}")
    if bare and labelled:
        lines.append(f"{split}: {len(bare)} images that no label file has, such as {min(bare)}")
    return lines


def _stems(folder: Path | None, ending: str) -> set[str]:
    """Return the names of a folder's files without the ending."""
    files = () if folder is None else folder.iterdir()
    return {path.name.removesuffix(ending) for path in visible(files) if path.name.endswith(ending)}


def _lane_values(*, crosswalk: bool, vertical: bool) -> dict[int | tuple[int, int, int], str]:
    """Return what the values of a 2020 lane mask mean, of which some count as marking."""
    values: dict[int | tuple[int, int, int], str] = {255: "background"}
    for value in range(64):
        marking = not value & 8 and (vertical or not value & 32) and (crosswalk or value & 7)
        values[value] = "foreground" if marking else "background"
    return values
