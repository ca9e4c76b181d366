"""``trilitenet data``: convert, check, show and prepare data sets."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import cv2
from cyclopts import Parameter
from rich.table import Table

from trilitenet.commands.paths import NameOrPath, StrPath, check_writable, one_for_several, optional_path
from trilitenet.commands.progress import show_progress
from trilitenet.data.check_page import check_page, picture_page
from trilitenet.data.checking import KINDS, CheckReport, check_dataset, detect_layout
from trilitenet.data.contact_sheet import alternative_area, caption, contact_sheet, draw_sample, pick, thumbnail
from trilitenet.data.converting import ConversionOptions, ConversionReport
from trilitenet.data.converting import convert as run_conversion
from trilitenet.data.description import DatasetDescription, folder_name
from trilitenet.data.prepared import CACHE_FOLDER, is_prepared
from trilitenet.data.prepared import prepare as run_preparation
from trilitenet.data.reading import UNDEFINED, DrivingDataset, check_root, split_folders
from trilitenet.data.records import RecordSource
from trilitenet.engine.report import render
from trilitenet.errors import ConfigError, DataError, OutputError, did_you_mean, few, write_file
from trilitenet.formats.readers.bdd100k import read_bdd100k
from trilitenet.formats.readers.coco import read_coco
from trilitenet.formats.readers.cvat import read_cvat
from trilitenet.formats.readers.mapping import LabelMapping, read_mapping
from trilitenet.formats.readers.masks import read_masks
from trilitenet.formats.readers.yolo import read_yolo
from trilitenet.processing.cores import usable_cores
from trilitenet.processing.letterbox import Letterbox

__all__ = ["Checked", "Converted", "Prepared", "Shown", "check", "convert", "prepare", "show"]

Kind = Literal["bdd100k", "coco", "yolo", "cvat", "masks"]

_KEYS: Final[dict[str, tuple[Kind, ...]]] = {
    "missing": ("coco", "yolo", "cvat"),
    "drivable": ("coco", "yolo", "cvat"),
    "alternative": ("coco", "yolo", "cvat"),
    "lane": ("coco", "yolo", "cvat"),
    "lane_edges": ("cvat",),
    "tasks": ("coco", "yolo", "cvat", "masks"),
    "split": ("coco", "cvat", "masks"),
    "splits": ("masks",),
    "images": ("masks",),
    "drivable_mask": ("masks",),
    "lane_mask": ("masks",),
}
"""Keys of the file of --classes that some formats do not take -> those that do."""


@dataclasses.dataclass(frozen=True)
class Converted:
    """What `convert` did.

    Attributes:
        output: The data set written.
        found: What was found in the source.
        report: Counts of what was written and what was left out.
    """

    output: Path
    found: tuple[str, ...]
    report: ConversionReport

    @property
    def errors(self) -> tuple[str, ...]:
        """Why the data set is of no use, in a line; none if it has a label."""
        if not any(self.report.images.values()):
            return (f"{self.output}: no image was written; see above what was found and why it was left out",)
        if not any(self.report.labelled.values()):
            return (
                f"{self.output}: no image is labelled; see above what was found, "
                "add missing label files, or say what names and values mean with --classes FILE (docs/data.md)",
            )
        return ()

    @property
    def exit_code(self) -> int:
        """1 if there is no image, or none with a label."""
        return int(bool(self.errors))

    def summary(self) -> str:
        """Return what was found, written and left out, for people."""
        table = Table("split", "images", "detection", "drivable", "lane", "boxes", "markings")
        for split in self.report.images:
            table.add_row(*_counts(self.report, split), _listed(self.report.lanes[split]))
        lines = [*self.found, render([table])]
        if any("masks" in lanes for lanes in self.report.lanes.values()):
            lines.append("lane masks keep the width they are drawn in; --lane-width is for lines")
        for split, reasons in self.report.dropped.items():
            lines += [f"{split}: left out {count} x {reason}" for reason, count in reasons.items()]
        return "\n".join([*lines, f"written to {self.output}"])


@one_for_several
def convert(
    source: NameOrPath,
    output: StrPath,
    target: StrPath | None = None,
    /,
    *,
    kind: Annotated[Kind | None, Parameter(name="--from")] = None,
    classes: StrPath | None = None,
    splits: Sequence[str] = (),
    lane_width: Sequence[str] = (),
    crosswalk: bool = False,
    vertical: bool = False,
    pair_edges: bool = True,
    max_gap: float = 40.0,
    keep_alternative: bool = False,
    images: Literal["link", "copy", "symlink"] = "link",
    workers: int = 0,
) -> Converted:
    """Convert a foreign data set to the published layout.

    ``trilitenet data convert bdd100k RAW OUT`` and ``trilitenet data convert --from coco DIR OUT`` are the two ways to
    say it. A conversion that was interrupted goes on where it stood; run again, it changes nothing. Exits 1 when no
    image was written, or none with a label.

    Args:
        source: What it is (bdd100k, coco, yolo, cvat, masks), or with --from the folder or annotation file itself.
        output: The folder or file to convert; with --from, the folder to write.
        target: The folder to write.
        kind: What the source is, if it is not the first word.
        classes: A YAML file with ``classes:`` (class name to categories), and for formats other than BDD100K what the
            other names and mask values mean; see docs/data.md.
        splits: Convert these splits alone. They come after the folders.
        lane_width: Width of lane markings in pixels of a 1280-pixel wide image, for all splits (``4``) or one
            (``train=8``); 8 for train and 2 for others if left out. Markings that come as masks keep theirs.
        crosswalk: Draw crosswalks as lane markings.
        vertical: Draw markings across the road (stop lines) as lane markings.
        pair_edges: Join the two edges that BDD100K draws of a marking into its centre line.
        max_gap: Edges further apart than this, in pixels of a 1280-pixel wide image, are two markings.
        keep_alternative: Keep alternative drivable areas apart, as mask value 127; training merges them.
        images: Hard-link images (or copy, where that is impossible), copy them, or point symbolic links at them.
        workers: Processes to share the work; one for each processor if 0.

    Raises:
        ConfigError: If the arguments or the YAML file are wrong.
        DataError: If the source cannot be read.
        OutputError: If the output holds something else.
    """
    chosen, raw, out = _arguments(str(source), output, target, kind)
    mapping = read_mapping(classes)
    options = ConversionOptions(
        classes=mapping.classes,
        ignore=mapping.ignore,
        lane_width=_widths(lane_width),
        crosswalk=crosswalk,
        vertical=vertical,
        pair_edges=pair_edges,
        max_gap=max_gap,
        keep_alternative=keep_alternative,
        images=images,
    )
    with show_progress("reading the labels"):
        records = _open_source(chosen, raw, mapping, options)
    unknown = {item.rpartition("=")[0] for item in lane_width} - {"", "*", *records.splits}
    if unknown:
        raise ConfigError(f"--lane-width names no split {min(unknown)!r}; there are {', '.join(records.splits)}")
    description = DatasetDescription(name=mapping.name, licence=mapping.licence, source=f"{chosen}: {folder_name(raw)}")
    with show_progress("images") as advance:
        report = run_conversion(
            records,
            out,
            options,
            splits=splits or None,
            workers=_workers(workers),
            description=description,
            progress=advance,
        )
    return Converted(out, records.found, report)


@dataclasses.dataclass(frozen=True)
class Checked:
    """What `check` found.

    Attributes:
        report: Faults and counts.
        files: The reports written.
    """

    report: CheckReport
    files: tuple[Path, ...]

    @property
    def exit_code(self) -> int:
        """1 if anything is wrong."""
        return int(not self.report.ok)

    def summary(self) -> str:
        """Return tables of what is there and what is wrong, for people."""
        report = self.report
        counts = Table("split", "images", "detection", "drivable", "lane", "boxes")
        for split in report.images:
            counts.add_row(*_counts(report, split))
        lines = [f"{report.root}: taken for {report.layout}", render([counts])]
        few = {key: values for key, values in report.conditions.items() if len(values) <= 12}
        for key, values in few.items():
            lines.append(f"{key}: " + ", ".join(f"{value} {sum(n.values())}" for value, n in values.items()))
        recall = "no boxes" if math.isnan(report.anchor_recall) else f"{report.anchor_recall:.2%}"
        lines.append(f"best possible recall of the anchors: {recall}")
        if report.findings:
            faults = Table("kind", "split", "count", "what", "for example")
            for finding in report.findings:
                faults.add_row(
                    finding.kind, finding.split, str(finding.count), KINDS[finding.kind], finding.examples[0]
                )
            lines.append(render([faults]))
        else:
            lines.append("nothing wrong")
        return "\n".join([*lines, *(f"written: {path}" for path in self.files)])


def check(
    root: StrPath,
    *,
    json_file: Annotated[StrPath | None, Parameter(name="--json")] = None,
    html: StrPath | None = None,
    pictures: int = 24,
    workers: int = 0,
) -> Checked:
    """Look for faults in a data set, and count what is in it; exits 1 when something is wrong.

    Args:
        root: A data set in the published layout; another one is named, with the command that converts it.
        json_file: Write the report as JSON.
        html: Write the report as a page with plots and a contact sheet.
        pictures: How many images the page shows.
        workers: Processes to share the work; one for each processor if 0.

    Raises:
        DataError: If the layout is not the published one.
        OutputError: If a report cannot be written: as far as can be told, before the work begins.
        MissingExtraError: If the extra ``data`` is not installed.
    """
    json_file, html = optional_path(json_file), optional_path(html)
    for file in filter(None, (json_file, html)):
        check_writable(file)
    with show_progress("images") as advance:
        report = check_dataset(root, workers=_workers(workers), progress=advance)
    files: list[Path] = []
    if json_file is not None:
        write_file(json_file, json.dumps(report.to_dict(), indent=1, ensure_ascii=False))
        files.append(json_file)
    if html is not None:
        write_file(html, check_page(report, _some_pictures(report, pictures)))
        files.append(html)
    return Checked(report, tuple(files))


@dataclasses.dataclass(frozen=True)
class Shown:
    """What `show` wrote.

    Attributes:
        output: The picture or page.
        count: Images on it.
    """

    output: Path
    count: int

    def summary(self) -> str:
        """Return one line for people."""
        return f"{self.count} image{'' if self.count == 1 else 's'} on {self.output}"


@one_for_several
def show(
    root: StrPath,
    output: StrPath,
    *,
    split: str = "",
    where: Sequence[str] = (),
    count: int = 24,
    start: int = 0,
    seed: int = 0,
    columns: int = 4,
    width: int = 320,
) -> Shown:
    """Draw images with their labels on a contact sheet (.jpg, .png) or a page (.html).

    Only the images shown are read, and the annotations of those looked at for a condition, so it is quick for any
    number of images.

    Args:
        root: A data set in the published layout.
        output: The picture or page to write.
        split: Show this split; all if left out.
        where: Only images with an attribute, for example ``timeofday=night`` or ``source=city``, or without it
            (``timeofday=undefined``); all must hold.
        count: How many images a split.
        start: Leave out the first so many: the next sheet of the same seed.
        seed: Of the random order.
        columns: Images a row of a contact sheet; a page takes as many as fit.
        width: Of each image in pixels; on a page at least 480.

    Raises:
        DataError: If there is no such split, or no such image.
        OutputError: If the ending of ``output`` is none of these.
    """
    root, output = Path(root), Path(output)
    if output.suffix.lower() not in {".jpg", ".jpeg", ".png", ".html"}:
        raise OutputError(f"{output}: must end in .jpg, .png or .html")
    numbers = (
        ("count", count, 1),
        ("columns", columns, 1),
        ("width", width, 16),
        ("seed", seed, 0),
        ("start", start, 0),
    )
    for option, value, least in numbers:
        if value < least:
            raise ConfigError(f"{option} must be at least {least}, got {value}")
    wanted = _conditions(where)
    datasets = {name: DrivingDataset(root, name) for name in ([split] if split else _splits(root))}
    # Of an attribute that no image has, a slip as a rule, none is without it.
    slips = [key for key, value in wanted.items() if value == UNDEFINED and not _is_known(key, datasets.values())]
    groups = {}
    for name, dataset in datasets.items():
        indices = [] if slips else pick(dataset, wanted, count, seed=seed, start=start)
        if indices:
            groups[name] = (dataset, indices)
    if not groups:
        which = f" with {', '.join(where)}" if where else ""
        after = f" after the first {start}" if start else ""
        known: dict[str, set[str]] = {}
        for dataset in datasets.values():
            for index in range(len(dataset)):
                for key, held in dataset.attributes(index).items():
                    known.setdefault(key, set()).add(held)
        raise DataError(f"{root}: no image{which}{after} in {split or 'any split'}{_what_is_unknown(wanted, known)}")
    shown = sum(len(indices) for _, indices in groups.values())
    if output.suffix.lower() == ".html":
        pictures = {
            f"{name}: {len(indices)} of {len(dataset)}": _all_fitted(dataset, indices, max(width, 480))
            for name, (dataset, indices) in groups.items()
        }
        write_file(output, picture_page(f"{folder_name(root)} {' '.join(where)}".strip(), pictures))
    else:
        thumbnails = [
            _thumbnail(dataset, index, (width * 9 // 16, width), split=name if len(groups) > 1 else "")
            for name, (dataset, indices) in groups.items()
            for index in indices
        ]
        sheet = contact_sheet(thumbnails, columns=columns)
        done, data = cv2.imencode(output.suffix, cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
        if not done:
            raise OutputError(f"{output}: a sheet of {sheet.shape[1]}x{sheet.shape[0]} pixels cannot be encoded")
        write_file(output, data.tobytes())
    return Shown(output, shown)


@dataclasses.dataclass(frozen=True)
class Prepared:
    """What `prepare` wrote.

    Attributes:
        output: The prepared data set.
        images: Split -> images.
        size: Bytes on disk.
        by_itself: Whether loading finds it by itself.
    """

    output: Path
    images: dict[str, int]
    size: int
    by_itself: bool

    def summary(self) -> str:
        """Return a line for people."""
        counts = ", ".join(f"{count} {split}" for split, count in self.images.items())
        use = "training uses it by itself"
        if not self.by_itself:
            use = "to train on it, give it as --data with --val-split ''"
        return f"{counts} in {self.output} ({self.size / 2**20:.1f} MiB); {use}"


@one_for_several
def prepare(
    root: StrPath,
    output: StrPath | None = None,
    *,
    size: tuple[int, int] = (384, 640),
    splits: Sequence[str] = (),
    classes: Sequence[str] = (),
    images: Literal["jpeg", "raw"] = "raw",
    quality: int = 95,
    mask_above: int = 1,
    shard_size: int = 1000,
    workers: int = 0,
) -> Prepared:
    """Pack a data set at training resolution into WebDataset shards, which training reads several times as fast.

    Shards that are there and up to date are kept.

    Args:
        root: A data set in the published layout.
        output: Folder to write; ``.prepared`` in the data set if left out, where training finds it by itself.
        size: Height and width that training will use.
        splits: Prepare these splits alone. They come after OUTPUT.
        classes: Detection classes, each of some box; those of the data set if left out. They come after OUTPUT.
        images: ``raw`` gives training exactly the same pixels, and is quickest; ``jpeg`` takes a sixth of the room.
        quality: Of the JPEGs, of 100.
        mask_above: A resized mask pixel above this, of 255, is foreground; the published rule is 1.
        shard_size: Images a shard.
        workers: Processes to share the work; one for each processor if 0.

    Raises:
        DataError: If the data set is broken.
        OutputError: If the output holds something else, or was made with other settings.
    """
    with show_progress("images") as advance:
        counts = run_preparation(
            root,
            output,
            canvas=size,
            class_names=tuple(classes) or None,
            splits=splits or None,
            images=images,
            quality=quality,
            mask_above=mask_above,
            shard_size=shard_size,
            workers=_workers(workers),
            progress=advance,
        )
    folder = Path(root, CACHE_FOLDER) if output is None else Path(output)
    total = sum(path.stat().st_size for path in folder.iterdir())
    return Prepared(folder, counts, total, by_itself=output is None)


def _arguments(source: str, output: StrPath, target: StrPath | None, kind: str | None) -> tuple[str, str, Path]:
    """Return (kind, what to convert, where to) of either way to say it."""
    if kind is None:
        if target is None:
            raise ConfigError("say `data convert KIND SOURCE OUTPUT` or `data convert --from KIND SOURCE OUTPUT`")
        kind, source, output = source, str(output), target
    elif target is not None:
        raise ConfigError("with --from, give SOURCE and OUTPUT alone")
    if kind not in get_args(Kind):
        raise ConfigError(f"unknown kind of data set {kind!r}; known: {', '.join(get_args(Kind))}")
    return kind, source, Path(output)


def _open_source(kind: str, raw: str, mapping: LabelMapping, options: ConversionOptions) -> RecordSource:
    default = LabelMapping()
    for key, kinds in _KEYS.items():
        if kind not in kinds and getattr(mapping, key) != getattr(default, key):  # it would be taken for heard
            raise ConfigError(f"{key!r} in the file of --classes is for {', '.join(kinds)}; leave it out for {kind}")
    if kind == "bdd100k":
        return read_bdd100k(raw, crosswalk=options.crosswalk, vertical=options.vertical)
    readers: dict[str, Callable[[str, LabelMapping], RecordSource]] = {
        "coco": read_coco,
        "yolo": read_yolo,
        "cvat": read_cvat,
        "masks": read_masks,
    }
    return readers[kind](raw, mapping)


def _widths(items: Sequence[str]) -> dict[str, float]:
    widths: dict[str, float] = {}
    for item in items:
        split, _, text = item.rpartition("=")
        try:
            width = float(text)
        except ValueError as error:
            raise ConfigError(f"lane width must be a number or SPLIT=number, got {item!r}") from error
        if not (math.isfinite(width) and width > 0):
            raise ConfigError(f"lane width must be above 0 and finite, got {item!r}")
        widths[split or "*"] = width
    return widths if "*" in widths else {"train": 8.0, "*": 2.0, **widths}


def _conditions(where: Sequence[str]) -> dict[str, str]:
    """Return attribute -> wanted value."""
    wanted: dict[str, str] = {}
    for item in where:
        key, equals, value = item.partition("=")
        if not equals:
            raise ConfigError(f"--where wants ATTRIBUTE=VALUE, got {item!r}")
        if wanted.setdefault(key, value) != value:  # all must hold, and an image has one of them
            raise ConfigError(f"--where wants one value of an attribute, got {key}={wanted[key]} and {item}")
    return wanted


def _is_known(attribute: str, datasets: Iterable[DrivingDataset]) -> bool:
    """Return whether an image has the attribute; looks up to the first."""
    return any(attribute in dataset.attributes(index) for dataset in datasets for index in range(len(dataset)))


def _what_is_unknown(wanted: Mapping[str, str], known: Mapping[str, Collection[str]]) -> str:
    """Return the first attribute, or the first value, that no image has, and what was perhaps meant."""
    for key in wanted:
        if key not in known:
            return f": none has the attribute {key!r}{did_you_mean(key, known)}"
    for key, value in wanted.items():
        if value not in known[key]:
            near = did_you_mean(value, known[key])
            hint = near if near.endswith("?") else f"; known: {few(sorted(known[key]), most=10)}"
            return f": none has {key} {value!r}{hint}"
    return ""


def _splits(root: Path) -> list[str]:
    check_root(root)
    if is_prepared(root):
        raise DataError(f"{root}: is a prepared data set; show the one that it was made from")
    splits = [path.name for path in split_folders(root)]
    if not splits:
        raise DataError(f"{root}: looks like {detect_layout(root)[1]}, not the published layout (images/SPLIT, ...)")
    return splits


def _some_pictures(report: CheckReport, count: int) -> Any:
    """Return a contact sheet of readable images, from all splits alike."""
    thumbnails = []
    for split in report.images if count > 0 else ():
        with contextlib.suppress(DataError):  # of a split that cannot be read, as the report tells
            dataset = DrivingDataset(report.root, split)
            for index in pick(dataset, {}, max(1, count // len(report.images))):
                with contextlib.suppress(DataError):
                    thumbnails.append(_thumbnail(dataset, index, split=split if len(report.images) > 1 else ""))
    return contact_sheet(thumbnails) if thumbnails else None


def _thumbnail(dataset: DrivingDataset, index: int, size: tuple[int, int] = (180, 320), *, split: str) -> Any:
    return thumbnail(
        dataset[index], dataset.class_names, size, split=split, alternative=alternative_area(dataset, index)
    )


def _all_fitted(dataset: DrivingDataset, indices: Iterable[int], width: int) -> Iterator[tuple[str, Any]]:
    """Yield captions and drawn images one by one: a page needs but one of them at a time."""
    for index in indices:
        sample = dataset[index]
        box = Letterbox.fit(sample.size, long_side=width, stride=1)
        drawn = draw_sample(sample, dataset.class_names, alternative_area(dataset, index))
        yield caption(sample), box.image(drawn)


def _workers(workers: int) -> int:
    count = workers or usable_cores()
    return 0 if count == 1 else count


def _counts(report: ConversionReport | CheckReport, split: str) -> tuple[str, ...]:
    """Return cells of a table: the split, its images, those labelled for each task, and boxes."""
    labelled = (str(report.labelled[split].get(task, 0)) for task in ("detection", "drivable", "lane"))
    return split, str(report.images[split]), *labelled, _listed(report.objects[split])


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
