"""The Open Inference Protocol, version 2, below ``/v2``: what clients of KServe and Triton speak.

The model has one input, ``image``: UINT8 (B, H, W, 3) RGB, or BYTES (B) with encoded images of one size. Its outputs
are in pixels of that image: ``boxes`` FP32 (B, N, 6) left, top, right, bottom, confidence, class, best first and filled
up with -1; ``drivable`` and ``lane`` UINT8 (B, H, W), 1 where the task sees something. Tensors travel as JSON or in the
protocol's binary form.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import chain
from typing import Any, Final, NamedTuple

import numpy as np
from fastapi import APIRouter, Request
from numpy.typing import NDArray
from starlette.responses import JSONResponse, Response

from trilitenet import __version__
from trilitenet.apps.server import openapi
from trilitenet.apps.server.intake import Header, check_header, read_header
from trilitenet.apps.server.problems import ProblemError
from trilitenet.apps.server.rest import read_request, until_vanished
from trilitenet.apps.server.service import Encoded, Service, in_time
from trilitenet.apps.server.settings import BYTES_PER_PIXEL, Settings
from trilitenet.config import ModelCard
from trilitenet.errors import did_you_mean
from trilitenet.structures import Perception

__all__ = ["protocol_router"]

_HEADER_LENGTH: Final = "inference-header-content-length"
_VERSION: Final = "1"

_MAX_VALUES: Final = 1_500_000
"""Values in the JSON of a request: 640 x 480 pixels fit, as one list or in lists of lists."""

_MAX_LISTS: Final = 400_000
"""Lists and objects among them: Python's lock is held while they are parsed, unless there are numbers between."""

_MAX_QUOTES: Final = 10_000
"""Quotation marks in the JSON of a request: objects of very many names would hold the lock for a second."""

_MAX_DIGITS: Final = 20
"""Characters of a whole number: the time that one takes grows with the square of its length."""

_NO_PIXELS: Final = "data must hold whole numbers from 0 to 255"

_SLICE: Final = 2**16
"""Numbers that are checked, or letters of base64 decoded, at once: between two slices other threads get their turn."""

_PARAMETERS: Final = ("confidence", "binary_data_output")
"""Parameters of a request that mean something here."""

_PASSED_OVER: Final = ("sequence_id", "sequence_start", "sequence_end", "priority", "timeout")
"""Those that the protocol's clients send by themselves."""

_MAX_MASK_PIXELS: Final = 4_000_000
"""Pixels of all images of a request whose masks are wanted as JSON."""


class _Query(NamedTuple):
    """A parsed inference request.

    Attributes:
        identifier: What the client calls the request.
        images: Encoded or as pixels.
        size: Height and width of each in pixels.
        outputs: For each output whether it is wanted in binary form.
        confidence: Replaces the model's threshold for boxes.
    """

    identifier: str | None
    images: list[Encoded | NDArray[np.uint8]]
    size: tuple[int, int]
    outputs: dict[str, bool]
    confidence: float | None


def protocol_router(service: Service) -> APIRouter:
    """Return the routes of ``/v2``."""
    router = APIRouter(tags=["open inference protocol"])
    names = _output_names(service.card)

    @router.get("/v2", **openapi.ANY)
    async def server_metadata() -> Response:
        return JSONResponse({"name": "trilitenet", "version": __version__, "extensions": ["binary_tensor_data"]})

    @router.get("/v2/health/live", **openapi.READY)
    async def live() -> Response:
        return JSONResponse({"live": service.alive}, status_code=200 if service.alive else 503)

    @router.get("/v2/health/ready", **openapi.READY)
    async def ready() -> Response:
        return JSONResponse({"ready": service.ready}, status_code=200 if service.ready else 503)

    @router.get("/v2/models/{model}", **openapi.MODEL)
    async def model_metadata(model: str) -> Response:
        return await version_metadata(model, _VERSION)

    @router.get("/v2/models/{model}/versions/{version}", **openapi.MODEL)
    async def version_metadata(model: str, version: str) -> Response:
        _check_model(service, model, version)
        return JSONResponse(_metadata(service.name, names))

    @router.get("/v2/models/{model}/ready", **openapi.MODEL_READY)
    async def model_ready(model: str) -> Response:
        return await version_ready(model, _VERSION)

    @router.get("/v2/models/{model}/versions/{version}/ready", **openapi.MODEL_READY)
    async def version_ready(model: str, version: str) -> Response:
        _check_model(service, model, version)
        return JSONResponse({"name": model, "ready": service.ready}, status_code=200 if service.ready else 503)

    @router.post("/v2/models/{model}/infer", **openapi.INFER)
    async def infer(request: Request, model: str) -> Response:
        return await version_infer(request, model, _VERSION)

    @router.post("/v2/models/{model}/versions/{version}/infer", **openapi.INFER)
    async def version_infer(request: Request, model: str, version: str) -> Response:
        _check_model(service, model, version)
        reservation = request.scope["state"]["reservation"]
        body = await read_request(request, service, reservation)
        split = _json_length(request.headers.get(_HEADER_LENGTH), len(body))
        reservation.take(len(body) - split)  # what follows the JSON is copied
        reservation.take(await service.in_pool(_json_memory, body, split))

        async def work(deadline: float) -> Response:
            query = await service.in_pool(_parse, body, split, names, service.settings)
            count = len(query.images)
            reservation.take(sum(map(_cost, query.images)))
            with service.admit(count - 1) if count > 1 else nullcontext():
                perceptions = await service.see_all(
                    query.images, deadline, lambda outcome: outcome.perception, query.confidence
                )
                return await service.in_pool(_answer, service.name, query, perceptions)

        with service.admit(1) as deadline:  # how many images there are is known only when the request is parsed
            return await until_vanished(request, in_time(work(deadline), deadline))

    return router


def _cost(image: Encoded | NDArray[np.uint8]) -> int:
    return image.header.cost if isinstance(image, Encoded) else image.shape[0] * image.shape[1] * BYTES_PER_PIXEL


def _check_model(service: Service, model: str, version: str) -> None:
    if model != service.name:
        raise ProblemError(404, "unknown_model", f"there is no model {model[:40]!r}; this service has {service.name!r}")
    if version != _VERSION:
        raise ProblemError(404, "unknown_version", f"there is no version {version[:40]!r}; this model has {_VERSION!r}")


def _output_names(card: ModelCard) -> tuple[str, ...]:
    return tuple({"detection": "boxes"}.get(task, task) for task in card.tasks)


def _metadata(name: str, names: Sequence[str]) -> dict[str, Any]:
    shapes: dict[str, tuple[str, list[int]]] = {"boxes": ("FP32", [-1, -1, 6])}
    outputs = []
    for output in names:
        datatype, shape = shapes.get(output, ("UINT8", [-1, -1, -1]))
        outputs.append({"name": output, "datatype": datatype, "shape": shape})
    return {
        "name": name,
        "versions": [_VERSION],
        "platform": "trilitenet",
        "inputs": [{"name": "image", "datatype": "UINT8", "shape": [-1, -1, -1, 3]}],
        "outputs": outputs,
    }


def _json_length(header: str | None, length: int) -> int:
    if header is None:
        return length
    if not (header.isascii() and header.isdecimal() and len(header) <= 20) or int(header) > length:
        raise _bad(f"{_HEADER_LENGTH} must be at most the length of the body, {length}")
    return int(header)


def _json_memory(body: bytes, split: int) -> int:
    """Return the most bytes that the first ``split`` bytes of a body can take once they are parsed as JSON.

    Raises:
        ProblemError: 413 if they hold too many values.
    """
    plain = nested = quotes = 0
    for start in range(0, split, 2**20):
        end = min(start + 2**20, split)
        plain += body.count(b",", start, end)
        nested += body.count(b"[", start, end) + body.count(b"{", start, end)
        quotes += body.count(b'"', start, end)
        if quotes > _MAX_QUOTES:
            raise ProblemError(413, "too_many_values", f"the JSON holds more than {_MAX_QUOTES // 2:,} texts and names")
        if plain + nested > _MAX_VALUES or nested > _MAX_LISTS:
            raise ProblemError(
                413,
                "too_many_values",
                f"the JSON holds more than {_MAX_VALUES:,} values, or {_MAX_LISTS:,} lists: send the tensor in binary "
                "form",
            )
    return 8 * split + 64 * plain + 256 * nested  # text of four bytes a letter, twice; a number each; a list each


def _parse(body: bytes, split: int, names: Sequence[str], settings: Settings) -> _Query:
    """Read an inference request.

    Raises:
        ProblemError: 400 if it is malformed, 413 if an image is too large.
    """
    try:
        # A function of Python for each number: C code would not let other threads run before the end.
        mapping = json.loads(body[:split], parse_int=_whole, parse_float=lambda text: float(text))
    except (ValueError, RecursionError) as error:
        raise _bad("the request is not JSON") from error
    if not isinstance(mapping, dict):
        raise _bad("the request is not a JSON object")
    identifier = mapping.get("id")
    if identifier is not None and not isinstance(identifier, str):
        raise _bad("id must be a string")
    inputs = mapping.get("inputs")
    if not isinstance(inputs, list) or len(inputs) != 1 or not isinstance(inputs[0], dict):
        raise _bad("inputs must hold one tensor, called image")
    tensor = inputs[0]
    if tensor.get("name") != "image":
        raise _bad(f"unknown input {str(tensor.get('name'))[:40]!r}: call it image")
    shape = tensor.get("shape")
    if not isinstance(shape, list) or not all(type(side) is int and 0 < side <= 2**31 for side in shape):
        raise _bad("shape must be a list of positive numbers")
    confidence = _confidence(mapping)
    outputs = _wanted(mapping, names)
    if shape and shape[0] > settings.max_images:
        raise ProblemError(413, "too_many_images", f"at most {settings.max_images} images are taken at once")
    if tensor.get("datatype") == "UINT8":
        images: list[Encoded | NDArray[np.uint8]]
        images, size = _pixels(tensor, shape, body[split:], settings)
    elif tensor.get("datatype") == "BYTES":
        images, size = _files(tensor, shape, body[split:], settings)
    else:
        raise _bad("the datatype of image must be UINT8 (pixels) or BYTES (encoded images)")
    as_json = any(not binary for output, binary in outputs.items() if output != "boxes")
    if as_json and len(images) * size[0] * size[1] > _MAX_MASK_PIXELS:
        raise ProblemError(
            413,
            "too_many_values",
            f"masks of more than {_MAX_MASK_PIXELS:,} pixels are not sent as JSON: ask for binary_data, or for boxes",
        )
    return _Query(identifier, images, size, outputs, confidence)


def _parameters(mapping: dict[str, Any], owner: str) -> dict[str, Any]:
    parameters = mapping.get("parameters")
    if parameters is None:
        return {}
    if not isinstance(parameters, dict):
        raise _bad(f"the parameters of {owner} must be an object")
    return parameters


def _confidence(mapping: dict[str, Any]) -> float | None:
    """Return the parameter ``confidence`` of a request.

    Raises:
        ProblemError: 400 if it is no number from 0 to 1, or there is a parameter that means nothing here.
    """
    parameters = _parameters(mapping, "a request")
    for name in parameters:
        if name not in (*_PARAMETERS, *_PASSED_OVER):
            name = name[:40]
            raise _bad(f"unknown parameter {name!r}{did_you_mean(name, _PARAMETERS)}")
    confidence = parameters.get("confidence")
    if confidence is None:
        return None
    if type(confidence) not in {int, float} or not 0 <= confidence <= 1:
        raise _bad(f"confidence must be a number from 0 to 1, got {confidence!r:.40}")
    return float(confidence)


def _wanted(mapping: dict[str, Any], names: Sequence[str]) -> dict[str, bool]:
    """Return the outputs to answer with, and whether each is wanted in binary form."""
    binary = _flag(mapping, "binary_data_output")
    outputs = mapping.get("outputs")
    if outputs is None or outputs == []:
        return dict.fromkeys(names, binary)
    if not isinstance(outputs, list) or not all(isinstance(output, dict) for output in outputs):
        raise _bad("outputs must be a list of objects")
    wanted: dict[str, bool] = {}
    for output in outputs:
        name = output.get("name")
        if name not in names:
            raise _bad(f"unknown output {str(name)[:40]!r}; there are {', '.join(names)}")
        parameters = _parameters(output, "an output")
        if "classification" in parameters:
            raise _bad("the classification extension is not supported")
        wanted[name] = _flag(output, "binary_data", binary)
    return wanted


def _flag(mapping: dict[str, Any], name: str, default: bool = False) -> bool:
    parameters = mapping.get("parameters")
    return bool(parameters.get(name, default)) if isinstance(parameters, dict) else default


def _binary(tensor: dict[str, Any], rest: bytes) -> bytes | None:
    """Return the tensor's bytes if it came in binary form."""
    parameters = tensor.get("parameters")
    size = parameters.get("binary_data_size") if isinstance(parameters, dict) else None
    if size is None:
        return None
    if size != len(rest):
        raise _bad(f"binary_data_size is {size!r:.40}, {len(rest)} bytes came")
    return rest


def _pixels(
    tensor: dict[str, Any], shape: list[int], rest: bytes, settings: Settings
) -> tuple[list[Encoded | NDArray[np.uint8]], tuple[int, int]]:
    if len(shape) != 4 or shape[3] != 3:
        raise _bad(f"the shape of image must be [B, H, W, 3], got {shape[:8]}")
    count, height, width, _ = shape
    check_header(Header("PNG", width, height, 1), settings)
    data = _binary(tensor, rest)
    try:
        if data is None:
            data = _numbers(tensor.get("data"))
        array = np.frombuffer(data, np.uint8).reshape(count, height, width, 3)
    except ValueError as error:
        raise _bad(f"the data does not fill the shape {shape}") from error
    return list(array), (height, width)


def _whole(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise _bad(f"a number of more than {_MAX_DIGITS} digits")
    return int(text)


def _numbers(values: Any) -> bytes:
    """Return the numbers of a list, or of lists of equally long lists, a byte each.

    Raises:
        ProblemError: 400 if there is anything but whole numbers from 0 to 255.
        ValueError: If the lists are not equally long.
    """
    if not isinstance(values, list):
        raise _bad(_NO_PIXELS)
    while values and isinstance(values[0], list):
        length = len(values[0])
        if not all(isinstance(row, list) and len(row) == length for row in values):
            raise ValueError
        values = list(chain.from_iterable(values))
    numbers = bytearray()
    for start in range(0, len(values), _SLICE):
        part = values[start : start + _SLICE]
        kinds = set(map(type, part))
        if list in kinds:
            raise ValueError
        if kinds - {int}:
            raise _bad(_NO_PIXELS)
        try:
            numbers += bytes(part)
        except ValueError:
            raise _bad(_NO_PIXELS) from None
    return bytes(numbers)


def _files(
    tensor: dict[str, Any], shape: list[int], rest: bytes, settings: Settings
) -> tuple[list[Encoded | NDArray[np.uint8]], tuple[int, int]]:
    data = _binary(tensor, rest)
    files = _base64(tensor.get("data")) if data is None else _length_prefixed(data, settings.max_images)
    if shape not in ([len(files)], [len(files), 1]) or not files:
        raise _bad(f"the shape is {shape[:8]}, {len(files)} encoded images came")
    images: list[Encoded | NDArray[np.uint8]] = []
    for file in files:
        header = read_header(file)
        check_header(header, settings)
        images.append(Encoded(file, header))
    # The stored size: EXIF may turn an image, but the reservation and the comparison do not mind.
    sizes = {(image.header.height, image.header.width) for image in images if isinstance(image, Encoded)}
    if len(sizes) > 1:
        raise _bad("encoded images of one request must have one size; send them apart")
    return images, sizes.pop()


def _base64(data: Any) -> list[bytes]:
    if not isinstance(data, list) or not all(isinstance(item, str) for item in data):
        raise _bad("data must be a list of encoded images in base64")
    try:
        return [
            b"".join(base64.b64decode(item[i : i + _SLICE], validate=True) for i in range(0, len(item), _SLICE))
            for item in data
        ]
    except (binascii.Error, ValueError) as error:
        raise _bad("data is not base64") from error


def _length_prefixed(data: bytes, most: int) -> list[bytes]:
    """Split encoded images that each follow their length, a number of four bytes."""
    files: list[bytes] = []
    position = 0
    while position < len(data):
        if len(files) == most:
            raise _bad(f"the binary data holds more than {most} encoded images")
        if position + 4 > len(data):
            raise _bad("the binary data ends early")
        (length,) = struct.unpack_from("<I", data, position)
        position += 4
        if position + length > len(data):
            raise _bad("the binary data ends early")
        files.append(data[position : position + length])
        position += length
    return files


def _answer(name: str, query: _Query, perceptions: list[Perception]) -> Response:
    """Write the response, with the binary tensors after the JSON."""
    if len({perception.size for perception in perceptions}) > 1:
        raise _bad("the images differ in size after their EXIF rotation; send them apart")
    outputs: list[str] = []
    tail: list[bytes] = []
    for output, binary in query.outputs.items():
        array = _boxes(perceptions) if output == "boxes" else np.stack([_mask(p, output) for p in perceptions])
        data = ""
        entry: dict[str, Any] = {
            "name": output,
            "datatype": "FP32" if output == "boxes" else "UINT8",
            "shape": list(array.shape),
        }
        if binary:
            tail.append(array.tobytes())
            entry["parameters"] = {"binary_data_size": len(tail[-1])}
        elif output == "boxes":
            entry["data"] = array.ravel().tolist()
        else:
            data = _digits(array)
        outputs.append(f'{_compact(entry)[:-1]},"data":[{data}]}}' if data else _compact(entry))
    mapping: dict[str, Any] = {"model_name": name, "model_version": _VERSION}
    if query.identifier is not None:
        mapping["id"] = query.identifier
    head = f'{_compact(mapping)[:-1]},"outputs":[{",".join(outputs)}]}}'.encode()
    if not tail:
        return Response(head, media_type="application/json")
    return Response(
        b"".join([head, *tail]), media_type="application/octet-stream", headers={_HEADER_LENGTH: str(len(head))}
    )


def _compact(mapping: dict[str, Any]) -> str:
    return json.dumps(mapping, separators=(",", ":"))


def _digits(mask: NDArray[Any]) -> str:
    """Write zeros and ones with commas between: a mask as numbers of Python would stop everything else meanwhile."""
    text = np.full(2 * mask.size - 1, ord(","), np.uint8)
    text[::2] = mask.ravel() + np.uint8(ord("0"))
    return text.tobytes().decode("ascii")


def _boxes(perceptions: Sequence[Perception]) -> NDArray[np.float32]:
    rows = []
    for perception in perceptions:
        assert perception.boxes is not None
        boxes = perception.boxes
        rows.append(np.column_stack([boxes.xyxy, boxes.confidence, boxes.class_id.astype(np.float32)]))
    array = np.full((len(rows), max(len(row) for row in rows), 6), -1, np.float32)
    for index, row in enumerate(rows):
        array[index, : len(row)] = row
    return array


def _mask(perception: Perception, name: str) -> NDArray[np.uint8]:
    mask = getattr(perception, name)
    return np.asarray(mask).view(np.uint8)


def _bad(message: str) -> ProblemError:
    return ProblemError(400, "bad_request", message)
