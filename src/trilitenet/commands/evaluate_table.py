"""Measure models in several precisions: the counterpart of the paper's table of precision levels."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from trilitenet.commands.evaluate import evaluate, hash_dataset, hash_model, known_report
from trilitenet.commands.export import PRECISIONS, check_drop, drop_frames, export, find_pictures
from trilitenet.commands.load import own_builder
from trilitenet.commands.paths import NameOrPath, SizeText, StrPath, check_writable, one_for_several
from trilitenet.commands.tables import PAPER_COLUMNS, markdown_row
from trilitenet.config import ARTEFACT_SUFFIXES, VARIANTS, Precision
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.provenance import hash_files
from trilitenet.errors import ConfigError, write_file
from trilitenet.models.weights import read_card

__all__ = ["PrecisionRow", "PrecisionTable", "evaluate_table"]

_FAIR: Final = {
    "fair/detection/ap50": "AP50 (%)",
    "fair/detection/f1": "Vehicle F1 (%)",
    "fair/drivable/miou": "Drivable mIoU (%)",
    "fair/drivable/iou": "Drivable IoU (%)",
    "fair/lane/f1_2px": "Lane F1, 2 px (%)",
    "fair/lane/iou": "Lane IoU (%)",
}


@dataclasses.dataclass(frozen=True)
class PrecisionRow:
    """One model in one precision.

    Attributes:
        model: As it was named.
        precision: What the artefact was exported for.
        runtime: What ran it, and in what it computes here: a processor without fp16 computes an fp16 artefact in fp32.
        figures: ``protocol/task/name`` -> value in [0, 1].
    """

    model: str
    precision: str
    runtime: str
    figures: dict[str, float]


@dataclasses.dataclass(frozen=True)
class PrecisionTable:
    """Models in several precisions.

    Attributes:
        rows: A model after the other; the first of each is what its others are compared with.
    """

    rows: tuple[PrecisionRow, ...]

    def _first(self, row: PrecisionRow) -> PrecisionRow:
        return next(one for one in self.rows if one.model == row.model)

    def drop(self, row: PrecisionRow) -> tuple[float, str]:
        """Return by how many points a row is at most below the first row of its model, and in which figure."""
        first = self._first(row)
        lost = {
            key: 100 * (first.figures.get(key, math.nan) - row.figures[key])
            for key in (*PAPER_COLUMNS, *_FAIR)
            if key in row.figures
        }
        lost = {key: value for key, value in lost.items() if not math.isnan(value)}  # as for a task without labels
        worst = max(lost, key=lambda key: lost[key], default="")
        return lost.get(worst, 0.0), worst

    def summary(self) -> str:
        """Return two tables in Markdown: the paper's columns by its protocol, and those of the fair one."""
        parts = ["Protocol paper, the columns of the paper's table of precision levels:", ""]
        parts += [*self._table(PAPER_COLUMNS), "", "Protocol fair:", "", *self._table(_FAIR), ""]
        for row in self.rows:
            lost, name = self.drop(row)
            if lost > 0:
                parts.append(f"{row.model} {row.precision}: loses at most {lost:.2f} points ({name})")
        return "\n".join(parts)

    def _table(self, columns: dict[str, str]) -> list[str]:
        known = {key: title for key, title in columns.items() if any(key in row.figures for row in self.rows)}
        head = ("Model", "Precision", "Runs as", *known.values())
        lines = [markdown_row(head), markdown_row(["---"] * len(head))]
        for row in self.rows:
            first = self._first(row)
            cells = []
            for key in known:
                value = row.figures.get(key, math.nan)
                if math.isnan(value):
                    cells.append("-")
                    continue
                points = 100 * (value - first.figures.get(key, math.nan))
                cells.append(f"{100 * value:.2f}" + ("" if row is first else f" ({points:+.2f})"))
            lines.append(markdown_row((row.model, row.precision, row.runtime, *cells)))
        return lines


@one_for_several
def evaluate_table(
    *models: NameOrPath,
    data: StrPath,
    output: StrPath,
    precisions: Sequence[Precision] | None = None,
    format: Literal["openvino", "onnx"] = "openvino",
    size: SizeText | None = None,
    split: str = "val",
    calibration: StrPath | None = None,
    calibration_frames: int = 500,
    max_drop: float | None = None,
    limit: int | None = None,
    network: str | None = None,
    overwrite: bool = False,
) -> PrecisionTable:
    """Export models in several precisions, measure each by both protocols, and print the paper's table of precisions.

    Artefacts and reports stay in the output folder; what is there of the same model, data, calibration frames and
    settings is not made again.

    Args:
        models: Names of shipped weights, or weight files; tiny, small and base if left out.
        data: Root folder of a data set in the published layout.
        output: Folder for artefacts and reports.
        precisions: fp32, fp16, bf16 (OpenVINO), int8; all of the format's if left out. The others are compared with
            the first.
        format: Runtime: openvino or onnx.
        size: HEIGHTxWIDTH of the input of all models, or dynamic; the size that each was trained at if left out.
        split: Split to measure on.
        calibration: Frames for INT8: a data set's train split, or a folder of pictures; by default that of --data.
        calibration_frames: At most so many of them.
        max_drop: INT8 may lose at most so many points on the val split; layers fall back until it does.
        limit: Measure on the first so many images alone.
        network: The function that built the network of those weight files that are of one of your own, with other
            widths or numbers of blocks: FILE.py:FUNCTION or MODULE:FUNCTION.
        overwrite: Make everything again.

    Returns:
        The table.

    Raises:
        ConfigError: If there is no precision, the format lacks one, or there shall be no calibration frames.
        OutputError: If the output folder cannot be written to.
    """
    output, calibration = Path(output), Path(data if calibration is None else calibration)
    precisions = PRECISIONS[format] if precisions is None else precisions
    if not precisions:
        raise ConfigError("name at least one of --precisions fp32 fp16 bf16 int8")
    for precision in precisions:
        if precision not in PRECISIONS[format]:
            raise ConfigError(
                f"{format} artefacts come as {', '.join(PRECISIONS[format])}; leave {precision} out of --precisions"
            )
    if size == "dynamic" and "int8" in precisions:
        raise ConfigError("int8 needs a fixed --size; give one, or leave int8 out of --precisions")
    if calibration_frames < 1:
        raise ConfigError(f"--calibration-frames must be at least 1, got {calibration_frames}")
    check_drop(max_drop)
    check_writable(output / "precisions.md")
    int8 = ""
    if "int8" in precisions:
        int8 = f"-{calibration_frames}-{_hash_calibration(calibration, calibration_frames, max_drop)[:12]}"
        int8 += "" if max_drop is None else f"-drop{max_drop:g}"
    rows: list[PrecisionRow] = []
    hashes: dict[tuple[str, ...], dict[str, str]] = {}  # the classes decide what labels mean
    for model in [os.fspath(model) for model in models or VARIANTS]:
        card = read_card(model)
        classes = card.class_names
        canvas = size if isinstance(size, str) else "x".join(map(str, size or card.input_size))
        if classes not in hashes:
            hashes[classes] = hash_dataset(DrivingDataset(data, split, class_names=classes), limit)
        stamp = (hash_model(model) or "")[:12]
        for precision in precisions:
            name = f"{Path(model).stem}-{stamp}-{canvas}-{precision}{int8 if precision == 'int8' else ''}"
            artefact = output / f"{name}{ARTEFACT_SUFFIXES[format]}"
            folder = output / (name if format == "openvino" else f"{name}-{format}")
            files = [artefact, *([artefact.with_suffix(".bin")] if format == "openvino" else [])]
            made = not overwrite and all(file.is_file() for file in files)
            runtime = "openvino" if format == "openvino" else "onnxruntime"
            report = None
            if made:
                report = known_report(
                    folder,
                    str(artefact),
                    functools.partial(hashes.__getitem__, classes),
                    card=card,
                    protocols=("paper", "fair"),
                    backend=runtime,
                    long_side=None if canvas == "dynamic" else max(map(int, canvas.split("x"))),
                )
            if report is None:
                stage = f"{model} {precision} ({len(rows) + 1} of {len(models or VARIANTS) * len(precisions)})"
                if not made:
                    sys.stderr.write(f"{stage}: exporting\n")
                    export(
                        model,
                        format=format,
                        output=artefact,
                        precision=precision,
                        size=canvas,
                        calibration=calibration if precision == "int8" else None,
                        calibration_frames=calibration_frames,
                        max_drop=max_drop if precision == "int8" else None,
                        masks="probability",  # the protocols decide by thresholds of their own
                        frames=data,
                        network=own_builder(model, network),
                        overwrite=True,
                    )
                sys.stderr.write(f"{stage}: measuring\n")
                report = evaluate(
                    str(artefact),
                    data=data,
                    split=split,
                    protocol="both",
                    backend=runtime,
                    output=folder,
                    resamples=0,
                    worst=0,
                    limit=limit,
                    overwrite=True,
                )
            rows.append(PrecisionRow(model, precision, report.provenance.runtime, report.values()))
    table = PrecisionTable(tuple(rows))
    write_file(output / "precisions.md", table.summary() + "\n")
    return table


def _hash_calibration(calibration: Path, frames: int, max_drop: float | None) -> str:
    """Return the SHA-256 of what decides an INT8 artefact: the frames, and the val split that a drop is measured on."""
    frames_hash = hash_files(find_pictures(calibration, frames, "train"))
    if max_drop is None:
        return frames_hash
    measured = hash_dataset(drop_frames(calibration))
    return hashlib.sha256("\n".join((frames_hash, *measured.values())).encode()).hexdigest()
