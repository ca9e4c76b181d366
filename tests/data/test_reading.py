from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.published import write_annotation, write_published
from trilitenet.data.checking import check_dataset
from trilitenet.data.description import (
    DatasetDescription,
    MaskMeaning,
    class_table,
    folder_name,
    read_description,
    write_description,
)
from trilitenet.data.reading import (
    DrivingDataset,
    MixedDataset,
    decode_image,
    decode_mask,
    is_crowd,
    parse_annotation,
    sampling_weights,
)
from trilitenet.data.sample import Sample
from trilitenet.errors import DataError, ShapeError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_published(tmp_path, "train", 8)
    return tmp_path


def box(category: str, x: float, *, crowd: bool = False) -> dict[str, object]:
    corners = {"x1": x, "y1": 1.0, "x2": x + 10, "y2": 21.0}
    return {"category": category, "box2d": corners, "attributes": {"crowd": crowd}}


def test_any_subset_of_the_tasks(root: Path) -> None:
    dataset = DrivingDataset(root, "train")
    assert dataset.names == [f"train_{index:04}" for index in range(8)]
    for index, sample in enumerate(dataset):
        assert sample.size == (72, 128)
        assert (sample.drivable is None) == (index % 4 == 3)
        assert (sample.lane is None) == (index % 5 == 4)
        assert (sample.boxes is None) == (index % 7 == 6)
        if sample.drivable is not None:
            assert set(np.unique(sample.drivable)) == {0, 1}


@pytest.mark.parametrize(
    ("value", "crowd"),
    [(True, True), (1, True), (0.5, True), ("true", True), ("Yes", True), ("1", True), (False, False), (0, False),
     (0.0, False), ("0.0", False), ("No", False), (" false", False), ("", False), ([], False), (None, False)],
)  # fmt: skip
def test_what_marks_a_crowd(value: object, crowd: bool) -> None:
    assert is_crowd({"attributes": {"crowd": value}}) == crowd


@pytest.mark.parametrize(
    ("class_names", "last"), [(("vehicle",), [(8, 8)]), (("vehicle", "zebra"), [(index, 8) for index in range(1, 9)])]
)
def test_annotations_looked_at_are_counted(root: Path, class_names: tuple[str, ...], last: list[object]) -> None:
    calls: list[object] = []
    DrivingDataset(root, "train", class_names=class_names).warn_of_foreign(lambda *call: calls.append(call))
    assert calls == last
    calls.clear()
    sampling_weights(DrivingDataset(root, "train"), {"timeofday": {}}, lambda *call: calls.append(call))
    assert calls == [(index, 8) for index in range(1, 9)]


def test_an_image_is_rgb(root: Path) -> None:
    red = np.zeros((72, 128, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes BGR
    cv2.imwrite(str(root / "images/train/red.png"), red)
    dataset = DrivingDataset(root, "train", names=["red"])
    assert dataset[0].image[5, 5].tolist() == [255, 0, 0]
    assert dataset[0].boxes is None


def test_categories_crowds_and_boxes_beyond_the_image(root: Path) -> None:
    items = [
        box("car", 0),
        box("train", 20),
        box("person", 40),
        box("bus", 60, crowd=True),
        box("person", 9, crowd=True),
    ]
    items += [box("truck", 120), box("car", 300)]
    write_annotation(root, "train", "train_0000", items, weather="clear")
    sample = DrivingDataset(root, "train")[0]
    assert sample.boxes is not None
    assert sample.boxes[:, 0].tolist() == [0, 20, 120]
    assert sample.boxes[2].tolist() == [120, 1, 128, 21]
    assert sample.ignored.tolist() == [[60, 1, 70, 21]]
    assert sample.attributes == {"weather": "clear"}
    two = DrivingDataset(root, "train", class_names=["person", "heavy"], classes={"heavy": ["bus", "truck", "train"]})[
        0
    ]
    assert two.class_id is not None
    assert two.class_id.tolist() == [1, 0, 1]
    assert len(two.ignored) == 2


def test_a_category_that_is_a_number_is_the_text_of_it(root: Path) -> None:
    write_annotation(root, "train", "train_0000", [{"category": 3, "box2d": {"x1": 1, "y1": 2, "x2": 9, "y2": 8}}])
    dataset = DrivingDataset(root, "train", class_names=("vehicle",), classes={"vehicle": ("3",)})
    boxes = dataset[0].boxes
    assert boxes is not None
    assert boxes.tolist() == [[1, 2, 9, 8]]
    assert dataset.classes_without_boxes() == ([], {"3"})


def test_a_category_to_ignore_is_ignored_though_a_class_has_it(root: Path) -> None:
    """As the check and the conversion have it; trains are vehicles unless something is said."""
    write_annotation(root, "train", "train_0000", [box("car", 0), box("train", 20)])
    (root / "dataset.yaml").write_text("ignore: [train]\n")
    sample = DrivingDataset(root, "train")[0]
    assert sample.boxes is not None
    assert sample.boxes[:, 0].tolist() == [0]
    assert sample.ignored[:, 0].tolist() == [20]


def test_index_gives_attributes(root: Path) -> None:
    (root / "index.csv").write_text(
        "name,split,source,condition\ntrain_0001,train,city,night\ntrain_0001,val,other,day\n"
    )
    dataset = DrivingDataset(root, "train")
    assert dataset.attributes(1) == {"timeofday": "night", "source": "city", "condition": "night"}
    assert dataset[1].attributes == dataset.attributes(1)
    (root / "index.csv").write_text("name,split,source\ntrain_0001,train,straße\n", encoding="utf-8-sig")
    assert DrivingDataset(root, "train").attributes(1)["source"] == "straße"
    (root / "index.csv").write_text("name,split,weather,\ntrain_0000,train,rain,more,yet more\n")  # as spreadsheets do
    assert DrivingDataset(root, "train")[0].attributes[""] == "more"
    assert sampling_weights(DrivingDataset(root, "train"), {"weather": {"rain": 2.0}})[0] == 2.0
    (root / "index.csv").write_bytes("name,split\nstraße,train\n".encode("latin-1"))
    with pytest.raises(DataError, match=r"index\.csv: cannot be read as CSV in UTF-8"):
        DrivingDataset(root, "train")
    (root / "index.csv").write_text("name;split\ntrain_0000;train\n")
    with pytest.raises(DataError, match=r"'name' and 'split', separated by commas; its columns: name;split$"):
        DrivingDataset(root, "train")
    (root / "index.csv").write_text("")
    with pytest.raises(DataError, match=r"its columns: none$"):
        DrivingDataset(root, "train")


def test_ego_mask_by_camera(root: Path) -> None:
    own = np.zeros((36, 64), np.uint8)  # of another size: it is resized
    own[30:] = 255
    cv2.imwrite(str(root / "car.png"), own)
    (root / "dataset.yaml").write_text("ego_masks: {train_0000: car.png}\n")
    dataset = DrivingDataset(root, "train")
    valid = dataset[0].valid
    assert valid is not None
    assert valid[:60].all()
    assert not valid[60:].any()
    assert dataset[1].valid is None
    (root / "dataset.yaml").write_text("ego_mask: gone.png\n")
    with pytest.raises(DataError, match=r"gone\.png"):
        DrivingDataset(root, "train")[0]


def test_mask_values_have_a_meaning(root: Path) -> None:
    mask = np.zeros((72, 128), np.uint8)
    mask[0], mask[1], mask[2], mask[3] = 1, 2, 64, 255
    cv2.imwrite(str(root / "da_seg_annotations/train/train_0000.png"), mask)
    plain = DrivingDataset(root, "train")[0]
    assert plain.drivable is not None
    assert plain.drivable[:4, 0].tolist() == [0, 1, 1, 1]  # the published rule: above 1
    assert plain.valid is None
    write_description(root, DatasetDescription(drivable=MaskMeaning(above=0, ignore=(64,)), tasks=("drivable",)))
    sample = DrivingDataset(root, "train")[0]
    assert sample.drivable is not None
    assert sample.drivable[:4, 0].tolist() == [1, 1, 0, 1]
    assert sample.valid is None
    assert sample.lane_valid is None
    assert sample.drivable_valid is not None
    assert np.flatnonzero(~sample.drivable_valid.all(axis=1)).tolist() == [2]
    assert sample.boxes is None
    assert sample.lane is None


def test_a_folder_is_called_alike_however_its_path_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "yard" / "north").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "yard" / "north")
    assert [folder_name(path) for path in ("..", Path(), "../north/")] == ["yard", "north", "north"]
    assert read_description(Path()).name == "north"


def test_description_round_trip(tmp_path: Path) -> None:
    description = DatasetDescription(
        name="mine",
        classes={"car": ("car", "van"), "person": ("pedestrian",)},
        splits=("train",),
        drivable=MaskMeaning(values={255: "direct"}),
        licence="CC BY 4.0",
    )
    write_description(tmp_path, description)
    assert read_description(tmp_path) == description
    assert read_description(tmp_path).class_names == ("car", "person")
    (tmp_path / "dataset.yaml").write_text("clases: {}\n")
    with pytest.raises(DataError, match="did you mean 'classes'"):
        read_description(tmp_path)
    (tmp_path / "dataset.yaml").write_text("a: [")
    with pytest.raises(DataError, match="not YAML"):
        read_description(tmp_path)
    with pytest.raises(DataError, match=r"^category 'x' belongs to both 'a' and 'b'$"):
        class_table(("a", "b"), {"a": ("x",), "b": ("x",)})


def test_errors_name_the_file(root: Path) -> None:
    with pytest.raises(DataError, match=r"no folder images/val; its splits: train$"):
        DrivingDataset(root, "val")
    with pytest.raises(DataError, match=rf"^{re.escape(str(root))}: category 'car' belongs to both"):
        DrivingDataset(root, "train", class_names=("vehicle", "car"))
    (root / "dataset.yaml").write_text("classes: {a: [x], b: [x]}\n")
    for read in (lambda: DrivingDataset(root, "train"), lambda: check_dataset(root)):
        with pytest.raises(DataError, match=r"dataset\.yaml: category 'x' belongs to both 'a' and 'b'"):
            read()
    (root / "dataset.yaml").unlink()
    (root / "prepared.json").touch()
    with pytest.raises(DataError, match="a prepared copy, for training alone"):
        DrivingDataset(root, "val")
    with pytest.raises(DataError, match="no image 'x'"):
        DrivingDataset(root, "train", names=["x"])
    (root / "images/empty").mkdir()
    with pytest.raises(DataError, match="no images"):
        DrivingDataset(root, "empty")
    dataset = DrivingDataset(root, "train")
    cv2.imwrite(str(root / "ll_seg_annotations/train/train_0000.png"), np.zeros((3, 4), np.uint8))
    with pytest.raises(DataError, match="mask of 4x3 for an image of 128x72"):
        dataset[0]
    (root / "da_seg_annotations/train/train_0001.png").write_bytes(b"")
    with pytest.raises(DataError, match=r"train_0001\.png: not a mask"):
        dataset[1]
    (root / "images/train/train_0002.jpg").write_bytes(b"\xff\xd8 broken")
    with pytest.raises(DataError, match=r"train_0002\.jpg: not an image"):
        dataset[2]
    (root / "det_annotations/train/train_0003.json").write_text("{")
    with pytest.raises(DataError, match=r"train_0003\.json: not JSON"):
        dataset[3]
    (root / "det_annotations/train/train_0004.json").write_text('{"frames": [{"objects": [{"box2d": {}}]}]}')
    with pytest.raises(DataError, match=r"train_0004\.json: not an annotation"):
        dataset[4]
    (root / "det_annotations/train/train_0005.json").write_text('{"frames": [], "attributes": ["night"]}')
    with pytest.raises(DataError, match=r"train_0005\.json: not an annotation"):
        dataset.attributes(5)
    with pytest.raises(DataError, match="not an image"):
        decode_image(b"", "nothing")


def test_mixed_data_sets(root: Path, tmp_path: Path) -> None:
    write_published(tmp_path / "other", "train", 3)
    one, two = DrivingDataset(root, "train"), DrivingDataset(tmp_path / "other", "train")
    mixed = MixedDataset([(one, 1.0), (two, 4.0)])
    assert len(mixed) == 11
    np.testing.assert_array_equal(mixed[9].image, two[1].image)
    assert mixed.attributes(8) == two.attributes(0)
    assert mixed.weights.tolist() == [1.0] * 8 + [4.0] * 3
    assert MixedDataset([(two, 1.0), (mixed, 0.5)]).weights.tolist() == [1.0] * 3 + [0.5] * 8 + [2.0] * 3
    weights = sampling_weights(mixed, {"timeofday": {"night": 2.0}})
    assert weights.tolist() == [1, 2, 1, 2, 1, 2, 1, 2, 4, 8, 4]
    with pytest.raises(IndexError):
        mixed[11]
    with pytest.raises(DataError, match="above 0"):
        MixedDataset([(one, 0.0)])
    with pytest.raises(DataError, match="above 0 and finite, got inf"):
        MixedDataset([(one, 1.0), (two, math.inf)])
    with pytest.raises(DataError, match="at least one"):
        MixedDataset([])
    with pytest.raises(DataError, match="different classes"):
        MixedDataset([(one, 1.0), (DrivingDataset(root, "train", class_names=["car"]), 1.0)])
    with pytest.raises(DataError, match="negative"):
        sampling_weights(one, {"timeofday": {"night": -1.0}})
    with pytest.raises(DataError, match="night must be finite"):
        sampling_weights(one, {"timeofday": {"night": math.inf}})
    with pytest.raises(DataError, match="every sampling weight is 0"):
        sampling_weights(one, {"timeofday": {"night": 0.0, "day": 0.0, "": 0.0}})


def test_what_no_image_has_to_sample_by_is_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    dataset = DrivingDataset(root, "train")
    sampling_weights(dataset, {"timeofday": {"nigth": 2.0, "day": 1.0, "": 1.0}, "timeofdya": {"night": 2.0}})
    assert caplog.messages == [
        "no image has the timeofday 'nigth' to sample by; did you mean 'night'?",
        "no image has the attribute 'timeofdya' to sample by; did you mean 'timeofday'?",
    ]


def test_images_without_an_attribute_are_sampled_by_what_the_check_calls_them(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    dataset = DrivingDataset(root, "train")
    without = ["timeofday" not in dataset.attributes(index) for index in range(len(dataset))]
    assert set(without) == {True, False}
    for name in ("undefined", ""):
        weights = sampling_weights(dataset, {"timeofday": {name: 3.0, "day": 1.0}})
        assert weights.tolist() == [3.0 if one else 1.0 for one in without]
    assert not caplog.messages


def test_a_sample_is_checked() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    with pytest.raises(ShapeError, match="uint8"):
        Sample("x", image.astype(np.float32))
    with pytest.raises(ShapeError, match="go together"):
        Sample("x", image, boxes=np.zeros((0, 4), np.float32))
    with pytest.raises(ShapeError, match="N class ids"):
        Sample("x", image, boxes=np.zeros((2, 4), np.float32), class_id=np.zeros(1, np.int64))
    with pytest.raises(ShapeError, match="lane must be"):
        Sample("x", image, lane=np.zeros((6, 4), np.uint8))
    with pytest.raises(ShapeError, match="ignored"):
        Sample("x", image, ignored=np.zeros((1, 5), np.float32))


def test_driving_frames(driving: Path) -> None:
    train, val = DrivingDataset(driving, "train"), DrivingDataset(driving, "val")
    assert (len(train), len(val)) == (2164, 439)
    samples = [val[index] for index in range(0, len(val), 20)]
    assert all(sample.boxes is not None for sample in samples)
    assert {sample.attributes["condition"] for sample in samples} >= {"day", "night"}


def test_files_that_cannot_be_read_are_named(root: Path) -> None:
    dataset = DrivingDataset(root, "train")
    lane = root / "ll_seg_annotations/train/train_0001.png"
    lane.unlink()
    lane.mkdir()
    with pytest.raises(DataError, match=r"train_0001\.png: cannot be read \(Is a directory\)"):
        dataset[1]
    dataset.image_path(2).unlink()
    with pytest.raises(DataError, match=r"train_0002\.\w+: the image is not there any more"):
        dataset[2]


def test_a_number_that_no_float_is_makes_a_broken_annotation() -> None:
    box = {"category": "car", "box2d": {"x1": 0, "y1": 0, "x2": 10**400, "y2": 9}}
    with pytest.raises(DataError, match=r"^x\.json: not an annotation in the per-image form"):
        parse_annotation({"frames": [{"objects": [box]}]}, {"car": 0}, (), (9, 9), "x.json")


def test_an_attribute_of_null_is_none(root: Path) -> None:
    """As text it would be one value, and all images without a sequence one sequence."""
    path = root / "det_annotations/train/train_0000.json"
    path.write_text('{"frames": [], "attributes": {"weather": "rainy", "sequence": null, "lanes": 0}}')
    dataset = DrivingDataset(root, "train")
    assert dataset[0].attributes == dataset.attributes(0) == {"weather": "rainy", "lanes": "0"}


def test_an_image_of_an_absurd_size_is_a_broken_one() -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")
    with pytest.raises(DataError, match=r"huge\.png: not an image"):
        decode_image(data, "huge.png")
    with pytest.raises(DataError, match=r"huge\.png: not a mask"):
        decode_mask(data, "huge.png", MaskMeaning())


def test_a_mask_of_16_bits_is_refused_not_read_as_empty() -> None:
    deep = cv2.imencode(".png", np.full((4, 4), 255, np.uint16))[1].tobytes()
    with pytest.raises(DataError, match="has 16 bits a pixel; save it with 8"):
        decode_mask(deep, "a.png", MaskMeaning())


def test_another_ego_mask_makes_another_sample(root: Path) -> None:
    before = DrivingDataset(root, "train").fingerprint(0)
    seen = {before}
    (root / "dataset.yaml").write_text("ego_mask: ego.png\n")
    for rows in (10, 20):
        mask = np.zeros((72, 128), np.uint8)
        mask[-rows:] = 255
        cv2.imwrite(str(root / "ego.png"), mask)
        seen.add(DrivingDataset(root, "train").fingerprint(0))
    assert len(seen) == 3
    (root / "dataset.yaml").unlink()
    assert DrivingDataset(root, "train").fingerprint(0) == before


def test_of_two_ego_masks_that_fit_a_name_the_one_that_says_more_of_it_counts(root: Path) -> None:
    for name, rows in (("all.png", 10), ("first.png", 20)):
        own = np.zeros((72, 128), np.uint8)
        own[:rows] = 255
        cv2.imwrite(str(root / name), own)
    (root / "dataset.yaml").write_text("ego_masks: {train_: all.png, train_0000: first.png}\n")
    dataset = DrivingDataset(root, "train")
    found = []
    for index in (0, 1):
        valid = dataset[index].valid
        assert valid is not None
        found.append(int((~valid).all(axis=1).sum()))
    assert found == [20, 10]


def test_hidden_files_are_no_images(root: Path) -> None:
    """macOS puts a file of its own beside each, for example on a memory stick."""
    before = DrivingDataset(root, "train").names
    (root / "images/train/._train_0001.jpg").write_bytes(b"\0\5\26\7")
    assert DrivingDataset(root, "train").names == before
