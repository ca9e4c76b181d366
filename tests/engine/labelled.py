"""Labelled images whose pixels tell a fake network what to answer."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ModelCard, Thresholds
from trilitenet.data.sample import Sample
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import RawOutputs


class Images:
    """Images of 64x96 and 48x96: red holds the drivable area, green the lanes, blue of every pixel the number."""

    class_names: tuple[str, ...] = ("vehicle",)

    def __init__(self, count: int = 12, seed: int = 0) -> None:
        self._samples = [_sample(index, np.random.default_rng((seed, index))) for index in range(count)]

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> Sample:
        return self._samples[index]


def _sample(index: int, rng: np.random.Generator) -> Sample:
    size = (64, 96) if index % 3 else (48, 96)
    drivable = np.zeros(size, np.uint8)
    drivable[size[0] // 2 :, 10 + int(rng.integers(0, 20)) : 80] = 1
    lane = np.zeros(size, np.uint8)
    column = int(rng.integers(20, 70))
    lane[20:, column : column + 4] = 1
    low = rng.integers(0, 30, (3, 2))
    boxes = np.concatenate([low, low + rng.integers(8, 18, (3, 2))], axis=1).astype(np.float32)
    boxes += np.array([[0, 0, 0, 0], [30, 0, 30, 0], [60, 0, 60, 0]], np.float32)
    boxes[:, 2] = np.minimum(boxes[:, 2], 96)
    boxes[:, 3] = np.minimum(boxes[:, 3], size[0])
    image = np.stack([drivable * 255, lane * 255, np.full(size, index, np.uint8)], axis=2)
    return Sample(
        name=f"{index:03d}",
        image=image,
        boxes=boxes,
        class_id=np.zeros(len(boxes), np.int64),
        drivable=drivable,
        lane=lane,
        attributes={"timeofday": "night" if index % 4 == 0 else "daytime", "scene": "undefined"},
    )


class FakeBackend:
    """Answers what is in the pixels, with boxes from the labels.

    Args:
        images: Whose boxes to answer.
        drift: Pixels by which masks and boxes are moved to the right.
    """

    name = "fake"
    canvas: tuple[int, int] | None = None

    def __init__(self, images: Images, drift: int = 0) -> None:
        self.card = ModelCard("tiny", thresholds=Thresholds(confidence=0.3))
        self.batches: list[int] = []
        self._images, self._drift = images, drift

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        self.batches.append(len(batch))
        detection = np.zeros((len(batch), 5, 6), np.float32)
        for row, canvas in zip(detection, batch, strict=True):
            boxes = self._images[int(canvas[canvas.shape[0] // 2, 0, 2])].boxes
            assert boxes is not None
            top = (canvas.shape[0] - (48 if canvas[0, 0, 2] == 114 else canvas.shape[0])) // 2
            row[:3, :2] = (boxes[:, :2] + boxes[:, 2:]) / 2 + (self._drift, top)
            row[:3, 2:4] = boxes[:, 2:] - boxes[:, :2]
            row[:3, 4:] = 0.9
            row[3] = (80, 40, 10, 10, 0.1, 0.9)  # an unsure box where nothing is
        moved = np.roll(batch, self._drift, axis=2)
        return RawOutputs(detection, moved[..., 0].copy(), moved[..., 1].copy())

    def close(self) -> None:
        pass


@dataclasses.dataclass
class FakePredictor:
    backend: FakeBackend
    thresholds: Thresholds = dataclasses.field(default_factory=lambda: Thresholds(confidence=0.3))
    long_side: int = 96

    def preprocess(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Letterbox]:
        letterbox = Letterbox.fit((image.shape[0], image.shape[1]), long_side=self.long_side)
        return letterbox.image(image), letterbox


def fake_predictor(images: Images, drift: int = 0) -> FakePredictor:
    return FakePredictor(FakeBackend(images, drift))
