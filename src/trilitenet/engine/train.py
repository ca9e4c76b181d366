"""The training loop (Section IV-A, Algorithm 1): network, data, loss and validation are passed in."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import torch
import yaml
from torch import Tensor, nn

from trilitenet.config import TASKS, ModelCard, Task
from trilitenet.data.batches import Batch
from trilitenet.data.identity import tell_apart
from trilitenet.data.loader import WORKER_LOST
from trilitenet.engine.checkpoint import random_state, read_checkpoint, set_random_state, write_checkpoint
from trilitenet.engine.ema import MovingAverage
from trilitenet.engine.guard import FiniteGuard
from trilitenet.engine.loggers import RunEnd, RunLogger
from trilitenet.engine.optim import Schedule, build_optimiser
from trilitenet.engine.recipe import TrainConfig
from trilitenet.engine.rescale import draw_size, rescale
from trilitenet.engine.runtime import StopRequest, hosts_group, putting_off
from trilitenet.engine.transfer import keep_frozen
from trilitenet.errors import (
    ConfigError,
    DataError,
    OutputError,
    TrainingError,
    WeightsError,
    brief,
    gist,
    write_file,
    writing,
)
from trilitenet.losses.distillation import DistillationLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.models.trilitenet import TriLiteNet, normalise_images
from trilitenet.models.weights import read_card, save_network
from trilitenet.processing.memory import lacks_memory

__all__ = ["CHECKPOINT_NAME", "FIGURES", "TrainResult", "Trainer", "figures_in_words", "holds_run"]


CHECKPOINT_NAME: Final = "last.ckpt"
"""The checkpoint in the run's folder that `--resume` continues from."""

_RESULTS: Final = (CHECKPOINT_NAME, "final.safetensors", "best-*.safetensors")
_TRACES: Final = ("config.yaml", "metrics.csv", "loggers.json", "results", "tensorboard")

FIGURES: Final = {"detection": "detection/ap50", "drivable": "drivable/miou", "lane": "lane/iou"}
"""The figure each task is judged by; the mean of these is the overall one."""

_TERMS: Final[Mapping[Task, tuple[str, ...]]] = {
    "detection": ("box", "objectness", "classification"),
    "drivable": ("drivable_focal", "drivable_tversky"),
    "lane": ("lane_focal", "lane_tversky"),
}
"""Each task's part of `trilitenet.losses.multitask.LossTerms`."""

SAME_ON_RESUME: Final = (
    "variant",
    "network",
    "tasks",
    "pcaa",
    "litepan",
    "spp",
    "batch_size",
    "accumulate",
    "balancing",
    "freeze",  # with `decay_all` it says which parameters the optimiser's state is of, which goes by their place
    "decay_all",
)
"""Settings that a checkpoint must share with the run that resumes it."""
_OF_THE_RUN: Final = ("weight_decay", "betas", "fused", "foreach")
"""Settings of the optimiser that are the run's, not its checkpoint's."""


class BatchSource(Protocol):
    """Where batches come from; `trilitenet.data.loader.Loader` is such."""

    def __len__(self) -> int: ...
    def epoch(self, epoch: int, *, start: int = 0) -> Iterator[Batch]:
        """Return the batches of an epoch from batch ``start`` on."""


class Display(Protocol):
    """Shows a run to its user."""

    def line(self, text: str) -> None:
        """Show a line that stays."""

    def step(self, step: int, steps: int, text: str) -> None:
        """Show how far the run is."""

    def validation(self, images: int, count: int) -> None:
        """Show how many images the network has been measured on, and of how many."""


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """What a run came to.

    Attributes:
        folder: The run's folder.
        weights: The final weights (the moving average's), a safetensors file; not written if the run was stopped.
        steps: Optimiser steps done.
        finished: False if it was stopped before its end.
        metrics: Figures of the last validation, by name.
        best: Best value so far of each task and overall.
        images_per_second: Training throughput, without validation.
        first: Whether this is the first of the run's processes, which alone tells of it.
    """

    folder: Path
    weights: Path
    steps: int
    finished: bool
    metrics: dict[str, float]
    best: dict[str, float]
    images_per_second: float
    first: bool = True

    @property
    def exit_code(self) -> int:
        """0 if the run reached its end, 130 if it was stopped."""
        return 0 if self.finished else 130

    def summary(self) -> str:
        """Return one line a reader understands; nothing for a process that is not the first."""
        if not self.first:
            return ""
        speed = f"after {self.steps} steps"
        speed += f" at {self.images_per_second:.1f} images/s" if self.images_per_second else ", none of them new"
        if not self.finished:
            return f"stopped {speed}; {self.folder / CHECKPOINT_NAME} holds its state, go on with --resume"
        figures = ", ".join(f"{name} {value}" for name, value in figures_in_words(self.metrics).items())
        return f"finished {speed}: {self.weights}" + (f" ({figures})" if figures else "")


class _LeftValidationError(Exception):
    """A wish to stop came while the network was measured."""


class _FromPixels(nn.Module):
    """A network that takes (B, 3, H, W) uint8 RGB: Fabric would round normalised pixels to bf16 on their way in."""

    def __init__(self, network: Any, card: ModelCard) -> None:
        super().__init__()
        self.network = network
        self.card = card

    def forward(self, images: Tensor) -> Any:
        """Normalise the pixels and run the network."""
        return self.network(normalise_images(images, self.card.mean, self.card.std))


class Trainer:
    """Trains one network; made anew for each run.

    Args:
        config: The run.
        network: What to train.
        loss: With its parameters, if it has any.
        loader: Training batches, ``batch_size / accumulate`` images each.
        fabric: A launched ``lightning_fabric.Fabric``.
        card: What the weights' file is to say of them.
        identity: Of the training data, see `trilitenet.data.identity`; a checkpoint of other data is refused.
        validate: Returns figures of a network by name; see `FIGURES` for those that tell what is best. It is to call
            its second argument with how many images are measured, and of how many.
        measured_on: Identity of the data that these are of; where a checkpoint has others, what is best is found anew.
        teacher: A network to distil from, and the loss for it.
        display: Shows the run.
    """

    def __init__(
        self,
        config: TrainConfig,
        network: TriLiteNet,
        loss: MultiTaskLoss,
        loader: BatchSource,
        fabric: Any,
        card: ModelCard,
        *,
        identity: Mapping[str, Any] | None = None,
        validate: Callable[[TriLiteNet, Callable[[int, int], None]], Mapping[str, float]] | None = None,
        measured_on: Mapping[str, Any] | None = None,
        teacher: tuple[TriLiteNet, DistillationLoss] | None = None,
        display: Display | None = None,
    ) -> None:
        self.config = config
        self.fabric = fabric
        self.loader = loader
        self.card = card
        self.identity = identity
        self.validate = validate
        self.measured_on = measured_on
        self.display = display
        self.folder = Path(config.output)
        self.loggers: Sequence[RunLogger] = ()
        self._hosts = hosts_group(fabric)

        self.network = network.to(fabric.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        loss = loss.to(fabric.device)
        optimiser = build_optimiser(
            [network, loss],
            lr=config.lr,
            betas=config.betas,
            weight_decay=config.weight_decay,
            decay_all=config.decay_all,
        )
        compiled = torch.compile(self.network) if config.compile else self.network
        self.model, self.optimiser = fabric.setup(_FromPixels(compiled, card), optimiser)
        self.loss = loss
        self.terms = ["total", *(name for task in network.tasks for name in _TERMS[task])]
        """Names of the losses that are told: of the tasks that there are, and of what is distilled."""
        self.teacher = None
        if teacher is not None:
            tutor = teacher[0].to(fabric.device).eval()
            self.teacher = _FromPixels(tutor, tutor.card), teacher[1].to(fabric.device).eval()
            weights = dict(zip(TASKS, teacher[1].weights, strict=True))
            self.terms += [f"distil_{task}" for task in network.tasks if task in tutor.tasks and weights[task]]
        self.ema = MovingAverage(self.network, config.ema_decay, config.ema_ramp) if config.ema_decay else None
        interval = 20 if fabric.device.type == "cuda" else 1
        # The average follows no bad step that is seen at once.
        followers = [] if self.ema is None or interval == 1 else [self.ema.network]
        self.guard = FiniteGuard([self.network, *followers], optimiser, interval)

        self.epoch_steps = len(loader) // config.accumulate
        if not self.epoch_steps:
            raise ConfigError(
                f"an epoch of {len(loader)} batches has no step of {config.accumulate}; "
                "lower --accumulate or --batch-size"
            )
        steps = config.epochs * self.epoch_steps
        self.steps = min(steps, config.max_steps) if config.max_steps else steps
        warmup = max(round(config.warmup_epochs * self.epoch_steps), config.warmup_steps if config.warmup_epochs else 0)
        stair = self.epoch_steps if config.cosine_steps == "epoch" else 1
        self.schedule = Schedule(steps, min(warmup, steps), config.lr, config.final_lr, stair)

        self.step = 0
        self.best: dict[str, float] = {}
        self._best_of: Mapping[str, Any] | None = None
        """Identity of the data that the best values were measured on."""
        self.metrics: dict[str, float] = {}
        self.stale = 0
        self.ended = 0
        """Step at which an epoch was last validated and saved, for a stop comes between it and its last step."""
        self._ahead: dict[str, float] = {}
        """What the files of best weights reached that are newer than the checkpoint."""
        self._saved: int | None = None
        """Step that the checkpoint in the folder is of."""
        self._heeding: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
        """In its blocks alone PyTorch raises that a process that reads images was killed, which it does anywhere."""
        self.seconds = 0.0
        self.images = 0

    def fit(
        self,
        resume: str | Path | None,
        build_loggers: Callable[[int, int, Callable[[], None]], Sequence[RunLogger]],
    ) -> TrainResult:
        """Train to the end, or until SIGINT or SIGTERM asks to stop.

        Args:
            resume: A checkpoint to go on from.
            build_loggers: Returns the loggers of a run that goes on from a step, the last validation that it will not
                do anew being of another one. It is to call its third argument, which removes an earlier run, when a
                server cannot refuse it any more, and before it makes a file.

        Raises:
            DataError: If an image or label cannot be read.
            OutputError: If a result cannot be written.
            TrainingError: If the loss or gradient is not finite ten steps in a row, the device is out of memory, a
                process that reads images was killed, or the server of a logger does not let the run in.
            WeightsError: If the checkpoint is damaged or of another run.
        """
        if resume is not None:
            self.load(resume)
        if self.fabric.is_global_zero:
            with writing(self.folder):
                self.loggers = build_loggers(self.step, self.ended, lambda: self._begin(anew=resume is None))
        weights = self.folder / "final.safetensors"
        try:
            finished = self._run_to(weights)
        except (DataError, OutputError) as error:  # it came between two steps
            raise type(error)(f"{error}; once that is mended, {self._keep()}") from error
        except RuntimeError as error:
            if lacks_memory(error):
                height, width = self.config.input_size
                raise TrainingError(
                    f"{self.fabric.device} is out of memory in step {self.step} (a batch of {self.config.batch_size} "
                    f"images of {width}x{height}, --accumulate {self.config.accumulate}); raise --accumulate, or lower "
                    "--batch-size, --input-size or --multi-scale"
                ) from error
            if not str(error).startswith(WORKER_LOST):
                raise
            raise TrainingError(
                f"a process that reads images was ended ({gist(error)}), mostly for want of memory; "
                f"lower --workers; {self._keep()}"
            ) from error
        self.fabric.barrier()
        speed = self.images / self.seconds if self.seconds else 0.0
        first = self.fabric.is_global_zero
        return TrainResult(self.folder, weights, self.step, finished, self.metrics, self.best, speed, first)

    def _begin(self, *, anew: bool) -> None:
        """Write the settings into the folder, without what an earlier run left there or one that was killed cut off."""
        for name in (*_RESULTS, *_TRACES):
            for part in self.folder.glob(f".{name}.*.part"):
                part.unlink()
        if anew:
            _forget(self.folder)
        write_file(self.folder / "config.yaml", yaml.safe_dump(self.config.to_dict(), sort_keys=False))

    def _run_to(self, weights: Path) -> bool:
        """Run the epochs, write the weights of the end, and close the loggers; return whether the end was reached."""
        try:
            finished = self._run()
            if finished and self.fabric.is_global_zero:
                save_network(self.averaged, weights, self._card())
        except BaseException as error:
            with contextlib.suppress(OSError):  # of which what is told already may be the cause
                self._close("stopped" if isinstance(error, KeyboardInterrupt) else "failed")
            raise
        with writing(self.folder):
            self._close("finished" if finished else "stopped")
        return finished

    def _run(self) -> bool:
        """Run the epochs; return whether the end was reached, by schedule or by early stopping."""
        with StopRequest() as stop, putting_off("SIGCHLD") as self._heeding:
            if self.ended < self.step and (self.step % self.epoch_steps == 0 or self.step >= self.steps):
                self._end_epoch((self.step - 1) // self.epoch_steps, stop)
            while self.step < self.steps and not self._stopped(stop) and not self._stalled():
                epoch, start = divmod(self.step, self.epoch_steps)
                self._train_epoch(epoch, start, stop)
                if self._stopped(stop):
                    break
                self._end_epoch(epoch, stop)
            self.save()
            return not self._stopped(stop)

    def _keep(self) -> str:
        """Save the state if that can be done; return how to go on."""
        self.guard.look()
        with contextlib.suppress(OutputError):
            self.save()
        if self._saved is None:
            return "start anew with --overwrite, for nothing is saved yet"
        epoch = math.ceil(self._saved / self.epoch_steps)
        return f"--resume goes on after step {self._saved} of {self.steps} (epoch {epoch} of {self.config.epochs})"

    def _close(self, end: RunEnd) -> None:
        """Close all loggers, also where one cannot be."""
        with contextlib.ExitStack() as closing:
            for logger in reversed(self.loggers):
                closing.callback(logger.close, end)

    @property
    def averaged(self) -> TriLiteNet:
        """The network to validate and ship: the moving average, or the network itself without one."""
        network = self.network if self.ema is None else self.ema.network
        assert isinstance(network, TriLiteNet)
        return network

    def _train_epoch(self, epoch: int, start: int, stop: StopRequest) -> None:
        """Run the optimiser steps of an epoch, from its step ``start`` on."""
        self.model.train()
        keep_frozen(self.network, self.config.freeze)
        batches = self.loader.epoch(epoch, start=start * self.config.accumulate)
        sums = torch.zeros(len(self.terms) + 1, device=self.fabric.device)
        rate, mark, since = 0.0, time.perf_counter(), 0
        while group := self._read(batches, stop):
            rate = self.schedule.apply(self.optimiser, self.step)
            sums += self._train_step(group)
            self.step += 1
            if self.validate is None:
                self.metrics = {}  # of a run that went on: they are those of other weights
            since += sum(len(batch) for batch in group) * self.fabric.world_size
            if self.step % self.config.log_every == 0:
                self._log_losses(epoch, sums, rate, mark, since)
                mark, since = time.perf_counter(), 0
        if since:
            self._log_losses(epoch, sums, rate, mark, since)
        self.guard.look()

    def _read(self, batches: Iterator[Batch], stop: StopRequest) -> list[Batch]:
        """Return the batches of an optimiser step; none at the end, or once any of the processes was asked to stop.

        Raises:
            DataError: If an image or label cannot be read by any of the processes: the first one is to save.
            RuntimeError: If a worker of any was killed, likewise; its text begins with `WORKER_LOST`.
        """
        group: list[Batch] = []
        failed: DataError | RuntimeError | None = None
        try:
            if not stop and self.step < self.steps:
                with self._heeding():
                    group = list(itertools.islice(batches, self.config.accumulate))
        except (DataError, RuntimeError) as error:
            failed = error
        asked, broken = self._any(bool(stop), failed is not None)
        if broken:
            told = [failed] * self.fabric.world_size
            if self.fabric.world_size > 1:
                torch.distributed.all_gather_object(told, failed)
            raise next(filter(None, told))
        return [] if asked or len(group) < self.config.accumulate else group

    def _train_step(self, batches: Sequence[Batch]) -> Tensor:
        """Run one optimiser step; return the loss terms and 1, or zeros if it was left out."""
        sums = torch.zeros(len(self.terms) + 1, device=self.fabric.device)
        for index, batch in enumerate(batches):
            with self.fabric.no_backward_sync(self.model, enabled=index < len(batches) - 1):
                terms = self._losses(batch.to(self.fabric.device, non_blocking=True))
                self.fabric.backward(terms["total"] / len(batches))
            sums[:-1] += torch.stack([terms[name].detach() for name in self.terms]) / len(batches)
        if self.fabric.world_size > 1:
            for parameter in self.loss.parameters():
                parameter.grad = self.fabric.all_reduce(parameter.grad)
        norm = self.fabric.clip_gradients(
            self.model, self.optimiser, max_norm=self.config.clip_gradient or math.inf, error_if_nonfinite=False
        )
        total = sums[0] if self.fabric.world_size == 1 else self.fabric.all_reduce(sums[0])
        names = tuple(name for batch in batches for name in batch.names)
        # A gradient scaler must see bad steps, and leaves them out itself.
        scaled = getattr(self.fabric._precision, "scaler", None) is not None
        if self.guard.good(self.step, names, total, norm) or scaled:
            self.optimiser.step()
            if self.ema is not None:
                self.ema.update(self.network)
        self.optimiser.zero_grad()
        sums[-1] = 1
        return torch.where(torch.isfinite(sums[0]) & torch.isfinite(norm), sums, torch.zeros_like(sums))

    def _losses(self, batch: Batch) -> dict[str, Tensor]:
        """Run the network on a batch; return the terms of the loss by name."""
        if self.config.multi_scale is not None:
            size = (batch.images.shape[2], batch.images.shape[3])
            batch = rescale(batch, draw_size(size, self.config.multi_scale, self.config.seed, self.step))
        images = batch.images.contiguous(memory_format=torch.channels_last)
        outputs = self.model(images)
        terms: dict[str, Tensor] = self.loss(outputs, batch)._asdict()
        if self.teacher:
            network, distil = self.teacher
            with torch.no_grad(), self.fabric.autocast():
                lesson = network(images)
            taught = distil(outputs, lesson)
            terms["total"] = terms["total"] + torch.stack(tuple(taught)).sum()
            terms |= {f"distil_{task}": term for task, term in taught._asdict().items()}
        return terms

    def _end_epoch(self, epoch: int, stop: StopRequest) -> None:
        """Validate, keep the best, save, but at the end of the run, which does that itself.

        A validation is left if a wish to stop comes meanwhile; a run that goes on does it anew, and that alone: where
        ``checkpoint_every`` has the epoch saved, the state is saved before, too.
        """
        last = self.step >= self.steps
        saved = last or (epoch + 1) % self.config.checkpoint_every == 0
        if self.validate is not None and (last or (epoch + 1) % self.config.validate_every == 0):
            if saved and self._saved != self.step:
                self.save()
            whole = self.fabric.is_global_zero and self._validate(epoch, stop)
            whole, self.stale = self.fabric.broadcast((whole, self.stale))
            if not whole:
                return
        self.ended = self.step
        if saved and not last:
            self.save()

    def _validate(self, epoch: int, stop: StopRequest) -> bool:
        """Measure the network and keep the best; return False if a wish to stop came first."""

        def show(images: int, count: int) -> None:
            if stop:
                raise _LeftValidationError
            if self.display is not None:
                self.display.validation(images, count)

        assert self.validate is not None
        try:
            self.metrics = dict(self.validate(self.averaged, show))
        except _LeftValidationError:
            return False
        except (RuntimeError, MemoryError) as error:
            if not (lacks_memory(error) or lacks_memory(error.__cause__)):
                raise
            raise TrainingError(
                f"{self.fabric.device} is out of memory in the validation after step {self.step}; make room, or go "
                f"without it by --val-split ''; {self._keep()}"
            ) from error
        self._tell({f"val/{name}": value for name, value in self.metrics.items()})
        figures = ", ".join(f"{name} {value}" for name, value in figures_in_words(self.metrics).items())
        self._show(f"epoch {epoch + 1}/{self.config.epochs}: {figures}")
        self._keep_best()
        return True

    def _keep_best(self) -> None:
        """Save the weights of every task that is better than ever, and of the mean over tasks."""
        scores = {task: self.metrics.get(FIGURES[task], math.nan) for task in self.network.tasks}
        scores = {task: value for task, value in scores.items() if math.isfinite(value)}
        if scores:
            scores["overall"] = sum(scores.values()) / len(scores)
        better = {name: value for name, value in scores.items() if value > self.best.get(name, -math.inf)}
        for name, value in better.items():
            # A better file that is newer than the checkpoint is made again by a step that is yet to be run again.
            if value >= self._ahead.get(name, -math.inf):
                card = self._card()
                card = dataclasses.replace(card, metrics={**card.metrics, f"best {name}": value})
                save_network(self.averaged, self._best_path(name), card)
        self.best |= better  # not before the files are whole: after a full disk all of this is done anew
        self._best_of = self.measured_on
        if scores:  # without labels nothing tells whether it is better
            self.stale = 0 if "overall" in better else self.stale + 1

    def _best_path(self, name: str) -> Path:
        return self.folder / f"best-{name}.safetensors"

    def _stalled(self) -> bool:
        """Return whether validation has not improved for too long."""
        stalled = 0 < self.config.patience <= self.stale
        if stalled:
            self._show(f"no better for {self.stale} validations: stopping early")
        return stalled

    def _stopped(self, stop: StopRequest) -> bool:
        """Return whether any process was asked to stop."""
        return self._any(bool(stop))[0]

    def _any(self, *here: bool) -> tuple[bool, ...]:
        """Return of each thing whether it is so in any process."""
        if self.fabric.world_size == 1:
            return here
        so = torch.tensor(here, dtype=torch.float32)  # not on the device, whose steps a look would wait for
        torch.distributed.all_reduce(so, group=self._hosts)
        return tuple((so > 0).tolist())

    def _log_losses(self, epoch: int, sums: Tensor, rate: float, mark: float, since: int) -> None:
        """Log the mean losses of all processes, of so many images since a time, and clear the sums; all take part."""
        elapsed = time.perf_counter() - mark
        speed = since / elapsed
        self.seconds, self.images = self.seconds + elapsed, self.images + since
        whole = sums if self.fabric.world_size == 1 else self.fabric.all_reduce(sums.clone())
        *means, _ = (whole / whole[-1]).tolist()  # NaN where every step was left out
        sums.zero_()
        losses = dict(zip(self.terms, means, strict=True))
        figures = {f"train/{name}": value for name, value in (losses | self._balance()).items()}
        self._tell(figures | {"lr": rate, "images_per_second": speed})
        parts = " ".join(f"{name} {value:.4f}" for name, value in losses.items())
        text = f"epoch {epoch + 1}/{self.config.epochs} step {self.step}/{self.steps}: {parts} ({speed:.1f} images/s)"
        if self.display is not None and self.fabric.is_global_zero:
            self.display.step(self.step, self.steps, text)

    def _balance(self) -> dict[str, float]:
        """Return what multiplies each task's loss, where that is learned."""
        if self.loss.log_variance is None:
            return {}
        learned = zip(TASKS, self.loss.weights, torch.exp(-self.loss.log_variance.detach()).tolist(), strict=True)
        return {f"weight_{task}": weight * factor for task, weight, factor in learned if task in self.network.tasks}

    def _tell(self, values: Mapping[str, float]) -> None:
        with writing(self.folder):
            for logger in self.loggers:
                logger.log(values, self.step)

    def _show(self, text: str) -> None:
        if self.display is not None and self.fabric.is_global_zero:
            self.display.line(text)

    def _card(self) -> ModelCard:
        provenance = {**self.card.provenance, "steps": str(self.step)}
        metrics = {f"val {name}": value for name, value in self.metrics.items()}
        return dataclasses.replace(self.card, metrics=metrics, provenance=provenance)

    def save(self) -> None:
        """Write the checkpoint: all that the run needs to go on as if it had never stopped."""
        if not self.fabric.is_global_zero:
            return
        write_checkpoint(
            self.folder / CHECKPOINT_NAME,
            {
                "config": self.config.to_dict(),
                "classes": self.network.classes,
                "data": self.identity,
                "step": self.step,
                "network": self.network.state_dict(),
                "ema": None if self.ema is None else self.ema.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "loss": self.loss.state_dict(),
                "scaler": self.fabric._precision.state_dict(),
                "best": self.best,
                "best_of": self._best_of,
                "metrics": self.metrics,
                "stale": self.stale,
                "ended": self.ended,
                "random": random_state(),
            },
        )
        self._saved = self.step

    def load(self, path: str | Path) -> None:
        """Take over the state of a checkpoint.

        Raises:
            WeightsError: If it is damaged, or of a run with another network, batch, class count or data set.
        """
        state = read_checkpoint(path)
        ours, theirs = self.config.to_dict(), state["config"]
        ours["class count"], theirs["class count"] = self.network.classes, state["classes"]
        if "tasks" in theirs:
            theirs["tasks"] = [task for task in TASKS if task in theirs["tasks"]]  # as a run lists them now
        for name in (*SAME_ON_RESUME, "class count"):
            if theirs.get(name, ours[name]) != ours[name]:
                raise WeightsError(
                    f"{path}: was trained with {name} {theirs[name]!r}, this run has {ours[name]!r}; "
                    "set it alike, or start anew with --init"
                )
        if state["data"] and self.identity:
            difference = tell_apart(state["data"], self.identity)
            if difference:
                raise WeightsError(
                    f"{path}: was trained on {difference}; give the same --data and --classes, or start anew with "
                    "--overwrite or another --output"
                )
        own = state["network"].get("anchors")
        if self.config.anchors is not None and not (
            isinstance(own, Tensor) and torch.equal(own, self.network.anchors.cpu())
        ):
            raise WeightsError(
                f"{path}: was trained with other anchors than are given now; leave them out to go on with its own, or "
                "start anew with --overwrite"
            )
        try:
            self._take_over(state)
        except (RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
            reason = gist(brief(error))  # of a network it names every tensor
            raise WeightsError(f"{path}: does not fit this run ({reason}); start anew with --overwrite") from error
        self._saved = self.step
        self._best_of = state.get("best_of")
        before, now = self._best_of, self.measured_on
        goes_on = self.step < self.steps or self.ended < self.step
        changed = tell_apart(before, now) if before and now and goes_on else None
        if changed:
            self._show(f"was validated on {changed}: what is best is found anew")
            self.best, self.stale = {}, 0
        else:
            self._read_best()
        self.guard.look()
        other = ", ".join(_changes(theirs, ours))
        if other:
            self._show(f"goes on with other settings than it had: {other}")

    def _take_over(self, state: Mapping[str, Any]) -> None:
        self.network.load_state_dict(state["network"])
        if self.loss.detection is not None:
            self.loss.detection.anchors.copy_(self.network.anchors)
        if self.teacher:
            self.teacher[1].get_buffer("student_anchors").copy_(self.network.anchors)
        if self.ema is not None:
            # A run without an average that goes on with one: it begins at the weights as they are.
            self.ema.load_state_dict(state["ema"] or {"updates": 0, "network": state["network"]})
        # As this run says, like the learning rate, and as this device computes; before they are loaded, for where a
        # fused optimiser keeps its counts of steps depends on it.
        now = [{key: group[key] for key in _OF_THE_RUN} for group in self.optimiser.param_groups]
        before = state["optimiser"]["param_groups"]
        groups = [{**old, **new} for old, new in zip(before, now, strict=True)]
        self.optimiser.load_state_dict({**state["optimiser"], "param_groups": groups})
        self.loss.load_state_dict(state["loss"])
        if state["scaler"]:
            self.fabric._precision.load_state_dict(state["scaler"])
        self.step, self.stale, self.ended = state["step"], state["stale"], state["ended"]
        self.best, self.metrics = dict(state["best"]), dict(state["metrics"])
        set_random_state(state["random"])

    def _read_best(self) -> None:
        """Learn from files newer than the checkpoint what must not be replaced by worse."""
        for name in (*self.network.tasks, "overall"):
            path = self._best_path(name)
            if not path.is_file():
                continue
            try:
                value = read_card(path).metrics.get(f"best {name}", -math.inf)
            except WeightsError:  # the run needs no more of it than that
                self._show(f"{path}: is damaged; the next validation replaces it")
                self.best.pop(name, None)
                continue
            if value > self.best.get(name, -math.inf):
                self._ahead[name] = value


def _changes(before: Mapping[str, Any], after: Mapping[str, Any], within: str = "") -> Iterator[str]:
    """Tell every setting that has another value, but the places of data, copies and run, which may have been moved."""
    for name, value in after.items():
        old = before.get(name, value)
        if isinstance(old, Mapping) and old.keys() == value.keys():
            yield from _changes(old, value, f"{within}{name}.")
        elif old != value and name not in ("data", "cache", "output"):
            yield f"{within}{name} {value} (was {old})"


def figures_in_words(figures: Mapping[str, float]) -> dict[str, str]:
    """Return figures as they are shown; a dash is undefined, as of a task that nothing is labelled for."""
    return {name: "-" if math.isnan(value) else f"{value:.4f}" for name, value in figures.items()}


def holds_run(folder: Path) -> bool:
    """Return whether a folder has anything that a new run would replace."""
    return any(True for pattern in (*_RESULTS, *_TRACES) for _ in folder.glob(pattern))


def _forget(folder: Path) -> None:
    """Remove what an earlier run left, so that none of it is taken for the new one's."""
    for path in [path for pattern in (*_RESULTS, *_TRACES) for path in folder.glob(pattern)]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
