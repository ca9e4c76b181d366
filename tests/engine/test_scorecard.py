from __future__ import annotations

import numpy as np
import pytest

from tests.engine.labelled import Images, fake_predictor
from trilitenet.data.sample import Sample
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.report import Provenance
from trilitenet.engine.scorecard import Scorecard
from trilitenet.errors import DataError
from trilitenet.structures import Boxes, Perception

SIZE = (64, 64)


def card(**settings: int | str) -> Scorecard:
    return Scorecard(("vehicle",), ("detection",), **settings)  # type: ignore[arg-type]


def boxes(count: int, *, left: float = 0) -> np.ndarray:
    """Return boxes that do not overlap."""
    corners = np.array([[left + 8 * (index % 4), 8 * (index // 4)] for index in range(count)], np.float32).reshape(
        -1, 2
    )
    return np.concatenate([corners, corners + 7], axis=1)


def add(to: Scorecard, name: str, objects: int, wrong: int, **attributes: str) -> None:
    """Add an image with so many objects, none of them found, and so many wrong boxes."""
    said = Boxes(boxes(wrong, left=32), np.linspace(0.9, 0.5, wrong, dtype=np.float32), np.zeros(wrong, np.int64))
    image = np.zeros((*SIZE, 3), np.uint8)
    sample = Sample(name, image, boxes(objects), np.zeros(objects, np.int64), attributes=attributes)
    to.add(sample, Perception(SIZE, boxes=said), None)


def nothing(images: int) -> Provenance:
    return Provenance("", None, "", "", "", images, {}, {}, {}, (), {}, "", "", 0.0, 0.0)


def test_of_images_as_bad_the_one_with_more_errors_is_the_worse() -> None:
    scores = card(worst=1)
    for name, objects, wrong in (("a", 1, 0), ("b", 3, 0), ("c", 1, 3), ("d", 2, 1)):
        add(scores, name, objects, wrong)
        kept = {"a": "a", "b": "b"}.get(name, "c")
        assert [frame.name for frame in scores.report(nothing, resamples=0).worst] == [kept]


def test_images_without_lanes_that_none_are_seen_on_are_not_among_the_worst() -> None:
    scores = Scorecard(("vehicle",), ("lane",), worst=3)
    lane = np.zeros(SIZE, np.uint8)
    lane[:, 30:34] = 1
    for name, truth in (("empty", np.zeros_like(lane)), ("missed", lane), ("also empty", np.zeros_like(lane))):
        sample = Sample(name, np.zeros((*SIZE, 3), np.uint8), lane=truth)
        scores.add(sample, Perception(SIZE, lane=np.zeros(SIZE, np.bool_)), None)
    assert [(frame.name, frame.score) for frame in scores.report(nothing, resamples=0).worst] == [("missed", 0.0)]


def test_of_images_that_are_alike_the_first_are_kept() -> None:
    report = evaluate(fake_predictor(Images()), Images(), resamples=0, worst=3)
    names = [(frame.task, frame.name) for frame in report.worst]
    assert names == [(task, f"00{index}") for task in ("detection", "drivable", "lane") for index in range(3)]


def test_images_without_an_attribute_that_others_have_are_a_row() -> None:
    scores = card()
    for name, attributes in (
        ("a", {"weather": "rain"}),
        ("b", {"weather": "clear"}),
        ("c", {"weather": ""}),
        ("d", {}),
    ):
        add(scores, name, 1, 0, **attributes)
    rows = [(row.value, row.images) for row in scores.report(nothing, resamples=0).conditions]
    assert rows == [("undefined", 2), ("clear", 1), ("rain", 1)]


def test_images_that_share_a_sequence_are_drawn_together() -> None:
    scores, apart = card(), card(group="image")
    for index, sequence in enumerate(("drive", "drive", "", "other", "drive", "")):
        for to in (scores, apart):
            add(to, str(index), 1 + index, index, sequence=sequence)
    report = scores.report(nothing, resamples=20)
    assert (report.groups, report.group) == ((0, 0, 1, 2, 0, 3), "sequence")
    assert report.drawn == "4 groups of images (by sequence)"
    alone = apart.report(nothing, resamples=20)
    assert (alone.groups, alone.drawn) == ((), "6 images")
    key = "fair/detection/precision"
    assert report.figures[key].value == alone.figures[key].value


def test_a_single_group_gives_no_interval() -> None:
    scores = card()
    for index in range(5):
        add(scores, str(index), 1, index, sequence="drive")
    report = scores.report(nothing, resamples=20)
    assert report.figures["fair/detection/recall"].spread == ""
    assert "--group image" in " ".join(report.summary().split())


def test_an_attribute_to_draw_by_that_no_image_has_is_told(caplog: pytest.LogCaptureFixture) -> None:
    scores = card(group="sorce")
    add(scores, "a", 1, 0, source="x")
    scores.report(nothing, resamples=0)
    assert "no image has the attribute 'sorce' to draw by; did you mean 'source'" in caplog.text


def test_few_is_told_by_the_labels_of_the_task() -> None:
    scores = Scorecard(("vehicle",), ("detection", "lane"), worst=0)
    lane = np.ones(SIZE, np.uint8)
    for index in range(40):
        truth = lane if index < 2 else None
        sample = Sample(
            str(index), np.zeros((*SIZE, 3), np.uint8), boxes(1), np.zeros(1, np.int64), lane=truth,
            attributes={"timeofday": "daytime"},
        )  # fmt: skip
        scores.add(sample, Perception(SIZE, boxes=Boxes.empty(), lane=lane.astype(np.bool_)), None)
    report = scores.report(nothing, resamples=0)
    (row,) = report.conditions
    assert row.labelled == {"detection": 40, "lane": 2}
    assert not row.few
    assert row.few_for("fair/lane/iou")
    assert not row.few_for("fair/detection/ap50")
    assert "(100.0)" in report.summary()


def test_plots_of_detection_have_few_points_and_all_boxes() -> None:
    scores = card(worst=0)
    for index in range(60):
        add(scores, str(index), 1, 8)
    plots = scores.report(nothing, resamples=0).plots
    assert plots is not None
    assert (len(plots.right), len(plots.wrong), sum(plots.wrong)) == (20, 20, 480)
    assert plots.class_names == ("vehicle", "background")
    assert plots.confusion == ((0, 60), (480, 0))
    rng = np.random.default_rng(0)
    for index in range(60, 70):
        image = Sample(str(index), np.zeros((*SIZE, 3), np.uint8), boxes(1), np.zeros(1, np.int64))
        sure = -np.sort(-rng.random(60).astype(np.float32))
        said = Boxes(np.tile(boxes(1, left=40), (60, 1)), sure, np.zeros(60, np.int64))
        scores.add(image, Perception(SIZE, boxes=said), None)
    plots = scores.report(nothing, resamples=0).plots
    assert plots is not None
    assert len(plots.recall) == len(plots.precision) == len(plots.confidence) == 400
    assert plots.confidence[0] > 0.95 > 0.05 > plots.confidence[-1]


def test_pictures_have_the_boxes_above_the_stated_confidence() -> None:
    pictures = []
    for confidence in (0.25, 0.6):
        scores = Scorecard(("vehicle",), ("detection",), confidence=confidence)
        add(scores, "a", 1, 2)  # of confidence 0.9 and 0.5
        pictures.append(scores.report(nothing, resamples=0).worst[0].picture)
    assert pictures[0] != pictures[1]


def test_no_image_is_no_report() -> None:
    with pytest.raises(DataError, match="no images to score"):
        card().report(nothing)
