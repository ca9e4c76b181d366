from __future__ import annotations

import asyncio
import http.client
import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from tests.apps.server.conftest import TOKEN, FakeBackend, MakeApp, Running, encode
from trilitenet.apps.server.application import Application


@pytest.mark.parametrize("path", ["/", "/healthz", "/v1/models", "/nowhere", "/metrics"])
def test_every_answer_has_the_security_headers(client: TestClient, path: str) -> None:
    headers = client.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert headers["referrer-policy"] == "no-referrer"
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert "access-control-allow-origin" not in headers
    assert "server" not in headers


def test_the_page_may_load_its_own_files(client: TestClient) -> None:
    headers = client.get("/").headers
    assert "script-src 'self'" in headers["content-security-policy"]
    assert headers["cache-control"] == "no-cache"
    assert client.get("/v1/models").headers["cache-control"] == "no-store"


def test_links_from_elsewhere_lead_to_the_page(client: TestClient) -> None:
    assert client.get("/", headers={"sec-fetch-site": "cross-site"}).status_code == 200


def test_the_largest_body_is_taken(make_app: MakeApp, jpeg: bytes) -> None:
    with TestClient(make_app(max_body=len(jpeg))) as client:
        for body, status in ((jpeg, 200), (jpeg + b"x", 413)):
            assert client.post("/v1/predict", content=body).status_code == status
        given = {"content-encoding": "Identity"}
        assert client.post("/v1/predict", content=jpeg, headers=given).status_code == 200


@pytest.mark.parametrize("path", ["/", "/healthz", "/metrics", "/v1/models", "/v2", "/openapi.json", "/nowhere"])
def test_head_is_answered_as_get_without_the_body(
    app: Application, run_app: Callable[[Application], Running], path: str
) -> None:
    client = http.client.HTTPConnection("127.0.0.1", run_app(app).port, timeout=20)
    answers = []
    for method in ("HEAD", "GET", "HEAD"):  # on one connection: a body would be taken for the next answer
        client.request(method, path)
        answer = client.getresponse()
        answer.read()
        answers.append((answer.status, answer.headers["content-type"]))
    client.close()
    assert answers[0] == answers[1] == answers[2]
    text = app.service.metrics.text().decode()
    assert 'trilitenet_requests_total{method="HEAD",route="' in text


def test_what_a_browser_has_is_not_sent_again(client: TestClient) -> None:
    etag = client.get("/app.js").headers["etag"]
    for given in (etag, f"W/{etag}", f'"x", {etag}'):
        assert client.get("/app.js", headers={"if-none-match": given}).status_code == 304
    assert client.get("/app.js", headers={"if-none-match": '"x"'}).status_code == 200


def test_there_is_no_cors(client: TestClient, jpeg: bytes) -> None:
    preflight = client.options(
        "/v1/predict", headers={"origin": "https://example.org", "access-control-request-method": "POST"}
    )
    assert preflight.status_code == 405
    answer = client.post("/v1/predict", content=jpeg, headers={"origin": "https://example.org"})
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize("given", ["abc-123", "A" * 64])
def test_a_good_request_id_is_kept(client: TestClient, given: str) -> None:
    assert client.get("/healthz", headers={"x-request-id": given}).headers["x-request-id"] == given


@pytest.mark.parametrize("given", ["", "A" * 65, "a b", 'x"y', "<script>"])
def test_a_bad_request_id_is_replaced(client: TestClient, given: str) -> None:
    answer = client.get("/healthz", headers={"x-request-id": given}).headers["x-request-id"]
    assert answer != given
    assert len(answer) == 32


class TestToken:
    @pytest.fixture
    def client(self, make_app: MakeApp) -> Any:
        with TestClient(make_app(token=TOKEN)) as client:
            yield client

    @pytest.mark.parametrize("path", ["/v1/models", "/metrics", "/openapi.json", "/v2", "/nowhere"])
    @pytest.mark.parametrize(
        "header",
        [None, "", "Bearer", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", f"Basic {TOKEN}", TOKEN],
    )
    def test_without_the_token_there_is_nothing(self, client: TestClient, path: str, header: str | None) -> None:
        headers = {} if header is None else {"authorization": header}
        answer = client.get(path, headers=headers)
        assert answer.status_code == 401
        assert answer.headers["www-authenticate"] == "Bearer"

    @pytest.mark.parametrize("scheme", ["Bearer", "bearer"])
    def test_with_it_there_is_everything(self, client: TestClient, scheme: str) -> None:
        for space in (" ", "  "):
            answer = client.get("/v1/models", headers={"authorization": f"{scheme}{space}{TOKEN}"})
            assert answer.status_code == 200

    @pytest.mark.parametrize("path", ["/", "/app.js", "/app.css", "/icon.svg", "/healthz", "/readyz"])
    def test_page_and_probes_need_none(self, client: TestClient, path: str) -> None:
        assert client.get(path).status_code == 200


def test_a_declared_length_is_refused_before_the_body(app: Application) -> None:
    sent = _call(app, [(b"content-length", b"4294967296")], [])
    assert sent[0]["status"] == 413


@pytest.mark.parametrize("length", [b"x", b"-1", b"1e9"])
def test_a_length_must_be_a_number(app: Application, length: bytes) -> None:
    assert _call(app, [(b"content-length", length)], [])[0]["status"] == 400


def test_an_undeclared_body_is_cut_off_at_the_limit(make_app: MakeApp) -> None:
    app = make_app(max_body=1000)
    pieces = [{"type": "http.request", "body": b"x" * 400, "more_body": True}] * 10
    sent = _call(app, [(b"transfer-encoding", b"chunked")], pieces)
    assert sent[0]["status"] == 413
    assert (b"connection", b"close") in sent[0]["headers"]
    assert app.service.memory.used == 0


def test_a_body_that_does_not_arrive_times_out(make_app: MakeApp) -> None:
    app = make_app(upload_timeout=0.1)
    sent = _call(app, [(b"content-length", b"100")], [{"type": "http.request", "body": b"x", "more_body": True}])
    assert sent[0]["status"] == 408
    assert app.service.memory.used == 0


def test_without_room_a_body_is_dropped_as_it_comes(app: Application) -> None:
    app.service.admission.enter(64)
    pieces = [{"type": "http.request", "body": b"x" * 500, "more_body": index < 9} for index in range(10)]
    sent = _call(app, [(b"content-length", b"5000")], pieces)
    assert sent[0]["status"] == 503
    headers = dict(sent[0]["headers"])
    assert int(headers[b"retry-after"]) >= 1
    assert b"connection" not in headers  # it can be used again
    text = app.service.metrics.text().decode()
    assert 'trilitenet_requests_total{method="POST",route="/v1/predict",status="503"} 1.0' in text
    assert 'trilitenet_rejects_total{reason="queue_full"} 1.0' in text


def test_without_room_a_client_that_asks_first_is_answered_first(app: Application) -> None:
    app.service.admission.enter(64)
    pieces = [{"type": "http.disconnect"}]
    sent = _call(app, [(b"content-length", b"5000"), (b"expect", b"100-continue")], pieces)
    assert sent[0]["status"] == 503
    assert (b"connection", b"close") in sent[0]["headers"]


def test_a_client_that_vanishes_while_sending_holds_nothing(app: Application) -> None:
    sent = _call(app, [(b"content-length", b"100")], [{"type": "http.disconnect"}])
    assert sent[0]["status"] == 499
    assert app.service.memory.used == app.service.admission.taken == 0
    assert "trilitenet_vanished_total 1.0" in app.service.metrics.text().decode()


def test_a_client_that_vanishes_while_waiting_leaves_the_queue(
    app: Application, backend: FakeBackend, jpeg: bytes
) -> None:
    pieces: list[dict[str, Any]] = [
        {"type": "http.request", "body": jpeg, "more_body": False},
        {"type": "http.disconnect"},
    ]
    backend.gate.set()

    async def run() -> None:
        await app.service.start()
        backend.gate.clear()
        sent = await _request(app, [(b"content-length", b"%d" % len(jpeg))], pieces)
        assert sent[0]["status"] == 499
        assert app.service.memory.used == app.service.admission.taken == 0
        backend.gate.set()
        await app.service.stop()

    asyncio.run(run())


def test_an_answer_is_held_in_the_memory_budget_until_it_is_read(app: Application) -> None:
    data = encode(np.random.default_rng(0).integers(0, 256, (400, 400, 3), np.uint8), "PNG")
    pieces = [{"type": "http.request", "body": data, "more_body": False}]
    held: list[tuple[int, int]] = []

    def on_send(message: dict[str, Any]) -> None:
        held.append((len(message.get("body", b"")), app.service.memory.used))

    async def run() -> None:
        await app.service.start()
        headers = [(b"content-length", b"%d" % len(data)), (b"accept", b"image/png")]
        await _request(app, headers, pieces, b"format=overlay", on_send)
        await app.service.stop()

    asyncio.run(run())
    _, (size, meanwhile), (last, afterwards) = held
    # The server takes the last, empty piece only when the client has read the one before.
    assert size > 2**16
    assert (last, meanwhile, afterwards) == (0, size, size)
    assert app.service.memory.used == 0


def test_the_log_names_requests_and_nothing_of_their_content(
    client: TestClient, jpeg: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="trilitenet.server"):
        client.post("/v1/predict", files={"image": ("secret.jpg", jpeg)}, headers={"x-request-id": "one"})
        client.post("/v1/predict", content=b"secret")
        client.post("/v1/predict?token=secret", content=jpeg)
    first, second, third = [record for record in caplog.records if record.message == "request"]
    fields = {"request_id": "one", "method": "POST", "route": "/v1/predict", "status": 200}
    assert fields.items() <= first.__dict__.items()
    assert second.__dict__["problem"] == "unsupported_type"
    assert third.__dict__["problem"] == "bad_parameter"
    assert "secret" not in repr([record.__dict__ for record in caplog.records])


def _call(app: Application, headers: list[tuple[bytes, bytes]], pieces: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return asyncio.run(_request(app, headers, pieces))


async def _request(
    app: Application,
    headers: list[tuple[bytes, bytes]],
    pieces: list[dict[str, Any]],
    query: bytes = b"",
    on_send: Callable[[dict[str, Any]], None] = lambda message: None,
) -> list[dict[str, Any]]:
    """Send one request piece by piece; after the last, the client is silent."""
    left = list(pieces)
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        if not left:
            await asyncio.sleep(30)
        return left.pop(0)

    async def send(message: Any) -> None:
        on_send(message)
        sent.append(dict(message))

    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "POST",
        "scheme": "http",
        "path": "/v1/predict",
        "raw_path": b"/v1/predict",
        "root_path": "",
        "query_string": query,
        "headers": [(b"host", b"x"), *headers],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 2),
        "state": {},
    }
    await app(scope, receive, send)
    return sent
