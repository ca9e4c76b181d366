"""The process: uvicorn with the timeouts it lacks, a shutdown that loses nothing, and logs in JSON."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import socket
import sys
import time
from typing import Any, Final

import uvicorn
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

from trilitenet.apps.server.application import Application
from trilitenet.apps.server.metrics import Metrics
from trilitenet.apps.server.settings import Settings
from trilitenet.errors import BackendError, gist

__all__ = ["GuardedProtocol", "GuardedServer", "JsonFormatter", "build_server", "set_up_logs"]

_LOGGER: Final = logging.getLogger("trilitenet.server")

_MAX_HEADERS: Final = 32 * 1024
"""Bytes of a request's first line and headers."""

_UPGRADE: Final = re.compile(rb"\r\nupgrade(?=[ \t]*:)", re.IGNORECASE)
"""The header that asks for another protocol, in the bytes of headers."""

_LAST_CALL: Final = 1.0
"""Seconds that a connection without a request is given when the server stops, and a refused one to read why."""

_GRACE: Final = 0.1
"""Seconds more before headers count as late: on a busy machine they may lie unread since long."""

_TCP_USER_TIMEOUT: Final = getattr(socket, "TCP_USER_TIMEOUT", None)


class GuardedProtocol(HttpToolsProtocol):
    """HTTP/1.1 with limits on what a slow or greedy client can hold.

    uvicorn waits without end for a request's headers, takes headers of any length, and keeps a connection whose client
    reads nothing. Here each has a limit. Its parser drops the body of a request that offers another protocol, and takes
    it for the next request. Here such an offer is passed over.
    """

    limits = Settings()
    metrics: Metrics

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._due: asyncio.TimerHandle | None = None
        self._stuck: asyncio.TimerHandle | None = None
        self._in_headers = True
        self._header_bytes = 0
        self._parsed_bytes = 0
        self._bytes_between = 0
        self._refused = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, unless there are too many."""
        super().connection_made(transport)
        if len(self.connections) > 2 * self.limits.max_connections:
            self.metrics.reject("too_many_connections")
            transport.abort()  # too many even of those that are told so
            return
        if len(self.connections) > self.limits.max_connections:
            self._refuse(503, "too_many_connections", "too many connections", "retry-after: 1\r\n")
            return
        raw: socket.socket | None = transport.get_extra_info("socket")
        if raw is not None and _TCP_USER_TIMEOUT is not None and raw.family in {socket.AF_INET, socket.AF_INET6}:
            raw.setsockopt(socket.IPPROTO_TCP, _TCP_USER_TIMEOUT, int(self.limits.send_timeout * 1000))
        self._wait_for_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection that is gone."""
        self._cancel()
        if self._stuck is not None:
            self._stuck.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes; those of headers, and those between pieces of a body, are counted."""
        if self.transport.is_closing() or self._refused:
            return
        if self._in_headers:
            self._header_bytes += len(data)
            end = data.find(b"\r\n\r\n")
            head = data if end < 0 else data[:end]
            if _UPGRADE.search(head):
                data = _UPGRADE.sub(b"\r\nignored", head) + data[len(head) :]
        self._bytes_between += len(data)
        super().data_received(data)
        if self._in_headers and self._due is None and (self.cycle is None or self.cycle.response_complete):
            self._wait_for_headers()  # line breaks before a request begin no message, but end the idle time
        if (self._header_bytes if self._in_headers else self._bytes_between) > _MAX_HEADERS:
            self._refuse_headers()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP in the form of every refusal."""
        self._refuse(400, "bad_request", msg.lower().rstrip("."))

    def on_message_begin(self) -> None:
        """A request begins: its headers are due."""
        if self._refused:
            return
        self._parsed_bytes = 0
        self._wait_for_headers()
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """Take a piece of the address."""
        self._parsed_bytes += len(url)
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a header; what comes after the body is none."""
        if not self._in_headers:
            return
        self._parsed_bytes += len(name) + len(value)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """The headers are there: the body is due."""
        if self._refused:
            return
        if self._parsed_bytes > _MAX_HEADERS:
            self._refuse_headers()
            return
        if self.parser.should_upgrade() and {b"content-length", b"transfer-encoding"} & dict(self.headers).keys():
            # The header came in pieces, so it was not passed over: the parser is about to lose the body.
            self._refuse(400, "bad_request", "a request with a body cannot change the protocol")
            return
        self._cancel()
        self._in_headers = False
        self._bytes_between = 0
        # The application answers 408 in time; this only ends connections that trickle on after their answer.
        self._due = self.loop.call_later(self.limits.upload_timeout + 5.0, self._close)
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take a piece of the body; between two, little may come: sizes of chunks, and what nobody asked for."""
        self._bytes_between = 0
        if not self._refused:
            super().on_body(body)

    def on_message_complete(self) -> None:
        """The request is there."""
        if self._refused:
            return
        self._cancel()
        self._in_headers = True
        self._header_bytes = 0
        super().on_message_complete()

    def shutdown(self) -> None:
        """The server stops: a client that has just connected is about to ask, so it gets a moment to do so."""
        if self._refused:
            return
        if self.cycle is None and not self.transport.is_closing():
            self._cancel()
            self._due = self.loop.call_later(_LAST_CALL, self._close)
        else:
            super().shutdown()

    def on_response_complete(self) -> None:
        """The answer is written: if the connection ends with it, its rest must be taken in time."""
        super().on_response_complete()
        if self.transport.is_closing():
            self._close()

    def timeout_keep_alive_handler(self) -> None:
        """End an idle connection."""
        self._close()

    def pause_writing(self) -> None:
        """The client does not read: it has so long to take something, and so long to take nearly all."""
        super().pause_writing()
        self._wait_for_reading(self.loop.time() + self.limits.answer_timeout)

    def resume_writing(self) -> None:
        """The client reads again."""
        if self._stuck is not None:
            self._stuck.cancel()
        super().resume_writing()

    def _wait_for_reading(self, until: float) -> None:
        left = self.transport.get_write_buffer_size()
        seconds = min(self.limits.send_timeout, until - self.loop.time())
        self._stuck = self.loop.call_later(seconds, self._check_reading, left, until)

    def _check_reading(self, left: int, until: float) -> None:
        if self.transport.get_write_buffer_size() < left and self.loop.time() < until:
            self._wait_for_reading(until)
        else:
            self.transport.abort()

    def _close(self) -> None:
        """Close the connection, and do not wait for ever until its client has taken the rest of an answer."""
        self._cancel()
        self.transport.close()
        self._due = self.loop.call_later(self.limits.send_timeout, self.transport.abort)

    def _wait_for_headers(self) -> None:
        self._cancel()
        self._due = self.loop.call_later(self.limits.header_timeout, self._headers_late)

    def _headers_late(self) -> None:
        self._due = self.loop.call_later(_GRACE, self._headers_lost)

    def _headers_lost(self) -> None:
        if self.cycle is not None and not self._header_bytes:
            self._close()  # between two requests
        else:
            self._refuse(408, "headers_timeout", "the headers did not arrive in time")

    def _refuse_headers(self) -> None:
        self._refuse(431, "headers_too_long", f"the headers are longer than {_MAX_HEADERS:,} bytes")

    def _cancel(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _refuse(self, status: int, code: str, message: str, headers: str = "") -> None:
        """Answer without the application, then close; what still arrives is dropped, so that the answer is not."""
        if self.transport.is_closing() or self._refused:
            return
        self._cancel()
        self._refused = True
        self.metrics.reject(code)
        _LOGGER.info("connection refused", extra={"status": status, "problem": code})
        if self.cycle is not None and not self.cycle.response_complete:
            if self._in_headers or self.pipeline or self.cycle.response_started:
                self._close()  # an answer to an earlier request is on its way
                return
            self.cycle.disconnected = True  # its body is broken: the application need not wait for it
            self.cycle.message_event.set()
        body = json.dumps({"error": {"code": code, "message": message, "request_id": ""}})
        self.transport.write(
            f"HTTP/1.1 {status} Refused\r\n{headers}content-type: application/json\r\n"
            f"content-length: {len(body)}\r\nconnection: close\r\n\r\n{body}".encode()
        )
        self.transport.write_eof()
        self._due = self.loop.call_later(_LAST_CALL, self._close)


class GuardedServer(uvicorn.Server):
    """Uvicorn's server with a shutdown in two steps.

    First it says it is not ready and asks every client to close its connection after the next answer, and still serves;
    only then does it stop to listen, and it ends when all that it accepted is answered.
    """

    def __init__(self, config: Config, application: Application) -> None:
        super().__init__(config)
        self._application = application

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until a signal asks to stop.

        Raises:
            KeyboardInterrupt: If a second one came before all that was accepted was answered.
            BackendError: If the model does not get through the image with which the service starts.
        """
        service = self._application.service
        log = logging.getLogger("uvicorn.error")

        def unsaid(record: logging.LogRecord) -> bool:
            return service.failure is None  # which is told below, in one line

        log.addFilter(unsaid)
        try:
            super().run(sockets)
        except KeyboardInterrupt:  # uvicorn raises the signal again when it has heeded it
            if self.force_exit:
                raise
        except SystemExit:
            if service.failure is None:
                raise
        finally:
            log.removeFilter(unsaid)
        if service.failure is not None:
            reason = gist(service.failure) or type(service.failure).__name__
            raise BackendError(f"{service.name}: cannot serve, the first image failed ({reason})")

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and say where."""
        await super().startup(sockets)
        if not self.started:
            return
        for listener in sockets or []:
            host, port = listener.getsockname()[:2]
            _LOGGER.info("listening", extra={"url": f"http://{f'[{host}]' if ':' in host else host}:{port}/"})

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain, then stop."""
        service = self._application.service
        service.draining = True
        until = time.monotonic() + service.settings.drain
        while time.monotonic() < until and not self.force_exit:
            await asyncio.sleep(0.05)
        # Closing a listener resets connections that nobody has accepted yet; a second handle keeps it open till then.
        spares = [listener.dup() for listener in sockets or []]
        for server in self.servers:
            server.close()
        for spare in spares:
            await self._accept_waiting(spare)
        await super().shutdown(sockets)
        if self.force_exit:
            await self._end_at_once()

    async def _end_at_once(self) -> None:
        """End what is open after a second Ctrl-C: uvicorn leaves it to the end of the loop, with a traceback each."""
        for connection in list(self.server_state.connections):
            connection.transport.abort()
        if self.server_state.tasks:
            await asyncio.wait(self.server_state.tasks, timeout=_LAST_CALL)
        await self.lifespan.shutdown()

    async def _accept_waiting(self, listener: socket.socket) -> None:
        """Accept what waits at a listener, then close it."""

        def protocol() -> asyncio.Protocol:
            made: asyncio.Protocol = self.config.http_protocol_class(  # type: ignore[call-arg]
                config=self.config, server_state=self.server_state, app_state=self.lifespan.state
            )
            return made

        accepted = []
        with listener:
            listener.setblocking(False)
            with contextlib.suppress(OSError):  # BlockingIOError when none is left
                while True:
                    accepted.append(listener.accept()[0])
        for connection in accepted:
            await asyncio.get_running_loop().connect_accepted_socket(protocol, connection)


def build_server(application: Application) -> GuardedServer:
    """Build the server of a process; its ``run`` takes the listening sockets.

    Args:
        application: What `create_app` made.
    """
    settings, metrics = application.service.settings, application.service.metrics
    protocol = type("Protocol", (GuardedProtocol,), {"limits": settings, "metrics": metrics})
    config = Config(
        application,
        http=protocol,
        ws="none",
        lifespan="on",
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
        backlog=1024,
        timeout_keep_alive=int(settings.keep_alive),
        timeout_graceful_shutdown=int(settings.shutdown_timeout),
    )
    server = GuardedServer(config, application)
    metrics.gauge("connections", "Open connections.", lambda: len(server.server_state.connections))
    return server


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, message, and the fields given as ``extra``."""

    _known = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "color_message", "taskName"}

    def format(self, record: logging.LogRecord) -> str:
        """Write one record."""
        entry: dict[str, Any] = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry.update({key: value for key, value in record.__dict__.items() if key not in self._known})
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry, ensure_ascii=False, default=str)


def set_up_logs(level: str = "INFO") -> None:
    """Send all logs and warnings of the process to standard error, in JSON."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)
    logging.getLogger("PIL").setLevel(max(logging.INFO, logging.getLogger().level))  # below, it logs what EXIF says
