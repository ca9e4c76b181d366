"""Measure a model on labelled images."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Literal

from trilitenet.commands.load import load
from trilitenet.commands.paths import NameOrPath, StrPath, check_writable, one_for_several, optional_path
from trilitenet.commands.progress import show_progress
from trilitenet.config import ModelCard, Task, shipped_weights
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.evaluate import LOWEST_CONFIDENCE, EvaluatedPredictor
from trilitenet.engine.evaluate import evaluate as run_evaluation
from trilitenet.engine.predictions import PredictionWriter
from trilitenet.engine.provenance import hash_files
from trilitenet.engine.report import Report, Variation, read_report
from trilitenet.engine.robustness import corrupted_figures, figures_by_size
from trilitenet.engine.scorecard import CONDITIONS, GROUP, PAPER_THRESHOLDS
from trilitenet.errors import ConfigError, DataError, OutputError
from trilitenet.inference.backend import artefact_info
from trilitenet.inference.predictor import LONGEST_SIDE, Predictor
from trilitenet.processing.corruptions import SEVERITIES

__all__ = [
    "check_counts",
    "check_output",
    "evaluate",
    "hash_dataset",
    "hash_model",
    "known_report",
    "warn_of_unlabelled",
    "write_report",
]

_LOGGER: Final = logging.getLogger(__name__)

_PAPER_BATCH: Final = 16


@one_for_several
def evaluate(
    model: NameOrPath = "tiny",
    /,
    *,
    data: StrPath,
    split: str = "val",
    protocol: Literal["fair", "paper", "both"] = "fair",
    output: StrPath | None = None,
    save: StrPath | None = None,
    overwrite: bool = False,
    limit: int | None = None,
    resamples: int = 1000,
    worst: int = 24,
    by: Sequence[str] = CONDITIONS,
    group: str = GROUP,
    paper_batch: int = _PAPER_BATCH,
    batch_size: int = 1,
    network: str | None = None,
    device: str = "auto",
    backend: str = "auto",
    confidence: float | None = None,
    iou: float | None = None,
    drivable: float | None = None,
    lane: float | None = None,
    long_side: int | None = None,
    corruptions: bool = False,
    severities: Sequence[int] = SEVERITIES,
    resolution: Sequence[int] = (),
) -> Report:
    """Measure a model on labelled images, under the published protocol, a fair one, or both.

    Args:
        model: Name of shipped weights, a weight file, or an exported artefact of any runtime.
        data: Root folder of a data set in the published layout.
        split: Split to measure on.
        protocol: fair (native size, one confusion matrix, COCO matching), paper (as published), or both.
        output: Folder to write report.json and report.html to.
        save: Folder to write the predictions to, as `trilitenet score` reads them.
        overwrite: Replace reports and predictions that are there.
        limit: Measure on the first so many images alone.
        resamples: Bootstrap draws for the 95% intervals; 0 for none.
        worst: How many of the worst images the page shows, a task; under fair.
        by: Attributes to make tables by.
        group: Images that share this attribute, such as the frames of one drive, are drawn together for the intervals;
            "image" draws each by itself.
        paper_batch: Images a batch of the published averages.
        batch_size: At most so many images go through the network at once.
        network: The function that built a weight file's network, where it is one of your own: FILE.py:FUNCTION or
            MODULE:FUNCTION.
        device: auto, cpu, cuda, cuda:1, mps.
        backend: auto (what the file is for) or the name of a runtime.
        confidence: State precision, recall and F1 above this confidence; the model's own if left out.
        iou: A box goes when it overlaps a better one by more; the model's own if left out.
        drivable: A pixel is drivable above this probability; the model's own if left out.
        lane: A pixel is lane marking above this probability; the model's own if left out.
        long_side: The longer side of an image is resized to so many pixels; by default as in training.
        corruptions: Measure on images with the fifteen common corruptions too: fifteen more passes a severity.
        severities: Severities of the corruptions, 1 to 5.
        resolution: Measure at these longer sides of the input too.

    Returns:
        The report.

    Raises:
        ConfigError: If a count, a severity or a size is out of range, severities are given without corruptions, or an
            artefact has decided already what a protocol decides.
        OutputError: If there is a report already.
    """
    model, data, output, save = os.fspath(model), Path(data), optional_path(output), optional_path(save)
    check_counts(resamples, worst, limit, paper_batch, batch_size)
    if not severities or not set(severities) <= set(SEVERITIES):
        raise ConfigError(f"--severities must be of 1 to 5, got {', '.join(map(str, severities)) or 'none'}")
    severities = tuple(dict.fromkeys(severities))  # a mean takes each once
    if severities != SEVERITIES and not corruptions:
        raise ConfigError("--severities is for --corruptions; give both")
    check_output(output, overwrite)
    if protocol == "paper":
        _warn_of_thresholds({"confidence": confidence, "iou": iou, "drivable": drivable, "lane": lane})
    predictor = load(
        model,
        network=network,
        device=device,
        backend=backend,
        confidence=confidence,
        iou=iou,
        drivable=drivable,
        lane=lane,
        long_side=long_side,
    )
    with predictor, ExitStack() as stack:
        _check_artefact(model, predictor, protocol)
        resized = _resized(predictor, resolution)
        dataset = DrivingDataset(data, split, class_names=predictor.card.class_names)
        shown = stack.enter_context(show_progress("images"))
        warn_of_unlabelled(dataset, predictor.card.tasks)
        if "detection" in predictor.card.tasks:
            dataset.warn_of_foreign(shown)
        writer = None
        if save is not None:
            writer = stack.enter_context(PredictionWriter(save, predictor.card.tasks, overwrite=overwrite))
        report = run_evaluation(
            predictor,
            dataset,
            protocol=protocol,
            batch_size=batch_size,
            limit=limit,
            resamples=resamples,
            worst=worst,
            by=by,
            group=group,
            paper_batch=paper_batch,
            on_prediction=None if writer is None else lambda sample, prediction: writer.write(sample.name, prediction),
            progress=shown,
            about={
                "model": model,
                "model_sha256": hash_model(model),
                "data": str(data),
                "split": split,
                "data_sha256": hash_dataset(dataset, limit),
            },
        )
        variations: list[Variation] = []
        settings: dict[str, Any] = {
            "protocol": protocol,
            "batch_size": batch_size,
            "limit": limit,
            "paper_batch": paper_batch,
            "progress": shown,
        }
        if corruptions:
            variations += corrupted_figures(
                predictor, dataset, report, severities=severities, on_pass=shown.name, **settings
            )
        if resized:
            shown.name("input sizes")
            variations += figures_by_size(resized, dataset, **settings)
        report = dataclasses.replace(report, variations=tuple(variations))
    write_report(report, output)
    return report


def _warn_of_thresholds(given: Mapping[str, float | None]) -> None:
    """Warn of thresholds that were asked for and decide nothing."""
    options = [f"--{name}" for name, value in given.items() if value is not None]
    if options:
        _LOGGER.warning(
            "no figure of --protocol paper hangs on %s: it goes by confidence %g, IoU %g and the likelier class",
            ", ".join(options), PAPER_THRESHOLDS.confidence, PAPER_THRESHOLDS.iou,
        )  # fmt: skip


def warn_of_unlabelled(dataset: DrivingDataset, tasks: Sequence[Task]) -> None:
    """Warn of tasks that no image of the split is labelled for, unless ``dataset.yaml`` says so."""
    without = [task for task in tasks if task in dataset.description.tasks and not dataset.has_labels(task)]
    if without:
        folders = ", ".join(str(dataset.label_path(task, "").parent) for task in without)
        _LOGGER.warning(
            "no image of %s %s is labelled for %s: nothing in %s", dataset.root, dataset.split, ", ".join(without),
            folders,
        )  # fmt: skip


def _check_artefact(model: str, predictor: Predictor, protocol: str) -> None:
    """Refuse an artefact that has decided already what a protocol decides.

    Raises:
        ConfigError: If it has.
    """
    info = artefact_info(predictor.backend)
    if info is None:
        return
    if info.nms and "detection" in predictor.card.tasks:
        raise ConfigError(
            f"{model} suppresses boxes inside, and those under its confidence are gone; "
            "average precision needs them: export it without --nms"
        )
    thresholds = predictor.card.thresholds
    if protocol != "fair" and info.decides_masks and not thresholds.drivable == thresholds.lane == 0.5:
        raise ConfigError(
            f"{model} decides masks inside, by thresholds of its own; the 'paper' protocol takes the likelier class: "
            "export it with --masks probability"
        )


def _resized(predictor: Predictor, sides: Sequence[int]) -> dict[int, EvaluatedPredictor]:
    """Return a predictor for each longer side of the input.

    Raises:
        ConfigError: If the input's size is fixed, or a side out of range.
    """
    if not all(1 <= side <= LONGEST_SIDE for side in sides):
        raise ConfigError(f"--resolution must be of 1 to {LONGEST_SIDE}, got {', '.join(map(str, sides))}")
    if sides and predictor.backend.canvas is not None:
        height, width = predictor.backend.canvas
        raise ConfigError(
            f"this model's input is fixed to {width}x{height}; --resolution needs one that takes any size"
        )
    return {side: Predictor(predictor.backend, predictor.thresholds, long_side=side) for side in sides}


def hash_model(model: str) -> str | None:
    """Return the SHA-256 of a weight file, as ``sha256sum`` prints it, or of the files of an exported artefact."""
    path = shipped_weights().get(model) or Path(model)
    if path.is_dir():
        return hash_files(file for file in path.rglob("*") if file.is_file())
    # OpenVINO and NCNN keep weights beside the graph, NCNN the card as well; that of a plan is in the graph beside it.
    beside = {".xml": (".bin",), ".param": (".bin", ".json"), ".plan": (".onnx",)}.get(path.suffix, ())
    files = [file for file in map(path.with_suffix, beside) if file.is_file()]
    if files and path.is_file():
        return hash_files([path, *files])
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def hash_dataset(dataset: DrivingDataset, limit: int | None = None) -> dict[str, str]:
    """Return the SHA-256 of images and of the labels of each task with what they mean, of the images measured on."""
    names, about = dataset.names[:limit], dataset.description
    own_car = [dataset.root / path for path in {about.ego_mask, *about.ego_masks.values()} if path]

    def labels(task: Task) -> str:
        files = hash_files([*(dataset.label_path(task, name) for name in names), *own_car])
        return hashlib.sha256(f"{files} {dataset.meaning(task)}".encode()).hexdigest()

    return {
        "images": hash_files(dataset.image_path(index) for index in range(len(names))),
        "drivable": labels("drivable"),
        "lane": labels("lane"),
        "boxes": labels("detection"),
    }


def known_report(
    folder: Path,
    model: str,
    data_hash: Callable[[], dict[str, str]],
    *,
    card: ModelCard,
    protocols: Collection[str],
    backend: str,
    long_side: int | None = None,
) -> Report | None:
    """Return the report that is in a folder, if `evaluate` would say the same of this model and data again.

    Args:
        folder: The folder.
        model: The file.
        data_hash: Gives what `hash_dataset` does; called for a report of this file alone.
        card: Of the model, with whose thresholds it shall have been measured.
        protocols: Those that are needed, in batches of the published size.
        backend: The runtime that it shall have run on; torch is the plain network.
        long_side: The longer side of its input; the card's if left out.
    """
    path = folder / "report.json"
    if not path.is_file():
        return None
    try:
        report = read_report(path)
    except DataError:  # then it is made anew
        return None
    about = report.provenance
    runtime = about.runtime.split()
    side = max(card.input_size) if long_side is None else long_side
    same = (
        set(protocols) <= set(report.protocols)
        and ("paper" not in protocols or about.settings.get("paper_batch") == _PAPER_BATCH)
        and about.settings.get("lowest_confidence") == LOWEST_CONFIDENCE
        and about.thresholds == dataclasses.asdict(card.thresholds)
        and all(max(map(int, size.split("x"))) == side for size in about.canvas)
        and (runtime[:1] == [backend] and (backend != "torch" or "graph" not in runtime))
        and about.model_sha256 == hash_model(model)
        and about.data_sha256 == data_hash()
    )
    return report if same else None


def check_counts(
    resamples: int, worst: int = 0, limit: int | None = None, paper_batch: int = 1, batch_size: int = 1
) -> None:
    """Refuse, before hours of work, counts that are negative, and batches and a limit of no images.

    Raises:
        ConfigError: If one is.
    """
    for option, value in (("resamples", resamples), ("worst", worst)):
        if value < 0:
            raise ConfigError(f"--{option} must not be negative, got {value}; 0 is for none")
    for option, value in (("paper-batch", paper_batch), ("batch-size", batch_size)):
        if value < 1:
            raise ConfigError(f"--{option} must be at least 1, got {value}")
    if limit is not None and limit < 1:
        raise ConfigError(f"--limit must be at least 1, got {limit}; leave it out for all images")


def check_output(output: Path | None, overwrite: bool, name: str = "report") -> None:
    """Refuse, before hours of work, a folder that holds a page or JSON of this name, or cannot be written.

    Raises:
        OutputError: If it is so.
    """
    if output is None:
        return
    for file in (output / f"{name}.json", output / f"{name}.html"):
        if not overwrite and file.exists():
            raise OutputError(f"{output}: holds {file.name} already; give another folder or --overwrite")
        check_writable(file)


def write_report(report: Report, output: Path | None) -> None:
    """Write report.json and report.html into a folder."""
    if output is not None:
        report.save_json(output / "report.json")
        report.save_html(output / "report.html")
