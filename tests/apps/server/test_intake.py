from __future__ import annotations

import asyncio
import io
import struct
import zlib
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.apps.server.conftest import encode, picture
from trilitenet.apps.server.intake import (
    Header,
    MemoryBudget,
    Reservation,
    check_header,
    decode,
    read_body,
    read_header,
)
from trilitenet.apps.server.problems import BusyError, ProblemError
from trilitenet.apps.server.settings import Settings


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("JPEG", {}),
        ("JPEG", {"progressive": True}),
        ("JPEG", {"comment": b"x" * 3000}),
        ("PNG", {}),
        ("WEBP", {"lossless": True}),
        ("WEBP", {"lossless": False}),
        ("WEBP", {"icc_profile": b"x" * 200}),
    ],
)
def test_headers_are_read_as_pillow_reads_them(kind: str, options: dict[str, object]) -> None:
    data = encode(picture(61, 47), kind, **options)
    header = read_header(data)
    assert header[:3] == (kind, 61, 47)
    assert (header.scans > 1) == bool(options.get("progressive"))
    pixels = decode(data, header)
    np.testing.assert_array_equal(pixels, np.asarray(Image.open(io.BytesIO(data)).convert("RGB")))


def _png(width: int, height: int) -> bytes:
    body = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + body + struct.pack(">I", zlib.crc32(b"IHDR" + body))
    return b"\x89PNG\r\n\x1a\n" + chunk


@pytest.mark.parametrize(("width", "height"), [(60000, 60000), (20000, 1), (1, 20000), (2**31, 2**31)])
def test_bombs_are_refused_by_their_header(width: int, height: int) -> None:
    with pytest.raises(ProblemError) as caught:
        check_header(read_header(_png(width, height)), Settings())
    assert caught.value.status == 413


def test_no_pixels_are_refused() -> None:
    with pytest.raises(ProblemError) as caught:
        check_header(read_header(_png(0, 5)), Settings())
    assert caught.value.status == 422


def test_scans_count_by_the_size_of_the_picture() -> None:
    check_header(Header("JPEG", 1000, 1000, 200), Settings())
    with pytest.raises(ProblemError, match="200 scans"):
        check_header(Header("JPEG", 7000, 4000, 200), Settings())


def test_the_largest_allowed_image_is_8k() -> None:
    check_header(Header("PNG", 7680, 4320, 1), Settings())
    with pytest.raises(ProblemError) as caught:
        check_header(Header("PNG", 7680, 4321, 1), Settings())
    assert caught.value.status == 413


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_a_truncated_file_is_refused_unless_only_its_end_mark_is_missing(kind: str) -> None:
    data = encode(picture(40, 30), kind)
    whole = decode(data, read_header(data))
    refused = 0
    for length in range(len(data)):
        try:
            pixels = decode(data[:length], read_header(data[:length]))
        except ProblemError as problem:
            refused += problem.status in {400, 415, 422}
        else:
            np.testing.assert_array_equal(pixels, whole)
    assert refused > len(data) - 32


def test_a_header_that_contradicts_itself_is_refused() -> None:
    data = encode(picture(40, 30), "PNG")
    with pytest.raises(ProblemError, match="contradicts"):
        decode(data, Header("PNG", 41, 30, 1))


def test_another_format_than_its_header_is_refused() -> None:
    with pytest.raises(ProblemError) as caught:
        decode(encode(picture(), "PNG"), Header("JPEG", 64, 48, 1))
    assert caught.value.status == 422


def test_webp_costs_more_memory_than_others() -> None:
    costs = {kind: read_header(encode(picture(100, 20), kind)).cost for kind in ("JPEG", "PNG", "WEBP")}
    assert costs == {"JPEG": 20_000, "PNG": 20_000, "WEBP": 34_000}


def test_memory_is_given_back() -> None:
    budget = MemoryBudget(100)
    first, second = Reservation(budget), Reservation(budget)
    first.take(60)
    second.take(40)
    with pytest.raises(BusyError):
        second.take(1)
    assert budget.used == 100
    second.keep(0)
    assert budget.used == 60
    first.keep(0)
    assert budget.used == 0


def test_a_request_that_never_fits_is_told_so() -> None:
    reservation = Reservation(MemoryBudget(100))
    reservation.take(60)
    with pytest.raises(ProblemError, match="more than 100 bytes") as caught:
        reservation.take(41)
    assert caught.value.status == 413
    reservation.keep(10)
    assert reservation.budget.used == 10
    reservation.keep(50)
    assert reservation.budget.used == 10


def test_what_follows_a_jpeg_is_no_part_of_it() -> None:
    data = encode(picture(61, 47), "JPEG")
    assert read_header(data + b"\xff\xda" * 5000) == Header("JPEG", 61, 47, 1)


def test_what_segments_hold_counts_as_no_scan_and_no_end() -> None:
    data = encode(picture(61, 47), "JPEG", progressive=True)
    scans = read_header(data).scans
    start = data.index(b"\xff\xda")
    segment = b"\xff\xe1\x00\x0a" + b"\xff\xd9\xff\xda" * 2
    assert scans > 5
    assert read_header(data[:start] + segment + data[start:]).scans == scans


@pytest.mark.parametrize(
    "between",
    [
        b"\xff\x00\xff\xd3\xff",  # stuffing, a restart, a fill byte
        b"\xff\x02\x40\x00",  # a marker that a decoder passes over, whatever its length says
        bytes(9000) + b"\x00",
        bytes(4095 - 8),
        bytes(4096 - 8),
    ],
)
def test_every_scan_is_found(between: bytes) -> None:
    data = encode(picture(61, 47), "JPEG")
    scan = b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00" + between
    assert read_header(data[:-2] + 300 * scan + data[-2:]).scans == 301


@pytest.mark.parametrize(
    "segment",
    [
        b"\xff\xcc\x00\x04\x00\x10",  # conditions of arithmetic codes, whose marker is among those of frames
        b"\xff\xd0\xff\xd7\xff\x01",  # markers without a length
        b"\xff\xff\xff\xfe\x00\x02",  # fill bytes
    ],
)
def test_segments_before_the_size_are_passed_over(segment: bytes) -> None:
    data = encode(picture(61, 47), "JPEG")
    assert read_header(data[:2] + segment + data[2:]) == Header("JPEG", 61, 47, 1)


@pytest.mark.parametrize("length", [0, 1])
def test_a_segment_is_no_shorter_than_its_length(length: int) -> None:
    data = encode(picture(61, 47), "JPEG")
    with pytest.raises(ProblemError, match="broken header"):
        read_header(data[:2] + b"\xff\xfe\x00" + bytes([length]) + data[2:])


def test_an_extended_webp_must_hold_its_size() -> None:
    data = encode(picture(61, 47), "WEBP", icc_profile=b"x" * 200)
    assert data[12:16] == b"VP8X"
    with pytest.raises(ProblemError, match="inside its header"):
        read_header(data[:29])


async def _pieces(*pieces: bytes) -> AsyncIterator[bytes]:
    for piece in pieces:
        yield piece


def test_a_body_is_paid_for_as_it_arrives() -> None:
    settings = Settings(max_body=10)
    reservation = Reservation(MemoryBudget(100))
    assert asyncio.run(read_body(_pieces(b"12345", b"67890"), reservation, settings)) == b"1234567890"
    assert reservation.held == 10
    with pytest.raises(ProblemError, match="larger than 10 bytes") as caught:
        asyncio.run(read_body(_pieces(b"12345", b"678901"), reservation, settings))
    assert caught.value.status == 413
    assert reservation.held == 15
    reservation.budget.take(80)  # by others
    with pytest.raises(BusyError):
        asyncio.run(read_body(_pieces(b"12345", b"67890"), Reservation(reservation.budget), settings))


def test_any_number_of_fill_bytes_is_passed_over_at_once() -> None:
    data = encode(picture(61, 47), "JPEG")
    seen = []

    class Watched(bytes):
        def __getitem__(self, place: Any) -> Any:
            seen.append(place)
            return super().__getitem__(place)

    filled = Watched(data[:2] + b"\xff" * 1_000_000 + data[2:])
    assert read_header(filled) == Header("JPEG", 61, 47, 1)
    assert len(seen) < 1_000  # bytes looked at one by one
    with pytest.raises(ProblemError, match="header"):
        read_header(data[:2] + b"\xff" * 1_000)


def test_endless_segments_are_refused() -> None:
    data = encode(picture(61, 47), "JPEG")
    for place in (2, len(data) - 2):
        with pytest.raises(ProblemError, match="segments") as caught:
            read_header(data[:place] + b"\xff\xfe\x00\x02" * 1_000 + data[place:])
        assert caught.value.status == 413


def test_flags_beside_the_sizes_of_webp_are_no_part_of_them() -> None:
    lossy = bytearray(encode(picture(61, 47), "WEBP", lossless=False))
    start = lossy.index(b"\x9d\x01\x2a") + 3
    lossy[start + 1] |= 0xC0  # how to scale the picture when it is shown
    lossy[start + 3] |= 0x40
    assert read_header(bytes(lossy)) == Header("WEBP", 61, 47, 1)
    clear = np.concatenate([picture(61, 47), np.full((47, 61, 1), 9, np.uint8)], axis=2)
    lossless = encode(clear, "WEBP", lossless=True)  # with a flag for its alpha
    assert lossless[12:16] == b"VP8L"
    assert read_header(lossless) == Header("WEBP", 61, 47, 1)
