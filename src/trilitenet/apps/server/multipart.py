"""Multipart forms split in memory: nothing of an upload is spooled to disk, and file names are ignored.

A body is already whole and bounded when it comes here, so searching it for the boundary is all there is to do; the cost
is linear whatever the bytes.
"""

from __future__ import annotations

from email.message import Message
from typing import Final, NamedTuple

from trilitenet.apps.server.problems import ProblemError

__all__ = ["Part", "split_form"]

_MAX_HEADERS: Final = 4096
"""Bytes of the headers of one part."""
_LONGEST_VALUE: Final = 1024
"""Characters of a header's value with parameters, which take quadratic time to read."""


class Part(NamedTuple):
    """One field of a form.

    Attributes:
        name: Of the field.
        data: Its bytes.
    """

    name: str
    data: bytes


def split_form(body: bytes, content_type: str, max_parts: int) -> list[Part]:
    """Split a ``multipart/form-data`` body (RFC 7578).

    Args:
        body: The whole body.
        content_type: The header, with the boundary.
        max_parts: More parts are refused.

    Raises:
        ProblemError: 400 if the body is not such a form or ends early, 413 if it has too many parts.
    """
    boundary = _parameter("Content-Type", content_type, "boundary")
    if not boundary or len(boundary) > 200:
        raise ProblemError(400, "bad_form", "the multipart form names no boundary in its Content-Type")
    delimiter = b"\r\n--" + boundary.encode("latin-1", "replace")
    # The first delimiter may stand at the very start, without the line break before it.
    position = 0 if body.startswith(delimiter[2:]) else body.find(delimiter) + 2
    if position == 1:
        raise ProblemError(400, "bad_form", "the multipart form does not hold its own boundary")
    position += len(delimiter) - 2
    parts: list[Part] = []
    while body[position : position + 2] != b"--":
        if len(parts) == max_parts:
            most = f"{max_parts} part{'s' * (max_parts != 1)}"
            raise ProblemError(413, "too_many_parts", f"the form has more than {most}")
        end = body.find(delimiter, position)
        # The search starts at the delimiter's own line break, so that a part without headers is found.
        headers_end = body.find(b"\r\n\r\n", position, position + _MAX_HEADERS)
        if end < 0 or headers_end < 0 or headers_end > end:
            raise ProblemError(400, "bad_form", "the multipart form is broken or ends early")
        parts.append(Part(_field_name(body[position:headers_end]), body[headers_end + 4 : end]))
        position = end + len(delimiter)
    return parts


def _field_name(headers: bytes) -> str:
    for line in headers.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-disposition":
            return _parameter("Content-Disposition", value.decode("utf-8", "replace"), "name")
    return ""


def _parameter(header: str, value: str, name: str) -> str:
    if len(value) > _LONGEST_VALUE:
        raise ProblemError(
            400, "bad_form", f"a {header} of the multipart form is longer than {_LONGEST_VALUE:,} characters"
        )
    message = Message()
    message[header] = value.replace("\r", " ").replace("\n", " ").strip()
    try:
        found = message.get_param(name, "", header=header)
    except ValueError:  # a part's number of thousands of digits
        return ""
    return found if isinstance(found, str) else ""
