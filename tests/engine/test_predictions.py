from __future__ import annotations

import json
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from trilitenet.engine.predictions import PredictionWriter, SavedPredictions
from trilitenet.errors import DataError, OutputError
from trilitenet.structures import Boxes, Perception

BOX = '{"image_id": "a", "category_id": 1, "bbox": [0, 0, 1, 1], "score": 0.5}'


def perception(rng: np.random.Generator, boxes: int) -> Perception:
    low = rng.uniform(0, 20, (boxes, 2))
    return Perception(
        (40, 50),
        ("car", "bus"),
        Boxes(
            np.concatenate([low, low + 9], axis=1).astype(np.float32),
            np.sort(rng.random(boxes).astype(np.float32))[::-1],
            rng.integers(0, 2, boxes),
        ),
        rng.random((40, 50)) < 0.5,
        rng.random((40, 50)) < 0.1,
    )


def test_what_is_written_is_read_again(tmp_path: Path, rng: np.random.Generator) -> None:
    written = {f"image {index}": perception(rng, index) for index in range(4)}
    with PredictionWriter(tmp_path, ("detection", "drivable", "lane")) as writer:
        for name, one in written.items():
            writer.write(name, one)
    saved = SavedPredictions(tmp_path, ("car", "bus"))
    assert saved.tasks == ("detection", "drivable", "lane")
    assert saved.names == {"image 1", "image 2", "image 3"}  # the first has no boxes
    assert saved.lowest == pytest.approx(min(one.boxes.confidence[-1] for one in written.values() if one.boxes))
    for name, one in written.items():
        again = saved.get(name, (40, 50))
        assert again.boxes is not None
        assert one.boxes is not None
        np.testing.assert_allclose(again.boxes.xyxy, one.boxes.xyxy, atol=1e-3)
        np.testing.assert_allclose(again.boxes.confidence, one.boxes.confidence, rtol=1e-6)
        assert (again.boxes.class_id == one.boxes.class_id).all()
        np.testing.assert_array_equal(again.drivable, one.drivable)
        np.testing.assert_array_equal(again.lane, one.lane)


def test_classes_in_another_order_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    with PredictionWriter(tmp_path, ("detection",)) as writer:
        writer.write("a", perception(rng, 3))
    for names in (("bus", "car"), ("car", "bus", "lorry")):
        with pytest.raises(DataError, match=r"classes\.json: .* car, bus, not .*; give --classes car bus$"):
            SavedPredictions(tmp_path, names)
    assert SavedPredictions(tmp_path, ("vehicle",)).names == {"a"}
    (tmp_path / "classes.json").write_text("3")
    with pytest.raises(DataError, match=r"classes\.json: not a JSON list of names"):
        SavedPredictions(tmp_path, ("car", "bus"))
    PredictionWriter(tmp_path, ("detection",), overwrite=True).close()
    assert SavedPredictions(tmp_path, ("bus", "car")).tasks == ("detection",)


def test_the_form_on_disk(tmp_path: Path) -> None:
    one = Perception(
        (2, 3),
        boxes=Boxes(np.array([[1, 2, 4, 7]], np.float32), np.array([0.5], np.float32), np.zeros(1, np.int64)),
        lane=np.eye(2, 3, dtype=np.bool_),
    )
    with PredictionWriter(tmp_path, ("detection", "lane")) as writer:
        writer.write("a", one)
    assert json.loads((tmp_path / "detections.json").read_text()) == [
        {"image_id": "a", "category_id": 1, "bbox": [1.0, 2.0, 3.0, 5.0], "score": 0.5}
    ]
    lane = cv2.imread(str(tmp_path / "lane" / "a.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(lane, [[255, 0, 0], [0, 255, 0]])
    assert not (tmp_path / "drivable").exists()


def test_predictions_are_not_overwritten_unasked(tmp_path: Path) -> None:
    PredictionWriter(tmp_path, ("detection",)).close()
    assert json.loads((tmp_path / "detections.json").read_text()) == []
    with pytest.raises(OutputError, match="--overwrite"):
        PredictionWriter(tmp_path, ("detection",))
    PredictionWriter(tmp_path, ("detection",), overwrite=True).close()


def test_nothing_of_another_model_is_left(tmp_path: Path) -> None:
    PredictionWriter(tmp_path, ("detection", "lane")).close()
    (tmp_path / "lane" / "a.png").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("mine")
    PredictionWriter(tmp_path, ("drivable",), overwrite=True).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drivable", "notes.txt"]


def test_a_part_that_is_not_there_is_a_task_that_is_not_scored(tmp_path: Path) -> None:
    (tmp_path / "lane").mkdir()
    cv2.imwrite(str(tmp_path / "lane" / "a.png"), np.full((4, 4), 7, np.uint8))
    saved = SavedPredictions(tmp_path, ("vehicle",))
    one = saved.get("a", (4, 4))
    assert saved.tasks == ("lane",)
    assert one.boxes is None
    assert one.drivable is None
    assert one.lane is not None
    assert one.lane.all()  # anything above 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "not COCO results"),
        ("[1]", "not COCO results"),
        ('[{"image_id": "a"}]', "not COCO results"),
        ('[{"image_id": "a", "category_id": 1, "bbox": [0, 0, 1], "score": 0.5}]', "not COCO results"),
        ('[{"image_id": "a", "category_id": 1, "bbox": [0, 0, 1, 1], "score": 50}]', "between 0 and 1"),
        ('[{"image_id": "a", "category_id": 1, "bbox": [0, 0, 1, 1], "score": -0.5}]', "between 0 and 1"),
        ('[{"image_id": "a", "category_id": 0, "bbox": [0, 0, 1, 1], "score": 0.5}]', "category_id 0 is not 1 to 2"),
        ('[{"image_id": "a", "category_id": 3, "bbox": [0, 0, 1, 1], "score": 0.5}]', "category_id 3 is not 1 to 2"),
        ("[{", "not COCO results"),
        ('[{"image_id": "a", "category_id": 1, "bbox": [9, 9, -5, 5], "score": 0.5}]', "left, top, width, height"),
        (f"[{BOX} {BOX}]", "not one JSON list, at character"),
        (f"[{BOX}] {BOX}", "not one JSON list, at character"),
        (f"[{BOX}", "not one JSON list, at character"),
        (f"[{BOX},]", "not COCO results"),
        (f"[,{BOX}]", "not COCO results"),
        ("", "not COCO results"),
        ('[{"image_id": "a", "category_id": Infinity, "bbox": [0, 0, 1, 1], "score": 0.5}]', "not COCO results"),
        pytest.param("[" * 500_000, "nested too deeply", id="deep"),
    ],
)
def test_broken_detections_are_told_in_a_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "detections.json").write_text(content)
    with pytest.raises(DataError, match=message):
        SavedPredictions(tmp_path, ("car", "bus"))


def test_several_categories_of_one_class_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    entry = {"image_id": "a", "category_id": 3, "bbox": [0, 0, 9, 9], "score": 0.5}
    for entries, told in (([entry], 0), ([entry, {**entry, "category_id": 8}], 1)):
        (tmp_path / "detections.json").write_text(json.dumps(entries))
        SavedPredictions(tmp_path, ("vehicle",))
        assert caplog.text.count(f"boxes of {len(entries)} categories count as vehicle alike") == told


def test_a_mark_before_the_list_is_no_part_of_it(tmp_path: Path) -> None:
    (tmp_path / "detections.json").write_text("\ufeff[]", encoding="utf-8")
    assert SavedPredictions(tmp_path, ("car",)).names == set()


def test_masks_must_be_there_and_fit(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no predictions"):
        SavedPredictions(tmp_path, ("vehicle",))
    (tmp_path / "lane").mkdir()
    saved = SavedPredictions(tmp_path, ("vehicle",))
    with pytest.raises(DataError, match="missing"):
        saved.get("a", (4, 4))
    (tmp_path / "lane" / "a.png").write_bytes(b"")
    with pytest.raises(DataError, match="decoded"):
        saved.get("a", (4, 4))
    picture = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    side = (100_000).to_bytes(4, "big")
    header = b"IHDR" + side + side + picture[24:29]
    absurd = picture[:12] + header + zlib.crc32(header).to_bytes(4, "big") + picture[33:]
    (tmp_path / "lane" / "a.png").write_bytes(absurd)
    with pytest.raises(DataError, match="decoded"):
        saved.get("a", (4, 4))
    cv2.imwrite(str(tmp_path / "lane" / "a.png"), np.zeros((4, 5), np.uint8))
    with pytest.raises(DataError, match="5x4, the image is 4x4"):
        saved.get("a", (4, 4))
    cv2.imwrite(str(tmp_path / "lane" / "a.png"), np.full((4, 4), 255, np.uint16))  # OpenCV would make it 0
    with pytest.raises(DataError, match="has 16 bits a pixel; save it with 8"):
        saved.get("a", (4, 4))


def test_with_one_class_any_category_is_it(tmp_path: Path) -> None:
    (tmp_path / "detections.json").write_text(
        '[{"image_id": 7, "category_id": 3, "bbox": [0, 0, 1, 1], "score": 0.1},'
        ' {"image_id": 7, "category_id": 1, "bbox": [0, 0, 2, 2], "score": 0.4}]'
    )
    boxes = SavedPredictions(tmp_path, ("vehicle",)).get("7", (4, 4)).boxes
    assert boxes is not None
    assert boxes.class_id.tolist() == [0, 0]
    assert boxes.confidence.tolist() == pytest.approx([0.4, 0.1])  # best first


def test_what_is_interrupted_does_not_look_whole(tmp_path: Path, rng: np.random.Generator) -> None:
    def write() -> None:
        with PredictionWriter(tmp_path, ("detection",)) as writer:
            writer.write("a", perception(rng, 3))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e300"])
def test_a_box_that_is_not_finite_is_named(tmp_path: Path, value: str) -> None:
    (tmp_path / "detections.json").write_text(
        f'[{{"image_id": "a", "category_id": 1, "bbox": [{value}, 1, 5, 5], "score": 0.5}}]'
    )
    with pytest.raises(DataError, match="a bbox must be four numbers"):
        SavedPredictions(tmp_path, ("car",))
