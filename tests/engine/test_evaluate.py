from __future__ import annotations

import contextlib
import dataclasses
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.engine.labelled import FakeBackend, FakePredictor, Images, fake_predictor
from trilitenet.config import Thresholds
from trilitenet.data.sample import Sample
from trilitenet.engine.evaluate import best_thresholds, evaluate, score_predictions
from trilitenet.engine.predictions import PredictionWriter, SavedPredictions
from trilitenet.engine.report import Report
from trilitenet.engine.scorecard import Scorecard
from trilitenet.errors import BackendError, ConfigError, DataError
from trilitenet.structures import Boxes, Perception, RawOutputs


def values(report: Report) -> dict[str, float]:
    return {key: figure.value for key, figure in report.figures.items()}


def test_a_perfect_predictor_scores_one() -> None:
    images = Images()
    report = evaluate(fake_predictor(images), images, resamples=50)
    assert report.fair is not None
    assert report.fair.drivable is not None
    assert report.fair.detection is not None
    assert report.fair.lane is not None
    assert report.fair.drivable.miou == 1.0
    assert report.fair.lane.as_labelled.iou == 1.0
    assert report.fair.lane.boundary_f == {1: 1.0, 2: 1.0, 5: 1.0}
    assert report.fair.detection.ap50 == pytest.approx(1.0)
    assert report.fair.detection.at.f1 == 1.0
    assert report.fair.detection.at.confidence == 0.3
    assert report.paper is None
    figure = report.figures["fair/drivable/miou"]
    assert (figure.value, figure.low, figure.high) == (1.0, 1.0, 1.0)


def test_a_drifting_predictor_scores_less_and_its_interval_holds_the_value() -> None:
    images = Images()
    report = evaluate(fake_predictor(images, drift=3), images, protocol="both", resamples=200)
    undefined = [key for key, figure in report.figures.items() if np.isnan(figure.value)]
    assert undefined == ["fair/detection/ap_medium", "fair/detection/ap_large"]  # there are no such boxes
    for key, figure in report.figures.items():
        if key in undefined:
            continue
        assert figure.low is not None
        assert figure.high is not None
        assert figure.low - 1e-9 <= figure.value <= figure.high + 1e-9, key
    assert report.figures["fair/lane/iou"].value == pytest.approx(1 / 7)
    assert report.protocols == ("fair", "paper")


class _DoubledMasks(FakeBackend):
    """As an artefact of --mask-scale 2."""

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        raw = super().run(batch)
        assert raw.drivable is not None
        assert raw.lane is not None
        drivable, lane = (mask.repeat(2, 1).repeat(2, 2) for mask in (raw.drivable, raw.lane))
        return RawOutputs(raw.detection, drivable, lane)


def test_masks_that_a_backend_enlarges_count_in_both_protocols() -> None:
    images = Images(4)
    predictors = FakePredictor(_DoubledMasks(images)), fake_predictor(images)
    doubled, plain = (values(evaluate(one, images, protocol="both", resamples=0)) for one in predictors)
    assert doubled["fair/lane/iou"] == 1
    for key in ("paper/drivable/miou", "paper/lane/iou"):
        assert doubled[key] == pytest.approx(plain[key], abs=0.01)


@pytest.mark.parametrize("protocol", ["fair", "paper"])
def test_figures_do_not_hang_on_the_batch_size(protocol: str) -> None:
    images = Images()
    one = fake_predictor(images, drift=2)
    several = fake_predictor(images, drift=2)
    first = evaluate(one, images, protocol=protocol, resamples=0)
    second = evaluate(several, images, protocol=protocol, resamples=0, batch_size=2)
    assert str(values(first)) == str(values(second))
    assert set(one.backend.batches) == {1}
    assert max(several.backend.batches) == 2  # neighbours of one size share a batch
    assert sum(several.backend.batches) == len(images)


def test_predictions_are_handed_on_in_order_at_the_images_own_size() -> None:
    images = Images()
    seen: list[str] = []

    def look(sample: object, prediction: Perception) -> None:
        assert isinstance(sample, Sample)
        assert prediction.size == sample.size
        seen.append(sample.name)

    for protocol in ("fair", "paper"):
        evaluate(fake_predictor(images), images, protocol=protocol, resamples=0, limit=7, on_prediction=look)
    assert seen == [f"{index:03d}" for index in range(7)] * 2


def test_the_image_is_changed_for_the_network_alone() -> None:
    images = Images()
    names = []

    def change(image: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        names.append(name)
        return image // np.array([4, 1, 1], np.uint8)

    report = evaluate(fake_predictor(images), images, resamples=0, change=change)
    assert names == [f"{index:03d}" for index in range(12)]
    assert values(report)["fair/drivable/iou"] == 0.0
    assert values(report)["fair/lane/iou"] == 1.0


def test_conditions_hold_their_own_images() -> None:
    images = Images()
    report = evaluate(fake_predictor(images, drift=2), images, resamples=0)
    assert [(row.attribute, row.value, row.images) for row in report.conditions] == [
        ("timeofday", "daytime", 9),
        ("timeofday", "night", 3),
    ]  # the scene is undefined everywhere, weather is not there
    assert all(row.few for row in report.conditions)
    night = Images()
    night._samples = [sample for sample in night._samples if sample.attributes["timeofday"] == "night"]
    alone = evaluate(fake_predictor(images, drift=2), night, resamples=0)
    assert report.conditions[1].figures == pytest.approx(values(alone), nan_ok=True)


def test_an_attribute_that_is_named_twice_has_one_table() -> None:
    report = evaluate(fake_predictor(Images()), Images(), resamples=0, by=("timeofday", "scene", "timeofday"))
    assert [(row.value, row.images) for row in report.conditions] == [("daytime", 9), ("night", 3)]


def test_an_attribute_that_no_image_has_is_told(caplog: pytest.LogCaptureFixture) -> None:
    evaluate(fake_predictor(Images()), Images(), resamples=0, by=("timeofday", "weather", "timofday"))
    message = "no image has the attribute 'timofday' to make a table by; did you mean 'timeofday'?"
    assert [record.message for record in caplog.records] == [message]


def test_the_worst_images_are_kept_with_a_picture() -> None:
    images = Images()
    report = evaluate(fake_predictor(images, drift=4), images, resamples=0, worst=3)
    for task in ("detection", "drivable", "lane"):
        frames = [frame for frame in report.worst if frame.task == task]
        assert len(frames) == 3
        assert [frame.score for frame in frames] == sorted(frame.score for frame in frames)
        assert all(frame.picture.startswith(b"\xff\xd8") for frame in frames)
    assert evaluate(fake_predictor(images), images, resamples=0, worst=0).worst == ()


def test_saved_predictions_score_as_the_predictor_did(tmp_path: Path) -> None:
    images = Images()
    predictor = fake_predictor(images, drift=2)
    with PredictionWriter(tmp_path, ("detection", "drivable", "lane")) as writer:
        report = evaluate(
            predictor,
            images,
            resamples=0,
            on_prediction=lambda sample, prediction: writer.write(sample.name, prediction),
        )
    saved = score_predictions(SavedPredictions(tmp_path, ("vehicle",)), images, confidence=0.3, resamples=0)
    assert values(saved) == pytest.approx(values(report), abs=1e-9, nan_ok=True)
    assert saved.provenance.runtime == "saved predictions"
    again = SavedPredictions(tmp_path, ("vehicle",))
    both = score_predictions(again, images, protocol="both", confidence=0.5, paper_batch=5, resamples=0)
    assert values(both)["paper/drivable/miou"] > 0.8
    assert both.fair is not None
    assert both.fair.detection is not None
    assert both.fair.detection.at.confidence == 0.5
    assert both.provenance.settings["paper_batch"] == 5


def test_what_saved_predictions_leave_out_is_undefined_at_the_common_confidence(tmp_path: Path) -> None:
    images = Images()
    with PredictionWriter(tmp_path, ("detection",)) as writer:
        for sample in images._samples:
            assert sample.boxes is not None
            boxes = Boxes(sample.boxes, np.full(3, 0.4, np.float32), np.zeros(3, np.int64))
            writer.write(sample.name, Perception(sample.size, ("vehicle",), boxes=boxes))
    saved = score_predictions(SavedPredictions(tmp_path, ("vehicle",)), images, protocol="both", resamples=5)
    assert {figure.spread for key, figure in saved.figures.items() if key.endswith("_025")} == {""}
    for name in ("precision", "recall", "f1"):
        known = [values(saved)[f"fair/detection/{name}{suffix}"] for suffix in ("_best", "", "_025")]
        assert known == pytest.approx([1.0, np.nan, np.nan], nan_ok=True)  # 0.25 is the stated confidence too
    own = score_predictions(SavedPredictions(tmp_path, ("vehicle",)), images, confidence=0.395, resamples=0)
    assert values(own)["fair/detection/f1"] == 1.0
    settings = saved.provenance.settings
    assert settings["lowest_confidence"] == pytest.approx(0.4)
    assert settings["paper_thresholds"] == {"confidence": 0.001, "max_boxes": 300}
    predictor = fake_predictor(images)
    predictor.thresholds = Thresholds(confidence=0.9)  # boxes are looked for down to 0.001 all the same
    report = evaluate(predictor, images, resamples=0)
    assert (values(report)["fair/detection/f1"], values(report)["fair/detection/f1_025"]) == (0.0, 1.0)
    assert "paper_thresholds" not in report.provenance.settings


def test_the_best_thresholds_are_found_in_one_pass() -> None:
    images = Images()
    predictor = fake_predictor(images)
    run = predictor.backend.run

    def unsure(batch: np.ndarray) -> object:
        raw = run(batch)
        assert raw.drivable is not None
        assert raw.lane is not None
        # Drivable 80 inside and 60 outside, lane 200 inside and 180 outside: the cuts lie between.
        return dataclasses.replace(
            raw,
            drivable=np.where(raw.drivable == 255, 80, 60).astype(np.uint8),
            lane=np.where(raw.lane == 255, 200, 180).astype(np.uint8),
        )

    predictor.backend.run = unsure  # type: ignore[method-assign,assignment]
    best = best_thresholds(predictor, images)
    assert 60 / 255 < best.thresholds.drivable < 80 / 255
    assert 180 / 255 < best.thresholds.lane < 200 / 255
    assert 0.09 < best.thresholds.confidence < 0.81
    assert (best.drivable_iou, best.lane_iou, best.detection_f1) == (1.0, 1.0, 1.0)
    predictor.thresholds = best.thresholds
    assert values(evaluate(predictor, images, resamples=0))["fair/drivable/iou"] == 1.0


def test_without_labels_thresholds_stay() -> None:
    images = Images(3)
    images._samples = [
        dataclasses.replace(sample, boxes=None, class_id=None, drivable=None, lane=None) for sample in images._samples
    ]
    best = best_thresholds(fake_predictor(images), _WithBoxes(images))
    assert best.thresholds == Thresholds(confidence=0.3)
    assert np.isnan([best.detection_f1, best.drivable_iou, best.lane_iou]).all()


class _WithBoxes:
    """Images without labels, for a fake backend that looks boxes up elsewhere."""

    class_names = ("vehicle",)

    def __init__(self, images: Images) -> None:
        self._blank = list(images._samples)
        images._samples = Images(3)._samples

    def __len__(self) -> int:
        return len(self._blank)

    def __getitem__(self, index: int) -> Sample:
        return self._blank[index]


def test_what_cannot_be_evaluated_is_refused() -> None:
    images = Images()
    predictor = fake_predictor(images)
    with pytest.raises(ConfigError, match="unknown protocol 'unfair'"):
        evaluate(predictor, images, protocol="unfair")
    for limit, batch_size in ((0, 1), (None, 0)):
        with pytest.raises(DataError, match="no images to evaluate on"):
            best_thresholds(predictor, images, limit=limit, batch_size=batch_size)
    images.class_names = ("car", "bus")
    with pytest.raises(ConfigError, match="the model has classes vehicle, the labels car, bus"):
        evaluate(predictor, images)
    predictor.backend.card = dataclasses.replace(predictor.backend.card, class_names=("car", "bus"))
    images.class_names = ("vehicle",)
    with pytest.raises(ConfigError, match="the model has classes car, bus, the labels vehicle"):
        evaluate(predictor, images)
    predictor.backend.card = dataclasses.replace(predictor.backend.card, tasks=("drivable", "lane"))
    assert evaluate(predictor, images, resamples=0).fair is not None  # its classes tell nothing


def test_an_error_while_reading_is_the_callers() -> None:
    class Broken(Images):
        def __getitem__(self, index: int) -> Sample:
            if index == 5:
                raise DataError("005.jpg: broken")
            return super().__getitem__(index)

    with pytest.raises(DataError, match=r"005\.jpg: broken"):
        evaluate(fake_predictor(Images()), Broken(), resamples=0)


def test_memory_grows_by_little_more_than_counts() -> None:
    rng = np.random.default_rng(0)
    card = Scorecard(("vehicle",), ("detection", "drivable", "lane"), protocol="fair", worst=4)
    mask = np.zeros((64, 64), np.uint8)
    mask[30:34] = 1

    def add(index: int) -> None:
        boxes = rng.uniform(0, 50, (20, 4)).astype(np.float32)
        boxes[:, 2:] += boxes[:, :2]
        sample = Sample(
            name=f"{index}",
            image=np.zeros((64, 64, 3), np.uint8),
            boxes=boxes[:3],
            class_id=np.zeros(3, np.int64),
            drivable=mask,
            lane=mask,
        )
        scores = np.sort(rng.random(20).astype(np.float32))[::-1]
        predicted = Perception(
            (64, 64), boxes=Boxes(boxes, scores, np.zeros(20, np.int64)), drivable=mask > 0, lane=mask > 0
        )
        card.add(sample, predicted, None)

    for index in range(100):
        add(index)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for index in range(100, 500):
        add(index)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    # An image of 64x64 with its labels takes 20 kB; what stays of it is counts and 20 boxes of about 30 bytes.
    assert grown / 400 < 3000


class ParallelBackend(FakeBackend):
    inside = 0
    fails = False

    @contextlib.contextmanager
    def in_parallel(self) -> Iterator[int]:
        self.inside += 1
        try:
            yield 3
        finally:
            self.inside -= 1

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        assert self.inside == 1
        if self.fails:
            raise BackendError("the runtime is gone")
        number = int(batch[0, batch.shape[1] // 2, 0, 2])
        time.sleep(0.01 * (3 - number % 3))  # batches finish in another order than they came
        return super().run(batch)


def test_a_backend_that_runs_in_parallel_changes_no_figure() -> None:
    images = Images(20)
    alone = evaluate(fake_predictor(images, drift=2), images, resamples=0)
    backend = ParallelBackend(images, drift=2)
    together = evaluate(FakePredictor(backend), images, resamples=0, batch_size=2)
    assert backend.inside == 0
    assert together.names == alone.names
    assert str(values(together)) == str(values(alone))
    backend.fails = True
    with pytest.raises(BackendError, match="gone"):
        evaluate(FakePredictor(backend), images, resamples=0)
    assert backend.inside == 0


def test_progress_is_told_image_by_image(tmp_path: Path) -> None:
    images = Images(4)
    told: list[tuple[int, int]] = []

    def progress(done: int, total: int) -> None:
        told.append((done, total))

    evaluate(fake_predictor(images), images, resamples=0, progress=progress)
    best_thresholds(fake_predictor(images), images, limit=3, progress=progress)
    (tmp_path / "detections.json").write_text("[]")
    saved = SavedPredictions(tmp_path, ("vehicle",))
    score_predictions(saved, images, limit=2, resamples=0, progress=progress)
    assert told == [*((n, 4) for n in (1, 2, 3, 4)), *((n, 3) for n in (1, 2, 3)), (1, 2), (2, 2)]


def test_the_worst_images_are_the_worst_of_all() -> None:
    images = Images()
    few, every = (
        evaluate(fake_predictor(images, drift=4), images, resamples=0, worst=count).worst for count in (3, len(images))
    )
    for task in ("detection", "drivable"):
        scores = [frame.score for frame in every if frame.task == task]
        assert scores[0] < scores[-1]
        assert [frame.score for frame in few if frame.task == task] == scores[:3]


def make_unsure(predictor: FakePredictor, inside: int, outside: int) -> None:
    """Let a predictor give these probabilities x 255 of drivable in place of 255 and 0."""
    run = predictor.backend.run

    def unsure(batch: np.ndarray) -> RawOutputs:
        raw = run(batch)
        assert raw.drivable is not None
        return dataclasses.replace(raw, drivable=np.where(raw.drivable == 255, inside, outside).astype(np.uint8))

    predictor.backend.run = unsure  # type: ignore[method-assign]


def test_thresholds_are_not_told_from_what_does_not_count() -> None:
    images = Images()
    predictor = fake_predictor(images)
    make_unsure(predictor, 80, 60)
    plain = best_thresholds(predictor, images)
    for index, sample in enumerate(images._samples):  # wrong labels on the own car, which is the lower half
        assert sample.drivable is not None
        valid = np.ones(sample.drivable.shape, np.bool_)
        valid[:, :40] = False
        drivable = np.where(valid, sample.drivable, 1 - sample.drivable).astype(np.uint8)
        images._samples[index] = dataclasses.replace(sample, drivable=drivable, valid=valid)
    found = best_thresholds(predictor, images)
    assert found.drivable_iou == plain.drivable_iou == 1.0


def test_the_best_threshold_lies_just_below_the_best_value() -> None:
    images = Images()
    predictor = fake_predictor(images)
    make_unsure(predictor, 100, 99)
    best = best_thresholds(predictor, images)
    assert best.drivable_iou == 1.0
    predictor.thresholds = best.thresholds
    assert values(evaluate(predictor, images, resamples=0))["fair/drivable/iou"] == 1.0


def test_saved_masks_count_in_the_paper_protocol_where_half_a_pixel_is_foreground(tmp_path: Path) -> None:
    images = Images(1)
    true = np.zeros((720, 1280), np.uint8)
    true[400:, 200:1000] = 1
    images._samples = [
        dataclasses.replace(images[0], image=np.zeros((720, 1280, 3), np.uint8), drivable=true, lane=None)
    ]
    (tmp_path / "drivable").mkdir()
    saved = true * np.uint8(255)
    saved[100:300:4, ::4] = 255  # a quarter of a pixel of the canvas each
    cv2.imwrite(str(tmp_path / "drivable" / "000.png"), saved)
    report = score_predictions(SavedPredictions(tmp_path, ("vehicle",)), images, protocol="paper", resamples=0)
    assert values(report)["paper/drivable/iou"] == 1.0


def test_a_single_class_may_be_called_otherwise_by_the_labels() -> None:
    images = Images(2)
    images.class_names = ("car",)
    scores = evaluate(fake_predictor(images), images, resamples=0).fair
    assert scores is not None
    assert scores.detection is not None
    assert scores.detection.ap50 == pytest.approx(1.0)


@pytest.mark.parametrize(("confidence", "lowest"), [(0.3, 0.001), (0.0, 0.0)])
def test_average_precision_needs_doubtful_boxes_too(confidence: float, lowest: float) -> None:
    images = Images(3)
    for score, found in ((lowest + 0.0005, 1.0), (lowest - 0.0005, 0.0)):
        predictor = fake_predictor(images)
        predictor.thresholds = Thresholds(confidence=confidence)
        run = predictor.backend.run

        def doubt(batch: np.ndarray, run: Callable[..., RawOutputs] = run, score: float = score) -> RawOutputs:
            raw = run(batch)
            assert raw.detection is not None
            raw.detection[:, :3, 4:] = np.sqrt(max(score, 0))
            return raw

        predictor.backend.run = doubt  # type: ignore[method-assign]
        scores = evaluate(predictor, images, resamples=0).fair
        assert scores is not None
        assert scores.detection is not None
        assert scores.detection.recall_all == found
        assert scores.detection.at.recall == (found if score > confidence else 0.0)


@pytest.mark.parametrize(
    ("long_side", "inside", "outside", "iou"),
    [(640, 128, 127, 1.0), (320, 255, 0, 1.0), (320, 130, 0, 179 / 180)],  # the last loses a row between pixels
)
def test_the_paper_protocol_takes_the_likelier_class_without_padding(
    long_side: int, inside: int, outside: int, iou: float
) -> None:
    images = Images(1)
    drivable = np.zeros((360, 640), np.uint8)
    drivable[180:] = 1
    image = np.stack([drivable * 255, np.zeros_like(drivable), np.zeros_like(drivable)], axis=2)
    images._samples = [dataclasses.replace(images[0], image=image, drivable=drivable, lane=None)]
    predictor = fake_predictor(images)
    predictor.long_side = long_side

    def run(batch: np.ndarray) -> RawOutputs:
        masks = np.where(batch[..., 0] == 255, inside, outside).astype(np.uint8)
        return RawOutputs(None, np.where(batch[..., 0] == 114, np.uint8(255), masks), None)  # the padding is foreground

    predictor.backend.run = run  # type: ignore[method-assign]
    report = evaluate(predictor, images, protocol="paper", resamples=0)
    assert values(report)["paper/drivable/iou"] == iou


def test_the_best_confidence_lies_half_way_to_nothing_below_the_last_box() -> None:
    images = Images(3)
    predictor = fake_predictor(images)
    run = predictor.backend.run

    def doubt(batch: np.ndarray) -> RawOutputs:
        raw = run(batch)
        assert raw.detection is not None
        raw.detection[:, :3, 4:] = np.sqrt(0.1)
        return dataclasses.replace(raw, detection=raw.detection[:, :3])

    predictor.backend.run = doubt  # type: ignore[method-assign]
    best = best_thresholds(predictor, images)
    assert best.detection_f1 == 1.0
    assert best.thresholds.confidence == pytest.approx(0.05)  # half way to nothing


def test_thresholds_of_what_a_network_has_not_or_never_finds_stay() -> None:
    images = Images(2)
    predictor = fake_predictor(images)
    find = predictor.backend.run

    def find_nothing(batch: np.ndarray) -> RawOutputs:
        return RawOutputs(np.zeros((len(batch), 1, 6), np.float32), None, None)

    predictor.backend.run = find_nothing  # type: ignore[method-assign]
    best = best_thresholds(predictor, images)
    assert best.thresholds == predictor.thresholds
    assert np.isnan([best.drivable_iou, best.lane_iou]).all()
    predictor.backend.run = lambda batch: dataclasses.replace(find(batch), drivable=None)  # type: ignore[method-assign]
    empty = Images(2)
    empty._samples = [
        dataclasses.replace(sample, boxes=np.zeros((0, 4), np.float32), class_id=np.zeros(0, np.int64))
        for sample in images._samples
    ]
    best = best_thresholds(predictor, empty)  # boxes, and no object
    assert best.thresholds.confidence == 0.3
    assert np.isnan(best.detection_f1)


def test_thresholds_stay_where_nothing_is_ever_right() -> None:
    images = Images(2)
    predictor = fake_predictor(images)
    find = predictor.backend.run

    def err(batch: np.ndarray) -> RawOutputs:
        raw = find(batch)
        assert raw.detection is not None and raw.drivable is not None and raw.lane is not None  # noqa: PT018
        raw.detection[..., :4] = (2, 2, 4, 4)
        return RawOutputs(raw.detection, 255 - raw.drivable, 255 - raw.lane)

    predictor.backend.run = err  # type: ignore[method-assign]
    best = best_thresholds(predictor, images)
    assert best.thresholds == predictor.thresholds
    assert (best.detection_f1, best.drivable_iou, best.lane_iou) == (0.0, 0.0, 0.0)


def test_each_mask_has_its_own_threshold() -> None:
    images = Images(3)
    predictor = fake_predictor(images)
    predictor.thresholds = Thresholds(drivable=0.9, lane=0.2)
    run = predictor.backend.run

    def unsure(batch: np.ndarray) -> RawOutputs:
        raw = run(batch)
        assert raw.drivable is not None
        assert raw.lane is not None
        return dataclasses.replace(raw, drivable=raw.drivable // 2, lane=raw.lane // 2)

    predictor.backend.run = unsure  # type: ignore[method-assign]
    found = values(evaluate(predictor, images, resamples=0))
    assert (found["fair/drivable/iou"], found["fair/lane/iou"]) == (0.0, 1.0)


def test_neighbours_of_other_shapes_share_no_batch() -> None:
    images = Images(2)
    turned = images[1]
    assert turned.drivable is not None
    images._samples[1] = dataclasses.replace(
        turned, image=np.zeros((96, 64, 3), np.uint8), boxes=None, class_id=None, drivable=None, lane=None
    )
    predictor = fake_predictor(images)
    run, shapes = predictor.backend.run, []

    def look(batch: np.ndarray) -> RawOutputs:
        shapes.append(batch.shape[:3])
        return run(batch) if batch.shape[1] == 64 else RawOutputs(None, None, None)

    predictor.backend.run = look  # type: ignore[method-assign]
    evaluate(predictor, images, resamples=0, batch_size=2)
    assert shapes == [(1, 64, 96), (1, 96, 64)]


def test_saved_boxes_count_in_the_paper_protocol_as_those_of_a_network_do(tmp_path: Path) -> None:
    images = Images(1)
    assert images[0].boxes is not None
    right = Boxes(images[0].boxes[:1], np.array([0.5], np.float32), np.zeros(1, np.int64))

    def recall(scores: float, count: int) -> dict[str, float]:
        wrong = np.tile(np.array([[90, 40, 95, 45]], np.float32), (count, 1))
        confidence = np.append(right.confidence, np.full(count, scores, np.float32))
        order = np.argsort(-confidence, kind="stable")
        boxes = Boxes(np.concatenate([right.xyxy, wrong])[order], confidence[order], np.zeros(count + 1, np.int64))
        with PredictionWriter(tmp_path, ("detection",), overwrite=True) as writer:
            writer.write("000", Perception(size=images[0].size, boxes=boxes))
        saved = SavedPredictions(tmp_path, ("vehicle",))
        return values(score_predictions(saved, images, protocol="paper", resamples=0))

    assert recall(0.0005, 3)["paper/detection/precision"] == 1.0  # not above the published confidence
    assert recall(0.9, 299)["paper/detection/recall"] == pytest.approx(1 / 3)
    assert recall(0.9, 300)["paper/detection/recall"] == 0.0  # 300 boxes an image count
