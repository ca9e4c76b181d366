"""ONNX Runtime and OpenVINO on exported artefacts: parity, metadata, refusals, and no PyTorch."""

from __future__ import annotations

import copy
import ctypes
import dataclasses
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import types
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trilitenet
from tests.artefacts import SIZE, Artefacts, check_backend
from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.onnx import save_onnx
from trilitenet.errors import BackendError, ConfigError, ShapeError, WeightsError
from trilitenet.inference.exported import (
    ArtefactBackend,
    gather_outputs,
    is_int8_onnx,
    prepare_input,
    read_metadata,
    read_onnx_metadata,
)
from trilitenet.inference.ncnn_backend import NcnnBackend
from trilitenet.inference.onnx_backend import OnnxBackend
from trilitenet.inference.openvino_backend import OpenVINOBackend
from trilitenet.inference.tensorrt_backend import MAGIC, TensorRTBackend, pack_engine, unpack_engine

BACKENDS = [
    pytest.param("model.onnx", OnnxBackend, {}, 0.9999, 0.01, id="onnxruntime"),
    pytest.param("model.onnx", OpenVINOBackend, {}, 0.9999, 0.01, id="openvino-onnx"),
    pytest.param("model.xml", OpenVINOBackend, {"precision": "fp32"}, 0.9999, 0.01, id="openvino-fp32"),
    pytest.param("model.xml", OpenVINOBackend, {"streams": 2}, 0.97, 8.0, id="openvino-bf16-streams"),
]


def need(kind: type) -> None:
    """Skip the test where what makes and runs such artefacts is not installed."""
    if kind is NcnnBackend:
        pytest.importorskip("pnnx")
        pytest.importorskip("ncnn")


@pytest.mark.parametrize(("name", "kind", "options", "pixels", "error"), BACKENDS)
def test_equals_the_network(
    artefacts: Artefacts, name: str, kind: Any, options: dict[str, Any], pixels: float, error: float
) -> None:
    check_backend(kind(artefacts.folder / name, **options), artefacts, pixels=pixels, error=error)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("model.onnx", OnnxBackend), ("model.xml", OpenVINOBackend), ("model.ncnn.param", NcnnBackend)],
)
def test_in_parallel_gives_the_same(artefacts: Artefacts, name: str, kind: Any) -> None:
    need(kind)
    backend = kind(artefacts.folder / name, threads=3)
    images = [artefacts.images[index % len(artefacts.images)][None] for index in range(12)]
    alone = [backend.run(image) for image in images]
    with backend.in_parallel() as runners, ThreadPoolExecutor(runners) as pool:
        assert runners == 3
        together = list(pool.map(backend.run, images))
    for one, other, after in zip(alone, together, map(backend.run, images), strict=True):
        for got in (other, after):
            assert one.detection is not None
            assert got.detection is not None
            np.testing.assert_allclose(got.detection, one.detection, rtol=1e-3, atol=1e-3)
            assert np.mean(got.lane == one.lane) > 0.999


@pytest.mark.parametrize(
    ("name", "kind", "held"), [("model.onnx", OnnxBackend, "_session"), ("model.xml", OpenVINOBackend, "_idle")]
)
def test_two_uses_in_parallel_share_and_the_last_one_restores(
    artefacts: Artefacts, name: str, kind: Any, held: str
) -> None:
    backend = kind(artefacts.folder / name, threads=2)
    before = getattr(backend, held)
    for _ in range(2):
        first, second = backend.in_parallel(), backend.in_parallel()
        assert first.__enter__() == 2
        shared = getattr(backend, held)
        assert shared is not before
        assert second.__enter__() == 2
        assert getattr(backend, held) is shared
        first.__exit__(None, None, None)
        assert getattr(backend, held) is shared
        second.__exit__(None, None, None)
        assert getattr(backend, held) is before


def test_the_first_two_images_of_a_process_may_come_at_once(artefacts: Artefacts) -> None:
    program = f"""
import threading, numpy as np
from trilitenet.inference.openvino_backend import OpenVINOBackend
backend = OpenVINOBackend({str(artefacts.folder / "model.xml")!r}, streams=2)
barrier = threading.Barrier(2)
def work():
    barrier.wait()
    backend.run(np.zeros((1, {SIZE[0]}, {SIZE[1]}, 3), np.uint8))
threads = [threading.Thread(target=work) for _ in range(2)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("model.onnx", OnnxBackend), ("model.xml", OpenVINOBackend), ("model.ncnn.param", NcnnBackend)],
)
def test_a_predictor_goes_to_other_processes(artefacts: Artefacts, name: str, kind: Any) -> None:
    need(kind)
    predictor = trilitenet.Predictor(kind(artefacts.folder / name, threads=1), batch_size=3)
    again = pickle.loads(pickle.dumps(predictor))  # noqa: S301 - its own
    assert (again.backend.name, again.batch_size) == (predictor.backend.name, 3)
    assert again.backend._threads == 1
    for one, other in zip(predictor([*artefacts.images]), again([*artefacts.images]), strict=True):
        assert one.lane is not None
        np.testing.assert_array_equal(other.lane, one.lane)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("model.onnx", OnnxBackend), ("model.xml", OpenVINOBackend), ("model.ncnn.param", NcnnBackend)],
)
def test_another_process_may_work_in_another_folder(
    artefacts: Artefacts, name: str, kind: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(kind)
    monkeypatch.chdir(artefacts.folder)
    data = pickle.dumps(kind(name))
    monkeypatch.chdir(tmp_path)
    assert pickle.loads(data).canvas == SIZE  # noqa: S301 - its own


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("model.onnx", OnnxBackend),
        ("model.onnx", OpenVINOBackend),
        ("model.xml", OpenVINOBackend),
        ("model.ncnn.param", NcnnBackend),
    ],
)
def test_a_model_stays_the_same_where_the_process_changes_its_folder(
    artefacts: Artefacts, name: str, kind: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(kind)
    monkeypatch.chdir(artefacts.folder)
    backend = kind(name, threads=2)
    monkeypatch.chdir(tmp_path)
    with backend.in_parallel() as runners:
        assert runners == 2
    assert pickle.loads(pickle.dumps(backend)).canvas == SIZE  # noqa: S301 - its own
    assert copy.deepcopy(backend).canvas == SIZE
    backend.close()
    with pytest.raises(BackendError, match=f"^{re.escape(name)}: the model was closed"):  # as it was given
        backend.run(artefacts.images)


def test_streams_and_precision_go_with_it(artefacts: Artefacts) -> None:
    backend = OpenVINOBackend(artefacts.folder / "model.xml", precision="fp32", streams=2)
    assert backend.name == "openvino cpu fp32 x2"
    assert pickle.loads(pickle.dumps(backend)).name == backend.name  # noqa: S301 - its own


def test_a_precision_that_the_processor_has_not_is_computed_in_fp32(
    artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    from trilitenet.inference import openvino_backend

    class Core:
        def __init__(self, core: Any) -> None:
            self.core = core

        def __getattr__(self, name: str) -> Any:
            return getattr(self.core, name)

        def get_property(self, device: str, name: str) -> list[str]:
            return ["FP32", "INT8"]

    plain = openvino_backend.openvino_core
    monkeypatch.setattr(openvino_backend, "openvino_core", lambda openvino: Core(plain(openvino)))
    assert OpenVINOBackend(artefacts.folder / "model.xml").name == "openvino cpu fp32"


def test_signals_may_come_after_models_were_dropped(artefacts: Artefacts) -> None:
    program = f"""
import gc, os, signal
from trilitenet.inference.openvino_backend import OpenVINOBackend
first, second = [OpenVINOBackend({str(artefacts.folder / "model.xml")!r}) for _ in range(2)]
del first
gc.collect()
del second
gc.collect()
caught = []
signal.signal(signal.SIGUSR1, lambda *_: caught.append(1))
os.kill(os.getpid(), signal.SIGUSR1)
assert caught
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.parametrize(("name", "kind"), [("model.xml", OpenVINOBackend), ("model.ncnn.param", NcnnBackend)])
def test_a_fork_is_told_to_load_the_model_itself(
    artefacts: Artefacts, name: str, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = kind(artefacts.folder / name)
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with pytest.raises(BackendError, match="before this process was forked; load it in this process"):
        backend.run(np.zeros((1, *backend.canvas, 3), np.uint8))


def test_an_interruption_leaves_every_request_idle(artefacts: Artefacts) -> None:
    interruptions = [KeyboardInterrupt()]

    class Request:
        def __init__(self, request: Any) -> None:
            self.request = request

        def __getattr__(self, name: str) -> Any:
            return getattr(self.request, name)

        def wait(self) -> None:
            if interruptions:
                raise interruptions.pop()
            self.request.wait()

    backend = OpenVINOBackend(artefacts.folder / "model.xml", streams=2)
    assert backend._idle is not None
    for _ in range(2):
        backend._idle.put(Request(backend._idle.get()))
    images = np.concatenate([artefacts.images] * 3)
    with pytest.raises(KeyboardInterrupt):
        backend.run(images)
    assert backend._idle.qsize() == 2
    lane = backend.run(images).lane
    assert lane is not None
    assert len(lane) == len(images)


def any_size(folder: Path) -> Path:
    """Write an artefact of any size: its lane is where a pixel's red, green and blue are above 100 on average."""
    openvino = pytest.importorskip("openvino")
    from trilitenet.deploy.openvino import save_openvino

    ops = openvino.opset13
    image = ops.parameter(openvino.PartialShape([1, -1, -1, 3]), np.uint8, "image")
    mean = ops.reduce_mean(ops.convert(image, "f32"), np.array([3]))
    lane = ops.convert(ops.greater(mean, np.float32(100)), "u8")
    lane.output(0).set_names({"lane"})
    card, info = ModelCard("tiny", tasks=("lane",)), ArtefactInfo("openvino", size=None)
    save_openvino(openvino.Model([ops.result(lane)], [image], "g"), folder / "any.xml", card, info)
    return folder / "any.xml"


def check_lane(backend: OpenVINOBackend, height: int, width: int, count: int = 1) -> None:
    """Run the artefact of `any_size` on images of a size, and check what it returns."""
    images = np.random.default_rng(height + width).integers(0, 256, (count, height, width, 3), np.uint8)
    lane = backend.run(images).lane
    assert lane is not None
    np.testing.assert_array_equal(lane, 255 * (images.mean(3) > 100))


def compiled_for(backend: OpenVINOBackend) -> list[tuple[int, ...]]:
    """Return the shapes for which an idle backend is compiled, the one last used last, and check its requests."""
    assert backend._idle is not None
    request = backend._idle.get()
    backend._idle.put(request)
    for shape, requests in request._sizes._requests.items():
        assert len(requests) == backend._idle.qsize()
        assert all(tuple(each.get_compiled_model().inputs[0].shape) == shape for each in requests)
    return list(request._sizes._requests)


def test_a_size_that_keeps_coming_is_compiled_for(tmp_path: Path) -> None:
    backend = OpenVINOBackend(any_size(tmp_path), threads=1)
    assert backend.canvas is None
    assert backend._idle is not None
    request = backend._idle.get()
    backend._idle.put(request)
    plain = request._request
    for times in range(1, 9):  # by turns, as photos of two forms come
        for size in ((64, 96), (96, 64)):
            check_lane(backend, *size)
            assert (request._used is plain) == (times < 5)
    assert compiled_for(backend) == [(1, 64, 96, 3), (1, 96, 64, 3)]
    assert request._used is request._sizes._requests[1, 96, 64, 3][0]
    check_lane(backend, 64, 96)
    assert compiled_for(backend) == [(1, 96, 64, 3), (1, 64, 96, 3)]
    check_lane(backend, 32, 32, count=7)
    for width in (64, 96, 128):
        check_lane(backend, 32, width, count=5)
    assert compiled_for(backend) == [(1, 32, width, 3) for width in (32, 64, 96, 128)]  # those longest unused are gone
    again = pickle.loads(pickle.dumps(backend))  # noqa: S301 - its own
    backend.close()
    with pytest.raises(BackendError, match="the model was closed"):
        check_lane(backend, 32, 32)
    check_lane(again, 32, 32, count=5)
    assert compiled_for(again) == [(1, 32, 32, 3)]


def test_sizes_that_seldom_come_are_not_compiled_for(tmp_path: Path) -> None:
    backend = OpenVINOBackend(any_size(tmp_path), threads=1)
    for _ in range(8):
        for width in (32, 64, 96, 128):
            check_lane(backend, 64, width)
    assert not compiled_for(backend)


def test_a_size_that_cannot_be_compiled_for_is_computed_all_the_same(tmp_path: Path) -> None:
    class Model:
        def clone(self) -> Any:
            raise RuntimeError("Failed to allocate")

    backend = OpenVINOBackend(any_size(tmp_path), threads=1)
    assert backend._idle is not None
    request = backend._idle.get()
    backend._idle.put(request)
    request._sizes._model = Model()
    for _ in range(7):
        check_lane(backend, 64, 96)
    assert request._used is request._request


def test_threads_may_bring_images_of_several_sizes(tmp_path: Path) -> None:
    backend = OpenVINOBackend(any_size(tmp_path), streams=2, threads=4)
    sizes = [(32, 32, 1), (64, 32, 3), (32, 96, 2), (64, 96, 1), (32, 64, 1)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda size: check_lane(backend, *size), sizes * 20))
        assert 0 < len(compiled_for(backend)) <= 4
        before = compiled_for(backend)
        with backend.in_parallel() as runners:
            assert runners == 4
            assert not compiled_for(backend)
            list(pool.map(lambda size: check_lane(backend, *size), sizes * 20))
            assert 0 < len(compiled_for(backend)) <= 4
    assert compiled_for(backend) == before
    check_lane(backend, *SIZE)


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
def test_a_closed_model_says_so(artefacts: Artefacts, kind: Any) -> None:
    backend = kind(artefacts.folder / "model.onnx")
    backend.close()
    with pytest.raises(BackendError, match=r"model\.onnx: the model was closed; load it again"):
        backend.run(artefacts.images)


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
def test_wrong_size_is_refused(artefacts: Artefacts, kind: Any) -> None:
    backend = kind(artefacts.folder / "model.onnx")
    for height in (96, 32):
        with pytest.raises(ShapeError, match=f"takes 128x64 pixels, got 128x{height}"):
            backend.run(np.zeros((1, height, 128, 3), np.uint8))
    with pytest.raises(ShapeError, match="uint8"):
        backend.run(np.zeros((1, 64, 128, 3), np.float32))


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
def test_what_a_runtime_cannot_take_is_one_line(artefacts: Artefacts, kind: Any) -> None:
    backend = kind(artefacts.folder / "model.onnx")
    with pytest.raises(ShapeError, match="B >= 1"):
        backend.run(np.zeros((0, *SIZE, 3), np.uint8))
    backend.info = dataclasses.replace(backend.info, size=None)  # it says it is dynamic, and is not
    with pytest.raises(ShapeError, match="multiples of 32 pixels, got 64x50"):
        backend.run(np.zeros((1, 50, 64, 3), np.uint8))
    with pytest.raises(BackendError, match="the runtime failed") as caught:
        backend.run(np.zeros((1, 96, 96, 3), np.uint8))
    assert "\n" not in str(caught.value)
    backend.run(np.zeros((1, *SIZE, 3), np.uint8))


def test_the_cause_at_the_end_of_a_long_error_is_told(artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch) -> None:
    def compute(_: object) -> None:
        raise RuntimeError(
            "Exception from src/inference/src/cpp/infer_request.cpp:246:\n" * 5 + "Failed to allocate\n\n"
        )

    backend = OnnxBackend(artefacts.folder / "model.onnx")
    monkeypatch.setattr(backend, "_compute", compute)
    with pytest.raises(BackendError, match=r"^the runtime failed \(Exception .*Failed to allocate\)$") as caught:
        backend.run(np.zeros((1, *SIZE, 3), np.uint8))
    assert len(str(caught.value)) < 230


@pytest.mark.parametrize(
    ("name", "kind"), [("x.onnx", OnnxBackend), ("x.onnx", OpenVINOBackend), ("x.xml", OpenVINOBackend)]
)
def test_corrupt_and_missing_files_are_one_line(tmp_path: Path, name: str, kind: Any) -> None:
    with pytest.raises(WeightsError, match="no such file"):
        kind(tmp_path / name)
    (tmp_path / name).write_bytes(b"not a model\n" * 20)
    with pytest.raises(WeightsError, match="not a usable") as caught:
        kind(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
def test_foreign_and_newer_artefacts_are_refused(artefacts: Artefacts, tmp_path: Path, kind: Any) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(artefacts.folder / "model.onnx"))
    metadata = {entry.key: entry.value for entry in model.metadata_props if entry.key != GRAPH_HASH_KEY}

    def with_metadata(entries: dict[str, str]) -> Path:
        del model.metadata_props[:]
        onnx.helper.set_model_props(model, entries)
        onnx.save(model, str(tmp_path / "other.onnx"))
        return tmp_path / "other.onnx"

    with pytest.raises(WeightsError, match=r"no 'trilitenet.card' in its metadata"):
        kind(with_metadata({"author": "someone"}))
    newer = json.dumps(json.loads(metadata[ARTEFACT_KEY]) | {"schema": 99})
    with pytest.raises(WeightsError, match="schema 99 is newer"):
        kind(with_metadata(metadata | {ARTEFACT_KEY: newer}))
    newer = json.dumps(json.loads(metadata[CARD_KEY]) | {"schema": 99})
    with pytest.raises(WeightsError, match="upgrade trilitenet"):
        kind(with_metadata(metadata | {CARD_KEY: newer}))


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        ([1], ["detection"], "its graph has no drivable, lane;"),
        ([1, 1], ["detection", "drivable"], "describe an input of (64, 128), the graph takes [1, 64, 128, 3], [1, 64,"),
        ([100], ["detection"], "describe an input of (64, 128), the graph takes [1, 6400, 128, 3];"),
    ],
    ids=["outputs", "inputs", "size"],
)
def test_a_graph_other_than_its_metadata_is_refused(
    artefacts: Artefacts, tmp_path: Path, kind: Any, inputs: list[int], outputs: list[str], message: str
) -> None:
    onnx = pytest.importorskip("onnx")
    helper, byte = onnx.helper, onnx.TensorProto.UINT8
    takes = [helper.make_tensor_value_info(f"in{i}", byte, [1, 64 * n, 128, 3]) for i, n in enumerate(inputs)]
    gives = [helper.make_tensor_value_info(name, byte, None) for name in outputs]
    nodes = [helper.make_node("Identity", [f"in{i % len(inputs)}"], [name]) for i, name in enumerate(outputs)]
    model = helper.make_model(
        helper.make_graph(nodes, "g", takes, gives), ir_version=8, opset_imports=[helper.make_opsetid("", 17)]
    )
    metadata = onnx.load(str(artefacts.folder / "model.onnx")).metadata_props
    helper.set_model_props(model, {entry.key: entry.value for entry in metadata if entry.key != GRAPH_HASH_KEY})
    onnx.save(model, str(tmp_path / "foreign.onnx"))
    with pytest.raises(WeightsError, match=re.escape(message)):
        kind(tmp_path / "foreign.onnx")


def test_openvino_without_its_weights_file(artefacts: Artefacts, tmp_path: Path) -> None:
    shutil.copy(artefacts.folder / "model.xml", tmp_path / "model.xml")
    with pytest.raises(WeightsError, match=r"its weights are missing; keep model\.bin beside it$"):
        OpenVINOBackend(tmp_path / "model.xml")
    weights = (artefacts.folder / "model.bin").read_bytes()
    (tmp_path / "model.bin").write_bytes(weights[: len(weights) // 2])
    with pytest.raises(WeightsError, match=r"model\.bin is cut off, or of another file; export it again"):
        OpenVINOBackend(tmp_path / "model.xml")


def test_openvino_with_the_weights_of_another_export(artefacts: Artefacts, tmp_path: Path) -> None:
    shutil.copy(artefacts.folder / "model.xml", tmp_path / "model.xml")
    weights = bytearray((artefacts.folder / "model.bin").read_bytes())
    weights[len(weights) // 2] ^= 1
    (tmp_path / "model.bin").write_bytes(weights)
    with pytest.raises(WeightsError, match=r"model\.bin: not the weights that model\.xml was written for"):
        OpenVINOBackend(tmp_path / "model.xml")
    (tmp_path / "model.bin").write_bytes(np.random.default_rng(0).bytes(len(weights)))  # axes that are none, and such
    with pytest.raises(WeightsError, match=r"model\.bin: not the weights that model\.xml was written for"):
        OpenVINOBackend(tmp_path / "model.xml")
    weights[len(weights) // 2] ^= 1
    (tmp_path / "model.bin").write_bytes(weights)
    graph = (tmp_path / "model.xml").read_text(encoding="utf-8")
    older = re.sub(r"<weights_sha256 [^>]*/>", "", graph)
    assert older != graph
    (tmp_path / "model.xml").write_text(older, encoding="utf-8")
    OpenVINOBackend(tmp_path / "model.xml").close()


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
def test_a_graph_that_was_cut_off_is_told_in_our_words(
    artefacts: Artefacts, tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: Any
) -> None:
    whole = (artefacts.folder / "model.onnx").read_bytes()
    path = tmp_path / "model.onnx"
    for length in (len(whole) - 1, len(whole) // 2, 100):
        path.write_bytes(whole[:length])
        with pytest.raises(WeightsError, match=r"ONNX model \(cut off or damaged; export it again\)$"):
            kind(path)
    path.write_bytes(whole[:8])
    with pytest.raises(WeightsError, match="ONNX model"):
        kind(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
@pytest.mark.parametrize(("start", "end"), [(0.3, 0.31), (0.3, 0.9), (0.6, 1.0)])
def test_a_graph_with_a_hole_is_told(artefacts: Artefacts, tmp_path: Path, kind: Any, start: float, end: float) -> None:
    content = bytearray((artefacts.folder / "model.onnx").read_bytes())
    hole = slice(int(start * len(content)), int(end * len(content)))
    content[hole] = bytes(len(content[hole]))
    (tmp_path / "a.onnx").write_bytes(content)
    with pytest.raises(WeightsError, match=r"a\.onnx: .*damaged.*export it again"):
        kind(tmp_path / "a.onnx")


@pytest.mark.parametrize("kind", [OnnxBackend, OpenVINOBackend])
def test_a_graph_that_another_program_changed_is_told_and_may_go_without_its_hash(
    artefacts: Artefacts, tmp_path: Path, kind: Any
) -> None:
    onnx = pytest.importorskip("onnx")
    model, path = onnx.load(str(artefacts.folder / "model.onnx")), tmp_path / "a.onnx"
    model.metadata_props.add(key="author", value="someone")
    onnx.save(model, str(path))
    kind(path).close()
    model.graph.doc_string = "changed"
    onnx.save(model, str(path))
    with pytest.raises(WeightsError, match=rf"changed by another program .* take '{GRAPH_HASH_KEY}' out of its metad"):
        kind(path)
    entries = {entry.key: entry.value for entry in model.metadata_props if entry.key != GRAPH_HASH_KEY}
    onnx.helper.set_model_props(model, entries)
    onnx.save(model, str(path))
    kind(path).close()


def test_metadata_of_a_graph_are_read_without_a_runtime(artefacts: Artefacts, tmp_path: Path) -> None:
    path = artefacts.folder / "model.onnx"
    metadata = read_onnx_metadata(path)
    assert list(metadata) == [CARD_KEY, ARTEFACT_KEY, GRAPH_HASH_KEY]
    backend = OnnxBackend(path)
    assert read_metadata(metadata, "") == (backend.card, backend.info)
    whole = path.read_bytes()
    for content in (whole[:-1], whole[: len(whole) // 2], whole[:3], b"not a model\n" * 20, b"\x72\x02\x0a\x00"):
        (tmp_path / "a.onnx").write_bytes(content)
        with pytest.raises(WeightsError, match=r"not a usable ONNX model \(cut off or damaged; export it again\)$"):
            read_onnx_metadata(tmp_path / "a.onnx")


def test_a_program_with_a_wrong_bit_is_told(tmp_path: Path) -> None:
    import torch

    from trilitenet.inference.exported_torch_backend import ExportedTorchBackend

    card, info = ModelCard("tiny"), ArtefactInfo("torch", size=SIZE)
    path, module = tmp_path / "a.pt2", torch.nn.Linear(8, 8)
    metadata = {CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()}
    torch.export.save(torch.export.export(module, (torch.ones(1, 8),)), path, extra_files=metadata)
    ExportedTorchBackend(path).close()
    content, weights = bytearray(path.read_bytes()), module.weight.detach().numpy().tobytes()
    content[content.index(weights)] ^= 1
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=r"a\.pt2: not a usable PyTorch program \(damaged"):
        ExportedTorchBackend(path)


def test_broken_programs_print_nothing_of_their_own(tmp_path: Path) -> None:
    contents = {"empty.pt2": b"", "text.pt2": b"not a program\n" * 20, "zip.pt2": b"PK\5\6" + bytes(18)}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    script = (
        "import sys; from trilitenet.apps.cli import main\n"
        "for name in sys.argv[1:]: main(['predict', 'x.jpg', '--model', name])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, *contents], capture_output=True, text=True, timeout=100, cwd=tmp_path
    )
    lines = done.stderr.splitlines()
    assert len(lines) == len(contents)
    for name, line in zip(contents, lines, strict=True):
        assert f"{name}: not a usable PyTorch program" in line


def test_bad_options(artefacts: Artefacts) -> None:
    path = artefacts.folder / "model.xml"
    with pytest.raises(BackendError, match="no device"):
        OpenVINOBackend(path, "npu.9")
    with pytest.raises(ConfigError, match="streams"):
        OpenVINOBackend(path, streams=0)
    with pytest.raises(ConfigError, match="precision"):
        OpenVINOBackend(path, precision="fp8")
    with pytest.raises(BackendError, match="cuda"):
        OnnxBackend(artefacts.folder / "model.onnx", "mps")


def test_a_runtime_without_cuda_says_so(artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(BackendError, match=r"has no CUDA; install onnxruntime-gpu, or use device='cpu'"):
        OnnxBackend(artefacts.folder / "model.onnx", "cuda")


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_cuda_that_does_not_start_is_not_the_cpu_in_silence(
    artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = artefacts.folder / "model.onnx"
    providers = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: providers)  # as where cuDNN is missing
    with pytest.raises(BackendError, match="could not start on CUDA"):
        OnnxBackend(path, "cuda")
    assert OnnxBackend(path).name == "onnxruntime cpu fp32"


@pytest.mark.parametrize(("name", "runtime"), [("model.onnx", "onnxruntime"), ("model.xml", "openvino")])
def test_prediction_needs_no_torch(artefacts: Artefacts, name: str, runtime: str) -> None:
    code = (
        "import sys, numpy, trilitenet\n"
        f"predictor = trilitenet.load({str(artefacts.folder / name)!r}, backend={runtime!r})\n"
        "perception = predictor(numpy.zeros((90, 160, 3), numpy.uint8))\n"
        "assert perception.lane.shape == (90, 160)\n"
        "assert predictor.class_names == ('class_0', 'class_1')\n"
        "heavy = {'torch', 'onnx', 'nncf', 'matplotlib', 'av'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


def test_load_picks_a_runtime(artefacts: Artefacts) -> None:
    onnx, xml = str(artefacts.folder / "model.onnx"), str(artefacts.folder / "model.xml")
    assert trilitenet.load(onnx).backend.name.startswith("openvino cpu fp32")
    assert trilitenet.load(onnx, backend="onnxruntime").backend.name == "onnxruntime cpu fp32"
    assert trilitenet.load(xml).backend.name.startswith("openvino cpu")
    with pytest.raises(ConfigError, match="runs on openvino, not on torch"):
        trilitenet.load(xml, backend="torch")
    with pytest.raises(ConfigError, match="trilitenet export"):
        trilitenet.load(str(artefacts.folder / "weights.safetensors"), backend="openvino")


def test_input_forms() -> None:
    image = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    assert np.array_equal(prepare_input(image, ArtefactInfo("onnx", colour="bgr"))[0], image[:, :, ::-1])
    planes = prepare_input(image, ArtefactInfo("onnx", input="float_nchw"))
    assert planes.dtype == np.float32
    assert np.array_equal(planes[0].transpose(1, 2, 0), image)


@pytest.mark.parametrize(
    ("masks", "given", "wanted"),
    [
        ("decision", np.array([[0, 1]], np.uint8), [0, 255]),
        ("probability", np.array([[0, 100]], np.uint8), [0, 100]),
        ("logit", np.array([[-0.5, 0.25]], np.float32), [0, 255]),
    ],
)
def test_masks_of_every_kind_become_probability(masks: Any, given: NDArray[Any], wanted: list[int]) -> None:
    card, info = ModelCard("tiny", tasks=("lane",)), ArtefactInfo("onnx", masks=masks)
    raw = gather_outputs([{"lane": given[None]}, {"lane": given[None]}], card, info)
    assert raw.detection is None
    assert raw.drivable is None
    assert raw.lane is not None
    assert raw.lane.tolist() == [[wanted], [wanted]]


def test_results_that_lack_an_output_are_told() -> None:
    results = [{"lane": np.zeros((1, 2, 2), np.uint8), "drivable": None}]
    with pytest.raises(ShapeError, match="have no detection, drivable; ask the artefact for detection, drivable, lane"):
        gather_outputs(results, ModelCard("tiny"), ArtefactInfo("onnx"))  # type: ignore[arg-type]


def test_what_a_client_of_triton_imports_needs_no_runtime() -> None:
    code = (
        "import sys, trilitenet.inference.exported, trilitenet.processing.postprocess, trilitenet.processing.images\n"
        "heavy = {'torch', 'onnx', 'onnxruntime', 'openvino'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


def test_images_of_different_numbers_of_boxes_share_a_batch() -> None:
    class Suppressed(ArtefactBackend):
        name, info, _card = "fake", ArtefactInfo("onnx", size=SIZE, nms=True), ModelCard("tiny", tasks=("detection",))

        def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
            return [{"detection": np.ones((1, int(image.max()), 6), np.float32)} for image in batch]

    counts = np.array([3, 0, 1, 2], np.uint8)
    batch = np.broadcast_to(counts[:, None, None, None], (4, *SIZE, 3))
    detection = Suppressed().run(batch).detection
    assert detection is not None
    np.testing.assert_array_equal(detection, np.repeat(np.arange(3) < counts[:, None], 6, 1).reshape(4, 3, 6))


def test_engine_files(tmp_path: Path) -> None:
    card, info = ModelCard("tiny"), ArtefactInfo("tensorrt", "fp16", (384, 640))
    path = tmp_path / "a.engine"
    path.write_bytes(pack_engine(b"engine", card, info))
    assert unpack_engine(path) == (card, info, b"engine")
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"engine", b"\0ngine"))
    assert path.read_bytes() == whole[:-6] + b"\0ngine"
    with pytest.raises(WeightsError, match=r"a\.engine: its engine is damaged; build it again with"):
        unpack_engine(path)
    older = json.dumps({CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()}).encode()
    path.write_bytes(MAGIC + len(older).to_bytes(4, "little") + older + b"engine")
    assert unpack_engine(path) == (card, info, b"engine")
    for broken in (b"ftrt" * 20, MAGIC, MAGIC + b"\x02"):
        path.write_bytes(broken)
        with pytest.raises(WeightsError, match="not an engine of ours"):
            unpack_engine(path)
    for header, message in ((b"[1]", "its header is not a JSON object"), (b"{1}", "its header is broken")):
        path.write_bytes(MAGIC + b"\x03\0\0\0" + header)
        with pytest.raises(WeightsError, match=message):
            unpack_engine(path)


class FakeTensorRT:
    """TensorRT and CUDA of memory on the host: an engine answers each output with its number among the tensors.

    Args:
        shapes: The shape of each tensor; ``image`` comes in.
    """

    ERROR, cudaMemcpyKind = 0, types.SimpleNamespace(cudaMemcpyHostToDevice=1, cudaMemcpyDeviceToHost=2)  # noqa: N815

    def __init__(self, shapes: dict[str, tuple[int, ...]]) -> None:
        self.shapes, self.num_io_tensors, self.held = shapes, len(shapes), dict[int, NDArray[np.uint8]]()
        self.addresses: dict[str, int] = {}
        self.engine = b""
        self.Logger = self  # called, it is itself

    def __call__(self, _severity: int) -> FakeTensorRT:
        return self

    def __getattr__(self, name: str) -> Any:
        """Runtime and context are it as well; other calls of CUDA succeed."""
        return (lambda *_: (0, 7)) if name.startswith("cuda") else lambda *_: self

    def deserialize_cuda_engine(self, engine: bytes) -> FakeTensorRT:
        self.engine = engine
        return self

    def get_tensor_name(self, index: int) -> str:
        return list(self.shapes)[index]

    def get_tensor_shape(self, name: str) -> tuple[int, ...]:
        return self.shapes[name]

    def nptype(self, _: object) -> type:
        return np.float32

    def cudaMalloc(self, size: int) -> tuple[int, int]:  # noqa: N802
        memory = np.zeros(size, np.uint8)
        self.held[memory.ctypes.data] = memory
        return 0, memory.ctypes.data

    def set_tensor_address(self, name: str, address: int) -> None:
        self.addresses[name] = address

    def cudaMemcpyAsync(self, target: int, source: int, size: int, *_: object) -> int:  # noqa: N802
        ctypes.memmove(target, source, size)
        return 0

    def execute_async_v3(self, _stream: object) -> None:
        for number, name in enumerate(self.shapes):
            if name != "image":
                self.held[self.addresses[name]].view(np.float32)[:] = number


@pytest.fixture
def planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, FakeTensorRT]:
    """A plan with the portable graph beside it, by its outermost message alone, and what stands in for TensorRT."""
    onnx = pytest.importorskip("onnx")
    fake = FakeTensorRT({"image": (1, 3, *SIZE), "drivable": (1, *SIZE), "lane": (1, *SIZE)})
    monkeypatch.setattr("trilitenet.inference.tensorrt_backend.import_extra", lambda *_: fake)
    model = onnx.helper.make_model(onnx.helper.make_graph([], "g", [], []))
    card = ModelCard("tiny", tasks=("drivable", "lane"))
    info = ArtefactInfo("onnx", size=SIZE, input="float_nchw", masks="logit")
    onnx.helper.set_model_props(model, {CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()})
    save_onnx(model, tmp_path / "a.onnx")
    (tmp_path / "a.plan").write_bytes(b"plan")
    return tmp_path / "a.plan", fake


def test_a_plan_has_its_card_from_the_graph_beside_it(planned: tuple[Path, FakeTensorRT]) -> None:
    path, fake = planned
    predictor = trilitenet.load(path)
    assert fake.engine == b"plan"
    assert predictor.backend.name == "tensorrt cuda plan"
    assert predictor.backend.canvas == SIZE
    raw = predictor.backend.run(np.zeros((2, *SIZE, 3), np.uint8))
    assert raw.drivable is not None
    assert raw.drivable.shape == (2, *SIZE)
    assert raw.drivable.min() == 255
    predictor.close()
    with pytest.raises(BackendError, match="the model was closed"):
        predictor.backend.run(np.zeros((1, *SIZE, 3), np.uint8))


def test_a_plan_of_another_graph_or_without_one_is_refused(planned: tuple[Path, FakeTensorRT]) -> None:
    path, fake = planned
    fake.shapes["image"] = (1, 3, 96, 128)
    message = "a.plan: its metadata describe an input of (64, 128), the graph takes [1, 3, 96, 128]"
    with pytest.raises(WeightsError, match=re.escape(message)):
        TensorRTBackend(path)
    fake.shapes |= {"image": (1, 3, *SIZE), "lane": (1, -1, 128)}
    with pytest.raises(BackendError, match=r"a\.plan: has no fixed sizes; build it from the graph of: export --format"):
        TensorRTBackend(path)
    path.with_suffix(".onnx").unlink()
    with pytest.raises(WeightsError, match=r"a\.plan: its card is missing; keep a\.onnx, which it was built from"):
        TensorRTBackend(path)
    with pytest.raises(WeightsError, match=r"b\.plan: no such file"):
        trilitenet.load(path.with_name("b.plan"))


def test_integers_are_told_by_what_the_artefact_says_of_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    card = ModelCard("tiny", notes=('of "precision": "int8" there is more in the documentation',)).to_json()
    for artefact, found in ((ArtefactInfo("onnx", "int8"), True), (ArtefactInfo("onnx", "fp32"), False)):
        info = json.loads(artefact.to_json())
        for separators in ((",", ":"), (", ", ": ")):
            entry = f"{ARTEFACT_KEY}{json.dumps(info, separators=separators)}"
            path.write_bytes(b"\x08" * 100_000 + f'"precision": "int8" {card} {entry}'.encode())
            assert is_int8_onnx(path) == found
    assert not is_int8_onnx(tmp_path / "none.onnx")


def test_metadata_that_is_no_text() -> None:
    with pytest.raises(WeightsError, match="its card is not JSON"):
        read_metadata({CARD_KEY: 5, ARTEFACT_KEY: "{}"}, "a.engine")  # type: ignore[dict-item]


def test_metadata_that_is_no_json() -> None:
    with pytest.raises(WeightsError, match="not JSON"):
        read_metadata({CARD_KEY: ModelCard("tiny").to_json(), ARTEFACT_KEY: "{"}, "x.onnx")


@pytest.mark.parametrize("names", [("car",), tuple("abcdefg")])
def test_a_card_of_another_graph_is_told(artefacts: Artefacts, names: tuple[str, ...]) -> None:
    backend = OnnxBackend(artefacts.folder / "model.onnx", "cpu")
    backend._card = dataclasses.replace(backend.card, class_names=names)
    with pytest.raises(WeightsError, match=f"the card names {len(names)} classes, but the graph gives rows of 7"):
        backend.run(artefacts.images[:1])


def test_a_page_is_no_graph(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.xml").write_text("<html></html>")
    (tmp_path / "a.bin").write_bytes(b"")
    with pytest.raises(WeightsError, match="does not begin as one"):
        OpenVINOBackend(tmp_path / "a.xml")
    assert capfd.readouterr() == ("", "")
