from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.engine.labelled import Images, fake_predictor
from trilitenet.engine import provenance
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.provenance import describe_hardware, gpu_index


@pytest.fixture(autouse=True)
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the driver tells of GPUs: nothing yet; PyTorch is not loaded."""
    monkeypatch.setattr(provenance, "_NVIDIA", tmp_path)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    return tmp_path


def add_gpu(driver: Path, bus: str, model: str) -> None:
    (driver / bus).mkdir()
    (driver / bus / "information").write_text(f"Model: \t\t {model}\nIRQ:   \t\t 33\nGPU UUID: \t GPU-1\n")


def load_torch(monkeypatch: pytest.MonkeyPatch, *models: str) -> None:
    cuda = SimpleNamespace(device_count=lambda: len(models), get_device_name=models.__getitem__)
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=cuda))


def test_the_gpu_that_a_loaded_torch_computes_on_is_told(driver: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_gpu(driver, "0000:01:00.0", "NVIDIA L4")
    load_torch(monkeypatch, "NVIDIA H200", "Tesla T4")
    assert describe_hardware("torch cuda") == describe_hardware("torch cpu") + ", NVIDIA H200"
    assert describe_hardware("torch cuda:1 graph").endswith(", Tesla T4")


def test_the_gpu_of_another_runtime_is_told_by_the_driver(driver: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = describe_hardware("onnxruntime cpu fp32")
    assert describe_hardware("tensorrt cuda fp16") == plain  # nothing tells
    add_gpu(driver, "0000:01:00.0", "Tesla T4")
    add_gpu(driver, "0000:02:00.0", "Tesla T4")
    assert describe_hardware("tensorrt cuda fp16") == f"{plain}, Tesla T4"
    load_torch(monkeypatch)  # one without CUDA
    assert describe_hardware("onnxruntime cuda fp32") == f"{plain}, Tesla T4"
    add_gpu(driver, "0000:03:00.0", "NVIDIA H200")  # CUDA has an order of its own
    assert describe_hardware("onnxruntime cuda fp32") == f"{plain}, Tesla T4 or NVIDIA H200"
    assert describe_hardware("onnxruntime cpu fp32") == plain


def test_the_index_of_a_gpu() -> None:
    runtimes = ("torch cuda", "torch cuda:1 graph", "tensorrt cuda fp16", "torch program cuda:12", "openvino cpu fp32")
    assert [gpu_index(runtime) for runtime in runtimes] == [0, 1, 0, 12, None]


def test_a_report_tells_the_gpu_of_its_runtime(driver: Path) -> None:
    add_gpu(driver, "0000:01:00.0", "Tesla T4")
    images = Images(1)
    report = evaluate(fake_predictor(images), images, resamples=0, about={"runtime": "onnxruntime cuda fp32"})
    assert report.provenance.hardware.endswith(", Tesla T4")


def test_torch_is_not_loaded_for_it(driver: Path) -> None:
    add_gpu(driver, "0000:01:00.0", "Tesla T4")
    assert describe_hardware("onnxruntime cuda fp32").endswith(", Tesla T4")
    assert "torch" not in sys.modules
