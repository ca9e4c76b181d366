from __future__ import annotations

import contextlib
import io
import json
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from trilitenet.errors import ShapeError
from trilitenet.metrics.detection import AREAS, DetectionMetric
from trilitenet.metrics.published import PublishedDetection

NO_BOXES = np.zeros((0, 4), np.float32)
NO_CLASS = np.zeros(0, np.int64)


def random_boxes(rng: np.random.Generator, count: int) -> np.ndarray:
    low = rng.uniform(0, 400, (count, 2))
    return np.asarray(np.concatenate([low, low + rng.uniform(4, 160, (count, 2))], axis=1).round(2))


def random_images(rng: np.random.Generator, count: int, classes: int) -> list[dict[str, np.ndarray]]:
    images = []
    for _ in range(count):
        truth = random_boxes(rng, int(rng.integers(0, 7)))
        ignored = random_boxes(rng, int(rng.integers(0, 3)))
        truth_class = rng.integers(0, classes, len(truth))
        near = np.repeat(np.arange(len(truth)), rng.integers(0, 4, len(truth)))
        parts = [truth[near] + rng.normal(0, 6, (len(near), 4))]
        parts += [box[None] + rng.normal(0, 10, (int(rng.integers(0, 3)), 4)) for box in ignored]
        parts += [random_boxes(rng, int(rng.integers(0, 6)))]
        boxes = np.concatenate(parts)
        class_id = rng.integers(0, classes, len(boxes))
        class_id[: len(near)] = truth_class[near]
        boxes[:, 2:] = np.maximum(boxes[:, 2:], boxes[:, :2] + 1)
        images.append(
            {
                "truth": truth,
                "truth_class": truth_class,
                "ignored": ignored,
                "boxes": boxes,
                # few distinct confidences, so that ties occur
                "scores": (rng.integers(1, 60, len(boxes)) / 64).astype(np.float32),
                "class_id": class_id,
            }
        )
    return images


def coco_stats(images: list[dict[str, np.ndarray]], classes: int) -> dict[str, Any]:
    annotations: list[dict[str, Any]] = []
    results: list[dict[str, Any]] = []

    def xywh(box: np.ndarray) -> list[float]:
        return [float(box[0]), float(box[1]), float(box[2] - box[0]), float(box[3] - box[1])]

    for index, image in enumerate(images, 1):
        true = [(box, int(number), 0) for box, number in zip(image["truth"], image["truth_class"], strict=True)]
        true += [(box, number, 1) for box in image["ignored"] for number in range(classes)]
        for box, number, crowd in true:
            x, y, width, height = xywh(box)
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": index,
                    "category_id": number + 1,
                    "bbox": [x, y, width, height],
                    "area": width * height,
                    "iscrowd": crowd,
                }
            )
        for box, score, number in zip(image["boxes"], image["scores"], image["class_id"], strict=True):
            results.append(
                {"image_id": index, "category_id": int(number) + 1, "bbox": xywh(box), "score": float(score)}
            )
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO()
        coco.dataset = {
            "info": {},
            "images": [{"id": index} for index in range(1, len(images) + 1)],
            "categories": [{"id": number + 1, "name": str(number)} for number in range(classes)],
            "annotations": annotations,
        }
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes(json.loads(json.dumps(results))), "bbox")
        evaluation.params.maxDets = [1, 10, 300]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"]  # (IoU, recall, class, area, max boxes)
    return {
        name: precision[:, :, :, index, 2].mean(axis=1).T
        for index, name in enumerate(("all", "small", "medium", "large"))
    }


def fill(metric: DetectionMetric, images: list[dict[str, np.ndarray]]) -> DetectionMetric:
    for image in images:
        metric.update(
            image["boxes"],
            image["scores"],
            image["class_id"],
            image["truth"],
            image["truth_class"],
            image["ignored"],
        )
    return metric


@pytest.mark.parametrize(("seed", "classes"), [(0, 1), (1, 1), (2, 3), (3, 3)])
def test_average_precision_is_that_of_pycocotools(seed: int, classes: int) -> None:
    images = random_images(np.random.default_rng(seed), 60, classes)
    metric = fill(DetectionMetric([str(number) for number in range(classes)]), images)
    expected = coco_stats(images, classes)
    for area in AREAS:
        np.testing.assert_allclose(metric.average_precision(area=area)[0], expected[area], atol=1e-9)
    scores = metric.compute()
    assert scores.ap == pytest.approx(expected["all"].mean(), abs=1e-9)
    assert scores.ap50 == pytest.approx(expected["all"][:, 0].mean(), abs=1e-9)
    assert 0.05 < scores.ap < 0.95


def test_one_weight_an_image_is_repeating_the_image(rng: np.random.Generator) -> None:
    images = random_images(rng, 20, 2)
    for image in images:  # without ties, whose order is free
        image["scores"] = rng.uniform(0, 1, len(image["scores"])).astype(np.float32)
    metric = fill(DetectionMetric(["a", "b"]), images)
    counts = rng.integers(0, 4, 20)
    repeated = fill(
        DetectionMetric(["a", "b"]), [image for image, n in zip(images, counts, strict=True) for _ in range(n)]
    )
    weighted = metric.figures(counts[None].astype(np.float64))
    for name, value in repeated.figures().items():
        if not name.endswith("_best"):  # the best confidence is of all images once
            assert weighted[name][0] == pytest.approx(value[0], abs=1e-12), name


def test_a_small_case_by_hand() -> None:
    # Three objects. Boxes: 0.9 right, 0.8 wrong, 0.6 right, 0.2 right (below the stated 0.25).
    truth = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float32)
    boxes = np.concatenate([truth[:1], [[60, 60, 70, 70]], truth[1:]]).astype(np.float32)
    metric = DetectionMetric()
    counts = metric.update(boxes, np.array([0.9, 0.8, 0.6, 0.2]), np.zeros(4, np.int64), truth, np.zeros(3, np.int64))
    assert counts == (2, 1, 1)
    scores = metric.compute()
    # Precision after each hit: 1, 2/3, 3/4; envelope 1 up to recall 1/3 (34 of 101 points), 3/4 beyond (67 points).
    assert scores.ap50 == pytest.approx((34 * 1 + 67 * 0.75) / 101)
    assert scores.at.precision == pytest.approx(2 / 3)
    assert scores.at.recall == pytest.approx(2 / 3)
    assert scores.best.f1 == pytest.approx(2 * 0.75 / 1.75)
    assert scores.best.confidence == pytest.approx(0.2)
    assert scores.recall_all == 1.0
    assert metric.confusion.tolist() == [[2, 1], [1, 0]]


def test_the_figures_at_every_stated_confidence_by_hand() -> None:
    # As above, then an image whose box of 0.3 is wrong: best is still all down to 0.2, 6 / (5 + 4) against 4 / (3 + 4).
    truth = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 80, 40]], np.float32)
    boxes = np.concatenate([truth[:1], [[60, 60, 70, 70]], truth[1:]]).astype(np.float32)
    metric = DetectionMetric(confidence=0.7)
    metric.update(boxes, np.array([0.9, 0.8, 0.6, 0.2]), np.zeros(4, np.int64), truth, np.zeros(3, np.int64))
    metric.update(boxes[1:2], np.array([0.3]), np.zeros(1, np.int64), truth[:1], np.zeros(1, np.int64))
    figures = {name: value.tolist() for name, value in metric.figures(np.array([[1, 1], [0, 1]])).items()}
    assert figures["precision"] == pytest.approx([1 / 2, np.nan], nan_ok=True)
    assert figures["recall"] == pytest.approx([1 / 4, 0])
    assert figures["precision_best"] == pytest.approx([3 / 5, 0])
    assert figures["recall_best"] == pytest.approx([3 / 4, 0])
    assert figures["f1_best"] == pytest.approx([6 / 9, 0])
    assert figures["precision_025"] == pytest.approx([2 / 4, 0])
    assert figures["recall_025"] == pytest.approx([2 / 4, 0])
    assert figures["f1_025"] == pytest.approx([4 / 8, 0])
    assert figures["ap_medium"] == pytest.approx([1, np.nan], nan_ok=True)
    assert 0 < figures["ap_small"][0] < 1
    assert np.isnan(figures["ap_large"]).all()
    best = metric.compute().best
    assert best.f1 == pytest.approx(figures["f1_best"][0])
    metric.update(boxes[:3], np.array([0.9, 0.8, 0.6]), np.zeros(3, np.int64), boxes[:3], np.zeros(3, np.int64))
    assert metric.figures()["f1_best"][0] == pytest.approx(metric.compute().best.f1) != pytest.approx(best.f1)


def test_what_boxes_that_were_cut_off_decide_is_undefined(rng: np.random.Generator) -> None:
    stated, common = (frozenset(f"{name}{suffix}" for name in ("precision", "recall", "f1")) for suffix in ("", "_025"))
    for confidence, lowest, expected in (
        (0.25, 0.0, frozenset()),
        (0.25, 0.255, frozenset()),
        (0.25, 0.4, stated | common),
        (0.4, 0.405, common),
        (0.1, 0.2, stated),
    ):
        metric = fill(DetectionMetric(confidence=confidence, lowest=lowest), random_images(rng, 10, 1))
        for one in (metric, DetectionMetric.from_state(json.loads(json.dumps(metric.state())))):
            figures = one.figures(np.ones((2, 10)))
            assert {name for name, value in figures.items() if np.isnan(value).any()} == expected
            at = one.compute().at
            assert at.confidence == confidence
            for name in ("precision", "recall", "f1"):
                assert getattr(at, name) == pytest.approx(figures[name][0], nan_ok=True)


def test_an_ignored_region_is_neither_object_nor_background() -> None:
    region = np.array([[0, 0, 100, 100]], np.float32)
    inside = np.array([[10, 10, 30, 30], [50, 50, 70, 70]], np.float32)
    metric = DetectionMetric()
    assert metric.update(inside, np.array([0.9, 0.8]), np.zeros(2, np.int64), NO_BOXES, NO_CLASS, region) == (0, 0, 0)
    truth = np.array([[200, 0, 220, 20]], np.float32)
    metric.update(truth, np.array([0.5]), np.zeros(1, np.int64), truth, np.zeros(1, np.int64))
    assert metric.compute().ap50 == pytest.approx(1)
    assert metric.compute().boxes == 1
    without = DetectionMetric()
    without.update(inside, np.array([0.9, 0.8]), np.zeros(2, np.int64), NO_BOXES, NO_CLASS)
    without.update(truth, np.array([0.5]), np.zeros(1, np.int64), truth, np.zeros(1, np.int64))
    assert without.compute().ap50 == pytest.approx(1 / 3)


def test_empty_and_unlabelled_images_are_counted_and_left_out() -> None:
    metric = DetectionMetric()
    metric.update(NO_BOXES, np.zeros(0), NO_CLASS, NO_BOXES, NO_CLASS)
    metric.update(NO_BOXES, np.zeros(0), NO_CLASS, None, None)
    scores = metric.compute()
    assert (scores.images, scores.both_empty, scores.not_labelled) == (0, 1, 1)
    assert np.isnan(scores.ap50)
    assert np.isnan(scores.best.f1)


def test_nothing_found_scores_zero() -> None:
    metric = DetectionMetric()
    metric.update(NO_BOXES, np.zeros(0), NO_CLASS, np.ones((1, 4)) * [0, 0, 5, 5], np.zeros(1, np.int64))
    scores = metric.compute()
    assert (scores.ap50, scores.recall_all, scores.at.f1) == (0.0, 0.0, 0.0)


def test_the_best_f1_is_zero_where_nothing_is_found_and_undefined_without_objects() -> None:
    truth = np.array([[0, 0, 10, 10]], np.float32)
    for boxes, true, best in ((NO_BOXES, truth, 0.0), (truth + 50, truth, 0.0), (truth, NO_BOXES, np.nan)):
        metric = DetectionMetric()
        metric.update(boxes, np.full(len(boxes), 0.5), np.zeros(len(boxes), int), true, np.zeros(len(true), int))
        assert metric.compute().best.f1 == pytest.approx(best, nan_ok=True)


def test_confusion_tells_the_class_taken_for_another() -> None:
    box = np.array([[0, 0, 10, 10]], np.float32)
    metric = DetectionMetric(["car", "bus"])
    metric.update(box, np.array([0.9]), np.array([1]), box, np.array([0]))
    assert metric.confusion.tolist() == [[0, 1, 0], [0, 0, 0], [0, 0, 0]]


def test_a_surer_box_of_another_class_does_not_take_an_object_from_the_right_one() -> None:
    box = np.array([[0, 0, 10, 10]] * 2, np.float32)
    metric = DetectionMetric(["car", "truck"])
    outcome = metric.update(box, np.array([0.85, 0.8]), np.array([0, 1]), box[:1], np.array([1]))
    assert outcome == (1, 1, 0)
    assert metric.confusion.tolist() == [[0, 0, 0], [0, 1, 0], [1, 0, 0]]
    assert (metric.compute().at.precision, metric.compute().at.recall) == (0.5, 1.0)


def test_right_boxes_of_the_confusion_are_those_of_the_recall(rng: np.random.Generator) -> None:
    metric = fill(DetectionMetric(["a", "b", "c"], confidence=0.3), random_images(rng, 40, 3))
    recall = metric.compute().at.recall
    right, objects = np.trace(metric.confusion[:3, :3]), metric.confusion[:3].sum()
    assert recall == pytest.approx(right / objects)


def test_the_state_survives_json(rng: np.random.Generator) -> None:
    metric = fill(DetectionMetric(["a", "b"]), random_images(rng, 10, 2))
    again = DetectionMetric.from_state(json.loads(json.dumps(metric.state())))
    assert again.compute() == metric.compute()
    assert (again.confusion == metric.confusion).all()


def test_histogram_and_curve_count_every_box(rng: np.random.Generator) -> None:
    metric = fill(DetectionMetric(), random_images(rng, 10, 1))
    right, wrong = metric.histogram(10)
    assert right.sum() + wrong.sum() == metric.compute().boxes
    curve = metric.curve()
    assert (np.diff(curve.recall) >= 0).all()
    assert (np.diff(curve.confidence) < 0).all()


def test_arrays_of_different_length_are_refused() -> None:
    with pytest.raises(ShapeError, match="2 predicted boxes have 1 scores"):
        DetectionMetric().update(np.zeros((2, 4)), np.zeros(1), np.zeros(2), NO_BOXES, NO_CLASS)


@pytest.mark.parametrize("metric", [DetectionMetric(), PublishedDetection()])
def test_what_does_not_fit_is_refused_and_nothing_of_it_is_kept(metric: DetectionMetric | PublishedDetection) -> None:
    box = np.array([[0.0, 0.0, 9.0, 9.0]])
    for scores, class_id, truth, truth_class in (
        ([0.9], [1], box, [0]),
        ([0.9], [-1], box, [0]),
        ([0.9], [0], box, [1]),
        ([0.9, 0.8], [0], box, [0]),
        ([0.9], [0], box[:, :3], [0]),
        (None, [0], box, [0]),
    ):
        with pytest.raises(ShapeError):
            metric.update(box, scores, class_id, truth, truth_class)  # type: ignore[arg-type]
    assert len(metric) == 0


def test_plain_empty_lists_are_no_boxes() -> None:
    metric = DetectionMetric()
    assert metric.update([], [], [], [[0, 0, 10, 10]], [0]) == (0, 0, 1)  # type: ignore[arg-type]
    assert metric.update([], [], [], [], []) == (0, 0, 0)  # type: ignore[arg-type]
    assert metric.compute().objects == 1


def test_a_box_at_the_very_overlap_is_right_and_one_at_the_very_confidence_does_not_count() -> None:
    truth = np.array([[0, 0, 10, 10]], np.float32)
    half = np.array([[0, 0, 10, 5]], np.float32)
    metric = DetectionMetric(confidence=0.5)
    assert metric.update(half, np.array([0.5]), np.zeros(1, np.int64), truth, np.zeros(1, np.int64)) == (0, 0, 1)
    scores = metric.compute()
    assert scores.ap50 == pytest.approx(1)
    assert scores.at.recall == 0


def test_boxes_beyond_the_stated_number_do_not_count() -> None:
    truth = np.array([[0, 0, 10, 10]], np.float32)
    boxes = np.concatenate([truth + 50, truth])  # the right one comes second
    for most, recall in ((1, 0.0), (2, 1.0)):
        metric = DetectionMetric(max_boxes=most)
        metric.update(boxes, np.array([0.9, 0.8]), np.zeros(2, np.int64), truth, np.zeros(1, np.int64))
        assert metric.compute().recall_all == recall
