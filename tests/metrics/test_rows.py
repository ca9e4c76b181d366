from __future__ import annotations

import base64

import numpy as np
import pytest

from trilitenet.metrics.rows import Rows


@pytest.mark.parametrize("dtype", [np.int64, np.float32, np.uint16, np.bool_])
def test_packed_rows_come_back(dtype: type[np.generic]) -> None:
    rows = Rows(3, dtype)
    rows.append(np.arange(600).reshape(200, 3) % 7)
    again = Rows(3, dtype)
    again.unpack(rows.pack())
    assert again.array.dtype == rows.array.dtype
    assert np.array_equal(again.array, rows.array)
    again.unpack(Rows(3, dtype).pack())
    assert len(again) == 200


@pytest.mark.parametrize("text", ["???", base64.b64encode(b"no zlib").decode(), 3, Rows(2).pack()[:-4]])
def test_what_is_no_packed_rows_is_refused(text: str) -> None:
    rows = Rows(2)
    rows.append(np.ones((5, 2)))
    with pytest.raises(ValueError, match=r".+"):
        rows.unpack(text)


def test_rows_of_other_columns_are_refused() -> None:
    rows = Rows(2)
    rows.append(np.ones((5, 2)))
    with pytest.raises(ValueError, match="reshape"):
        Rows(3).unpack(rows.pack())
