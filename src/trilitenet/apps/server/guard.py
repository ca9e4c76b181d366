"""The outermost layer: what is checked, limited, counted and logged for every request, before any route sees it."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
import re
import time
import uuid
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from trilitenet.apps.server.intake import Reservation, too_large
from trilitenet.apps.server.pages import PAGE_PATHS
from trilitenet.apps.server.problems import ProblemError, problem_response
from trilitenet.apps.server.service import Service

__all__ = ["PUBLIC_PATHS", "Guard"]

_LOGGER: Final = logging.getLogger("trilitenet.server")

PUBLIC_PATHS: Final = PAGE_PATHS | {"/healthz", "/readyz"}
"""What needs no token: the page's own files, which hold nothing secret, and the probes."""

_HEADERS: Final = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(self), microphone=(), geolocation=()",
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
}
_REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")
_LINGER: Final = 1.0
"""Seconds that the rest of a refused body is read and dropped, so that the client can read its answer."""

_SMALL: Final = 2**16
"""Bytes of an answer that are sent at once, whether somebody reads them or not."""


class Guard:
    """ASGI middleware around the whole application.

    Args:
        app: The application.
        service: Its settings and counters.
    """

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self._app = app
        self._service = service
        token = service.settings.token
        self._token = None if token is None else hashlib.sha256(token.encode()).digest()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await self._request(scope, receive, send)

    async def _request(self, scope: Scope, receive: Receive, send: Send) -> None:
        method = scope["method"]
        if method == "HEAD":  # answered as GET; the server leaves the body out
            scope = {**scope, "method": "GET"}
        exchange = _Exchange(scope, method, receive, send, self._service)
        scope.setdefault("state", {}).update(request_id=exchange.identifier, reservation=exchange.reservation)
        try:
            try:
                self._check(scope, exchange.headers)
            except ProblemError as problem:
                if problem.status == 503 and "expect" not in exchange.headers:
                    await exchange.drop_body()  # so that the connection can be used again
                await problem_response(Request(scope), problem)(scope, exchange.receive, exchange.send)
            else:
                await self._app(scope, exchange.receive, exchange.send)
        except Exception:
            # The application has answered 500 by now, if anything could still be sent.
            _LOGGER.exception("unexpected error", extra={"request_id": exchange.identifier})
            if not exchange.started:
                raise
        finally:
            exchange.reservation.keep(0)
            exchange.log()

    def _check(self, scope: Scope, headers: Headers) -> None:
        if scope["http_version"] == "1.1" and "host" not in headers:
            raise ProblemError(400, "no_host", "a request of HTTP/1.1 needs a Host header")
        if self._token is not None and scope["path"] not in PUBLIC_PATHS:
            scheme, _, given = headers.get("authorization", "").partition(" ")
            digest = hashlib.sha256(given.strip().encode("utf-8", "surrogateescape")).digest()
            # Digests are compared in constant time, so neither content nor length of the token leaks.
            if not hmac.compare_digest(digest, self._token) or scheme.lower() != "bearer":
                raise ProblemError(
                    401, "unauthorized", "this service needs a bearer token", {"www-authenticate": "Bearer"}
                )
        if scope["method"] != "GET" and headers.get("sec-fetch-site") == "cross-site":
            raise ProblemError(403, "cross_site", "another web site may not use this service through its visitors")
        if headers.get("content-encoding", "identity").lower() not in {"", "identity"}:
            raise ProblemError(415, "content_encoding", "compressed bodies are not taken: send the image as it is")
        declared = headers.get("content-length", "0")
        if not declared.isdecimal():
            raise ProblemError(400, "bad_length", "the Content-Length is not a number")
        if int(declared[:20]) > self._service.settings.max_body:
            raise too_large(self._service.settings)
        if scope["method"] == "POST":  # every POST wants a place: without one its body is not even kept
            self._service.admission.check()


def _label(path: str) -> str:
    """Name the route of a path in metrics; there are few names, whatever clients ask for."""
    if path in {"/v1/predict", "/v1/predict/batch"}:
        return path
    return "/v2/models/{model}/infer" if path.startswith("/v2/models/") and path.endswith("/infer") else "other"


class _Exchange:
    """One request and its answer: limits on the way in, headers and counts on the way out."""

    def __init__(self, scope: Scope, method: str, receive: Receive, send: Send, service: Service) -> None:
        self.headers = Headers(scope=scope)
        given = self.headers.get("x-request-id", "")
        self.identifier = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        self.started = False
        self.reservation = Reservation(service.memory)
        self._scope = scope
        self._method = method
        self._receive = receive
        self._send = send
        self._service = service
        self._begin = time.monotonic()
        self._body_due = self._begin + service.settings.upload_timeout
        has_body = self.headers.get("content-length", "0") != "0" or "transfer-encoding" in self.headers
        self._body_complete = not has_body
        self._received = 0
        self._status = 499

    async def receive(self) -> Message:
        """Receive a piece of the body in time, or wait for the client to go away.

        Raises:
            ProblemError: 408 if the body is not complete in time.
        """
        if self._body_complete:
            return await self._receive()
        try:
            message = await asyncio.wait_for(self._receive(), max(0.0, self._body_due - time.monotonic()))
        except asyncio.TimeoutError:
            limit = self._service.settings.upload_timeout
            raise ProblemError(408, "upload_timeout", f"the body did not arrive within {limit:g} s") from None
        if message["type"] == "http.disconnect":
            self._body_complete = True
        elif message["type"] == "http.request":
            self._received += len(message.get("body", b""))
            if not message.get("more_body", False):
                self._body_complete = True
                self._service.metrics.stage("upload", time.monotonic() - self._begin)
        return message

    async def send(self, message: Message) -> None:
        """Send a piece of the answer, with the headers that all have; a large one holds memory until it is read."""
        if message["type"] == "http.response.start":
            self.started = True
            self._status = message["status"]
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
            headers["x-request-id"] = self.identifier
            if self._service.draining or not self._body_complete:
                headers["connection"] = "close"
        elif message["type"] == "http.response.body" and not message.get("more_body"):
            size = len(message.get("body", b""))
            self.reservation.keep(size if size > _SMALL else 0)
            if size > _SMALL or not self._body_complete:
                await self._send({**message, "more_body": True})
                await self.drop_body()
                # The server takes this only when the client has read nearly all that was sent before.
                message = {"type": "http.response.body", "body": b"", "more_body": False}
        await self._send(message)

    async def drop_body(self) -> None:
        """Read on for a moment: closing at once would reset the connection and lose the answer on its way."""
        until = time.monotonic() + _LINGER
        while not self._body_complete and (left := until - time.monotonic()) > 0:
            try:
                message = await asyncio.wait_for(self._receive(), left)
            except asyncio.TimeoutError:
                return
            self._received += len(message.get("body", b""))
            self._body_complete = message["type"] == "http.disconnect" or not message.get("more_body", False)

    def log(self) -> None:
        """Count and log the request. Nothing of its content is logged."""
        seconds = time.monotonic() - self._begin
        # Without a route it was refused before routing, or there is none.
        route = getattr(self._scope.get("route"), "path", None) or _label(self._scope["path"])
        problem = self._scope["state"].get("problem")
        self._service.metrics.answer(route, self._method, self._status, seconds)
        if self._status == 499:
            self._service.metrics.vanish()
        elif problem is not None:
            self._service.metrics.reject(problem)
        _LOGGER.info(
            "request",
            extra={
                "request_id": self.identifier,
                "method": self._method,
                "route": route,
                "status": self._status,
                "milliseconds": round(seconds * 1e3, 1),
                "bytes_in": self._received,
                **({} if problem is None else {"problem": problem}),
            },
        )
