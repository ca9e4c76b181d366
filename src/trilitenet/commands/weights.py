"""Weight files: convert published checkpoints, average and finish trained weights, see what a file says of itself."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from trilitenet.commands.evaluate import check_counts
from trilitenet.commands.load import load
from trilitenet.commands.paths import NameOrPath, StrPath, check_writable, one_for_several
from trilitenet.commands.progress import show_progress
from trilitenet.config import STRIDES, TASKS, ModelCard, check_size, parse, read_yaml
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.evaluate import BestThresholds, best_thresholds
from trilitenet.engine.evaluate import evaluate as run_evaluation
from trilitenet.engine.figures import CONDITION_FIGURES
from trilitenet.engine.report import Report
from trilitenet.errors import ConfigError, DataError, OutputError, scratch_folder
from trilitenet.models.averaging import average_networks
from trilitenet.models.weights import import_published, load_network, read_card, resolve_weights, save_network

__all__ = ["CardText", "average", "finish", "import_weights", "info"]

_LOGGER: Final = logging.getLogger(__name__)
_LOW: Final = ", 95% from"
_HIGH: Final = ", 95% to"
"""What ends the names of a figure's interval among a card's metrics."""


@dataclasses.dataclass(frozen=True)
class CardText:
    """What people have to say of weights, read from YAML by `finish`.

    Attributes:
        training_data: One line a source, with counts and licence; the training run's own lines if left out.
        licence: Licence and allowed use of the weights.
        provenance: Added to what the training run wrote: labels, hardware, hours.
        notes: What the weights are bad at, and anything a user should know.
    """

    training_data: tuple[str, ...] = ()
    licence: str | None = None
    provenance: dict[str, str] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()


def import_weights(
    source: StrPath, destination: StrPath, /, *, variant: str | None = None, overwrite: bool = False
) -> ModelCard:
    """Convert a published checkpoint (.pth) to safetensors, strictly and without running code in it.

    Args:
        source: The published checkpoint, a pickled state dict.
        destination: The .safetensors file to write.
        variant: tiny, small or base; guessed from the shapes if left out.
        overwrite: Replace an existing destination.

    Returns:
        The card written into the file.

    Raises:
        ConfigError: If the destination does not end with .safetensors.
        WeightsError: If the source is not such a checkpoint, is truncated, or holds code.
        OutputError: If the destination exists already, is the source, or cannot be written.
    """
    source, destination = Path(source), Path(destination)
    _check_destination(destination, overwrite=overwrite)
    if source.exists() and destination.exists() and source.samefile(destination):
        raise OutputError(f"{destination}: is the checkpoint itself, which would be lost; give another name")
    card = import_published(source, destination, variant)
    sys.stdout.write(f"{destination}: {card.variant}, {card.classes} class(es), from {source.name}\n")
    return card


def average(
    first: NameOrPath,
    second: NameOrPath,
    destination: StrPath,
    /,
    *,
    share: float = 0.5,
    network: str | None = None,
    overwrite: bool = False,
) -> ModelCard:
    """Write the mean of weights before and after a fine-tuning, which often keeps most of what either does better.

    Both must be of one network. The mean has the card of the second without its figures, and thresholds that are not
    fixed for it: `weights finish` measures and fixes both.

    Args:
        first: Weights before, for example tiny.
        second: Weights after, for example runs/mine/final.safetensors.
        destination: The .safetensors file to write.
        share: Of the second, 0 to 1.
        network: The function that built a weight file's network, where it is one of your own: FILE.py:FUNCTION or
            MODULE:FUNCTION.
        overwrite: Replace an existing destination.

    Returns:
        The card written into the file.

    Raises:
        ConfigError: If the destination does not end with .safetensors, or the share is not within 0 and 1.
        WeightsError: If a file is no such weights, or the two are of different networks.
        OutputError: If the destination exists already, or cannot be written.
    """
    destination = Path(destination)
    _check_destination(destination, overwrite=overwrite)
    check_writable(destination)
    mean = average_networks(load_network(first, network), load_network(second, network), share)
    files = [resolve_weights(each) for each in (first, second)]
    alike = files[0].name == files[1].name  # as of two training runs: the folder tells them apart
    names = [f"{file.absolute().parent.name}/{file.name}" if alike else file.name for file in files]
    provenance = {"mean of": f"{1 - share:g} of {names[0]}, {share:g} of {names[1]}"}
    card = dataclasses.replace(mean.card, metrics={}, provenance=mean.card.provenance | provenance)
    save_network(mean, destination, card)
    sys.stdout.write(f"{destination}: {provenance['mean of']}\n")
    return card


@one_for_several
def finish(
    source: NameOrPath,
    destination: StrPath,
    /,
    *,
    data: StrPath,
    split: str = "val",
    card: Sequence[StrPath] = (),
    input_size: tuple[int, int] | None = None,
    iou: float | None = None,
    batch_size: int = 8,
    network: str | None = None,
    full: bool = False,
    overwrite: bool = False,
) -> ModelCard:
    """Finish trained weights for use: fix the thresholds on a split, measure them there, write fp16 with the card.

    The threshold of each task is the one that does best on the split (F1 of boxes at IoU 0.5, IoU of both masks). The
    figures are those of the file as it is written, under the protocol fair, with 95% intervals by sequence, and by
    condition (weather, scene, time of day) with how many images that is.

    Args:
        source: Trained weights, for example runs/tiny/final.safetensors.
        destination: The .safetensors file to write.
        data: Root folder of a data set in the published layout.
        split: Split that the thresholds are fixed and the figures measured on.
        card: YAML files with training_data, licence, provenance and notes; the later add to the earlier.
        input_size: Height and width the weights are meant for; those of the training run if left out.
        iou: Overlap at which non-maximum suppression drops a box; the card's if left out.
        batch_size: At most so many images go through the network at once.
        network: The function that built a weight file's network, where it is one of your own: FILE.py:FUNCTION or
            MODULE:FUNCTION.
        full: Store 32-bit floats instead of fp16.
        overwrite: Replace an existing destination.

    Returns:
        The card written into the file.

    Raises:
        ConfigError: If the input size is not of multiples of 32, or the batch size below 1.
        DataError: If nothing in the split is labelled for any task.
        OutputError: If the destination exists already, or cannot be written.
    """
    destination, data = Path(destination), Path(data)
    _check_destination(destination, overwrite=overwrite)
    check_writable(destination)
    if input_size is not None:
        check_size(input_size, "--input-size")
    check_counts(0, batch_size=batch_size)
    trained = load_network(source, network)
    described = _describe(trained.card, [parse(CardText, read_yaml(path), str(path)) for path in card])
    if input_size is not None:
        described = dataclasses.replace(described, input_size=input_size)
    if iou is not None:
        described = dataclasses.replace(described, thresholds=dataclasses.replace(described.thresholds, iou=iou))
    dataset = DrivingDataset(data, split, class_names=described.class_names)
    with scratch_folder() as folder:
        draft = folder / "draft.safetensors"
        # Measured as stored: what the user loads is what the figures are of.
        save_network(trained, draft, dataclasses.replace(described, metrics={}), half=not full)
        with load(draft, network=network) as predictor, show_progress("thresholds") as shown:
            if "detection" in described.tasks:
                dataset.warn_of_foreign(shown)
            best = best_thresholds(predictor, dataset, batch_size=batch_size, progress=shown)
            _check_measured(best, described, f"{data}: nothing in {split}")
            predictor.thresholds = best.thresholds
            shown.name("figures")
            report = run_evaluation(
                predictor,
                dataset,
                batch_size=batch_size,
                worst=0,
                progress=shown,
                about={"model": str(destination), "data": str(data), "split": split},
            )
        finished = dataclasses.replace(described, thresholds=best.thresholds, metrics=_card_metrics(report, split))
        save_network(trained, destination, finished, half=not full)
    sys.stdout.write(f"{report.summary()}\nwritten to {destination}\n")
    return finished


def _card_metrics(report: Report, split: str) -> dict[str, float]:
    """Return what a card says of a report: figures, their intervals, and the foremost by condition."""
    metrics: dict[str, float] = {f"{split} images": report.provenance.images}
    for name, figure in report.figures.items():
        metrics[f"{split} {name}"] = figure.value
        if figure.low is not None and figure.high is not None:
            metrics |= {f"{split} {name}{_LOW}": figure.low, f"{split} {name}{_HIGH}": figure.high}
    for condition in report.conditions:
        where = f", {condition.attribute} {condition.value}"
        metrics[f"{split} images{where}"] = condition.images
        metrics |= {
            f"{split} {name}{where}": condition.figures[name]
            for name in CONDITION_FIGURES["fair"]
            if name in condition.figures
        }
    return {name: round(value, 4) for name, value in metrics.items() if not math.isnan(value)}


def _with_intervals(metrics: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return a line for each of a card's metrics, its interval behind it."""
    lines = []
    for name, value in metrics.items():
        low, high = metrics.get(name + _LOW), metrics.get(name + _HIGH)
        if not name.endswith((_LOW, _HIGH)):
            lines.append((name, f"{value:g}" + ("" if low is None or high is None else f" (95%: {low:g} to {high:g})")))
    return lines


def _check_destination(path: Path, *, overwrite: bool) -> None:
    if path.suffix != ".safetensors":
        raise ConfigError(f"{path}: weights end with .safetensors")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already; give another name or --overwrite")


def _check_measured(best: BestThresholds, card: ModelCard, nothing: str) -> None:
    """Warn of tasks whose thresholds stay as they are for want of labels, by a message that begins with ``nothing``.

    Raises:
        DataError: If all would.
    """
    values = dict(zip(TASKS, (best.detection_f1, best.drivable_iou, best.lane_iou), strict=True))
    without = [task for task in card.tasks if math.isnan(values[task])]
    if len(without) == len(card.tasks):
        raise DataError(f"{nothing} is labelled for {', '.join(without)}; take another --split")
    if without:
        _LOGGER.warning("%s is labelled for %s, whose threshold stays as it is", nothing, ", ".join(without))


def _describe(card: ModelCard, texts: Sequence[CardText]) -> ModelCard:
    """Add what people say to what the training run wrote."""
    for text in texts:
        card = dataclasses.replace(
            card,
            training_data=text.training_data or card.training_data,
            licence=text.licence or card.licence,
            provenance=card.provenance | text.provenance,
            notes=card.notes + text.notes,
        )
    return card


def info(file: NameOrPath, /, *, json_output: bool = False) -> ModelCard:
    """Print the card of a weight file: classes, input size, anchors, training data, metrics, licence.

    Args:
        file: A .safetensors file, or the name of shipped weights (tiny).
        json_output: Print JSON instead of text.

    Returns:
        The card.
    """
    card = read_card(file)
    if json_output:
        sys.stdout.write(json.dumps(dataclasses.asdict(card), indent=2) + "\n")  # the same in any encoding
        return card
    thresholds = card.thresholds
    lines = [
        ("file", str(resolve_weights(file))),
        ("variant", card.variant),
        ("tasks", ", ".join(card.tasks)),
        ("blocks", ", ".join(card.blocks)),
        ("classes", ", ".join(card.class_names)),
        ("input", f"{card.input_size[1]}x{card.input_size[0]} RGB, mean {card.mean}, std {card.std}"),
        *(
            (f"anchors 1/{stride}", ", ".join(f"{width:g}x{height:g}" for width, height in level))
            for stride, level in zip(STRIDES, card.anchors, strict=True)
        ),
        (
            "thresholds",
            f"box {thresholds.confidence:g} (NMS {thresholds.iou:g}), drivable {thresholds.drivable:g}, "
            f"lane {thresholds.lane:g}",
        ),
        *(("trained on", line) for line in card.training_data),
        *_with_intervals(card.metrics),
        *((name, value) for name, value in card.provenance.items()),
        ("licence", card.licence),
        *(("note", line) for line in card.notes),
    ]
    width = max(len(name) for name, _ in lines)
    sys.stdout.write("".join(f"{name:<{width}}  {value}\n" for name, value in lines))
    return card
