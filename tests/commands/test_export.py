from __future__ import annotations

import contextlib
import dataclasses
import errno
import importlib.metadata
import json
import math
import os
import pickle
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import trilitenet
from tests.artefacts import Artefacts
from tests.fakes import ColourBackend
from trilitenet.commands import export as command
from trilitenet.commands.export import export, find_pictures
from trilitenet.commands.progress import ProgressBar
from trilitenet.config import ARTEFACT_KEY, TASKS, ArtefactInfo, Thresholds
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.deploy.onnx import build_onnx
from trilitenet.deploy.parity import TOLERANCES, Tolerance
from trilitenet.deploy.quantize import KEEP_STEPS
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.figures import FIGURES
from trilitenet.engine.report import Figure, Report
from trilitenet.errors import BackendError, ConfigError, InputError, OutputError, ShapeError
from trilitenet.inference.exported import read_onnx_metadata
from trilitenet.inference.exported_torch_backend import ExportedTorchBackend
from trilitenet.inference.onnx_backend import OnnxBackend
from trilitenet.inference.openvino_backend import openvino_core
from trilitenet.inference.predictor import Predictor
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import load_network, save_network


@pytest.fixture
def frames(tmp_path: Path, rng: np.random.Generator) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in range(2):
        pixels = rng.integers(0, 256, (60, 120, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{index}.png")
    return folder


def test_options_that_do_not_fit(artefacts: Artefacts, tmp_path: Path) -> None:
    weights = str(artefacts.folder / "weights.safetensors")
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"precision": "bf16"}, "onnx artefacts come as"),
        ({"precision": "int8"}, "--calibration"),
        ({"size": "100x64"}, "multiples of 32"),
        ({"size": "big"}, "HEIGHTxWIDTH"),
        ({"size": (384, 640, 3)}, r"HEIGHTxWIDTH such as 384x640, or dynamic, not \(384, 640, 3\)"),
        ({"format": "tflite"}, "unknown format 'tflite'; known: executorch, ncnn, onnx"),
        ({"format": "onxx"}, "did you mean 'onnx'"),
        ({"format": "torch", "nms": True}, "--nms"),
        ({"portable": True, "nms": True}, "--portable keeps to operators"),
        ({"portable": True, "layout": "pixels"}, "--portable is planar"),
        ({"format": "ncnn", "layout": "pixels"}, "--portable is planar"),
        ({"portable": True, "layout": "planar-maximum"}, "--portable is planar"),
        ({"format": "tensorrt", "size": "dynamic"}, "tensorrt needs a fixed --size"),
        ({"format": "tensorrt", "output": tmp_path / "tiny.fp16"}, "end with .engine"),
        ({"precision": "int8", "calibration": tmp_path, "max_drop": 1.0, "nms": True}, "that --nms drops"),
        ({"format": "tensorrt", "precision": "int8"}, "tensorrt artefacts come as fp32, fp16, bf16, not int8"),
        ({"max_drop": 0.5}, "--max-drop"),
        ({"precision": "int8", "calibration": tmp_path, "size": "dynamic"}, "int8 needs a fixed --size"),
        ({"format": "ncnn", "precision": "bf16"}, "ncnn artefacts come as fp32, fp16, not bf16"),
        ({"format": "ncnn", "size": "dynamic"}, "ncnn needs a fixed --size"),
        ({"format": "executorch", "size": "dynamic"}, "executorch needs a fixed --size"),
        ({"portable": True, "size": "dynamic"}, "--portable needs a fixed --size"),
        ({"format": "torch", "portable": True, "size": "dynamic"}, "--portable needs a fixed --size"),
        ({"portable": True, "precision": "fp16"}, "--portable keeps to operators that fp16 needs more than"),
        (
            {"format": "triton", "portable": True, "precision": "int8", "calibration": tmp_path},
            "--portable keeps to operators that int8 needs more than",
        ),
        ({"format": "executorch", "precision": "fp16"}, "executorch artefacts come as fp32, int8, not fp16"),
        ({"format": "ncnn", "mask_scale": 2}, "--mask-scale doubles masks that are decided"),
        ({"format": "ncnn", "output": tmp_path / "a.param"}, "end with .ncnn.param"),
        ({"format": "tensorrt", "output": Path()}, "end with .engine"),
        ({"precision": "int8", "calibration": tmp_path, "calibration_frames": -3}, "must be at least 1, got -3"),
        ({"portable": True, "masks": "probability"}, "are logits; give --masks logit or leave it out, not probability"),
        ({"format": "ncnn", "masks": "decision"}, "are logits"),
        ({"format": "tensorrt", "masks": "decision"}, "are logits"),
        ({"format": "triton", "portable": True, "masks": "decision"}, "are logits"),
        ({"output": tmp_path / "a.xml"}, "end with .onnx"),
    )
    for options, message in cases:
        with pytest.raises(ConfigError, match=message):
            export(weights, **options)
    (tmp_path / "a.onnx").touch()
    with pytest.raises(OutputError, match="exists already"):
        export(weights, output=tmp_path / "a.onnx")


def test_a_size_is_height_by_width_and_turned_round_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    network = build_network("tiny", tasks=("lane",))
    save_network(network, tmp_path / "small.safetensors", dataclasses.replace(network.card, input_size=(64, 96)))
    sizes = [None, "64x96", (64, 96), "96x64", "96x96"]
    for index, size in enumerate(sizes):
        exported = export(tmp_path / "small.safetensors", output=tmp_path / f"{index}.onnx", size=size)
        canvas = OnnxBackend(exported.path).canvas
        assert canvas == {"96x64": (96, 64), "96x96": (96, 96)}.get(str(size), (64, 96))
    (told,) = caplog.messages
    assert "--size 96x64 is an upright input, 96 high and 64 wide" in told
    assert "as trained, 96 wide and 64 high, is --size 64x96" in told
    caplog.clear()
    save_network(network, tmp_path / "upright.safetensors", dataclasses.replace(network.card, input_size=(96, 64)))
    export(tmp_path / "upright.safetensors", output=tmp_path / "upright.onnx", size="64x96")
    (told,) = caplog.messages
    assert told.startswith("--size 64x96 is a wide input, 64 high and 96 wide; as trained, 64 wide and 96 high, is")


def test_an_engine_is_not_called_onnx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "is_installed", lambda: True)
    with pytest.raises(ConfigError, match=r"tensorrt artefacts end with \.engine, not \.onnx"):
        export("tiny", format="tensorrt", output=tmp_path / "a.onnx")


def test_pictures_are_never_masks(tmp_path: Path) -> None:
    write_dataset(tmp_path, "val", 2, 0, size=(64, 96))
    pictures = sorted((tmp_path / "images" / "val").iterdir())
    assert find_pictures(tmp_path, 8, "val") == pictures
    assert find_pictures(tmp_path / "images", 8, "train") == pictures
    with pytest.raises(InputError, match="no train split to calibrate on"):
        find_pictures(tmp_path, 8, "train")
    (tmp_path / "images" / "val").rename(tmp_path / "images" / "train")
    assert [path.parent.name for path in find_pictures(tmp_path, 8, "val")] == ["train", "train"]


def test_pictures_are_from_all_over_a_folder(tmp_path: Path) -> None:
    for name in ("4.jpg", "1.jpg", "0.jpg", "notes.txt", "3.jpg", "2.jpg"):
        (tmp_path / name).touch()
    assert [path.name for path in find_pictures(tmp_path, 3, "train")] == ["0.jpg", "2.jpg", "4.jpg"]


def test_what_is_no_folder_of_pictures_is_told(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").touch()
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("photo.jpg", "is a file; give a folder"),
        ("absent", "no such folder"),
        ("empty", "no pict"),
    ):
        with pytest.raises(InputError, match=message):
            find_pictures(tmp_path / name, 8, "train")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Predictor:
    folder = tmp_path_factory.mktemp("program")
    network = build_network("tiny", tasks=("lane",))
    save_network(network, folder / "lane.safetensors", network.card)
    made = export(str(folder / "lane.safetensors"), format="torch", size="dynamic", output=folder / "a.pt2")
    assert "input any multiple of 32 from 64 to 4096 RGB" in made.summary()
    return trilitenet.load(made.path)


def test_a_program_goes_to_other_processes_and_can_be_closed(program: Predictor) -> None:
    assert program.backend.name == "torch program cpu"
    copy = pickle.loads(pickle.dumps(program))  # noqa: S301 - its own
    image = np.full((64, 96, 3), 90, np.uint8)
    np.testing.assert_array_equal(copy(image).lane, program(image).lane)
    copy.close()
    with pytest.raises(BackendError, match=r"a\.pt2: the model was closed"):
        copy(image)


def test_a_program_runs_on_another_device_than_it_was_exported_on(program: Predictor) -> None:
    path = program.backend.__reduce__()[1][0]
    backend = ExportedTorchBackend(path, "meta")  # of tensors without values; a program of two devices raises there too
    assert backend._module is not None
    (mask,) = backend._module(torch.zeros((1, 96, 128, 3), dtype=torch.uint8, device="meta"))
    assert (mask.shape, mask.device.type) == ((1, 96, 128), "meta")


def test_a_dynamic_program_says_how_small_and_large_a_side_may_be(program: Predictor) -> None:
    for size in ((64, 96), (64, 4096)):
        program.backend.run(np.zeros((1, *size, 3), np.uint8))
    for size in ((32, 96), (96, 32), (4128, 64), (64, 4128)):
        with pytest.raises(ShapeError, match="takes sides from 64 pixels to 4096"):
            program.backend.run(np.zeros((1, *size, 3), np.uint8))


def test_suppression_needs_boxes(tmp_path: Path) -> None:
    network = build_network("tiny", tasks=("lane",))
    save_network(network, tmp_path / "lane.safetensors", network.card)
    with pytest.raises(ConfigError, match="has no detection task"):
        export(str(tmp_path / "lane.safetensors"), nms=True, output=tmp_path / "a.onnx")


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where a network would be loaded; TensorRT is not there."""
    monkeypatch.setattr(command, "is_installed", lambda: False)
    monkeypatch.setattr(command, "load_network", _no_work)


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(
    ("format_", "name", "other"),
    [
        ("tensorrt", "a.engine", "a.onnx"),
        ("openvino", "a.xml", "a.bin"),
        ("ncnn", "a.ncnn.param", "a.ncnn.bin"),
        ("ncnn", "a.ncnn.param", "a.ncnn.json"),
    ],
)
def test_no_file_is_replaced_unasked(tmp_path: Path, format_: Any, name: str, other: str) -> None:
    (tmp_path / other).write_text("mine")
    with pytest.raises(
        OutputError, match=f"^{tmp_path / other}: exists already; give another --output or --overwrite$"
    ):
        export("tiny", format=format_, output=tmp_path / name)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(other, "mine")]


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(
    ("format_", "output", "told"),
    [
        ("onnx", "file/a.onnx", "file/a.onnx"),
        ("torch", "file/deep/a.pt2", "file/deep/a.pt2"),
        ("tensorrt", "file/a.engine", "file/a.onnx"),
        ("triton", "file", "file/tiny/config.pbtxt"),
    ],
)
def test_a_file_in_the_place_of_a_folder(tmp_path: Path, format_: Any, output: str, told: str) -> None:
    (tmp_path / "file").touch()
    reason = rf"cannot be written \({tmp_path / 'file'} is no folder\)"
    with pytest.raises(OutputError, match=f"^{tmp_path / told}: {reason}$"):
        export("tiny", format=format_, output=tmp_path / output)


def test_what_cannot_be_written_is_told_in_one_line(
    artefacts: Artefacts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.onnx").mkdir()
    with pytest.raises(OutputError, match=r"a\.onnx: cannot be written \(it is a folder\)$"):
        export("tiny", output=tmp_path / "a.onnx", overwrite=True)
    # What only shows on writing, such as a full disk.
    monkeypatch.setattr(command, "build_onnx", lambda *_, **__: None)

    def fill(*arguments: object) -> None:
        (trial,) = (argument for argument in arguments if isinstance(argument, Path))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(trial))

    monkeypatch.setattr(command, "save_onnx", fill)
    with pytest.raises(OutputError, match=rf"^{tmp_path}/b\.onnx: cannot be written \(No space left on device\)$"):
        export(str(artefacts.folder / "weights.safetensors"), size="64x128", output=tmp_path / "b.onnx")
    # PyTorch aborts the process where it cannot write: it never gets the file.
    monkeypatch.setattr(torch.export, "export", lambda *_, **__: None)
    monkeypatch.setattr(torch.export, "save", lambda _, file, **__: file.write(b"program"))
    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(OutputError, match=rf"^{tmp_path}/c\.pt2: cannot be written \(No space left on device\)$"):
        export(str(artefacts.folder / "weights.safetensors"), format="torch", size="64x128", output=tmp_path / "c.pt2")
    assert [path.name for path in tmp_path.iterdir()] == ["a.onnx"]


def test_an_interruption_leaves_no_half_of_an_artefact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"{'a' * 251}.bin", f"{'a' * 251}.xml"]  # as long as file systems take names
    for name in names:
        (tmp_path / name).write_text("old")
    plain = Path.replace

    def replace(path: Path, target: Path) -> Path:
        os.kill(os.getpid(), signal.SIGINT)
        return plain(path, target)

    monkeypatch.setattr(Path, "replace", replace)

    def put() -> None:
        with command._trial(tmp_path / names[1]) as trial:
            for name in names:
                trial.with_name(name).write_text("new")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            put()
    finally:
        signal.signal(signal.SIGINT, before)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(names, "new")


class Bar(ProgressBar):
    """A bar that keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[str | tuple[int, int]] = []

    def __call__(self, done: int, total: int) -> None:
        self.told.append((done, total))

    def name(self, what: str) -> None:
        self.told.append(what)


def _no_work(*_: object) -> Any:
    raise AssertionError("the work began")


def test_masks_are_decisions_or_with_portable_logits_by_default_and_its_graph_is_plain(
    artefacts: Artefacts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = []
    monkeypatch.setattr(command, "build_onnx", lambda graph, *_, **__: graph.layout)
    monkeypatch.setattr(
        command, "_keep", lambda _network, layout, info, *_: kept.append((info.masks, info.input, layout.maximum))
    )
    weights = str(artefacts.folder / "weights.safetensors")
    for options in ({}, {"masks": "probability"}, {"portable": True}, {"portable": True, "masks": "logit"}):
        export(weights, size="64x128", output=tmp_path / "a.onnx", **options)
    pixels, portable = ("uint8_nhwc", True), ("float_nchw", False)
    assert kept == [("decision", *pixels), ("probability", *pixels), ("logit", *portable), ("logit", *portable)]


def test_an_artefact_is_compared_on_the_pictures_asked_for(
    artefacts: Artefacts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[object] = []
    monkeypatch.setattr(command, "build_onnx", lambda *_, **__: None)
    monkeypatch.setattr(command, "_canvases", lambda source, *_: source)
    monkeypatch.setattr(command, "_keep", lambda *arguments: kept.append(arguments[-1]))
    sources: tuple[dict[str, str], ...] = ({"frames": "a", "calibration": "b"}, {"calibration": "b"}, {})
    for source in sources:
        export(str(artefacts.folder / "weights.safetensors"), size="64x128", output=tmp_path / "a.onnx", **source)  # type: ignore[arg-type]
    assert kept == [Path("a"), Path("b"), None]


def test_int8_is_not_judged_by_the_frames_that_it_was_calibrated_on_alone(
    artefacts: Artefacts, tmp_path: Path, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[int] = []
    monkeypatch.setattr(command, "build_onnx", lambda *_, **__: None)
    monkeypatch.setattr(command, "_export_int8", lambda *arguments: kept.append(len(arguments[4])))
    weights, dataset = str(artefacts.folder / "weights.safetensors"), tmp_path / "data"
    write_dataset(dataset, "train", 1, 0, size=(32, 64))
    write_dataset(dataset, "val", 3, 0, size=(32, 64))
    options: tuple[dict[str, Any], ...] = (
        {"calibration": frames},
        {"calibration": frames, "frames": frames},
        {"calibration": dataset},
        {"calibration": dataset / "images" / "train"},
    )
    for option in options:
        export(weights, precision="int8", size="64x128", output=tmp_path / "a.onnx", **option)
    assert kept == [2 + 4, 2, 3, 1 + 4]


def test_the_drop_needs_labels_before_frames_are_read(tmp_path: Path) -> None:
    (tmp_path / "broken.png").touch()
    info = ArtefactInfo("onnx", "int8", (32, 64))
    arguments: tuple[Any, ...] = (None, None, info, tmp_path / "a.onnx", [], tmp_path, 500, 1.0)
    with pytest.raises(ConfigError, match=r"--max-drop needs labels; .* is not a data set with a val split"):
        command._export_int8(*arguments)


@pytest.mark.parametrize(
    ("options", "canvas"), [({}, (64, 96)), ({"size": "64x128"}, (64, 128)), ({"size": "dynamic"}, None)]
)
def test_the_input_is_as_large_as_in_training_unless_another_size_is_asked_for(
    tmp_path: Path, options: dict[str, Any], canvas: tuple[int, int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = build_network("tiny")
    save_network(network, tmp_path / "own.safetensors", dataclasses.replace(network.card, input_size=(64, 96)))
    kept: list[object] = []
    monkeypatch.setattr(command, "build_onnx", lambda *_, **__: None)
    monkeypatch.setattr(
        command, "_keep", lambda _network, _built, info, _path, checks: kept.extend((info.size, checks[0].shape))
    )
    export(tmp_path / "own.safetensors", output=tmp_path / "a.onnx", **options)
    assert kept == [canvas, (*(canvas or (64, 96)), 3)]


def test_an_artefact_is_compared_at_the_thresholds_of_its_model(monkeypatch: pytest.MonkeyPatch) -> None:
    network = build_network("tiny")
    network.card = dataclasses.replace(network.card, thresholds=Thresholds(confidence=0.2, drivable=0.4, lane=0.6))
    kept: list[Any] = []
    monkeypatch.setattr(command, "compare", lambda *arguments, **options: kept.extend((arguments[3], options)))
    command._compare(network, ColourBackend(), ArtefactInfo("onnx", "int8", (64, 128)), [])
    assert kept == [TOLERANCES["int8"], {"masks": (0.4, 0.6), "confidence": 0.2}]


@pytest.mark.slow
def test_openvino_with_synthetic_frames(artefacts: Artefacts, tmp_path: Path) -> None:
    path = tmp_path / "made" / "model.xml"
    done = export(str(artefacts.folder / "weights.safetensors"), format="openvino", size="64x128", output=path)
    assert done.parity is not None
    assert done.parity.pixels is not None
    assert done.parity.pixels > 0.9999
    assert done.parity.frames == 4
    assert sorted(file.name for file in path.parent.iterdir()) == ["model.bin", "model.xml"]
    with trilitenet.load(path) as predictor:
        assert predictor.card.licence == "MIT"
        assert predictor(np.zeros((90, 160, 3), np.uint8)).size == (90, 160)


@pytest.mark.slow
@pytest.mark.parametrize(("format_", "name"), [("onnx", "a.onnx"), ("torch", "a.pt2")])
def test_doubled_masks_of_shipped_weights(tmp_path: Path, format_: Any, name: str) -> None:
    done = export("tiny", format=format_, size="192x320", mask_scale=2, output=tmp_path / name)
    assert done.parity is not None
    assert done.parity.pixels is not None
    assert done.parity.pixels > 0.9999


@pytest.mark.slow
def test_nothing_is_written_beyond_the_tolerance(
    traced: str, tmp_path: Path, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(TOLERANCES, "fp32", Tolerance(pixels=1.1, overlap=1.1, boxes=1.1, confidence=1.0))
    with pytest.raises(BackendError, match=r"not written after comparison with the network: .*pixels agree"):
        export(traced, size="64x128", output=tmp_path / "a.onnx", frames=frames)
    assert not list(tmp_path.glob("*a.*"))


@pytest.mark.slow
def test_tensorrt_without_tensorrt_says_how(artefacts: Artefacts, tmp_path: Path, frames: Path) -> None:
    weights = str(artefacts.folder / "weights.safetensors")
    done = export(
        weights, format="tensorrt", precision="fp16", size="64x128", output=tmp_path / "a.engine", frames=frames
    )
    assert done.path == tmp_path / "a.onnx"
    assert "no engine was built" in done.summary()
    assert "trtexec --onnx=" in done.summary()
    assert " --fp16 " in done.summary()
    assert "trilitenet[tensorrt] runs a.plan on TensorRT 10, with a.onnx beside it" in done.summary()
    backend = trilitenet.load(done.path, backend="onnxruntime").backend
    assert backend.canvas == (64, 128)
    assert backend.name == "onnxruntime cpu fp32"
    assert json.loads(read_onnx_metadata(done.path)[ARTEFACT_KEY])["format"] == "onnx"


@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_ncnn(artefacts: Artefacts, tmp_path: Path, frames: Path, precision: Any) -> None:
    pytest.importorskip("ncnn")
    pytest.importorskip("pnnx")
    weights, path = str(artefacts.folder / "weights.safetensors"), tmp_path / "made" / "a.ncnn.param"
    done = export(weights, format="ncnn", precision=precision, bgr=True, size="64x128", output=path, frames=frames)
    assert done.parity is not None
    assert done.parity.failures == []
    assert sorted(file.suffix for file in path.parent.iterdir()) == [".bin", ".json", ".param"]
    with trilitenet.load(path.parent) as predictor:
        assert predictor.card.licence == "MIT"
        assert predictor(np.zeros((90, 160, 3), np.uint8)).size == (90, 160)


def _int8_weights(path: Path) -> list[int]:
    """Return the largest magnitude of each tensor of INT8 weights in an artefact."""
    if path.suffix == ".onnx":
        onnx = pytest.importorskip("onnx")
        kind = onnx.TensorProto.INT8
        graph = onnx.load(path).graph
        tensors = [onnx.numpy_helper.to_array(t) for t in graph.initializer if t.data_type == kind and len(t.dims) > 1]
    else:
        openvino = pytest.importorskip("openvino")
        operators = openvino_core(openvino).read_model(path).get_ops()
        constants = [op for op in operators if op.get_type_name() == "Constant"]
        tensors = [op.get_data() for op in constants if op.get_element_type() == openvino.Type.i8]
    return [int(np.abs(tensor.astype(int)).max()) for tensor in tensors]


def _check_quantisers(path: Path) -> None:
    """Activations are symmetric, weights have a scale a channel, depthwise convolutions are left alone."""
    onnx = pytest.importorskip("onnx")
    graph = onnx.load(path).graph
    values = {entry.name: onnx.numpy_helper.to_array(entry) for entry in graph.initializer}
    zeros = {int(values[node.input[2]]) for node in graph.node if node.op_type == "QuantizeLinear"}
    before = tuple(map(int, importlib.metadata.version("onnxruntime").split(".")[:2])) < (1, 24)
    assert zeros == {127 if before else 128}
    from_integers = {node.output[0]: node for node in graph.node if node.op_type == "DequantizeLinear"}
    for node in graph.node:
        grouped = [attribute.i for attribute in node.attribute if attribute.name == "group" and attribute.i > 1]
        if node.op_type == "Conv" and node.input[1] in from_integers:
            assert not grouped
            scales, weight = (values[from_integers[node.input[1]].input[place]] for place in (1, 0))
            assert scales.shape == (len(weight),)


@pytest.mark.slow
@pytest.mark.parametrize("format_", ["openvino", "onnx"])
def test_int8(traced: str, tmp_path: Path, frames: Path, format_: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if format_ == "openvino":
        pytest.importorskip("nncf")
    else:
        monkeypatch.setattr(command, "build_onnx", build_onnx)  # in the layout of this runtime
    monkeypatch.setitem(TOLERANCES, "int8", Tolerance(pixels=0.5, overlap=0.0, boxes=0.0, confidence=1.0))
    bar = Bar()
    monkeypatch.setattr(command, "show_progress", lambda _: contextlib.nullcontext(bar))
    path = tmp_path / ("a.xml" if format_ == "openvino" else "a.onnx")
    done = export(
        traced,
        format=format_,  # type: ignore[arg-type]
        precision="int8",
        size="64x128",
        calibration=frames,
        output=path,
    )
    assert done.parity is not None
    count = len(list(frames.iterdir()))
    assert bar.told[: count + 1] == [*((done, count) for done in range(1, count + 1)), "frames calibrated with"]
    assert (count, count) in bar.told[count + 1 :]
    text = path.read_bytes()
    assert (b"FakeQuantize" if format_ == "openvino" else b"QuantizeLinear") in text
    assert max(_int8_weights(path)) <= 64  # more would overflow where the processor lacks VNNI
    if format_ == "onnx":
        _check_quantisers(path)
    assert "in floating point: difference, detection, c5" in done.summary()
    with trilitenet.load(path, threads=1) as predictor:  # on the runtime that it was quantised for and compared on
        assert predictor.backend.name == f"{'openvino' if format_ == 'openvino' else 'onnxruntime'} cpu int8"
    if format_ == "onnx":
        with pytest.raises(BackendError, match="use backend='onnxruntime'"):
            trilitenet.load(path, backend="openvino")


@pytest.mark.parametrize(
    ("max_drop", "drops", "step", "notes"),
    [
        (None, [], 1, ("in floating point: difference, detection, c5",)),
        (
            1.0,
            [3.0, 1.0],
            1,
            ("in floating point: difference, detection, c5", "largest drop on val: 1.00 points"),
        ),
        (
            1.0,
            [0.5],
            0,
            (
                "in floating point: nothing that can be quantised",
                "largest drop on val: 0.50 points",
            ),
        ),
        (1.0, [9.0] * 5, None, ()),
    ],
)
def test_int8_keeps_as_little_in_floating_point_as_the_scores_allow(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    max_drop: float | None,
    drops: list[float],
    step: int | None,
    notes: tuple[str, ...],
) -> None:
    for split, count in (("train", 3), ("val", 1)):
        write_dataset(tmp_path / "data", split, count, 0, size=(32, 64))
    calls: list[tuple[Any, tuple[str, ...]]] = []
    left = iter(drops)

    class Drop:
        def __init__(self, *_: object) -> None: ...

        def measure(self, backend: object) -> float:
            return next(left)

    def quantize(inputs: Any, keep: Any) -> None:
        calls.append((list(inputs), tuple(keep)))

    monkeypatch.setattr(command, "prepare_input", lambda image, told: (image.shape, told))
    monkeypatch.setattr(command, "_Drop", Drop)
    monkeypatch.setattr(command, "_write", lambda *_: None)
    monkeypatch.setattr(command, "_open", lambda *_: None)
    monkeypatch.setattr(
        command, "_keep", lambda _network, _built, info, path, _checks: command.Exported(path, info, None)
    )
    info = ArtefactInfo("onnx", "int8", (32, 64))
    arguments: tuple[Any, ...] = (None, quantize, info, tmp_path / "a.onnx", [], tmp_path / "data", 500, max_drop)
    if step is None:
        with pytest.raises(BackendError, match=r"INT8 costs too much .*\(9\.00 points lost, at most 1\.0 allowed\)"):
            command._export_int8(*arguments)
        assert [keep for _, keep in calls] == list(KEEP_STEPS)
    else:
        assert command._export_int8(*arguments).notes == notes
        # On the training split, as the artefact takes it.
        assert calls[-1] == ([((32, 64, 3), info)] * 3, KEEP_STEPS[step])


def test_suppression_inside_is_not_overridden_silently(traced: str, tmp_path: Path) -> None:
    path = export(traced, output=tmp_path / "a.onnx", size="64x128", nms=True).path
    inside = trilitenet.load(path).thresholds
    assert trilitenet.load(path, confidence=0.9, iou=inside.iou).thresholds.confidence == 0.9
    for change in ({"confidence": inside.confidence / 2}, {"iou": 0.99}, {"iou": 0.1}):
        with pytest.raises(ConfigError, match="export it without --nms"):
            trilitenet.load(path, **change)  # type: ignore[arg-type]


def test_the_drop_is_measured_all_over_the_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(tmp_path, "val", 7, 0, size=(32, 64))
    monkeypatch.setattr(command, "DROP_FRAMES", 3)
    names = DrivingDataset(tmp_path, "val").names
    assert command.drop_frames(tmp_path).names == [names[0], names[3], names[6]]


def test_the_drop_is_that_of_the_worst_of_all_tasks(
    traced: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every task's score is looked at, detection's too, under a name that reports have."""
    assert set(command.DROP_SCORES) == set(TASKS)
    assert set(command.DROP_SCORES.values()) <= set(FIGURES)
    write_dataset(tmp_path / "data", "val", 2, 0, size=(96, 160))
    network = load_network(traced)
    detection, drivable, lane = "fair/detection/ap50", "fair/drivable/miou", "fair/lane/iou"
    changes = iter([{}, {detection: 0.48}, {drivable: 0.47}, {lane: 0.46}, {lane: math.nan}])
    canvases = []

    def worse(predictor: Predictor, *arguments: Any, **options: Any) -> Report:
        canvases.append(predictor.backend.canvas)
        report = evaluate(predictor, *arguments, **options)
        values = dict.fromkeys(report.figures, 0.5) | next(changes)
        return dataclasses.replace(report, figures={key: Figure(value, None, None) for key, value in values.items()})

    monkeypatch.setattr(command, "evaluate", worse)
    path = export(traced, output=tmp_path / "a.onnx", size="64x128").path
    bar = Bar()
    drop = command._Drop(network, (64, 128), tmp_path / "data", bar)
    assert bar.told == ["images measured", (1, 2), (2, 2)]
    losses = [drop.measure(OnnxBackend(path)) for _ in range(4)]
    assert bar.told == ["images measured", (1, 2), (2, 2)] * 5
    assert losses == pytest.approx([2.0, 3.0, 4.0, 50.0])  # what cannot be told is lost
    assert canvases == [(64, 128)] * 5  # the network is looked at once
    monkeypatch.undo()
    for labels in ("det_annotations", "da_seg_annotations", "ll_seg_annotations"):
        shutil.rmtree(tmp_path / "data" / labels)
    with pytest.raises(ConfigError, match="--max-drop needs labels"):
        command._Drop(network, (64, 128), tmp_path / "data", bar)
