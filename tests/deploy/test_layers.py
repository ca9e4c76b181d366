"""Cells of columns: the same bytes of channels-last memory, read as fewer and wider pixels."""

from __future__ import annotations

import pytest
import torch

from trilitenet.deploy.layers import Columns, Layout, concatenate, recolumn


def channels_last(channels: int, height: int = 4, width: int = 16) -> torch.Tensor:
    return torch.randn(2, channels, height, width).contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 1), (4, 2), (2, 8)])
def test_recolumn_is_a_view(before: int, after: int) -> None:
    x = recolumn(channels_last(3), 1, before)
    cells = recolumn(x, before, after)
    assert cells.shape == (2, 3 * after, 4, 16 // after)
    assert cells.data_ptr() == x.data_ptr()
    assert torch.equal(recolumn(cells, after, before), x)


def test_a_cell_holds_its_columns_in_turn() -> None:
    x = channels_last(3)
    cells = recolumn(x, 1, 4)
    assert torch.equal(cells[:, 3 * 2 : 3 * 3, :, 1], x[..., 4 + 2])


@pytest.mark.parametrize("columns", [1, 4])
def test_concatenate_gives_pixels(columns: int) -> None:
    maps = [channels_last(3), channels_last(5)]
    cells = [recolumn(x, 1, columns) for x in maps]
    assert torch.equal(concatenate(cells, columns), torch.cat(maps, 1))


def test_layouts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(AssertionError):
        Layout(channels_last=False, columns=Columns(half=2))
    with pytest.raises(AssertionError):
        Layout(split=True, columns=Columns(stem=2, half=4), shared_image=True)
