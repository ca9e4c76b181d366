from __future__ import annotations

import numpy as np
import pytest
import torch

from trilitenet.data.batches import NOT_LABELLED, collate
from trilitenet.data.sample import Sample
from trilitenet.errors import ShapeError


def sample(name: str, **more: object) -> Sample:
    image = np.zeros((32, 64, 3), np.uint8)
    image[..., 0] = 9
    return Sample(name, image, **more)  # type: ignore[arg-type]


def test_rows_name_their_image() -> None:
    full = sample(
        "full",
        boxes=np.array([[0, 0, 10, 20], [4, 4, 8, 8]], np.float32),
        class_id=np.array([0, 1]),
        ignored=np.array([[10, 10, 20, 30]], np.float32),
        drivable=np.ones((32, 64), np.uint8),
        lane=np.zeros((32, 64), np.uint8),
    )
    empty = sample("empty", boxes=np.zeros((0, 4), np.float32), class_id=np.zeros(0, np.int64))
    batch = collate([sample("bare"), full, empty])
    assert batch.images.shape == (3, 3, 32, 64)
    assert batch.images.dtype == torch.uint8
    assert batch.images[0, :, 0, 0].tolist() == [9, 0, 0]  # RGB
    assert batch.boxes.tolist() == [[1, 0, 5, 10, 10, 20], [1, 1, 6, 6, 4, 4]]
    assert batch.ignored.tolist() == [[1, 15, 20, 10, 20]]
    assert batch.detection_labelled.tolist() == [False, True, True]
    assert batch.names == ("bare", "full", "empty")
    assert len(batch) == 3


def test_not_labelled_is_255_and_never_zero() -> None:
    labelled = sample("a", drivable=np.zeros((32, 64), np.uint8))
    batch = collate([labelled, sample("b")])
    assert set(batch.drivable[0].flatten().tolist()) == {0}
    assert set(batch.drivable[1].flatten().tolist()) == {NOT_LABELLED}
    assert set(batch.lane.flatten().tolist()) == {NOT_LABELLED}


def test_ego_mask_is_ignored_by_every_task() -> None:
    valid = np.ones((32, 64), np.bool_)
    valid[24:, 16:48] = False
    batch = collate([sample("a", drivable=np.ones((32, 64), np.uint8), valid=valid)])
    assert (batch.drivable[0].numpy() == NOT_LABELLED).tolist() == (~valid).tolist()
    covered = np.zeros((32, 64), np.bool_)
    for _, x, y, w, h in batch.ignored.tolist():
        covered[round(y - h / 2) : round(y + h / 2), round(x - w / 2) : round(x + w / 2)] = True
    assert not (covered & valid).any()
    assert (covered & ~valid).sum() > 0.8 * (~valid).sum()


def test_what_one_mask_ignores_counts_for_the_other_and_for_boxes() -> None:
    ones, valid = np.ones((32, 64), np.uint8), np.ones((32, 64), np.bool_)
    valid[:16] = False
    batch = collate([sample("a", drivable=ones, lane=ones, drivable_valid=valid)])
    assert (batch.drivable[0].numpy() == NOT_LABELLED).tolist() == (~valid).tolist()
    assert set(batch.lane[0].flatten().tolist()) == {1}
    assert not len(batch.ignored)
    batch = collate([sample("a", drivable=ones, lane=ones, lane_valid=valid, valid=valid[::-1])])
    assert (batch.drivable[0].numpy() == NOT_LABELLED).tolist() == (~valid[::-1]).tolist()
    assert set(batch.lane[0].flatten().tolist()) == {NOT_LABELLED}


def test_what_lies_between_ignored_areas_is_not_ignored() -> None:
    valid = np.ones((32, 64), np.bool_)
    valid[:4] = valid[28:] = False
    assert collate([sample("a", valid=valid)]).ignored[:, 4].unique().tolist() == [4]


def test_only_one_size() -> None:
    with pytest.raises(ShapeError, match="at least one"):
        collate([])
    with pytest.raises(ShapeError, match="one canvas"):
        collate([sample("a"), Sample("b", np.zeros((64, 64, 3), np.uint8))])


def test_to_keeps_everything() -> None:
    batch = collate([sample("a")]).to("cpu")
    assert batch.names == ("a",)
    assert batch.images.device.type == "cpu"
