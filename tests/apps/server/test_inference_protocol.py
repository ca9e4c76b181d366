from __future__ import annotations

import base64
import contextlib
import io
import json
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image
from starlette.testclient import TestClient

from tests.apps.server.conftest import FakeBackend, MakeApp, Running, encode, picture
from trilitenet.apps.server.application import Application, create_app
from trilitenet.apps.server.inference_protocol import _base64, _boxes, _parse
from trilitenet.apps.server.problems import ProblemError
from trilitenet.apps.server.settings import Settings
from trilitenet.config import ArtefactInfo
from trilitenet.inference.predictor import Predictor
from trilitenet.structures import Boxes, Perception


def test_tritons_client_gets_right_answers(app: Application, run_app: Callable[[Application], Running]) -> None:
    triton = pytest.importorskip("tritonclient.http", reason="tritonclient is not installed")
    running = run_app(app)
    client = triton.InferenceServerClient(f"127.0.0.1:{running.port}", concurrency=2)
    try:
        assert client.is_server_live()
        assert client.is_server_ready()
        assert client.is_model_ready("tiny")
        assert client.get_server_metadata()["name"] == "trilitenet"
        metadata = client.get_model_metadata("tiny", "1")
        assert [output["name"] for output in metadata["outputs"]] == ["boxes", "drivable", "lane"]
        pixels = np.stack([picture(80, 60), picture(80, 60)[:, ::-1]])
        expected = [app.service.predictor(image) for image in pixels]
        for binary in (True, False):
            tensor = triton.InferInput("image", list(pixels.shape), "UINT8")
            tensor.set_data_from_numpy(np.ascontiguousarray(pixels), binary_data=binary)
            outputs = [triton.InferRequestedOutput(name, binary_data=binary) for name in ("boxes", "drivable", "lane")]
            result = client.infer("tiny", [tensor], outputs=outputs, request_id="seven")
            assert result.get_response()["id"] == "seven"
            for index, seen in enumerate(expected):
                assert seen.boxes is not None
                np.testing.assert_array_equal(result.as_numpy("boxes")[index, :, :4], seen.boxes.xyxy)
                np.testing.assert_array_equal(result.as_numpy("boxes")[index, :, 4], seen.boxes.confidence)
                np.testing.assert_array_equal(result.as_numpy("drivable")[index], seen.drivable)
                np.testing.assert_array_equal(result.as_numpy("lane")[index], seen.lane)
        # Encoded images in BYTES, and the default outputs.
        file = encode(picture(80, 60), "PNG")
        tensor = triton.InferInput("image", [1], "BYTES")
        tensor.set_data_from_numpy(np.array([file], dtype=np.object_))
        result = client.infer("tiny", [tensor])
        np.testing.assert_array_equal(result.as_numpy("lane")[0], expected[0].lane)
        with pytest.raises(triton.InferenceServerException, match="there is no model 'other'"):
            client.infer("other", [tensor])
        # What the client sends by itself is passed over, and a parameter of ours reaches the boxes.
        own = {"sequence_id": 3, "sequence_start": True, "sequence_end": True, "priority": 1, "timeout": 9}
        counts = [
            client.infer("tiny", [tensor], parameters={"confidence": value}, **own).as_numpy("boxes").shape[1]
            for value in (0.05, 0.3, 0.6, 1)
        ]
        assert counts == [3, 2, 1, 0]
        job = client.async_infer("tiny", [tensor])
        np.testing.assert_array_equal(job.get_result().as_numpy("drivable")[0], expected[0].drivable)
    finally:
        client.close()


def _tensor(**changes: Any) -> dict[str, Any]:
    tensor = {"name": "image", "datatype": "UINT8", "shape": [1, 2, 2, 3], "data": [7] * 12}
    return {"inputs": [{**tensor, **changes}]}


def test_plain_json_works(client: TestClient) -> None:
    answer = client.post("/v2/models/tiny/infer", json={**_tensor(), "outputs": [{"name": "lane"}]})
    (output,) = answer.json()["outputs"]
    assert output == {"name": "lane", "datatype": "UINT8", "shape": [1, 2, 2], "data": [0, 0, 0, 0]}
    nested = client.post("/v2/models/tiny/infer", json=_tensor(data=np.full((1, 2, 2, 3), 7).tolist()))
    assert len(nested.json()["outputs"]) == 3
    text = base64.b64encode(encode(picture(32, 32))).decode()
    files = client.post("/v2/models/tiny/infer", json=_tensor(datatype="BYTES", shape=[1], data=[text]))
    assert files.json()["outputs"][1]["shape"] == [1, 32, 32]


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        ("not json", 400, "not JSON"),
        ("[" * 100_000, 400, "not JSON"),
        ("[]", 400, "not a JSON object"),
        ("{}", 400, "inputs must hold one"),
        (_tensor(name="x"), 400, "unknown input 'x'"),
        (_tensor(shape=[1, 2, 2]), 400, "must be"),
        (_tensor(shape=[1, 2, 2, -3]), 400, "positive"),
        (_tensor(shape=[1, 2, 2, True]), 400, "positive"),
        (_tensor(shape=[2, 2, 2, 3]), 400, "fill"),
        (_tensor(shape=[999, 2, 2, 3]), 413, "at most"),
        (_tensor(shape=[1, 99999, 99999, 3]), 413, "pixels"),
        (_tensor(data=[256] * 12), 400, "0 to 255"),
        (_tensor(data=["a"] * 12), 400, "0 to 255"),
        (_tensor(data=[0.5] * 12), 400, "0 to 255"),
        (_tensor(data=[[1], [2, 3]]), 400, "fill"),
        (_tensor(data=[[1], 2]), 400, "fill"),
        (_tensor(data=[1, [2]]), 400, "fill"),
        (_tensor(data=[[]] * 12), 400, "fill"),
        (_tensor(data=[[7] * 5, [7] * 7]), 400, "fill"),
        (_tensor(data=[-1] * 12), 400, "0 to 255"),
        (_tensor(data=[10**19] * 12), 400, "0 to 255"),
        (_tensor(data=[10**20] * 12), 400, "20 digits"),
        (_tensor(data=[True] * 12), 400, "0 to 255"),
        (_tensor(data=None), 400, "0 to 255"),
        (_tensor(datatype="FP32"), 400, "datatype"),
        (_tensor(datatype="BYTES", shape=[1], data=["%%%"]), 400, "base64"),
        (_tensor(datatype="BYTES", shape=[1], data=["aGVsbG8="]), 415, "not a JPEG"),
        (_tensor(parameters={"binary_data_size": 3}), 400, "3, 0 bytes came"),
        (_tensor(parameters={"binary_data_size": "\ud800"}), 400, "'\\ud800', 0 bytes came"),
        ({**_tensor(), "outputs": [{"name": "x"}]}, 400, "unknown output 'x'"),
        ({**_tensor(), "outputs": [{"name": "boxes", "parameters": 5}]}, 400, "of an output must be an object"),
        ({**_tensor(), "outputs": [{"name": "boxes", "parameters": []}]}, 400, "of an output must be an object"),
        ({**_tensor(), "id": 3}, 400, "id must be"),
        ({**_tensor(), "parameters": 5}, 400, "of a request must be an object"),
        ({**_tensor(), "parameters": []}, 400, "of a request must be an object"),
        ({**_tensor(), "parameters": False}, 400, "of a request must be an object"),
        (
            {**_tensor(), "parameters": {"confidense": 0.5}},
            400,
            "unknown parameter 'confidense'; did you mean 'confidence'?",
        ),
    ],
)
def test_malformed_requests_are_refused(client: TestClient, body: Any, status: int, message: str) -> None:
    content = body if isinstance(body, str) else json.dumps(body)
    answer = client.post("/v2/models/tiny/infer", content=content)
    assert answer.status_code == status
    assert message in answer.json()["error"]


@pytest.mark.parametrize("value", [-0.1, 1.5, True, "0.5", [], float("nan")])
def test_a_confidence_that_is_none_is_refused(client: TestClient, value: Any) -> None:
    body = {**_tensor(), "parameters": {"confidence": value}}
    answer = client.post("/v2/models/tiny/infer", content=json.dumps(body))
    assert answer.status_code == 400
    assert "confidence must be a number from 0 to 1" in answer.json()["error"]


@pytest.mark.parametrize("length", ["5", "x", "-1", "0" * 20 + "9" * 4400])
def test_a_wrong_header_length_is_refused(client: TestClient, length: str) -> None:
    answer = client.post("/v2/models/tiny/infer", content="{}", headers={"inference-header-content-length": length})
    assert answer.status_code == 400


@pytest.mark.parametrize("data", [b"\x01", b"\x09\x00\x00\x00abc"])
def test_binary_strings_that_end_early_are_refused(client: TestClient, data: bytes) -> None:
    tensor = _tensor(datatype="BYTES", shape=[1], data=None, parameters={"binary_data_size": len(data)})
    head = json.dumps(tensor).encode()
    headers = {"inference-header-content-length": str(len(head))}
    answer = client.post("/v2/models/tiny/infer", content=head + data, headers=headers)
    assert answer.status_code == 400
    assert "ends early" in answer.json()["error"]


def test_many_empty_files_are_refused_before_they_are_split(client: TestClient) -> None:
    head = json.dumps(_tensor(datatype="BYTES", data=None, parameters={"binary_data_size": 4000})).encode()
    headers = {"inference-header-content-length": str(len(head))}
    answer = client.post("/v2/models/tiny/infer", content=head + bytes(4000), headers=headers)
    assert answer.status_code == 400
    assert "more than 16 encoded images" in answer.json()["error"]


def test_other_models_and_versions_are_unknown(client: TestClient) -> None:
    assert client.get("/v2/models/other").status_code == 404
    assert client.get("/v2/models/tiny/versions/2/ready").status_code == 404
    assert client.get("/v2/models/tiny/versions/1/ready").json()["ready"] is True


def test_a_full_queue_is_told_in_the_protocols_form(make_app: MakeApp) -> None:
    app = make_app(queue=1, max_images=1)
    with TestClient(app) as client, app.service.admit(1):
        answer = client.post("/v2/models/tiny/infer", json=_tensor())
    assert answer.status_code == 503
    assert int(answer.headers["retry-after"]) >= 1
    assert "places are taken" in answer.json()["error"]


def _file(width: int, height: int) -> dict[str, Any]:
    encoded = base64.b64encode(encode(np.zeros((height, width, 3), np.uint8), "PNG")).decode()
    return _tensor(datatype="BYTES", shape=[1], data=[encoded])


def test_masks_as_json_have_a_largest_size(client: TestClient) -> None:
    request = _file(2001, 2000)
    answer = client.post("/v2/models/tiny/infer", json=request)
    assert answer.status_code == 413
    assert "ask for binary_data" in answer.json()["error"]
    binary = client.post("/v2/models/tiny/infer", json={**request, "parameters": {"binary_data_output": True}})
    boxes = client.post("/v2/models/tiny/infer", json={**request, "outputs": [{"name": "boxes"}]})
    assert binary.status_code == boxes.status_code == 200
    assert len(binary.content) > 2 * 2001 * 2000


def test_masks_as_json_are_zeros_and_ones(client: TestClient, app: Application) -> None:
    pixels = picture(80, 60)
    request = _tensor(shape=[1, 60, 80, 3], data=pixels.tolist())
    outputs = {
        output["name"]: output for output in client.post("/v2/models/tiny/infer", json=request).json()["outputs"]
    }
    seen = app.service.predictor(pixels)
    for name, mask in (("drivable", seen.drivable), ("lane", seen.lane)):
        assert mask is not None
        assert outputs[name]["shape"] == [1, 60, 80]
        assert outputs[name]["data"] == mask.astype(int).ravel().tolist()


@pytest.mark.parametrize(
    ("value", "count", "message"),
    [
        (b"1", 1_500_000, "1,500,000 values"),
        (b"[]", 400_000, "400,000 lists"),
        (b"{}", 400_000, "400,000 lists"),
        (b'{"":1}', 5_000, "5,000 texts and names"),
    ],
)
def test_json_of_too_many_values_is_refused_unparsed(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, value: bytes, count: int, message: str
) -> None:
    body = b'{"inputs":[' + b",".join([value] * count) + b"]}"
    monkeypatch.setattr("trilitenet.apps.server.inference_protocol._parse", None)
    answer = client.post("/v2/models/tiny/infer", content=body)
    assert answer.status_code == 413
    assert message in answer.json()["error"]


def _longest_pause(work: Callable[[], Any]) -> float:
    """Run something in a thread; the longest time that others had to wait, as a share of the whole."""
    thread = threading.Thread(target=work)
    longest, start = 0.0, time.perf_counter()
    thread.start()
    last = start
    while thread.is_alive():
        time.sleep(0.001)
        now = time.perf_counter()
        longest, last = max(longest, now - last), now
    return longest / (last - start)


@pytest.mark.parametrize("value", [b"0.1234567891", b"123"])
def test_numbers_are_parsed_while_others_get_their_turn(value: bytes) -> None:
    data = b",".join([value] * 300_000)
    body = b'{"inputs":[{"name":"image","datatype":"UINT8","shape":[1,250,400,3],"data":[' + data + b"]}]}"

    def parse() -> None:
        with contextlib.suppress(ProblemError):
            _parse(body, len(body), ["boxes"], Settings())

    # The best of five, because other work on the machine makes pauses too.
    assert min(_longest_pause(parse) for _ in range(5)) < 0.25


def test_base64_is_decoded_while_others_get_their_turn() -> None:
    image = bytes(range(256)) * 32_768
    texts = [base64.b64encode(image).decode()]
    assert _base64(texts) == [image]
    assert min(_longest_pause(lambda: _base64(texts)) for _ in range(5)) < 0.5


def test_pixels_as_numbers_fit_up_to_640_x_480(client: TestClient) -> None:
    request = _tensor(shape=[1, 480, 640, 3], data=np.zeros((480, 640, 3), int).tolist())
    request["outputs"] = [{"name": "boxes"}]
    assert client.post("/v2/models/tiny/infer", json=request).status_code == 200


def test_what_is_parsed_is_paid_for_and_has_a_place(
    client: TestClient, app: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    def parse(body: bytes, *_: Any) -> Any:
        assert app.service.admission.taken == 1
        assert app.service.memory.used > 64 * body.count(b",") + 256 * body.count(b"[")
        raise ProblemError(400, "seen", "seen")

    monkeypatch.setattr("trilitenet.apps.server.inference_protocol._parse", parse)
    assert client.post("/v2/models/tiny/infer", json=_tensor()).json()["error"] == "seen"
    assert app.service.memory.used == app.service.admission.taken == 0


def test_an_answer_is_written_within_the_deadline(make_app: MakeApp, monkeypatch: pytest.MonkeyPatch) -> None:
    app = make_app(deadline=0.3)
    done = threading.Event()
    monkeypatch.setattr("trilitenet.apps.server.inference_protocol._answer", lambda *_: done.wait(20))
    with TestClient(app) as client:
        answer = client.post("/v2/models/tiny/infer", json=_tensor())
        done.set()
    assert answer.status_code == 503


def test_texts_in_place_of_numbers_take_no_more_than_they_are_long(client: TestClient) -> None:
    # As an array of texts these would take 4,000 x 1,000,000 x 4 bytes.
    request = _tensor(data=["a" * 1_000_000] + [""] * 4_000)
    answer = client.post("/v2/models/tiny/infer", json=request)
    assert answer.status_code == 400
    assert "0 to 255" in answer.json()["error"]


def test_several_images_take_as_many_places(make_app: MakeApp) -> None:
    app = make_app(queue=2, max_images=2)
    request = _tensor(shape=[2, 2, 2, 3], data=[0] * 24)
    with TestClient(app) as client:
        assert client.post("/v2/models/tiny/infer", json=request).status_code == 200
        with app.service.admit(1):
            assert client.post("/v2/models/tiny/infer", json=request).status_code == 503
    assert app.service.admission.taken == 0


def _binary(shape: list[int], data: bytes, datatype: str = "UINT8", **more: Any) -> dict[str, Any]:
    """What `TestClient.post` takes for a request whose tensor comes behind the JSON."""
    tensor = {"name": "image", "datatype": datatype, "shape": shape, "parameters": {"binary_data_size": len(data)}}
    head = json.dumps({"inputs": [tensor], **more}).encode()
    return {"content": head + data, "headers": {"inference-header-content-length": str(len(head))}}


def test_the_images_of_a_request_are_paid_for(make_app: MakeApp) -> None:
    with TestClient(make_app(memory=226_000, max_body=100_000, max_pixels=2000)) as client:
        for count, status in ((4, 200), (16, 413)):  # 10 bytes a pixel: 80 kB, and 320 kB, beside the body
            request = _binary([count, 40, 50, 3], bytes(count * 6000))
            answer = client.post("/v2/models/tiny/infer", **request)
            assert answer.status_code == status
    assert "memory" in answer.json()["error"]


def test_what_follows_the_json_is_paid_for_twice(make_app: MakeApp, jpeg: bytes) -> None:
    film = jpeg + bytes(60_000)  # few pixels, many bytes
    request = _binary([1], struct.pack("<I", len(film)) + film, "BYTES")
    app = make_app(memory=300_000, max_body=100_000, max_pixels=7_000)
    with TestClient(app) as client:
        for taken, status in ((120_000, 200), (180_000, 503)):  # by others; once would fit beside either
            app.service.memory.take(taken)
            assert client.post("/v2/models/tiny/infer", **request).status_code == status
            app.service.memory.give(taken)


def test_as_many_images_as_are_taken_at_once(client: TestClient) -> None:
    for count, status in ((16, 200), (17, 413)):
        request = _binary([count, 2, 2, 3], bytes(count * 12))
        assert client.post("/v2/models/tiny/infer", **request).status_code == status


def test_what_may_be_left_out_or_said_twice(client: TestClient) -> None:
    body = json.dumps({**_tensor(), "outputs": []}).encode()
    whole = client.post(
        "/v2/models/tiny/infer", content=body, headers={"inference-header-content-length": str(len(body))}
    )
    assert [output["name"] for output in whole.json()["outputs"]] == ["boxes", "drivable", "lane"]
    asked = {**_tensor(), "parameters": {"binary_data_output": True}, "outputs": [{"name": "lane"}]}
    lane = client.post("/v2/models/tiny/infer", json=asked)
    assert lane.headers["content-type"] == "application/octet-stream"
    assert lane.content[int(lane.headers["inference-header-content-length"]) :] == bytes(4)
    column = {**_file(32, 32)}
    column["inputs"][0]["shape"] = [1, 1]
    assert client.post("/v2/models/tiny/infer", json=column).status_code == 200


@pytest.mark.parametrize(("turned", "message"), [(False, "must have one size"), (True, "after their EXIF rotation")])
def test_images_of_two_sizes_do_not_go_together(client: TestClient, turned: bool, message: str) -> None:
    size = (40, 30) if turned else (30, 40)
    image = Image.fromarray(np.zeros((*size, 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", **({"exif": exif} if turned else {}))
    files = [encode(np.zeros((40, 30, 3), np.uint8)), buffer.getvalue()]
    texts = [base64.b64encode(file).decode() for file in files]
    answer = client.post("/v2/models/tiny/infer", json=_tensor(datatype="BYTES", shape=[2], data=texts))
    assert answer.status_code == 400
    assert message in answer.json()["error"]


def test_fewer_boxes_are_filled_up() -> None:
    box = Boxes(np.array([[1, 2, 3, 4]], np.float32), np.array([0.5], np.float32), np.array([0]))
    rows = _boxes([Perception((9, 9), boxes=box), Perception((9, 9), boxes=Boxes.empty())])
    assert rows.tolist() == [[[1, 2, 3, 4, 0.5, 0]], [[-1] * 6]]


def test_confidence_replaces_the_threshold(client: TestClient) -> None:
    def count(**asked: Any) -> int:
        answer = client.post("/v2/models/tiny/infer", json={**_file(64, 48), **asked})
        return int(answer.json()["outputs"][0]["shape"][1])

    parameters: list[dict[str, Any]] = [{}, {"confidence": None}, {"confidence": 0.05}, {"confidence": 0.6}]
    assert [count(parameters=each) for each in parameters] == [2, 2, 3, 1]
    assert count(parameters=None) == 2


def test_a_confidence_that_the_artefact_cannot_give_is_refused(backend: FakeBackend) -> None:
    backend.info = ArtefactInfo("onnx", nms=True)  # type: ignore[attr-defined]
    with TestClient(create_app(Predictor(backend), "tiny")) as client:
        answer = client.post("/v2/models/tiny/infer", json={**_tensor(), "parameters": {"confidence": 0.01}})
    assert answer.status_code == 422
    assert "drops boxes below" in answer.json()["error"]


def test_extensions_that_are_not_there_are_refused(client: TestClient) -> None:
    asked = {**_tensor(), "outputs": [{"name": "boxes", "parameters": {"classification": 3}}]}
    answer = client.post("/v2/models/tiny/infer", json=asked)
    assert answer.status_code == 400
    assert "classification extension" in answer.json()["error"]


def test_the_protocols_probes_follow_the_life_of_the_service(app: Application) -> None:
    client = TestClient(app)
    assert (client.get("/v2/health/live").status_code, client.get("/v2/health/ready").status_code) == (200, 503)
    with client:
        assert client.get("/v2/health/ready").json() == {"ready": True}
    assert (client.get("/v2/health/live").status_code, client.get("/v2/health/ready").status_code) == (503, 503)
