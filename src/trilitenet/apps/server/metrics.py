"""What the service counts, in Prometheus' form. Each service has a registry of its own, so tests do not collide."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)

__all__ = ["STAGES", "Metrics"]

STAGES: Final = ("upload", "decode", "preprocess", "queue", "network", "postprocess", "encode")
"""The stages of a request, in their order; each has a latency histogram."""

BUSY: Final = ("queue_full", "queue_slow", "deadline", "memory", "too_many_connections", "closing", "internal")
"""Reasons of refusals that are the service's, not the client's."""

_SECONDS: Final = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0, 100.0)


class Metrics:
    """All counters of one service."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        self._stage = Histogram(
            "trilitenet_stage_seconds",
            "Time an image spent in a stage.",
            ["stage"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._stages = {stage: self._stage.labels(stage) for stage in STAGES}
        self._request = Histogram(
            "trilitenet_request_seconds",
            "Time from the headers of a request to the end of its answer.",
            ["route"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._answers = Counter(
            "trilitenet_requests", "Requests answered.", ["route", "method", "status"], registry=self.registry
        )
        self._rejects = Counter(
            "trilitenet_rejects",
            "Requests, images of batches and connections refused, by reason.",
            ["reason"],
            registry=self.registry,
        )
        for reason in BUSY:  # no rise is seen in what begins with 1
            self._rejects.labels(reason)
        self._vanished = Counter(
            "trilitenet_vanished", "Requests whose client went away before the answer.", registry=self.registry
        )
        self._batch = Histogram(
            "trilitenet_batch_size",
            "Images that went through the network at once.",
            buckets=(1, 2, 4, 8, 16, 32),
            registry=self.registry,
        )
        self._info = Info("trilitenet_model", "The model that is served.", registry=self.registry)

    def expect(self, routes: Iterable[str]) -> None:
        """Begin with 0 what alerts look at, for routes that are posted to: no rise is seen in what begins with 1."""
        for route in routes:
            for status in ("500", "503"):
                self._answers.labels(route, "POST", status)

    def gauge(self, name: str, text: str, value: Callable[[], float]) -> None:
        """Add a gauge that is read when it is scraped."""
        Gauge(f"trilitenet_{name}", text, registry=self.registry).set_function(value)

    def model(self, name: str, backend: str, version: str) -> None:
        """Say which model is served."""
        self._info.info({"name": name, "backend": backend, "version": version})

    def stage(self, stage: str, seconds: float) -> None:
        """Count the time an image spent in one of `STAGES`."""
        self._stages[stage].observe(seconds)

    def batch(self, size: int) -> None:
        """Count one run of the network."""
        self._batch.observe(size)

    def reject(self, reason: str) -> None:
        """Count a refusal by its code."""
        self._rejects.labels(reason).inc()

    def vanish(self) -> None:
        """Count a client that went away."""
        self._vanished.inc()

    def answer(self, route: str, method: str, status: int, seconds: float) -> None:
        """Count one answered request."""
        self._answers.labels(route, method, str(status)).inc()
        self._request.labels(route).observe(seconds)

    def text(self) -> bytes:
        """Return everything in Prometheus' text format."""
        return generate_latest(self.registry)
