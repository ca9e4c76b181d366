"""What backends and clients of exported artefacts share: their metadata, their input, and their outputs gathered."""

from __future__ import annotations

import abc
import hashlib
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, MAX_STRIDE, ArtefactInfo, ModelCard
from trilitenet.errors import BackendError, ShapeError, TriLiteNetError, WeightsError, gist
from trilitenet.inference.backend import check_batch
from trilitenet.structures import RawOutputs

__all__ = [
    "ArtefactBackend",
    "check_graph",
    "gather_outputs",
    "is_int8_onnx",
    "prepare_input",
    "read_metadata",
    "read_onnx",
    "read_onnx_metadata",
]

_METADATA_BYTES = 1 << 16
_ONNX_METADATA: Final = 14
"""Number of the field of an ONNX model that holds a key and a value."""
_HASH: Final = re.compile(rb"\x72.\x0a." + re.escape(GRAPH_HASH_KEY.encode()) + rb"\x12\x40([0-9a-f]{64})", re.DOTALL)
"""Such a field with the hash, as it stands in the file."""


def read_metadata(metadata: Mapping[str, str], source: str) -> tuple[ModelCard, ArtefactInfo]:
    """Return the card and the description of an artefact.

    Args:
        metadata: The artefact's own key-value pairs.
        source: The file, for messages.

    Raises:
        WeightsError: If they are missing, broken or of a newer layout.
    """
    for key in (CARD_KEY, ARTEFACT_KEY):
        if key not in metadata:
            raise WeightsError(f"{source}: no {key!r} in its metadata; export it with: trilitenet export")
    return ModelCard.from_json(metadata[CARD_KEY], source), ArtefactInfo.from_json(metadata[ARTEFACT_KEY], source)


def check_graph(
    inputs: Sequence[Sequence[int | None]], outputs: Collection[str], card: ModelCard, info: ArtefactInfo, source: str
) -> None:
    """Refuse a graph that is another than the metadata beside it describes.

    Args:
        inputs: The shape of each of its inputs; None for a side that is dynamic.
        outputs: The names of its outputs.
        card: Its tasks say which outputs there must be.
        info: The size it must take.
        source: The file, for messages.

    Raises:
        WeightsError: If it has not one input of that size, or lacks an output.
    """
    shape = inputs[0] if len(inputs) == 1 else ()
    sides = tuple(shape[1:3] if info.input == "uint8_nhwc" else shape[2:4])
    size = info.size or (None, None)
    missing = [task for task in card.tasks if task not in outputs]
    if len(shape) != 4 or any(side not in (None, wanted) for side, wanted in zip(sides, size, strict=True)):
        raise WeightsError(
            f"{source}: its metadata describe an input of {'any size' if info.size is None else info.size}, the graph "
            f"takes {', '.join(str(list(shape)) for shape in inputs) or 'none'}; the file is damaged or foreign"
        )
    if missing:
        raise WeightsError(f"{source}: its graph has no {', '.join(missing)}; the file is damaged or foreign")


def is_int8_onnx(path: str | os.PathLike[str]) -> bool:
    """Whether an ``.onnx`` artefact is quantised, without a runtime: its description stands as text after the graph.

    Args:
        path: The file; one that cannot be read is not quantised.
    """
    try:
        with Path(path).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _METADATA_BYTES))
            end = file.read()
    except OSError:
        return False
    start = end.rfind(ARTEFACT_KEY.encode())
    return start >= 0 and re.search(rb'"precision":\s*"int8"', end[start:]) is not None


def read_onnx(path: Path) -> bytes:
    """Return the content of an ``.onnx`` file, if it is what was exported; older files hold no hash of themselves.

    What was added after the hash, such as more metadata, does not count.

    Args:
        path: The file.

    Raises:
        WeightsError: If it is not there, damaged or changed.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file")
    content = path.read_bytes()
    key = content.rfind(GRAPH_HASH_KEY.encode())
    hashed = _HASH.match(content, max(0, key - 4))
    if hashed is not None and hashlib.sha256(content[: hashed.start()]).hexdigest() != hashed[1].decode():
        raise WeightsError(
            f"{path}: damaged, or changed by another program since it was exported; export it again, or take "
            f"{GRAPH_HASH_KEY!r} out of its metadata if the change is yours"
        )
    return content


def read_onnx_metadata(path: Path) -> dict[str, str]:
    """Return the key-value pairs of an ``.onnx`` file, without a runtime or ONNX's own package.

    Args:
        path: The file.

    Raises:
        WeightsError: If it is not there, damaged, changed or foreign.
    """
    entries = {}
    try:
        for number, value in _fields(read_onnx(path)):
            if number == _ONNX_METADATA:
                entry = dict(_fields(value))
                entries[entry[1].decode()] = entry[2].decode()
    except (LookupError, ValueError) as error:
        raise WeightsError(f"{path}: not a usable ONNX model (cut off or damaged; export it again)") from error
    return entries


def _fields(message: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield number and content of each field of a message of protobuf; of whole numbers nothing.

    Raises:
        IndexError: If it is cut off.
        ValueError: If it holds what ONNX's outermost message does not.
    """
    at = 0

    def whole_number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at, value, shift = at + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while at < len(message):
        number, kind = divmod(whole_number(), 8)
        if kind not in (0, 2):
            raise ValueError(f"field {number} is of kind {kind}")
        length = whole_number()
        if kind == 2:
            if at + length > len(message):
                raise IndexError(f"field {number} is cut off")
            yield number, message[at : at + length]
            at += length


def prepare_input(image: NDArray[np.uint8], info: ArtefactInfo) -> NDArray[Any]:
    """Turn (H, W, 3) uint8 RGB into the artefact's input for one image.

    Args:
        image: A letterboxed image, RGB whatever the artefact takes.
        info: How the artefact takes it.

    Returns:
        (1, H, W, 3) uint8 or (1, 3, H, W) float32 of 0 .. 255, RGB or BGR, as ``info`` says.

    Raises:
        ShapeError: If the artefact is for another size.
    """
    size = image.shape[:2]
    if info.size is not None and size != info.size:
        raise ShapeError(
            f"this artefact takes {info.size[1]}x{info.size[0]} pixels, got {size[1]}x{size[0]}; "
            f"for these: export --size {size[0]}x{size[1]}"
        )
    if info.colour == "bgr":
        image = image[:, :, ::-1]
    if info.input == "float_nchw":
        return np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)
    return np.ascontiguousarray(image[None])


def gather_outputs(results: Sequence[Mapping[str, NDArray[Any]]], card: ModelCard, info: ArtefactInfo) -> RawOutputs:
    """Turn what an artefact returned into what `to_perceptions` takes: masks of any kind become probability x 255.

    Args:
        results: For each image the name of each output -> array with a leading 1.
        card: The artefact's card; its tasks are the outputs.
        info: What the artefact's masks hold.

    Raises:
        ShapeError: If an output is missing.
        WeightsError: If the card is of another graph.
    """
    missing = [task for task in card.tasks if any(result.get(task) is None for result in results)]
    if missing:
        raise ShapeError(f"the results have no {', '.join(missing)}; ask the artefact for {', '.join(card.tasks)}")

    def mask(name: str) -> NDArray[np.uint8] | None:
        if name not in card.tasks:
            return None
        return np.concatenate([_probability(result[name], info) for result in results])

    detection = None
    if "detection" in card.tasks:
        rows = [np.asarray(result["detection"], np.float32) for result in results]
        if any(row.shape[-1] != 5 + card.classes for row in rows):
            raise WeightsError(
                f"the card names {card.classes} classes, but the graph gives rows of {rows[0].shape[-1]} numbers, "
                f"not {5 + card.classes}; the file is damaged"
            )
        rows = [row.reshape(-1, 5 + card.classes) for row in rows]
        detection = np.zeros((len(rows), max(len(row) for row in rows), 5 + card.classes), np.float32)
        for padded, row in zip(detection, rows, strict=True):  # after suppression, images have different counts
            padded[: len(row)] = row
    return RawOutputs(detection, mask("drivable"), mask("lane"))


class ArtefactBackend(abc.ABC):
    """An exported artefact on a runtime.

    Attributes:
        info: How the artefact takes pixels and returns results.
    """

    info: ArtefactInfo
    _card: ModelCard

    @property
    def card(self) -> ModelCard:
        """What the network is."""
        return self._card

    @property
    def canvas(self) -> tuple[int, int] | None:
        """The artefact's input size, None if it is dynamic."""
        return self.info.size

    @abc.abstractmethod
    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        """Return for each image the name of each output -> array with a leading 1."""

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        """Run the network on (B, H, W, 3) uint8 RGB; see `Backend.run`.

        Raises:
            ShapeError: If the batch is empty, or of another shape or type, or of a size the artefact cannot take.
            BackendError: If the runtime fails.
            WeightsError: If the card is of another graph.
        """
        check_batch(batch, MAX_STRIDE if self.info.size is None else 1)
        try:
            results = self._compute(batch)
        except TriLiteNetError:
            raise
        except Exception as error:  # what runtimes raise shares no base class
            raise BackendError(f"the runtime failed ({gist(error)})") from error
        return gather_outputs(results, self._card, self.info)


def _probability(mask: NDArray[Any], info: ArtefactInfo) -> NDArray[np.uint8]:
    """Return a mask as probability x 255; a decided one has 0 and 255."""
    if not info.decides_masks:
        return np.asarray(mask, np.uint8)
    decided = mask if info.masks == "decision" else (mask > 0).astype(np.uint8)
    return np.asarray(np.multiply(decided, np.uint8(255), dtype=np.uint8))
