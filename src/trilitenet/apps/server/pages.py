"""The page for people: static files of the package, held in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Awaitable, Callable
from importlib import resources
from typing import Final

from fastapi import APIRouter, Request
from starlette.responses import Response

__all__ = ["PAGE_PATHS", "pages_router"]

_SCRIPTS: Final = ("app.js", "client.js", "draw.js", "sources.js")
_FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/app.css": ("app.css", "text/css; charset=utf-8"),
    **{f"/{name}": (name, "text/javascript; charset=utf-8") for name in _SCRIPTS},
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
PAGE_PATHS: Final = frozenset(_FILES)
"""Paths of the page's files."""

_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; media-src blob:; "
    "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def pages_router() -> APIRouter:
    """Return the routes of the page's files."""
    router = APIRouter(include_in_schema=False)
    for path, (name, media_type) in _FILES.items():
        router.add_api_route(path, _serve(name, media_type), methods=["GET"])
    return router


def _serve(name: str, media_type: str) -> Callable[[Request], Awaitable[Response]]:
    content = resources.files(__package__).joinpath("page").joinpath(name).read_bytes()
    etag = f'"{hashlib.sha256(content).hexdigest()[:16]}"'
    headers = {
        "content-type": media_type,
        "etag": etag,
        "cache-control": "no-cache",
        "content-security-policy": _POLICY,
    }

    async def page(request: Request) -> Response:
        if etag in request.headers.get("if-none-match", ""):  # one of a list, or marked W/ by a proxy
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers)

    return page
