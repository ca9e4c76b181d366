"""Batches in an order, and with an augmentation, that depend on (seed, epoch, position) alone.

Whatever the number of workers, and whether an epoch is run through or taken up in its middle, the same batches come.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any, Final

import cv2
import numpy as np
import torch.utils.data
from numpy.typing import NDArray

from trilitenet.data.batches import Batch, collate
from trilitenet.data.reading import MixedDataset, SampleSource
from trilitenet.data.sample import Sample
from trilitenet.data.transforms import Transform
from trilitenet.errors import ConfigError, TriLiteNetError
from trilitenet.processing.cores import held_back

__all__ = ["WORKER_LOST", "Loader", "build_loader", "epoch_order"]

WORKER_LOST: Final = "DataLoader worker"
"""How the text of the RuntimeError begins that tells of a worker that was killed; PyTorch raises it anywhere."""

_ORDER_STREAM: Final = 0
_SAMPLE_STREAM: Final = 1
"""Random streams of the sample order and of the augmentation are kept apart."""


def epoch_order(
    count: int, *, seed: int, epoch: int, weights: NDArray[np.float64] | None = None, length: int | None = None
) -> NDArray[np.int64]:
    """Return the indices of one epoch, shuffled.

    With weights, sample ``i`` comes ``length * weights[i] / weights.sum()`` times, rounded down or up at random
    (systematic sampling); without, every sample comes once (if ``length`` is left out).

    Args:
        count: Number of samples.
        seed: Of the run.
        epoch: From 0.
        weights: (count,) relative weights, not negative.
        length: Number of indices; ``count`` if left out.

    Returns:
        (length,) int64.
    """
    rng = np.random.default_rng([seed, _ORDER_STREAM, epoch])
    length = count if length is None else length
    shares = np.full(count, length / count) if weights is None else weights / weights.sum() * length
    shuffled = rng.permutation(count)
    # One random offset, then a pick at each whole number along the summed shares.
    ends = np.cumsum(shares[shuffled])
    ends *= length / ends[-1]
    picks = np.searchsorted(ends, np.arange(length) + rng.random() * (1 - 1e-6), side="right")
    order: NDArray[np.int64] = shuffled[np.minimum(picks, count - 1)].astype(np.int64)
    rng.shuffle(order)
    return order


@dataclasses.dataclass(frozen=True)
class _Draw:
    """What a worker needs to make one sample: where it stands in the run and which sample it is."""

    epoch: int
    position: int
    index: int


class _Samples(torch.utils.data.Dataset[Sample | TriLiteNetError]):
    """Transformed samples by `_Draw`."""

    def __init__(
        self, dataset: SampleSource, transform: Transform, seed: int, weights: NDArray[np.float64] | None
    ) -> None:
        self._dataset = dataset
        self._transform = transform
        self._seed = seed
        self._chance: NDArray[np.float64] | None = None
        if weights is not None:
            self._chance = np.cumsum(weights)
            self._chance /= self._chance[-1]  # not by the sum, which is rounded otherwise

    def __getitem__(self, draw: _Draw) -> Sample | TriLiteNetError:
        """Return the sample, or why there is none: PyTorch would wrap what a worker raises into pages of text."""
        rng = np.random.default_rng([self._seed, _SAMPLE_STREAM, draw.epoch, draw.position])
        try:
            return self._transform(self._dataset[draw.index], rng, self._other)
        except TriLiteNetError as error:
            return error

    def _other(self, rng: np.random.Generator) -> Sample:
        """Return a sample to mix another with, drawn by the weights too."""
        if self._chance is None:
            return self._dataset[int(rng.integers(len(self._dataset)))]
        return self._dataset[int(np.searchsorted(self._chance, rng.random(), side="right"))]


def _collate(samples: list[Sample | TriLiteNetError]) -> Batch | TriLiteNetError:
    whole: list[Sample] = []
    for sample in samples:
        if isinstance(sample, TriLiteNetError):
            return sample
        whole.append(sample)
    return collate(whole)


def _batches(
    loader: torch.utils.data.DataLoader[Batch | TriLiteNetError], plan: _Plan, batches: list[list[_Draw]]
) -> Iterator[Batch]:
    """Yield the batches of a plan. Workers serve one at a time: where another was begun meanwhile, they begin anew.

    Raises:
        RuntimeError: If a worker was killed; its text begins with `WORKER_LOST`.
    """
    following: Iterator[Batch | TriLiteNetError] = iter(())
    left: list[list[_Draw]] | None = None
    try:
        for number in range(len(batches)):
            if plan.batches is not left:
                plan.batches = left = batches[number:]
                with _starting(loader.num_workers):
                    following = iter(loader)
            batch = next(following)
            if isinstance(batch, TriLiteNetError):
                raise batch
            yield batch
    except (EOFError, OSError) as error:  # it was killed while it handed a batch over
        time.sleep(1.0)  # PyTorch raises which one as soon as the system tells of its end
        raise RuntimeError(f"{WORKER_LOST} lost ({error})") from error


@contextlib.contextmanager
def _starting(workers: int) -> Iterator[None]:
    """Inside, workers are started: SIGTERM is held back in all their threads, see `_start_worker`.

    They are the parallelism, so OpenCV works on one thread in each. A forked one takes this over; setting it there
    would wait for ever for OpenCV's threads, which a fork leaves behind.
    """
    threads = cv2.getNumThreads()
    if workers:
        cv2.setNumThreads(0)
    try:
        with held_back(signal.SIGTERM):
            yield
    finally:
        if workers:
            cv2.setNumThreads(threads)


class _Plan(torch.utils.data.Sampler[list[_Draw]]):
    """The batches still to come of one epoch."""

    def __init__(self) -> None:
        self.batches: list[list[_Draw]] = []

    def __iter__(self) -> Iterator[list[_Draw]]:
        return iter(self.batches)

    def __len__(self) -> int:
        return len(self.batches)


class Loader:
    """Batches of a data set; made by `build_loader`, which checks and describes its arguments."""

    def __init__(
        self,
        dataset: SampleSource,
        transform: Transform,
        *,
        batch_size: int,
        seed: int,
        shuffle: bool,
        weights: NDArray[np.float64] | None,
        length: int,
        drop_last: bool,
        workers: int,
        pin_memory: bool,
        share: tuple[int, int],
    ) -> None:
        self.dataset = dataset
        self.batch_size = batch_size
        self.seed = seed
        self._shuffle = shuffle
        self._weights = weights
        self._length = length
        self._drop_last = drop_last
        self._share = share
        self._plan = _Plan()
        more: dict[str, Any] = {"persistent_workers": True, "prefetch_factor": 4} if workers else {}
        self._loader: torch.utils.data.DataLoader[Batch | TriLiteNetError] = torch.utils.data.DataLoader(
            _Samples(dataset, transform, seed, weights if shuffle else None),  # type: ignore[arg-type]
            batch_sampler=self._plan,
            collate_fn=_collate,
            num_workers=workers,
            pin_memory=pin_memory,
            worker_init_fn=_start_worker,
            generator=torch.Generator(),  # else each start of an epoch would draw from the global one
            **more,
        )

    def __len__(self) -> int:
        """Number of batches an epoch."""
        whole, rest = divmod(self._length, self.batch_size)
        return whole + bool(rest and not self._drop_last)

    def __iter__(self) -> Iterator[Batch]:
        return self.epoch(0)

    def epoch(self, epoch: int, *, start: int = 0) -> Iterator[Batch]:
        """Return the batches of one epoch.

        Args:
            epoch: From 0.
            start: Leave out the first so many batches, to take an epoch up in its middle.
        """
        if self._shuffle:
            order = epoch_order(
                len(self.dataset), seed=self.seed, epoch=epoch, weights=self._weights, length=self._length
            )
        else:
            order = np.arange(self._length, dtype=np.int64)
        draws = [_Draw(epoch, position, int(index)) for position, index in enumerate(order)]
        batches = [draws[first : first + self.batch_size] for first in range(0, len(draws), self.batch_size)]
        index, count = self._share
        shares = [
            batch[index * len(batch) // count : (index + 1) * len(batch) // count]
            for batch in batches[start : len(self)]
        ]
        return _batches(self._loader, self._plan, shares)


def build_loader(
    dataset: SampleSource,
    transform: Transform,
    *,
    batch_size: int,
    seed: int = 0,
    shuffle: bool = True,
    weights: NDArray[np.float64] | None = None,
    samples_per_epoch: int | None = None,
    workers: int = 0,
    pin_memory: bool = False,
    share: tuple[int, int] = (0, 1),
) -> Loader:
    """Build a deterministic loader. When it shuffles it leaves out a last batch that is not full, if another is left.

    Args:
        dataset: A `DrivingDataset`, a `MixedDataset` (whose weights are used) or anything alike.
        transform: `TrainTransform` or `EvalTransform`.
        batch_size: Samples a batch.
        seed: Of order and augmentation.
        shuffle: Shuffle the samples each epoch; False keeps the data set's order and ignores weights.
        weights: (N,) relative sampling weights, for example of `sampling_weights`; those of a `MixedDataset` if left
            out.
        samples_per_epoch: Length of an epoch when shuffling; the number of samples if left out.
        workers: Processes that read ahead; 0 reads in this one.
        pin_memory: Put batches into page-locked memory, for a GPU.
        share: (index, count): give the index-th of count equal parts of every batch, for one of several processes;
            together they see what one process would. ``batch_size`` is that of all together.

    Raises:
        ConfigError: If a number is out of range, the weights do not fit the data set, or it is empty.
    """
    if not len(dataset):
        raise ConfigError("there is no sample to load")
    if batch_size < 1 or workers < 0 or seed < 0:
        raise ConfigError(
            f"batch_size must be at least 1, workers and seed at least 0, got {batch_size}, {workers} and {seed}"
        )
    if not 0 <= share[0] < share[1] or batch_size % share[1]:
        raise ConfigError(f"a batch of {batch_size} cannot be shared by {share[1]} processes in equal parts")
    if samples_per_epoch is not None and (samples_per_epoch < 1 or not shuffle):
        raise ConfigError("samples_per_epoch must be at least 1, and needs shuffle")
    if weights is None and isinstance(dataset, MixedDataset):
        own = dataset.weights
        weights = None if (own == own[0]).all() else own
    if weights is not None and (
        weights.shape != (len(dataset),) or not (weights >= 0).all() or not 0 < weights.sum() < math.inf
    ):
        raise ConfigError(f"weights must be {len(dataset)} numbers, none negative, one above 0 and none infinite")
    length = samples_per_epoch or len(dataset)
    drop_last = shuffle and length >= batch_size
    rest = length % batch_size
    if 0 < rest < share[1] and not drop_last:
        raise ConfigError(f"{rest} of {length} images are left for a last batch, too few for {share[1]} processes")
    return Loader(
        dataset,
        transform,
        batch_size=batch_size,
        seed=seed,
        shuffle=shuffle,
        weights=weights,
        length=length,
        drop_last=drop_last,
        workers=workers,
        pin_memory=pin_memory,
        share=share,
    )


def _start_worker(worker: int) -> None:
    """Leave stopping to the process that trains, and keep a worker that was not forked to one core too.

    Ctrl-C reaches every process of a terminal, a scheduler's SIGTERM every one of a job, but the training process needs
    its workers until the step at hand is done and saved. A library that was loaded before the fork may have started a
    thread in the worker by now, which must not take SIGTERM either: the worker begins with it held back.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "sigwaitinfo"):
        threading.Thread(target=_heed_parent, daemon=True).start()
    if multiprocessing.get_start_method() != "fork":
        cv2.setNumThreads(0)


def _heed_parent() -> None:
    """End this process at its parent's SIGTERM, and at no other."""
    while signal.sigwaitinfo({signal.SIGTERM}).si_pid != os.getppid():
        pass
    os._exit(0)
