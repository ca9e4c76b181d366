"""What is wrong with a data set, and what is in it: one pass over its files, in parallel.

Every image is decoded (JPEGs at a fraction of their size, which still reads the whole file) and hashed, every mask and
annotation is read. Of each image only a few hundred bytes are kept, so memory stays small for a hundred thousand.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import itertools
import math
import mmap
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.config import DEFAULT_ANCHORS, LONG_SIDE, parse_json
from trilitenet.data.description import DatasetDescription, MaskMeaning, class_table, read_description
from trilitenet.data.prepared import is_prepared
from trilitenet.data.reading import (
    IMAGE_ENDINGS,
    IMAGE_FOLDER,
    LABEL_FILES,
    UNDEFINED,
    check_root,
    decode_grey,
    decode_mask,
    is_crowd,
    is_image_file,
    label_file,
    parse_attributes,
    read_index,
    split_folders,
)
from trilitenet.errors import DataError, few, import_extra
from trilitenet.processing.boxes import best_side_ratio
from trilitenet.processing.cores import ProcessPool
from trilitenet.processing.images import BROKEN, open_image, read_image, upright_size

__all__ = ["KINDS", "CheckReport", "Finding", "check_dataset", "detect_layout"]

KINDS: Final[dict[str, str]] = {
    "image-unreadable": "the image is empty, truncated, no image, or a link to nothing",
    "annotation-unreadable": "the annotation is not JSON, or not in the per-image form",
    "mask-unreadable": "the mask is empty, truncated or no image",
    "mask-size": "the mask has another size than its image",
    "mask-values": "the mask has values that dataset.yaml does not explain",
    "mask-invisible": "the mask's labels are all at or below the threshold, so they read as background",
    "box-invalid": "a box with missing, swapped or infinite coordinates, or without area",
    "box-outside": "a box reaches out of the image",
    "box-twice": "the same box twice in one image",
    "category-unknown": "a category that is neither in a class nor one of BDD100K's",
    "no-class": "there are boxes, and none is of a class",
    "orphan": "an annotation or a mask without its image",
    "not-read": "an image, annotation or mask in a folder, or of an ending, that is not read",
    "unlabelled": "an image without any label",
    "name-in-two-splits": "the same name in two splits",
    "name-twice": "images that differ in their ending alone, and would have the same labels",
    "duplicate": "the same file twice in one split",
    "leak-duplicate": "the same file in two splits",
    "leak-near-duplicate": "nearly the same picture in two splits",
    "leak-sequence": "a sequence (index.csv, annotations) with images in two splits",
    "index": "index.csv and the images disagree, or it lists an image twice",
    "ego-mask": "a mask of the own car that dataset.yaml names and that cannot be read",
    "split-missing": "a split that dataset.yaml names, or a folder of one, and that has no images",
    "anchors": "too many boxes that no anchor fits",
}
"""Everything that is looked for."""

_KNOWN_CATEGORIES: Final = frozenset({
    "car", "truck", "bus", "train", "person", "pedestrian", "rider", "bike", "bicycle", "motor", "motorcycle",
    "traffic light", "traffic sign", "vehicle", "trailer", "other vehicle", "other person",
})  # fmt: skip

_PLAIN_VALUES: Final = frozenset({0, 127, 255})
"""Values of masks without a description: background, alternative area, foreground."""

_PICTURES: Final = (
    *IMAGE_ENDINGS, ".tif", ".tiff", ".jfif", ".jpe", ".jp2", ".heic", ".heif", ".avif", ".gif", ".ppm", ".pgm",
)  # fmt: skip
"""Endings of images and masks, read or not."""
_SPLITS: Final = ("train", "val", "test")
"""Folders that hold a split wherever they are."""
_ARCHIVES: Final = {"drivable": "bdd_seg_gt", "lane": "bdd_lane_gt"}
"""What the archives of the published masks call a task's folder."""

_HASH_DISTANCE: Final = 4
"""Of 64 bits: perceptual hashes this near are compared closer."""
_THUMB_DISTANCE: Final = 5.0
"""Mean difference of 16 x 16 grey thumbnails under which two pictures are nearly the same, of 255."""
_FLAT: Final = 2.0
"""Standard deviation of a thumbnail under which its picture is flat."""
_GAINS: Final = (0.6, 1.6)
"""Least and greatest factor between the contrasts of two pictures that are nearly the same."""
_SLACK: Final = 1.0
"""A box may reach out of the image by this many pixels: annotators round."""
_MIN_ANCHOR_RECALL: Final = 0.98
_EXAMPLES: Final = 5
"""Named for each kind of fault."""
_MIN_BOXES: Final = 50
"""Anchors are judged by no fewer boxes."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One kind of fault.

    Attributes:
        kind: A key of `KINDS`.
        split: Where it was found; "" = the whole data set.
        count: How often.
        examples: The first few, with the file's path from the root.
    """

    kind: str
    split: str
    count: int
    examples: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class CheckReport:
    """What `check_dataset` found.

    Attributes:
        root: The data set.
        layout: What it was taken for, in words.
        images: Split -> images.
        labelled: Split -> task -> images labelled for it.
        objects: Split -> category -> boxes (``ignored`` = crowd or an ignored category).
        conditions: Attribute -> value -> split -> images.
        sizes: ``"640x360"`` -> images.
        drivable: Split -> mean part of the image that is drivable, where labelled.
        lane: Split -> mean part of the image that is lane marking, where labelled.
        anchor_recall: Part of the boxes that an anchor fits (worst side ratio under 4); NaN without boxes.
        box_sizes: (width, height) of up to 2,000 boxes, in pixels of an image with a long side of 640.
        findings: The faults.
    """

    root: Path
    layout: str
    images: dict[str, int]
    labelled: dict[str, dict[str, int]]
    objects: dict[str, dict[str, int]]
    conditions: dict[str, dict[str, dict[str, int]]]
    sizes: dict[str, int]
    drivable: dict[str, float]
    lane: dict[str, float]
    anchor_recall: float
    box_sizes: tuple[tuple[float, float], ...]
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes."""
        content = dataclasses.asdict(self)
        content["root"] = str(self.root)
        content["anchor_recall"] = None if math.isnan(self.anchor_recall) else round(self.anchor_recall, 4)
        del content["box_sizes"]
        return {"ok": self.ok, **content}


@dataclasses.dataclass(frozen=True, eq=False)
class _Facts:
    """What is kept of one image."""

    name: str
    size: tuple[int, int] | None
    digest: bytes
    hash: int
    thumb: bytes
    labelled: tuple[str, ...]
    objects: dict[str, int]
    box_sizes: NDArray[np.float32]
    parts: dict[str, float]
    attributes: dict[str, str]
    faults: tuple[tuple[str, str], ...]


@dataclasses.dataclass(frozen=True)
class _Job:
    root: Path
    description: DatasetDescription
    table: dict[str, int]


def detect_layout(root: str | Path) -> tuple[str, str]:
    """Return what a folder looks like.

    Returns:
        ``published``, ``prepared``, ``bdd100k``, ``coco``, ``yolo``, ``cvat`` or ``unknown``; and why, in words.
    """
    root = Path(root)
    if is_prepared(root):
        return "prepared", "a prepared data set (prepared.json)"
    annotated = [folder for folder, _ in LABEL_FILES.values() if (root / folder).is_dir()]
    if (root / IMAGE_FOLDER).is_dir() and annotated:
        if not split_folders(root):
            return "unknown", "images that are in no folder of a split"
        return "published", f"the published layout ({', '.join([IMAGE_FOLDER, *annotated])})"
    if (
        any(root.glob("**/images/100k/*"))
        or any(root.glob("**/det_20"))
        or any(root.glob("**/bdd100k_labels_images_*"))
    ):
        return "bdd100k", "raw BDD100K (images/100k, labels)"
    if any(root.glob("annotations/*.json")) or any(root.glob("*/_annotations.coco.json")):
        return "coco", "COCO (annotations/*.json)"
    if (root / "data.yaml").is_file():
        return "yolo", "YOLO (data.yaml)"
    for path in sorted(root.glob("*.json")):
        if _mentions(path, b'"images"', b'"annotations"'):
            return "coco", f"COCO ({path.name})"
    if any(root.glob("*.xml")):
        return "cvat", "CVAT (.xml)"
    return "unknown", "nothing known"


def _mentions(path: Path, *words: bytes) -> bool:
    """Return whether a file holds all of the words, without reading it into memory."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return all(content.find(word) >= 0 for word in words)
    except (OSError, ValueError):  # unreadable, or empty
        return False


def check_dataset(
    root: str | Path,
    *,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Look for faults in a data set in the published layout, and count what is in it.

    Args:
        root: The data set.
        workers: Processes; 0 works in this one.
        progress: Called with (images done, images in all).

    Raises:
        DataError: If it has another layout, or a broken ``dataset.yaml``.
        MissingExtraError: If ImageHash is not installed.
    """
    import_extra("imagehash", "data")
    root = Path(root)
    check_root(root)
    layout, words = detect_layout(root)
    if layout == "prepared":
        raise DataError(f"{root}: is {words}; check the data set that it was made from")
    if layout != "published":
        cure = "" if layout == "unknown" else f"; convert it first: trilitenet data convert {layout} {root} OUT"
        raise DataError(f"{root}: looks like {words}, not the published layout (images/SPLIT, ...){cure}")
    description = read_description(root)
    job = _Job(root, description, class_table(description.class_names, description.classes, root))
    names = {
        folder.name: sorted(path.name for path in folder.iterdir() if is_image_file(path.name) and not path.is_dir())
        for folder in split_folders(root)
    }
    work = [(split, name) for split, items in names.items() for name in items]
    facts: dict[str, list[_Facts]] = {split: [] for split in names}
    for done, ((split, _), fact) in enumerate(zip(work, _run(job, work, workers), strict=True), start=1):
        facts[split].append(fact)
        if progress:
            progress(done, len(work))
    collector = _Collector()
    for split, items in facts.items():
        for fact in items:
            for kind, where in fact.faults:
                collector.add(kind, split, where)
    try:
        index = read_index(root)
    except DataError as error:
        collector.add("index", "", str(error))
        index = []
    _find_classes(job, facts, collector)
    _find_orphans(job, names, collector)
    _find_misplaced(job, facts, collector)
    _find_names(facts, collector)
    _find_duplicates(facts, collector)
    _find_near_duplicates(facts, collector)
    described = _described(index, facts)
    _find_sequences(described, collector)
    _find_unlisted(index, facts, collector)
    for name in _ego_masks(description):
        if not _is_mask(root / name):
            collector.add("ego-mask", "", name)
    for split in dict.fromkeys((*description.splits, *names)):
        if not names.get(split):
            collector.add("split-missing", split, f"{IMAGE_FOLDER}/{split}")
    box_sizes = np.concatenate(
        [np.zeros((0, 2), np.float32), *(f.box_sizes for items in facts.values() for f in items)]
    )
    recall = _anchor_recall(box_sizes)
    if len(box_sizes) >= _MIN_BOXES and recall < _MIN_ANCHOR_RECALL:
        collector.add("anchors", "", f"anchors fit {recall:.1%} of {len(box_sizes)} boxes; train with auto-anchor")
    chosen = np.random.default_rng(0).permutation(len(box_sizes))[:2000]
    return CheckReport(
        root=root,
        layout=words,
        images={split: len(items) for split, items in facts.items()},
        labelled={split: _sorted(Counter(t for f in items for t in f.labelled)) for split, items in facts.items()},
        objects={split: _sorted(sum((Counter(f.objects) for f in items), Counter())) for split, items in facts.items()},
        conditions=_conditions(described),
        sizes=_sorted(Counter(f"{f.size[1]}x{f.size[0]}" for items in facts.values() for f in items if f.size)),
        drivable=_means(facts, "drivable"),
        lane=_means(facts, "lane"),
        anchor_recall=recall,
        box_sizes=tuple((float(w), float(h)) for w, h in box_sizes[chosen]),
        findings=collector.findings(),
    )


def _ego_masks(description: DatasetDescription) -> list[str]:
    return sorted(filter(None, {description.ego_mask, *description.ego_masks.values()}))


def _is_mask(path: Path) -> bool:
    """Return whether a file can be read as a mask; OpenCV itself crashes on a path that is not UTF-8."""
    try:
        decode_mask(path.read_bytes(), "", MaskMeaning())
    except (OSError, ValueError):  # of broken files, too, and of paths that no system has
        return False
    return True


class _Collector:
    """Counts faults and keeps the first examples of each kind and split."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._examples: dict[tuple[str, str], list[str]] = defaultdict(list)

    def add(self, kind: str, split: str, example: str) -> None:
        self._counts[kind, split] += 1
        if len(self._examples[kind, split]) < _EXAMPLES:
            self._examples[kind, split].append(example)

    def findings(self) -> tuple[Finding, ...]:
        order = {kind: number for number, kind in enumerate(KINDS)}
        keys = sorted(self._counts, key=lambda key: (order[key[0]], key[1]))
        return tuple(
            Finding(kind, split, self._counts[kind, split], tuple(self._examples[kind, split])) for kind, split in keys
        )


def _run(job: _Job, work: list[tuple[str, str]], workers: int) -> Iterator[_Facts]:
    look = functools.partial(_look, job)
    if workers <= 0 or len(work) < 64:
        yield from map(look, work)
        return
    with ProcessPool(workers) as pool:
        yield from pool.map(look, work, chunksize=64)


def _look(job: _Job, work: tuple[str, str]) -> _Facts:
    """Read all that belongs to one image of a split."""
    split, file = work
    name = Path(file).stem
    tasks = job.description.tasks
    faults: list[tuple[str, str]] = []
    path = job.root / IMAGE_FOLDER / split / file
    size, digest, picture_hash, thumb = _look_at_image(path, f"{IMAGE_FOLDER}/{split}/{file}", faults)
    labelled: list[str] = []
    parts: dict[str, float] = {}
    objects: dict[str, int] = {}
    box_sizes = np.zeros((0, 2), np.float32)
    attributes: dict[str, str] = {}
    for task in LABEL_FILES:
        where = label_file(task, split, name)
        if not (job.root / where).is_file():
            continue
        if task == "detection":
            objects, box_sizes, attributes = _look_at_boxes(job, where, size, faults)
            if task in tasks:
                labelled.append(task)
        elif task in tasks:
            labelled.append(task)
            meaning = job.description.drivable if task == "drivable" else job.description.lane
            part = _look_at_mask(job.root / where, where, meaning, size, faults)
            if part is not None:
                parts[task] = part
    if not labelled:
        faults.append(("unlabelled", f"{IMAGE_FOLDER}/{split}/{file}"))
    return _Facts(
        name, size, digest, picture_hash, thumb, tuple(labelled), objects, box_sizes, parts, attributes, tuple(faults)
    )


def _look_at_image(
    path: Path, where: str, faults: list[tuple[str, str]]
) -> tuple[tuple[int, int] | None, bytes, int, bytes]:
    """Return (height, width), a digest of the file, a perceptual hash and a 16 x 16 grey thumbnail."""
    try:
        data = path.read_bytes()
    except OSError as error:
        gone = isinstance(error, FileNotFoundError) and path.is_symlink()
        reason = f"links to {path.readlink()}, which is not there" if gone else error.strerror
        faults.append(("image-unreadable", f"{where} ({reason})"))
        return None, b"", 0, b""
    digest = hashlib.blake2b(data, digest_size=12).digest()
    try:
        with open_image(io.BytesIO(data)) as image:
            size = upright_size(image)
            # JPEGs are decoded at 1/2, 1/4 or 1/8: a whole file is read, in a part of the time.
            image.draft("L", (64, 64))
            # Pillow itself would cut off what is above 255 in 16 bits.
            whole = Image.fromarray(read_image(image)) if image.mode[0] in "IF" else image
            grey = whole.convert("L").resize((64, 64), Image.Resampling.BILINEAR)
    except BROKEN as error:
        faults.append(("image-unreadable", f"{where} ({_reason(error)})"))
        return None, digest, 0, b""
    bits = np.packbits(import_extra("imagehash", "data").phash(grey).hash).tobytes()
    return size, digest, int.from_bytes(bits, "big"), grey.resize((16, 16), Image.Resampling.BOX).tobytes()


def _look_at_boxes(
    job: _Job, where: str, size: tuple[int, int] | None, faults: list[tuple[str, str]]
) -> tuple[dict[str, int], NDArray[np.float32], dict[str, str]]:
    try:
        content = parse_json((job.root / where).read_bytes())
        items = [item for frame in content["frames"] for item in (frame.get("objects") or ())]
        attributes = parse_attributes(content)
        labels = [(str(item["category"]), item.get("box2d"), is_crowd(item)) for item in items]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        faults.append(("annotation-unreadable", f"{where} ({_reason(error)})"))
        return {}, np.zeros((0, 2), np.float32), {}
    counts: Counter[str] = Counter()
    seen: set[tuple[str, float, float, float, float]] = set()
    sizes: list[tuple[float, float]] = []
    if "detection" not in job.description.tasks:
        labels = []
    for number, (category, box, crowd) in enumerate(labels):
        if box is None:
            continue
        place = f"{where} object {number} ({category})"
        if category not in job.table and category not in job.description.ignore and category not in _KNOWN_CATEGORIES:
            faults.append(("category-unknown", place))
        try:
            x1, y1, x2, y2 = (float(box[key]) for key in ("x1", "y1", "x2", "y2"))
        except (KeyError, TypeError, ValueError, OverflowError):
            faults.append(("box-invalid", place))
            continue
        if not (math.isfinite(x1 + y1 + x2 + y2) and x2 > x1 and y2 > y1):
            faults.append(("box-invalid", f"{place} {x1:g} {y1:g} {x2:g} {y2:g}"))
            continue
        if size is not None and (min(x1, y1) < -_SLACK or x2 > size[1] + _SLACK or y2 > size[0] + _SLACK):
            faults.append(("box-outside", f"{place} {x1:g} {y1:g} {x2:g} {y2:g} in {size[1]}x{size[0]}"))
        if (category, x1, y1, x2, y2) in seen:
            faults.append(("box-twice", place))
        seen.add((category, x1, y1, x2, y2))
        ignored = crowd or category in job.description.ignore
        counts["ignored" if ignored else category] += 1
        if size is not None and category in job.table and not ignored:
            scale = LONG_SIDE / max(size)
            sizes.append(((x2 - x1) * scale, (y2 - y1) * scale))
    return dict(counts), np.array(sizes, np.float32).reshape(-1, 2), attributes


def _look_at_mask(
    path: Path, where: str, meaning: MaskMeaning, size: tuple[int, int] | None, faults: list[tuple[str, str]]
) -> float | None:
    """Return the part of the mask that is foreground."""
    try:
        data = path.read_bytes()
        with open_image(io.BytesIO(data)) as picture:
            picture.load()  # which OpenCV does not refuse if it is cut short
            found = upright_size(picture)
    except BROKEN as error:
        faults.append(("mask-unreadable", f"{where} ({_reason(error)})"))
        return None
    if size is not None and found != size:
        faults.append(("mask-size", f"{where} is {found[1]}x{found[0]}, its image {size[1]}x{size[0]}"))
    try:
        grey = decode_grey(np.frombuffer(data, np.uint8), where)  # as training does: Pillow's grey of colours differs
    except DataError as error:
        faults.append(("mask-values", str(error)))
        return None
    if grey is None:
        faults.append(("mask-unreadable", f"{where} (cannot be decoded)"))
        return None
    counts = np.bincount(grey.ravel(), minlength=256)
    present = set(np.flatnonzero(counts).tolist())
    allowed = {0, *meaning.values, *meaning.ignore} if meaning.values else {*_PLAIN_VALUES, *meaning.ignore}
    if _is_invisible(present, meaning):
        faults.append(("mask-invisible", f"{where} has {_listed(present)}; foreground is above {meaning.above}"))
    elif present - allowed:
        faults.append(("mask-values", f"{where} has {_listed(present - allowed)}"))
    levels = np.arange(256)
    foreground = (levels > meaning.above) & ~np.isin(levels, meaning.ignore)
    return float(counts[foreground].sum() / counts.sum())


def _is_invisible(present: set[int], meaning: MaskMeaning) -> bool:
    """Return whether a mask has labels, all at or below the threshold, and ``dataset.yaml`` does not explain them.

    ``values`` that names none above the threshold explains nothing: one of the two is a slip.
    """
    labels = present - {0, *meaning.ignore}
    named = {*meaning.values} - {*meaning.ignore}
    hidden = labels - named if any(value > meaning.above for value in named) else labels
    return bool(hidden) and max(labels) <= meaning.above


def _find_classes(job: _Job, facts: dict[str, list[_Facts]], collector: _Collector) -> None:
    found = {category for items in facts.values() for fact in items for category in fact.objects} - {"ignored"}
    if found and not found & job.table.keys() and "detection" in job.description.tasks:
        collector.add("no-class", "", f"boxes are of {_listed(found)}; classes are of {_listed(job.table)}")


def _find_orphans(job: _Job, names: dict[str, list[str]], collector: _Collector) -> None:
    """Look for label files that belong to no image, or that are passed over for their ending."""
    root = job.root
    for folder, ending in _label_folders(job.description):
        for split in (path.name for path in split_folders(root, folder)):
            images = {Path(name).stem for name in names.get(split, ())}
            for path in sorted((root / folder / split).iterdir()):
                where = path.relative_to(root).as_posix()
                if path.name.startswith("."):
                    continue
                if path.suffix == ending:
                    if path.stem not in images:
                        collector.add("orphan", split, where)
                elif path.is_file():
                    cure = "rename it to" if path.suffix.lower() == ending else "save it as"
                    collector.add("not-read", split, f"{where} is not read; {cure} {ending}")


def _label_folders(description: DatasetDescription) -> list[tuple[str, str]]:
    """Return folder and file ending of the labels that are read; annotations hold the attributes, too."""
    return [files for task, files in LABEL_FILES.items() if task == "detection" or task in description.tasks]


def _find_misplaced(job: _Job, facts: dict[str, list[_Facts]], collector: _Collector) -> None:
    """Look for images and labels in folders that are not read, and for images of endings that are not."""
    root, about = job.root, job.description
    splits = {*_SPLITS, *about.splits, *facts}
    ego = {root / name for name in _ego_masks(about)}
    for top, ending in ((IMAGE_FOLDER, ".jpg"), *_label_folders(about)):
        for folder, found in _files_below(root / top, _PICTURES if ending in _PICTURES else (ending,)):
            names = [name for name in found if folder / name not in ego]
            where = folder.relative_to(root).as_posix()
            inside = folder.relative_to(root / top).parts
            split = next((part for part in reversed(inside) if part in splits), "")
            target = f"{top}/{split or 'SPLIT'}"
            if not inside:
                for name in names:
                    collector.add("not-read", "", f"{where}/{name} is not read; move it to {target}")
            elif len(inside) > 1 and names:
                collector.add("not-read", split, f"{where} is not read; move its files ({len(names)}) to {target}")
            elif top == IMAGE_FOLDER and len(inside) == 1:
                for name in names:
                    if not is_image_file(name):
                        collector.add("not-read", split, f"{where}/{name} is not read; save it as {ending}")
    for task, name in _ARCHIVES.items():
        labelled = any(task in fact.labelled for items in facts.values() for fact in items)
        if task in about.tasks and not labelled and (root / name).is_dir():
            own, _ = LABEL_FILES[task]
            cure = "move its folders to" if (root / own).exists() else "rename it to"
            collector.add("not-read", "", f"{name} is not read; {cure} {own}")


def _files_below(top: Path, endings: tuple[str, ...]) -> Iterator[tuple[Path, list[str]]]:
    """Yield a folder and each below it, with the names in it of these endings; hidden ones are passed over."""
    for where, folders, files in os.walk(top, followlinks=True):
        folder = Path(where)
        deep = len(folder.relative_to(top).parts) > 1  # where a link may lead back
        folders[:] = sorted(f for f in folders if not f.startswith(".") and not (deep and (folder / f).is_symlink()))
        yield folder, sorted(name for name in files if not name.startswith(".") and name.lower().endswith(endings))


def _find_names(facts: dict[str, list[_Facts]], collector: _Collector) -> None:
    for one, two in itertools.combinations(facts, 2):
        for name in sorted({f.name for f in facts[one]} & {f.name for f in facts[two]}):
            collector.add("name-in-two-splits", f"{one}, {two}", name)
    for split, items in facts.items():
        for name, count in Counter(fact.name for fact in items).items():
            if count > 1:
                collector.add("name-twice", split, name)


def _find_duplicates(facts: dict[str, list[_Facts]], collector: _Collector) -> None:
    by_digest: dict[bytes, list[tuple[str, str]]] = defaultdict(list)
    for split, items in facts.items():
        for fact in items:
            if fact.size is not None:
                by_digest[fact.digest].append((split, fact.name))
    for group in by_digest.values():
        splits = sorted({split for split, _ in group})
        for split in splits:
            names = [name for other, name in group if other == split]
            for name in names[1:]:
                collector.add("duplicate", split, f"{names[0]} = {name}")
        for one, two in itertools.combinations(splits, 2):
            pair = [next(name for other, name in group if other == split) for split in (one, two)]
            collector.add("leak-duplicate", f"{one}, {two}", f"{one}/{pair[0]} = {two}/{pair[1]}")


def _find_near_duplicates(facts: dict[str, list[_Facts]], collector: _Collector) -> None:
    readable = {split: [fact for fact in items if fact.thumb] for split, items in facts.items()}
    for one, two in itertools.combinations(readable, 2):
        if not readable[one] or not readable[two]:
            continue
        small, large = sorted((one, two), key=lambda split: len(readable[split]))
        hashes = np.array([fact.hash for fact in readable[large]], np.uint64)
        thumbs = np.stack([np.frombuffer(fact.thumb, np.uint8) for fact in readable[large]])
        for fact in readable[small]:
            near = np.flatnonzero(_popcount(hashes ^ np.uint64(fact.hash)) <= _HASH_DISTANCE)
            thumb = np.frombuffer(fact.thumb, np.uint8).astype(np.float32)
            gaps = _gaps(thumb, thumbs[near].astype(np.float32))
            # Dark or even pictures are alike in few grey levels: they must be the nearer, the flatter they are.
            for index in near[gaps < min(_THUMB_DISTANCE, 0.1 * float(thumb.std()) + 0.2)]:
                other = readable[large][index]
                if other.digest != fact.digest:
                    collector.add("leak-near-duplicate", f"{one}, {two}", f"{small}/{fact.name} ~ {large}/{other.name}")
                    break


def _gaps(thumb: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean difference of a thumbnail (P,) to each of others (N, P): as they are, or evened if that is less.

    Evened are brightness and contrast. A picture that is flat has nothing but these to tell it by.
    """
    gaps = np.abs(others - thumb).mean(axis=1)
    if thumb.std() >= _FLAT:
        thumb = thumb - thumb.mean()
        others = others - others.mean(axis=1, keepdims=True)
        gains = others @ thumb / np.maximum((others**2).sum(axis=1), 1.0)
        evened = others * np.clip(gains, *_GAINS)[:, None]
        gaps = np.minimum(gaps, np.abs(evened - thumb).mean(axis=1))
    return np.asarray(gaps)


def _popcount(values: NDArray[np.uint64]) -> NDArray[np.uint8]:
    if hasattr(np, "bitwise_count"):
        return np.asarray(np.bitwise_count(values), np.uint8)
    bits = np.unpackbits(values.view(np.uint8).reshape(-1, 8), axis=1)
    return np.asarray(bits.sum(axis=1), np.uint8)


def _described(index: list[dict[str, str]], facts: dict[str, list[_Facts]]) -> list[tuple[str, dict[str, str]]]:
    """Return the split and the attributes of each image, as reading gives them."""
    rows = {
        (row["split"], row["name"]): {key: value for key, value in row.items() if key not in {"name", "split"}}
        for row in index
    }
    return [
        (split, {**fact.attributes, **rows.get((split, fact.name), {})})
        for split, items in facts.items()
        for fact in items
    ]


def _find_sequences(described: list[tuple[str, dict[str, str]]], collector: _Collector) -> None:
    splits_of: dict[str, set[str]] = defaultdict(set)
    for split, attributes in described:
        if attributes.get("sequence"):
            splits_of[f"{attributes.get('source', '')}/{attributes['sequence']}".lstrip("/")].add(split)
    for sequence, splits in sorted(splits_of.items()):
        if len(splits) > 1:
            collector.add("leak-sequence", ", ".join(sorted(splits)), sequence)


def _find_unlisted(index: list[dict[str, str]], facts: dict[str, list[_Facts]], collector: _Collector) -> None:
    listed: dict[str, Counter[str]] = defaultdict(Counter)
    for row in index:
        listed[row["split"]][row["name"]] += 1
    for split in sorted({*listed, *facts} if index else ()):
        there = {fact.name for fact in facts.get(split, ())}
        for name in sorted(listed[split].keys() - there):
            collector.add("index", split, f"{name}: listed, no image")
        for name in sorted(there - listed[split].keys()):
            collector.add("index", split, f"{name}: not listed")
        for name, count in sorted(listed[split].items()):
            if count > 1:
                collector.add("index", split, f"{name}: listed {count} times; the last row counts")


def _conditions(described: list[tuple[str, dict[str, str]]]) -> dict[str, dict[str, dict[str, int]]]:
    """Return attribute -> value -> split -> images, for attributes with few values."""
    table: dict[str, dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    for key in {key for _, attributes in described for key in attributes}:
        for split, attributes in described:
            table[key][attributes.get(key) or UNDEFINED][split] += 1
    limit = max(2, min(40, len(described) // 3))
    return {
        key: {value: dict(sorted(counts.items())) for value, counts in sorted(values.items())}
        for key, values in sorted(table.items())
        if 1 <= len(values) <= limit
        and not all(value.replace(".", "", 1).isdigit() for value in values.keys() - {UNDEFINED})
    }


def _anchor_recall(sizes: NDArray[np.float32]) -> float:
    """Return the part of the boxes whose sides differ from some default anchor's by a factor of less than 4."""
    if not len(sizes):
        return float("nan")
    anchors = np.array(DEFAULT_ANCHORS, np.float32).reshape(-1, 2)
    return float((best_side_ratio(sizes, anchors) > 1 / 4).mean())


def _means(facts: dict[str, list[_Facts]], task: str) -> dict[str, float]:
    parts = {split: [f.parts[task] for f in items if task in f.parts] for split, items in facts.items()}
    return {split: round(float(np.mean(values)), 5) for split, values in parts.items() if values}


def _sorted(counts: Counter[str]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _listed(values: Iterable[int] | Iterable[str]) -> str:
    return few([str(value) for value in sorted(values)], most=8)


def _reason(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0] or type(error).__name__
