"""What the OpenAPI schema says of requests and answers, with examples. It describes; it does not run."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import PlainTextResponse

__all__ = [
    "ANY",
    "INFER",
    "METRICS",
    "MODEL",
    "MODELS",
    "MODEL_READY",
    "PREDICT",
    "PREDICT_BATCH",
    "PROBE",
    "READY",
    "BatchPrediction",
    "ErrorAnswer",
    "Prediction",
    "ProtocolErrorAnswer",
    "add_token",
]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Size(_Strict):
    """Size of the image as it is shown, in pixels."""

    height: int
    width: int


class Mask(_Strict):
    """A mask as COCO compressed run-length encoding: column by column, first the run outside."""

    size: tuple[int, int] = Field(description="height, width")
    counts: str


class Box(_Strict):
    """One detected object."""

    xyxy: tuple[float, float, float, float] = Field(description="left, top, right, bottom in pixels of the image")
    confidence: float = Field(ge=0, le=1)
    class_id: int
    class_name: str


class PerceptionForm(_Strict):
    """What the network sees in one image. A task that the model lacks is null."""

    schema_version: str = Field(alias="schema")
    source: str | None = None
    frame: int | None = None
    timestamp: float | None = None
    size: Size
    class_names: list[str]
    boxes: list[Box] | None = Field(description="Best first.")
    drivable: Mask | None
    lane: Mask | None


class _Seen(_Strict):
    status: Literal[200]
    milliseconds: dict[str, float] = Field(description="Time in each stage; in the network, that of the whole batch.")
    batch: int = Field(ge=1, description="Images that went through the network at once, of this request and of others.")
    perception: PerceptionForm


class Prediction(_Seen):
    """The answer for one image."""

    request_id: str
    model: str


class ErrorBody(_Strict):
    """Why a request was refused."""

    code: str = Field(description="A short word that programs can rely on.")
    message: str = Field(description="One line for people.")
    request_id: str


class ErrorAnswer(_Strict):
    """A refusal."""

    error: ErrorBody


class ProtocolErrorAnswer(_Strict):
    """A refusal in the form of the Open Inference Protocol."""

    error: str


class ErrorItem(_Strict):
    """Why one image was refused."""

    code: str
    message: str


class _Refused(_Strict):
    status: int
    error: ErrorItem


class BatchPrediction(_Strict):
    """The answer for several images, in their order; each has a status of its own."""

    request_id: str
    model: str
    results: list[_Seen | _Refused]


_PERCEPTION: Final = {
    "schema": "1.0",
    "source": None,
    "frame": None,
    "timestamp": None,
    "size": {"height": 4, "width": 6},
    "class_names": ["vehicle"],
    "boxes": [{"xyxy": [1.25, 0.5, 4.0, 3.75], "confidence": 0.9132, "class_id": 0, "class_name": "vehicle"}],
    "drivable": {"size": [4, 6], "counts": "b013"},
    "lane": {"size": [4, 6], "counts": "h0"},
}
_SEEN: Final = {
    "status": 200,
    "milliseconds": {"decode": 6.1, "preprocess": 0.7, "queue": 0.1, "network": 10.4, "postprocess": 1.2},
    "batch": 1,
    "perception": _PERCEPTION,
}
_ABOUT: Final = {"request_id": "6f1c2f4b7d5e4a6b9f0e6d1c2b3a4958", "model": "small"}


def _error(code: str, message: str) -> dict[str, Any]:
    body = {"code": code, "message": message, "request_id": _ABOUT["request_id"]}
    return {"model": ErrorAnswer, "content": {"application/json": {"example": {"error": body}}}}


_TOLD: Final = {
    400: ("empty", "the image is empty"),
    401: ("unauthorized", "this service needs a bearer token"),
    403: ("cross_site", "another web site may not use this service through its visitors"),
    408: ("upload_timeout", "the body did not arrive within 20 s"),
    413: ("too_many_pixels", "the image has 60000 x 60000 pixels; send a smaller one"),
    415: ("unsupported_type", "the bytes are not a JPEG, PNG or WebP image"),
    422: ("broken_image", "the JPEG image is broken or truncated"),
    500: ("internal", "the service failed on this request; its log says why"),
    503: ("queue_full", "all 64 places are taken; try again in 1 s"),
}
"""Status -> code and message of a refusal."""

_RETRY: Final = {"Retry-After": {"description": "Seconds to wait.", "schema": {"type": "integer"}}}

_REFUSALS: Final[dict[int | str, dict[str, Any]]] = {status: _error(*told) for status, told in _TOLD.items()}
_REFUSALS[503]["headers"] = _RETRY
_FILE: Final = {"type": "string", "format": "binary"}


def _body(schema: dict[str, Any]) -> dict[str, Any]:
    return {
        "multipart/form-data": {"schema": {"type": "object", "properties": schema}},
        **{kind: {"schema": _FILE} for kind in ("image/jpeg", "image/png", "image/webp")},
    }


PREDICT: Final[dict[str, Any]] = {
    "responses": {
        200: {
            "model": Prediction,
            "description": "What the network sees, the image with it drawn, or the masks "
            "(a palette PNG: 0 neither, 1 drivable, 2 lane marking, 3 both).",
            "content": {
                "application/json": {"example": {**_ABOUT, **_SEEN}},
                "image/jpeg": {"schema": _FILE},
                "image/png": {"schema": _FILE},
            },
        },
        **_REFUSALS,
    },
    "openapi_extra": {
        "requestBody": {
            "required": True,
            "description": "The image itself, or a form with the field image.",
            "content": _body({"image": _FILE}),
        }
    },
}

PREDICT_BATCH: Final[dict[str, Any]] = {
    "responses": {
        200: {
            "model": BatchPrediction,
            "content": {
                "application/json": {
                    "example": {
                        **_ABOUT,
                        "results": [
                            _SEEN,
                            {"status": 422, "error": {"code": "broken_image", "message": "the PNG image is broken"}},
                        ],
                    }
                }
            },
        },
        **_REFUSALS,
    },
    "openapi_extra": {
        "requestBody": {
            "required": True,
            "description": "A form with the field images, several times, or one image itself.",
            "content": _body({"images": {"type": "array", "items": _FILE}}),
        }
    },
}

MODELS: Final[dict[str, Any]] = {
    "responses": {
        200: {
            "description": "The model card: variant, classes, thresholds, training data, figures, licence; the "
            "confidence above which boxes are kept, the least that may be asked for; the most images of a batch "
            "request, pixels of an image and of a side, bytes of a request, and seconds until they must be there.",
            "content": {
                "application/json": {
                    "example": {
                        "version": "0.1.0",
                        "models": [
                            {
                                "name": "small",
                                "backend": "openvino cpu",
                                "ready": True,
                                "confidence": 0.25,
                                "least_confidence": 0.0,
                                "max_images": 16,
                                "max_pixels": 33177600,
                                "max_side": 16384,
                                "max_body": 20971520,
                                "upload_timeout": 20.0,
                                "card": {"variant": "small", "class_names": ["vehicle"]},
                            }
                        ],
                    }
                }
            },
        }
    }
}

PROBE: Final[dict[str, Any]] = {
    "responses": {
        200: {"content": {"application/json": {"example": {"status": "ok"}}}},
        503: {"description": "Not now.", "content": {"application/json": {"example": {"status": "unavailable"}}}},
    }
}

METRICS: Final[dict[str, Any]] = {
    "response_class": PlainTextResponse,
    "responses": {200: {"content": {"text/plain": {"example": "trilitenet_ready 1.0\n"}}}},
}


def _protocol_error(message: str) -> dict[str, Any]:
    return {"model": ProtocolErrorAnswer, "content": {"application/json": {"example": {"error": message}}}}


_OBJECT: Final = {"application/json": {"schema": {"type": "object"}}}

_UNKNOWN: Final = _protocol_error("there is no model 'other'; this service has 'tiny'")

ANY: Final[dict[str, Any]] = {"responses": {200: {"content": _OBJECT}}}

MODEL: Final[dict[str, Any]] = {
    "responses": {**ANY["responses"], 404: _UNKNOWN, "default": {**_UNKNOWN, "description": "Any other refusal."}}
}

READY: Final[dict[str, Any]] = {"responses": {**ANY["responses"], 503: {"description": "Not now.", "content": _OBJECT}}}

MODEL_READY: Final[dict[str, Any]] = {"responses": {**MODEL["responses"], **READY["responses"]}}

INFER: Final[dict[str, Any]] = {
    "responses": {
        200: {
            "description": "The outputs, as JSON, or with binary tensors after it as the request's "
            "binary_data parameters ask.",
            "headers": {
                "Inference-Header-Content-Length": {
                    "description": "Bytes of the JSON before the binary tensors, if there are any.",
                    "schema": {"type": "integer"},
                }
            },
            "content": {**_OBJECT, "application/octet-stream": {"schema": _FILE}},
        },
        **{status: _protocol_error(message) for status, (_, message) in _TOLD.items()},
        400: _protocol_error("shape must be a list of positive numbers"),
        404: _UNKNOWN,
        413: _protocol_error("at most 16 images are taken at once"),
        503: {**_protocol_error(_TOLD[503][1]), "headers": _RETRY},
    },
    "openapi_extra": {
        "requestBody": {
            "required": True,
            "description": "The parameter confidence, from 0 to 1, keeps boxes above it; the model's own threshold if "
            "left out.",
            "content": {
                "application/json": {
                    "schema": {"type": "object"},
                    "example": {
                        "parameters": {"confidence": 0.3},
                        "inputs": [
                            {"name": "image", "datatype": "UINT8", "shape": [1, 1, 2, 3], "data": [0, 0, 0, 9, 9, 9]}
                        ],
                    },
                },
                "application/octet-stream": {"schema": _FILE},
            },
        }
    },
}


def add_token(schema: dict[str, Any], public: Container[str], *, required: bool) -> None:
    """Say which requests take the bearer token, and that they get 401 without it.

    Args:
        schema: The OpenAPI document; changed in place.
        public: Paths that need none.
        required: Whether the service has a token; else any or none will do.
    """
    schema["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
    for path, operations in schema["paths"].items():
        if path in public:
            continue
        v2 = path.startswith("/v2")
        form = ProtocolErrorAnswer if v2 else ErrorAnswer
        example = (_protocol_error(_TOLD[401][1]) if v2 else _error(*_TOLD[401]))["content"]["application/json"]
        content = {"schema": {"$ref": f"#/components/schemas/{form.__name__}"}, **example}
        refusal = {"description": "Unauthorized", "content": {"application/json": content}}
        for operation in operations.values():
            operation["security"] = [{"bearer": []}] if required else [{}, {"bearer": []}]
            operation["responses"].setdefault("401", refusal)
