from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from trilitenet.errors import ConfigError
from trilitenet.processing.geometry import Camera

CAMERA = Camera.from_field_of_view((720, 1280), 60.0, 1.4, pitch=0.05, yaw=-0.02, roll=0.03)


def test_a_level_camera_by_hand() -> None:
    camera = Camera((480, 640), 500.0, 500.0, 319.5, 239.5, height=1.5)
    # 10 m ahead and 2 m to the left: 2/10 of the focal length left of the middle, 1.5/10 of it below.
    np.testing.assert_allclose(camera.to_pixels([[10.0, 2.0]]), [[319.5 - 100.0, 239.5 + 75.0]])
    np.testing.assert_allclose(camera.vanishing_point(), (319.5, 239.5))
    np.testing.assert_allclose(camera.horizon([0, 639]), [239.5, 239.5])


@pytest.mark.parametrize(
    ("angle", "axis", "sign"),
    [("pitch", 1, -1), ("yaw", 0, 1)],
    ids=["down moves things up", "left moves things right"],
)
def test_signs_of_pitch_and_yaw(angle: str, axis: int, sign: int) -> None:
    level = Camera.from_field_of_view((480, 640), 60.0, 1.5)
    turned = dataclasses.replace(level, **{angle: 0.05})  # type: ignore[arg-type]
    moved = turned.to_pixels([[20.0, 0.0]])[0] - level.to_pixels([[20.0, 0.0]])[0]
    assert moved[axis] * sign > 20


@pytest.mark.parametrize(
    ("name", "ends"), [("front", (0.0, 10.0)), ("left", (-2.0, 2.0)), ("vehicle_width", (0.5, 4.0))]
)
def test_the_place_in_the_vehicle_moves_no_pixel_and_has_a_range(name: str, ends: tuple[float, float]) -> None:
    for value in ends:
        placed = dataclasses.replace(CAMERA, **{name: value})  # type: ignore[arg-type]
        np.testing.assert_array_equal(placed.to_pixels([[20.0, 1.0]]), CAMERA.to_pixels([[20.0, 1.0]]))
        assert placed.to_dict()[name] == value
    for value in (ends[0] - 0.1, ends[1] + 0.1, math.nan):
        with pytest.raises(ConfigError, match=f"camera {name} must be between"):
            dataclasses.replace(CAMERA, **{name: value})  # type: ignore[arg-type]


def test_a_strong_lens_there_and_back() -> None:
    lens = (0.2, 0.1, 0.0, 0.0, 0.002, 0.55, 0.15, 0.01)
    camera = Camera((720, 1280), 370.0, 370.0, 639.5, 359.5, 1.4, 0.05, distortion=lens)
    pixels = np.array([[5.0, 715.0], [1270.0, 700.0], [640.0, 600.0]])
    np.testing.assert_allclose(camera.to_pixels(camera.to_ground(pixels)), pixels, atol=0.01)


def test_pixels_that_a_lens_cannot_show_are_not_on_the_road() -> None:
    camera = Camera((720, 1280), 448.0, 448.0, 639.5, 359.5, 1.4, 0.05, distortion=(-0.25, 0.06, 0.0, 0.0, -0.006))
    ground = camera.to_ground([[100.0, 500.0], [1160.0, 600.0], [640.0, 600.0]])
    assert np.isnan(ground).all(axis=1).tolist() == [True, True, False]


def test_roll_lowers_the_right_side_of_the_camera() -> None:
    rolled = dataclasses.replace(Camera.from_field_of_view((480, 640), 60.0, 1.5), roll=0.1)
    left, right = rolled.horizon([0, 639])
    assert left > right  # the right side looks lower, so the horizon stands higher there
    np.testing.assert_allclose((left - right) / 639, math.tan(0.1), rtol=1e-6)


@pytest.mark.parametrize("distortion", [(), (-0.3, 0.1, 0.001, -0.0005, 0.01)])
def test_ground_to_pixels_and_back(rng: np.random.Generator, distortion: tuple[float, ...]) -> None:
    camera = dataclasses.replace(CAMERA, distortion=distortion)
    points = np.stack([rng.uniform(5, 60, 50), rng.uniform(-2, 2, 50)], axis=1)
    np.testing.assert_allclose(camera.to_ground(camera.to_pixels(points)), points, rtol=2e-3, atol=2e-3)


def test_the_homography_agrees_with_the_projection(rng: np.random.Generator) -> None:
    points = np.stack([rng.uniform(3, 80, 50), rng.uniform(-8, 8, 50)], axis=1)
    mapped = cv2.perspectiveTransform(points[:, None], CAMERA.ground_homography)[:, 0]
    np.testing.assert_allclose(mapped, CAMERA.to_pixels(points), atol=1e-8)


def test_agrees_with_opencv(rng: np.random.Generator) -> None:
    points = np.stack([rng.uniform(3, 80, 20), rng.uniform(-8, 8, 20), rng.uniform(0, 3, 20)], axis=1)
    turn, _ = cv2.Rodrigues(CAMERA.rotation.T)
    shift = -CAMERA.rotation.T @ (0.0, 0.0, CAMERA.height)
    expected, _ = cv2.projectPoints(points[:, None], turn, shift, CAMERA.matrix, np.zeros(5))
    np.testing.assert_allclose(CAMERA.to_pixels(points), np.asarray(expected)[:, 0], atol=1e-6)


def test_no_ground_above_the_horizon_and_no_pixel_behind() -> None:
    row = float(CAMERA.horizon([600.0])[0])
    ground = CAMERA.to_ground([[600.0, row - 5], [600.0, row + 5]])
    assert np.isnan(ground[0]).all()
    assert ground[1, 0] > 100
    assert np.isnan(CAMERA.to_pixels([[-5.0, 0.0]])).all()


def test_the_vanishing_point_lies_on_the_horizon_and_roads_go_there() -> None:
    u, v = CAMERA.vanishing_point(0.1)
    np.testing.assert_allclose(CAMERA.horizon([u]), [v], atol=1e-6)
    far = CAMERA.to_pixels([[1e6 * math.cos(0.1), 1e6 * math.sin(0.1)]])
    np.testing.assert_allclose(far[0], (u, v), atol=0.01)


def test_resizing_keeps_the_view() -> None:
    small = CAMERA.resized((360, 640))
    points = [[10.0, 1.0], [40.0, -3.0]]
    # Pixel middles: (u + 1/2) scales.
    np.testing.assert_allclose((small.to_pixels(points) + 0.5) * 2, CAMERA.to_pixels(points) + 0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 0.0}, "height must be positive"),
        ({"height": 140}, "height must be at most 10.0 metres above the road, got 140"),  # centimetres
        ({"fx": -1.0}, "fx must be positive"),
        ({"pitch": 2.0}, "between -90 and 90 degrees"),
        ({"distortion": (0.1,)}, "coefficients, got 1"),
        ({"size": (0, 5)}, "size must be"),
    ],
)
def test_refuses_nonsense(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(CAMERA, **change)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="field of view"):
        Camera.from_field_of_view((10, 10), 180.0, 1.0)
