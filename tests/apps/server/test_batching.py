from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.apps.server.batching import Admission, Batcher, split
from trilitenet.apps.server.problems import BusyError
from trilitenet.structures import RawOutputs

LATER = float("inf")


class Network:
    """Answers with the first byte of each canvas, and waits for the gate before it does."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.started = threading.Semaphore(0)
        self.batches: list[list[int]] = []
        self.error: Exception | None = None

    def __call__(self, batch: NDArray[np.uint8]) -> RawOutputs:
        self.started.release()
        assert self.gate.wait(10)
        self.batches.append([int(canvas[0, 0, 0]) for canvas in batch])
        if self.error is not None:
            raise self.error
        return RawOutputs(None, batch[..., 0].copy(), None)


@pytest.fixture
def network() -> Network:
    return Network()


@pytest.fixture
def batcher(network: Network) -> Iterator[Batcher]:
    batcher = Batcher(network, max_batch=3)
    batcher.start()
    yield batcher
    network.gate.set()
    batcher.close(10)
    assert not batcher.alive


def canvas(value: int, size: int = 4) -> NDArray[np.uint8]:
    return np.full((size, size, 3), value, np.uint8)


def value(result: tuple[RawOutputs, float, float, int]) -> int:
    assert result[0].drivable is not None
    return int(result[0].drivable[0, 0, 0])


def test_what_gathers_while_the_network_runs_is_one_batch(network: Network, batcher: Batcher) -> None:
    first = batcher.submit(canvas(0), LATER)
    assert network.started.acquire(timeout=5)
    others = [batcher.submit(canvas(i), LATER) for i in range(1, 6)]
    assert batcher.length == 5
    network.gate.set()
    assert [value(future.result(5)) for future in [first, *others]] == [0, 1, 2, 3, 4, 5]
    assert network.batches == [[0], [1, 2, 3], [4, 5]]
    assert [future.result(5)[3] for future in others] == [3, 3, 3, 2, 2]


def test_shapes_do_not_mix_and_the_oldest_goes_first(network: Network, batcher: Batcher) -> None:
    batcher.submit(canvas(0), LATER)
    assert network.started.acquire(timeout=5)
    sizes = [(1, 8), (2, 4), (3, 8), (4, 4)]
    futures = [batcher.submit(canvas(i, size), LATER) for i, size in sizes]
    network.gate.set()
    assert [value(future.result(5)) for future in futures] == [1, 2, 3, 4]
    assert network.batches == [[0], [1, 3], [2, 4]]


def test_the_cancelled_and_the_late_are_left_out(network: Network, batcher: Batcher) -> None:
    batcher.submit(canvas(0), LATER)
    assert network.started.acquire(timeout=5)
    gone = batcher.submit(canvas(1), LATER)
    late = batcher.submit(canvas(2), time.monotonic() - 1)
    good = batcher.submit(canvas(3), LATER)
    assert gone.cancel()
    network.gate.set()
    assert value(good.result(5)) == 3
    with pytest.raises(BusyError, match="too long"):
        late.result(5)
    with pytest.raises(CancelledError):
        gone.result(5)
    assert network.batches == [[0], [3]]


def test_a_failing_batch_fails_alone(network: Network, batcher: Batcher) -> None:
    network.gate.set()
    network.error = RuntimeError("no")
    with pytest.raises(RuntimeError, match="no"):
        batcher.submit(canvas(0), LATER).result(5)
    network.error = None
    assert value(batcher.submit(canvas(1), LATER).result(5)) == 1


def test_closing_finishes_what_waits_and_takes_no_more(network: Network) -> None:
    batcher = Batcher(network, max_batch=1)
    batcher.start()
    futures = [batcher.submit(canvas(i), LATER) for i in range(4)]
    threading.Timer(0.05, network.gate.set).start()
    batcher.close(10)
    assert [value(future.result(0)) for future in futures] == [0, 1, 2, 3]
    with pytest.raises(BusyError, match="closing"):
        batcher.submit(canvas(9), LATER)


def test_a_delay_waits_for_company(network: Network) -> None:
    sizes: list[int] = []
    batcher = Batcher(network, max_batch=2, delay=5.0, observe=sizes.append)
    network.gate.set()
    batcher.start()
    futures = [batcher.submit(canvas(0), LATER)]
    time.sleep(0.1)
    futures.append(batcher.submit(canvas(1), LATER))
    for future in futures:
        future.result(2)
    batcher.close(10)
    assert network.batches == [[0, 1]]
    assert sizes == [2]


class Clock:
    """Seconds that pass when a test says so."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_the_time_in_the_queue_and_that_in_the_network_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("trilitenet.apps.server.batching.time", SimpleNamespace(monotonic=clock))

    def run(batch: NDArray[np.uint8]) -> RawOutputs:
        clock.now += 3
        return RawOutputs(None, batch[..., 0].copy(), None)

    batcher = Batcher(run, max_batch=1)
    future = batcher.submit(canvas(0), LATER)
    clock.now += 2
    batcher.start()
    assert future.result(5)[1:] == (2.0, 3.0, 1)
    batcher.close(10)


def test_admission_counts_and_tells_how_long_to_wait() -> None:
    clock = Clock()
    admission = Admission(4, clock=clock)
    clock.now += 500
    admission.observe(1)  # the first run, before any request, teaches nothing
    assert admission.seconds_each == 0.1
    clock.now += 500
    admission.enter(3)
    with pytest.raises(BusyError):
        admission.enter(2)
    admission.enter(1)
    for _ in range(50):
        clock.now += 4.0
        admission.observe(2)
    for call in (admission.check, admission.enter):
        with pytest.raises(BusyError) as caught:
            call()
        assert caught.value.code == "queue_full"
        assert int(caught.value.headers["retry-after"]) == 8
    admission.leave(4)
    assert admission.taken == 0


def test_a_slow_machine_gives_fewer_places_away() -> None:
    clock = Clock()
    admission = Admission(64, patience=6.0, clock=clock)
    admission.enter(10)
    for _ in range(100):
        clock.now += 1.0
        admission.observe(1)
    with pytest.raises(BusyError, match="would take 10 s") as caught:
        admission.enter()
    assert caught.value.code == "queue_slow"
    admission.leave(5)
    admission.enter(1)
    assert admission.taken == 6
    # An image that takes longer than the patience alone still enters, and so does the next: else nothing ever would.
    admission.leave(6)
    for _ in range(100):
        admission.enter()
        clock.now += 60.0
        admission.observe(1)
        admission.leave()
    admission.enter(1)
    admission.enter(1)
    with pytest.raises(BusyError):
        admission.check()
    # It recovers with the machine.
    for _ in range(100):
        clock.now += 0.01
        admission.observe(1)
    admission.enter(62)


def test_one_that_enters_later_does_not_shorten_what_the_first_took() -> None:
    clock = Clock()
    admission = Admission(4, clock=clock)
    admission.enter()
    clock.now += 5.0
    admission.enter()
    clock.now += 5.0
    admission.observe(1)
    assert admission.seconds_each == pytest.approx(0.1 + 0.1 * (10.0 - 0.1))


@pytest.mark.parametrize("missing", ["detection", "drivable", "lane"])
def test_split_gives_views_and_keeps_what_is_missing(missing: str) -> None:
    outputs: dict[str, Any] = {
        "detection": np.arange(24, dtype=np.float32).reshape(2, 2, 6),
        "drivable": np.arange(8, dtype=np.uint8).reshape(2, 2, 2),
        "lane": np.arange(8, dtype=np.uint8).reshape(2, 2, 2),
    }
    outputs[missing] = None
    pieces = split(RawOutputs(**outputs), 2)
    for name, whole in outputs.items():
        for index, piece in enumerate(pieces):
            part = getattr(piece, name)
            if whole is None:
                assert part is None
            else:
                np.testing.assert_array_equal(part, whole[index : index + 1])
                assert part.base is not None


def test_time_that_went_to_refused_images_is_not_charged_to_the_next() -> None:
    clock = Clock()
    admission = Admission(64, patience=6.0, clock=clock)
    admission.enter(3)
    for _ in range(100):
        clock.now += 1.0
        admission.skip()
    clock.now += 0.1
    admission.observe(1)
    assert admission.seconds_each == pytest.approx(0.1)
    admission.enter(10)
