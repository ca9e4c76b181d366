"""A teacher's saved outputs as targets."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from trilitenet.data.sample import Sample
from trilitenet.data.transforms import Augmentation, TrainTransform, shrink
from trilitenet.engine.lessons import Lessons, TaughtTransform
from trilitenet.engine.predictions import DETECTIONS_FILE, PredictionWriter
from trilitenet.errors import ConfigError, DataError
from trilitenet.structures import Boxes, Perception

SIZE = (96, 160)


def scene(name: str = "a") -> Sample:
    rng = np.random.default_rng(3)
    drivable, lane = np.zeros(SIZE, np.uint8), np.zeros(SIZE, np.uint8)
    drivable[50:, 20:120] = 1
    lane[50:, 60:66] = 1
    return Sample(
        name=name,
        image=rng.integers(0, 255, (*SIZE, 3), dtype=np.uint8),
        boxes=np.array([[20, 30, 60, 70], [90, 20, 130, 60]], np.float32),
        class_id=np.array([0, 0]),
        ignored=np.array([[0, 0, 9, 9]], np.float32),
        drivable=drivable,
        lane=lane,
    )


def save(folder: Path, sample: Sample, scores: tuple[float, ...] = (0.9, 0.8)) -> Path:
    """Write the labels of a sample as if a model had said them."""
    assert sample.boxes is not None
    assert sample.class_id is not None
    tasks = [task for task in ("drivable", "lane") if getattr(sample, task) is not None]
    said = Perception(
        size=sample.size,
        class_names=("vehicle",),
        boxes=Boxes(sample.boxes, np.array(scores, np.float32), sample.class_id),
        drivable=None if sample.drivable is None else sample.drivable.astype(np.bool_),
        lane=None if sample.lane is None else sample.lane.astype(np.bool_),
    )
    with PredictionWriter(folder, ("detection", *tasks)) as writer:  # type: ignore[arg-type]
        writer.write(sample.name, said)
    return folder


def bare(sample: Sample) -> Sample:
    return dataclasses.replace(sample, boxes=None, class_id=None, drivable=None, lane=None)


def same(first: Sample, second: Sample) -> None:
    for field in ("image", "boxes", "class_id", "ignored", "drivable", "lane"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field), field)


@pytest.mark.parametrize("more", [{}, {"mosaic": 1.0}, {"mixup": 1.0}])
def test_outputs_move_with_the_image(tmp_path: Path, more: dict[str, float]) -> None:
    """A teacher that says just what the labels say teaches an unlabelled image just what they would."""
    sample = scene()
    plain = TrainTransform((96, 160), Augmentation(mask_above=127, **more))
    taught = TaughtTransform(plain, Lessons(save(tmp_path, sample), ("vehicle",)))
    for seed in range(4):
        expected = plain(sample, np.random.default_rng(seed), lambda rng: scene())
        same(taught(bare(sample), np.random.default_rng(seed), lambda rng: bare(scene())), expected)
        assert expected.drivable is not None
        assert expected.drivable.any()


def test_labels_and_teacher_share_by_weight(tmp_path: Path) -> None:
    sample = scene()
    assert sample.drivable is not None
    assert sample.lane is not None
    lessons = Lessons(
        save(tmp_path, dataclasses.replace(sample, drivable=1 - sample.drivable, lane=1 - sample.lane)), ("vehicle",)
    )
    still = TrainTransform(SIZE, Augmentation(rotation=0, scale=0, translation=0, flip=0, mask_above=127))
    taught = TaughtTransform(still, lessons, (0.0, 3.0, 0.5))
    drivable, lane = [], []
    for seed in range(400):
        out = taught(sample, np.random.default_rng(seed))
        assert out.drivable is not None
        assert out.lane is not None
        assert out.boxes is not None
        assert len(out.ignored) == 1
        drivable.append(bool(out.drivable[0, 0]))
        lane.append(bool(out.lane[0, 0]))
    assert np.mean(drivable) == pytest.approx(3 / 4, abs=0.08)
    assert np.mean(lane) == pytest.approx(1 / 3, abs=0.08)
    assert abs(np.corrcoef(drivable, lane)[0, 1]) < 0.15
    first, again = (taught(sample, np.random.default_rng(7)) for _ in range(2))
    same(first, again)


def test_what_no_draw_takes_is_not_read(tmp_path: Path) -> None:
    sample = scene()
    lessons = Lessons(save(tmp_path, sample), ("vehicle",))
    whole = lessons.of(sample, ("detection",))
    assert whole is not None
    assert whole.boxes is not None
    assert (whole.drivable, whole.lane) == (None, None)
    (tmp_path / "drivable" / "a.png").write_bytes(b"")
    still = TrainTransform(SIZE, Augmentation(rotation=0, scale=0, translation=0, flip=0))
    assert TaughtTransform(still, lessons, (0.0, 0.0, 0.0))(sample, np.random.default_rng(0)).drivable is not None


def test_confidence_makes_objects_and_ignored_regions(tmp_path: Path) -> None:
    sample = scene()
    lessons = Lessons(save(tmp_path, sample, (0.5, 0.3)), ("vehicle",), (0.1, 0.5))
    said = lessons.of(bare(sample))
    assert said is not None
    assert said.boxes is not None
    assert said.boxes.tolist() == [[20, 30, 60, 70]]
    assert said.ignored.tolist() == [[90, 20, 130, 60]]
    taught = TaughtTransform(TrainTransform(SIZE, Augmentation(rotation=0, scale=0, translation=0, flip=0)), lessons)
    out = taught(bare(sample), np.random.default_rng(0))
    assert out.ignored.tolist() == [[0, 0, 9, 9], [90, 20, 130, 60]]
    for low, count in ((0.4, 0), (0.3, 1)):
        doubtful = Lessons(tmp_path, ("vehicle",), (low, 0.5)).of(bare(sample))
        assert doubtful is not None
        assert len(doubtful.ignored) == count


@pytest.mark.parametrize("above", [1, 127])
@pytest.mark.parametrize("canvas", [(64, 96), (192, 320)])
def test_outputs_follow_a_resized_image_as_labels_do(canvas: tuple[int, int], above: int, tmp_path: Path) -> None:
    sample = scene()
    small = shrink(sample, canvas, above)
    said = Lessons(save(tmp_path, sample), ("vehicle",), resized=True, mask_above=above).of(bare(small))
    assert said is not None
    assert said.boxes is not None
    assert small.boxes is not None
    np.testing.assert_allclose(said.boxes, small.boxes, atol=1e-3)
    np.testing.assert_array_equal(said.drivable, small.drivable)
    np.testing.assert_array_equal(said.lane, small.lane)


def test_an_image_the_teacher_never_saw_keeps_its_labels(tmp_path: Path) -> None:
    lessons = Lessons(save(tmp_path, scene()), ("vehicle",))
    plain = TrainTransform(SIZE, Augmentation())
    other = scene("b")
    assert lessons.of(other) is None
    assert lessons.names() == {"a"}
    same(
        TaughtTransform(plain, lessons)(other, np.random.default_rng(1)),
        plain(other, np.random.default_rng(1)),
    )


def test_a_task_the_teacher_lacks_keeps_its_labels(tmp_path: Path) -> None:
    sample = scene()
    save(tmp_path, dataclasses.replace(sample, lane=None, drivable=None))
    lessons = Lessons(tmp_path, ("vehicle",))
    taught = TaughtTransform(TrainTransform(SIZE, Augmentation()), lessons, (9.0, 9.0, 9.0))
    out = taught(sample, np.random.default_rng(0))
    assert out.lane is not None
    assert out.lane.any()
    assert lessons.of(scene("b")) is None  # the list names no image without boxes, so this one was perhaps never seen


def test_a_task_of_weight_zero_is_not_taught(tmp_path: Path) -> None:
    lessons = Lessons(save(tmp_path, scene()), ("vehicle",))
    taught = TaughtTransform(TrainTransform(SIZE, Augmentation()), lessons, (0.0, 1.0, 0.0))
    out = taught(bare(scene()), np.random.default_rng(0))
    assert (out.boxes, out.lane) == (None, None)
    assert out.drivable is not None


def test_refusals(tmp_path: Path) -> None:
    sample = scene()
    with pytest.raises(DataError, match="no predictions"):
        Lessons(tmp_path, ("vehicle",))
    save(tmp_path / "boxes", dataclasses.replace(sample, lane=None, drivable=None))
    with pytest.raises(ConfigError, match="do not tell the size"):
        Lessons(tmp_path / "boxes", ("vehicle",), resized=True)
    folder = save(tmp_path / "all", sample)
    (folder / "lane" / "a.png").unlink()
    with pytest.raises(DataError, match=r"a\.png: missing"):
        Lessons(folder, ("vehicle",)).of(sample)
    cv2.imwrite(str(folder / "drivable" / "a.png"), np.zeros((100, 100), np.uint8))
    with pytest.raises(DataError, match="100x100, of another shape than the image of 160x96"):
        Lessons(folder, ("vehicle",)).of(sample)
    cv2.imwrite(str(folder / "drivable" / "a.png"), np.zeros((96, 152), np.uint8))
    with pytest.raises(DataError, match="152x96, of another shape"):
        Lessons(folder, ("vehicle",)).of(sample)
    (folder / "drivable" / "a.png").write_bytes(b"no")
    with pytest.raises(DataError, match="not a PNG"):
        Lessons(folder, ("vehicle",)).of(sample)
    (folder / DETECTIONS_FILE).write_text("{}")
    with pytest.raises(DataError, match="not COCO results"):
        Lessons(folder, ("vehicle",))
