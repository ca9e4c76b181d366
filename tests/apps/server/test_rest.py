from __future__ import annotations

import asyncio
import dataclasses
import gc
import io
import json
import threading
import time
import weakref
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from starlette.testclient import TestClient

from tests.apps.server.conftest import TOKEN, FakeBackend, MakeApp, encode, picture
from trilitenet.apps.server.application import Application, create_app
from trilitenet.apps.server.guard import PUBLIC_PATHS
from trilitenet.apps.server.intake import Header, Reservation, read_header
from trilitenet.apps.server.openapi import BatchPrediction, Prediction, ProtocolErrorAnswer
from trilitenet.config import ArtefactInfo
from trilitenet.inference.predictor import Predictor
from trilitenet.processing.drawing import DRIVABLE_COLOUR, LANE_COLOUR
from trilitenet.processing.ego_mask import EgoMask
from trilitenet.structures import Perception, RawOutputs


def test_predict_takes_a_body_or_a_form_and_answers_alike(client: TestClient, jpeg: bytes) -> None:
    body = client.post("/v1/predict", content=jpeg, headers={"content-type": "image/jpeg"})
    form = client.post("/v1/predict", files={"image": ("../../etc/passwd", jpeg, "text/plain")})
    assert body.status_code == form.status_code == 200
    assert body.json()["perception"] == form.json()["perception"]


def test_predict_agrees_with_the_predictor(client: TestClient, app: Application) -> None:
    pixels = picture(80, 60)
    answer = client.post("/v1/predict", content=encode(pixels, "PNG")).json()
    Prediction.model_validate(answer)
    assert answer["perception"] == app.service.predictor(pixels).to_dict()
    assert answer["model"] == "tiny"
    assert {"decode", "preprocess", "queue", "network", "postprocess"} == set(answer["milliseconds"])
    seen = Perception.from_dict(answer["perception"])
    assert seen.drivable is not None
    assert seen.drivable[-1].all()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_formats_are_told_by_their_bytes(client: TestClient, kind: str) -> None:
    data = encode(picture(), kind)
    answer = client.post("/v1/predict", content=data, headers={"content-type": "application/x-nonsense"})
    assert answer.status_code == 200
    assert answer.json()["perception"]["size"] == {"height": 48, "width": 64}


def test_exif_rotation_is_applied(client: TestClient) -> None:
    image = Image.fromarray(picture(64, 48))
    exif = image.getexif()
    exif[0x0112] = 6
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", exif=exif)
    answer = client.post("/v1/predict", content=buffer.getvalue()).json()
    assert answer["perception"]["size"] == {"height": 64, "width": 48}


def test_confidence_replaces_the_threshold(client: TestClient, jpeg: bytes) -> None:
    def count(query: str) -> int:
        return len(client.post(f"/v1/predict{query}", content=jpeg).json()["perception"]["boxes"])

    assert [count(""), count("?confidence=0.05"), count("?confidence=0.6")] == [2, 3, 1]


def test_a_confidence_that_the_artefact_cannot_give_is_refused(backend: FakeBackend, jpeg: bytes) -> None:
    backend.info = ArtefactInfo("onnx", nms=True)  # type: ignore[attr-defined]
    least = backend.card.thresholds.confidence
    with TestClient(create_app(Predictor(backend), "tiny")) as client:
        assert client.get("/v1/models").json()["models"][0]["least_confidence"] == least
        assert client.post(f"/v1/predict?confidence={least}", content=jpeg).status_code == 200
        answer = client.post("/v1/predict?confidence=0.01", content=jpeg)
    assert answer.status_code == 422
    assert answer.json()["error"]["code"] == "confidence_too_low"


def test_nothing_is_found_on_an_ego_mask_and_other_shapes_are_refused(backend: FakeBackend, jpeg: bytes) -> None:
    own = np.zeros((48, 64), np.bool_)
    own[30:] = True
    with TestClient(create_app(Predictor(backend, ego_mask=EgoMask(own)), "tiny")) as client:
        for query in ("", "?confidence=0.05"):
            answer = client.post(f"/v1/predict{query}", content=jpeg).json()["perception"]
            drivable = Perception.from_dict(answer).drivable
            assert drivable is not None
            assert drivable[:30].any()
            assert not drivable[30:].any()
        upright = encode(picture(48, 64))
        answer = client.post("/v1/predict", content=upright)
        assert (answer.status_code, answer.json()["error"]["code"]) == (422, "wrong_shape")
        assert "the ego mask is of 64x48 pixels, the picture of 48x64" in answer.json()["error"]["message"]
        files = [("images", ("a.jpg", jpeg)), ("images", ("b.jpg", upright))]
        results = client.post("/v1/predict/batch", files=files).json()["results"]
        assert [each["status"] for each in results] == [200, 422]


def test_overlay_is_the_picture_with_everything_drawn(client: TestClient, app: Application) -> None:
    pixels = picture(80, 60)
    answer = client.post("/v1/predict?format=overlay", content=encode(pixels, "PNG"), headers={"accept": "image/png"})
    assert answer.headers["content-type"] == "image/png"
    drawn = np.asarray(Image.open(io.BytesIO(answer.content)))
    np.testing.assert_array_equal(drawn, app.service.predictor(pixels).draw())
    assert "network;dur=" in answer.headers["server-timing"]
    jpeg = client.post("/v1/predict?format=overlay", content=encode(pixels, "PNG"))
    assert jpeg.headers["content-type"] == "image/jpeg"
    assert Image.open(io.BytesIO(jpeg.content)).size == (80, 60)


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("image/PNG", "png"),
        ("image/webp, image/png;q=0.5, */*;q=0.1", "png"),
        ("image/png; q=0", "jpeg"),
        ("image/png;q=0.00, */*", "jpeg"),
        ("*/*", "jpeg"),
        ("image/pngx, ;;,", "jpeg"),
    ],
)
def test_an_overlay_is_png_where_the_client_asks_for_it(
    client: TestClient, jpeg: bytes, accept: str, kind: str
) -> None:
    answer = client.post("/v1/predict?format=overlay", content=jpeg, headers={"accept": accept})
    assert answer.headers["content-type"] == f"image/{kind}"


def test_masks_are_one_palette_picture(client: TestClient, app: Application) -> None:
    pixels = picture(80, 60)
    answer = client.post("/v1/predict?format=masks", content=encode(pixels, "PNG"))
    image = Image.open(io.BytesIO(answer.content))
    assert image.mode == "P"
    values = np.asarray(image)
    seen = app.service.predictor(pixels)
    np.testing.assert_array_equal(values & 1 > 0, seen.drivable)
    np.testing.assert_array_equal(values & 2 > 0, seen.lane)
    assert set(np.unique(values)) == {0, 1, 2, 3}
    assert (image.getpalette() or [])[:9] == [0, 0, 0, *DRIVABLE_COLOUR, *LANE_COLOUR]


def test_a_batch_gives_each_image_its_own_status(client: TestClient, jpeg: bytes, backend: FakeBackend) -> None:
    files = [
        ("images", ("a", jpeg)),
        ("images", ("b", b"no image")),
        ("images", ("c", encode(picture(32, 64), "PNG"))),
        ("images", ("d", jpeg[:-30])),
    ]
    answer = client.post("/v1/predict/batch", files=files)
    assert answer.status_code == 200
    BatchPrediction.model_validate(answer.json())
    results = answer.json()["results"]
    assert [result["status"] for result in results] == [200, 415, 200, 422]
    assert results[2]["perception"]["size"] == {"height": 64, "width": 32}


def test_the_headers_of_a_batch_leave_others_their_turn(
    client: TestClient, jpeg: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    others: list[int] = []
    meanwhile: list[int] = []

    def look(data: bytes) -> Header:
        meanwhile.append(len(others))
        asyncio.get_running_loop().call_soon(others.append, 1)
        return read_header(data)

    monkeypatch.setattr("trilitenet.apps.server.rest.read_header", look)
    files = [("images", (f"{index}.jpg", jpeg)) for index in range(4)]
    assert client.post("/v1/predict/batch", files=files).status_code == 200
    assert meanwhile == [0, 1, 2, 3]


def test_a_batch_has_a_largest_size(make_app: MakeApp, jpeg: bytes) -> None:
    with TestClient(make_app(max_images=2)) as client:
        answer = client.post("/v1/predict/batch", files=[("images", ("a", jpeg))] * 3)
    assert answer.status_code == 413


@pytest.mark.parametrize(
    ("content", "headers", "status", "code"),
    [
        (b"", {}, 400, "empty"),
        (b"hello", {}, 415, "unsupported_type"),
        (b"GIF89a" + bytes(100), {"content-type": "image/jpeg"}, 415, "unsupported_type"),
        (encode(picture())[:200], {}, 422, "broken_image"),
        (b"--x\r\n", {"content-type": "multipart/form-data"}, 400, "bad_form"),
        (b"--x--\r\n", {"content-type": "multipart/form-data; boundary=x"}, 400, "empty"),
        (
            b'--x\r\nContent-Disposition: form-data; name="file"\r\n\r\nhello\r\n--x--\r\n',
            {"content-type": "multipart/form-data; boundary=x"},
            400,
            "unknown_field",
        ),
        (b"x", {"content-encoding": "gzip"}, 415, "content_encoding"),
        (b"x", {"sec-fetch-site": "cross-site"}, 403, "cross_site"),
    ],
)
def test_refusals_have_one_form(
    client: TestClient, content: bytes, headers: dict[str, str], status: int, code: str
) -> None:
    answer = client.post("/v1/predict", content=content, headers=headers)
    assert answer.status_code == status
    error = answer.json()["error"]
    assert error["code"] == code
    assert error["request_id"] == answer.headers["x-request-id"]


@pytest.mark.parametrize("query", ["?confidence=2", "?confidence=x", "?format=exe"])
def test_bad_parameters_are_named(client: TestClient, jpeg: bytes, query: str) -> None:
    answer = client.post(f"/v1/predict{query}", content=jpeg)
    assert answer.status_code == 422
    assert answer.json()["error"]["message"].startswith(query[1:].split("=")[0])


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("?confidenc=0.5", "unknown parameter 'confidenc'; did you mean 'confidence'?"),
        ("/batch?format=overlay", "unknown parameter 'format'; known: confidence"),
        ("?format=json&confidence=0.3&format=masks", "format is given 2 times: give it once"),
        ("/batch?confidence=0.3&confidence=0.3", "confidence is given 2 times: give it once"),
    ],
)
def test_parameters_that_are_not_known_or_given_twice_are_refused(
    client: TestClient, jpeg: bytes, path: str, message: str
) -> None:
    answer = client.post(f"/v1/predict{path}", content=jpeg)
    assert answer.status_code == 422
    assert (answer.json()["error"]["code"], answer.json()["error"]["message"]) == ("bad_parameter", message)


def test_a_form_of_one_image_says_what_is_too_much(client: TestClient, jpeg: bytes) -> None:
    image = ("image", ("a.jpg", jpeg))
    for files in ([image, ("confidence", (None, b"0.5"))], [("confidence", (None, b"0.5")), image]):
        answer = client.post("/v1/predict", files=files)
        assert answer.status_code == 400
        assert "'confidence'" in answer.json()["error"]["message"]
    answer = client.post("/v1/predict", files=[image, image])
    assert answer.status_code == 413
    assert "/v1/predict/batch" in answer.json()["error"]["message"]


def test_models_shows_the_card(client: TestClient) -> None:
    (model,) = client.get("/v1/models").json()["models"]
    assert model["name"] == "tiny"
    assert model["backend"] == "fake"
    assert model["card"]["licence"] == "MIT"
    assert (model["least_confidence"], model["max_images"]) == (0.0, 16)
    assert model["confidence"] == model["card"]["thresholds"]["confidence"]


def test_models_tells_the_limits_that_a_client_can_heed(make_app: MakeApp) -> None:
    limits = {"max_images": 3, "max_pixels": 5000, "max_side": 400, "max_body": 9000, "upload_timeout": 7.5}
    app = make_app(**limits)
    with TestClient(app) as client:
        (model,) = client.get("/v1/models").json()["models"]
    assert {name: model[name] for name in limits} == limits
    example = app.api.openapi()["paths"]["/v1/models"]["get"]["responses"]["200"]["content"]["application/json"]
    assert set(example["example"]["models"][0]) == set(model)


def test_models_tells_the_confidence_that_is_served(backend: FakeBackend) -> None:
    predictor = Predictor(backend, dataclasses.replace(backend.card.thresholds, confidence=0.6))
    with TestClient(create_app(predictor, "tiny")) as client:
        assert client.get("/v1/models").json()["models"][0]["confidence"] == 0.6


def test_probes_follow_the_life_of_the_service(app: Application) -> None:
    client = TestClient(app)
    assert client.get("/healthz").status_code == 200
    assert client.get("/readyz").status_code == 503
    with client:
        assert client.get("/readyz").status_code == 200
        app.service.draining = True
        answer = client.get("/readyz")
        assert answer.status_code == 503
        assert answer.headers["connection"] == "close"
        assert client.get("/v1/models").json()["models"][0]["ready"] is False
    assert client.get("/healthz").status_code == 503


def test_a_backend_that_does_not_come_back_is_told_to_the_probes(
    make_app: MakeApp, backend: FakeBackend, jpeg: bytes
) -> None:
    with TestClient(make_app(deadline=0.2)) as client:
        backend.gate.clear()
        assert client.post("/v1/predict", content=jpeg).json()["error"]["code"] == "deadline"
        time.sleep(0.1)  # the batch began after the image came
        assert [client.get(path).status_code for path in ("/healthz", "/readyz", "/v2/health/live")] == [503] * 3
        assert "trilitenet_ready 0.0" in client.get("/metrics").text
        backend.gate.set()
        until = time.monotonic() + 10
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < until
        assert client.get("/healthz").status_code == 200


def test_a_wrong_address_or_method_is_told_what_is_right(client: TestClient) -> None:
    nothing, method, triton = client.get("/predict"), client.get("/v1/predict"), client.get("/v2/models/tiny/config")
    assert (nothing.status_code, method.status_code, triton.status_code) == (404, 405, 404)
    assert method.headers["allow"] == "POST"
    error = method.json()["error"]
    assert (error["code"], error["message"]) == ("method_not_allowed", "this address takes POST, not GET")
    assert "/openapi.json" in nothing.json()["error"]["message"]
    assert "/openapi.json" in triton.json()["error"]


def test_a_backend_that_fails_is_an_answer_not_an_end(client: TestClient, jpeg: bytes, backend: FakeBackend) -> None:
    backend.error = RuntimeError("secret detail")
    answer = client.post("/v1/predict", content=jpeg)
    assert answer.status_code == 500
    assert "secret" not in answer.text
    backend.error = None
    assert client.post("/v1/predict", content=jpeg).status_code == 200


def test_one_image_goes_the_whole_way_before_the_service_is_ready(client: TestClient) -> None:
    text = client.get("/metrics").text
    for stage in ("decode", "preprocess", "network", "postprocess", "encode"):
        assert f'trilitenet_stage_seconds_count{{stage="{stage}"}} 1.0' in text
    assert "trilitenet_ready 1.0" in text


def test_what_alerts_look_at_begins_with_0(client: TestClient, jpeg: bytes, backend: FakeBackend) -> None:
    text = client.get("/metrics").text
    for route in ("/v1/predict", "/v1/predict/batch", "/v2/models/{model}/infer"):
        assert f'trilitenet_requests_total{{method="POST",route="{route}",status="500"}} 0.0' in text
    for reason in ("queue_full", "deadline", "internal"):
        assert f'trilitenet_rejects_total{{reason="{reason}"}} 0.0' in text
    backend.error = RuntimeError("secret detail")
    client.post("/v1/predict", content=jpeg)
    text = client.get("/metrics").text
    assert 'trilitenet_requests_total{method="POST",route="/v1/predict",status="500"} 1.0' in text
    assert 'trilitenet_rejects_total{reason="internal"} 1.0' in text


def test_metrics_count_what_happened(client: TestClient, jpeg: bytes) -> None:
    client.post("/v1/predict", content=jpeg)
    client.post("/v1/predict", content=b"no image")
    client.get("/nowhere")
    text = client.get("/metrics").text
    assert 'trilitenet_requests_total{method="POST",route="/v1/predict",status="200"} 1.0' in text
    assert 'trilitenet_requests_total{method="GET",route="other",status="404"} 1.0' in text
    assert 'trilitenet_rejects_total{reason="unsupported_type"} 1.0' in text
    for stage in ("upload", "decode", "preprocess", "queue", "network", "postprocess", "encode"):
        assert f'trilitenet_stage_seconds_count{{stage="{stage}"}}' in text
    assert 'trilitenet_stage_seconds_count{stage="upload"} 2.0' in text
    assert "trilitenet_accepted 0.0" in text
    assert "trilitenet_memory_bytes 0.0" in text


def test_the_schema_describes_every_route_with_examples(app: Application) -> None:
    schema: dict[str, Any] = app.api.openapi()
    json.dumps(schema)
    assert {"/v1/predict", "/v1/predict/batch", "/v1/models", "/healthz", "/readyz", "/metrics"} <= set(schema["paths"])
    predict = schema["paths"]["/v1/predict"]["post"]
    Prediction.model_validate(predict["responses"]["200"]["content"]["application/json"]["example"])
    batch = schema["paths"]["/v1/predict/batch"]["post"]
    BatchPrediction.model_validate(batch["responses"]["200"]["content"]["application/json"]["example"])
    taken = {"multipart/form-data", "image/jpeg", "image/png", "image/webp"}
    assert set(predict["requestBody"]["content"]) == set(batch["requestBody"]["content"]) == taken
    assert "Retry-After" in predict["responses"]["503"]["headers"]


def test_a_failure_ends_the_rest_of_a_batch(make_app: MakeApp, backend: FakeBackend, jpeg: bytes) -> None:
    plain, runs = backend.run, []

    def run(batch: NDArray[np.uint8]) -> RawOutputs:
        runs.append(len(batch))
        if len(runs) == 2:  # the first is the start's
            raise RuntimeError("broken")
        time.sleep(0.1)
        return plain(batch)

    backend.run = run  # type: ignore[method-assign]
    with TestClient(make_app(max_batch=1), raise_server_exceptions=False) as client:
        answer = client.post("/v1/predict/batch", files=[("images", ("a", jpeg))] * 12)
        assert answer.status_code == 500
        seen = len(runs)
        assert client.post("/v1/predict", content=jpeg).status_code == 200  # behind what is still in work
    assert len(runs) <= seen + 3


def test_nothing_is_kept_of_work_that_nobody_waits_for(make_app: MakeApp) -> None:
    class Body:
        """Stands for an image's bytes."""

    service, gate = make_app(threads=1).service, threading.Event()

    async def leave() -> weakref.ref[Body]:
        first = asyncio.ensure_future(service.in_pool(gate.wait))  # the one thread is busy
        body = Body()
        held = weakref.ref(body)
        second = asyncio.ensure_future(service.in_pool(print, body))
        del body
        await asyncio.sleep(0.05)
        assert held() is not None
        second.cancel()
        await asyncio.gather(second, return_exceptions=True)
        del second
        gc.collect()
        assert held() is None
        gate.set()
        assert await first
        return held

    asyncio.run(leave())


def test_a_batch_beyond_all_memory_refuses_what_does_not_fit(make_app: MakeApp) -> None:
    file = encode(picture(400, 300), "PNG")
    with TestClient(make_app(memory=3_000_000, max_body=100_000, max_pixels=200_000)) as client:
        answer = client.post("/v1/predict/batch", files=[("images", ("a", file))] * 3)
        assert [result["status"] for result in answer.json()["results"]] == [200, 200, 413]
        assert "memory" in answer.json()["results"][2]["error"]["message"]
        assert 'trilitenet_rejects_total{reason="too_much_memory"} 1.0' in client.get("/metrics").text


def test_a_batch_that_would_fit_later_is_refused_as_a_whole(make_app: MakeApp) -> None:
    app = make_app(memory=3_000_000, max_body=100_000, max_pixels=200_000)
    app.service.memory.take(1_000_000)  # by others: the first picture still fits, the second does not
    with TestClient(app) as client:
        file = encode(picture(400, 300), "PNG")
        answer = client.post("/v1/predict/batch", files=[("images", ("a", file))] * 2)
    assert answer.status_code == 503
    assert answer.json()["error"]["code"] == "memory"
    assert answer.headers["retry-after"] == "1"


def test_an_overlay_is_paid_for_beside_the_picture(
    client: TestClient, jpeg: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[int] = []
    take = Reservation.take

    def noted(self: Reservation, size: int) -> None:
        taken.append(size)
        take(self, size)

    monkeypatch.setattr(Reservation, "take", noted)
    paid = []
    for output in ("json", "overlay"):
        taken.clear()
        assert client.post(f"/v1/predict?format={output}", content=jpeg).status_code == 200
        paid.append(sum(taken))
    height, width = picture().shape[:2]
    assert paid[1] - paid[0] == 3 * height * width


def test_the_parts_of_a_form_are_paid_for_beside_it(make_app: MakeApp) -> None:
    small = encode(picture(20, 20), "PNG")
    large = small + bytes(91_500)
    with TestClient(make_app(memory=213_000, max_body=100_000, max_pixels=1000)) as client:
        files = [("images", ("a", large)), *[("images", ("b", small))] * 7]
        answer = client.post("/v1/predict/batch", files=files)
    # Twice 91.5 kB and a little, and 4 kB a picture: the last one is too much.
    assert [result["status"] for result in answer.json()["results"]][:4] == [200] * 4
    assert answer.json()["results"][-1]["error"]["code"] == "too_much_memory"


def test_a_batch_for_which_there_was_no_time_is_refused_as_a_whole(
    make_app: MakeApp, backend: FakeBackend, jpeg: bytes
) -> None:
    app = make_app(deadline=0.2)
    with TestClient(app) as client:
        backend.gate.clear()
        late = client.post("/v1/predict/batch", files=[("images", ("a", jpeg))] * 2)
        mixed = client.post("/v1/predict/batch", files=[("images", ("a", jpeg)), ("images", ("b", b"no image"))])
        backend.gate.set()
        text = client.get("/metrics").text
    assert late.status_code == 503
    assert late.json()["error"]["code"] == "deadline"
    assert late.json()["error"]["message"] == "the image waited too long; try again soon"
    assert int(late.headers["retry-after"]) >= 1
    assert [result["status"] for result in mixed.json()["results"]] == [503, 415]
    assert 'trilitenet_rejects_total{reason="deadline"} 2.0' in text
    assert 'trilitenet_rejects_total{reason="unsupported_type"} 1.0' in text


@pytest.mark.parametrize("path", ["/v1/predict", "/v1/predict/batch", "/v2/models/tiny/infer"])
def test_a_refused_image_is_not_charged_to_the_next(
    client: TestClient, app: Application, monkeypatch: pytest.MonkeyPatch, jpeg: bytes, path: str
) -> None:
    skipped: list[int] = []
    monkeypatch.setattr(app.service.admission, "skip", lambda: skipped.append(1))
    files = {"images": ("a", jpeg[:-30])}
    client.post(path, files=files) if path.startswith("/v1") else client.post(path, content=b"no JSON")
    assert skipped == [1]


def test_a_slash_too_many_leads_nowhere(client: TestClient) -> None:
    assert client.get("/v1/models/", follow_redirects=False).status_code == 404


@pytest.mark.parametrize("path", ["/docs", "/redoc"])
def test_no_page_loads_scripts_from_elsewhere(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404


def _documented(schema: dict[str, Any], path: str, method: str) -> set[str]:
    return set(schema["paths"][path][method]["responses"])


def test_the_schema_says_what_v2_answers(client: TestClient, backend: FakeBackend) -> None:
    schema = client.get("/openapi.json").json()
    infer = schema["paths"]["/v2/models/{model}/infer"]["post"]
    assert set(infer["responses"]["200"]["content"]) == {"application/json", "application/octet-stream"}
    assert "Retry-After" in infer["responses"]["503"]["headers"]
    for path, operations in schema["paths"].items():
        for operation in operations.values():
            parameters = {(one["name"], one["in"]) for one in operation.get("parameters", ())}
            assert ("version", "query") not in parameters
            for status, response in operation["responses"].items():
                text = json.dumps(response)
                if status not in {"200", "503"}:
                    assert ("ProtocolErrorAnswer" if path.startswith("/v2") else "/ErrorAnswer") in text
    assert "HTTPValidationError" not in json.dumps(schema)
    assert set(schema["paths"]["/metrics"]["get"]["responses"]["200"]["content"]) == {"text/plain"}
    for probe in ("live", "ready"):
        assert "503" in _documented(schema, f"/v2/health/{probe}", "get")
    assert {"404", "503"} <= _documented(schema, "/v2/models/{model}/versions/{version}/ready", "get")
    path = "/v2/models/{model}/infer"
    cross = client.post("/v2/models/tiny/infer", headers={"sec-fetch-site": "cross-site"})
    unknown = client.post("/v2/models/other/infer")
    backend.error = RuntimeError("no")
    tensor = {"name": "image", "datatype": "UINT8", "shape": [1, 1, 1, 3], "data": [0, 0, 0]}
    failed = client.post("/v2/models/tiny/infer", json={"inputs": [tensor]})
    assert [answer.status_code for answer in (cross, unknown, failed)] == [403, 404, 500]
    for answer in (cross, unknown, failed):
        ProtocolErrorAnswer.model_validate(answer.json())
        assert str(answer.status_code) in _documented(schema, path, "post")
        assert answer.status_code == 404 or str(answer.status_code) in _documented(schema, "/v1/predict", "post")


@pytest.mark.parametrize("token", [None, TOKEN])
def test_the_schema_says_where_the_token_is_asked_for(make_app: MakeApp, token: str | None) -> None:
    schema = make_app(token=token).api.openapi()
    expected: list[dict[str, list[str]]] = [{"bearer": []}] if token else [{}, {"bearer": []}]
    assert schema["components"]["securitySchemes"]["bearer"]["scheme"] == "bearer"
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            assert ("401" in _documented(schema, path, method)) == (path not in PUBLIC_PATHS)
            assert operation.get("security") == (None if path in PUBLIC_PATHS else expected)


def test_a_place_that_was_waited_for_in_vain_tells_how_slow_the_machine_is(
    make_app: MakeApp, backend: FakeBackend, monkeypatch: pytest.MonkeyPatch, jpeg: bytes
) -> None:
    app = make_app(deadline=0.2)
    skipped: list[int] = []
    monkeypatch.setattr(app.service.admission, "skip", lambda: skipped.append(1))
    assert app.service.admission.patience == pytest.approx(0.12)
    with TestClient(app) as client:
        backend.gate.clear()
        assert client.post("/v1/predict", content=jpeg).status_code == 503
        backend.gate.set()
    assert skipped == []


def test_milliseconds_are_milliseconds(client: TestClient, app: Application, backend: FakeBackend, jpeg: bytes) -> None:
    backend.seconds = 0.05
    assert app.service.admission.seconds_each == 0.1
    answer = client.post("/v1/predict", content=jpeg).json()
    assert 50 <= answer["milliseconds"]["network"] < 50_000
    assert app.service.admission.seconds_each != 0.1  # learned from it


def test_milliseconds_of_the_network_come_with_the_size_of_their_batch(
    make_app: MakeApp, backend: FakeBackend, jpeg: bytes
) -> None:
    app = make_app(max_batch=3)
    with TestClient(app) as client:
        app.service._batcher._delay = 10.0  # until there are three
        answer = client.post("/v1/predict/batch", files=[("images", ("a", jpeg))] * 3).json()
    assert backend.batches[-1] == 3
    assert [result["batch"] for result in answer["results"]] == [3, 3, 3]
