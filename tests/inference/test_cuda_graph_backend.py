from __future__ import annotations

import collections
import weakref
from typing import Any

import numpy as np
import pytest
import torch

from trilitenet.commands.load import load
from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS
from trilitenet.errors import BackendError, ConfigError, ShapeError
from trilitenet.inference.cuda_graph_backend import CudaGraphBackend, _filled
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.models.weights import load_network

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@pytest.mark.parametrize("layout", ["planar", "pixels", "tiles-tiny"])
def test_half_precision_stays_close(layout: str, rng: np.random.Generator) -> None:
    network = load_network("tiny")
    images = torch.from_numpy(rng.integers(0, 256, (1, 128, 192, 3), dtype=np.uint8))
    with torch.inference_mode():
        wanted = DeployGraph(network, LAYOUTS[layout], masks="probability")(images)
        got = DeployGraph(network, LAYOUTS[layout], masks="probability").reduced(torch.float16)(images)
    assert got.detection.dtype == torch.float32
    # Corners in pixels and scores: half precision inside, none in the decoding.
    assert (got.detection[..., :2] - wanted.detection[..., :2]).abs().max() < 0.25
    assert (got.detection[..., 4:] - wanted.detection[..., 4:]).abs().max() < 0.02
    for mask, fp32 in ((got.drivable, wanted.drivable), (got.lane, wanted.lane)):
        assert mask.dtype == torch.uint8
        assert (mask.float() - fp32.float()).abs().mean() < 1.0


def test_only_half_precisions_are_offered() -> None:
    with pytest.raises(ConfigError, match="float16 or bfloat16"):
        DeployGraph(load_network("tiny")).reduced(torch.int8)


def test_the_cpu_is_refused() -> None:
    network = load_network("tiny")
    with pytest.raises(BackendError, match="need a CUDA device"):
        CudaGraphBackend(DeployGraph(network), network.card, "cpu")


def test_few_shapes_are_captured_and_memory_is_made_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    captured: list[tuple[int, ...]] = []
    room = [True]
    tried: list[weakref.ref[Any]] = []

    def capture(self: CudaGraphBackend, network: object, shape: tuple[int, ...]) -> str:
        large = np.zeros(1)  # what did not fit
        assert not [held for held in tried if held() is not None]
        tried.append(weakref.ref(large))
        if not room[0]:
            room[0] = True
            raise torch.OutOfMemoryError
        captured.append(shape)
        return f"graph of {shape}"

    monkeypatch.setattr(CudaGraphBackend, "_capture", capture)
    backend = object.__new__(CudaGraphBackend)
    backend._graph, backend._card = lambda pixels: (None, None, None), load_network("tiny").card
    backend._captured = collections.OrderedDict()
    for _ in range(3):
        for count in range(1, 9):
            for height in (384, 512):
                shape = _filled((count, height, 640, 3))
                assert str(backend._get(shape)) == f"graph of {shape}"
    assert len(captured) == len(set(captured)) == 8
    assert {shape[0] for shape in captured} == {1, 2, 4, 8}
    assert [_filled((count, 32, 32, 3))[0] for count in (9, 12, 16, 17, 32)] == [16, 16, 16, 24, 32]
    room[0] = False
    backend._get((8, 640, 640, 3))
    assert list(backend._captured) == [(8, 640, 640, 3)]
    room[0] = False
    backend._captured.clear()
    with pytest.raises(torch.OutOfMemoryError):
        backend._get((8, 640, 640, 3))


@needs_cuda
def test_replays_equal_the_network(rng: np.random.Generator) -> None:
    network = load_network("tiny")
    with load("tiny", device="cuda") as predictor:
        assert "graph" in predictor.backend.name
        for batch in (1, 2, 3, 1):
            images = rng.integers(0, 256, (batch, 128, 192, 3), dtype=np.uint8)
            wanted, got = TorchBackend(network, "cpu").run(images), predictor.backend.run(images)
            assert got.detection is not None
            assert wanted.detection is not None
            assert np.abs(got.detection[..., 4:] - wanted.detection[..., 4:]).mean() < 0.005
            for name in ("drivable", "lane"):
                difference = getattr(got, name).astype(float) - getattr(wanted, name)
                assert np.abs(difference).mean() < 1.0


@needs_cuda
def test_sizes_that_are_no_multiple_of_32_are_refused_on_cuda() -> None:
    with load("tiny", device="cuda") as predictor, pytest.raises(ShapeError, match="multiples of 32"):
        predictor.backend.run(np.zeros((1, 100, 192, 3), np.uint8))
