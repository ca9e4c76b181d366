from __future__ import annotations

import time

import pytest

from trilitenet.apps.server.multipart import Part, split_form
from trilitenet.apps.server.problems import ProblemError

TYPE = "multipart/form-data; boundary=xyz"


def _part(name: str, data: bytes, extra: str = "") -> bytes:
    return f'--xyz\r\nContent-Disposition: form-data; name="{name}"{extra}\r\n\r\n'.encode() + data + b"\r\n"


def test_parts_come_back_as_they_were() -> None:
    body = _part("image", b"\x00\r\n--xy\r\n\xff") + _part("images", b"", '; filename="a; name=b"') + b"--xyz--\r\n"
    assert split_form(body, TYPE, 5) == [Part("image", b"\x00\r\n--xy\r\n\xff"), Part("images", b"")]


def test_preamble_and_quoted_boundary() -> None:
    body = b"hello\r\n" + _part("image", b"1") + b"--xyz--"
    assert split_form(body, 'multipart/form-data; charset=x; boundary="xyz"', 5) == [Part("image", b"1")]


@pytest.mark.parametrize(
    ("body", "content_type"),
    [
        (b"", TYPE),
        (b"--xyz", TYPE),
        (b"--xyz\r\n", TYPE),
        (b"--abc--\r\n", TYPE),
        (_part("image", b"1"), TYPE),
        (b"--xyz\r\nno headers end\r\n--xyz--", TYPE),
        (b"--xyz\r\n" + b"a" * 9000 + b"\r\n\r\n1\r\n--xyz--", TYPE),
        (_part("image", b"1") + b"--xyz--", "multipart/form-data"),
        (_part("image", b"1") + b"--xyz--", "multipart/form-data; boundary="),
        (_part("image", b"1") + b"--xyz--", "multipart/form-data; boundary*" + "1" * 5000 + "=xyz"),
        (_part("image", b"1") + b"--xyz--", "multipart/form-data; boundary=" + "x" * 300),
        (b"--" + b"x" * 201 + b"\r\n\r\n\r\n--" + b"x" * 201 + b"--", "multipart/form-data; boundary=" + "x" * 201),
        (b"--xyz\r\nno headers end\r\n" + _part("image", b"1") + b"--xyz--", TYPE),
        (_part("image", b"1") + b"--xyz--", f'{TYPE}; x="{";" * 32_000}'),  # which would take a second to read
        (_part("image", b"1", f'; x="{";" * 3_000}') + b"--xyz--", TYPE),
    ],
)
def test_broken_forms_are_refused(body: bytes, content_type: str) -> None:
    with pytest.raises(ProblemError) as caught:
        split_form(body, content_type, 5)
    assert caught.value.status == 400


def test_a_part_without_a_name_is_kept_without_one() -> None:
    assert split_form(b"--xyz\r\nX: y\r\n\r\n1\r\n--xyz--", TYPE, 5) == [Part("", b"1")]


def test_too_many_parts_are_refused() -> None:
    with pytest.raises(ProblemError) as caught:
        split_form(_part("image", b"1") * 3 + b"--xyz--", TYPE, 2)
    assert (caught.value.status, caught.value.message) == (413, "the form has more than 2 parts")
    with pytest.raises(ProblemError) as caught:
        split_form(_part("image", b"1") * 2 + b"--xyz--", TYPE, 1)
    assert caught.value.message == "the form has more than 1 part"


@pytest.mark.parametrize("filler", [b"\r", b"\r\n", b"\r\n--xy", b"-"])
def test_hostile_bytes_cost_no_more_than_others(filler: bytes) -> None:
    body = _part("image", filler * (4_000_000 // len(filler))) + b"--xyz--"
    start = time.process_time()
    split_form(body, TYPE, 2)
    assert time.process_time() - start < 0.5
