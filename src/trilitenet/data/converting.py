"""From records of any foreign format to the published layout: parallel, resumable, idempotent.

Each image's files are written under another name and then renamed, and a journal beside them says which images are
done and what was left out, so a conversion that was interrupted goes on where it stood and ends the same.
"""

from __future__ import annotations

import collections
import contextlib
import csv
import dataclasses
import hashlib
import io
import json
import logging
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.description import (
    DESCRIPTION_FILE,
    VEHICLES,
    DatasetDescription,
    MaskMeaning,
    class_table,
    is_folder_name,
    read_description,
    write_description,
)
from trilitenet.data.lane_edges import centre_line, pair_edges
from trilitenet.data.rasterise import check_finite, draw_line, fill_polygon
from trilitenet.data.reading import (
    FOLDERS,
    IMAGE_ENDINGS,
    IMAGE_FOLDER,
    LABEL_FILES,
    label_file,
)
from trilitenet.data.records import (
    AreaLabel,
    ImageRecord,
    LaneLabel,
    MaskFile,
    ObjectLabel,
    RecordSource,
    RunLabel,
    image_size,
)
from trilitenet.errors import Claim, ConfigError, DataError, OutputError, replacing, writing
from trilitenet.processing.cores import ProcessPool
from trilitenet.processing.images import BROKEN, open_image

__all__ = ["ConversionOptions", "ConversionReport", "convert", "drivable_mask", "lane_mask"]

_LOGGER: Final = logging.getLogger(__name__)

REFERENCE_WIDTH: Final = 1280
"""Line widths and gaps are in pixels of an image this wide."""

ALTERNATIVE_VALUE: Final = 127
"""Mask value of alternative areas when they are kept apart from direct ones (255)."""

IGNORE_VALUE: Final = 64
"""Mask value of pixels that are neither foreground nor background."""

_BACKGROUND: Final = 1
"""Stands for 0 while 0 stands for values without a meaning."""

_CORNERS: Final = 3
"""An area with fewer has no pixel."""

_STATE_FOLDER: Final = ".conversion"
_REPORT_FILE: Final = "conversion.json"


@dataclasses.dataclass(frozen=True)
class ConversionOptions:
    """What to make of the labels.

    Attributes:
        classes: Class name -> categories that belong to it.
        ignore: Categories whose boxes become ignored regions.
        lane_width: Split -> width of a drawn lane marking in pixels of a 1280-pixel wide image; ``"*"`` for others.
        crosswalk: Draw crosswalks as lane markings.
        vertical: Draw markings across the road (stop lines) as lane markings.
        lane_categories: Draw these alone; empty = all.
        pair_edges: Join the two edges of a marking into its centre line; False draws each edge.
        max_gap: Edges further apart than this, in pixels of a 1280-pixel wide image, are two markings.
        keep_alternative: Keep alternative drivable areas apart, as value 127 instead of 255.
        images: Hard-link images (copied where that is impossible), copy them, or point symbolic links at them.
    """

    classes: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=lambda: {"vehicle": VEHICLES})
    ignore: tuple[str, ...] = ()
    lane_width: dict[str, float] = dataclasses.field(default_factory=lambda: {"train": 8.0, "*": 2.0})
    crosswalk: bool = False
    vertical: bool = False
    lane_categories: tuple[str, ...] = ()
    pair_edges: bool = True
    max_gap: float = 40.0
    keep_alternative: bool = False
    images: Literal["link", "copy", "symlink"] = "link"

    def __post_init__(self) -> None:
        if not all(math.isfinite(width) and width > 0 for width in self.lane_width.values()):
            raise ConfigError(f"lane widths must be above 0 and finite, got {self.lane_width}")
        if not 0 <= self.max_gap < math.inf:
            raise ConfigError(f"max_gap must be finite and not negative, got {self.max_gap}")
        class_table(tuple(self.classes), self.classes)

    def width(self, split: str) -> float:
        """Return the width of a lane marking for a split."""
        return self.lane_width.get(split, self.lane_width.get("*", 2.0))


@dataclasses.dataclass(frozen=True)
class ConversionReport:
    """What a conversion did, and earlier ones of other splits into the same folder.

    Attributes:
        images: Split -> images written.
        labelled: Split -> task -> images labelled for it.
        objects: Split -> class (or ``ignored``) -> boxes written.
        lanes: Split -> ``"pairs"``, ``"single lines"``, ``"outlines"`` -> lane markings drawn; ``"masks"`` -> images
            whose markings came as a mask, which keeps its width.
        dropped: Split -> reason -> how many labels, or images, were left out.
    """

    images: dict[str, int]
    labelled: dict[str, dict[str, int]]
    objects: dict[str, dict[str, int]]
    lanes: dict[str, dict[str, int]]
    dropped: dict[str, dict[str, int]]

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes."""
        return dataclasses.asdict(self)


def convert(
    source: RecordSource,
    out: str | Path,
    options: ConversionOptions | None = None,
    *,
    splits: Iterable[str] | None = None,
    workers: int = 0,
    description: DatasetDescription | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ConversionReport:
    """Write a foreign data set in the published layout.

    What is there already from an earlier run of the same source with the same options is kept where its labels and
    files are unchanged; what the source no longer has is removed. An image whose labels are broken is left out, counted
    and logged.

    Args:
        source: The foreign data set.
        out: Folder to write; made if missing.
        options: What to make of the labels.
        splits: Only these; all if left out.
        workers: Processes; 0 converts in this one.
        description: Name, licence and the like for ``dataset.yaml``; what it leaves out stays as it is there.
        progress: Called with (images done, images in all).

    Raises:
        OutputError: If ``out`` holds something else, or a conversion with other options or of another source; or if it
            cannot be written, or is being written by another call.
        DataError: If a split is unknown, or its name not that of one folder.
    """
    options = options or ConversionOptions()
    root = Path(out)
    chosen = tuple(splits) if splits is not None else source.splits
    unknown = [split for split in chosen if split not in source.splits]
    if unknown:
        raise DataError(f"no split {unknown[0]!r}; there are {', '.join(source.splits)}")
    for split in chosen:
        if not is_folder_name(split):
            raise DataError(f"split {split!r} is not the name of one folder; rename it where the source names it")
    state = _open_state(root, options, source.origin)
    names = {split: source.names(split) for split in chosen}
    if splits is None:
        names |= {path.stem: [] for path in sorted(state.glob("*.jsonl")) if path.stem not in names}
    total = sum(map(len, names.values()))
    finished = 0
    if progress:
        progress(finished, total)
    with writing(root), contextlib.closing(Claim(root / _REPORT_FILE)):
        for part in root.rglob(".*.part"):  # of a run that was killed
            part.unlink()
        for split, wanted in names.items():
            for _ in _convert_split(source, split, wanted, root, options, workers):
                finished += 1
                if progress:
                    progress(finished, total)
        journals = _read_journals(state, source.splits)
        report = _report(journals)
        _finish(root, options, description, report, journals)
    return report


def _convert_split(
    source: RecordSource, split: str, names: list[str], root: Path, options: ConversionOptions, workers: int
) -> Iterator[str]:
    """Convert a split's images and yield their names one by one; at the end its files are those of a first run."""
    folders = [root / folder / split for folder in FOLDERS]
    path = root / _STATE_FOLDER / f"{split}.jsonl"
    earlier = _read_journal(path)
    for name in earlier.keys() - set(names):
        _remove_files(root, split, name)
        del earlier[name]
    done: dict[str, dict[str, Any]] = {}
    if names:
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        _write(path, _journal_text(earlier))
        with path.open("a", encoding="utf-8") as journal:
            for summary in _run(source, split, [(name, earlier.get(name)) for name in names], root, options, workers):
                name = summary["name"]
                done[name] = summary
                if summary != earlier.get(name):
                    journal.write(json.dumps(summary, sort_keys=True) + "\n")
                    journal.flush()
                yield name
        _write(path, _journal_text(done))
    else:
        path.unlink(missing_ok=True)
    if not any("image" in summary for summary in done.values()):
        for folder in folders:
            with contextlib.suppress(OSError):  # missing, or holds files that are not of a conversion
                folder.rmdir()


def drivable_mask(
    areas: Iterable[AreaLabel | RunLabel], size: tuple[int, int], *, keep_alternative: bool = False
) -> NDArray[np.uint8]:
    """Draw drivable areas, later ones over earlier ones, and what is to be ignored over all.

    Args:
        areas: Polygons in pixels.
        size: (height, width).
        keep_alternative: Draw alternative areas with 127 instead of 255.

    Returns:
        (height, width) uint8: 255 direct, 255 or 127 alternative, 64 ignored, 0 elsewhere.
    """
    mask = np.zeros(size, np.uint8)
    for area in sorted(areas, key=lambda area: area.kind == "ignore"):
        level = _level(area.kind, keep_alternative=keep_alternative)
        if isinstance(area, AreaLabel):
            fill_polygon(mask, area.points, level)
        else:
            mask[area.decode(size)] = level
    return mask


def _level(kind: str, *, keep_alternative: bool) -> int:
    """Return the mask value of a kind of area."""
    if kind == "ignore":
        return IGNORE_VALUE
    return ALTERNATIVE_VALUE if kind == "alternative" and keep_alternative else 255


def lane_mask(
    lanes: Iterable[LaneLabel | RunLabel], size: tuple[int, int], width: float, options: ConversionOptions
) -> tuple[NDArray[np.uint8], Counter[str], Counter[str]]:
    """Draw lane markings; the two edges of one become its centre line.

    Args:
        lanes: Lines, edges or outlines in pixels.
        size: (height, width).
        width: Of the drawn line, in pixels of a 1280-pixel wide image.
        options: Which to draw, and how to pair.

    Returns:
        (height, width) uint8 {0, 255}; counts of drawn ``pairs``, ``single lines``, ``outlines``; counts of what was
        left out.
    """
    mask = np.zeros(size, np.uint8)
    drawn: Counter[str] = Counter()
    dropped: Counter[str] = Counter()
    factor = size[1] / REFERENCE_WIDTH
    groups: dict[tuple[str, str, str], list[NDArray[np.float64]]] = collections.defaultdict(list)
    for lane in lanes:
        if not isinstance(lane, LaneLabel):
            mask[lane.decode(size)] = _level(lane.kind, keep_alternative=False)
            drawn["outlines"] += 1
        elif lane.category == "crosswalk" and not options.crosswalk:
            dropped["lane: crosswalk"] += 1
        elif lane.direction == "vertical" and not options.vertical:
            dropped["lane: across the road"] += 1
        elif options.lane_categories and lane.category not in options.lane_categories:
            dropped[f"lane: {lane.category}"] += 1
        elif len(lane.points) < (_CORNERS if lane.closed else 2):
            dropped["lane with too few points"] += 1
        elif lane.closed:
            fill_polygon(mask, lane.points, 255)
            drawn["outlines"] += 1
        elif lane.edge and options.pair_edges:
            check_finite(lane.points)
            groups[lane.category, lane.style, lane.direction].append(lane.points)
        else:
            draw_line(mask, lane.points, width * factor, 255)
            drawn["single lines"] += 1
    for edges in groups.values():
        pairing = pair_edges(edges, options.max_gap * factor)
        for first, second in pairing.pairs:
            draw_line(mask, centre_line(edges[first], edges[second]), width * factor, 255)
        for index in pairing.single:
            draw_line(mask, edges[index], width * factor, 255)
        drawn["pairs"] += len(pairing.pairs)
        drawn["single lines"] += len(pairing.single)
    return mask, +drawn, dropped


@dataclasses.dataclass(frozen=True, eq=False)
class _Job:
    source: RecordSource
    split: str
    root: Path
    options: ConversionOptions

    def __call__(self, item: tuple[str, dict[str, Any] | None]) -> dict[str, Any]:
        """Convert the image of a name, unless the line that an earlier run wrote of it still holds."""
        name, earlier = item
        try:
            record = self.source.record(self.split, name)
            digest = _digest(record)
            if earlier and earlier.get("digest") == digest and _is_complete(self.root, self.split, earlier):
                return earlier
            summary = {**_convert_one(record, self.split, self.root, self.options), "digest": digest}
        except DataError as error:
            readable = name.encode("utf-8", "backslashreplace").decode()  # a file's name may be no text
            _LOGGER.warning("left out %s/%s: %s", self.split, readable, error)
            summary = {"name": name, "dropped": {"image: labels or image broken": 1}, "error": str(error)}
        _remove_files(self.root, self.split, name, keep=_files(self.split, summary))
        return summary


_job: _Job | None = None


def _start(job: _Job) -> None:
    global _job
    _job = job


def _work(item: tuple[str, dict[str, Any] | None]) -> dict[str, Any]:
    if _job is None:
        raise RuntimeError("the worker was not started")
    return _job(item)


def _run(
    source: RecordSource,
    split: str,
    items: list[tuple[str, dict[str, Any] | None]],
    root: Path,
    options: ConversionOptions,
    workers: int,
) -> Iterator[dict[str, Any]]:
    """Yield the line of the journal of each (name, its earlier line)."""
    job = _Job(source, split, root, options)
    if workers <= 0 or len(items) < 2:
        yield from map(job, items)
        return
    with ProcessPool(workers, _start, (job,)) as pool:
        yield from pool.map(_work, items, chunksize=max(1, min(32, len(items) // (workers * 4))))


def _convert_one(record: ImageRecord, split: str, root: Path, options: ConversionOptions) -> dict[str, Any]:
    """Write one image and its labels; return its line of the journal."""
    if record.image.suffix.lower() not in IMAGE_ENDINGS:
        raise DataError(f"{record.image}: training reads {', '.join(IMAGE_ENDINGS)}; save it as one of these")
    try:
        json.dumps([record.name, record.attributes], ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise DataError(f"{record.name!r}: its name or attributes are not UTF-8; rename it") from error
    size = image_size(record.image)
    if record.size is not None and record.size != size:
        stated = f"{record.size[1]}x{record.size[0]}"
        raise DataError(f"{record.image}: is {size[1]}x{size[0]}, its labels are for {stated}; give it at that size")
    dropped = Counter(record.dropped)
    summary: dict[str, Any] = {"name": record.name, "attributes": record.attributes, "labelled": []}
    if record.objects is not None:
        items, counts = _objects(record.objects, size, options, dropped)
        content = {
            "name": record.name,
            "attributes": record.attributes,
            "frames": [{"timestamp": 0, "objects": items}],
        }
        _write(root / label_file("detection", split, record.name), json.dumps(content))
        summary["labelled"].append("detection")
        summary["objects"] = dict(sorted(counts.items()))
    if record.drivable is not None:
        if isinstance(record.drivable, MaskFile):
            mask, told = _mask_of(record.drivable, size, keep_alternative=options.keep_alternative)
            dropped["drivable: values of a mask that nothing explains"] += told
        else:
            mask = drivable_mask(record.drivable, size, keep_alternative=options.keep_alternative)
            dropped["area with too few points"] += sum(
                isinstance(area, AreaLabel) and len(area.points) < _CORNERS for area in record.drivable
            )
        _write_mask(root / label_file("drivable", split, record.name), mask)
        summary["labelled"].append("drivable")
    if record.lane is not None:
        if isinstance(record.lane, MaskFile):
            mask, told = _mask_of(record.lane, size, keep_alternative=False)
            dropped["lane: values of a mask that nothing explains"] += told
            summary["lanes"] = {"masks": 1}
        else:
            mask, drawn, left_out = lane_mask(record.lane, size, options.width(split), options)
            dropped += left_out
            summary["lanes"] = dict(sorted(drawn.items()))
        _write_mask(root / label_file("lane", split, record.name), mask)
        summary["labelled"].append("lane")
    if _has_ignored(record.drivable) or _has_ignored(record.lane):
        summary["ignore_value"] = True
    summary["dropped"] = dict(sorted((+dropped).items()))
    # The image comes last: where it is, its labels are complete.
    _place_image(record.image, root / IMAGE_FOLDER / split / f"{record.name}{record.image.suffix.lower()}", options)
    summary["image"] = f"{record.name}{record.image.suffix.lower()}"
    return summary


def _objects(
    objects: Iterable[ObjectLabel], size: tuple[int, int], options: ConversionOptions, dropped: Counter[str]
) -> tuple[list[dict[str, Any]], Counter[str]]:
    """Return the objects to write, clipped to the image, and how many of each class."""
    table = class_table(tuple(options.classes), options.classes)
    names = tuple(options.classes)
    items: list[dict[str, Any]] = []
    counts: Counter[str] = Counter()
    for item in objects:
        ignored = item.category in options.ignore
        if item.category not in table and not ignored:
            dropped[f"object: category {item.category!r} not in a class"] += 1
            continue
        x1, y1, x2, y2 = item.box
        box = (max(x1, 0.0), max(y1, 0.0), min(x2, float(size[1])), min(y2, float(size[0])))
        if not (box[2] > box[0] and box[3] > box[1]):
            dropped["object: box empty or outside the image"] += 1
            continue
        crowd = item.crowd or ignored
        counts["ignored" if crowd else names[table[item.category]]] += 1
        attributes = {**item.attributes, "crowd": True} if crowd else item.attributes
        # An ignored category keeps its name; a crowd box counts under any class.
        items.append(
            {
                "category": item.category,
                "id": len(items),
                "attributes": attributes,
                "box2d": dict(zip(("x1", "y1", "x2", "y2"), box, strict=True)),
            }
        )
    return items, counts


def _has_ignored(labels: tuple[AreaLabel | LaneLabel | RunLabel, ...] | MaskFile | None) -> bool:
    if isinstance(labels, MaskFile):
        return "ignore" in labels.values.values()
    return any(getattr(label, "kind", "") == "ignore" for label in labels or ())


def _mask_of(file: MaskFile, size: tuple[int, int], *, keep_alternative: bool) -> tuple[NDArray[np.uint8], bool]:
    """Return the mask that a picture holds, and whether values without a meaning, which are background, are to be told.

    The mask is 255 foreground, 127 alternative if kept apart, 64 ignored. Values without a meaning are to be told where
    the background has been given one, and where the picture holds no value with a meaning.
    """
    try:
        with open_image(file.path) as picture:
            picture.load()
            colours = any(isinstance(value, tuple) for value in file.values)
            if colours or (not file.values and picture.mode.startswith("RGB")):
                rgb = np.asarray(picture.convert("RGB")).astype(np.int32)
                pixels = (rgb[..., 0] << 16) | (rgb[..., 1] << 8) | rgb[..., 2]
            else:
                plain = picture if picture.mode in {"P", "L", "1"} or picture.mode[0] == "I" else picture.convert("L")
                pixels = np.asarray(plain).astype(np.int32)
                if picture.mode == "1" and 1 not in file.values:
                    pixels *= 255  # a picture of two levels has them as 0 and 255 everywhere else
    except BROKEN as error:
        raise DataError(f"{file.path}: not a mask that can be read ({error})") from error
    if pixels.shape != size:
        raise DataError(f"{file.path}: mask of {pixels.shape[1]}x{pixels.shape[0]}, image of {size[1]}x{size[0]}")
    if not file.values:
        return np.where(pixels > 0, 255, 0).astype(np.uint8), False
    table = np.zeros(1 << 24, np.uint8)  # of all colours; a level beyond is told by the last, which is none's
    for value, meaning in file.values.items():
        place = (value[0] << 16) | (value[1] << 8) | value[2] if isinstance(value, tuple) else value
        background = meaning == "background"
        table[place] = _BACKGROUND if background else _level(meaning, keep_alternative=keep_alternative)
    mask = table[np.clip(pixels, -1, len(table) - 1)]
    unknown = mask == 0
    mask[mask == _BACKGROUND] = 0
    complete = "background" in file.values.values()
    return mask, bool((complete or unknown.all()) and (pixels[unknown] != 0).any())


def _write_mask(path: Path, mask: NDArray[np.uint8]) -> None:
    _write(path, cv2.imencode(".png", mask)[1].tobytes())


def _write(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, and only if it differs."""
    data = content.encode() if isinstance(content, str) else content
    try:
        if path.stat().st_size == len(data) and path.read_bytes() == data:
            return
    except FileNotFoundError:
        pass
    with replacing(path) as part:
        part.write_bytes(data)


def _place_image(source: Path, target: Path, options: ConversionOptions) -> None:
    source = source.resolve()
    if options.images == "symlink":
        if target.is_symlink() and target.resolve() == source:
            return
        target.unlink(missing_ok=True)
        target.symlink_to(source)
        return
    if target.exists():
        there, here = target.stat(), source.stat()
        if os.path.samestat(there, here) or (there.st_size, there.st_mtime_ns) == (here.st_size, here.st_mtime_ns):
            return
    part = target.with_name(f".{os.getpid()}.part")  # short, for names may be as long as file systems take them
    part.unlink(missing_ok=True)
    if options.images == "link":
        with contextlib.suppress(OSError):
            os.link(source, part)
    if not part.exists():
        try:
            shutil.copy2(source, part)
        except OSError as error:  # which names the source
            part.unlink(missing_ok=True)
            raise OutputError(f"{target}: cannot be written as a copy of {source} ({error.strerror})") from error
    part.replace(target)


def _open_state(root: Path, options: ConversionOptions, origin: Mapping[str, str]) -> Path:
    """Return the folder of the journals, made if this is a first run.

    Raises:
        OutputError: If the folder is not of a conversion of this source with these options.
    """
    state = root / _STATE_FOLDER
    text = json.dumps({**dataclasses.asdict(options), "source": dict(origin)}, sort_keys=True, indent=1)
    path = state / "options.json"
    if path.is_file():
        if path.read_text(encoding="utf-8") != text:
            raise OutputError(
                f"{root}: holds a conversion with other options or another source; choose another folder or remove it"
            )
        return state
    if root.is_dir() and any(child != state for child in root.iterdir()):  # the state may have failed to be written
        raise OutputError(f"{root}: is not empty and not of an earlier conversion; choose another folder")
    with writing(root):
        state.mkdir(parents=True, exist_ok=True)
        _write(path, text)
    return state


def _read_journals(state: Path, order: Iterable[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the journals of all splits that are there: those of ``order`` first."""
    there = {path.stem for path in state.glob("*.jsonl")}
    splits = [*(split for split in order if split in there), *sorted(there - set(order))]
    return {split: _read_journal(state / f"{split}.jsonl") for split in splits}


def _read_journal(path: Path) -> dict[str, dict[str, Any]]:
    """Return image name -> its last line."""
    lines: dict[str, dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            summary = json.loads(line)
        except ValueError:
            continue  # the line that an interruption cut off
        lines[summary["name"]] = summary
    return lines


def _journal_text(lines: Mapping[str, Mapping[str, Any]]) -> str:
    return "".join(json.dumps(lines[name], sort_keys=True) + "\n" for name in sorted(lines))


def _files(split: str, summary: Mapping[str, Any]) -> set[str]:
    """Return the files of an image's line of the journal, from the root."""
    if "image" not in summary:
        return set()
    labels = {label_file(task, split, summary["name"]) for task in summary["labelled"]}
    return {f"{IMAGE_FOLDER}/{split}/{summary['image']}"} | labels


def _is_complete(root: Path, split: str, summary: Mapping[str, Any]) -> bool:
    """Return whether an image's files are all there."""
    files = _files(split, summary)
    return bool(files) and all((root / file).is_file() for file in files)


def _remove_files(root: Path, split: str, name: str, keep: Collection[str] = ()) -> None:
    """Remove what an earlier run wrote of an image and this one does not."""
    images = (f"{IMAGE_FOLDER}/{split}/{name}{ending}" for ending in IMAGE_ENDINGS)
    for file in (*images, *(label_file(task, split, name) for task in LABEL_FILES)):
        if file not in keep:
            (root / file).unlink(missing_ok=True)


def _digest(record: ImageRecord) -> str:
    """Return what changes when the labels change, or the files that they are in or for."""
    files = [record.image, *(mask.path for mask in (record.drivable, record.lane) if isinstance(mask, MaskFile))]
    try:
        facts = [(state.st_size, state.st_mtime_ns) for state in map(Path.stat, files)]
    except OSError as error:
        raise DataError(f"{error.filename}: cannot be read ({error.strerror})") from error
    return hashlib.blake2b(repr((facts, _plain(record))).encode(), digest_size=16).hexdigest()


def _plain(value: Any) -> Any:
    """Return ``value`` in lists, numbers and text, whose ``repr`` is whole and the same for the same labels."""
    if dataclasses.is_dataclass(value):
        value = vars(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return sorted((str(key), _plain(item)) for key, item in value.items())
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return str(value.resolve()) if isinstance(value, Path) else value


def _report(summaries: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> ConversionReport:
    images: dict[str, int] = {}
    tables: dict[str, dict[str, Counter[str]]] = {key: {} for key in ("labelled", "objects", "lanes", "dropped")}
    for split, done in summaries.items():
        images[split] = sum("image" in summary for summary in done.values())
        counters = {key: Counter[str]() for key in tables}
        for summary in done.values():
            counters["labelled"].update(summary.get("labelled", ()))
            for key in ("objects", "lanes", "dropped"):
                counters[key].update(summary.get(key, {}))
        for key, counter in counters.items():
            tables[key][split] = counter
    plain = {key: {split: dict(sorted(c.items())) for split, c in table.items()} for key, table in tables.items()}
    return ConversionReport(images=images, **plain)


def _finish(
    root: Path,
    options: ConversionOptions,
    description: DatasetDescription | None,
    report: ConversionReport,
    journals: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> None:
    """Write ``dataset.yaml``, ``index.csv`` and ``conversion.json`` for all splits that are there."""
    rows: list[dict[str, str]] = []
    columns: list[str] = []
    ignore: tuple[int, ...] = ()
    for split, lines in sorted(journals.items()):
        for summary in lines.values():
            if "image" in summary:
                # The columns of the layout itself stay its own.
                own = {f"attribute_{k}" if k in {"name", "split"} else k: v for k, v in summary["attributes"].items()}
                rows.append({**own, "name": summary["name"], "split": split})
                ignore = (IGNORE_VALUE,) if summary.get("ignore_value") else ignore
                columns += [key for key in own if key not in columns]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, ["name", "split", *sorted(columns)], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    _write(root / "index.csv", text.getvalue())
    _write(root / _REPORT_FILE, json.dumps(report.to_dict(), indent=1, sort_keys=True))
    values = {255: "direct", ALTERNATIVE_VALUE: "alternative"} if options.keep_alternative else {255: "drivable"}
    default = DatasetDescription()
    given = vars(description or default).items()
    before = read_description(root)  # with what has been added by hand, an ego mask for example
    whole = dataclasses.replace(
        before,
        **{key: value for key, value in given if value != getattr(default, key)}
        | {
            "classes": dict(options.classes),
            "ignore": (*options.ignore, *(category for category in before.ignore if category not in options.ignore)),
            "splits": tuple(sorted(split for split, count in report.images.items() if count)),
            "attributes": tuple(sorted(columns)),
            "drivable": _meaning(before.drivable, values, ignore),
            "lane": _meaning(before.lane, {255: "lane marking"}, ignore),
        },
    )
    if not (root / DESCRIPTION_FILE).is_file() or before != whole:
        write_description(root, whole)


def _meaning(before: MaskMeaning, values: dict[int, str], ignore: tuple[int, ...]) -> MaskMeaning:
    """Return what a mask's values mean, with the threshold and the ignored values that have been added by hand."""
    added = tuple(value for value in before.ignore if value != IGNORE_VALUE)
    return MaskMeaning(before.above, values, ignore + added)
