"""Train a network on labelled images, from a recipe."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, get_type_hints

import cyclopts
import torch
import yaml

from trilitenet.config import ModelCard
from trilitenet.data.loader import build_loader
from trilitenet.data.reading import DrivingDataset, sampling_weights
from trilitenet.data.transforms import TrainTransform
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.recipe import TrainConfig, merge, read_recipe
from trilitenet.engine.runtime import make_fabric
from trilitenet.engine.train import CHECKPOINT_NAME, Trainer, TrainResult
from trilitenet.errors import ConfigError, OutputError
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.losses.segmentation import SegmentationLoss
from trilitenet.models.trilitenet import TriLiteNet, build_network

__all__ = ["build_loss", "train"]

_YAML_FLAGS: Final = ("anchors", "sampling")
"""Fields whose flag takes YAML, for example --sampling '{timeofday: {night: 2}}'."""


def train(
    recipe: Path | None = None, /, *, resume: bool = False, overwrite: bool = False, **fields: Any
) -> TrainResult:
    """Train a network by a recipe; every key of the recipe is also a flag.

    Args:
        recipe: A YAML file of settings; the defaults without one.
        resume: Go on from the checkpoint in the output folder, as if the run had never stopped.
        overwrite: Start anew in an output folder that holds a run.
        **fields: Settings that replace the recipe's; see `trilitenet.engine.recipe.TrainConfig`.

    Returns:
        The run's folder, weights and figures.
    """
    config = read_recipe(recipe, _nested(fields))
    if not config.data:
        raise ConfigError("no data: give the root folder of a data set with --data")
    folder = Path(config.output)
    checkpoint = folder / CHECKPOINT_NAME
    if checkpoint.exists() and not (resume or overwrite):
        raise OutputError(f"{folder}: holds a run already; --resume it, --overwrite it, or give another --output")
    fabric = make_fabric(config.device, config.precision)
    torch.manual_seed(config.seed)

    dataset = DrivingDataset(config.data, config.train_split, class_names=config.classes)
    loader = build_loader(
        dataset,
        TrainTransform(config.input_size, config.augmentation),
        batch_size=config.batch_size,
        seed=config.seed,
        weights=sampling_weights(dataset, config.sampling) if config.sampling else None,
        samples_per_epoch=config.samples_per_epoch,
        workers=config.workers,
        pin_memory=fabric.device.type == "cuda",
    )
    names = tuple(dataset.class_names)
    network = build_network(
        config.variant,
        len(names),
        config.tasks,
        pcaa=config.pcaa,
        litepan=config.litepan,
        spp=config.spp,
        anchors=config.anchors,
    )
    card = ModelCard(
        variant=config.variant,
        class_names=names,
        tasks=network.tasks,
        blocks=network.blocks,
        input_size=config.input_size,
        training_data=(f"{Path(config.data).name}/{config.train_split}: {len(dataset)} images",),
        provenance={"recipe": recipe.name if recipe is not None else "defaults", "seed": str(config.seed)},
    )
    network.card = dataclasses.replace(card, anchors=network.card.anchors)
    trainer = Trainer(
        config,
        network,
        build_loss(config, network),
        loader,
        fabric,
        card,
        validate=_validation(config, names, str(fabric.device)),
        report=_report,
    )
    return trainer.fit(checkpoint if resume else None)


def build_loss(config: TrainConfig, network: TriLiteNet) -> MultiTaskLoss:
    """Build the loss that a recipe asks for, with the network's anchors."""
    detection = None
    if "detection" in network.tasks:
        detection = DetectionLoss(
            network.anchors,
            network.classes,
            gains=config.box_gains,
            single_class_loss=config.single_class_loss,
            label_smoothing=config.label_smoothing,
        )
    masks = [
        SegmentationLoss(*tversky, focal_alpha=config.focal[0], focal_gamma=config.focal[1])
        for tversky in (config.drivable_tversky, config.lane_tversky)
    ]
    return MultiTaskLoss(detection, *masks, weights=config.task_weights, balancing=config.balancing)


def _validation(
    config: TrainConfig, names: tuple[str, ...], device: str
) -> Callable[[TriLiteNet], Mapping[str, float]] | None:
    if not config.val_split:
        return None
    dataset = DrivingDataset(config.data, config.val_split, class_names=names)

    def validate(network: TriLiteNet) -> dict[str, float]:
        predictor = Predictor(TorchBackend(network, device))
        scores = evaluate(predictor, dataset, batch_size=8, resamples=0, worst=0).fair
        figures: dict[str, float] = {}
        if scores is None:
            return figures
        if scores.detection is not None:
            figures |= {"detection/ap50": scores.detection.ap50, "detection/recall": scores.detection.recall_all}
        if scores.drivable is not None:
            figures |= {"drivable/miou": scores.drivable.miou}
        if scores.lane is not None:
            figures |= {"lane/iou": scores.lane.as_labelled.iou, "lane/f1_2px": scores.lane.f1}
        return figures

    return validate


def _flags(config: type[Any], prefix: str = "") -> list[inspect.Parameter]:
    """Return one keyword-only parameter a field of a configuration class, its help taken from the docstring."""
    hints = get_type_hints(config)
    helps = dict(re.findall(r"^ {8}(\w+): ((?:.|\n {12})*)", config.__doc__ or "", re.M))
    flags: list[inspect.Parameter] = []
    for field in dataclasses.fields(config):
        default = field.default
        if dataclasses.is_dataclass(default) and not isinstance(default, type):
            flags += _flags(type(default), f"{prefix}{field.name}.")
            continue
        text = " ".join(helps.get(field.name, "").split())
        shown = default if default is not dataclasses.MISSING else ""
        kind = hints[field.name] if field.name not in _YAML_FLAGS else str
        name = f"{prefix}{field.name}"
        note = cyclopts.Parameter(
            name="--" + name.replace("_", "-"), help=f"{text} [default: {shown}]", show_default=False, negative=None
        )
        flags.append(
            inspect.Parameter(
                name.replace(".", "__"),
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=Annotated[kind | None, note],
            )
        )
    return flags


def _report(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


def _nested(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as a recipe holds them: no None, ``augmentation__flip`` within ``augmentation``, YAML read."""
    settings: dict[str, Any] = {}
    for name, value in fields.items():
        if value is None:
            continue
        if name in _YAML_FLAGS and isinstance(value, str):
            value = yaml.safe_load(value)
        for part in reversed(name.split("__")[1:]):
            value = {part: value}
        settings = merge(settings, {name.split("__")[0]: value})
    return settings


_own = inspect.signature(train)
train.__signature__ = _own.replace(  # type: ignore[attr-defined]
    parameters=[
        *(parameter for parameter in _own.parameters.values() if parameter.kind is not inspect.Parameter.VAR_KEYWORD),
        *_flags(TrainConfig),
    ]
)
