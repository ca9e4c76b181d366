from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.data.synthetic import Scene, SyntheticScenes
from trilitenet.processing.geometry import Camera
from trilitenet.road.lanes import assign_positions, find_lines, vanishing_point

SIZE = (384, 640)


def paint(*lines: NDArray[np.float64], size: tuple[int, int] = SIZE, thickness: int = 4) -> NDArray[np.bool_]:
    mask = np.zeros(size, np.uint8)
    for line in lines:
        cv2.polylines(mask, [np.round(line * 16).astype(np.int32)], False, 1, thickness, cv2.LINE_8, 4)
    return mask.astype(np.bool_)


def straight(bottom: float, top: float, rows: tuple[float, float] = (383, 190)) -> NDArray[np.float64]:
    return np.array([[bottom, rows[0]], [top, rows[1]]])


def test_an_empty_mask_has_no_lines() -> None:
    assert find_lines(np.zeros(SIZE, bool)) == []
    specks = np.zeros(SIZE, bool)
    specks[100:102, 50:54] = True
    specks[300:304, 400] = True
    assert find_lines(specks) == []


def test_two_straight_lines_and_their_place() -> None:
    lines = find_lines(paint(straight(120, 300), straight(540, 340)))
    assert len(lines) == 2
    for line in lines:
        bottom, top = (120, 300) if line.column(380) < 320 else (540, 340)
        rows = np.array([220.0, 300.0, 370.0])
        np.testing.assert_allclose(line.column(rows), bottom + (383 - rows) / 193 * (top - bottom), atol=0.7)
        assert line.residual < 0.6
        assert line.confidence > 0.8
        assert line.points[0, 1] > line.points[-1, 1]


def test_the_json_form_has_the_curve_in_pixels() -> None:
    v = np.linspace(383, 185, 60)
    (line,) = find_lines(paint(np.stack([200 + 0.4 * (383 - v) + 1500 / (v - 165), v], axis=1)))
    form = line.to_dict()
    assert form["ground"] is None
    v0, span = form["origin"]
    rows = np.linspace(v0, v0 + span, 9)
    columns = np.polynomial.Polynomial(form["polynomial"])((rows - v0) / span)
    np.testing.assert_allclose(columns, line.column(rows), atol=0.02)


def test_a_line_keeps_its_rows_where_the_height_is_no_multiple_of_the_scale() -> None:
    (line,) = find_lines(paint(straight(133, 2133, (1438, 720)), size=(1439, 2560), thickness=12))
    rows = np.linspace(800, 1400, 20)
    missed = line.column(rows) - (133 + (1438 - rows) / 718 * 2000)
    assert abs(missed.mean()) < 0.7


def test_a_curve_that_bends_towards_the_horizon() -> None:
    v = np.linspace(383, 185, 60)
    u = 200 + 0.4 * (383 - v) + 1500 / (v - 165)
    (line,) = find_lines(paint(np.stack([u, v], axis=1)))
    slope = 0.4 + 1500 / (v - 165) ** 2
    apart = np.abs(line.column(v) - u) / np.sqrt(1 + slope**2)
    assert apart[3:-3].max() < 2.0


def test_dashes_become_one_line() -> None:
    whole = paint(straight(160, 300))
    rows = np.arange(384)
    whole[(rows % 60) < 26] = False
    lines = find_lines(whole)
    assert len(lines) == 1
    assert lines[0].confidence < find_lines(paint(straight(160, 300)))[0].confidence


def test_lines_that_merge_far_away_stay_two() -> None:
    lines = find_lines(paint(straight(150, 318, (383, 175)), straight(420, 322, (383, 175))))
    assert len(lines) == 2
    bottoms = sorted(float(line.column(383.0)) for line in lines)
    np.testing.assert_allclose(bottoms, [150, 420], atol=2)


def test_a_flat_line_at_the_side() -> None:
    (line,) = find_lines(paint(np.array([[2.0, 260.0], [300.0, 185.0]])))
    np.testing.assert_allclose(line.column(220.0), 2 + (260 - 220) / 75 * 298, atol=4)


def test_a_double_line_counts_once() -> None:
    lines = find_lines(paint(straight(100, 296), straight(112, 298), straight(540, 340)))
    assert len(lines) == 2


def test_a_stop_line_is_no_lane_line() -> None:
    lines = find_lines(paint(straight(120, 300), np.array([[140.0, 300.0], [500.0, 300.0]])))
    assert len(lines) == 1


@pytest.mark.parametrize("scale", [1, 2])
def test_larger_masks_give_larger_coordinates(scale: int) -> None:
    mask = paint(straight(120, 300))
    large = cv2.resize(mask.astype(np.uint8), None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST) > 0
    (line,) = find_lines(large)
    (base,) = find_lines(mask)
    np.testing.assert_allclose(
        (line.column(300.0 * scale + (scale - 1) / 2) + 0.5) / scale, base.column(300.0) + 0.5, atol=0.3
    )


def test_finds_the_true_lines_of_synthetic_scenes() -> None:
    scenes = SyntheticScenes(21, SIZE, faults=False)
    found = wanted = 0
    for index in range(14):
        scene = scenes.scene(index)
        assert scene.sample.lane is not None
        lines = find_lines(scene.sample.lane)
        for truth in scene.truth.lines:
            near = truth.points[(truth.points[:, 0] >= 6) & (truth.points[:, 0] <= 25)]
            pixels = scene.truth.camera.to_pixels(near)
            inside = ((pixels >= 3) & (pixels < (SIZE[1] - 3, SIZE[0] - 3))).all(axis=1)
            seen = [
                scene.sample.lane[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2].any()
                for u, v in pixels[inside]
            ]
            if len(seen) < 8 or np.mean(seen) < 0.9:
                continue
            wanted += 1
            pixels = pixels[inside]
            slope = np.abs(np.gradient(pixels[:, 0]) / np.minimum(np.gradient(pixels[:, 1]), -1e-3))
            apart = [
                np.median(np.abs(line.column(pixels[:, 1]) - pixels[:, 0]) / np.sqrt(1 + slope**2)) for line in lines
            ]
            found += min(apart, default=99.0) < 2.5
    assert wanted >= 25
    assert found / wanted >= 0.9


def test_the_vanishing_point_of_a_straight_drive(drive: tuple[Scene, ...]) -> None:
    errors = []
    for scene in drive[::6]:
        assert scene.sample.lane is not None
        point = vanishing_point(find_lines(scene.sample.lane), scene.sample.size)
        if point is not None:
            errors.append(point.v - scene.truth.camera.vanishing_point()[1])
            assert abs(errors[-1]) < 4 * point.error
    assert len(errors) >= 7
    assert np.median(np.abs(errors)) < 0.5


def test_the_vanishing_point_behind_a_lens_that_bends_lines() -> None:
    camera = Camera((720, 1280), 700.0, 700.0, 639.5, 359.5, 1.4, 0.14, distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))
    ahead = np.linspace(3.0, 60.0, 80)
    mask = np.zeros(camera.size, np.uint8)
    for y in (-1.8, 1.8):
        pixels = camera.to_pixels(np.stack([ahead, np.full(80, y)], axis=1))
        cv2.polylines(mask, [np.round(pixels * 16).astype(np.int32)], False, 1, 6, cv2.LINE_8, 4)
    lines = find_lines(mask.astype(np.bool_))
    straightened, bent = (vanishing_point(lines, camera.size, known) for known in (camera, None))
    assert straightened is not None
    assert bent is not None
    assert abs(straightened.v - camera.vanishing_point()[1]) < 1.5
    assert abs(bent.v - camera.vanishing_point()[1]) > 5


def test_no_vanishing_point_of_one_line_or_of_none() -> None:
    assert vanishing_point(find_lines(paint(straight(120, 300))), SIZE) is None
    assert vanishing_point([], SIZE) is None


def test_positions_count_from_the_vehicle_outwards() -> None:
    (line,) = find_lines(paint(straight(120, 300)))
    numbered = assign_positions([line] * 5, [5.0, -1.0, 1.0, -4.0, None])
    assert [item.position for item in numbered] == [-2, -1, 1, 2, 0]


def test_a_line_in_a_large_mask_is_where_its_pixels_are() -> None:
    mask = np.zeros((720, 1280), np.uint8)
    mask[360:, 600:608] = 1
    (line,) = find_lines(mask)
    assert float(line.column(500.0)) == pytest.approx(603.5, abs=0.2)


def test_a_stripe_that_the_edge_of_the_picture_cuts_is_no_line() -> None:
    mask = np.zeros((360, 640), np.uint8)
    mask[180:, :6] = mask[180:, 320:326] = 1
    (line,) = find_lines(mask)
    assert float(line.column(300.0)) == pytest.approx(322.5, abs=0.2)
