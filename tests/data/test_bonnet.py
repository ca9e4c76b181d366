"""A bonnet over the lower edge: what it hides is no road, no marking and no vehicle, and the rest stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from trilitenet.data.bonnet import bonnet
from trilitenet.data.sample import Sample
from trilitenet.data.transforms import Augmentation, TrainTransform, shrink
from trilitenet.errors import ConfigError

SIZE = (180, 320)


def road() -> Sample:
    """A green image that is road all over, with a vehicle far above, one across the edge and one at the bottom."""
    return Sample(
        "road",
        np.full((*SIZE, 3), (20, 200, 20), np.uint8),
        boxes=np.array([[10, 10, 60, 50], [150, 60, 200, 178], [250, 172, 290, 180]], np.float32),
        class_id=np.array([0, 1, 2]),
        drivable=np.ones(SIZE, np.uint8),
        lane=np.ones(SIZE, np.uint8),
    )


@pytest.mark.parametrize("seed", range(30))
def test_what_it_hides_is_labelled_so_and_the_rest_stays(seed: int) -> None:
    before = road()
    after = bonnet(before, np.random.default_rng(seed))
    assert np.array_equal(before.image, road().image)
    assert after.drivable is not None
    assert after.lane is not None
    assert np.array_equal(after.drivable, after.lane)
    hidden = after.drivable == 0
    assert 0 < hidden.mean() <= 0.4
    assert hidden[-1].all()
    assert (np.diff(hidden.astype(int), axis=0) >= 0).all()  # from the edge down to the bottom
    far = ~np.pad(hidden, ((0, 14), (0, 0)), constant_values=True)[14:]  # the edge is soft
    assert np.array_equal(after.image[far], before.image[far])
    below = np.roll(hidden, 8, axis=0) & hidden
    assert (np.abs(after.image[below].astype(int) - before.image[below]).max(axis=1) > 5).mean() > 0.9


@pytest.mark.parametrize("seed", range(30))
def test_boxes_end_at_its_edge(seed: int) -> None:
    before, after = road(), bonnet(road(), np.random.default_rng(seed))
    assert before.boxes is not None
    assert after.boxes is not None
    assert after.class_id is not None
    assert after.drivable is not None
    assert after.boxes[0].tolist() == before.boxes[0].tolist()
    edges = (after.drivable > 0).sum(axis=0)
    shown = dict(zip(after.class_id.tolist(), after.boxes.tolist(), strict=True))
    for number in (1, 2):
        left, top, right, bottom = before.boxes[number].tolist()
        edge = min(bottom, float(edges[int((left + right) / 2)]))
        share = (edge - top) / (bottom - top)
        if number in shown:
            assert shown[number] == pytest.approx([left, top, right, edge], abs=1)
            assert share > 0.35
        else:
            assert share < 0.45
    assert len(after.ignored) <= 2 - (len(shown) - 1)


def test_a_task_without_labels_stays_without() -> None:
    sample = dataclasses.replace(road(), boxes=None, class_id=None, lane=None)
    after = bonnet(sample, np.random.default_rng(0))
    assert after.boxes is None
    assert after.class_id is None
    assert after.lane is None
    assert after.drivable is not None
    assert after.drivable.min() == 0


def test_a_prepared_sample_draws_the_same() -> None:
    transform = TrainTransform((96, 160), Augmentation(bonnet=1.0))
    for seed in range(10):
        whole = transform(road(), np.random.default_rng(seed))
        prepared = transform(shrink(road(), (96, 160), 1), np.random.default_rng(seed))
        assert np.array_equal(whole.image, prepared.image)
        assert np.array_equal(np.asarray(whole.drivable), np.asarray(prepared.drivable))
        assert np.array_equal(np.asarray(whole.boxes), np.asarray(prepared.boxes))


def test_it_is_drawn_as_often_as_asked_for_and_off_by_default() -> None:
    still = Augmentation(rotation=0, scale=0, translation=0, hue=0, saturation=0, value=0, flip=0)
    drawn = 0
    for seed in range(100):
        results = [
            TrainTransform((192, 320), dataclasses.replace(still, bonnet=share))(road(), np.random.default_rng(seed))
            for share in (0.0, 0.3)
        ]
        masks = [each.drivable for each in results]
        assert masks[0] is not None
        assert masks[1] is not None
        assert masks[0].sum() == SIZE[0] * SIZE[1]
        drawn += masks[1].sum() < masks[0].sum()
    assert 15 <= drawn <= 45
    with pytest.raises(ConfigError, match="bonnet is a probability"):
        Augmentation(bonnet=1.5)
