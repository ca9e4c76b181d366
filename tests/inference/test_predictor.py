from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.fakes import ColourBackend, coloured_scene
from trilitenet.config import ArtefactInfo, Thresholds
from trilitenet.errors import ConfigError, InputError, ShapeError
from trilitenet.inference.backend import Backend
from trilitenet.inference.predictor import Predictor
from trilitenet.processing.ego_mask import EgoMask


def check(perception: object, height: int, width: int) -> None:
    from trilitenet import Perception

    assert isinstance(perception, Perception)
    assert perception.size == (height, width)
    assert perception.boxes is not None
    tolerance = max(height, width) / 640 + 1
    np.testing.assert_allclose(
        perception.boxes.xyxy, [[width / 4, height / 4, width / 2, height / 2]], atol=2 * tolerance
    )
    assert perception.drivable is not None
    assert perception.drivable.shape == (height, width)
    assert perception.drivable[-1, 5]
    assert not perception.drivable[: height // 2 - 4].any()
    assert perception.lane is not None
    assert perception.lane[-1, width // 2 + 2]


def test_the_fake_is_a_backend() -> None:
    assert isinstance(ColourBackend(), Backend)


@pytest.mark.parametrize("size", [(360, 640), (720, 1280), (480, 360), (193, 640), (1000, 333)])
def test_any_size(size: tuple[int, int]) -> None:
    backend = ColourBackend()
    check(Predictor(backend)(coloured_scene(*size)), *size)
    assert backend.batches[0][1] % 32 == backend.batches[0][2] % 32 == 0


def test_a_fixed_canvas_is_honoured() -> None:
    backend = ColourBackend(canvas=(384, 640))
    check(Predictor(backend)(coloured_scene(480, 480)), 480, 480)
    assert backend.batches == [(1, 384, 640, 3)]


def test_kinds_of_input(tmp_path: Path) -> None:
    scene = coloured_scene()
    path = tmp_path / "scene.png"
    Image.fromarray(scene).save(path)
    predictor = Predictor(ColourBackend())
    for image in (path, str(path), path.read_bytes(), Image.fromarray(scene), scene):
        check(predictor(image), 360, 640)
    assert predictor(path).source == str(path)
    assert predictor(scene).source is None
    np.testing.assert_array_equal(predictor(path).image, scene)


def test_a_list_is_batched_by_canvas_size_and_stays_in_order() -> None:
    backend = ColourBackend()
    sizes = [(360, 640)] * 5 + [(480, 360)] * 2 + [(360, 640)]
    perceptions = Predictor(backend, batch_size=4)([coloured_scene(*size) for size in sizes])
    assert [perception.size for perception in perceptions] == sizes
    assert [shape[0] for shape in backend.batches] == [4, 1, 2, 1]
    for perception, size in zip(perceptions, sizes, strict=True):
        check(perception, *size)
    assert Predictor(backend)([]) == []


def test_images_may_come_from_a_generator() -> None:
    predictor = Predictor(ColourBackend(), batch_size=2)
    assert len(predictor(coloured_scene() for _ in range(3))) == 3


@pytest.mark.parametrize("image", [None, io.BytesIO(b"x"), bytearray(b"x"), memoryview(b"x")])
def test_what_is_no_image_is_named_as_a_whole(image: Any) -> None:
    with pytest.raises(ShapeError, match=f"PIL image or an array, got {type(image).__name__}"):
        Predictor(ColourBackend())(image)


def test_a_file_and_a_tensor_are_refused_with_the_cure() -> None:
    predictor, tensor = Predictor(ColourBackend()), torch.zeros(3, 32, 32)
    with pytest.raises(ShapeError, match=r"got BytesIO; pass its \.read\(\)$"):
        predictor(io.BytesIO(b"x"))
    images: tuple[Any, ...] = (tensor, [tensor], torch.zeros(()))
    for image in images:
        with pytest.raises(ShapeError, match=r"got Tensor; pass its \.numpy\(\) as \(height, width, 3\) uint8 RGB$"):
            predictor(image)


@pytest.mark.parametrize("url", ["https://host/x.jpg", Path("https://host/x.jpg"), "file:///tmp/x.jpg"])
def test_a_url_is_told_from_a_path(url: str | Path) -> None:
    for image in (url, [url]):
        with pytest.raises(InputError, match=r"x\.jpg: is a URL; download it first, or use `trilitenet predict`$"):
            Predictor(ColourBackend())(image)


def test_it_is_shown_by_its_network_and_runtime() -> None:
    backend = ColourBackend()
    assert repr(Predictor(backend)) == f"Predictor({backend.card.variant} on {backend.name})"


def test_images_in_memory_may_come_one_by_one_each_with_its_source() -> None:
    predictor, scene = Predictor(ColourBackend(), batch_size=2), coloured_scene()
    found = predictor.perceive((scene for _ in range(3)), iter("abc"))
    assert [perception.source for perception in found] == ["a", "b", "c"]
    with pytest.raises(ConfigError, match="got 2 images and 1 sources"):
        predictor.perceive([scene, scene], ["a"])


def test_stages_make_the_whole() -> None:
    predictor = Predictor(ColourBackend())
    scene = coloured_scene(720, 1280)
    canvas, letterbox = predictor.preprocess(scene)
    assert canvas.shape == (384, 640, 3)
    (perception,) = predictor.postprocess(predictor.backend.run(canvas[None]), [letterbox], [scene])
    assert perception.to_dict() == predictor(scene).to_dict()


def test_thresholds_come_from_the_card_or_the_caller() -> None:
    scene = coloured_scene()
    assert len(Predictor(ColourBackend())(scene).boxes or ()) == 1
    assert len(Predictor(ColourBackend(), Thresholds(confidence=0.95))(scene).boxes or ()) == 0
    backend = ColourBackend()
    backend.card = dataclasses.replace(backend.card, thresholds=Thresholds(confidence=0.95))
    assert len(Predictor(backend)(scene).boxes or ()) == 0


def test_errors() -> None:
    with pytest.raises(InputError, match="no such file"):
        Predictor(ColourBackend())("absent.jpg")
    with pytest.raises(ConfigError, match="at least 1"):
        Predictor(ColourBackend(), batch_size=0)
    with pytest.raises(ConfigError, match="long_side must be at most 16384, got 100000"):
        Predictor(ColourBackend(), long_side=100_000)
    assert Predictor(ColourBackend(), long_side=16384).long_side == 16384


def test_it_closes_its_backend() -> None:
    backend = ColourBackend()
    with Predictor(backend):
        pass
    assert backend.closed == 1


def test_thresholds_that_a_file_fixes_inside_are_refused() -> None:
    backend = ColourBackend()
    own = backend.card.thresholds
    backend.info = ArtefactInfo("onnx", masks="probability", nms=True)  # type: ignore[attr-defined]
    assert Predictor(backend).least_confidence == own.confidence
    Predictor(backend, dataclasses.replace(own, confidence=0.99, max_boxes=own.max_boxes - 1, drivable=0.9))
    changes: tuple[dict[str, Any], ...] = (
        {"confidence": own.confidence / 2},
        {"iou": 0.99},
        {"iou": own.iou / 2},  # a box that is gone inside may be one that this would have kept
        {"max_boxes": own.max_boxes + 1},
    )
    for change in changes:
        with pytest.raises(ConfigError, match="another IoU or more boxes export it without --nms"):
            Predictor(backend, dataclasses.replace(own, **change))
    backend.info = ArtefactInfo("onnx")  # type: ignore[attr-defined]
    assert Predictor(backend, dataclasses.replace(own, confidence=0.01)).least_confidence == 0
    for decided in (dataclasses.replace(own, lane=0.9), dataclasses.replace(own, drivable=0.9)):
        with pytest.raises(ConfigError, match="--masks probability"):
            Predictor(backend, decided)


def test_images_are_resized_as_in_training_unless_told_otherwise() -> None:
    backend = ColourBackend()
    backend.card = dataclasses.replace(backend.card, input_size=(192, 320))
    Predictor(backend)(coloured_scene())
    Predictor(backend, long_side=640)(coloured_scene())
    assert backend.batches == [(1, 192, 320, 3), (1, 384, 640, 3)]


def test_nothing_is_found_on_the_own_car() -> None:
    own = np.zeros((360, 640), np.bool_)
    own[270:] = True
    predictor = Predictor(ColourBackend(), ego_mask=EgoMask(own))
    scenes = [coloured_scene(), coloured_scene(720, 1280)]
    scenes[0][300:, :200] = (220, 20, 20)  # the red bonnet would make another box of the vehicle's
    for perception in predictor(scenes):
        height, width = perception.size
        assert perception.boxes is not None
        np.testing.assert_allclose(
            perception.boxes.xyxy, [[width / 4, height / 4, width / 2, height / 2]], atol=3 * width / 640
        )
        for mask in (perception.drivable, perception.lane):
            assert mask is not None
            assert mask[height // 2 + 8 : 3 * height // 4].any()
            assert not mask[3 * height // 4 :].any()
    np.testing.assert_array_equal(predictor(scenes[0]).image, scenes[0])


def test_the_own_car_is_left_out_stage_by_stage_as_in_one_call() -> None:
    own = np.zeros((360, 640), np.bool_)
    own[270:] = True
    predictor = Predictor(ColourBackend(), ego_mask=EgoMask(own))
    canvas, letterbox = predictor.preprocess(coloured_scene())
    (perception,) = predictor.postprocess(predictor.backend.run(canvas[None]), [letterbox])
    assert perception.to_dict() == predictor(coloured_scene()).to_dict()
    assert not (canvas == Predictor(predictor.backend).preprocess(coloured_scene())[0]).all()
    with pytest.raises(ShapeError, match="another shape"):
        predictor(coloured_scene(480, 640))
