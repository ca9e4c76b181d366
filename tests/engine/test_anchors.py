from __future__ import annotations

import numpy as np
import pytest

from trilitenet.config import DEFAULT_ANCHORS
from trilitenet.data.sample import Sample
from trilitenet.engine.anchors import best_possible_recall, box_sizes, fit_anchors
from trilitenet.errors import DataError


def wide_boxes(count: int = 600) -> np.ndarray:
    rng = np.random.default_rng(0)
    width = np.exp(rng.uniform(np.log(8), np.log(300), count))
    return np.stack([width, width / 3 * rng.uniform(0.8, 1.2, count)], axis=1)


def test_width_comes_first() -> None:
    fit = fit_anchors(wide_boxes(), DEFAULT_ANCHORS)
    assert fit.changed
    assert all(width > 2 * height for level in fit.anchors for width, height in level)


def test_fits_better_and_says_so() -> None:
    boxes = wide_boxes()
    fit = fit_anchors(boxes, DEFAULT_ANCHORS)
    flat = np.array(fit.anchors).reshape(-1, 2)
    assert fit.recall_after == best_possible_recall(boxes, flat) >= fit.recall_before
    assert fit.fit_after > fit.fit_before
    assert (np.diff(flat.prod(axis=1)) >= 0).all()
    assert "best possible recall" in fit.summary()


def test_good_anchors_are_kept() -> None:
    old = fit_anchors(wide_boxes(), DEFAULT_ANCHORS).anchors
    boxes = np.repeat(np.array(old).reshape(-1, 2), 5, axis=0)
    fit = fit_anchors(boxes, old)
    assert fit.anchors == old
    assert fit.fit_after == pytest.approx(1.0)
    assert not fit.changed
    assert "anchors kept" in fit.summary()


def test_boxes_that_are_thinner_than_two_pixels_are_left_out() -> None:
    thin = np.full((50, 2), [100.0, 1.9])
    assert fit_anchors(np.concatenate([wide_boxes(), thin]), DEFAULT_ANCHORS).boxes == 600


def test_anchors_that_suit_well_enough_are_kept() -> None:
    boxes = wide_boxes()
    recall = best_possible_recall(boxes, np.array(DEFAULT_ANCHORS).reshape(-1, 2))
    assert fit_anchors(boxes, DEFAULT_ANCHORS, enough=recall + 0.001).changed
    kept = fit_anchors(boxes, DEFAULT_ANCHORS, enough=recall)
    assert not kept.changed
    assert kept.anchors == DEFAULT_ANCHORS


def test_anchors_that_fit_better_but_take_fewer_boxes_are_not_taken() -> None:
    squares = np.array([[8.0 * 2**k] * 2 for k in range(9)])
    thin = np.full((20, 2), [4.0, 400.0])
    old = np.concatenate([squares[:8] * 1.2, thin[:1]])
    before = tuple(tuple((float(width), float(height)) for width, height in level) for level in old.reshape(3, 3, 2))
    fit = fit_anchors(np.concatenate([np.repeat(squares, 1000, axis=0), thin]), before)
    assert (fit.anchors, fit.recall_after) == (before, 1.0)
    assert fit.fit_before < 0.9


def test_lost_clusters_are_filled_from_the_smallest_box_to_the_largest() -> None:
    common, rare = np.full((5000, 2), [40.0, 30.0]), np.array([[10.0 + 3 * k, 8.0 + 2 * k] for k in range(14, 22)])
    fit = fit_anchors(np.concatenate([common, rare / 2, rare * 2]), (((7.0, 6.0),) * 3,) * 3)
    flat = np.array(fit.anchors).reshape(-1, 2)
    assert fit.changed
    assert flat[0].tolist() == [26.0, 18.0]
    assert flat[-1].tolist() == [146.0, 100.0]


def test_is_deterministic() -> None:
    assert fit_anchors(wide_boxes(), DEFAULT_ANCHORS, seed=3) == fit_anchors(wide_boxes(), DEFAULT_ANCHORS, seed=3)


def test_too_few_boxes_are_refused() -> None:
    with pytest.raises(DataError, match="8 boxes of 8 sizes are too few to fit 9 anchors"):
        fit_anchors(wide_boxes(8), DEFAULT_ANCHORS)
    with pytest.raises(DataError, match="500 boxes of 1 sizes are too few to fit 9 anchors"):
        fit_anchors(np.full((500, 2), 20.0), DEFAULT_ANCHORS)


def test_recall_by_hand() -> None:
    sizes = np.array([[10.0, 10.0], [39.0, 10.0], [40.0, 10.0], [41.0, 10.0]])  # four times is too much
    assert best_possible_recall(sizes, np.array([[10.0, 10.0]])) == 2 / 4


class _Source:
    class_names = ("vehicle",)

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> Sample:
        image = np.zeros((720, 1280, 3), np.uint8)
        if index:
            return Sample("b", image)
        return Sample("a", image, np.array([[0, 0, 100, 40]], np.float32), np.zeros(1, np.int64))

    def attributes(self, index: int) -> dict[str, str]:
        return {}


def test_sizes_are_in_input_pixels() -> None:
    told: list[tuple[int, int]] = []
    sizes = box_sizes(_Source(), (384, 640), progress=lambda done, count: told.append((done, count)))
    assert sizes.tolist() == [[50.0, 20.0]]
    assert told == [(number, len(_Source())) for number in range(1, len(_Source()) + 1)]


def test_the_published_sizes_are_tall() -> None:
    # 100 of 1280 columns times the 360 rows of the resized image, 40 of 720 rows times its 640 columns.
    assert box_sizes(_Source(), (384, 640), swapped=True)[0] == pytest.approx([28.125, 35.556], abs=1e-3)
