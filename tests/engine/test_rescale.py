from __future__ import annotations

import dataclasses

import pytest
import torch

from trilitenet.data.batches import Batch
from trilitenet.engine.rescale import draw_size, rescale


def batch() -> Batch:
    mask = torch.zeros(1, 64, 128, dtype=torch.uint8)
    mask[:, 32:, :64] = 1
    mask[:, :, 120:] = 255
    return Batch(
        images=torch.full((1, 3, 64, 128), 77, dtype=torch.uint8),
        boxes=torch.tensor([[0, 0, 32.0, 48.0, 16.0, 8.0]]),
        ignored=torch.tensor([[0, 100.0, 10.0, 20.0, 20.0]]),
        detection_labelled=torch.tensor([True]),
        drivable=mask,
        lane=mask,
        names=("a",),
    )


def test_images_masks_and_boxes_go_together() -> None:
    small = rescale(batch(), (32, 64))
    assert small.images.shape == (1, 3, 32, 64)
    assert small.images.dtype is torch.uint8
    assert set(small.images.unique().tolist()) == {77}
    assert small.boxes.tolist() == [[0, 0, 16.0, 24.0, 8.0, 4.0]]
    assert small.ignored.tolist() == [[0, 50.0, 5.0, 10.0, 10.0]]
    assert bool((small.drivable[0, 16:, :32] == 1).all())
    assert set(small.lane.unique().tolist()) == {0, 1, 255}


def test_masks_stay_where_their_pixels_are() -> None:
    whole = batch()
    edge = (torch.arange(128) < 51).to(torch.uint8).expand(1, 64, 128)
    pictured = dataclasses.replace(whole, images=(edge * 200)[:, None].expand(1, 3, 64, 128), lane=edge)
    for size in ((32, 96), (32, 64), (96, 160), (96, 224)):
        moved = rescale(pictured, size)
        # The edge in pixels, of which the image has parts.
        assert float(moved.images[0, 0, 9].sum() / 200) == pytest.approx(51 * size[1] / 128, abs=0.05)
        assert int(moved.lane[0, 9].sum()) == pytest.approx(51 * size[1] / 128, abs=0.5)


def test_what_lies_between_the_new_pixels_counts_too() -> None:
    whole = batch()
    whole.images[:] = 0
    whole.images[..., 3::4] = 203
    narrow = rescale(whole, (64, 32))
    # Every fourth column is bright; of four that become one, the middle two are dark.
    assert set(narrow.images[..., 1:-1].unique().tolist()) == {51}  # 203 / 4 = 50.75
    assert narrow.boxes.tolist() == [[0, 0, 8.0, 48.0, 4.0, 8.0]]
    assert narrow.ignored.tolist() == [[0, 25.0, 10.0, 5.0, 20.0]]


def test_the_same_size_changes_nothing() -> None:
    whole = batch()
    assert rescale(whole, (64, 128)) is whole


def test_sizes_are_multiples_of_32_and_depend_on_seed_and_step_alone() -> None:
    sizes = [draw_size((384, 640), (0.5, 1.5), 0, step) for step in range(40)]
    assert sizes == [draw_size((384, 640), (0.5, 1.5), 0, step) for step in range(40)]
    assert all(side % 32 == 0 for size in sizes for side in size)
    assert len(set(sizes)) > 5
    assert draw_size((384, 640), (1.0, 1.0), 0, 0) == (384, 640)
    assert draw_size((64, 640), (0.1, 0.1), 0, 0) == (32, 64)  # not 0 rows
