"""Put the parts together: a predictor and settings in, an ASGI application out."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from trilitenet import __version__
from trilitenet.apps.server import openapi
from trilitenet.apps.server.guard import PUBLIC_PATHS, Guard
from trilitenet.apps.server.inference_protocol import protocol_router
from trilitenet.apps.server.pages import pages_router
from trilitenet.apps.server.problems import ProblemError, problem_response
from trilitenet.apps.server.rest import rest_router
from trilitenet.apps.server.service import Service
from trilitenet.apps.server.settings import Settings
from trilitenet.inference.predictor import Predictor

__all__ = ["Application", "create_app"]

_DESCRIPTION = """Driving perception of one small network: vehicles, drivable area and lane markings.

Images are JPEG, PNG or WebP. Coordinates are pixels of the image as it is shown (EXIF rotation applied).
Errors have one form, `{"error": {"code", "message", "request_id"}}`, but below `/v2` that of the protocol,
`{"error": message}`; 503 comes with `Retry-After`.
"""


class Application:
    """The ASGI application: the routes inside the guard.

    Attributes:
        service: The predictor behind its queue.
        api: The FastAPI application, for its OpenAPI schema.
    """

    def __init__(self, service: Service) -> None:
        self.service = service
        self.api = _routes(service)
        self._guard = Guard(self.api, service)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request, or the lifespan of the process."""
        await self._guard(scope, receive, send)


def create_app(predictor: Predictor, name: str, settings: Settings | None = None) -> Application:
    """Build the service around a predictor.

    Args:
        predictor: As `trilitenet.load` returns it.
        name: What clients call the model.
        settings: Limits; the defaults if left out.
    """
    return Application(Service(predictor, name, settings or Settings()))


class _Api(FastAPI):
    """FastAPI whose schema says that the guard asks for a token."""

    token = False

    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            openapi.add_token(super().openapi(), PUBLIC_PATHS, required=self.token)
        return super().openapi()


def _routes(service: Service) -> FastAPI:
    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await service.start()
        yield
        await service.stop()

    # The interactive documentation of FastAPI loads scripts from elsewhere, so there is only the schema.
    api = _Api(
        title="TriLiteNet",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,  # it would lead from https to http behind a proxy
        lifespan=lifespan,
    )
    api.token = service.settings.token is not None
    for router in (rest_router(service), protocol_router(service), pages_router()):
        api.include_router(router)
        routes = (route for route in router.routes if isinstance(route, Route))
        service.metrics.expect(route.path for route in routes if "POST" in (route.methods or ()))
    api.add_exception_handler(ProblemError, _on_problem)
    api.add_exception_handler(RequestValidationError, _on_invalid)
    api.add_exception_handler(HTTPException, _on_http)
    api.add_exception_handler(Exception, _on_error)
    return api


async def _on_problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, ProblemError)
    return problem_response(request, error)


async def _on_invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    name = str(first["loc"][-1])
    return problem_response(request, ProblemError(422, "bad_parameter", f"{name}: {first['msg']}"))


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = dict(error.headers or {})
    code, message = {
        404: ("not_found", "there is nothing at this address; /openapi.json lists what there is"),
        405: ("method_not_allowed", f"this address takes {headers.get('Allow')}, not {request.method}"),
    }.get(error.status_code, ("http", str(error.detail)))
    return problem_response(request, ProblemError(error.status_code, code, message, headers))


async def _on_error(request: Request, error: Exception) -> Response:
    return problem_response(
        request, ProblemError(500, "internal", "the service failed on this request; its log says why")
    )
