"""Train a network on labelled images, from a recipe."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import json
import logging
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_type_hints

import cyclopts
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column

from trilitenet import __version__
from trilitenet.commands.load import own_builder
from trilitenet.commands.paths import StrPath, optional_path
from trilitenet.commands.progress import show_bars
from trilitenet.config import DEFAULT_ANCHORS, TASKS, ModelCard, Task, parse_yaml
from trilitenet.data.contact_sheet import as_perception
from trilitenet.data.description import folder_name
from trilitenet.data.identity import identify, parts_of
from trilitenet.data.loader import build_loader
from trilitenet.data.prepared import PreparedDataset, default_cache, is_prepared, open_dataset
from trilitenet.data.reading import DrivingDataset, MixedDataset, SampleSource, sampling_weights
from trilitenet.data.transforms import TrainTransform, Transform
from trilitenet.engine.anchors import box_sizes, fit_anchors
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.lessons import Lessons, TaughtTransform
from trilitenet.engine.loggers import build_loggers, check_loggers
from trilitenet.engine.predictions import saved_tasks
from trilitenet.engine.recipe import TrainConfig, merge, read_recipe
from trilitenet.engine.results import write_results
from trilitenet.engine.runtime import follow, running_fabric
from trilitenet.engine.train import CHECKPOINT_NAME, Trainer, TrainResult, figures_in_words, holds_run
from trilitenet.engine.transfer import check_frozen, freeze, initialise, order_classes
from trilitenet.errors import ConfigError, DataError, OutputError, TriLiteNetError, few, import_extra
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.distillation import DistillationLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.losses.segmentation import SegmentationLoss
from trilitenet.models.builders import build_by, telling
from trilitenet.models.detection import DetectionHead
from trilitenet.models.trilitenet import TriLiteNet, foreign_layers
from trilitenet.models.weights import load_network, read_card
from trilitenet.processing.addresses import as_address

__all__ = ["build_loss", "train", "training_data", "validation_figures"]

_LOGGER: Final = logging.getLogger(__name__)
_YAML_FLAGS: Final = ("anchors", "sampling", "extra_data")
"""Fields whose flag takes YAML, for example --sampling '{timeofday: {night: 2}}'."""


def train(
    recipe: StrPath | None = None, /, *, resume: bool = False, overwrite: bool = False, **fields: Any
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
    recipe = optional_path(recipe)
    if recipe is not None and not recipe.exists():
        raise ConfigError(
            f"{recipe}: no such recipe; give the path of a YAML file, such as those in recipes/ of the repository (at "
            f"version {__version__}), or of your own: `trilitenet train --help` lists every key"
        )
    config = read_recipe(recipe, _nested(fields))
    if not config.data:
        raise ConfigError("no data: give the root folder of a data set with --data")
    folder = Path(config.output)
    if holds_run(folder) and not (resume or overwrite):
        raise OutputError(
            f"{folder}: holds a run already, or files that a run would replace; --resume it, --overwrite it, or give "
            "another --output"
        )
    if config.val_split and (address := as_address(config.data)):
        raise DataError(
            f"{address}: what is at an address is prepared, and figures are measured on images as they are; give "
            "--val-split '' to train without, and measure with `trilitenet evaluate`"
        )
    if config.val_split and is_prepared(Path(config.data)):
        raise DataError(
            f"{config.data}: is prepared, and figures are measured on images as they are; give the data set that it "
            "was made of (a copy in its .prepared is used by itself), or --val-split '' to go without"
        )
    check_loggers(config.loggers)
    if "csv" in config.loggers:  # whose curves the page of results has
        import_extra("matplotlib", "train")
    with running_fabric(
        config.device,
        config.precision,
        devices=config.devices,
        num_nodes=config.num_nodes,
        command=_command(config, resume=resume, overwrite=overwrite),
    ) as fabric:
        return _train(config, fabric, recipe, resume=resume)


def _train(config: TrainConfig, fabric: Any, recipe: Path | None, *, resume: bool) -> TrainResult:
    """Train as one of the processes of a run."""
    folder = Path(config.output)
    if config.swapped_anchors and not config.auto_anchor:
        _LOGGER.warning("swapped_anchors changes nothing without auto_anchor, which fits them")
    if config.patience and not config.val_split:
        _LOGGER.warning("patience stops nothing without val_split, whose figures it watches")
    if not config.warmup_epochs and config.warmup_steps not in (0, TrainConfig.warmup_steps):
        _LOGGER.warning("warmup_steps changes nothing where warmup_epochs is 0, which is no warm-up")
    torch.manual_seed(config.seed)
    with _display(quiet=not fabric.is_global_zero) as display:
        dataset = training_data(config)
        for address in filter(None, map(as_address, (config.data, *config.extra_data))):
            display.line(f"{address}: copied to {config.cache or default_cache()}")
        for part in parts_of(dataset):
            if isinstance(part, PreparedDataset):  # before processes read: each would wait for every shard in a step
                part.copy(display.shards)
        _check_labels(config, dataset, display)
        loader = build_loader(
            dataset,
            _transform(config, dataset, display),
            batch_size=config.batch_size // config.accumulate,
            seed=config.seed,
            weights=sampling_weights(dataset, config.sampling, display.labels) if config.sampling else None,
            samples_per_epoch=config.samples_per_epoch,
            workers=config.workers,
            pin_memory=fabric.device.type == "cuda",
            share=(fabric.global_rank, fabric.world_size),
        )
        network = _network(config, dataset, display, resume=resume)
        network.card = _card(config, network, dataset, recipe)
        validation = None
        if config.val_split:
            validation = DrivingDataset(config.data, config.val_split, class_names=network.card.class_names)
            reason, tasks = _unlabelled(config, config.val_split, [validation])
            if tasks:
                _LOGGER.warning(reason)
        device = str(fabric.device)

        def validate(network: TriLiteNet, progress: Callable[[int, int], None]) -> dict[str, float]:
            assert validation is not None
            return validation_figures(network, validation, device, progress)

        trainer = Trainer(
            config,
            network,
            build_loss(config, network),
            loader,
            fabric,
            network.card,
            identity=identify(dataset),
            validate=None if validation is None else validate,
            measured_on=None if validation is None else identify(validation),
            teacher=_teacher(config, network),
            display=display,
        )
        _warn_of_warmup(config, trainer)
        with telling(config.network, running=True) if config.network is not None else contextlib.nullcontext():
            result = trainer.fit(
                folder / CHECKPOINT_NAME if resume else None,
                lambda *begin: build_loggers(config.loggers, folder, config.to_dict(), *begin),
            )
        if fabric.is_global_zero and result.finished and "csv" in config.loggers:
            predictor = Predictor(TorchBackend(trainer.averaged, device))
            write_results(
                folder / "results",
                folder / "metrics.csv",
                title=f"TriLiteNet {config.variant}: {folder_name(folder)}",
                facts={**network.card.provenance, "training data": "; ".join(network.card.training_data)}
                | figures_in_words(result.metrics),
                pictures=[] if validation is None else _pictures(predictor, validation, config.pictures),
            )
    return result


def _warn_of_warmup(config: TrainConfig, trainer: Trainer) -> None:
    """Warn of a warm-up that never ends, as a schedule for much data has on little."""
    steps = trainer.schedule.steps
    if trainer.schedule.warmup == steps:
        warmups = {
            "--warmup-epochs": round(config.warmup_epochs * trainer.epoch_steps),
            "--warmup-steps": config.warmup_steps,
        }
        flags = " and ".join(flag for flag, length in warmups.items() if length >= steps)
        _LOGGER.warning("warm-up takes the whole run (%d steps); lower %s", steps, flags)


def _command(config: TrainConfig, *, resume: bool, overwrite: bool) -> list[str]:
    """Return what starts a further process of a run, wherever the first one was called from."""
    # Ctrl-C reaches it too, and is the first one's affair from the beginning.
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    code += f"from {__name__} import _take_part; _take_part()"
    settings = {**config.to_dict(), "resume": resume, "overwrite": overwrite}
    return [sys.executable, "-c", code, json.dumps(settings)]


def _take_part() -> None:
    """Be a further process of a run; only what the first one does not say is said."""
    follow()
    logging.basicConfig(level="ERROR", format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("trilitenet.engine.guard").setLevel("WARNING")  # names the images of this process
    try:
        train(**json.loads(sys.argv[1]))
    except TriLiteNetError as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(1) from error


def training_data(config: TrainConfig) -> SampleSource:
    """Open the data that a recipe trains on."""
    # A folder of boxes alone does not tell the size of the images they are for: these are read, not a prepared copy.
    folder = None if config.teacher is None else Path(config.teacher)
    boxes_alone = folder is not None and folder.is_dir() and saved_tasks(folder) == ("detection",)
    opened = functools.partial(
        open_dataset,
        split=config.train_split,
        canvas=None if boxes_alone else config.input_size,
        mask_above=config.augmentation.mask_above,
        cache=config.cache,
    )
    first = opened(config.data, class_names=config.classes)
    if not config.extra_data:
        return first
    more = [(opened(root, class_names=first.class_names), weight) for root, weight in config.extra_data.items()]
    return MixedDataset([(first, 1.0), *more])


def _check_labels(config: TrainConfig, dataset: SampleSource, display: _Display) -> None:
    """Warn of tasks that no image is labelled for, of classes that no box is of, and of those that are not learnt.

    Raises:
        DataError: If there are no labels at all, and no teacher of any of the tasks.
    """
    parts = list(parts_of(dataset))
    reason, tasks = _unlabelled(config, config.train_split, parts, _taught(config))
    if tasks == len(config.tasks):
        raise DataError(reason)
    if tasks:
        _LOGGER.warning(reason)
    if "detection" in config.tasks:
        for part in parts:
            if isinstance(part, DrivingDataset):
                part.warn_of_foreign(display.labels)
                if config.classes is None and (others := part.classes_left_out()):
                    _LOGGER.warning(
                        "%s: boxes of %s are background, as %s has no such class; --classes says what is learnt",
                        part.root,
                        few(others, most=10),
                        config.data,
                    )


def _check_boxes(config: TrainConfig, dataset: SampleSource) -> None:
    """Refuse data without a box of a class, that anchors could be fitted to.

    Raises:
        DataError: If it is so; it names what can be trained instead.
    """
    parts, taught, others = list(parts_of(dataset)), _taught(config), set[str]()
    for part in parts:
        if isinstance(part, DrivingDataset):
            without, found = part.classes_without_boxes()
            if found and len(without) < len(part.class_names):
                return
            others |= found.difference(part.description.ignore)
    reason, cures = f"no image of {config.train_split} has a box", []
    if others:
        reason = (
            f"no box of {config.train_split} is of {' or '.join(dataset.class_names)}, but of {few(sorted(others))}"
        )
        cures.append("--classes says what is learnt")
    tasks = [task for task in config.tasks if task != "detection"]
    if left := [task for task in tasks if task in taught or any(part.has_labels(task) for part in parts)]:
        cures.append(f"--tasks {' '.join(left)} leaves detection out")
    raise DataError(f"{config.data}: {reason}{'; ' if cures else ''}{', '.join(cures)}")


def _taught(config: TrainConfig) -> frozenset[Task]:
    """Return the tasks that a teacher teaches.

    Raises:
        ConfigError: If it has none of those that are trained.
    """
    if config.teacher is None:
        return frozenset()
    folder = Path(config.teacher)
    tasks = saved_tasks(folder) if folder.is_dir() else read_card(config.teacher).tasks
    if not set(tasks) & set(config.tasks):
        raise ConfigError(f"{config.teacher}: the teacher has none of the tasks {', '.join(config.tasks)}")
    return frozenset(task for task, weight in zip(TASKS, config.distillation, strict=True) if weight and task in tasks)


def _unlabelled(
    config: TrainConfig,
    split: str,
    parts: Sequence[DrivingDataset | PreparedDataset],
    taught: Collection[Task] = (),
) -> tuple[str, int]:
    """Return which tasks no image of a split is labelled for nor taught, in words, and how many they are."""
    untaught = [task for task in config.tasks if task not in taught]
    without = [task for task in untaught if not any(part.has_labels(task) for part in parts)]
    return f"{config.data}: no image of {split} is labelled for {', '.join(without)}", len(without)


def _transform(config: TrainConfig, dataset: SampleSource, display: _Display) -> Transform:
    """Build the training transform, with a teacher's saved outputs as targets if there is a folder of them."""
    plain = TrainTransform(config.input_size, config.augmentation)
    if config.teacher is None or not Path(config.teacher).is_dir():
        return plain
    parts = list(parts_of(dataset))
    lessons = Lessons(
        Path(config.teacher),
        dataset.class_names,
        config.teacher_confidence,
        resized=any(isinstance(part, PreparedDataset) for part in parts),
        mask_above=config.augmentation.mask_above,
    )
    count = Counter(name for part in parts for name in part.names)
    names, known = count.keys(), lessons.names()
    if twice := sorted(name for name in names & known if count[name] > 1):
        raise ConfigError(
            f"{config.teacher}: outputs are found by the image's name, and several images of the training data are "
            f"called {few(twice)}; give the images names of their own"
        )
    if "detection" in _taught(config) and (unmasked := sorted(lessons.unmasked() & names)):
        raise DataError(
            f"{config.teacher}: has boxes of {few(unmasked)} but no mask of the image; every image needs a mask (an "
            "empty one where nothing is predicted), or no image any"
        )
    taught = len(names & known)
    if not taught:
        raise ConfigError(f"{config.teacher}: none of the {len(names)} training images is among the saved outputs")
    display.line(f"{config.teacher}: taught {', '.join(lessons.tasks)} on {taught} of {len(names)} images")
    return TaughtTransform(plain, lessons, config.distillation)


def _network(config: TrainConfig, dataset: SampleSource, display: _Display, *, resume: bool) -> TriLiteNet:
    """Build the network: anchors, initial weights, frozen parts."""
    anchors = config.anchors
    initial = None
    if config.init is not None and not resume:
        initial = load_network(config.init, own_builder(config.init, config.network))
    if config.auto_anchor and anchors is None and "detection" in config.tasks and not resume:
        swapped = config.swapped_anchors
        sizes = box_sizes(dataset, config.input_size, seed=config.seed, swapped=swapped, progress=display.anchors)
        enough = math.inf if swapped else config.anchor_recall
        # Weights that are taken over were trained with anchors of their own: those are kept where they fit.
        before = DEFAULT_ANCHORS if initial is None or "detection" not in initial.tasks else initial.card.anchors
        if len(sizes) or "detection" not in _taught(config):
            if not len(sizes):
                _check_boxes(config, dataset)
            fit = fit_anchors(sizes, before, enough=enough, seed=config.seed)
            display.line(fit.summary())
            anchors = fit.anchors
        else:
            display.line("anchors: kept as they are, for there is no labelled box to fit them to")
    build = functools.partial(
        build_by,
        config.network,
        config.variant,
        len(dataset.class_names),
        config.tasks,
        size=config.input_size,
        pcaa=config.pcaa,
        litepan=config.litepan,
        spp=config.spp,
        anchors=anchors,
    )
    network = build()
    if initial is not None:
        fitted = network.anchors.clone()
        _match_classes(config, initial, dataset.class_names)
        display.line(f"{config.init}: {initialise(network, initial).summary()}")
        if anchors is not None:
            network.anchors.copy_(fitted)
    if config.freeze and not resume:
        with torch.random.fork_rng(devices=()):  # a seeded run is the same with frozen parts and without
            other = build()
        if initial is not None:
            initialise(other, initial)
        check_frozen(network, other, config.freeze)
    freeze(network, config.freeze)
    return network


def _match_classes(config: TrainConfig, initial: TriLiteNet, names: Sequence[str]) -> None:
    """Put the classes of initial weights in the order of the data set's ``names``; warn where they are others.

    Raises:
        ConfigError: If a frozen head of several classes would go by other names than it has learnt, or begin at random.
    """
    told = initial.card.class_names
    frozen = any(part.partition(".")[0] == "detection" for part in config.freeze)
    if "detection" not in set(initial.tasks).intersection(config.tasks):
        return  # there is no head to take over
    if len(told) != len(names):  # it does not fit
        if frozen:
            raise ConfigError(
                f"{config.init}: its head tells {len(told)} classes, the data set has {len(names)}: a frozen detection "
                "head would stay as it begins, at random; leave it out of --freeze"
            )
        return
    own = any(layer.startswith(("detection", "the network")) for layer in foreign_layers(initial))
    if isinstance(initial.detection, DetectionHead) and not own and set(told) == set(names):
        order_classes(initial.detection, told, names)
    elif told != tuple(names):
        what = f"{config.init}: its classes are {', '.join(told)}, the data set's {', '.join(names)}"
        if frozen and len(names) > 1:
            raise ConfigError(f"{what}; a frozen detection head cannot learn them, leave it out of --freeze")
        _LOGGER.warning("%s: the detection head is taken over by place", what)


def _card(config: TrainConfig, network: TriLiteNet, dataset: SampleSource, recipe: Path | None) -> ModelCard:
    roots = [config.data, *config.extra_data]
    provenance = {"recipe": recipe.name if recipe is not None else "defaults", "seed": str(config.seed)}
    if config.network is not None:
        provenance["network"] = config.network
    if config.init is not None:
        provenance["initial weights"] = Path(config.init).name
    if config.teacher is not None:
        provenance["teacher"] = Path(config.teacher).name
    return dataclasses.replace(
        network.card,
        class_names=tuple(dataset.class_names),
        input_size=config.input_size,
        training_data=(f"{', '.join(map(folder_name, roots))} ({config.train_split}): {len(dataset)} images",),
        provenance=provenance,
    )


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


def _teacher(config: TrainConfig, network: TriLiteNet) -> tuple[TriLiteNet, DistillationLoss] | None:
    if config.teacher is None or Path(config.teacher).is_dir():
        return None
    teacher = load_network(config.teacher, own_builder(config.teacher, config.network))
    told, wanted = teacher.card.class_names, network.card.class_names
    if "detection" in teacher.tasks and "detection" in network.tasks and told != wanted and config.distillation[0]:
        raise ConfigError(
            f"{config.teacher}: the teacher tells the classes {', '.join(told)}, the data set has {', '.join(wanted)}; "
            "--distillation 0 1 1 distils the masks alone"
        )
    return teacher, DistillationLoss(network.anchors, teacher.anchors, config.distillation)


def validation_figures(
    network: TriLiteNet, dataset: DrivingDataset, device: str, progress: Callable[[int, int], None] | None = None
) -> dict[str, float]:
    """Score a network by the evaluation command's own code (the 'fair' protocol); return its figures by name.

    ``progress`` is called with how many images are scored, and of how many.
    """
    predictor = Predictor(TorchBackend(network, device))
    scores = evaluate(predictor, dataset, batch_size=8, resamples=0, worst=0, progress=progress).fair
    figures: dict[str, float] = {}
    if scores is None:
        return figures
    if scores.detection is not None:
        figures |= {"detection/recall": scores.detection.recall_all, "detection/ap50": scores.detection.ap50}
    if scores.drivable is not None:
        figures |= {"drivable/miou": scores.drivable.miou}
    if scores.lane is not None:
        figures |= {
            "lane/accuracy": scores.lane.as_labelled.balanced_accuracy,
            "lane/iou": scores.lane.as_labelled.iou,
            "lane/f1_2px": scores.lane.f1,
        }
    return figures


def _pictures(
    predictor: Predictor, dataset: DrivingDataset, count: int
) -> Iterator[tuple[str, NDArray[np.uint8], NDArray[np.uint8]]]:
    """Draw labels and predictions of images spread evenly over a data set."""
    for index in np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(int):
        sample = dataset[int(index)]
        labels = as_perception(sample, dataset.class_names)
        yield sample.name, labels.draw(), predictor(sample.image).draw(sample.image)


class _Display:
    """A bar on a terminal, lines elsewhere; both on standard error."""

    def __init__(self, progress: Progress, *, quiet: bool) -> None:
        self._progress, self._quiet = progress, quiet
        self._task = progress.add_task("", total=None, what="step")
        self._second: TaskID | None = None

    def line(self, text: str) -> None:
        """Show a line that stays."""
        if not self._quiet:
            sys.stderr.write(text + "\n")
            sys.stderr.flush()

    def step(self, step: int, steps: int, text: str) -> None:
        """Show how far the run is."""
        if self._progress.disable:
            self.line(text)
        else:
            self._progress.update(self._task, completed=step, total=steps, description=text.partition(": ")[2])

    def validation(self, images: int, count: int) -> None:
        """Show how many images the network has been measured on, and of how many."""
        self._aside("validation", images, count)

    def shards(self, done: int, count: int) -> None:
        """Show how many shards of a data set at an address are on this machine, and of how many."""
        self._aside("shards", done, count)

    def labels(self, images: int, count: int) -> None:
        """Show of how many images the annotations have been looked at, and of how many they may have to be."""
        self._aside("labels", images, count)

    def anchors(self, images: int, count: int) -> None:
        """Show of how many images the boxes have been read, and of how many they will be."""
        self._aside("boxes for anchors", images, count)

    def _aside(self, what: str, done: int, count: int) -> None:
        """Show a second bar until it is full."""
        if self._second is None:
            self._second = self._progress.add_task("", what=what)
        self._progress.update(self._second, completed=done, total=count)
        if done == count:
            self._progress.remove_task(self._second)
            self._second = None


@contextlib.contextmanager
def _display(*, quiet: bool) -> Iterator[_Display]:
    """Yield what shows a run; of the losses as much as the terminal has room for beside the rest."""
    columns = (
        TextColumn("{task.fields[what]}"),
        MofNCompleteColumn(),
        BarColumn(20),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    losses = TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True))
    with show_bars(*columns, losses, quiet=quiet, expand=True) as progress:
        yield _Display(progress, quiet=quiet)


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
        shown = default if default is not dataclasses.MISSING else "{}"
        kind = hints[field.name] if field.name not in _YAML_FLAGS else str
        name = f"{prefix}{field.name}"
        note = cyclopts.Parameter(
            name="--" + name.replace("_", "-"),
            help=f"{text} [default: {shown}]",
            show_default=False,
            negative_iterable="",
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


def _without_paths(value: Any) -> Any:
    """Return a setting with the paths in it as text, as recipes hold them."""
    if isinstance(value, Mapping):
        return {_without_paths(key): _without_paths(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_paths(item) for item in value]
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _name_in_file(function: Callable[..., Any]) -> str:
    """Return the name by which a function is found in its file; what such a name looks like, where it has none."""
    name, module = getattr(function, "__qualname__", ""), getattr(function, "__module__", None)
    file = getattr(sys.modules.get(module or ""), "__file__", None)
    if file is None or module == "__main__" or not name.isidentifier():  # that would begin the run once more
        return "FILE.py:FUNCTION"
    path, here = Path(file), Path.cwd()
    return f"{path.relative_to(here) if path.is_relative_to(here) else path}:{name}"


def _nested(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as a recipe holds them: ``augmentation__flip`` within ``augmentation``, YAML read, paths as text.

    None stands for what was not given, save where a setting may be None; one text stands for several of one.
    """
    hints = get_type_hints(TrainConfig)
    settings: dict[str, Any] = {}
    for name, value in fields.items():
        kinds = (hints.get(name), *get_args(hints.get(name)))
        if value is None and type(None) not in kinds:
            continue
        if name == "network" and callable(value):
            raise ConfigError(f"network takes a name here, which the recipe of the run holds: {_name_in_file(value)!r}")
        value = _without_paths(value)
        if name in _YAML_FLAGS and isinstance(value, str):
            value = parse_yaml(value, f"--{name.replace('__', '.').replace('_', '-')}")
        elif isinstance(value, str) and any(Ellipsis in get_args(kind) for kind in kinds):
            value = [value]
        first, *inner = name.split("__")
        for part in reversed(inner):
            value = {part: value}
        settings = merge(settings, {first: value})
    return settings


_own = inspect.signature(train)
train.__signature__ = _own.replace(  # type: ignore[attr-defined]
    parameters=[
        *(parameter for parameter in _own.parameters.values() if parameter.kind is not inspect.Parameter.VAR_KEYWORD),
        *_flags(TrainConfig),
    ]
)
