from __future__ import annotations

import dataclasses
import os
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

import trilitenet
from trilitenet.config import ARTEFACT_KEY, CARD_KEY, ArtefactInfo, ModelCard
from trilitenet.errors import BackendError, ShapeError
from trilitenet.inference.exported_torch_backend import ExportedTorchBackend
from trilitenet.inference.torch_backend import TorchBackend, check_threads, pick_device
from trilitenet.models.trilitenet import build_network


@pytest.fixture
def backend() -> TorchBackend:
    torch.manual_seed(0)
    return TorchBackend(build_network("tiny"), "cpu")


def test_outputs_are_the_networks(backend: TorchBackend, rng: np.random.Generator) -> None:
    batch = rng.integers(0, 256, (2, 64, 96, 3), dtype=np.uint8)
    raw = backend.run(batch)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    images = torch.from_numpy(((batch / 255 - mean) / std).transpose(0, 3, 1, 2)).float()
    with torch.no_grad():
        outputs = backend.network(images)
        expected = backend.network.decode(outputs).numpy()
    assert raw.detection is not None
    np.testing.assert_allclose(raw.detection, expected, rtol=1e-4, atol=1e-4)
    for mask, logits in ((raw.drivable, outputs.drivable), (raw.lane, outputs.lane)):
        assert logits is not None
        probability = logits.softmax(1)[:, 1].numpy() * 255
        assert mask is not None
        assert mask.shape == (2, 64, 96)
        assert np.abs(mask.astype(float) - probability).max() <= 0.51


def test_a_batch_is_the_same_as_its_images(backend: TorchBackend, rng: np.random.Generator) -> None:
    batch = rng.integers(0, 256, (3, 64, 96, 3), dtype=np.uint8)
    together = backend.run(batch).detection
    assert together is not None
    for i in range(3):
        alone = backend.run(batch[i : i + 1]).detection
        assert alone is not None
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-3, atol=1e-3)


def test_tasks_it_lacks_are_none() -> None:
    raw = TorchBackend(build_network("tiny", tasks=("lane",)), "cpu").run(np.zeros((1, 64, 64, 3), np.uint8))
    assert raw.detection is None
    assert raw.drivable is None
    assert raw.lane is not None


def test_name_and_canvas(backend: TorchBackend) -> None:
    assert backend.name == "torch cpu"
    assert backend.canvas is None
    assert backend.card.variant == "tiny"


def test_a_closed_model_says_so_and_is_free(backend: TorchBackend) -> None:
    network = weakref.ref(backend.network)
    backend.close()
    backend.close()
    assert network() is None
    assert (backend.name, backend.card.variant) == ("torch cpu", "tiny")
    with pytest.raises(BackendError, match=r"tiny: the model was closed; load it again"):
        backend.run(np.zeros((1, 64, 64, 3), np.uint8))


def test_sizes_that_are_no_multiple_of_32_are_refused(backend: TorchBackend) -> None:
    with pytest.raises(ShapeError, match="multiples of 32"):
        backend.run(np.zeros((1, 60, 96, 3), np.uint8))
    with pytest.raises(ShapeError, match="multiples of 32"):
        backend.run(np.zeros((1, 64, 90, 3), np.uint8))


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate ..."),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: ..."),
        MemoryError(),
    ],
)
def test_too_large_a_batch_is_one_line(
    error: Exception, backend: TorchBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forward(*_: object) -> None:
        raise error

    monkeypatch.setattr(backend.network, "forward", forward)
    with pytest.raises(BackendError, match="torch cpu is out of memory for 2 images of 96x64; use a smaller batch or"):
        backend.run(np.zeros((2, 64, 96, 3), np.uint8))
    with pytest.raises(BackendError, match="torch cpu is out of memory for an image of 96x64; use a smaller size"):
        backend.run(np.zeros((1, 64, 96, 3), np.uint8))


@pytest.mark.parametrize("device", ["cuda:99", "nonsense", "meta:x", "hpu"])
def test_a_device_that_is_not_there_is_named(device: str) -> None:
    with pytest.raises(BackendError, match=device):
        pick_device(device)


def test_of_an_unknown_device_those_that_there_are_are_told() -> None:
    with pytest.raises(BackendError, match=r"^unknown device 'gpu'; use auto, cpu, cuda, cuda:1 \(.*\) or mps$"):
        pick_device("gpu")


@pytest.mark.skipif(torch.backends.mps.is_available(), reason="a machine that has MPS")
def test_of_a_long_reason_the_first_sentence_is_told() -> None:
    with pytest.raises(BackendError, match=r"^device 'mps' cannot be used \(.*\); try 'cpu'$") as caught:
        pick_device("mps")
    assert ". " not in str(caught.value)


def test_auto_finds_a_device() -> None:
    assert pick_device().type in {"cpu", "cuda", "mps"}


def test_in_parallel_each_thread_has_cores_of_its_own(backend: TorchBackend, rng: np.random.Generator) -> None:
    batches = [rng.integers(0, 256, (1, 64, 96, 3), dtype=np.uint8) for _ in range(8)]
    alone = [backend.run(batch).detection for batch in batches]
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        with backend.in_parallel() as runners, ThreadPoolExecutor(runners) as pool:
            assert runners == 4
            assert pool.submit(torch.get_num_threads).result() == 1
            together = list(pool.map(lambda batch: backend.run(batch).detection, batches))
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)  # type: ignore[arg-type]


@pytest.mark.parametrize("first_leaves_first", [True, False])
def test_two_uses_in_parallel_share_threads_and_the_last_one_restores(
    backend: TorchBackend, first_leaves_first: bool
) -> None:
    def of_new_threads() -> int:
        with ThreadPoolExecutor(1) as new:
            return new.submit(torch.get_num_threads).result()

    before = torch.get_num_threads()
    torch.set_num_threads(8)
    try:
        with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as two:
            threads = [one, two]
            assert [each.submit(torch.get_num_threads).result() for each in threads] == [8, 8]
            uses = [TorchBackend(backend.network, "cpu").in_parallel() for _ in threads]
            assert [each.submit(use.__enter__).result() for each, use in zip(threads, uses, strict=True)] == [4, 4]
            assert of_new_threads() == 2
            leaving = [0, 1] if first_leaves_first else [1, 0]
            for index in leaving:
                assert of_new_threads() == 2
                threads[index].submit(uses[index].__exit__, None, None, None).result()
            assert [each.submit(torch.get_num_threads).result() for each in threads] == [8, 8]
        assert of_new_threads() == torch.get_num_threads() == 8
    finally:
        torch.set_num_threads(before)


def test_batches_are_checked_and_left_as_they_are() -> None:
    backend = TorchBackend(build_network("tiny", tasks=("lane",)), "cpu")
    for batch in (
        np.zeros((1, 64, 64, 3), np.float32),
        np.zeros((64, 64, 3), np.uint8),
        np.zeros((0, 64, 64, 3), np.uint8),
        np.zeros((1, 64, 0, 3), np.uint8),
    ):
        with pytest.raises(ShapeError, match="a batch must be"):
            backend.run(batch)  # type: ignore[arg-type]
    image = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3), np.uint8)
    lane = backend.run(image[..., ::-1]).lane
    assert lane is not None
    np.testing.assert_array_equal(lane, backend.run(np.ascontiguousarray(image[..., ::-1])).lane)


def test_pixels_are_normalised_as_the_card_says(rng: np.random.Generator) -> None:
    network = build_network("tiny", tasks=("lane",)).eval()
    network.card = dataclasses.replace(network.card, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
    batch = rng.integers(0, 256, (1, 64, 96, 3), dtype=np.uint8)
    with torch.no_grad():
        lane = network(torch.from_numpy((batch / 255).transpose(0, 3, 1, 2)).float()).lane
    found = TorchBackend(network, "cpu").run(batch).lane
    assert lane is not None
    assert found is not None
    assert np.abs(found - lane.softmax(1)[:, 1].numpy() * 255).max() <= 0.51


def test_a_program_stays_the_same_where_the_process_changes_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    metadata = {CARD_KEY: ModelCard("tiny").to_json(), ARTEFACT_KEY: ArtefactInfo("torch", size=(64, 128)).to_json()}
    program = torch.export.export(torch.nn.Identity(), (torch.zeros(1),))
    torch.export.save(program, tmp_path / "a.pt2", extra_files=metadata)
    monkeypatch.chdir(tmp_path)
    backend = ExportedTorchBackend("a.pt2")
    monkeypatch.chdir(Path(__file__).parent)
    assert pickle.loads(pickle.dumps(backend)).canvas == (64, 128)  # noqa: S301 - its own


def test_a_fork_is_told_that_it_lacks_the_threads(backend: TorchBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = np.zeros((1, 64, 64, 3), np.uint8)
    monkeypatch.setattr("trilitenet.inference.torch_backend._parallel_in", None)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    check_threads()
    backend.run(batch)
    monkeypatch.setattr(os, "getpid", lambda: -1)
    for use in (lambda: backend.run(batch), lambda: trilitenet.load("tiny"), lambda: trilitenet.load("a.pt2")):
        with pytest.raises(BackendError, match="before this process was forked; load the model with threads=1"):
            use()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    assert backend.run(batch).lane is not None
