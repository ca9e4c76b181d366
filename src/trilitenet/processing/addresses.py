"""Addresses (``https://...``) given where a file or folder is taken."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

__all__ = ["as_address"]

_SINGLE_SLASH: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):[/\\](?![/\\])(.+)")
"""An address as a path of it reads; not ``C:/``, which has one letter."""


def as_address(place: str | Path) -> str | None:
    """Return the address (``https://...``) that a text is, or a path of it, which lost a slash; None of others."""
    text = str(place)
    if "://" in text:
        return text
    found = _SINGLE_SLASH.fullmatch(text)
    if found is None or Path(text).exists():
        return None
    scheme, rest = found.groups()
    return f"{scheme}:{'///' if scheme.lower() == 'file' else '//'}{rest}"
