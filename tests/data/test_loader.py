from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tests.data.published import write_published
from trilitenet.data.batches import Batch
from trilitenet.data.loader import build_loader, epoch_order
from trilitenet.data.reading import DrivingDataset, MixedDataset
from trilitenet.data.sample import Sample
from trilitenet.data.transforms import Augmentation, EvalTransform, TrainTransform
from trilitenet.errors import ConfigError, DataError

CANVAS = (64, 96)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DrivingDataset:
    root = tmp_path_factory.mktemp("data")
    write_published(root, "train", 14)
    return DrivingDataset(root, "train")


def same(one: Batch, two: Batch) -> bool:
    tensors = ("images", "boxes", "ignored", "detection_labelled", "drivable", "lane")
    return one.names == two.names and all(torch.equal(getattr(one, key), getattr(two, key)) for key in tensors)


def test_epochs_differ_and_repeat(dataset: DrivingDataset) -> None:
    loader = build_loader(dataset, TrainTransform(CANVAS), batch_size=4, seed=3)
    assert len(loader) == 3  # the last, half batch is left out
    first, again, other = (list(loader.epoch(epoch)) for epoch in (0, 0, 1))
    assert all(same(one, two) for one, two in zip(first, again, strict=True))
    assert not any(same(one, two) for one, two in zip(first, other, strict=True))
    seeded = list(build_loader(dataset, TrainTransform(CANVAS), batch_size=4, seed=4).epoch(0))
    assert not any(same(one, two) for one, two in zip(first, seeded, strict=True))


@pytest.mark.parametrize("start", [0, 1, 2, 3])
def test_taking_an_epoch_up_in_its_middle(dataset: DrivingDataset, start: int) -> None:
    augmentation = Augmentation(mosaic=0.5, mixup=0.5, rain=0.3)
    loader = build_loader(dataset, TrainTransform(CANVAS, augmentation), batch_size=4, seed=3)
    whole = list(loader.epoch(5))
    rest = list(loader.epoch(5, start=start))
    assert len(rest) == 3 - start
    assert all(same(one, two) for one, two in zip(whole[start:], rest, strict=True))


@pytest.mark.slow
def test_workers_change_nothing(dataset: DrivingDataset) -> None:
    augmentation = Augmentation(mosaic=0.5, noise=0.5)
    alone = build_loader(dataset, TrainTransform(CANVAS, augmentation), batch_size=4, seed=3)
    workers = build_loader(dataset, TrainTransform(CANVAS, augmentation), batch_size=4, seed=3, workers=2)
    for epoch, start in ((0, 0), (1, 2)):
        pairs = zip(alone.epoch(epoch, start=start), workers.epoch(epoch, start=start), strict=True)
        assert all(same(one, two) for one, two in pairs)


@pytest.mark.parametrize("workers", [0, 2])
def test_epochs_may_be_taken_in_turns(dataset: DrivingDataset, workers: int) -> None:
    loader = build_loader(dataset, EvalTransform(CANVAS), batch_size=4, seed=3, workers=workers)
    alone = [[batch.names for batch in loader.epoch(epoch)] for epoch in (0, 1)]
    turns = zip(loader.epoch(0), loader.epoch(1), strict=True)
    assert [[one.names, two.names] for one, two in turns] == [list(pair) for pair in zip(*alone, strict=True)]


def test_opencv_keeps_its_threads_in_this_process(dataset: DrivingDataset) -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        loader = build_loader(dataset, EvalTransform(CANVAS), batch_size=4, workers=1)
        assert len(list(loader)) == len(loader)
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


_WITH_A_THREAD = """
import multiprocessing, os, subprocess, sys, threading, time
from trilitenet.data.loader import build_loader
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.transforms import EvalTransform

def start() -> None:
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()

os.register_at_fork(after_in_child=start)
loader = build_loader(DrivingDataset(sys.argv[1], "train"), EvalTransform((64, 96)), batch_size=2, workers=1)
batches = loader.epoch(0)
next(batches)
(worker,) = multiprocessing.active_children()
for _ in range(20):
    subprocess.run(["kill", "-TERM", str(worker.pid)], check=True)
print(sum(1 for _ in batches), sum(1 for _ in loader.epoch(1)), worker.is_alive())
"""
"""As some runtimes do, a thread is started in each forked process before the loader hears of it."""


@pytest.mark.skipif(not hasattr(os, "register_at_fork"), reason="no fork here")
def test_no_thread_of_a_worker_takes_sigterm(dataset: DrivingDataset) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WITH_A_THREAD, str(dataset.root)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("6 7 True\n", 0), done.stderr


@pytest.mark.parametrize("workers", [0, 1])
def test_a_broken_file_is_told_in_one_line(tmp_path: Path, workers: int) -> None:
    write_published(tmp_path, "train", 4)
    broken = tmp_path / "images/train/train_0002.jpg"
    broken.write_bytes(broken.read_bytes()[:60])
    loader = build_loader(
        DrivingDataset(tmp_path, "train"), TrainTransform(CANVAS, Augmentation()), batch_size=2, workers=workers
    )
    with pytest.raises(DataError, match="train_0002") as caught:
        list(loader)
    assert "\n" not in str(caught.value)


def test_without_shuffling_all_come_in_order(dataset: DrivingDataset) -> None:
    loader = build_loader(dataset, EvalTransform(CANVAS), batch_size=4, shuffle=False)
    assert [name for batch in loader for name in batch.names] == dataset.names
    assert len(loader) == 4


def test_a_small_set_is_not_dropped_whole(dataset: DrivingDataset) -> None:
    small = DrivingDataset(dataset.root, "train", names=dataset.names[:3])
    assert [len(batch) for batch in build_loader(small, EvalTransform(CANVAS), batch_size=16)] == [3]


def test_order_is_a_permutation_without_weights() -> None:
    for epoch in range(5):
        order = epoch_order(100, seed=1, epoch=epoch)
        assert sorted(order.tolist()) == list(range(100))
    assert len({tuple(epoch_order(100, seed=1, epoch=epoch)) for epoch in range(5)}) == 5


def test_weights_set_how_often() -> None:
    weights = np.array([1.0, 1.0, 2.0, 0.0, 0.5])
    total: Counter[int] = Counter()
    for epoch in range(200):
        order = epoch_order(5, seed=0, epoch=epoch, weights=weights, length=9)
        counts = Counter(order.tolist())
        assert len(order) == 9
        for index, weight in enumerate(weights):
            assert np.floor(weight * 2) <= counts[index] <= np.ceil(weight * 2), (epoch, counts)
        total += counts
    assert total[3] == 0
    assert total[4] / total[0] == pytest.approx(0.5, abs=0.05)
    assert total[2] / total[0] == pytest.approx(2.0, abs=0.1)


def test_weights_of_mixed_data_sets_are_used(dataset: DrivingDataset) -> None:
    rare = DrivingDataset(dataset.root, "train", names=dataset.names[:2])
    mixed = MixedDataset([(rare, 6.0), (dataset, 1.0)])
    loader = build_loader(mixed, EvalTransform(CANVAS), batch_size=2)
    names = Counter(name for batch in loader.epoch(0) for name in batch.names)
    assert names[dataset.names[0]] >= 3
    equal = build_loader(MixedDataset([(rare, 2.0), (dataset, 2.0)]), EvalTransform(CANVAS), batch_size=2)
    assert set(Counter(name for batch in equal.epoch(0) for name in batch.names).values()) == {1, 2}


def test_what_is_left_out_is_not_mixed_in_either(dataset: DrivingDataset) -> None:
    mixed: set[str] = set()

    def transform(
        sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample] | None = None
    ) -> Sample:
        assert draw is not None
        mixed.update(draw(rng).name for _ in range(30))
        return EvalTransform(CANVAS)(sample, rng, draw)

    weights = np.ones(len(dataset))
    weights[0] = weights[-1] = 0
    list(build_loader(dataset, transform, batch_size=2, weights=weights))
    assert mixed == set(dataset.names[1:-1])


def test_the_highest_draw_mixes_in_the_last_sample(dataset: DrivingDataset) -> None:
    class Highest(np.random.Generator):
        def random(self, *args: Any, **more: Any) -> Any:
            return np.nextafter(1, 0)

    def transform(
        sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample] | None = None
    ) -> Sample:
        assert draw is not None
        return EvalTransform(CANVAS)(draw(Highest(rng.bit_generator)), rng)

    weights = np.full(len(dataset), 0.1)  # whose sum depends on the order that they are added in
    batch = next(iter(build_loader(dataset, transform, batch_size=1, weights=weights)))
    assert batch.names == (dataset.names[-1],)


def test_length_of_an_epoch(dataset: DrivingDataset) -> None:
    loader = build_loader(dataset, EvalTransform(CANVAS), batch_size=4, samples_per_epoch=40)
    assert len(loader) == 10
    counts = Counter(name for batch in loader.epoch(0) for name in batch.names)
    assert set(counts.values()) <= {2, 3}


def test_settings_are_checked(dataset: DrivingDataset) -> None:
    with pytest.raises(ConfigError, match="batch_size"):
        build_loader(dataset, EvalTransform(CANVAS), batch_size=0)
    with pytest.raises(ConfigError, match="needs shuffle"):
        build_loader(dataset, EvalTransform(CANVAS), batch_size=1, shuffle=False, samples_per_epoch=4)
    with pytest.raises(ConfigError, match="seed at least 0, got 1, 0 and -1"):
        build_loader(dataset, EvalTransform(CANVAS), batch_size=1, seed=-1)
    with pytest.raises(ConfigError, match="no sample"):
        build_loader(DrivingDataset(dataset.root, "train", names=[]), EvalTransform(CANVAS), batch_size=1)
    for weights in (np.ones(3), np.zeros(14), -np.ones(14), np.full(14, np.inf), np.full(14, np.nan)):
        with pytest.raises(ConfigError, match="weights must be 14"):
            build_loader(dataset, EvalTransform(CANVAS), batch_size=1, weights=weights)


def test_no_process_is_left_without_an_image(dataset: DrivingDataset) -> None:
    with pytest.raises(ConfigError, match="2 of 14 images are left for a last batch, too few for 3 processes"):
        build_loader(dataset, EvalTransform(CANVAS), batch_size=6, shuffle=False, share=(0, 3))
    assert len(build_loader(dataset, EvalTransform(CANVAS), batch_size=6, share=(0, 3))) == 2


def test_an_image_is_augmented_anew_in_every_epoch(dataset: DrivingDataset) -> None:
    alone = DrivingDataset(dataset.root, "train", names=dataset.names[:1])
    loader = build_loader(alone, TrainTransform(CANVAS), batch_size=1, seed=3)
    (first,), (second,) = loader.epoch(0), loader.epoch(1)
    assert first.names == second.names
    assert not torch.equal(first.images, second.images)
