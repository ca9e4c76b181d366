"""Exported ``.param`` artefacts on NCNN. PyTorch is not needed."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import GRAPH_HASH_KEY, WEIGHTS_HASH_KEY, ArtefactInfo, ModelCard, parse_json
from trilitenet.errors import BackendError, ConfigError, WeightsError, import_extra
from trilitenet.inference.backend import ParallelSessions, check_process, held
from trilitenet.inference.exported import ArtefactBackend, prepare_input, read_metadata

__all__ = ["NcnnBackend"]

_MAGIC: Final = b"7767517"


class NcnnBackend(ParallelSessions, ArtefactBackend):
    """An artefact of ``trilitenet export --format ncnn`` on NCNN, on the CPU.

    Args:
        path: The ``.param`` file, with its ``.bin`` and its ``.json`` beside it, or a folder with one such artefact.
        device: ``"auto"`` or ``"cpu"``.
        precision: What to compute in: ``"fp32"`` or ``"fp16"``. By default what the artefact was exported for; fp16
            falls back to fp32 where the processor lacks it, as all but Arm's do.
        threads: Threads; NCNN's own choice if left out.

    Attributes:
        precision: What it computes in.

    Raises:
        MissingExtraError: If NCNN is not installed.
        WeightsError: If a file is missing, broken or foreign, or of a newer layout.
        BackendError: If the device is not there.
        ConfigError: If the precision is unknown.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        device: str = "auto",
        *,
        precision: str | None = None,
        threads: int | None = None,
    ) -> None:
        self._ncnn = import_extra("ncnn", "ncnn")
        if device not in ("auto", "cpu"):
            raise BackendError(f"device {device!r}: NCNN runs on the CPU here; use auto or cpu")
        if precision not in (None, "fp32", "fp16"):
            raise ConfigError(f"unknown precision {precision!r}; known: fp32, fp16")
        self._path, self._threads = _find(Path(path)), threads
        self._card, self.info = _read(self._path)
        self._file = self._path.absolute()  # which stays the same where the process changes its folder
        wanted = precision or self.info.precision
        self.precision = "fp16" if wanted == "fp16" and self._ncnn.cpu_support_arm_asimdhp() else "fp32"
        self._device = "cpu"
        self._process = os.getpid()
        self._session: Any = self._open(threads)

    def _open(self, threads: int | None) -> Any:
        net = self._ncnn.Net()
        half = self.precision == "fp16"
        net.opt.use_fp16_packed = net.opt.use_fp16_storage = net.opt.use_fp16_arithmetic = half
        if threads is not None:
            net.opt.num_threads = threads
        if net.load_param(str(self._file)) or net.load_model(str(self._file.with_suffix(".bin"))):
            raise WeightsError(f"{self._path}: not a usable NCNN model (its layers or their weights cannot be read)")
        missing = {"image", *self._card.tasks} - {*net.input_names(), *net.output_names()}
        if missing:
            raise WeightsError(f"{self._path}: not a usable NCNN model (it has no {', '.join(sorted(missing))})")
        return net

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it as what opens it again: its file, which must be there, and its options."""
        return functools.partial(NcnnBackend, self._file, precision=self.precision, threads=self._threads), ()

    @property
    def name(self) -> str:
        """The runtime, the device and the precision."""
        return f"ncnn cpu {self.precision}"

    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        net = held(self._session, self._path)
        check_process(self._process)
        return [self._run(net, image) for image in batch]

    def _run(self, net: Any, image: NDArray[np.uint8]) -> Mapping[str, NDArray[Any]]:
        planes = prepare_input(image, self.info)[0]  # named, for the Mat borrows its memory without keeping it alive
        results: dict[str, NDArray[Any]] = {}
        with net.create_extractor() as extractor:
            extractor.input("image", self._ncnn.Mat(planes))
            for task in self._card.tasks:
                status, output = extractor.extract(task)
                if status:
                    raise BackendError(f"{self._path}: NCNN cannot compute {task} (status {status})")
                values = np.array(output)  # a copy: the memory is of the network's own pool
                del output
                results[task] = values.reshape(1, *values.shape[-2:])  # pnnx 20250530 leaves masks a third axis
        return results

    def close(self) -> None:
        """Free the network."""
        self._session = None


def _find(path: Path) -> Path:
    """Return the ``.param`` file that is meant."""
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.param"))
    if len(found) != 1:
        raise WeightsError(f"{path}: holds {len(found)} .param files; name the one to load")
    return found[0]


def _read(path: Path) -> tuple[ModelCard, ArtefactInfo]:
    """Check the three files of an artefact and return what its ``.json`` says."""
    weights, side = path.with_suffix(".bin"), path.with_suffix(".json")
    for file in (path, weights, side):
        if not file.is_file():
            beside = "" if file is path else f"; it belongs beside {path.name}"
            raise WeightsError(f"{file}: no such file{beside}")
    with path.open("rb") as start:
        # Checked here because NCNN talks about what it cannot read.
        if start.read(len(_MAGIC)) != _MAGIC:
            raise WeightsError(f"{path}: not a usable NCNN model (it does not begin as one)")
    try:
        found = parse_json(side.read_text(encoding="utf-8"))
    except ValueError as error:
        raise WeightsError(f"{side}: not JSON ({error})") from error
    if not isinstance(found, dict):
        raise WeightsError(f"{side}: not the metadata of an artefact (not an object)")
    card, info = read_metadata({key: json.dumps(value) for key, value in found.items()}, str(side))
    # NCNN takes a piece of a graph for a whole one.
    for file, what, key in ((weights, "weights", WEIGHTS_HASH_KEY), (path, "graph", GRAPH_HASH_KEY)):
        if hashlib.sha256(file.read_bytes()).hexdigest() != found.get(key):
            raise WeightsError(f"{file}: not the {what} that {side.name} was written for; export the model again")
    return card, info
