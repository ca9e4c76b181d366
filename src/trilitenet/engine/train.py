"""The training loop (Section IV-A, Algorithm 1): network, data, loss and validation are passed in."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
import yaml
from torch import Tensor, nn

from trilitenet.config import ModelCard
from trilitenet.data.batches import Batch
from trilitenet.engine.checkpoint import random_state, read_checkpoint, set_random_state, write_checkpoint
from trilitenet.engine.ema import MovingAverage
from trilitenet.engine.optim import Schedule, build_optimiser
from trilitenet.engine.recipe import TrainConfig
from trilitenet.engine.runtime import StopRequest
from trilitenet.errors import TrainingError, WeightsError
from trilitenet.losses.multitask import LossTerms, MultiTaskLoss
from trilitenet.models.trilitenet import TriLiteNet, normalise_images
from trilitenet.models.weights import save_network

__all__ = ["CHECKPOINT_NAME", "RunLogger", "TrainResult", "Trainer"]

log = logging.getLogger(__name__)

CHECKPOINT_NAME = "last.ckpt"
"""The checkpoint in the run's folder that `--resume` continues from."""

FIGURES = {"detection": "detection/ap50", "drivable": "drivable/miou", "lane": "lane/iou"}
"""The figure each task is judged by; the mean of these is the overall one."""

MAX_BAD_STEPS = 10
"""So many steps in a row without a finite loss and gradient end the run."""

SAME_ON_RESUME = ("variant", "classes", "tasks", "pcaa", "litepan", "spp", "batch_size", "balancing")
"""Settings that a checkpoint must share with the run that resumes it."""


class BatchSource(Protocol):
    """Where batches come from; `trilitenet.data.loader.Loader` is such."""

    def __len__(self) -> int: ...
    def epoch(self, epoch: int, *, start: int = 0) -> Iterator[Batch]:
        """Return the batches of an epoch from batch ``start`` on."""


class RunLogger(Protocol):
    """Takes the figures of a run."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""

    def close(self) -> None:
        """Write out what is left."""


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """What a run came to.

    Attributes:
        folder: The run's folder.
        weights: The final weights (the moving average's), a safetensors file.
        steps: Optimiser steps done.
        finished: False if it was stopped before its end.
        metrics: Figures of the last validation, by name.
        best: Best value so far of each task and overall.
        images_per_second: Training throughput, without validation.
    """

    folder: Path
    weights: Path
    steps: int
    finished: bool
    metrics: dict[str, float]
    best: dict[str, float]
    images_per_second: float

    @property
    def exit_code(self) -> int:
        """0 if the run reached its end, 130 if it was stopped."""
        return 0 if self.finished else 130

    def summary(self) -> str:
        """Return one line a reader understands."""
        state = "finished" if self.finished else "stopped; go on with --resume"
        figures = ", ".join(f"{name} {value:.4f}" for name, value in self.metrics.items())
        return f"{state} after {self.steps} steps at {self.images_per_second:.1f} images/s: {self.weights}" + (
            f" ({figures})" if figures else ""
        )


class Trainer:
    """Trains one network; made anew for each run.

    Args:
        config: The run.
        network: What to train.
        loss: With its parameters, if it has any.
        loader: Training batches of ``batch_size`` images.
        fabric: A launched ``lightning_fabric.Fabric``.
        card: What the weights' file is to say of them.
        validate: Returns figures of a network by name; see `FIGURES` for those that tell what is best.
        loggers: Take the figures.
        report: Takes lines for the user.
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
        validate: Callable[[TriLiteNet], Mapping[str, float]] | None = None,
        loggers: Sequence[RunLogger] = (),
        report: Callable[[str], None] = log.info,
    ) -> None:
        self.config = config
        self.fabric = fabric
        self.loader = loader
        self.card = card
        self.validate = validate
        self.loggers = loggers
        self.report = report
        self.folder = Path(config.output)

        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.loss = loss.to(fabric.device)
        optimiser = build_optimiser([network, loss], lr=config.lr, betas=config.betas, weight_decay=config.weight_decay)
        self.model, self.optimiser = fabric.setup(self._compiled(self.network), optimiser)
        self.ema = MovingAverage(self.network, config.ema_decay, config.ema_ramp) if config.ema_decay else None
        steps = config.epochs * len(loader)
        self.steps = min(steps, config.max_steps) if config.max_steps else steps
        warmup = max(round(config.warmup_epochs * len(loader)), config.warmup_steps) if config.warmup_epochs else 0
        self.schedule = Schedule(steps, min(warmup, steps), config.lr, config.final_lr)

        self.step = 0
        self.best: dict[str, float] = {}
        self.metrics: dict[str, float] = {}
        self.bad_steps = 0
        self.seconds = 0.0
        self.images = 0

    def fit(self, resume: str | Path | None = None) -> TrainResult:
        """Train to the end, or until SIGINT or SIGTERM asks to stop.

        Args:
            resume: A checkpoint to go on from.

        Raises:
            TrainingError: If the loss or gradient is not finite ten steps in a row.
            WeightsError: If the checkpoint is damaged or of another run.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "config.yaml").write_text(yaml.safe_dump(self.config.to_dict(), sort_keys=False))
        if resume is not None:
            self._resume(resume)
        with StopRequest() as stop:
            while self.step < self.steps and not stop:
                epoch, start = divmod(self.step, len(self.loader))
                self._train_epoch(epoch, start, stop)
                if stop:
                    break
                self._end_epoch(epoch)
            if stop:
                self._save()
        weights = self.folder / "final.safetensors"
        if not stop:
            save_network(self.averaged, weights, self._card())
        for logger in self.loggers:
            logger.close()
        speed = self.images / self.seconds if self.seconds else 0.0
        return TrainResult(self.folder, weights, self.step, not stop, self.metrics, self.best, speed)

    @property
    def averaged(self) -> TriLiteNet:
        """The network to validate and ship: the moving average, or the network itself without one."""
        network = self.network if self.ema is None else self.ema.network
        assert isinstance(network, TriLiteNet)
        return network

    def _train_epoch(self, epoch: int, start: int, stop: StopRequest) -> None:
        """Run the optimiser steps of an epoch, from its batch ``start`` on."""
        self.model.train()
        sums = torch.zeros(len(LossTerms._fields), device=self.fabric.device)
        count, mark, since = 0, time.perf_counter(), 0
        for batch in self.loader.epoch(epoch, start=start):
            rate = self.schedule.apply(self.optimiser, self.step)
            terms = self._train_step(batch.to(self.fabric.device, non_blocking=True))
            if terms is not None:
                sums += torch.stack([term.detach() for term in terms])
                count += 1
            self.step += 1
            since += len(batch)
            if self.step % 20 == 0 or self.step == self.steps:
                elapsed = time.perf_counter() - mark
                self.seconds, self.images = self.seconds + elapsed, self.images + since
                self._log_losses(epoch, sums / max(count, 1), rate, since / elapsed)
                sums.zero_()
                count, mark, since = 0, time.perf_counter(), 0
            if stop or self.step >= self.steps:
                break

    def _train_step(self, batch: Batch) -> LossTerms | None:
        """Run one optimiser step; None if it was skipped."""
        images = batch.images.contiguous(memory_format=torch.channels_last)
        outputs = self.model(normalise_images(images))
        terms = self.loss(outputs, batch)
        self.fabric.backward(terms.total)
        norm = self._clip()
        if not math.isfinite(float(terms.total.detach())) or not math.isfinite(float(norm)):
            self._skip(batch)
            return None
        self.bad_steps = 0
        self.optimiser.step()
        self.optimiser.zero_grad()
        if self.ema is not None:
            self.ema.update(self.network)
        return terms  # type: ignore[no-any-return]

    def _clip(self) -> Tensor:
        """Limit the norm of the gradient and return what it was."""
        parameters = [parameter for parameter in self.network.parameters() if parameter.grad is not None]
        limit = self.config.clip_gradient or math.inf
        return nn.utils.clip_grad_norm_(parameters, limit, foreach=True)

    def _skip(self, batch: Batch) -> None:
        """Leave out a step whose loss or gradient is not finite."""
        self.optimiser.zero_grad()
        self.bad_steps += 1
        names = ", ".join(batch.names)
        log.warning("step %d skipped: its loss or gradient is not finite (images: %s)", self.step, names)
        if self.bad_steps >= MAX_BAD_STEPS:
            raise TrainingError(
                f"loss or gradient not finite for {MAX_BAD_STEPS} steps in a row, the last being step {self.step} "
                f"(images: {names}); lower --lr, or train with --precision 32-true"
            )

    def _end_epoch(self, epoch: int) -> None:
        """Validate, keep the best, save."""
        last = self.step >= self.steps
        if self.validate is not None and (last or (epoch + 1) % self.config.validate_every == 0):
            self.metrics = dict(self.validate(self.averaged))
            self._tell({f"val/{name}": value for name, value in self.metrics.items()})
            figures = ", ".join(f"{name} {value:.4f}" for name, value in self.metrics.items())
            self.report(f"epoch {epoch + 1}/{self.config.epochs}: {figures}")
            self._keep_best()
        if last or (epoch + 1) % self.config.checkpoint_every == 0:
            self._save()

    def _keep_best(self) -> None:
        """Save the weights of every task that is better than ever, and of the mean over tasks."""
        scores = {task: self.metrics.get(FIGURES[task], math.nan) for task in self.network.tasks}
        scores = {task: value for task, value in scores.items() if math.isfinite(value)}
        if scores:
            scores["overall"] = sum(scores.values()) / len(scores)
        for name, value in scores.items():
            if value > self.best.get(name, -math.inf):
                self.best[name] = value
                save_network(self.averaged, self.folder / f"best-{name}.safetensors", self._card())

    def _log_losses(self, epoch: int, means: Tensor, rate: float, speed: float) -> None:
        losses = dict(zip(LossTerms._fields, means.tolist(), strict=True))
        self._tell(
            {f"train/{name}": value for name, value in losses.items()} | {"lr": rate, "images_per_second": speed}
        )
        parts = " ".join(f"{name} {value:.4f}" for name, value in losses.items())
        self.report(
            f"epoch {epoch + 1}/{self.config.epochs} step {self.step}/{self.steps}: {parts} ({speed:.1f} images/s)"
        )

    def _tell(self, values: Mapping[str, float]) -> None:
        for logger in self.loggers:
            logger.log(values, self.step)

    def _card(self) -> ModelCard:
        provenance = {**self.card.provenance, "steps": str(self.step)}
        metrics = {f"val {name}": value for name, value in self.metrics.items()}
        return dataclasses.replace(self.card, metrics=metrics, provenance=provenance)

    def _save(self) -> None:
        write_checkpoint(
            self.folder / CHECKPOINT_NAME,
            {
                "config": self.config.to_dict(),
                "step": self.step,
                "network": self.network.state_dict(),
                "ema": None if self.ema is None else self.ema.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "loss": self.loss.state_dict(),
                "best": self.best,
                "metrics": self.metrics,
                "random": random_state(),
            },
        )

    def _resume(self, path: str | Path) -> None:
        state = read_checkpoint(path)
        ours, theirs = self.config.to_dict(), state["config"]
        for name in SAME_ON_RESUME:
            if ours[name] != theirs.get(name):
                raise WeightsError(
                    f"{path}: was trained with {name} {theirs.get(name)!r}, this run has {ours[name]!r}; "
                    f"set it alike, or start anew with --init"
                )
        self.network.load_state_dict(state["network"])
        if self.ema is not None and state["ema"] is not None:
            self.ema.load_state_dict(state["ema"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.loss.load_state_dict(state["loss"])
        self.step = int(state["step"])
        self.best, self.metrics = dict(state["best"]), dict(state["metrics"])
        set_random_state(state["random"])

    def _compiled(self, network: nn.Module) -> nn.Module:
        return torch.compile(network) if self.config.compile else network  # type: ignore[return-value]
