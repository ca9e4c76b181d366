"""Measure saved predictions of any model."""

from __future__ import annotations

import logging
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Final, Literal

from trilitenet.commands.evaluate import check_counts, check_output, hash_dataset, warn_of_unlabelled, write_report
from trilitenet.commands.paths import StrPath, one_for_several, optional_path
from trilitenet.commands.progress import show_progress
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.evaluate import score_predictions
from trilitenet.engine.predictions import DETECTIONS_FILE, SavedPredictions
from trilitenet.engine.provenance import hash_files
from trilitenet.engine.report import Report
from trilitenet.engine.scorecard import CONDITIONS, GROUP
from trilitenet.errors import ConfigError, DataError
from trilitenet.metrics.detection import COMMON_CONFIDENCE, is_cut_off

__all__ = ["score"]

_LOGGER: Final = logging.getLogger(__name__)


@one_for_several
def score(
    predictions: StrPath,
    /,
    *,
    data: StrPath,
    split: str = "val",
    classes: Sequence[str] = ("vehicle",),
    protocol: Literal["fair", "paper", "both"] = "fair",
    confidence: float = 0.25,
    output: StrPath | None = None,
    overwrite: bool = False,
    limit: int | None = None,
    resamples: int = 1000,
    worst: int = 24,
    by: Sequence[str] = CONDITIONS,
    group: str = GROUP,
    paper_batch: int = 16,
) -> Report:
    """Measure saved predictions of any model, on the scale of `trilitenet evaluate`.

    Args:
        predictions: Folder with detections.json (COCO results), drivable/NAME.png and lane/NAME.png, or some of them.
        data: Root folder of a data set in the published layout.
        split: Split that the predictions are for.
        classes: Detection classes; category_id 1 is the first.
        protocol: fair (native size, one confusion matrix, COCO matching), paper (as published), or both.
        confidence: State precision, recall and F1 above this confidence.
        output: Folder to write report.json and report.html to.
        overwrite: Replace a report that is there.
        limit: Measure on the first so many images alone.
        resamples: Bootstrap draws for the 95% intervals; 0 for none.
        worst: How many of the worst images the page shows, a task; under fair.
        by: Attributes to make tables by.
        group: Images that share this attribute, such as the frames of one drive, are drawn together for the intervals;
            "image" draws each by itself.
        paper_batch: Images a batch of the published averages.

    Returns:
        The report.

    Raises:
        ConfigError: If a count is negative, or the confidence out of range.
        DataError: If predictions are for none of the images, or one is broken.
        OutputError: If there is a report already.
    """
    predictions, data, output = Path(predictions), Path(data), optional_path(output)
    check_counts(resamples, worst, limit, paper_batch)
    if not 0 <= confidence <= 1:
        raise ConfigError(f"--confidence must be in [0, 1], got {confidence}")
    check_output(output, overwrite)
    dataset = DrivingDataset(data, split, class_names=tuple(classes))
    saved = SavedPredictions(predictions, classes)
    if saved.names and saved.names.isdisjoint(dataset.names):
        raise DataError(
            f"{predictions}: predictions for none of the {len(dataset)} images "
            f"(such as {min(saved.names)!r}); image_id must be the name of the image without ending"
        )
    warn_of_unlabelled(dataset, saved.tasks)
    if "detection" in saved.tasks:
        _warn_of_names(saved.names, dataset.names, limit)
        _warn_of_cut(saved.lowest, None if protocol == "paper" else confidence)
    with show_progress("images") as shown:
        if "detection" in saved.tasks:
            dataset.warn_of_foreign(shown)
        report = score_predictions(
            saved,
            dataset,
            protocol=protocol,
            confidence=confidence,
            limit=limit,
            resamples=resamples,
            worst=worst,
            by=by,
            group=group,
            paper_batch=paper_batch,
            progress=shown,
            about={
                "model": str(predictions),
                "model_sha256": hash_files(
                    [predictions / DETECTIONS_FILE]
                    + [
                        predictions / task / f"{name}.png"
                        for task in ("drivable", "lane")
                        for name in dataset.names[:limit]
                    ]
                ),
                "data": str(data),
                "split": split,
                "data_sha256": hash_dataset(dataset, limit),
            },
        )
    write_report(report, output)
    return report


def _warn_of_cut(lowest: float, confidence: float | None) -> None:
    """Warn where boxes may have been cut off, and say at which of the stated confidences nothing is known then.

    Args:
        lowest: The least confidence of all boxes.
        confidence: That precision, recall and F1 are asked for at; None where they are not, nor at the common one.
    """
    stated = {COMMON_CONFIDENCE} if confidence is None else {COMMON_CONFIDENCE, confidence}
    cut = sorted(one for one in stated if is_cut_off(lowest, one))
    if not cut:
        return
    undefined = ""
    if confidence is not None:
        undefined = f", so precision, recall and F1 at {' and '.join(f'{one:g}' for one in cut)} are undefined"
    if confidence in cut:
        undefined += " (give the model's own --confidence)"
    _LOGGER.warning(
        "%s: no box is below confidence %.2g%s; if others were cut off, average precision lacks them too",
        DETECTIONS_FILE, lowest, undefined,
    )  # fmt: skip


def _warn_of_names(predicted: Set[str], names: Sequence[str], limit: int | None) -> None:
    """Warn of boxes for images that the split lacks, and say how many of its images no box is for."""
    strays = predicted - set(names)
    if strays:
        _LOGGER.warning(
            "%s: boxes of %d images are left out, for the split has none of that name (such as %r); image_id must be "
            "the name of the image without ending", DETECTIONS_FILE, len(strays), min(strays),
        )  # fmt: skip
    measured = names[:limit]
    empty = len(set(measured) - predicted)
    if empty:
        _LOGGER.warning(
            "%s: no box for %d of %d images, which count as seen empty", DETECTIONS_FILE, empty, len(measured)
        )
