"""What a training run is told: one frozen dataclass, read from YAML and the command line, strictly."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

from trilitenet.config import (
    TASKS,
    Anchors,
    Task,
    check_anchors,
    check_size,
    check_tasks,
    get_variant,
    parse,
    plain,
    read_yaml,
)
from trilitenet.data.transforms import Augmentation
from trilitenet.errors import ConfigError, shown

__all__ = ["BASE_KEY", "TrainConfig", "merge", "read_recipe"]

BASE_KEY: Final = "base"
"""Key of a recipe that names another one, relative to it, whose values it takes over."""
_FORMS: Final = {"extra_data": "{OWN: 2, SCENES: 0.5}", "sampling": "{timeofday: {night: 2}}"}
"""Settings that are mappings -> how one is written."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run. The defaults are the package's own recipe; those that depart from the publication say so.

    Attributes:
        data: Root folder of a data set in the published layout, or the folder or address (https://...) of a prepared
            one.
        extra_data: Further data sets to train on, each with the weight its images are drawn by, where those of ``data``
            weigh 1, for example {OWN: 2, SCENES: 0.5}; {} for none.
        cache: Folder for copies of prepared data sets at an address; trilitenet in the user's cache (~/.cache) if left
            out.
        train_split: Split to train on.
        val_split: Split to validate on; empty for none.
        classes: Names of the detection classes; those of the data set if left out.
        sampling: Attribute -> value -> how often such an image is drawn, for example timeofday: {night: 2}; {} for all
            alike.
        samples_per_epoch: Images an epoch; all of them if left out.
        input_size: (height, width) in pixels, multiples of 32 (Section IV-A: 640x384).
        augmentation: Strengths of the random transforms.
        variant: tiny, small or base (Section III-B).
        network: A function of your own that builds the network, called as `build_network` is: FILE.py:FUNCTION or
            MODULE:FUNCTION.
        tasks: Of detection, drivable and lane.
        pcaa: With partial class activation attention.
        litepan: With LitePAN's two paths.
        spp: With spatial pyramid pooling.
        anchors: (width, height) in input pixels, three a level; the default ones if left out.
        auto_anchor: Fit the anchors to the training boxes by k-means, unless ``anchors`` are given.
        anchor_recall: ... unless so great a share of the boxes has a default anchor already; above 1 for always.
        swapped_anchors: Fit them with width and height swapped, always, as the published code does.
        init: Weight file to start from (or a shipped name); what fits by name and shape is taken over.
        freeze: Parts that stay as they are, for example encoder, or encoder.level1.
        teacher: Weight file of a network to distil from, of any variant, with the same classes where it teaches boxes;
            or a folder of any model's saved outputs on the training images, as `trilitenet evaluate --save` writes.
        distillation: Weights of distillation's detection, drivable and lane terms.
        teacher_confidence: Of a folder's boxes, those scored at least the second number are objects, those between the
            two are ignored regions.
        epochs: Passes over the data (Section IV-A: 200).
        batch_size: Images an optimiser step (Section IV-A: 16), over all processes.
        accumulate: Forward and backward passes an optimiser step; each takes batch_size / accumulate images.
        multi_scale: Range of a random factor of up to 16 on the input size, a step; none if left out.
        lr: Initial learning rate (Section IV-A: 0.001).
        betas: Of AdamW (Section IV-A: 0.937, 0.999).
        weight_decay: Of AdamW.
        decay_all: Decay biases, normalisation and slopes too, not only weights of convolutions and matrices (published
            code: on).
        final_lr: The cosine ends at this fraction of ``lr`` (published code: 0.2).
        cosine_steps: Lower the rate after each step, or after each epoch as the published code does.
        warmup_epochs: Linear warm-up takes this long, or ``warmup_steps`` if that is longer (published code: 3); 0 for
            none, whatever ``warmup_steps``.
        warmup_steps: See ``warmup_epochs`` (published code: 1000); no warm-up where that is 0.
        clip_gradient: Largest norm of the whole gradient; 0 for no limit (the publication has none).
        ema_decay: Of the moving average of the weights; 0 switches it off (published code: 0.9999).
        ema_ramp: The decay rises as 1 - exp(-updates / ramp) (published code: 2000).
        task_weights: Of the losses of detection, drivable area and lane (Section III-C: 1, 0.3, 0.3).
        balancing: fixed task weights, or learned ones (uncertainty).
        box_gains: Of the box, objectness and class terms (Section III-C: 0.05, 1.0, 0.5).
        single_class_loss: Train the class score also when there is one class (the published code does not).
        label_smoothing: Of the class targets, in [0, 1).
        drivable_tversky: alpha and beta (Section III-C: 0.7, 0.3).
        lane_tversky: alpha and beta (Section III-C: 0.9, 0.1).
        focal: alpha and gamma (Section III-C: 0.25, 2).
        validate_every: Epochs between validations; the last epoch is always validated.
        checkpoint_every: Epochs between checkpoints.
        patience: Stop after so many validations without a better mean over tasks; 0 = never.
        loggers: Of csv, tensorboard, mlflow and wandb.
        log_every: Steps between logged losses.
        pictures: Validation images in the results page, labels beside predictions.
        seed: Of weights, order and augmentation.
        output: Folder of the run.
        device: auto, cpu, cuda or mps.
        devices: Processes on this machine, a device each (more than one: distributed data-parallel).
        num_nodes: Machines, each with ``devices`` processes (start them with torchrun or SLURM).
        precision: 32-true, bf16-mixed or, on a GPU, 16-mixed; auto = bf16-mixed where the processor has it.
        compile: Compile the network (slow start, faster steps; needs a C++ compiler on a CPU).
        workers: Processes that read data ahead.
        max_steps: Stop after so many optimiser steps; 0 for no limit.
    """

    data: str = ""
    extra_data: dict[str, float] = dataclasses.field(default_factory=dict)
    cache: str | None = None
    train_split: str = "train"
    val_split: str = "val"
    classes: tuple[str, ...] | None = None
    sampling: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict)
    samples_per_epoch: int | None = None
    input_size: tuple[int, int] = (384, 640)
    augmentation: Augmentation = Augmentation()  # noqa: RUF009 - frozen, so shared safely
    variant: str = "tiny"
    network: str | None = None
    tasks: tuple[Task, ...] = TASKS
    pcaa: bool = True
    litepan: bool = True
    spp: bool = True
    anchors: Anchors | None = None
    auto_anchor: bool = False
    anchor_recall: float = 0.98
    swapped_anchors: bool = False
    init: str | None = None
    freeze: tuple[str, ...] = ()
    teacher: str | None = None
    distillation: tuple[float, float, float] = (1.0, 1.0, 1.0)
    teacher_confidence: tuple[float, float] = (0.1, 0.5)
    epochs: int = 200
    batch_size: int = 16
    accumulate: int = 1
    multi_scale: tuple[float, float] | None = None
    lr: float = 1e-3
    betas: tuple[float, float] = (0.937, 0.999)
    weight_decay: float = 0.01
    decay_all: bool = False
    final_lr: float = 0.2
    cosine_steps: Literal["step", "epoch"] = "step"
    warmup_epochs: float = 3.0
    warmup_steps: int = 1000
    clip_gradient: float = 10.0
    ema_decay: float = 0.9999
    ema_ramp: float = 2000.0
    task_weights: tuple[float, float, float] = (1.0, 0.3, 0.3)
    balancing: Literal["fixed", "uncertainty"] = "fixed"
    box_gains: tuple[float, float, float] = (0.05, 1.0, 0.5)
    single_class_loss: bool = True
    label_smoothing: float = 0.0
    drivable_tversky: tuple[float, float] = (0.7, 0.3)
    lane_tversky: tuple[float, float] = (0.3, 0.7)
    focal: tuple[float, float] = (0.25, 2.0)
    validate_every: int = 1
    checkpoint_every: int = 1
    patience: int = 0
    loggers: tuple[Literal["csv", "tensorboard", "mlflow", "wandb"], ...] = ("csv", "tensorboard")
    log_every: int = 20
    pictures: int = 6
    seed: int = 0
    output: str = "runs/train"
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    devices: int = 1
    num_nodes: int = 1
    precision: Literal["auto", "32-true", "bf16-mixed", "16-mixed"] = "auto"
    compile: bool = False
    workers: int = 2
    max_steps: int = 0

    def __post_init__(self) -> None:
        get_variant(self.variant)
        check_size(self.input_size, "input_size")
        positive = ("epochs", "batch_size", "accumulate", "validate_every", "checkpoint_every", "log_every")
        for name in (*positive, "devices", "num_nodes"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in (
            "weight_decay",
            "warmup_epochs",
            "warmup_steps",
            "clip_gradient",
            "final_lr",
            "ema_ramp",
            "workers",
            "max_steps",
            "patience",
            "pictures",
            "seed",
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must not be negative or infinite, got {getattr(self, name)}")
        if self.samples_per_epoch is not None and self.samples_per_epoch < 1:
            raise ConfigError(
                f"samples_per_epoch must be at least 1, got {self.samples_per_epoch}; leave it out for all images"
            )
        if self.seed >= 2**63:
            raise ConfigError(f"seed must be below 2**63, got {self.seed}")
        if self.batch_size % self.accumulate:
            raise ConfigError(f"batch_size {self.batch_size} is not a multiple of accumulate {self.accumulate}")
        if self.multi_scale is not None and not 0 < self.multi_scale[0] <= self.multi_scale[1] <= 16:
            raise ConfigError(f"multi_scale must be two factors up to 16, the lower first, got {self.multi_scale}")
        for name in ("task_weights", "box_gains", "drivable_tversky", "lane_tversky", "focal", "distillation"):
            if not all(0 <= value < math.inf for value in getattr(self, name)):
                raise ConfigError(f"{name} must not hold negative or infinite numbers, got {getattr(self, name)}")
        if self.focal[0] > 1:
            raise ConfigError(f"focal must be alpha in [0, 1] and gamma, got {self.focal}")
        if not self.tasks or len(set(self.tasks)) < len(self.tasks):
            raise ConfigError(f"tasks must be some of {', '.join(TASKS)}, each once, got {list(self.tasks)}")
        if self.classes is not None and not 0 < len(self.classes) == len(set(self.classes)):
            raise ConfigError(
                f"classes must be names, each once, got {list(self.classes)}; leave them out for the data's"
            )
        if not 0 <= self.teacher_confidence[0] <= self.teacher_confidence[1] <= 1:
            raise ConfigError(
                f"teacher_confidence must be two numbers in [0, 1], the lower first, got {self.teacher_confidence}"
            )
        if not 0 < self.lr < math.inf:
            raise ConfigError(f"lr must be above 0 and not infinite, got {self.lr}")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas must be in [0, 1), got {self.betas}")
        if self.anchors is not None:
            check_anchors(self.anchors)
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(f"ema_decay must be in [0, 1), got {self.ema_decay}")
        object.__setattr__(self, "tasks", check_tasks(self.tasks))  # in one order, as networks have them

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, numbers and strings, as YAML and checkpoints hold them."""
        return plain(dataclasses.asdict(self))  # type: ignore[no-any-return]


def merge(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``first`` with the values of ``second`` laid over it, mappings within mappings alike unless empty."""
    merged = dict(first)
    for key, value in second.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) and value else value
    return merged


def read_recipe(path: str | Path | None, overrides: Mapping[str, Any] | None = None) -> TrainConfig:
    """Read a recipe, with what its base gives and what the caller overrides.

    Args:
        path: A YAML file of `TrainConfig` keys; key ``base`` names another recipe to start from. None = defaults.
        overrides: Key -> value, laid over the file; mappings within mappings alike. An empty mapping, here or in a
            recipe, takes the place of what it is laid over: no extra_data, no sampling, the default augmentation.

    Raises:
        ConfigError: If it cannot be read, or on an unknown key (naming the nearest) or a wrong value.
    """
    mapping = _read(Path(path), ()) if path is not None else {}
    source = str(path) if path is not None else "train"
    settings = merge(mapping, overrides or {})
    for key, form in _FORMS.items():
        value = settings.get(key, {})
        if not isinstance(value, Mapping) or None in value.values():
            raise ConfigError(
                f"{source}: {key} is written like {form}, in quotes on the command line, got {shown(value)}"
            )
    return parse(TrainConfig, settings, source)


def _read(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    if path.resolve() in seen:
        raise ConfigError(f"{path}: is its own base, through {' -> '.join(str(p.name) for p in seen)}")
    mapping = read_yaml(path)
    base = mapping.pop(BASE_KEY, None)
    if base is None:
        return mapping
    return merge(_read(path.parent / str(base), (*seen, path.resolve())), mapping)
