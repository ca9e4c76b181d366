"""The service's own interface below ``/v1``, the probes and the metrics."""

from __future__ import annotations

import asyncio
import dataclasses
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from numpy.typing import NDArray
from PIL import Image
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response

from trilitenet import __version__
from trilitenet.apps.server import openapi
from trilitenet.apps.server.intake import Reservation, check_header, read_body, read_header
from trilitenet.apps.server.multipart import split_form
from trilitenet.apps.server.problems import BusyError, ProblemError
from trilitenet.apps.server.service import Encoded, Outcome, Service, together
from trilitenet.apps.server.settings import DRAWING_BYTES_PER_PIXEL
from trilitenet.errors import did_you_mean
from trilitenet.processing.drawing import DRIVABLE_COLOUR, LANE_COLOUR
from trilitenet.structures import Perception

__all__ = ["mask_image", "read_request", "rest_router", "until_vanished"]

_T = TypeVar("_T")
Format = Literal["json", "overlay", "masks"]
Confidence = Annotated[
    float | None, Query(ge=0.0, le=1.0, description="Keep boxes above this; the model's own threshold if left out.")
]

_NOT_ACCEPTABLE: Final = re.compile(r"q=0(\.0{0,3})?")
"""Weight of what a client does not want."""

_TOLD_LIMITS: Final = ("max_images", "max_pixels", "max_side", "max_body", "upload_timeout")
"""Settings that a client can heed before it sends anything."""

_PALETTE: Final = (0, 0, 0, *DRIVABLE_COLOUR, *LANE_COLOUR, 213, 94, 0)
"""Colours of the values 0 to 3 of a mask image, so that it can be looked at."""


def rest_router(service: Service) -> APIRouter:
    """Return the routes of ``/v1``, ``/healthz``, ``/readyz`` and ``/metrics``."""
    router = APIRouter()

    @router.post("/v1/predict", tags=["prediction"], dependencies=[_only("format", "confidence")], **openapi.PREDICT)
    async def predict(
        request: Request,
        output: Annotated[Format, Query(alias="format", description="What to answer with.")] = "json",
        confidence: Confidence = None,
    ) -> Response:
        """See one image: vehicles, drivable area and lane markings."""
        reservation = request.scope["state"]["reservation"]
        (data,) = await _encoded(request, service, reservation, most=1)
        image = _checked(data, service, reservation)
        if output == "overlay":
            reservation.take(image.header.width * image.header.height * DRAWING_BYTES_PER_PIXEL)
        finish = _finisher(output, request, service)
        with service.admit(1) as deadline:
            work = service.see(image, deadline, finish, confidence, keep_image=output == "overlay")
            return await until_vanished(request, work)

    @router.post("/v1/predict/batch", tags=["prediction"], dependencies=[_only("confidence")], **openapi.PREDICT_BATCH)
    async def predict_batch(request: Request, confidence: Confidence = None) -> Response:
        """See several images. One that is broken does not spoil the others: each has a status of its own."""
        images = await _all_images(request, service, request.scope["state"]["reservation"])
        with service.admit(len(images)) as deadline:

            async def settle(image: Encoded | dict[str, Any]) -> dict[str, Any]:
                if not isinstance(image, Encoded):
                    return image
                try:
                    return await service.see(image, deadline, _to_mapping, confidence)
                except ProblemError as problem:
                    if problem.status != 503:
                        service.admission.skip()
                    return _refusal(problem)

            results = await until_vanished(request, together(map(settle, images)))
        if all(result["status"] == 503 for result in results):
            raise BusyError(**{name: results[0]["error"][name] for name in ("code", "message")})
        for result in results:
            if result["status"] != 200:
                service.metrics.reject(result["error"]["code"])
        body = {**_about(request, service), "results": results}
        return Response(await service.in_pool(_to_json, body), media_type="application/json")

    @router.get("/v1/models", tags=["model"], **openapi.MODELS)
    async def models() -> Response:
        """Say which model is served, what it was trained on and how it may be used."""
        card = dataclasses.asdict(service.card)
        model = {
            "name": service.name,
            "backend": service.predictor.backend.name,
            "ready": service.ready,
            "confidence": service.predictor.thresholds.confidence,
            "least_confidence": service.predictor.least_confidence,
            **{name: getattr(service.settings, name) for name in _TOLD_LIMITS},
            "card": card,
        }
        return JSONResponse({"version": __version__, "models": [model]})

    @router.get("/healthz", tags=["operation"], **openapi.PROBE)
    async def healthz() -> Response:
        """Say whether the process does its work: 503 means that it should be restarted."""
        return _probe(service.alive)

    @router.get("/readyz", tags=["operation"], **openapi.PROBE)
    async def readyz() -> Response:
        """Say whether new requests are welcome: 503 while shutting down, and when the process should be restarted."""
        return _probe(service.ready)

    @router.get("/metrics", tags=["operation"], **openapi.METRICS)
    async def metrics() -> Response:
        """Return all counters in Prometheus' text format."""
        return Response(service.metrics.text(), media_type="text/plain; version=0.0.4")

    return router


def _only(*known: str) -> Any:
    """Return a dependency that refuses other parameters, and one given twice.

    A misspelt one, or all but the last, would be passed over without a word.
    """

    async def check(request: Request) -> None:
        for name, count in Counter(name for name, _ in request.query_params.multi_items()).items():
            if name not in known:
                name = name[:40]
                raise ProblemError(422, "bad_parameter", f"unknown parameter {name!r}{did_you_mean(name, known)}")
            if count > 1:
                raise ProblemError(422, "bad_parameter", f"{name} is given {count} times: give it once")

    return Depends(check)


async def read_request(request: Request, service: Service, reservation: Reservation) -> bytes:
    """Read a request's body within its limits.

    Raises:
        ProblemError: 499 if the client goes away meanwhile, or what `read_body` raises.
    """
    try:
        return await read_body(request.stream(), reservation, service.settings)
    except ClientDisconnect:
        raise ProblemError(499, "vanished", "the client went away") from None


async def until_vanished(request: Request, work: Coroutine[Any, Any, _T]) -> _T:
    """Await work, and cancel it as soon as the client goes away.

    Raises:
        ProblemError: 499 if it does.
    """
    task = asyncio.ensure_future(work)
    watcher = asyncio.ensure_future(_disconnected(request))
    try:
        await asyncio.wait({task, watcher}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ProblemError(499, "vanished", "the client went away")
        return task.result()
    finally:
        task.cancel()
        watcher.cancel()


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _all_images(request: Request, service: Service, reservation: Reservation) -> list[Encoded | dict[str, Any]]:
    """Return each image, or the result that says what is wrong with it."""
    checked: list[Encoded | dict[str, Any]] = []
    for data in await _encoded(request, service, reservation, most=service.settings.max_images):
        try:
            checked.append(_checked(data, service, reservation))
        except ProblemError as problem:
            if problem.status == 503:
                raise
            checked.append(_refusal(problem))
        await asyncio.sleep(0)  # the headers of many images take a while: others get their turn between
    return checked


def _checked(data: bytes, service: Service, reservation: Reservation) -> Encoded:
    header = read_header(data)
    check_header(header, service.settings)
    reservation.take(header.cost)
    return Encoded(data, header)


async def _encoded(request: Request, service: Service, reservation: Reservation, most: int) -> list[bytes]:
    """Return the images of a request: the fields of a form that are called image or images, or the body itself."""
    body = await read_request(request, service, reservation)
    content_type = request.headers.get("content-type", "")
    if not content_type.lower().startswith("multipart/"):
        return [body]
    reservation.take(len(body))  # the parts are copies
    parts = await service.in_pool(split_form, body, content_type, service.settings.max_images)
    for part in parts:
        if part.name not in {"image", "images"}:
            raise ProblemError(
                400,
                "unknown_field",
                f"unknown form field {part.name[:40]!r}: that of the image is image; parameters go into the address",
            )
    if not parts:
        raise ProblemError(400, "empty", "the form holds no image")
    if len(parts) > most:
        raise ProblemError(413, "too_many_parts", "the form has more than one image: send it to /v1/predict/batch")
    return [part.data for part in parts]


def _finisher(output: Format, request: Request, service: Service) -> Callable[[Outcome], Response]:
    """Choose what makes the answer; it runs in a thread."""
    about = _about(request, service)
    kind = "PNG" if _accepts_png(request.headers.get("accept", "")) else "JPEG"

    def finish(outcome: Outcome) -> Response:
        if output == "json":
            content, media_type = _to_json({**about, **_to_mapping(outcome)}), "application/json"
        elif output == "masks":
            content, media_type = mask_image(outcome.perception), "image/png"
        else:
            content, media_type = _encode(outcome.perception.draw(outcome.image), kind), f"image/{kind.lower()}"
        stages = ", ".join(f"{stage};dur={value}" for stage, value in outcome.milliseconds.items())
        return Response(content, media_type=media_type, headers={"server-timing": stages})

    return finish


def _accepts_png(accept: str) -> bool:
    """Return whether an Accept header names PNG, with a weight that is not 0 (RFC 9110, Section 12.5.1)."""
    for entry in accept.lower().split(","):
        kind, *parameters = (part.strip() for part in entry.split(";"))
        if kind == "image/png":
            return not any(_NOT_ACCEPTABLE.fullmatch(parameter) for parameter in parameters)
    return False


def _about(request: Request, service: Service) -> dict[str, Any]:
    return {"request_id": request.scope["state"]["request_id"], "model": service.name}


def _to_mapping(outcome: Outcome) -> dict[str, Any]:
    return {
        "status": 200,
        "milliseconds": outcome.milliseconds,
        "batch": outcome.batch,
        "perception": outcome.perception.to_dict(),
    }


def _to_json(mapping: dict[str, Any]) -> bytes:
    return json.dumps(mapping, ensure_ascii=False, separators=(",", ":")).encode()


def mask_image(perception: Perception) -> bytes:
    """Return both masks as one PNG with a palette: 0 neither, 1 drivable, 2 lane marking, 3 both."""
    values = np.zeros(perception.size, np.uint8)
    for value, mask in ((1, perception.drivable), (2, perception.lane)):
        if mask is not None:
            values += mask.astype(np.uint8) * np.uint8(value)
    image = Image.fromarray(values)
    image.putpalette(_PALETTE)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _encode(pixels: NDArray[np.uint8], kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, quality=90, compress_level=1)
    return buffer.getvalue()


def _refusal(problem: ProblemError) -> dict[str, Any]:
    return {"status": problem.status, "error": {"code": problem.code, "message": problem.message}}


def _probe(good: bool) -> Response:
    return JSONResponse({"status": "ok" if good else "unavailable"}, status_code=200 if good else 503)
