"""Export a model to another runtime, checked against the network before anything is written."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import logging
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import interpolate

import trilitenet
from trilitenet.commands.load import open_backend
from trilitenet.commands.paths import NameOrPath, SizeText, StrPath, check_writable, optional_path
from trilitenet.commands.progress import ProgressBar, show_progress
from trilitenet.config import (
    ARTEFACT_KEY,
    ARTEFACT_SUFFIXES,
    CARD_KEY,
    DYNAMIC_SIDES,
    ArtefactInfo,
    Masks,
    Precision,
    Task,
    check_size,
)
from trilitenet.data.reading import DrivingDataset, is_image_file
from trilitenet.deploy.executorch import build_executorch
from trilitenet.deploy.graph import DeployGraph, Traceable
from trilitenet.deploy.layouts import pick_layout
from trilitenet.deploy.ncnn import build_ncnn, save_ncnn
from trilitenet.deploy.onnx import build_onnx, save_onnx
from trilitenet.deploy.openvino import build_openvino, save_openvino, vector_unit
from trilitenet.deploy.parity import TOLERANCES, Parity, compare
from trilitenet.deploy.quantize import KEEP_STEPS, quantize_onnx, quantize_openvino
from trilitenet.deploy.tensorrt import build_engine, is_installed, trtexec_line
from trilitenet.deploy.triton import write_triton_repository
from trilitenet.engine.evaluate import evaluate
from trilitenet.errors import (
    BackendError,
    ConfigError,
    InputError,
    OutputError,
    did_you_mean,
    folder_beside,
    scratch_folder,
    writing,
)
from trilitenet.formats.writers.base import uninterrupted
from trilitenet.inference.backend import Backend
from trilitenet.inference.exported import prepare_input
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.models.trilitenet import NetworkOutputs, TriLiteNet
from trilitenet.models.weights import load_network, read_card
from trilitenet.processing.images import read_image
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import RawOutputs

__all__ = [
    "DROP_FRAMES",
    "PRECISIONS",
    "Exported",
    "check_drop",
    "drop_frames",
    "export",
    "find_pictures",
]

Format = Literal["onnx", "openvino", "ncnn", "executorch", "tensorrt", "torch", "triton"]
_Item = TypeVar("_Item")

PRECISIONS: Final[dict[str, tuple[Precision, ...]]] = {
    "onnx": ("fp32", "fp16", "int8"),
    "openvino": ("fp32", "fp16", "bf16", "int8"),
    "ncnn": ("fp32", "fp16"),
    "executorch": ("fp32", "int8"),
    "tensorrt": ("fp32", "fp16", "bf16"),
    "torch": ("fp32",),
    "triton": ("fp32", "fp16", "int8"),
}
"""Precisions of a format."""
_LOGGER: Final = logging.getLogger(__name__)
_RUNTIMES: Final = {"onnx": "onnxruntime"}
"""Runtimes that are not called as their format is."""
_PORTABLE: Final = ("ncnn", "executorch", "tensorrt")
"""Formats of the portable graph, of a fixed size."""
DROP_FRAMES: Final = 150
"""The drop of INT8 is measured on at most so many images, spread evenly over the val split."""
DROP_SCORES: Final[dict[Task, str]] = {
    "detection": "fair/detection/ap50",
    "drivable": "fair/drivable/miou",
    "lane": "fair/lane/iou",
}
"""Of which the largest drop counts."""


@dataclasses.dataclass(frozen=True)
class Exported:
    """What an export wrote.

    Attributes:
        path: The artefact.
        info: How it takes pixels and returns results.
        parity: How it compares with the network; None if it cannot run here.
        notes: What a user should know, such as the command that finishes the job elsewhere.
    """

    path: Path
    info: ArtefactInfo
    parity: Parity | None
    notes: tuple[str, ...] = ()

    def summary(self) -> str:
        """Return the lines that the command line prints."""
        anything = "any multiple of 32" + (
            " from {} to {}".format(*DYNAMIC_SIDES) if self.info.format == "torch" else ""
        )
        size = anything if self.info.size is None else f"{self.info.size[1]}x{self.info.size[0]}"
        lines = [f"{self.path}: {self.info.format} {self.info.precision}, input {size} {self.info.colour.upper()}"]
        if self.parity is not None:
            lines.append(self.parity.summary())
        return "\n".join((*lines, *self.notes))


def export(
    model: NameOrPath = "tiny",
    /,
    *,
    format: Format = "onnx",
    output: StrPath | None = None,
    precision: Precision = "fp32",
    size: SizeText | None = None,
    calibration: StrPath | None = None,
    calibration_frames: int = 500,
    max_drop: float | None = None,
    nms: bool = False,
    portable: bool = False,
    masks: Masks | None = None,
    mask_scale: int = 1,
    bgr: bool = False,
    layout: str = "auto",
    frames: StrPath | None = None,
    network: str | None = None,
    overwrite: bool = False,
) -> Exported:
    """Export a model to another runtime; preprocessing, anchors, classes and thresholds travel inside.

    The artefact is compared with the float32 network on frames before it is kept: beyond the tolerance nothing is
    written. Load it with `trilitenet.load`, which needs nothing else.

    While it converts and quantises, warnings and standard output of the whole process are off, and what this thread
    logs below errors; exports of several threads take turns there.

    Args:
        model: Name of shipped weights, or a file of weights.
        format: onnx, openvino (.xml and .bin), ncnn (.ncnn.param, .bin and .json), executorch (.pte), tensorrt
            (.engine, or .onnx and the trtexec line), torch (.pt2) or triton (a model repository with an ONNX graph).
        output: File to write (for triton, the folder of the repository); by default named after the model, here.
        precision: fp32, fp16 (weights stored so; on Arm, NCNN computes so too), bf16 (OpenVINO) or int8 (needs
            --calibration).
        size: HEIGHTxWIDTH of the input in multiples of 32, such as 384x640, or dynamic (not with int8, --portable,
            ncnn, executorch or tensorrt); the size that the model was trained at if left out.
        calibration: Frames for INT8: a data set in the published layout (its train split) or a folder of pictures.
        calibration_frames: At most so many of them.
        max_drop: INT8 may lose at most so many points of a score on the val split of --calibration; layers fall back
            to floating point, part by part, until it does.
        nms: Put non-maximum suppression inside, with the model's thresholds (onnx, openvino, triton).
        portable: Avoid operators that compilers for phones and accelerators refuse; float input, float mask logits; of
            a fixed size and, as onnx and triton, fp32.
        masks: decision (0 or 1, by the model's thresholds; the default), probability (x 255) or logit (the only choice,
            and the default, with --portable, ncnn, executorch and tensorrt).
        mask_scale: 2 doubles the size of masks inside the graph.
        bgr: Take BGR pixels (`trilitenet.load` converts by itself).
        layout: auto, or a memory layout by name (docs/speed.md); all compute the same.
        frames: Pictures for the comparison; by default those of --calibration, else synthetic scenes. INT8 that was
            calibrated on a folder of pictures is compared on both.
        network: The function that built the network, where it is one of your own with other widths or numbers of
            blocks: FILE.py:FUNCTION or MODULE:FUNCTION. Other layers cannot be exported.
        overwrite: Replace existing files of an artefact.

    Returns:
        What was written.

    Raises:
        ConfigError: If options do not fit each other.
        OutputError: If a file of the artefact exists (told before the work begins), or cannot be written.
        BackendError: If the comparison fails.
    """
    model, output, calibration, frames = os.fspath(model), *map(optional_path, (output, calibration, frames))
    portable = portable or format in _PORTABLE
    usual = read_card(model).input_size
    parsed = usual if size is None else _parse_size(size)
    _check_options(
        format, precision, parsed, calibration, calibration_frames, max_drop, nms, portable, masks, mask_scale, layout
    )
    path = _destination(model, format, output)
    _check_files(path, format, overwrite)
    trained = load_network(model, network)
    if nms and "detection" not in trained.tasks:
        raise ConfigError(f"{model} has no detection task, so there are no boxes to suppress; leave --nms out")
    if format == "triton":
        with scratch_folder() as folder:
            graph_path = folder / "model.onnx"
            try:
                exported = export(
                    model,
                    format="onnx",
                    output=graph_path,
                    precision=precision,
                    size=size,
                    calibration=calibration,
                    calibration_frames=calibration_frames,
                    max_drop=max_drop,
                    nms=nms,
                    portable=portable,
                    masks=masks,
                    mask_scale=mask_scale,
                    bgr=bgr,
                    layout=layout,
                    frames=frames,
                    network=network,
                )
            except BackendError as error:  # it names the graph, which goes with its folder
                raise BackendError(str(error).replace(str(graph_path), str(path))) from error
            with uninterrupted():  # the former model has gone before the new one comes
                write_triton_repository(exported.path, path.parent, trained.card, name=path.name, overwrite=overwrite)
        serve = f"Serve it with: tritonserver --model-repository {path.parent.resolve()}"
        return dataclasses.replace(exported, path=path, notes=(*exported.notes, serve))

    if parsed == usual[::-1] != usual:
        _tell_turned(parsed, usual)
    masks = masks or ("logit" if portable else "decision")
    info = ArtefactInfo(
        format=format,
        precision=precision,
        size=parsed,
        input="float_nchw" if portable else "uint8_nhwc",
        colour="bgr" if bgr else "rgb",
        masks=masks,
        mask_scale=mask_scale,
        nms=nms,
        trilitenet=trilitenet.__version__,
    )
    runtime = "planar" if portable else _RUNTIMES.get(format, format)
    graph = DeployGraph(
        trained,
        pick_layout(layout, trained.variant, runtime, unit=vector_unit()),
        masks=masks,
        mask_scale=mask_scale,
        bgr=bgr,
    )
    canvas = parsed or trained.card.input_size
    checks = _canvases(frames or calibration, canvas, 8)
    if precision == "int8" and frames is None and calibration is not None and not _has_val(calibration):
        checks += _canvases(None, canvas, 4)  # the others are what it was calibrated on
    if format == "torch":
        traceable = Traceable(graph, trained.card, info)
        with torch.no_grad():
            program = torch.export.export(traceable, (traceable.image,), dynamic_shapes=traceable.dynamic)
        return _keep(trained, program, info, path, checks)
    if format == "ncnn":
        return _keep(trained, build_ncnn(graph, trained.card, info), info, path, checks)
    if format == "executorch":
        build = functools.partial(build_executorch, graph, trained.card, info)
        if calibration is None or precision != "int8":
            return _keep(trained, build(), info, path, checks)
        return _export_int8(trained, build, info, path, checks, calibration, calibration_frames, max_drop)
    # What TensorRT is built from is a graph in fp32, which calls itself so where it is kept.
    traced = dataclasses.replace(info, format="onnx", precision="fp32") if format == "tensorrt" else info
    thresholds = trained.card.thresholds if nms else None
    proto = build_onnx(graph, trained.card, traced, nms=thresholds, half=format == "onnx" and precision == "fp16")
    if format == "tensorrt" and is_installed():  # pragma: no cover - needs a GPU and TensorRT
        return _keep(trained, build_engine(proto, precision), info, path, checks)
    if format == "tensorrt":
        exported = _keep(trained, proto, traced, _fallback(path), checks)
        return dataclasses.replace(exported, notes=_engine_notes(exported.path, path, precision))
    built: Any = build_openvino(proto) if format == "openvino" else proto
    if calibration is None or precision != "int8":
        return _keep(trained, built, info, path, checks)
    quantize = functools.partial(quantize_openvino if format == "openvino" else quantize_onnx, built)
    return _export_int8(trained, quantize, info, path, checks, calibration, calibration_frames, max_drop)


def _check_options(
    format: Format,
    precision: Precision,
    size: tuple[int, int] | None,
    calibration: Path | None,
    calibration_frames: int,
    max_drop: float | None,
    nms: bool,
    portable: bool,
    masks: Masks | None,
    mask_scale: int,
    layout: str,
) -> None:
    """Refuse options that do not fit each other."""
    if format not in PRECISIONS:
        raise ConfigError(f"unknown format {format!r}{did_you_mean(format, PRECISIONS)}")
    if precision not in PRECISIONS[format]:
        raise ConfigError(f"{format} artefacts come as {', '.join(PRECISIONS[format])}, not {precision}")
    if nms and format not in ("onnx", "openvino", "triton"):
        raise ConfigError("--nms is for onnx, openvino and triton")
    if nms and portable:
        raise ConfigError("--portable keeps to operators that --nms needs more than; choose one of them")
    if precision == "int8" and calibration is None:
        raise ConfigError("int8 needs --calibration: a data set in the published layout, or a folder of road frames")
    if calibration_frames < 1:
        raise ConfigError(f"--calibration-frames must be at least 1, got {calibration_frames}")
    if max_drop is not None and precision != "int8":
        raise ConfigError("--max-drop is for --precision int8")
    check_drop(max_drop)
    if max_drop is not None and nms:
        raise ConfigError("--max-drop measures the boxes that --nms drops; find what to keep without --nms")
    if portable and layout not in ("auto", "planar"):
        raise ConfigError(f"--portable is planar, as are {', '.join(_PORTABLE)}; leave --layout {layout} out")
    if size is None and (precision == "int8" or portable):
        what = "int8" if precision == "int8" else format if format in _PORTABLE else "--portable"
        raise ConfigError(f"{what} needs a fixed --size")
    if portable and format in ("onnx", "triton") and precision != "fp32":
        raise ConfigError(f"--portable keeps to operators that {precision} needs more than; choose one of them")
    if portable and masks not in (None, "logit"):
        raise ConfigError(
            f"masks of --portable, {', '.join(_PORTABLE)} are logits; give --masks logit or leave it out, not {masks}"
        )
    if portable and mask_scale != 1:
        raise ConfigError(
            f"--mask-scale doubles masks that are decided; --portable, {', '.join(_PORTABLE)} give logits"
        )


def check_drop(max_drop: float | None) -> None:
    """Refuse points that a precision may lose that are no such number.

    Raises:
        ConfigError: If they are negative, or not finite.
    """
    if max_drop is not None and not 0 <= max_drop < math.inf:
        raise ConfigError(f"--max-drop must be points, not negative and finite, got {max_drop}")


def _destination(model: str, format: Format, output: Path | None) -> Path:
    """Return the file to write; for triton, the folder of the model in the repository."""
    if format == "triton":
        return (output or Path("model_repository")) / Path(model).stem
    ending = ARTEFACT_SUFFIXES[format]
    path = output or Path(f"{Path(model).stem}{ending}")
    endings = (ending, ".onnx") if format == "tensorrt" and not is_installed() else (ending,)
    if not path.name.endswith(endings):
        raise ConfigError(f"{format} artefacts end with {ending}, not {path.suffix or 'nothing'}")
    return path


def _check_files(path: Path, format: Format, overwrite: bool) -> None:
    """Refuse, before any work, files that exist already and those that cannot be written."""
    files = [path]
    if format == "openvino":
        files = [path, path.with_suffix(".bin")]
    elif format == "ncnn":
        files = [path, path.with_suffix(".bin"), path.with_suffix(".json")]
    elif format == "tensorrt" and not is_installed():
        files = [_fallback(path)]
    elif format == "triton":
        files = [path / "config.pbtxt", path / "1" / "model.onnx"]
    for file in (path, *files):
        with writing(file):
            exists = file.exists()
        if exists and not overwrite:
            raise OutputError(f"{file}: exists already; give another --output or --overwrite")
    for file in files:
        check_writable(file)


def _parse_size(size: SizeText) -> tuple[int, int] | None:
    """Return (height, width), None for dynamic."""
    if size == "dynamic":
        return None
    words = "x".join(map(str, size)) if isinstance(size, (tuple, list)) else size
    match = re.fullmatch(r"(\d+)x(\d+)", words)
    if match is None:
        raise ConfigError(f"--size is HEIGHTxWIDTH such as 384x640, or dynamic, not {size!r}")
    canvas = int(match[1]), int(match[2])
    check_size(canvas, "--size")
    return canvas


def _tell_turned(size: tuple[int, int], usual: tuple[int, int]) -> None:
    """Warn of a (height, width) that is the one of training turned round, as if it had been meant width first."""
    (height, width), (usual_height, usual_width) = size, usual
    kind = "an upright" if height > width else "a wide"
    asked = f"--size {height}x{width} is {kind} input, {height} high and {width} wide"
    trained = f"{usual_width} wide and {usual_height} high, is --size {usual_height}x{usual_width}"
    _LOGGER.warning("%s; as trained, %s", asked, trained)


def _canvases(source: Path | None, canvas: tuple[int, int], count: int) -> list[NDArray[np.uint8]]:
    """Return letterboxed frames, spread evenly over what there is; synthetic scenes without a source."""
    if source is None:
        from trilitenet.data.synthetic import SyntheticScenes

        scenes = SyntheticScenes(seed=0, size=canvas)
        images = [scenes[index].image for index in range(min(count, 4))]
    else:
        images = [read_image(path) for path in find_pictures(source, count, "val")]
    return [_on_canvas(image, canvas) for image in images]


def _on_canvas(image: NDArray[np.uint8], canvas: tuple[int, int]) -> NDArray[np.uint8]:
    return Letterbox.fit(image.shape[:2], canvas=canvas).image(image)


def find_pictures(source: Path, count: int, split: str) -> list[Path]:
    """Return at most ``count`` pictures of a data set's split, or of a folder, spread evenly over what there is.

    Raises:
        InputError: If there are none or no folder, or a data set has a val split and no train split that was asked for.
    """
    if not source.is_dir():
        what = "is a file; give a folder of pictures" if source.exists() else "no such folder"
        raise InputError(f"{source}: {what}")
    images = source / "images"
    folder = images / split
    if not folder.is_dir():
        if split == "train" and _has_val(source):
            raise InputError(f"{source}: has no train split to calibrate on; give a folder of other pictures")
        folder = images if images.is_dir() else source  # a data set's masks are no pictures
    paths = sorted(path for path in folder.rglob("*") if is_image_file(path.name))
    if not paths:
        raise InputError(f"{source}: no pictures there")
    return _spread(paths, count)


def _has_val(data: Path) -> bool:
    return (data / "images" / "val").is_dir()


def drop_frames(data: Path, class_names: Sequence[str] | None = None) -> DrivingDataset:
    """Return what the drop of INT8 is measured on: at most `DROP_FRAMES` images, from all over the val split."""
    dataset = DrivingDataset(data, "val", class_names=class_names)
    return DrivingDataset(data, "val", class_names=class_names, names=_spread(dataset.names, DROP_FRAMES))


def _spread(items: Sequence[_Item], count: int) -> list[_Item]:
    chosen = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[index] for index in chosen]


def _write(built: Any, path: Path, network: TriLiteNet, info: ArtefactInfo) -> None:
    if info.format == "openvino":
        save_openvino(built, path, network.card, info)
    elif info.format == "ncnn":
        save_ncnn(built, path, network.card, info)
    elif info.format == "executorch":
        path.write_bytes(built)
    elif info.format == "torch":
        metadata = {CARD_KEY: network.card.to_json(), ARTEFACT_KEY: info.to_json()}
        data = io.BytesIO()  # PyTorch aborts the process where it cannot write to a file
        torch.export.save(built, data, extra_files=metadata)
        path.write_bytes(data.getvalue())
    elif info.format == "tensorrt":  # pragma: no cover - needs a GPU and TensorRT
        from trilitenet.inference.tensorrt_backend import pack_engine

        path.write_bytes(pack_engine(built, network.card, info))
    else:
        save_onnx(built, path)


def _keep(
    network: TriLiteNet, built: Any, info: ArtefactInfo, path: Path, checks: Sequence[NDArray[np.uint8]]
) -> Exported:
    """Write beside the destination, compare, and only then move into place."""
    with _trial(path) as trial:
        _write(built, trial, network, info)
        with contextlib.closing(_open(trial, info)) as backend:
            parity = _compare(network, backend, info, checks)
        if parity.failures:
            raise BackendError(f"{path}: not written after comparison with the network: {'; '.join(parity.failures)}")
    return Exported(path, info, parity)


@contextlib.contextmanager
def _trial(path: Path) -> Iterator[Path]:
    """Yield a name beside the destination; what is written there is moved into place if nothing is raised."""
    folder = path.parent
    try:
        with writing(path), folder_beside(path) as folder:
            yield folder / path.name
            with uninterrupted():  # files of an artefact belong together
                for part in folder.iterdir():
                    part.replace(path.parent / part.name)
    except OutputError as error:
        raise OutputError(str(error).replace(str(folder), str(path.parent))) from error


def _open(path: Path, info: ArtefactInfo) -> Backend:
    return open_backend(path, "cpu", _RUNTIMES.get(info.format, info.format))


def _compare(network: TriLiteNet, backend: Backend, info: ArtefactInfo, checks: Sequence[NDArray[np.uint8]]) -> Parity:
    thresholds = network.card.thresholds
    reference: Backend = TorchBackend(network, "cpu")
    if info.nms:
        reference = _Suppressed(reference)
    doubling = network.register_forward_hook(_double_masks) if info.mask_scale == 2 else None
    try:
        return compare(
            reference.run,
            backend.run,
            checks,
            TOLERANCES[info.precision],
            masks=(thresholds.drivable, thresholds.lane),
            confidence=thresholds.confidence,
        )
    finally:
        if doubling is not None:
            doubling.remove()


def _double_masks(_network: Any, _images: Any, outputs: NetworkOutputs) -> NetworkOutputs:
    """Double the masks of a network's outputs as ``--mask-scale 2`` does: bilinear, before the decision."""

    def double(mask: torch.Tensor | None) -> torch.Tensor | None:
        return None if mask is None else interpolate(mask, scale_factor=2.0, mode="bilinear", align_corners=False)

    return outputs._replace(drivable=double(outputs.drivable), lane=double(outputs.lane))


class _Suppressed:
    """The network with suppression after it, to compare with an artefact that has it inside."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        from trilitenet.processing.boxes import cxcywh_to_xyxy
        from trilitenet.processing.nms import nms
        from trilitenet.processing.postprocess import judge

        raw = self._backend.run(batch)
        if raw.detection is None:
            return raw
        thresholds = self._backend.card.thresholds
        rows = raw.detection[0]
        class_id, scores = judge(rows)
        above = scores > thresholds.confidence
        rows, class_id, scores = rows[above], class_id[above], scores[above]
        kept = nms(cxcywh_to_xyxy(rows[:, :4]), scores, class_id, thresholds.iou, thresholds.max_boxes)
        return dataclasses.replace(raw, detection=rows[kept][None])


class _Counted(Sequence[_Item]):
    """Items of which a bar shows how many have been taken, each time that somebody goes through them."""

    def __init__(self, items: Sequence[_Item], bar: ProgressBar) -> None:
        self._items = items
        self._bar = bar

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: Any) -> Any:
        return self._items[index]

    def __iter__(self) -> Iterator[_Item]:
        for done, item in enumerate(self._items, 1):
            self._bar(done, len(self))
            yield item


class _Drop:
    """The largest loss of a score in points on the val split, against the float32 network on the same pixels."""

    def __init__(self, network: TriLiteNet, size: tuple[int, int] | None, data: Path, bar: ProgressBar) -> None:
        if not _has_val(data):
            raise ConfigError(f"--max-drop needs labels; {data} is not a data set with a val split")
        self._bar = bar
        tasks = network.card.tasks
        self._keys = [DROP_SCORES[task] for task in tasks]
        self._dataset = drop_frames(data, network.card.class_names)
        self._before = self._scores(TorchBackend(network, "cpu", size))
        if not self._before:
            raise ConfigError(f"--max-drop needs labels; there are none for {', '.join(tasks)} in {data}")

    def measure(self, backend: Backend) -> float:
        """Return what an artefact loses; closes its backend."""
        after = self._scores(backend)
        return max(100 * (value - after.get(key, 0.0)) for key, value in self._before.items())

    def _scores(self, backend: Backend) -> dict[str, float]:
        self._bar.name("images measured")
        with Predictor(backend) as predictor:
            figures = evaluate(predictor, self._dataset, resamples=0, worst=0, by=(), progress=self._bar).figures
        values = {key: figures[key].value for key in self._keys if key in figures}
        return {key: value for key, value in values.items() if math.isfinite(value)}


def _export_int8(
    network: TriLiteNet,
    quantize: Callable[[Sequence[NDArray[Any]], Sequence[str]], Any],
    info: ArtefactInfo,
    path: Path,
    checks: Sequence[NDArray[np.uint8]],
    calibration: Path,
    calibration_frames: int,
    max_drop: float | None,
) -> Exported:
    """Quantise, and leave more and more parts in floating point until no score loses more than ``max_drop`` points."""
    canvas = info.size or network.card.input_size
    reason = ""
    with show_progress("frames read") as bar:
        pictures = find_pictures(calibration, calibration_frames, "train")
        budget = None
        if max_drop is not None:
            budget = _Drop(network, info.size, calibration, bar)
            bar.name("frames read")
        inputs = [prepare_input(_on_canvas(read_image(one), canvas), info) for one in _Counted(pictures, bar)]
        for keep in KEEP_STEPS if budget else KEEP_STEPS[1:2]:
            bar.name("frames calibrated with")
            candidate = quantize(_Counted(inputs, bar), keep)
            drop = 0.0
            if budget:
                with scratch_folder() as folder:
                    trial = folder / path.name
                    _write(candidate, trial, network, info)
                    drop = budget.measure(_open(trial, info))
            if max_drop is None or drop <= max_drop:
                exported = _keep(network, candidate, info, path, checks)
                kept = f"in floating point: {', '.join(keep) or 'nothing that can be quantised'}"
                notes = (kept,) if max_drop is None else (kept, f"largest drop on val: {drop:.2f} points")
                return dataclasses.replace(exported, notes=notes)
            reason = f"{drop:.2f} points lost, at most {max_drop} allowed"
    raise BackendError(f"{path}: not written, INT8 costs too much even with most layers in floating point ({reason})")


def _engine_notes(graph: Path, engine: Path, precision: Precision) -> tuple[str, ...]:
    """Say how an engine is built from the restricted ONNX graph elsewhere, and what runs it."""
    plan = engine.with_suffix(".plan")
    return (
        "TensorRT is not installed here: no engine was built, and none was run.",
        "On the machine that will run it:",
        f"  {trtexec_line(graph, plan, precision)}",
        f"There trilitenet[tensorrt] runs {plan.name} on TensorRT 10, with {graph.name} beside it,",
        "as do programs of your own on TensorRT's C++ or Python interface, of the version that built it.",
    )


def _fallback(engine: Path) -> Path:
    """Return where the graph goes that an engine is built from elsewhere."""
    return engine.with_suffix(".onnx")
