"""A service around a fake backend: everything but the network is real, and nothing needs PyTorch."""

from __future__ import annotations

import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from starlette.testclient import TestClient

from trilitenet.apps.server.application import Application, create_app
from trilitenet.apps.server.process import GuardedServer, build_server
from trilitenet.apps.server.settings import Settings
from trilitenet.config import ModelCard
from trilitenet.inference.predictor import Predictor
from trilitenet.structures import RawOutputs

TOKEN = "correct-horse-battery-staple"


class FakeBackend:
    """Sees two boxes at fixed places of the canvas, drivable ground below the middle, and lanes where it is white."""

    name = "fake"
    canvas = None

    def __init__(self, seconds: float = 0.0) -> None:
        self.card = ModelCard("tiny", training_data=("nothing",), licence="MIT")
        self.seconds = seconds
        self.batches: list[int] = []
        self.gate = threading.Event()
        self.gate.set()
        self.error: Exception | None = None
        self.closed = False

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        self.gate.wait(30)
        if self.error is not None:
            raise self.error
        if self.seconds:
            time.sleep(self.seconds * len(batch))
        self.batches.append(len(batch))
        count, height, width, _ = batch.shape
        detection = np.zeros((count, 3, 6), np.float32)
        detection[:, 0] = [width * 0.25, height * 0.5, width * 0.2, height * 0.2, 0.9, 1.0]
        detection[:, 1] = [width * 0.75, height * 0.5, width * 0.1, height * 0.1, 0.5, 1.0]
        detection[:, 2] = [width * 0.5, height * 0.4, width * 0.1, height * 0.1, 0.1, 1.0]
        drivable = np.zeros((count, height, width), np.uint8)
        drivable[:, height // 2 :] = 255
        lane = np.where(batch.min(axis=3) > 200, np.uint8(255), np.uint8(0))
        return RawOutputs(detection, drivable, lane)

    def close(self) -> None:
        self.closed = True


def picture(width: int = 64, height: int = 48) -> NDArray[np.uint8]:
    """A dark picture with a white upright bar."""
    pixels = np.full((height, width, 3), (30, 60, 90), np.uint8)
    pixels[:, width // 2 : width // 2 + width // 8] = 255
    return pixels


def encode(pixels: NDArray[np.uint8], kind: str = "JPEG", **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


@pytest.fixture
def jpeg() -> bytes:
    return encode(picture())


@pytest.fixture
def backend() -> FakeBackend:
    return FakeBackend()


MakeApp = Callable[..., Application]


@pytest.fixture
def make_app(backend: FakeBackend) -> MakeApp:
    """Build an application; keywords are settings."""

    def make(**settings: Any) -> Application:
        return create_app(Predictor(backend), "tiny", Settings(**{"threads": 2, "drain": 0.1, **settings}))

    return make


@pytest.fixture
def app(make_app: MakeApp) -> Application:
    return make_app()


@pytest.fixture
def client(app: Application) -> Iterator[TestClient]:
    """A client that speaks to the application without a network."""
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


class Running:
    """A real server on a free port of loopback, in a thread."""

    def __init__(self, app: Application) -> None:
        self.app = app
        self.server: GuardedServer = build_server(app)
        listener = socket.create_server(("127.0.0.1", 0), backlog=1024)
        self.port: int = listener.getsockname()[1]
        self._thread = threading.Thread(target=self.server.run, args=([listener],), daemon=True)
        self._thread.start()
        until = time.monotonic() + 20
        while not self.server.started:
            assert self._thread.is_alive(), "the server did not start"
            assert time.monotonic() < until, "the server did not start in time"
            time.sleep(0.01)
        self.url = f"http://127.0.0.1:{self.port}"

    def stop(self, timeout: float = 20) -> bool:
        self.server.should_exit = True
        self._thread.join(timeout)
        return not self._thread.is_alive()


@pytest.fixture
def run_app() -> Iterator[Callable[[Application], Running]]:
    """Start real servers; they are stopped at the end of the test."""
    running: list[Running] = []

    def run(app: Application) -> Running:
        running.append(Running(app))
        return running[-1]

    yield run
    for one in running:
        assert one.stop()
