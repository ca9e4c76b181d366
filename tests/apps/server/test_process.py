from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from uvicorn.protocols.http.flow_control import FlowControl

from tests.apps.server.conftest import FakeBackend, MakeApp, Running, encode, picture
from trilitenet.apps.server.application import Application
from trilitenet.apps.server.process import GuardedProtocol, JsonFormatter, build_server
from trilitenet.errors import BackendError

Run = Callable[[Application], Running]
_T = TypeVar("_T")


def _connect(running: Running) -> socket.socket:
    return socket.create_connection(("127.0.0.1", running.port), timeout=60)


def _wait(ask: Callable[[], _T]) -> _T:
    """Ask until there is something."""
    until = time.monotonic() + 20
    while not (found := ask()):
        assert time.monotonic() < until
        time.sleep(0.01)
    return found


def _read_all(connection: socket.socket) -> bytes:
    pieces = []
    while piece := connection.recv(65536):
        pieces.append(piece)
    return b"".join(pieces)


def _read_health(connection: socket.socket) -> bytes:
    """Return the answer to ``/healthz``, whose head and body may come apart."""
    answer = b""
    while not answer.endswith(b'{"status":"ok"}') and (piece := connection.recv(65536)):
        answer += piece
    return answer


def test_a_silent_connection_is_closed(make_app: MakeApp, run_app: Run) -> None:
    with _connect(run_app(make_app(header_timeout=0.2))) as connection:
        assert b" 408 " in _read_all(connection)


def test_headers_that_trickle_are_cut_off(make_app: MakeApp, run_app: Run) -> None:
    with _connect(run_app(make_app(header_timeout=0.3))) as connection:
        start = time.monotonic()
        connection.sendall(b"GET / HTTP/1.1\r\n")
        answer = b""
        while not answer and time.monotonic() - start < 5:
            connection.sendall(b"x: y\r\n")
            connection.settimeout(0.05)
            try:
                answer = connection.recv(1000)
            except TimeoutError:
                continue
        assert b" 408 " in answer
        assert time.monotonic() - start < 2


def test_late_headers_of_a_second_request_are_told(make_app: MakeApp, run_app: Run) -> None:
    with _connect(run_app(make_app(header_timeout=0.2))) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n")
        assert _read_health(connection).startswith(b"HTTP/1.1 200")
        connection.sendall(b"GET /heal")
        assert _read_all(connection).startswith(b"HTTP/1.1 408")


def test_line_breaks_do_not_keep_a_connection_open(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(header_timeout=0.3, keep_alive=0.3))
    with _connect(running) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n")
        assert _read_health(connection).startswith(b"HTTP/1.1 200")
        connection.sendall(b"\r\n")
        start = time.monotonic()
        _read_all(connection)
        assert time.monotonic() - start < 3


def test_endless_headers_are_refused(app: Application, run_app: Run) -> None:
    with _connect(run_app(app)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nx: ")
        try:
            for _ in range(100):
                connection.sendall(b"y" * 1000)
        except OSError:
            pass
        assert connection.recv(1000).startswith(b"HTTP/1.1 431")


def test_long_headers_are_refused_also_when_they_are_there_at_once(app: Application, run_app: Run) -> None:
    running = run_app(app)
    with _connect(running) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\nx: " + b"y" * 33_000 + b"\r\n\r\n")
        answer = _read_all(connection)
    assert answer.startswith(b"HTTP/1.1 431")
    assert json.loads(answer.split(b"\r\n\r\n")[1])["error"]["code"] == "headers_too_long"
    with _connect(running) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\nx: " + b"y" * 32_000 + b"\r\n\r\n")
        assert connection.recv(1000).startswith(b"HTTP/1.1 200")


def test_the_headers_of_each_request_count_alone(app: Application, run_app: Run) -> None:
    client = http.client.HTTPConnection("127.0.0.1", run_app(app).port, timeout=10)
    for _ in range(3):
        client.request("GET", "/healthz", headers={"x": "y" * 20_000})
        answer = client.getresponse()
        answer.read()
        assert (answer.status, answer.will_close) == (200, False)
    client.close()


@pytest.mark.parametrize(
    "pieces", [[b"0\r\n", b"x: y\r\n" * 2000], [b"0\r\nx: ", b"y" * 10_000], [b"1;", b"x" * 10_000]]
)
def test_what_nobody_asked_for_in_a_body_has_a_largest_size(
    app: Application, run_app: Run, pieces: list[bytes]
) -> None:
    running = run_app(app)
    with _connect(running) as connection:
        connection.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n" + pieces[0])
        with contextlib.suppress(ConnectionError):
            for _ in range(100):
                connection.sendall(pieces[1])
                time.sleep(0.001)
        assert connection.recv(1000).startswith(b"HTTP/1.1 431")


def test_headers_after_a_body_are_passed_over(app: Application, run_app: Run, jpeg: bytes) -> None:
    head = b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n"
    chunks = b"".join(b"1\r\n%c\r\n" % byte for byte in jpeg + bytes(20_000))
    with _connect(run_app(app)) as connection:
        connection.sendall(head + chunks + b"0\r\ncontent-type: multipart/form-data\r\n\r\n")
        assert connection.recv(1000).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "request_",
    [
        b"nonsense\r\n\r\n",
        b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\nno number\r\n",
    ],
)
def test_what_is_no_http_is_refused_in_the_form_of_every_refusal(
    app: Application, run_app: Run, request_: bytes
) -> None:
    with _connect(run_app(app)) as connection:
        connection.sendall(request_)
        answer = _read_all(connection)
    assert answer.startswith(b"HTTP/1.1 400")
    assert json.loads(answer.split(b"\r\n\r\n")[1])["error"]["code"] == "bad_request"


_BROKEN = b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n1\r\nx\r\nno number\r\n"


def test_a_request_whose_body_is_broken_is_not_waited_for(
    make_app: MakeApp, run_app: Run, caplog: pytest.LogCaptureFixture
) -> None:
    running = run_app(make_app(upload_timeout=0.3))
    with _connect(running) as connection:
        connection.sendall(_BROKEN)
        assert _read_all(connection).startswith(b"HTTP/1.1 400")
        _wait(lambda: not running.server.server_state.tasks)
        time.sleep(0.5)  # its time for the body passes
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []
    assert running.app.service.memory.used == 0


def test_a_refusal_is_not_taken_for_the_answer_to_an_earlier_request(
    app: Application, run_app: Run, backend: FakeBackend, jpeg: bytes
) -> None:
    running = run_app(app)
    backend.gate.clear()
    with _connect(running) as connection:
        connection.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: %d\r\n\r\n" % len(jpeg) + jpeg)
        _wait(lambda: app.service.admission.taken)
        connection.sendall(_BROKEN)
        assert b"HTTP/1.1 400" not in _read_all(connection)
    backend.gate.set()


def test_a_request_needs_a_host(app: Application, run_app: Run) -> None:
    running = run_app(app)
    for version, status in ((b"1.1", b"400"), (b"1.0", b"200")):
        with _connect(running) as connection:
            connection.sendall(b"GET /healthz HTTP/" + version + b"\r\nconnection: close\r\n\r\n")
            answer = _read_all(connection)
            assert answer.split()[1] == status
            assert b"\r\nserver:" not in answer.lower()


@pytest.mark.parametrize("rest", [b"", b"x" * 70_000])
def test_a_request_that_offers_another_protocol_keeps_its_body(
    app: Application, run_app: Run, jpeg: bytes, rest: bytes
) -> None:
    body = jpeg + rest  # what follows the picture is ignored
    head = (
        b"POST /v1/predict HTTP/1.1\r\nhost: x\r\nconnection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\n"
        b"http2-settings: AAMAAABkAAQAoAAAAAIAAAAA\r\ncontent-length: %d\r\n\r\n" % len(body)
    )
    with _connect(run_app(app)) as connection:
        for pieces in ([head + body], [head, body]):
            for piece in pieces:
                connection.sendall(piece)
            answer = http.client.HTTPResponse(connection)
            answer.begin()
            assert answer.status == 200
            assert json.load(answer)["perception"]["size"] == {"height": 48, "width": 64}
            assert not answer.will_close


def test_an_offer_in_pieces_is_refused_before_its_body_is_taken_for_a_request(app: Application, run_app: Run) -> None:
    running = run_app(app)
    with _connect(running) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: 54\r\nconnection: upgrade\r\nupg")
        (protocol,) = _wait(lambda: list(running.server.server_state.connections))
        assert isinstance(protocol, GuardedProtocol)
        _wait(lambda: protocol._header_bytes)
        connection.sendall(b"rade: h2c\r\n\r\n")
        answer = connection.recv(1000)
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n")
        answer += _read_all(connection)
    assert answer.startswith(b"HTTP/1.1 400")
    assert answer.count(b"HTTP/1.1 ") == 1


def test_an_offer_of_websockets_is_answered_as_ever(app: Application, run_app: Run) -> None:
    with _connect(run_app(app)) as connection:
        for _ in range(2):
            connection.sendall(
                b"GET /healthz HTTP/1.1\r\nhost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
                b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
            )
            answer = http.client.HTTPResponse(connection)
            answer.begin()
            assert answer.status == 200
            answer.read()


def test_refused_connections_are_counted_and_logged(
    make_app: MakeApp, run_app: Run, caplog: pytest.LogCaptureFixture
) -> None:
    app = make_app(max_connections=1, header_timeout=0.2)
    running = run_app(app)
    with caplog.at_level(logging.INFO, logger="trilitenet.server"), _connect(running) as first:
        with _connect(running) as second:
            assert b" 503 " in _read_all(second)
        assert b" 408 " in _read_all(first)
    text = app.service.metrics.text().decode()
    for reason in ("too_many_connections", "headers_timeout"):
        assert f'trilitenet_rejects_total{{reason="{reason}"}} 1.0' in text
    assert "\ntrilitenet_connections " in text
    refused = [record.__dict__ for record in caplog.records if record.message == "connection refused"]
    assert [(entry["status"], entry["problem"]) for entry in refused] == [
        (503, "too_many_connections"),
        (408, "headers_timeout"),
    ]


def test_a_body_that_trickles_is_cut_off(make_app: MakeApp, run_app: Run) -> None:
    with _connect(run_app(make_app(upload_timeout=0.3))) as connection:
        connection.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: 1000\r\n\r\nx")
        start = time.monotonic()
        answer = _read_all(connection)
        assert answer.startswith(b"HTTP/1.1 408")
        assert b'"upload_timeout"' in answer
        assert time.monotonic() - start < 3


def test_four_gigabytes_are_refused_at_once(app: Application, run_app: Run) -> None:
    with _connect(run_app(app)) as connection:
        start = time.monotonic()
        connection.sendall(
            b"POST /v1/predict HTTP/1.1\r\nhost: x\r\nexpect: 100-continue\r\ncontent-length: 4294967296\r\n\r\n"
        )
        assert connection.recv(1000).startswith(b"HTTP/1.1 413")
        assert time.monotonic() - start < 1


def test_too_many_connections_are_refused_and_the_rest_served(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(max_connections=2))
    with _connect(running) as first, _connect(running) as second:
        second.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n")
        assert second.recv(1000).startswith(b"HTTP/1.1 200")
        with _connect(running) as third:
            answer = _read_all(third)
            assert answer.startswith(b"HTTP/1.1 503")
            assert b"retry-after" in answer
        first.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n")
        assert first.recv(1000).startswith(b"HTTP/1.1 200")


def test_far_too_many_connections_are_not_even_answered(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(max_connections=1))
    with _connect(running), _connect(running) as told, _connect(running) as cut:
        assert told.recv(1000).startswith(b"HTTP/1.1 503")
        with contextlib.suppress(ConnectionResetError):
            assert cut.recv(1000) == b""


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="this system has no such limit")
def test_the_system_gives_up_clients_that_are_gone(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(send_timeout=1.5))
    with _connect(running):
        (protocol,) = _wait(lambda: list(running.server.server_state.connections))
        used = protocol.transport.get_extra_info("socket")
        assert used.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 1500


def test_a_refused_connection_can_be_read_after_a_long_body(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(max_connections=1))
    with _connect(running) as first, _connect(running) as second:
        second.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: 3000000\r\n\r\n" + b"x" * 3_000_000)
        time.sleep(0.2)  # closing with bytes unread would have reset the connection by now
        assert _read_all(second).startswith(b"HTTP/1.1 503")
        first.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n")
        assert first.recv(1000).startswith(b"HTTP/1.1 200")


def test_a_full_service_answers_again_and_again_on_one_connection(make_app: MakeApp, run_app: Run, jpeg: bytes) -> None:
    running = run_app(make_app(queue=1, max_images=1, keep_alive=1.0, header_timeout=0.3))
    running.app.service.admission.enter()
    client = http.client.HTTPConnection("127.0.0.1", running.port, timeout=10)
    client.connect()
    used = client.sock
    for _ in range(3):
        client.request("POST", "/v1/predict", body=jpeg + bytes(300_000))
        answer = client.getresponse()
        answer.read()
        assert answer.status == 503
        assert client.sock is used
    running.app.service.admission.leave()
    client.request("POST", "/v1/predict", body=jpeg)
    assert client.getresponse().status == 200
    client.close()


def test_slow_clients_do_not_hold_up_others(make_app: MakeApp, run_app: Run, jpeg: bytes) -> None:
    running = run_app(make_app(queue=2, max_images=2))
    slow = [_connect(running) for _ in range(20)]
    for connection in slow:
        connection.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: 1000\r\n\r\n\xff")
    client = http.client.HTTPConnection("127.0.0.1", running.port, timeout=10)
    for _ in range(5):
        client.request("POST", "/v1/predict", body=jpeg)
        answer = client.getresponse()
        answer.read()
        assert answer.status == 200
    client.close()
    for connection in slow:
        connection.close()


def test_a_client_that_does_not_read_is_cut_off(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(send_timeout=0.5))
    big = encode(picture(4000, 3000), "PNG")
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect(("127.0.0.1", running.port))
    head = b"POST /v1/predict?format=overlay HTTP/1.1\r\nhost: x\r\naccept: image/png\r\ncontent-length: %d\r\n\r\n"
    connection.sendall(head % len(big) + big)
    until = time.monotonic() + 60
    while not running.server.server_state.total_requests and time.monotonic() < until:
        time.sleep(0.05)
    while running.server.server_state.connections and time.monotonic() < until:
        time.sleep(0.05)
    assert not running.server.server_state.connections
    connection.close()


def test_a_client_that_reads_slowly_without_end_is_cut_off(make_app: MakeApp, run_app: Run) -> None:
    running = run_app(make_app(send_timeout=5.0, answer_timeout=1.0))
    noise = np.random.default_rng(0).integers(0, 256, (1500, 2000, 3), np.uint8)
    body = encode(noise, "JPEG")
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(60)
        connection.connect(("127.0.0.1", running.port))
        head = b"POST /v1/predict?format=overlay HTTP/1.1\r\nhost: x\r\naccept: image/png\r\ncontent-length: %d\r\n\r\n"
        connection.sendall(head % len(body) + body)
        taken = len(connection.recv(4096))
        while running.server.server_state.connections:
            taken += len(connection.recv(4096))  # all of it would take 10 s
            time.sleep(0.005)
    assert taken < 4_000_000
    _wait(lambda: not running.app.service.memory.used)


@pytest.mark.parametrize("headers", [b"", b"connection: close\r\n"])
def test_the_rest_of_an_answer_is_not_kept_for_ever(make_app: MakeApp, run_app: Run, headers: bytes) -> None:
    running = run_app(make_app(send_timeout=0.3, keep_alive=1.0))
    with _connect(running) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: x\r\n" + headers)
        (protocol,) = _wait(lambda: list(running.server.server_state.connections))
        assert isinstance(protocol, GuardedProtocol)
        transport = protocol.transport
        # Nothing can be sent, as if the client read nothing.
        protocol.transport = _Deaf(transport)  # type: ignore[assignment]
        connection.sendall(b"\r\n")
        _wait(lambda: transport.is_closing())
        _wait(lambda: not running.server.server_state.connections)


class _Deaf:
    """A transport that keeps what is written, and waits with closing until somebody has read it."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._closing = False

    def write(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        self._closing = True

    def is_closing(self) -> bool:
        return self._closing

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


class _Transport:
    """A transport whose client reads as a test says."""

    def __init__(self) -> None:
        self.protocol = GuardedProtocol.__new__(GuardedProtocol)
        self.unread = 1000
        self.aborted = False

    def get_write_buffer_size(self) -> int:
        return self.unread

    def abort(self) -> None:
        self.aborted = True


class _Loop:
    """Calls later when a test says so."""

    def __init__(self) -> None:
        self.now = 0.0
        self.later: Callable[[], None] = lambda: None

    def time(self) -> float:
        return self.now

    def call_later(self, seconds: float, function: Callable[..., None], *arguments: object) -> _Loop:
        def later() -> None:
            self.now += seconds
            function(*arguments)

        self.later = later
        return self

    def cancel(self) -> None:
        self.later = lambda: None


@pytest.fixture
def paused() -> tuple[_Transport, _Loop]:
    """The transport and the loop of a connection whose client does not read."""
    transport, loop = _Transport(), _Loop()
    protocol = transport.protocol
    protocol.transport, protocol.loop = transport, loop  # type: ignore[assignment]
    protocol.flow = FlowControl(transport)  # type: ignore[arg-type]
    protocol.pause_writing()
    return transport, loop


def test_a_client_that_reads_slowly_is_not_cut_off(paused: tuple[_Transport, _Loop]) -> None:
    transport, loop = paused
    for left in (900, 499):
        transport.unread = left
        loop.later()
        assert not transport.aborted
    loop.later()
    assert transport.aborted


def test_a_client_that_reads_again_is_watched_no_more(paused: tuple[_Transport, _Loop]) -> None:
    transport, loop = paused
    transport.protocol.resume_writing()
    transport.unread = 0
    loop.later()
    assert not transport.aborted
    assert loop.now == 0


def test_a_client_that_takes_a_few_bytes_now_and_then_is_cut_off(paused: tuple[_Transport, _Loop]) -> None:
    transport, loop = paused
    while not transport.aborted:
        transport.unread -= 1
        loop.later()
    assert loop.now == GuardedProtocol.limits.answer_timeout


def test_a_full_queue_is_told_with_retry_after(
    make_app: MakeApp, run_app: Run, backend: FakeBackend, jpeg: bytes
) -> None:
    running = run_app(make_app(queue=3, max_images=3))
    backend.gate.clear()
    statuses: list[int] = []
    headers: list[str | None] = []

    def post() -> None:
        client = http.client.HTTPConnection("127.0.0.1", running.port, timeout=20)
        client.request("POST", "/v1/predict", body=jpeg)
        answer = client.getresponse()
        answer.read()
        statuses.append(answer.status)
        headers.append(answer.headers["retry-after"])
        client.close()

    threads = [threading.Thread(target=post) for _ in range(10)]
    for thread in threads:
        thread.start()
    until = time.monotonic() + 10
    while len(statuses) < 7 and time.monotonic() < until:
        time.sleep(0.01)
    backend.gate.set()
    for thread in threads:
        thread.join(20)
    assert Counter(statuses) == {200: 3, 503: 7}
    assert sum(header is not None for header in headers) == 7


def test_an_image_that_waits_too_long_gets_503(
    make_app: MakeApp, run_app: Run, backend: FakeBackend, jpeg: bytes
) -> None:
    running = run_app(make_app(deadline=0.2))
    backend.gate.clear()
    client = http.client.HTTPConnection("127.0.0.1", running.port, timeout=20)
    client.request("POST", "/v1/predict", body=jpeg)
    answer = client.getresponse()
    assert answer.status == 503
    assert json.load(answer)["error"]["code"] == "deadline"
    backend.gate.set()
    client.close()


def test_while_it_drains_a_service_says_so_and_still_answers(make_app: MakeApp, run_app: Run, jpeg: bytes) -> None:
    running = run_app(make_app(drain=2.0))
    running.server.should_exit = True
    _wait(lambda: running.app.service.draining)
    for method, path, body, status in (("GET", "/readyz", None, 503), ("POST", "/v1/predict", jpeg, 200)):
        client = http.client.HTTPConnection("127.0.0.1", running.port, timeout=20)
        client.request(method, path, body=body)
        answer = client.getresponse()
        assert (answer.status, answer.will_close) == (status, True)
        client.close()


SCRIPT = """
import contextlib
import socket
from tests.apps.server.conftest import FakeBackend
from trilitenet.apps.server.application import create_app
from trilitenet.apps.server.process import build_server, set_up_logs
from trilitenet.apps.server.settings import Settings
from trilitenet.inference.predictor import Predictor

set_up_logs()
app = create_app(Predictor(FakeBackend(seconds=0.01)), "tiny", Settings(queue=32, threads=2, drain=0.5))
with contextlib.suppress(KeyboardInterrupt):
    build_server(app).run([socket.create_server(("127.0.0.1", 0), backlog=1024)])
"""


def _start_script() -> tuple[subprocess.Popen[str], int]:
    """Start a service in a process of its own; return it and the port."""
    root = Path(__file__).resolve().parents[3]
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT], cwd=root, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{root / 'src'}"},
    )  # fmt: skip
    assert process.stderr is not None
    while True:
        entry = json.loads(process.stderr.readline())
        if entry["message"] == "listening":
            return process, int(entry["url"].split(":")[-1].strip("/"))


def test_a_model_that_fails_at_the_start_is_one_line(
    make_app: MakeApp, backend: FakeBackend, caplog: pytest.LogCaptureFixture
) -> None:
    backend.error = BackendError("the runtime failed (no kernel\nfor this device)")
    server = build_server(make_app())
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, caplog.at_level("INFO"), pytest.raises(BackendError) as caught:
        server.run([listener])
    assert str(caught.value).endswith(
        "cannot serve, the first image failed (the runtime failed (no kernel for this device))"
    )
    assert not {"listening", "Application startup failed. Exiting."} & {record.message for record in caplog.records}
    assert not logging.getLogger("uvicorn.error").filters


def test_a_second_ctrl_c_ends_at_once_without_a_traceback() -> None:
    process, port = _start_script()
    assert process.stderr is not None
    urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz").close()  # signalled before, it would end at once
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: 1000\r\n\r\nx")
        process.send_signal(signal.SIGINT)
        while json.loads(line := process.stderr.readline())["message"] != "Shutting down":
            assert line
        process.send_signal(signal.SIGINT)
        start = time.monotonic()
        _, errors = process.communicate(timeout=60)
    assert time.monotonic() - start < 10
    assert "Traceback" not in errors


def test_sigterm_under_load_loses_no_accepted_request(jpeg: bytes) -> None:
    process, port = _start_script()
    outcomes: Counter[str] = Counter()
    stop = threading.Event()

    def load(number: int) -> None:
        client = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        count = 0
        while not stop.is_set():
            try:
                client.connect() if client.sock is None else None
            except OSError:
                outcomes["refused"] += 1  # never accepted: the listener is closed
                return
            try:
                client.request("POST", "/v1/predict", body=jpeg, headers={"x-request-id": f"{number}-{count}"})
                answer = client.getresponse()
                json.load(answer)
                outcomes[str(answer.status)] += 1
                if answer.will_close:
                    client.close()
            except (OSError, http.client.HTTPException) as error:
                outcomes[f"lost: {type(error).__name__}"] += 1
                client.close()
            count += 1

    threads = [threading.Thread(target=load, args=(number,)) for number in range(12)]
    for thread in threads:
        thread.start()
    until = time.monotonic() + 30
    while outcomes["200"] < 30 and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    stop.set()
    for thread in threads:
        thread.join(20)
    logged = [json.loads(line) for line in errors.splitlines()]
    answered = [entry for entry in logged if entry["message"] == "request"]
    assert {entry["status"] for entry in answered} <= {200, 503}
    assert outcomes.pop("refused", 0) == len(threads)
    assert outcomes["200"] >= 30
    assert set(outcomes) <= {"200", "503"}, outcomes
    assert sum(outcomes.values()) == len(answered)
    assert process.returncode in {0, -signal.SIGTERM}


def test_warnings_are_logged_in_json_and_no_content_of_images() -> None:
    script = """
import logging, warnings
from trilitenet.apps.server.process import set_up_logs
set_up_logs("DEBUG")
warnings.warn("corrupt EXIF")
logging.getLogger("PIL.TiffImagePlugin").debug("owner: secret")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    (entry,) = [json.loads(line) for line in done.stderr.splitlines()]
    assert "corrupt EXIF" in entry["message"]


@pytest.fixture
def _far_east(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "XYZ-9")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("_far_east")
def test_log_lines_are_json_with_the_fields() -> None:
    fields = {"created": 1.25, "msecs": 250.0, "request_id": "7"}
    record = logging.makeLogRecord({"name": "a", "levelname": "INFO", "msg": "x %d", "args": (3,), **fields})
    entry = json.loads(JsonFormatter().format(record))
    assert entry["message"] == "x 3"
    assert entry["request_id"] == "7"
    assert entry["time"] == "1970-01-01T00:00:01.250Z"
    try:
        raise ValueError("two\nlines")
    except ValueError:
        record = logging.getLogger("a").makeRecord("a", 40, "f", 1, "y", (), sys.exc_info())
    text = JsonFormatter().format(record)
    assert "\n" not in text
    assert "ValueError" in json.loads(text)["exception"]
