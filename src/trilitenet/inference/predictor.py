"""From an image to a `Perception`, in named stages, so that a runtime replaces only the middle one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.config import ModelCard, Thresholds
from trilitenet.errors import ConfigError
from trilitenet.inference.backend import Backend, artefact_info
from trilitenet.processing.ego_mask import EgoMask
from trilitenet.processing.images import no_image, read_image
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.postprocess import to_perceptions
from trilitenet.structures import Perception, RawOutputs

__all__ = ["LONGEST_SIDE", "ImageLike", "Predictor"]

ImageLike: TypeAlias = str | Path | bytes | Image.Image | NDArray[Any]
"""A path, the bytes of an image file, a Pillow image, or a (height, width, 3) uint8 **RGB** array."""

LONGEST_SIDE: Final = 16384
"""Pixels of the longer side at most: beyond, one image takes more memory than machines have."""


class Predictor:
    """What a user holds: call it with an image, get a `Perception`.

        predictor = trilitenet.load("tiny")
        perception = predictor("photo.jpg")
        perceptions = predictor([image, another])

    The stages are `preprocess`, ``backend.run`` and `postprocess`; calling the predictor does all three.

    Args:
        backend: The network on a runtime.
        thresholds: What counts as an object, drivable or lane; the card's if left out.
        long_side: The longer side of an image is resized to so many pixels, where the backend's input is not fixed;
            by default that of the size the network was trained at (its card's ``input_size``).
        batch_size: At most so many images go through the network at once.
        ego_mask: Where images show the own car; nothing is found there.

    Raises:
        ConfigError: If a size is not positive, or ``long_side`` above 16384, or the backend's file fixes thresholds
            inside and others are asked for.
    """

    def __init__(
        self,
        backend: Backend,
        thresholds: Thresholds | None = None,
        *,
        long_side: int | None = None,
        batch_size: int = 8,
        ego_mask: EgoMask | None = None,
    ) -> None:
        long_side = max(backend.card.input_size) if long_side is None else long_side
        if min(long_side, batch_size) < 1:
            raise ConfigError(f"long_side and batch_size must be at least 1, got {long_side} and {batch_size}")
        if long_side > LONGEST_SIDE:
            raise ConfigError(f"long_side must be at most {LONGEST_SIDE}, got {long_side}")
        self.backend = backend
        self.thresholds = thresholds or backend.card.thresholds
        self._check_thresholds()
        self.long_side = long_side
        self.batch_size = batch_size
        self.ego_mask = ego_mask

    @property
    def card(self) -> ModelCard:
        """What the network is: classes, tasks, training data, figures, licence."""
        return self.backend.card

    @property
    def least_confidence(self) -> float:
        """Boxes below are gone before they could be asked for: an artefact with ``--nms`` drops them inside."""
        info = artefact_info(self.backend)
        return self.card.thresholds.confidence if info is not None and info.nms else 0.0

    def _check_thresholds(self) -> None:
        info = artefact_info(self.backend)
        wanted, inside = self.thresholds, self.card.thresholds
        if info is None:
            return
        if info.decides_masks and (wanted.drivable, wanted.lane) != (inside.drivable, inside.lane):
            raise ConfigError(
                "this artefact decides masks inside, by the thresholds of the model it was exported from; "
                "for others export it with --masks probability"
            )
        # Nor a lower IoU: boxes are gone that a box suppressed at it would have suppressed.
        if info.nms and (
            wanted.confidence < self.least_confidence or wanted.iou != inside.iou or wanted.max_boxes > inside.max_boxes
        ):
            raise ConfigError(
                f"this artefact keeps {inside.max_boxes} boxes inside, at confidence {inside.confidence:g} and IoU "
                f"{inside.iou:g}; for a lower confidence, another IoU or more boxes export it without --nms"
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the detection classes."""
        return self.backend.card.class_names

    @overload
    def __call__(self, image: ImageLike) -> Perception: ...  # type: ignore[overload-overlap]  # text is a path
    @overload
    def __call__(self, image: Iterable[ImageLike]) -> list[Perception]: ...

    def __call__(self, image: ImageLike | Iterable[ImageLike]) -> Perception | list[Perception]:
        """Perceive one image or several.

        Args:
            image: An `ImageLike` of any size, or several, as a list or one by one (their sizes may differ).

        Returns:
            A `Perception` for an image, a list of them for several. Each keeps its source image, for drawing.

        Raises:
            InputError: If a file is missing, broken or no image.
            ShapeError: If it is something else, such as an open file, or an array of the wrong shape or type.
        """
        if isinstance(image, (str, Path, bytes, Image.Image, np.ndarray)):
            return self.perceive([read_image(image)], [_name(image)])[0]
        # Files, buffers and tensors give their lines, bytes and rows one by one, which are no images.
        whole = isinstance(image, (bytearray, memoryview)) or hasattr(image, "read") or hasattr(image, "numpy")
        if whole or not isinstance(image, Iterable):
            raise no_image(image)
        images = list(image)
        return self.perceive([read_image(one) for one in images], [_name(one) for one in images])

    def perceive(
        self, images: Iterable[NDArray[np.uint8]], sources: Iterable[str | None] | None = None
    ) -> list[Perception]:
        """Perceive images that are in memory; neighbours of one canvas size share a batch.

        Args:
            images: (height, width, 3) uint8 RGB each.
            sources: Where each came from.

        Raises:
            ConfigError: If there are more or fewer sources than images.
            ShapeError: If an image is of another shape than the ego mask.
        """
        images = list(images)
        sources = [None] * len(images) if sources is None else list(sources)
        if len(sources) != len(images):
            raise ConfigError(f"each image has one source, got {len(images)} images and {len(sources)} sources")
        perceptions: list[Perception] = []
        letterboxes = [self.fit(image) for image in images]
        for part in _runs([letterbox.canvas for letterbox in letterboxes], self.batch_size):
            batch = np.empty((part.stop - part.start, *letterboxes[part.start].canvas, 3), np.uint8)
            for canvas, image, letterbox in zip(batch, images[part], letterboxes[part], strict=True):
                self._fill(canvas, image, letterbox)
            raw = self.backend.run(batch)
            perceptions += self.postprocess(raw, letterboxes[part], images[part], sources[part])
        return perceptions

    def fit(self, image: NDArray[np.uint8]) -> Letterbox:
        """Return how an image is fitted into the network's input."""
        height, width = image.shape[:2]
        return Letterbox.fit((height, width), long_side=self.long_side, canvas=self.backend.canvas)

    def preprocess(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Letterbox]:
        """Letterbox one image.

        Args:
            image: (height, width, 3) uint8 RGB.

        Returns:
            The (canvas height, canvas width, 3) uint8 canvas, and how the image lies in it.
        """
        letterbox = self.fit(image)
        canvas = np.empty((*letterbox.canvas, 3), np.uint8)
        self._fill(canvas, image, letterbox)
        return canvas, letterbox

    def _fill(self, canvas: NDArray[np.uint8], image: NDArray[np.uint8], letterbox: Letterbox) -> None:
        letterbox.image(image, out=canvas)
        if self.ego_mask is not None:
            self.ego_mask.hide(canvas, letterbox)

    def postprocess(
        self,
        raw: RawOutputs,
        letterboxes: Sequence[Letterbox],
        images: Sequence[NDArray[np.uint8]] | None = None,
        sources: Sequence[str | None] | None = None,
    ) -> list[Perception]:
        """Turn the raw outputs of a batch into perceptions; see `to_perceptions`. The own car has none of them."""
        perceptions = to_perceptions(raw, letterboxes, self.thresholds, self.class_names, images, sources)
        return perceptions if self.ego_mask is None else [self.ego_mask.drop(each) for each in perceptions]

    def __repr__(self) -> str:
        return f"Predictor({self.card.variant} on {self.backend.name})"

    def close(self) -> None:
        """Free what the runtime holds."""
        self.backend.close()

    def __enter__(self) -> Predictor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _name(image: ImageLike) -> str | None:
    return str(image) if isinstance(image, (str, Path)) else None


def _runs(values: Sequence[object], longest: int) -> list[slice]:
    """Cut a sequence into runs of equal neighbours, none longer than ``longest``."""
    runs: list[slice] = []
    start = 0
    for stop in range(1, len(values) + 1):
        if stop == len(values) or values[stop] != values[start] or stop - start == longest:
            runs.append(slice(start, stop))
            start = stop
    return runs
