from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from trilitenet.data.synthetic import Scene
from trilitenet.errors import ConfigError, OutputError
from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import SelfCalibration, View, read_camera, write_camera
from trilitenet.road.lanes import assign_positions, find_lines
from trilitenet.road.structures import LaneLine
from trilitenet.structures import Boxes

CAMERA = Camera(
    (720, 1280), 1100.0, 1105.0, 641.0, 355.0, 1.42, 0.03, -0.01, 0.005, (-0.3, 0.1, 0.001, 0.0, 0.0), 1.8, -0.3, 2.5
)

SHORT = "image_width: 640\nimage_height: 360\nheight: 1.3\n"

OPENCV = """%YAML:1.0
---
image_width: 1280
image_height: 720
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [1100., 0., 640., 0., 1100., 360., 0., 0., 1.]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [0., 0., 0., 0., 0.]
height: 1.4
pitch: 3.0
"""


def test_a_camera_file_round_trip(tmp_path: Path) -> None:
    write_camera(CAMERA, tmp_path / "camera.yaml")
    read = read_camera(tmp_path / "camera.yaml")
    for field in dataclasses.fields(Camera):
        np.testing.assert_allclose(getattr(read, field.name), getattr(CAMERA, field.name), atol=1e-12)
    with pytest.raises(OutputError, match="cannot be written"):
        write_camera(CAMERA, tmp_path / "camera.yaml" / "camera.yaml")


def test_writes_what_opencv_calibrates(tmp_path: Path) -> None:
    fx, fy, cx, cy, mounted = np.array([1100.0, 1105.0, 641.0, 355.0, 1.42])
    height, width = np.array([720, 1280])
    lens = tuple(np.array([[-0.3, 0.1, 0.001, 0.0, 0.0]]).ravel())
    camera = Camera((height, width), fx, fy, cx, cy, mounted, distortion=lens)
    write_camera(camera, tmp_path / "camera.yaml")
    assert read_camera(tmp_path / "camera.yaml") == camera


@pytest.mark.parametrize("lens", ["field_of_view: 60", "camera_matrix: [554, 0, 320, 0, 554, 180, 0, 0, 1]"])
def test_where_the_camera_is_in_the_vehicle_may_be_told(tmp_path: Path, lens: str) -> None:
    path = tmp_path / "camera.yaml"
    for text, told in (("", (0.0, 0.0, None)), ("front: 1.8\nleft: -0.3\nvehicle_width: 2.5\n", (1.8, -0.3, 2.5))):
        path.write_text(f"{SHORT}{lens}\n{text}")
        camera = read_camera(path).resized((720, 1280))
        assert (camera.front, camera.left, camera.vehicle_width) == told


def test_reads_what_opencv_writes(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(OPENCV)
    camera = read_camera(path)
    assert (camera.fx, camera.cx, camera.size) == (1100.0, 640.0, (720, 1280))
    assert camera.pitch == pytest.approx(np.radians(3.0))
    assert camera.distortion == ()


def test_passes_over_what_else_calibration_programs_write(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(OPENCV + 'calibration_time: "Tue"\nflags: 0\navg_reprojection_error: 0.3\nsquare_size: 1.\n')
    assert read_camera(path).fx == 1100.0
    ros = OPENCV + "projection_matrix: {rows: 3, cols: 4, data: [1]}\ndistortion_model: "
    path.write_text(ros + "plumb_bob\n")
    assert read_camera(path).fx == 1100.0
    for told in (ros + "equidistant\n", OPENCV + "fisheye_model: 1\n"):
        path.write_text(told)
        with pytest.raises(ConfigError, match=r"lenses of the model '(equidistant|fisheye)' are not known"):
            read_camera(path)


def test_a_field_of_view_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("image_width: 640\nimage_height: 360\nheight: 1.3\nfield_of_view: 70\n")
    assert read_camera(path) == Camera.from_field_of_view((360, 640), 70.0, 1.3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_width: 640\nimage_height: 360\nheight: 1.3\n", "needs camera_matrix, or field_of_view"),
        ("image_width: 640\nimage_height: 360\nfield_of_view: 60\n", "missing key 'height'"),
        ("image_width: 640\nimage_height: 360\nheight: 1.3\nfield_of_veiw: 60\n", "did you mean 'field_of_view'"),
        ("image_width: 640\nimage_height: 360\nheight: 0\nfield_of_view: 60\n", "height must be positive"),
        ("image_width: 640\nimage_height: 360\nheight: 1\ncamera_matrix: {data: [1, 2]}\n", "9 numbers, got 2"),
        (SHORT + "camera_matrix: [[1, 2], [3]]\n", "9 numbers, got 3"),
        (
            "image_width: 640\nimage_height: 360\nheigth: 1.5\nfield_of_view: 60\n",
            "unknown key 'heigth'; did you mean 'height'",
        ),
        (SHORT + "camera_matrix: {data: [1], colls: 3}\n", "unknown key 'camera_matrix.colls'; did you mean 'cols'"),
        (SHORT + "camera_matrix: [900, 0, .nan, 0, 900, 180, 0, 0, 1]\n", "must be finite numbers"),
        (SHORT + "camera_matrix: [900, 2, 320, 0, 900, 180, 0, 0, 1]\n", "cannot be skewed"),
        (
            SHORT + "camera_matrix: [900, 0, 320, 0, 900, 180, 0, 0, 1]\ndistortion_coefficients: [.nan, 0, 0, 0]\n",
            "must be finite numbers",
        ),
        (SHORT + "field_of_view: 60\ndistortion_coefficients: [-0.3, 0, 0, 0]\n", "for an ideal lens"),
        (SHORT + "field_of_view: 60\nfront: -1.8\n", r"front must be between 0.0 and 10.0 metres, got -1.8"),
        (SHORT + "field_of_view: 60\nfront: .nan\n", "front must be between 0.0 and 10.0 metres, got nan"),
        (SHORT + "field_of_view: 60\nleft: 30\n", r"left must be between -2.0 and 2.0 metres, got 30"),
        (SHORT + "field_of_view: 60\nvehicle_width: 0\n", r"vehicle_width must be between 0.5 and 4.0 metres, got 0"),
        (SHORT + "field_of_view: 60\nvehicle_widht: 2\n", "did you mean 'vehicle_width'"),
        ("- 1\n", "must be a mapping"),
        ("a: [\n", "not YAML"),
    ],
)
def test_bad_camera_files_are_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_camera(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_camera(tmp_path / "absent.yaml")


def _positioned(scene: Scene) -> list[LaneLine]:
    assert scene.sample.lane is not None
    lines = find_lines(scene.sample.lane)
    height, width = scene.sample.size
    return assign_positions(lines, [float(line.column(height - 1.0)) - (width - 1) / 2 for line in lines])


def test_calibrates_itself_from_the_lanes(drive: tuple[Scene, ...]) -> None:
    truth = drive[0].truth
    calibration = SelfCalibration(drive[0].sample.size, field_of_view=60.0, lane_width=truth.lane_width)
    for scene in drive[:6]:
        calibration.update(_positioned(scene), scene.truth.timestamp)
    assert calibration.camera is None  # a few frames do not convince it
    for scene in drive[6:25]:
        calibration.update(_positioned(scene), scene.truth.timestamp)
    camera = calibration.camera
    assert camera is not None
    assert camera.pitch == pytest.approx(truth.camera.pitch, abs=0.003)
    assert camera.yaw == pytest.approx(truth.camera.yaw, abs=0.006)
    assert camera.height == pytest.approx(truth.camera.height, rel=0.02)
    assert abs(camera.pitch - truth.camera.pitch) < 3 * calibration.errors.pitch
    assert calibration.errors.focal > 0.1  # lanes do not show the focal length


def test_stays_unsure_without_lanes() -> None:
    calibration = SelfCalibration((360, 640))
    for frame in range(50):
        calibration.update([], frame / 25)
    assert calibration.camera is None
    with pytest.raises(ConfigError, match="lane width"):
        SelfCalibration((360, 640), lane_width=0.0)


def test_the_view_goes_there_and_back() -> None:
    view = View()
    points = np.array([[10.0, 2.0], [40.0, -5.0]])
    pixels = np.concatenate([view.to_pixels(points), np.ones((2, 1))], axis=1)
    np.testing.assert_allclose((pixels @ view.matrix.T)[:, :2], points)


@functools.cache
def _seen(heading: float) -> list[LaneLine]:
    """Return the lines of a straight lane as a car sees them that points so many radians to its left."""
    mounted = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03, yaw=heading)
    return _straight(mounted, 1.75, -1.75)


def _straight(mounted: Camera, *sides: float) -> list[LaneLine]:
    """Return straight lines so many metres to the left."""
    mask = np.zeros(mounted.size, np.uint8)
    ahead = np.linspace(5.0, 60.0, 100)
    for side in sides:
        pixels = mounted.to_pixels(np.stack([ahead, np.full_like(ahead, side)], axis=1))
        cv2.polylines(mask, [np.round(pixels * 16).astype(np.int32)], False, 1, 3, shift=4)
    lines = find_lines(mask)
    return assign_positions(lines, [float(line.column(359.0)) - 319.5 for line in lines])


def _drive(rate: int, seconds: float, heading: Callable[[float], float]) -> list[tuple[float, float]]:
    """Return the yaw and its error of each frame once there is a camera that looks straight ahead."""
    calibration, found = SelfCalibration((360, 640)), []
    for frame in range(round(seconds * rate)):
        calibration.update(_seen(round(heading(frame / rate), 3)), frame / rate)
        if calibration.camera is not None:
            found.append((calibration.camera.yaw, calibration.errors.yaw))
    return found


@pytest.mark.parametrize("rate", [10, 25, 60, 120])
def test_a_change_of_lanes_is_not_taken_for_yaw(rate: int) -> None:
    found = _drive(rate, 14.0, lambda now: 0.05 * math.sin(math.pi * (now - 8) / 4.5) if 8 < now < 12.5 else 0.0)
    assert len(found) == round(14.0 * rate) - SelfCalibration.NEEDED + 1
    assert max(abs(yaw) for yaw, _ in found) < 0.012
    assert max(abs(yaw) / error for yaw, error in found) < 2


def _wander(now: float) -> float:
    return 0.006 * math.sin(1.3 * now)


@pytest.mark.parametrize(("drive", "stop"), [(5, 12), (10, 60)])
@pytest.mark.parametrize("aside", [0.02, 0.06])
def test_a_stop_is_not_taken_for_yaw(drive: int, stop: int, aside: float) -> None:
    found = _drive(25, drive + stop + 5, lambda now: aside if drive < now <= drive + stop else _wander(now))
    assert max(abs(yaw) for yaw, _ in found) < 0.012
    assert max(abs(yaw) / error for yaw, error in found[25:]) < 2


def test_a_clip_that_begins_with_a_stop_is_made_good_by_the_drive() -> None:
    found = _drive(25, 60, lambda now: 0.03 if now < 30 else _wander(now))
    assert found[29 * 25][0] == pytest.approx(0.03, abs=0.004)
    assert abs(found[-1][0]) < 0.004
    found = _drive(25, 60, lambda now: 0.03 if now < 5 else 0.0)  # as if painted: lines that do not move again
    assert abs(found[-1][0]) < 0.004


def test_the_error_of_the_yaw_knows_of_two_headings() -> None:
    found = _drive(25, 12, lambda now: 0.03 if now < 5 else _wander(now))
    assert max(min(abs(yaw), abs(yaw - 0.03)) / error for yaw, error in found) < 2
    assert max(error for _, error in found) > 0.012


def test_a_clock_that_is_set_back_does_not_stop_the_calibration() -> None:
    calibration = SelfCalibration((360, 640))
    for frame in range(20):
        calibration.update(_seen(0.03), 100 + frame / 25)
    for frame in range(100):
        calibration.update(_seen(round(_wander(frame / 25), 3)), frame / 25)
    assert calibration.camera is not None
    assert calibration.camera.yaw == pytest.approx(0.0, abs=0.01)


def test_bends_count_by_time_too() -> None:
    calibration = SelfCalibration((360, 640))
    for frame in range(60):
        calibration.update(_seen(round(_wander(frame / 25), 3)), frame / 25)
        calibration.see_bend(0.0)
    for frame in range(600):
        calibration.update(_seen(0.0), 60 / 25 + frame / 1000)
        calibration.see_bend(0.004)
    assert calibration.errors.yaw < 0.015


def test_a_camera_that_looks_to_the_left_is_told_so() -> None:
    mounted = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03, yaw=0.05)
    calibration = SelfCalibration(mounted.size, still=True)
    calibration.update(_straight(mounted, 1.75, -1.75, -5.25), 0.0)
    assert calibration.camera is not None
    assert calibration.camera.yaw == pytest.approx(0.05, abs=0.01)
    assert calibration.camera.pitch == pytest.approx(0.03, abs=0.01)


def test_two_lines_that_meet_do_not_calibrate_a_picture() -> None:
    mounted = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    for sides, told in (((1.75, -1.75), False), ((5.25, 1.75, -1.75), True)):
        calibration = SelfCalibration(mounted.size, still=True)
        calibration.update(_straight(mounted, *sides), 0.0)
        assert (calibration.camera is not None) == told


def _cars(mounted: Camera, *places: tuple[float, float], wide: float = 1.8) -> Boxes:
    """Return boxes of rears so many metres ahead and to the left."""
    rows = []
    for ahead, left in places:
        (start, foot), (end, _) = mounted.to_pixels([[ahead, left + wide / 2], [ahead, left - wide / 2]]) + 0.5
        rows.append([start, foot - 0.8 * (end - start), end, foot])
    count = len(places)
    return Boxes(np.array(rows, np.float32), np.full(count, 0.9, np.float32), np.zeros(count, np.int64))


@pytest.mark.parametrize("still", [True, False])
def test_no_camera_where_vehicles_contradict_the_lane(still: bool) -> None:
    mounted = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    places = ((10.0, 0.0), (16.0, 3.0), (30.0, -1.0))
    cases = [
        (1.75, places, 1.8, True),
        (1.75, places, 2.55, True),  # lorries
        (1.45, places, 2.55, True),  # in narrow lanes
        (3.2, places, 1.8, False),  # the edges of a road of two lanes
        (0.8, places, 1.8, False),  # a seam in the lane's middle
        (3.2, (), 1.8, True),
    ]
    for half, seen, wide, told in cases:
        calibration = SelfCalibration(mounted.size, still=still)
        lines = _straight(mounted, half + 1.5, half, -half)
        for frame in range(12):
            calibration.update(lines, frame / 25, _cars(mounted, *seen, wide=wide) if seen else None)
        assert (calibration.camera is not None) == told, (half, seen, wide)


@pytest.mark.parametrize(
    ("field_of_view", "rows"),
    [
        (30, [[0.0, 200.0, 40.0, 270.0]]),  # cut by the picture's edges: left, right, below
        (30, [[600.0, 200.0, 640.0, 270.0]]),
        (60, [[300.0, 300.0, 340.0, 360.0]]),
        (60, [[100.0, 220.0, 130.0, 250.0]]),  # far aside
        (60, [[316.0, 176.0, 321.0, 182.0]]),  # far away
        (60, [[270.0, 170.0, 370.0, 241.0], [260.0, 180.0, 285.0, 230.0], [355.0, 180.0, 380.0, 230.0]]),  # half hidden
    ],
)
def test_what_is_not_seen_whole_contradicts_nothing(field_of_view: float, rows: list[list[float]]) -> None:
    mounted = Camera.from_field_of_view((360, 640), field_of_view, 1.4, pitch=0.03)
    count = len(rows)
    boxes = Boxes(np.array(rows, np.float32), np.full(count, 0.9, np.float32), np.zeros(count, np.int64))
    calibration = SelfCalibration(mounted.size, field_of_view=field_of_view, still=True)
    calibration.update(_straight(mounted, 5.25, 1.75, -1.75), 0.0, boxes)
    assert calibration.camera is not None


def test_a_video_is_not_contradicted_by_few_frames() -> None:
    mounted = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    calibration, lines, odd = SelfCalibration(mounted.size), _seen(0.0), _cars(mounted, (12.0, 0.0), wide=0.8)
    for frame in range(12 + SelfCalibration.NEEDED - 1):
        calibration.update(lines, frame / 10, odd if frame >= 12 else None)
    assert calibration.camera is not None
    calibration.update(lines, 2.3, odd)
    assert calibration.camera is None
    for frame in range(24, 60):
        calibration.update(lines, frame / 10, _cars(mounted, (12.0, 0.0)))
    assert calibration.camera is not None


def test_a_camera_does_not_come_and_go_with_vehicles_at_the_limit() -> None:
    mounted = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    calibration, lines, told, now = SelfCalibration(mounted.size), _seen(0.0), [], 0.0
    for wide in (3.0, 3.25, 3.6, 3.25, 3.0):  # a median within the limit, just over it, far over it, and back
        for _ in range(SelfCalibration.WINDOW):
            now += SelfCalibration.UNMOVED_INTERVAL
            calibration.update(lines, now, _cars(mounted, (12.0, 0.0), wide=wide))
        told.append(calibration.camera is not None)
    assert told == [True, True, False, False, True]
