from __future__ import annotations

import bisect
import json
from typing import Any

import numpy as np
import pytest

from trilitenet.errors import ConfigError, ShapeError
from trilitenet.metrics.published import PublishedDetection, PublishedSegmentation

NO_BOXES = np.zeros((0, 4), np.float32)
NO_CLASS = np.zeros(0, np.int64)

# An independent reading of the published evaluation, in plain loops ------------------------------------------------


def counts_of(prediction: list[list[int]], truth: list[list[int]]) -> list[int]:
    counts = [0, 0, 0, 0]
    for predicted_row, true_row in zip(prediction, truth, strict=True):
        for predicted, true in zip(predicted_row, true_row, strict=True):
            counts[0] += predicted == 1 and true == 1
            counts[1] += predicted == 1 and true == 0
            counts[2] += predicted == 0 and true == 1
            counts[3] += predicted == 0 and true == 0
    return counts


def divide(top: float, bottom: float) -> float:
    return top / bottom if bottom else 0.0


def independent_masks(pairs: list[tuple[Any, Any]], batch: int) -> dict[str, float]:
    sums = {"miou": 0.0, "acc": 0.0, "iou": 0.0, "recall": 0.0}
    images = 0
    for start in range(0, len(pairs), batch):
        part = pairs[start : start + batch]
        tp, fp, fn, tn = (sum(column) for column in zip(*(counts_of(*pair) for pair in part), strict=True))
        foreground, background = divide(tp, tp + fp + fn), divide(tn, tn + fp + fn)
        sensitivity, specificity = divide(tp, tp + fn), divide(tn, tn + fp)
        sums["miou"] += len(part) * (foreground + background) / 2
        sums["acc"] += len(part) * (sensitivity + specificity) / 2
        sums["iou"] += len(part) * foreground
        sums["recall"] += len(part) * sensitivity
        images += len(part)
    return {name: value / images for name, value in sums.items()}


def overlap(first: list[float], second: list[float]) -> float:
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    if width <= 0 or height <= 0:
        return 0.0
    area = [(box[2] - box[0]) * (box[3] - box[1]) for box in (first, second)]
    return width * height / (sum(area) - width * height)


def independent_detection(images: list[dict[str, Any]], thresholds: list[float]) -> dict[str, float]:
    """Recall, precision, mAP50 and mAP of lists of boxes already sorted by falling score an image."""
    rows: list[tuple[float, int, list[bool]]] = []
    targets: dict[int, int] = {}
    for image in images:
        for number in image["truth_class"]:
            targets[number] = targets.get(number, 0) + 1
        taken: set[int] = set()
        for box, score, number in zip(image["boxes"], image["scores"], image["class_id"], strict=True):
            best, which = 0.0, -1
            for index, (true, true_class) in enumerate(zip(image["truth"], image["truth_class"], strict=True)):
                value = overlap(box, true)
                if true_class == number and value > best:
                    best, which = value, index
            right = [False] * len(thresholds)
            if best > thresholds[0] and which not in taken:
                taken.add(which)
                right = [best > threshold for threshold in thresholds]
            rows.append((score, number, right))
    rows.sort(key=lambda row: -row[0])
    recalls, precisions, averages = [], [], []
    for number, count in sorted(targets.items()):
        mine = [right for _, one, right in rows if one == number]
        per_threshold = []
        for level in range(len(thresholds)):
            found, curve = 0, []
            for rank, right in enumerate(mine, 1):
                found += right[level]
                curve.append((found / count, found / rank))
            per_threshold.append(independent_average(curve))
            if level == 0:
                recalls.append(curve[-1][0] if curve else 0.0)
                precisions.append(curve[-1][1] if curve else 0.0)
        averages.append(per_threshold)
    return {
        "recall": sum(recalls) / len(recalls),
        "precision": sum(precisions) / len(precisions),
        "map50": sum(one[0] for one in averages) / len(averages),
        "map": sum(sum(one) / len(one) for one in averages) / len(averages),
    }


def independent_average(curve: list[tuple[float, float]]) -> float:
    if not curve:
        return 0.0
    points = [(0.0, 1.0), *curve, (curve[-1][0] + 1e-3, 0.0)]
    envelope = [precision for _, precision in points]
    for index in range(len(points) - 2, -1, -1):
        envelope[index] = max(envelope[index], envelope[index + 1])
    recalls = [recall for recall, _ in points]

    def height(at: float) -> float:
        left = bisect.bisect_right(recalls, at) - 1
        if left == len(points) - 1:
            return envelope[-1]
        (x0, _), (x1, _) = points[left], points[left + 1]
        return envelope[left] + (envelope[left + 1] - envelope[left]) * (at - x0) / (x1 - x0)

    grid = [float(value) for value in np.linspace(0, 1, 101)]
    heights = [height(at) for at in grid]
    return sum((heights[i] + heights[i + 1]) / 2 * (grid[i + 1] - grid[i]) for i in range(100))


# -------------------------------------------------------------------------------------------------------------------


def random_image(rng: np.random.Generator, classes: int) -> dict[str, Any]:
    low = rng.uniform(0, 300, (int(rng.integers(0, 6)), 2))
    truth = np.concatenate([low, low + rng.uniform(8, 90, low.shape)], axis=1)
    near = np.repeat(truth, rng.integers(0, 4, len(truth)), axis=0)
    near = near + rng.normal(0, 5, near.shape)
    low = rng.uniform(0, 300, (int(rng.integers(0, 5)), 2))
    boxes = np.concatenate([near, np.concatenate([low, low + 20], axis=1)])
    boxes[:, 2:] = np.maximum(boxes[:, 2:], boxes[:, :2] + 1)
    scores = np.sort(rng.uniform(0.001, 1, len(boxes)).astype(np.float32))[::-1]
    return {
        "truth": truth,
        "truth_class": rng.integers(0, classes, len(truth)),
        "boxes": rng.permutation(boxes),
        "scores": scores,
        "class_id": rng.integers(0, classes, len(boxes)),
    }


@pytest.mark.parametrize("classes", [1, 3])
def test_detection_equals_an_independent_computation_on_200_random_predictions(classes: int) -> None:
    rng = np.random.default_rng(classes)
    images = [random_image(rng, classes) for _ in range(200)]
    metric = PublishedDetection(classes)
    for image in images:
        metric.update(image["boxes"], image["scores"], image["class_id"], image["truth"], image["truth_class"])
    listed = [{name: value.tolist() for name, value in image.items()} for image in images]
    expected = independent_detection(listed, [0.5 + 0.05 * step for step in range(10)])
    scores = metric.compute()
    for name, value in expected.items():
        assert getattr(scores, name) == pytest.approx(value, abs=1e-6), name
    assert 0.05 < scores.map50 < 0.95


def test_masks_equal_an_independent_computation_on_200_random_predictions(rng: np.random.Generator) -> None:
    pairs = []
    metric = PublishedSegmentation(batch_size=24)  # the last batch is a small one
    for _ in range(200):
        shape = tuple(rng.integers(3, 20, 2))
        truth = rng.random(shape) < rng.choice([0.0, 0.1, 0.5])
        prediction = truth ^ (rng.random(shape) < 0.2)
        pairs.append((prediction.astype(int).tolist(), truth.astype(int).tolist()))
        metric.update(prediction, truth)
    scores = metric.compute()
    for name, value in independent_masks(pairs, 24).items():
        assert getattr(scores, name) == pytest.approx(value, abs=1e-6), name
    for name, value in independent_masks(pairs, 200).items():
        assert getattr(scores, f"dataset_{name}") == pytest.approx(value, abs=1e-6), name
    assert scores.miou != pytest.approx(scores.dataset_miou, abs=1e-3)  # the averaging matters


def test_figures_under_weights_are_those_of_repeated_images(rng: np.random.Generator) -> None:
    weights = np.array([2, 0, 1, 3, 0, 1])
    masks = [(rng.random((5, 6)) < 0.5, rng.random((5, 6)) < 0.5) for _ in weights]
    images = [random_image(rng, 1) for _ in weights]
    both = [(PublishedSegmentation(4), PublishedDetection(1)) for _ in range(2)]
    for index, count in enumerate(weights):
        for (segmentation, detection), times in zip(both, (1, count), strict=True):
            for _ in range(times):
                segmentation.update(*masks[index])
                image = images[index]
                detection.update(
                    image["boxes"], image["scores"], image["class_id"], image["truth"], image["truth_class"]
                )
    for once, repeated in zip(*both, strict=True):
        for name, value in once.figures(weights[None]).items():
            assert value[0] == pytest.approx(repeated.figures()[name][0]), name


def test_unlabelled_images_weigh_nothing() -> None:
    metric = PublishedSegmentation(2)
    assert np.isnan(metric.compute().miou)
    ones = np.ones((2, 2), np.uint8)
    metric.update(ones, ones)
    metric.update(ones, None)
    metric.update(None, ones)
    scores = metric.compute()
    assert (scores.images, scores.not_labelled) == (1, 2)
    assert scores.iou == scores.dataset_iou == 1.0
    detection = PublishedDetection()
    detection.update(np.ones((1, 4)), np.ones(1), np.zeros(1, np.int64), None, None)
    assert detection.compute().boxes == 0
    assert np.isnan(detection.compute().map50)


def test_nothing_predicted_scores_zero() -> None:
    metric = PublishedDetection()
    metric.update(NO_BOXES, np.zeros(0), NO_CLASS, np.array([[0, 0, 5, 5]]), np.zeros(1, np.int64))
    scores = metric.compute()
    assert (scores.recall, scores.map50, scores.map) == (0.0, 0.0, 0.0)


def test_the_states_survive_json(rng: np.random.Generator) -> None:
    segmentation, detection = PublishedSegmentation(3), PublishedDetection(2)
    for _ in range(7):
        segmentation.update(rng.random((4, 4)) < 0.5, rng.random((4, 4)) < 0.5)
        image = random_image(rng, 2)
        detection.update(image["boxes"], image["scores"], image["class_id"], image["truth"], image["truth_class"])
    assert (
        PublishedSegmentation.from_state(json.loads(json.dumps(segmentation.state()))).compute()
        == segmentation.compute()
    )
    assert PublishedDetection.from_state(json.loads(json.dumps(detection.state()))).compute() == detection.compute()


def test_impossible_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="batch_size"):
        PublishedSegmentation(0)
    with pytest.raises(ShapeError, match="2 predicted boxes have 1 scores"):
        PublishedDetection().update(np.ones((2, 4)), np.ones(1), np.zeros(2), NO_BOXES, NO_CLASS)


def test_plain_empty_lists_are_no_boxes() -> None:
    metric = PublishedDetection()
    metric.update([], [], [], [[0, 0, 10, 10]], [0])  # type: ignore[arg-type]
    metric.update([], [], [], [], [])  # type: ignore[arg-type]
    assert (metric.compute().objects, metric.compute().images) == (1, 2)


def test_curve_and_histogram_count_every_box_by_the_published_matching(rng: np.random.Generator) -> None:
    metric = PublishedDetection()
    for _ in range(20):
        low = rng.uniform(0, 60, (4, 2))
        truth = np.concatenate([low, low + 20], axis=1)
        boxes = np.concatenate([truth + rng.normal(0, 3, truth.shape), truth + 50])
        metric.update(boxes, rng.integers(1, 9, 8) / 10, np.zeros(8, np.int64), truth, np.zeros(4, np.int64))
    scores, curve = metric.compute(), metric.curve()
    right, wrong = metric.histogram(10)
    assert (right.sum() + wrong.sum(), right.sum()) == (scores.boxes, pytest.approx(scores.recall * scores.objects))
    assert curve.recall[-1] == pytest.approx(scores.recall)
    assert curve.precision[-1] == pytest.approx(scores.precision)
    assert (np.diff(curve.confidence) < 0).all()
    assert len(PublishedDetection().curve().confidence) == 0


def test_pixels_are_counted_over_the_data_set() -> None:
    metric = PublishedSegmentation(1)
    mask = np.array([[1, 1, 0, 0]], np.uint8)
    metric.update(mask, np.array([[1, 0, 0, 0]], np.uint8))
    metric.update(mask, mask)
    metric.update(mask, None)
    scores = metric.compute()
    counts = (scores.true_positive, scores.false_positive, scores.false_negative, scores.true_negative)
    assert counts == (3, 1, 0, 4)
    assert scores.dataset_iou == pytest.approx(3 / 4)
