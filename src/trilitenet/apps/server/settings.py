"""Limits and options of the service, in one frozen dataclass; every limit is finite."""

from __future__ import annotations

import dataclasses
import math
from typing import Final

from trilitenet.errors import ConfigError
from trilitenet.processing.cores import usable_cores

__all__ = ["BYTES_PER_PIXEL", "DRAWING_BYTES_PER_PIXEL", "WEBP_BYTES_PER_PIXEL", "Settings"]

BYTES_PER_PIXEL: Final = 10
"""Memory that one pixel of an accepted image may take while it is worked on: decoder, RGB copy, masks."""

WEBP_BYTES_PER_PIXEL: Final = 17
"""The same for WebP, whose decoder keeps several copies."""

DRAWING_BYTES_PER_PIXEL: Final = 3
"""What an overlay takes beside."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """What the service accepts and for how long it waits. Times are in seconds.

    Attributes:
        queue: At most so many images are accepted and not yet answered; one more gets 503 with Retry-After.
        max_batch: At most so many images go through the network at once.
        batch_delay: How long a batch that is not full waits for company. 0 takes what is there, which is best on CPUs.
        deadline: An accepted image that is not through by then gets 503.
        max_body: Bytes of one request.
        max_pixels: Width x height of one image, checked before it is decoded.
        max_side: Width or height of one image, checked before it is decoded.
        max_scans: Scans x pixels of a progressive JPEG may be at most this times ``max_pixels``: each scan costs time.
        max_images: Images of one batch request.
        memory: Bytes that bodies and decoded images of all requests may take together; beyond, 503.
        max_connections: Open connections; one more gets 503 at once.
        header_timeout: From the first byte of a request (or from connecting) to the end of its headers.
        upload_timeout: From the end of the headers to the end of the body.
        send_timeout: A client that takes nothing of its answer for so long is cut off.
        answer_timeout: From the answer to when the client has taken nearly all of it; then it is cut off.
        keep_alive: An idle connection is closed after this.
        drain: After SIGTERM the service still accepts for so long, so that load balancers see it is not ready.
        shutdown_timeout: How long accepted requests may take to finish after that.
        token: Bearer token that requests must bring; None lets everybody in.
        threads: Threads that decode images, and as many that make answers; 0 chooses by the number of cores.
    """

    queue: int = 64
    max_batch: int = 8
    batch_delay: float = 0.0
    deadline: float = 10.0
    max_body: int = 20 * 2**20
    max_pixels: int = 7680 * 4320
    max_side: int = 16384
    max_scans: int = 12
    max_images: int = 16
    memory: int = 2**30
    max_connections: int = 512
    header_timeout: float = 5.0
    upload_timeout: float = 20.0
    send_timeout: float = 20.0
    answer_timeout: float = 60.0
    keep_alive: float = 15.0
    drain: float = 1.0
    shutdown_timeout: float = 30.0
    token: str | None = dataclasses.field(default=None, repr=False)
    threads: int = 0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            lowest = 0 if field.name in {"batch_delay", "drain", "threads"} else 1
            if field.type == "int" and value < lowest:
                raise ConfigError(f"{field.name} must be at least {lowest}, got {value}")
            if field.type == "float" and not (0 < value < math.inf or (lowest == 0 and value == 0)):
                allowed = "positive" if lowest else "at least 0"
                raise ConfigError(f"{field.name} must be {allowed} and finite, got {value}")
        needed = 2 * self.max_body + (BYTES_PER_PIXEL + DRAWING_BYTES_PER_PIXEL) * self.max_pixels
        if needed > self.memory:
            raise ConfigError(
                f"memory ({self.memory}) must be at least {needed}, for one image of max_pixels ({self.max_pixels}) "
                f"and a body of max_body ({self.max_body})"
            )
        if self.max_images > self.queue:
            raise ConfigError(f"max_images ({self.max_images}) must not exceed queue ({self.queue})")
        if self.token is not None and len(self.token) < 16:
            raise ConfigError("the token must have at least 16 characters; make one with: openssl rand -hex 32")
        if self.token is not None and not (self.token.isascii() and self.token.isprintable() and " " not in self.token):
            raise ConfigError("the token must be plain ASCII without spaces; make one with: openssl rand -hex 32")

    @property
    def thread_count(self) -> int:
        """Threads of each of the two pools."""
        return self.threads or max(1, min(8, usable_cores()))
