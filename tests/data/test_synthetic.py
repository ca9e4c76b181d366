from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from trilitenet.data.reading import DrivingDataset
from trilitenet.data.sample import Sample
from trilitenet.data.synthetic import Scene, SyntheticScenes
from trilitenet.data.synthetic_chance import random_world
from trilitenet.data.synthetic_drive import SyntheticDrive
from trilitenet.data.synthetic_files import annotation, write_dataset
from trilitenet.data.synthetic_layout import random_layout
from trilitenet.data.synthetic_render import FIRST_VEHICLE, render
from trilitenet.data.synthetic_vehicles import VehiclePose, draw_shadow, in_front
from trilitenet.data.synthetic_world import FAR, Course, Vehicle
from trilitenet.errors import Claim, ConfigError, OutputError
from trilitenet.processing.geometry import Camera

SIZE = (192, 320)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    generator = SyntheticScenes(4, SIZE)
    return [generator.scene(i) for i in range(24)]


def test_a_scene_depends_on_seed_and_index_alone() -> None:
    first, again = SyntheticScenes(7, SIZE), SyntheticScenes(7, SIZE)
    again[0]  # another history
    sample, other = first[3], again[3]
    np.testing.assert_array_equal(sample.image, other.image)
    np.testing.assert_array_equal(sample.boxes, other.boxes)
    np.testing.assert_array_equal(sample.lane, other.lane)
    assert not np.array_equal(first[3].image, first[4].image)
    for index in (2, 3):
        assert not np.array_equal(first[3].image, SyntheticScenes(8, SIZE)[index].image)


def test_samples_are_whole_and_varied(scenes: list[Scene]) -> None:
    for scene in scenes:
        sample = scene.sample
        assert sample.image.shape == (*SIZE, 3)
        assert sample.boxes is not None
        assert sample.class_id is not None
        assert sample.drivable is not None
        assert sample.lane is not None
        for boxes in (sample.boxes, sample.ignored):
            assert (boxes[:, 2:] > boxes[:, :2]).all()
            assert boxes.min(initial=0) >= 0
            assert (boxes[:, 2:] <= (SIZE[1], SIZE[0])).all()
        assert set(np.unique(sample.drivable)) <= {0, 1}
    assert len({scene.sample.attributes["weather"] for scene in scenes}) >= 3
    assert len({scene.sample.attributes["timeofday"] for scene in scenes}) == 3
    assert sum(len(scene.truth.objects) for scene in scenes) > 40
    assert np.mean([scene.sample.drivable.mean() for scene in scenes]) > 0.1  # type: ignore[union-attr]


@pytest.mark.parametrize(("size", "index"), [((128, 32), 9), ((128, 64), 9), ((128, 32), 923)])
def test_a_tall_picture_shows_what_reaches_behind_the_camera(size: tuple[int, int], index: int) -> None:
    """A tree, a house, a lamp at night: near enough for its top to be behind the plane of a camera that looks down."""
    assert SyntheticScenes(1, size)[index].image.shape == (*size, 3)


@pytest.mark.filterwarnings("error")
def test_a_shadow_that_reaches_behind_the_camera() -> None:
    """Of a bus before a camera that looks steeply up."""
    camera = Camera.from_field_of_view((128, 32), 80.0, 1.4, pitch=-0.9)
    image = np.full((128, 32, 3), 200, np.uint8)
    draw_shadow(image, camera, VehiclePose(Vehicle("bus", 1.6, 0.0, 0.0, (9.0, 9.0, 9.0)), 1.6, 0.0, 0.0), 0.75)
    assert image.min() < 100


def test_night_is_darker_than_day(scenes: list[Scene]) -> None:
    bright = {"daytime": [0.0], "night": [0.0]}
    for scene in scenes:
        bright.setdefault(scene.sample.attributes["timeofday"], []).append(float(scene.sample.image.mean()))
    assert np.mean(bright["daytime"][1:]) > 2 * np.mean(bright["night"][1:])


def test_masks_stop_at_vehicles(scenes: list[Scene]) -> None:
    drive = SyntheticDrive(2, frames=10, size=(180, 320))
    drawn = render(drive.world(0.0), np.random.default_rng(0), faults=False)
    vehicles = drawn.ids >= FIRST_VEHICLE
    assert vehicles.sum() > 200
    assert not (drawn.drivable.astype(bool) & vehicles).any()
    assert not (drawn.lines.astype(bool) & vehicles).any()


@pytest.mark.parametrize(("seed", "index"), [(2, 0), (0, 110)])  # the second has a truck beside the camera
def test_boxes_are_the_visible_part_of_the_outline(seed: int, index: int) -> None:
    drive = SyntheticDrive(seed, frames=1500, size=(360, 640), faults=False)
    drawn = render(drive.world(index / 25), np.random.default_rng(0), faults=False)
    scene = drive[index]
    assert scene.sample.boxes is not None
    for box in scene.sample.boxes:
        left, top, right, bottom = (round(float(v)) for v in box)
        marks, counts = np.unique(drawn.ids[top:bottom, left:right], return_counts=True)
        best = marks[marks >= FIRST_VEHICLE][np.argmax(counts[marks >= FIRST_VEHICLE])]
        rows, columns = np.nonzero(drawn.ids == best)
        np.testing.assert_allclose(box, (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1), atol=0.51)


def test_true_lines_run_through_the_lane_mask(scenes: list[Scene]) -> None:
    checked = 0
    for scene in scenes:
        truth, lane = scene.truth, scene.sample.lane
        assert lane is not None
        hidden = np.zeros(SIZE, bool)
        for line in truth.lines:
            points = line.points[(line.points[:, 0] >= 5) & (line.points[:, 0] <= 30)]
            for u, v in np.round(truth.camera.to_pixels(points)).astype(int):
                if 2 <= u < SIZE[1] - 2 and 2 <= v < SIZE[0] - 2:
                    checked += 1
                    hidden[v, u] = not lane[v - 1 : v + 2, u - 1 : u + 2].any()
        assert hidden.sum() < 60  # behind vehicles, poles and the bonnet
    assert checked > 500


def test_paint_leaves_the_gaps_of_dashes_out() -> None:
    drive = SyntheticDrive(0, frames=2, size=(180, 320), faults=False)
    truth, lane = drive[0].truth, drive[0].sample.lane
    assert lane is not None
    assert {"dashed", "solid"} <= {line.kind for line in truth.lines}
    on_line, on_paint = [], []
    for line in (line for line in truth.lines if line.kind == "dashed" and abs(line.d) < 3):
        pixels = np.round(truth.camera.to_pixels(line.points[6:24])).astype(int)
        on_line += [bool(lane[v, u]) for u, v in pixels]
        on_paint += [bool(truth.paint[v, u]) for u, v in pixels]
    assert np.mean(on_line) > 0.9
    assert 0.05 < np.mean(on_paint) < 0.8


def test_labels_can_be_the_paint() -> None:
    lines, paint = SyntheticScenes(1, SIZE)[0].lane, SyntheticScenes(1, SIZE, labels="paint")
    np.testing.assert_array_equal(paint[0].lane, paint.scene(0).truth.paint)
    assert lines is not None
    assert not np.array_equal(lines, paint.scene(0).truth.paint)


def test_refuses_nonsense() -> None:
    with pytest.raises(IndexError):
        SyntheticScenes(0, SIZE, 3)[3]
    with pytest.raises(IndexError):
        SyntheticScenes(0, SIZE, 3)[-1]
    with pytest.raises(ConfigError, match="labels"):
        SyntheticScenes(labels="dots")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="size"):
        SyntheticScenes(size=(8, 8))
    with pytest.raises(ConfigError, match="seed must not be negative, got -1"):
        SyntheticScenes(-1)
    with pytest.raises(ConfigError, match="count must not be negative, got -1"):
        SyntheticScenes(count=-1)
    with pytest.raises(ConfigError, match="at least one frame"):
        SyntheticDrive(frames=0)
    for fps in (0.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="positive rate"):
            SyntheticDrive(fps=fps)
    with pytest.raises(ConfigError, match="seed must not be negative, got -1"):
        SyntheticDrive(seed=-1)


@pytest.mark.parametrize("size", ["96x160", 96, (96.5, 160), (96, 160, 3)])
def test_a_size_is_two_whole_numbers(tmp_path: Path, size: Any) -> None:
    with pytest.raises(ConfigError, match=r"^size must be two whole numbers, \(height, width\), got "):
        write_dataset(tmp_path / "out", count=1, size=size)
    with pytest.raises(ConfigError, match=r"^size must be two whole numbers, \(height, width\), got "):
        SyntheticDrive(size=size)


def test_a_size_may_be_a_list_or_an_array(tmp_path: Path) -> None:
    size: Any = [96, 160]
    write_dataset(tmp_path / "out", count=1, size=size)
    assert DrivingDataset(tmp_path / "out", "train")[0].size == (96, 160)
    assert SyntheticDrive(frames=1, size=np.array(size))[0].sample.size == (96, 160)  # type: ignore[arg-type]


def test_written_scenes_read_back(tmp_path: Path) -> None:
    write_dataset(tmp_path, "train", count=3, seed=9, size=SIZE)
    data = DrivingDataset(tmp_path, "train")
    assert len(data) == 3
    for index in range(3):
        made, read = SyntheticScenes(9, SIZE)[index], data[index]
        assert made.name == read.name
        assert made.boxes is not None
        assert read.boxes is not None
        np.testing.assert_allclose(read.boxes, made.boxes, atol=0.01)
        np.testing.assert_allclose(read.ignored, made.ignored, atol=0.01)
        np.testing.assert_array_equal(read.drivable, made.drivable)
        np.testing.assert_array_equal(read.lane, made.lane)
        # Channels in their order: JPEG changes a pixel by a little, a swap by much.
        apart = np.abs(read.image.astype(float).mean((0, 1)) - made.image.astype(float).mean((0, 1)))
        assert apart.max() < 2
        assert read.attributes["timeofday"] == made.attributes["timeofday"]


def test_writing_refuses_to_mix_with_what_is_there(tmp_path: Path) -> None:
    write_dataset(tmp_path, "val", count=1, seed=1, size=SIZE)
    with pytest.raises(OutputError, match="not empty"):
        write_dataset(tmp_path, "val", count=1, seed=2, size=SIZE)
    write_dataset(tmp_path, "train", count=1, seed=2, size=SIZE)
    with pytest.raises(ConfigError, match="at least 1"):
        write_dataset(tmp_path, "more", count=0)


def test_a_seed_that_another_split_has_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_dataset(tmp_path, "train", count=2, seed=1, size=SIZE)
    write_dataset(tmp_path, "val", count=1, seed=2, size=SIZE)
    assert not caplog.text
    write_dataset(tmp_path, "test", count=1, seed=1, size=SIZE)
    assert "images/train has the scenes of seed 1, too; another seed gives other scenes" in caplog.text
    assert "images/val" not in caplog.text


@pytest.mark.parametrize("workers", [1, 2])
def test_the_same_call_goes_on_where_one_was_interrupted(tmp_path: Path, workers: int) -> None:
    def stop(done: int, count: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    def files(root: Path) -> dict[str, bytes]:
        return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}

    call = functools.partial(write_dataset, split="val", count=4, seed=3, size=SIZE)
    call(tmp_path / "whole")
    root = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        call(root, progress=stop)
    first = root / "images/val/synthetic_3_000000.jpg"
    before = first.stat().st_mtime_ns
    assert files(root).keys() - files(tmp_path / "whole").keys() == {".synthesis-val.json"}
    (root / "images/val/.synthetic_3.01234567.part").write_bytes(b"half")
    with pytest.raises(OutputError, match=r"images/val is not empty, and not what the same command left"):
        call(root, count=5)
    with contextlib.closing(Claim(root / ".synthesis-val.json")):  # of the same call elsewhere
        with pytest.raises(OutputError, match=r"val\.json: it is being written already"):
            call(root)
        assert (root / "images/val/.synthetic_3.01234567.part").exists()
    call(root, workers=workers)
    assert files(root) == files(tmp_path / "whole")
    assert first.stat().st_mtime_ns == before
    with pytest.raises(OutputError, match="not empty"):
        call(root)


def test_an_image_that_is_there_has_its_labels_when_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(self: Image.Image, path: Path, **more: Any) -> None:
        path.write_bytes(b"cut off")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", save)
    with pytest.raises(OutputError, match="No space left"):
        write_dataset(tmp_path, "train", count=1, seed=0, size=SIZE)
    assert {path.suffix for path in tmp_path.rglob("*") if path.is_file()} == {".json", ".yaml"}


def test_vehicles_are_written_by_what_they_are(tmp_path: Path) -> None:
    size = (64, 96)
    write_dataset(tmp_path, "train", count=12, seed=4, size=size)
    names = ("car", "truck", "bus")
    one = DrivingDataset(tmp_path, "train")
    each = DrivingDataset(tmp_path, "train", class_names=names, classes={name: (name,) for name in names})
    seen = set[str]()
    for index in range(12):
        kinds = [thing.kind for thing in SyntheticScenes(4, size).scene(index).truth.objects if not thing.ignored]
        expected = [{"bus": "bus", "truck": "truck", "lorry": "truck"}.get(kind, "car") for kind in kinds]
        as_one, as_each = one[index].class_id, each[index].class_id
        assert as_one is not None
        assert as_each is not None
        assert [one.class_names[number] for number in as_one] == ["vehicle"] * len(kinds)
        assert [names[number] for number in as_each] == expected
        seen.update(kinds)
    assert {"bus", "truck", "lorry", "van"} <= seen


def test_a_description_that_leaves_vehicles_out_is_refused(tmp_path: Path) -> None:
    """As one that is of an earlier state, which called all vehicles cars."""
    (tmp_path / "dataset.yaml").write_text("classes: {vehicle: [car]}\nignore: [bus]\n")
    with pytest.raises(OutputError, match=r"dataset\.yaml leaves out truck: add each to a class or to `ignore`"):
        write_dataset(tmp_path, "val", count=1, size=SIZE)
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.yaml"]
    (tmp_path / "images/val").mkdir(parents=True)
    (tmp_path / "images/val/synthetic_0_000000.jpg").touch()
    state = tmp_path / ".synthesis-val.json"
    state.write_text(json.dumps({"seed": 0, "count": 1, "size": SIZE, "labels": "lines"}))
    with pytest.raises(OutputError, match="not what the same command left"):
        write_dataset(tmp_path, "val", count=1, size=SIZE)
    shutil.rmtree(tmp_path / "images")
    (tmp_path / "dataset.yaml").write_text("classes: {light: [car], heavy: [truck, bus]}\n")
    write_dataset(tmp_path, "val", count=1, size=SIZE)
    assert DrivingDataset(tmp_path, "val").class_names == ("light", "heavy")


def test_uncertain_vehicles_are_written_as_crowd() -> None:
    sample = Sample(
        "a", np.zeros((4, 4, 3), np.uint8), np.array([[0, 0, 2, 2]], np.float32), np.zeros(1, np.int64),
        np.array([[1, 1, 3, 3]], np.float32),
    )  # fmt: skip
    written = json.loads(json.dumps(annotation(sample)))
    crowds = [item["attributes"]["crowd"] for item in written["frames"][0]["objects"]]
    assert crowds == [False, True]


def test_a_drive_hangs_together() -> None:
    drive = SyntheticDrive(1, frames=250, fps=25, size=(180, 320), faults=False)
    first, second = drive[50], drive[51]
    change = np.abs(first.sample.image.astype(int) - second.sample.image).mean()
    other = np.abs(first.sample.image.astype(int) - SyntheticDrive(2, frames=1, size=(180, 320))[0].sample.image).mean()
    assert change < 0.5 * other
    known = {o.number: o for o in first.truth.objects if o.distance < 60 and abs(o.speed) > 5}
    step = 1 / 25
    for after in second.truth.objects:
        if (before := known.get(after.number)) is not None:
            moved = (after.speed - second.truth.speed) * step
            assert after.distance == pytest.approx(before.distance + moved, abs=0.12)


def test_a_drive_changes_lanes_and_has_a_lead() -> None:
    drive = SyntheticDrive(1, frames=250, fps=25, size=(96, 160), faults=False)
    offsets = [drive[i].truth.offset for i in range(100, 240, 10)]
    assert max(offsets) > 1.0  # nearing the line on the left
    assert min(offsets) < -1.0  # and coming from the right into the next lane
    assert abs(offsets[-1]) < 0.3
    assert drive[0].truth.lead is not None
    assert drive[0].truth.camera == drive[240].truth.camera


def test_a_vehicle_that_is_passed_leaves_by_the_edge_of_the_picture() -> None:
    drive = SyntheticDrive(0, frames=1500, size=(90, 160), faults=False)
    passed = [
        [thing for thing in drive[index].truth.objects if thing.number == 3]  # a truck on the right, 10.5 m long
        for index in range(45, 162, 6)
    ]
    ahead = [things[0] for things in passed if things]
    assert passed[: len(ahead)] == [[thing] for thing in ahead]  # once it is gone it stays so
    lefts = [float(thing.box[0]) for thing in ahead]
    assert lefts == sorted(lefts)
    assert lefts[-1] > 150
    assert ahead[-1].distance < -5
    assert not any(thing.ignored for thing in ahead[:-2])
    beside = np.array([thing.box for thing in ahead if thing.distance < 2])
    assert (beside[:, 2] == 160).all()
    assert (beside[1:8, 3] < 72).all()  # while the rear wheels are out of sight


def test_single_scenes_have_no_vehicle_beside_the_camera() -> None:
    for index in (65, 71, 147):  # each with traffic that would begin there
        world = random_world(np.random.default_rng((0, index)), SIZE)
        assert min(world.course.at(car.s, car.d)[0] for car in world.vehicles) > 2


def test_the_barriers_of_a_drive_do_not_travel_along() -> None:
    """Seed 5 has a guard rail on the right that would begin at 15 m."""
    drive = SyntheticDrive(5, frames=2, size=(90, 160), faults=False)
    for barrier in drive.world(0.0).layout.barriers:
        assert (barrier.start, barrier.end) == (0.0, FAR)
    assert any(barrier.d < 0 for barrier in drive.world(0.0).layout.barriers)


def test_the_truth_is_told_from_the_own_lane(scenes: list[Scene]) -> None:
    bends = 0
    for truth in (scene.truth for scene in scenes):
        assert abs(truth.offset) <= truth.lane_width / 2 + 1e-6
        places = [line.d for line in truth.lines]
        assert places == sorted(places, reverse=True)  # from the left to the right
        for line in truth.lines:
            assert line.polynomial[0] == pytest.approx(line.d - truth.offset, abs=0.2)
            assert line.polynomial[1] == pytest.approx(-truth.heading, abs=0.03)
            if abs(truth.curvature) > 0.002:
                bends += 1
                assert 2 * line.polynomial[2] == pytest.approx(truth.curvature, rel=0.4)
        for thing in truth.objects:
            if thing.distance < 12:
                assert thing.lateral == pytest.approx(thing.d - truth.offset, abs=1.0)
    assert bends > 10


def test_the_lead_is_the_nearest_in_the_own_lane_that_is_seen(scenes: list[Scene]) -> None:
    truth = next(scene.truth for scene in scenes if scene.truth.objects)
    thing = truth.objects[0]

    def lead(*places: tuple[float, float, bool]) -> float | None:
        objects = [dataclasses.replace(thing, distance=x, d=d, ignored=hidden) for x, d, hidden in places]
        found = dataclasses.replace(truth, objects=tuple(objects)).lead
        return None if found is None else found.distance

    side = truth.lane_width / 2 + 0.1
    assert lead((40, 0.3, False), (10, 0, True), (15, side, False), (30, -0.3, False)) == 30
    assert lead((15, side, False), (10, 0, True)) is None
    assert lead((-3, 0, False), (20, 0, False)) == 20  # one that is beside is not ahead


def test_a_layout_in_the_mirror() -> None:
    for kind in ("motorway", "country", "city"):
        layout = random_layout(np.random.default_rng(3), kind)
        other = layout.mirrored()
        assert other.drivable == (-layout.drivable[1], -layout.drivable[0])
        assert [mark.d for mark in other.markings] == [-mark.d for mark in layout.markings]
        assert other.oncoming == tuple(-d for d in layout.oncoming) != ()
        assert other.mirrored() == layout


def test_lines_of_a_course_are_parallel() -> None:
    course = Course(np.zeros_like, offset=0.5, heading=0.1)
    middle, left = course.line(0.0), course.line(2.0)
    slope = np.diff(middle[:, 1]) / np.diff(middle[:, 0])
    np.testing.assert_allclose(slope, -math.tan(0.1), rtol=1e-6)
    np.testing.assert_allclose((left[:, 1] - middle[:, 1]) * math.cos(0.1), 2.0, rtol=1e-6)
    assert middle[0, 1] == pytest.approx(-0.5 / math.cos(0.1))


@pytest.mark.parametrize("yaw", [0.0, math.pi])
def test_a_vehicle_is_placed_by_the_end_that_is_nearest(yaw: float) -> None:
    pose = VehiclePose(Vehicle("sedan", 20.0, 1.0, yaw, (9.0, 9.0, 9.0), 1.05), 20.0, 1.0, yaw)
    box = pose.ground_box
    length, width = pose.shape.length * 1.05, pose.shape.width * 1.05
    np.testing.assert_allclose([box[:, 0].min(), box[:, 0].max()], [20, 20 + length])
    np.testing.assert_allclose([box[:, 1].min(), box[:, 1].max()], [1 - width / 2, 1 + width / 2])


def test_a_polygon_is_cut_off_before_the_camera() -> None:
    camera = Camera.from_field_of_view((90, 160), 60.0, 1.4)
    square = np.array([[-3.0, 2.0, 0.0], [5.0, 2.0, 0.0], [5.0, 4.0, 0.0], [-3.0, 4.0, 0.0]])
    cut = in_front(camera, square)
    assert len(cut) == 4
    np.testing.assert_allclose([cut.min(axis=0), cut.max(axis=0)], [[1, 2, 0], [5, 4, 0]])
    ahead = np.array([5.0, 0.0, 0.0])
    np.testing.assert_array_equal(in_front(camera, square + ahead), square + ahead)
    assert len(in_front(camera, square - 2 * ahead)) == 0


def test_the_way_aside_and_its_rate_agree() -> None:
    drive = SyntheticDrive(1, frames=250, fps=25, size=(96, 160))
    before, change = drive._aside(0.0), 0.45 * drive.duration
    for time in (1.0, change + 1.0, change + 2.25, change + 4.0):
        (after, _), (earlier, _) = drive._aside(time + 1e-4), drive._aside(time - 1e-4)
        assert drive._aside(time)[1] == pytest.approx((after - earlier) / 2e-4, abs=1e-4)
    weave = drive._aside(7 * 3)[0] - before[0]  # three whole periods of it later
    assert weave == pytest.approx(drive._layout.lane_width)
