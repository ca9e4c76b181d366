"""A table that grows a row at a time and stays one compact array."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["Rows", "pack_tables", "unpack_tables"]


class Rows:
    """Rows of numbers in one array that doubles when full.

    Args:
        columns: Numbers a row.
        dtype: Their type.
    """

    def __init__(self, columns: int, dtype: DTypeLike = np.int64) -> None:
        self._array: NDArray[Any] = np.zeros((64, columns), dtype)
        self._used = 0

    def __len__(self) -> int:
        return self._used

    @property
    def array(self) -> NDArray[Any]:
        """(rows, columns) view of what was appended."""
        return self._array[: self._used]

    def append(self, rows: Any) -> None:
        """Append one row (columns,), or many (n, columns)."""
        block = np.atleast_2d(np.asarray(rows, self._array.dtype))
        end = self._used + len(block)
        if end > len(self._array):
            grown = np.zeros((max(end, 2 * len(self._array)), self._array.shape[1]), self._array.dtype)
            grown[: self._used] = self.array
            self._array = grown
        self._array[self._used : end] = block
        self._used = end

    def pack(self) -> str:
        """Return the rows as text: their bytes, little-endian, compressed by zlib, in base64."""
        little = self.array.astype(self._array.dtype.newbyteorder("<"), order="C", copy=False)
        return base64.b64encode(zlib.compress(little.tobytes(), 1)).decode("ascii")

    def unpack(self, text: str) -> None:
        """Append what `pack` returned for rows of the same columns and type.

        Raises:
            ValueError: If it is no such text.
        """
        try:
            data = zlib.decompress(base64.b64decode(text, validate=True))
        except (zlib.error, TypeError) as error:
            raise ValueError(f"not packed rows ({error})") from error
        little = np.frombuffer(data, self._array.dtype.newbyteorder("<"))
        self.append(little.reshape(-1, self._array.shape[1]))


def pack_tables(tables: Mapping[str, Rows]) -> dict[str, str]:
    """Return what `Rows.pack` makes of each table, by name."""
    return {name: rows.pack() for name, rows in tables.items()}


def unpack_tables(tables: Mapping[str, Rows], state: Mapping[str, Any]) -> None:
    """Fill tables with what `pack_tables` made of them.

    Raises:
        KeyError: If one is missing.
        ValueError: If one is no packed table.
    """
    for name, rows in tables.items():
        rows.unpack(state[name])
