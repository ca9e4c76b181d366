"""From untrusted bytes to an image: what it is and how large is read from its header, before anything is decoded.

The header readers are a few lines each and run no decoder, so that a decompression bomb, a wrong type or a truncated
header is refused for the price of reading some bytes. Only JPEG, PNG and WebP are taken; what the client calls the
file does not matter.
"""

from __future__ import annotations

import dataclasses
import io
import re
import struct
import threading
from collections.abc import AsyncIterator
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.apps.server.problems import BusyError, ProblemError
from trilitenet.apps.server.settings import BYTES_PER_PIXEL, WEBP_BYTES_PER_PIXEL, Settings
from trilitenet.errors import InputError
from trilitenet.processing.images import read_image

__all__ = ["Header", "MemoryBudget", "Reservation", "check_header", "decode", "read_body", "read_header", "too_large"]

_MAX_SEGMENTS: Final = 1_000
"""Segments of a JPEG, of which its header, metadata and scans are made; each costs 10 microseconds."""
_FILL: Final = re.compile(rb"\xff+")
"""Bytes that may stand before a marker, any number of them."""

Kind = Literal["JPEG", "PNG", "WEBP"]


class Header(NamedTuple):
    """What the header of an image says.

    Attributes:
        kind: The format, from the bytes alone.
        width: In pixels, as stored (EXIF rotation is applied later).
        height: In pixels, as stored.
        scans: Times that a decoder goes over the picture: more than 1 in a progressive JPEG.
    """

    kind: Kind
    width: int
    height: int
    scans: int

    @property
    def cost(self) -> int:
        """Bytes of memory that the image may take while it is worked on."""
        each = WEBP_BYTES_PER_PIXEL if self.kind == "WEBP" else BYTES_PER_PIXEL
        return self.width * self.height * each


def read_header(data: bytes) -> Header:
    """Read format and size of an image without decoding it.

    Raises:
        ProblemError: 400 if there are no bytes, 415 if they are no JPEG, PNG or WebP, 422 if the header is broken.
    """
    if not data:
        raise ProblemError(400, "empty", "the image is empty")
    try:
        if data[:3] == b"\xff\xd8\xff":
            return _jpeg(data)
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return _png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
    except (struct.error, IndexError) as error:
        raise ProblemError(422, "broken_image", "the image ends inside its header") from error
    raise ProblemError(415, "unsupported_type", "the bytes are not a JPEG, PNG or WebP image")


def check_header(header: Header, settings: Settings) -> None:
    """Refuse an image that would cost too much to decode.

    Raises:
        ProblemError: 413 if it has too many pixels or scans, 422 if it has none.
    """
    width, height = header.width, header.height
    if width < 1 or height < 1:
        raise ProblemError(422, "broken_image", f"the image has no pixels ({width} x {height})")
    if width > settings.max_side or height > settings.max_side or width * height > settings.max_pixels:
        raise ProblemError(
            413,
            "too_many_pixels",
            f"the image has {width} x {height} pixels; at most {settings.max_pixels:,} pixels and "
            f"{settings.max_side} a side are taken: send a smaller one",
        )
    if header.scans * width * height > settings.max_scans * settings.max_pixels:
        raise ProblemError(413, "too_many_scans", f"the JPEG has {header.scans} scans, too many for its size")


def decode(data: bytes, header: Header) -> NDArray[np.uint8]:
    """Decode an image whose header was checked.

    Returns:
        (height, width, 3) uint8 RGB, with the EXIF rotation applied.

    Raises:
        ProblemError: 422 if it is broken or truncated.
    """
    try:
        with Image.open(io.BytesIO(data), formats=[header.kind]) as image:
            if image.size != (header.width, header.height):
                raise ProblemError(422, "broken_image", f"the {header.kind} image contradicts itself about its size")
            return read_image(image)
    except InputError as error:
        raise ProblemError(422, "broken_image", f"the {header.kind} image is broken or truncated") from error
    except (ProblemError, MemoryError):
        raise
    except Exception as error:  # Pillow's decoders raise nearly anything on hostile bytes
        raise ProblemError(422, "broken_image", f"the {header.kind} image cannot be decoded") from error


def _jpeg(data: bytes) -> Header:
    """Walk the marker segments up to the frame header, then count the scans."""
    position = 2
    for _ in range(_MAX_SEGMENTS):
        if data[position] != 0xFF:
            raise ProblemError(422, "broken_image", "the JPEG image has a broken header")
        position = _FILL.match(data, position).end()  # type: ignore[union-attr]  # one is there
        marker = data[position]
        position += 1
        if marker in {0xD8, 0x01} or 0xD0 <= marker <= 0xD7:
            continue
        if marker in {0xD9, 0xDA}:
            raise ProblemError(422, "broken_image", "the JPEG image has no frame header")
        (length,) = struct.unpack_from(">H", data, position)
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            height, width = struct.unpack_from(">HH", data, position + 3)
            return Header("JPEG", width, height, _scans(data, position + length))
        position += length
    raise _too_many_segments()


def _scans(data: bytes, position: int) -> int:
    """Count the scans from a position after the frame header to the end mark, as a decoder meets them.

    What a segment holds (a thumbnail) and what follows the end mark (a film) is no part of the picture.
    """
    scans = 0
    array = np.frombuffer(data, np.uint8)
    for _ in range(_MAX_SEGMENTS):
        position = _next_marker(array, position)
        if position >= len(data) or data[position] == 0xD9:
            return scans
        scans += data[position] == 0xDA
        has_length = data[position] >= 0xC0 and data[position] != 0xD8
        position += 1
        if has_length:
            position += max(2, int.from_bytes(data[position : position + 2], "big"))
    raise _too_many_segments()


def _next_marker(data: NDArray[np.uint8], position: int) -> int:
    """Return where the next marker's second byte is, or the length of the data."""
    size = 4096
    while position < len(data) - 1:
        first, second = data[position : position + size + 1][:-1], data[position + 1 : position + size + 1]
        # Inside a scan 0xFF is stuffed with a zero, or begins a restart; it may fill the space between segments.
        found = (first == 0xFF) & (second != 0x00) & (second & 0xF8 != 0xD0) & (second != 0xFF)
        if found.any():
            return position + int(found.argmax()) + 1
        position += size
        size = min(2 * size, 2**20)
    return len(data)


def _too_many_segments() -> ProblemError:
    return ProblemError(413, "too_many_segments", f"the JPEG image has more than {_MAX_SEGMENTS:,} segments")


def _png(data: bytes) -> Header:
    length, name, width, height = struct.unpack_from(">I4sII", data, 8)
    if name != b"IHDR" or length != 13:
        raise ProblemError(422, "broken_image", "the PNG image has a broken header")
    return Header("PNG", width, height, 1)


def _webp(data: bytes) -> Header:
    chunk = data[12:16]
    if chunk == b"VP8X":
        width = 1 + int.from_bytes(data[24:27], "little")
        height = 1 + int.from_bytes(data[27:30], "little")
        if len(data) < 30:
            raise IndexError
        return Header("WEBP", width, height, 1)
    if chunk == b"VP8L":
        signature, bits = struct.unpack_from("<BI", data, 20)
        if signature != 0x2F:
            raise ProblemError(422, "broken_image", "the WebP image has a broken header")
        return Header("WEBP", 1 + (bits & 0x3FFF), 1 + ((bits >> 14) & 0x3FFF), 1)
    if chunk == b"VP8 ":
        start, width, height = struct.unpack_from("<3sHH", data, 23)
        if start != b"\x9d\x01\x2a":
            raise ProblemError(422, "broken_image", "the WebP image has a broken header")
        return Header("WEBP", width & 0x3FFF, height & 0x3FFF, 1)
    raise ProblemError(422, "broken_image", "the WebP image has a broken header")


class MemoryBudget:
    """Bytes that all requests in work may hold together. Safe to use from several threads."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.used = 0
        self._lock = threading.Lock()

    def take(self, count: int) -> None:
        """Take ``count`` bytes.

        Raises:
            BusyError: If there are not as many left.
        """
        with self._lock:
            if self.used + count > self.limit:
                raise BusyError("memory", "the service holds as much as it may; try again soon")
            self.used += count

    def give(self, count: int) -> None:
        """Give ``count`` bytes back."""
        with self._lock:
            self.used -= count


@dataclasses.dataclass
class Reservation:
    """What one request and its answer hold of a `MemoryBudget`."""

    budget: MemoryBudget
    held: int = 0

    def take(self, count: int) -> None:
        """Hold ``count`` bytes more.

        Raises:
            ProblemError: 413 if the request takes more than there is for all.
            BusyError: If there are not as many left now.
        """
        if self.held + count > self.budget.limit:
            raise ProblemError(
                413,
                "too_much_memory",
                f"the request takes more than {self.budget.limit:,} bytes of memory: send fewer or smaller images",
            )
        self.budget.take(count)
        self.held += count

    def keep(self, count: int) -> None:
        """Give back all but ``count`` bytes."""
        kept = min(self.held, count)
        self.budget.give(self.held - kept)
        self.held = kept


async def read_body(chunks: AsyncIterator[bytes], reservation: Reservation, settings: Settings) -> bytes:
    """Collect a request's body in memory, never on disk.

    Args:
        chunks: The pieces as they arrive.
        reservation: Pays for what has arrived (not for what was declared).
        settings: The limit on its size.

    Raises:
        ProblemError: 413 if it grows too large.
        BusyError: If there is no memory left.
    """
    body = bytearray()
    async for chunk in chunks:
        if len(body) + len(chunk) > settings.max_body:
            raise too_large(settings)
        reservation.take(len(chunk))
        body += chunk
    return bytes(body)


def too_large(settings: Settings) -> ProblemError:
    """Return the refusal of a body that is, or says it is, too large."""
    return ProblemError(413, "too_large", f"the body is larger than {settings.max_body:,} bytes: send less at once")
