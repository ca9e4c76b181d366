from __future__ import annotations

import importlib.util
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import trilitenet
from tests.artefacts import SIZE, Artefacts
from tests.deploy.networks import lively_network
from tests.deploy.test_graph import by_cell
from tests.fakes import ColourBackend
from trilitenet.config import TASKS, VARIANTS, Task, Thresholds
from trilitenet.errors import BackendError, ConfigError, ShapeError, WeightsError
from trilitenet.inference.openvino_backend import OpenVINOBackend
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import save_network


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    network = build_network("tiny")
    save_network(network, tmp_path / "random.safetensors", network.card)
    return tmp_path / "random.safetensors"


def test_load_gives_a_predictor(weights: Path) -> None:
    predictor = trilitenet.load(weights, device="cpu")
    assert isinstance(predictor, trilitenet.Predictor)
    perception = predictor(np.zeros((90, 160, 3), np.uint8))
    assert perception.size == (90, 160)
    assert perception.draw().shape == (90, 160, 3)
    assert perception.to_dict()["size"] == {"height": 90, "width": 160}


def test_a_device_may_be_that_of_pytorch(weights: Path) -> None:
    assert trilitenet.load(weights, device=torch.device("cpu")).backend.name == "torch cpu graph"
    with pytest.raises(BackendError, match=r"'cuda:99'"):
        trilitenet.load(weights, device=torch.device("cuda", 99))


def test_thresholds_can_be_overridden_one_by_one(weights: Path) -> None:
    predictor = trilitenet.load(weights, device="cpu", confidence=0.7, lane=0.2)
    assert predictor.thresholds == Thresholds(confidence=0.7, lane=0.2)
    predictor = trilitenet.load(weights, device="cpu", confidence=0.0, iou=0.0, batch_size=3)
    assert predictor.thresholds == Thresholds(confidence=0.0, iou=0.0)
    assert predictor.batch_size == 3


def test_a_model_whose_thresholds_are_refused_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = ColourBackend()
    monkeypatch.setattr("trilitenet.commands.load.open_backend", lambda *_: backend)
    with pytest.raises(ConfigError, match="confidence must be between 0 and 1"):
        trilitenet.load("a.onnx", confidence=7)
    assert backend.closed == 1


def test_the_runtime_that_is_there_is_taken(artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "openvino" else plain(name))
    assert trilitenet.load(artefacts.folder / "model.onnx").backend.name == "onnxruntime cpu fp32"


def test_endings_may_be_in_capitals(artefacts: Artefacts, tmp_path: Path) -> None:
    shutil.copy(artefacts.folder / "model.onnx", tmp_path / "MODEL.ONNX")
    assert trilitenet.load(tmp_path / "MODEL.ONNX", threads=1).backend.canvas == SIZE


def test_a_folder_called_like_a_model_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "a.param").touch()
    monkeypatch.chdir(tmp_path)
    assert trilitenet.load("tiny", device="cpu").backend.name == "torch cpu graph"


@pytest.mark.parametrize(
    ("classes", "tasks"), [(1, TASKS), (10, TASKS), (2, ("detection",)), (1, ("drivable",)), (1, ("lane",))]
)
@pytest.mark.parametrize("variant", VARIANTS)
def test_on_a_cpu_weights_run_as_their_deploy_graph(
    tmp_path: Path, variant: str, classes: int, tasks: tuple[Task, ...], rng: np.random.Generator
) -> None:
    network = lively_network(variant, classes=classes, tasks=tasks)
    save_network(network, tmp_path / "net.safetensors", network.card)
    plain = trilitenet.load(tmp_path / "net.safetensors", device="cpu", backend="torch")
    graph = trilitenet.load(tmp_path / "net.safetensors", device="cpu")
    assert (plain.backend.name, graph.backend.name) == ("torch cpu", "torch cpu graph")
    assert graph.backend.canvas is None
    for size, batch in (((96, 160), 1), ((64, 96), 2)):
        images = rng.integers(0, 256, (batch, *size, 3), np.uint8)
        wanted, got = plain.backend.run(images), graph.backend.run(images)
        assert (got.detection is None) == ("detection" not in tasks)
        if got.detection is not None and wanted.detection is not None:
            assert got.detection.dtype == np.float32
            reordered = by_cell(torch.from_numpy(wanted.detection), *size).numpy()
            np.testing.assert_allclose(got.detection, reordered, rtol=1e-3, atol=1e-3)
        for task in ("drivable", "lane"):
            mask, same = getattr(got, task), getattr(wanted, task)
            assert (mask is None) == (task not in tasks)
            if mask is not None:
                assert mask.dtype == np.uint8
                assert np.abs(mask.astype(int) - same).max() <= 1  # rounded, of 255
    with pytest.raises(ShapeError, match="multiples of 32"):
        graph.backend.run(np.zeros((1, 60, 96, 3), np.uint8))
    copy = pickle.loads(pickle.dumps(graph))  # noqa: S301 - its own
    np.testing.assert_array_equal(copy.perceive([images[0]])[0].draw(), graph.perceive([images[0]])[0].draw())
    graph.close()
    assert graph.backend.name == "torch cpu graph"
    with pytest.raises(BackendError, match="the model was closed; load it again"):
        graph.backend.run(images)


def test_what_is_asked_of_openvino_reaches_it(artefacts: Artefacts) -> None:
    backend = trilitenet.load(artefacts.folder / "model.xml", threads=1, streams=2).backend
    assert isinstance(backend, OpenVINOBackend)
    assert (backend._threads, backend.streams) == (1, 2)
    with pytest.raises(ConfigError, match=r"model\.xml runs on openvino, not on torch$"):
        trilitenet.load(artefacts.folder / "model.xml", backend="torch")


def test_another_size_than_an_artefact_takes_is_refused(artefacts: Artefacts) -> None:
    file = artefacts.folder / "model.onnx"
    with pytest.raises(ConfigError, match=f"model.onnx: its input is fixed to {SIZE[1]}x{SIZE[0]}"):
        trilitenet.load(file, long_side=1280)
    assert trilitenet.load(file, long_side=max(SIZE)).backend.canvas == SIZE


def test_masks_that_are_decided_inside_take_no_thresholds(artefacts: Artefacts) -> None:
    assert trilitenet.load(artefacts.folder / "model.onnx", confidence=0.6).thresholds.confidence == 0.6
    with pytest.raises(ConfigError, match="--masks probability"):
        trilitenet.load(artefacts.folder / "model.onnx", drivable=0.7)


@pytest.mark.parametrize(
    ("backend", "format"),
    [
        ("onnxruntime", "onnx"),
        ("openvino", "openvino"),
        ("ncnn", "ncnn"),
        ("executorch", "executorch"),
        ("tensorrt", "tensorrt"),
    ],
)
def test_a_runtime_that_weights_do_not_run_on_tells_its_export(backend: str, format: str) -> None:
    with pytest.raises(ConfigError, match=f"trilitenet export tiny --format {format}$"):
        trilitenet.load("tiny", backend=backend)


@pytest.mark.parametrize("options", [{"threads": 0}, {"threads": -1}, {"streams": 0}])
def test_counts_below_one_are_refused_before_a_runtime_sees_them(options: dict[str, int]) -> None:
    ((name, count),) = options.items()
    with pytest.raises(ConfigError, match=f"^{name} must be at least 1, got {count}$"):
        trilitenet.load("no.ncnn.param", threads=options.get("threads"), streams=options.get("streams", 1))


def test_threads_are_those_of_pytorch_too(weights: Path) -> None:
    before = torch.get_num_threads()
    try:
        trilitenet.load(weights, device="cpu", threads=before + 1)
        assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)


def test_mistakes_are_named(weights: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'torch'"):
        trilitenet.load(weights, backend="toch")
    with pytest.raises(ConfigError, match="confidence must be between 0 and 1"):
        trilitenet.load(weights, device="cpu", confidence=7)
    with pytest.raises(BackendError, match="cuda:99"):
        trilitenet.load(weights, device="cuda:99")
    with pytest.raises(WeightsError, match="does not exist"):
        trilitenet.load("nowhere.safetensors")
