"""Distillation from a teacher's saved outputs: its masks and boxes as targets, moved along with the image.

The teacher may be any model, for all that is read of it is a folder in the form of `trilitenet.engine.predictions`. Its
outputs replace labels before a sample is transformed, so they pass through the very same affine map, flip, mosaic and
crop as the image does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.config import TASKS, Task
from trilitenet.data.sample import Sample
from trilitenet.data.transforms import Transform
from trilitenet.engine.predictions import SavedPredictions
from trilitenet.errors import ConfigError, DataError
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Perception

__all__ = ["Lessons", "TaughtTransform"]

_FIELDS: Final[dict[Task, tuple[str, ...]]] = {
    "detection": ("boxes", "class_id"),
    "drivable": ("drivable",),
    "lane": ("lane",),
}
"""What a sample holds of a task."""


class Lessons:
    """What a teacher said of the images, as labels.

    Args:
        folder: Saved outputs, as `trilitenet evaluate --save` writes them.
        class_names: Detection classes of the data set, in the teacher's order of categories.
        confidence: (low, high): a box scored at least ``high`` is an object, one between is an ignored region, one
            below ``low`` is left out.
        resized: Whether samples may be of another size than the images that the teacher saw, as prepared ones are.
        mask_above: A pixel of a mask that is resized with its image is foreground above this, of 255, as of a label.

    Raises:
        ConfigError: If samples are resized and no mask tells from what size.
        DataError: If there is nothing in the folder, or it has another form.
    """

    def __init__(
        self,
        folder: Path,
        class_names: Sequence[str],
        confidence: tuple[float, float] = (0.1, 0.5),
        *,
        resized: bool = False,
        mask_above: int = 1,
    ) -> None:
        self._saved = SavedPredictions(folder, class_names)
        self._mask_above = mask_above
        self._low, self._high = confidence
        if resized and self._saved.tasks == ("detection",):
            raise ConfigError(
                f"{folder}: boxes without masks do not tell the size of the images they are for, and the data is "
                "prepared at another; give the data set itself as --data"
            )

    @property
    def tasks(self) -> tuple[Task, ...]:
        """The tasks that the teacher has."""
        return self._saved.tasks

    def names(self) -> set[str]:
        """Return the images that the teacher said something of."""
        return set(self._saved.names) | self._masked()

    def unmasked(self) -> set[str]:
        """Return the images that have boxes and no mask, of a teacher that has masks: nothing tells their size."""
        return set(self._saved.names) - self._masked() if {"drivable", "lane"} & set(self.tasks) else set()

    def _masked(self) -> set[str]:
        return {path.stem for task in ("drivable", "lane") for path in (self._saved.folder / task).glob("*.png")}

    def of(self, sample: Sample, wanted: Sequence[Task] = TASKS) -> Sample | None:
        """Return the sample with the teacher's outputs as its only labels; None if the teacher never saw it.

        Args:
            sample: The sample.
            wanted: Tasks whose outputs are read; of others there are none.

        Raises:
            DataError: If a mask is missing beside another, broken, or of another shape than the image.
        """
        masks = [task for task in self.tasks if task != "detection"]
        seen = [path for task in masks if (path := self._saved.folder / task / f"{sample.name}.png").is_file()]
        if not seen and (masks or sample.name not in self._saved.names):
            return None
        size = _png_size(seen[0]) if seen else sample.size
        # A prepared image's sides are rounded to whole pixels.
        if abs(size[0] / size[1] * sample.size[1] / sample.size[0] - 1) > 0.02:
            raise DataError(
                f"{seen[0]}: {size[1]}x{size[0]}, of another shape than the image of {sample.size[1]}x{sample.size[0]}"
            )
        said = self._saved.get(sample.name, size, wanted)
        boxes, class_id, doubtful = self._boxes(said, (sample.size[0] / size[0], sample.size[1] / size[1]))
        return dataclasses.replace(
            sample,
            boxes=boxes,
            class_id=class_id,
            ignored=doubtful,
            drivable=self._resized(said.drivable, sample.size),
            lane=self._resized(said.lane, sample.size),
        )

    def _resized(self, mask: NDArray[np.bool_] | None, size: tuple[int, int]) -> NDArray[np.uint8] | None:
        """Return a mask of {0, 1} at a size, made as labels of that size are."""
        if mask is None or mask.shape == size:
            return None if mask is None else mask.astype(np.uint8)
        return Letterbox((mask.shape[0], mask.shape[1]), size, size, 0, 0).mask(mask, self._mask_above)

    def _boxes(
        self, said: Perception, scale: tuple[float, float]
    ) -> tuple[NDArray[np.float32] | None, NDArray[np.int64] | None, NDArray[np.float32]]:
        """Return the boxes taken for objects, their classes, and the boxes to ignore."""
        if said.boxes is None:
            return None, None, np.zeros((0, 4), np.float32)
        xyxy = (said.boxes.xyxy * np.array([scale[1], scale[0]] * 2)).astype(np.float32)
        sure = said.boxes.confidence >= self._high
        doubtful = ~sure & (said.boxes.confidence >= self._low)
        return xyxy[sure], said.boxes.class_id[sure], xyxy[doubtful]


@dataclasses.dataclass(frozen=True)
class TaughtTransform:
    """A transform of samples whose labels are, in part, the teacher's.

    A task without a label gets the teacher's. A task with one keeps it or gets the teacher's, by a draw a sample and
    task: with weight w, the teacher's share is w / (1 + w), so that the loss is on average that by the label plus w
    times that by the teacher, over 1 + w.

    Attributes:
        inner: The transform proper.
        lessons: The teacher's outputs.
        weights: w of detection, drivable and lane; 0 leaves a task to its labels.
    """

    inner: Transform
    lessons: Lessons
    weights: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __call__(
        self, sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample] | None = None
    ) -> Sample:
        """Return the transformed sample; its labels are chosen first."""
        # An own stream, so that images are augmented as they are without a teacher.
        choice = rng.spawn(1)[0]
        other: Callable[[np.random.Generator], Sample] | None = None
        if draw is not None:

            def other(rng: np.random.Generator) -> Sample:
                return self._taught(draw(rng), choice)

        return self.inner(self._taught(sample, choice), rng, other)

    def _taught(self, sample: Sample, rng: np.random.Generator) -> Sample:
        draws = rng.random(len(TASKS))
        wanted: list[Task] = []
        for task, weight, drawn in zip(TASKS, self.weights, draws, strict=True):
            labelled = getattr(sample, _FIELDS[task][0]) is not None
            if task in self.lessons.tasks and weight and not (labelled and drawn >= weight / (1 + weight)):
                wanted.append(task)
        lesson = self.lessons.of(sample, wanted) if wanted else None
        if lesson is None:
            return sample
        taken: dict[str, Any] = {}
        for task in wanted:
            taken |= {name: getattr(lesson, name) for name in _FIELDS[task]}
            if task == "detection":
                taken["ignored"] = np.concatenate([sample.ignored, lesson.ignored])
        return dataclasses.replace(sample, **taken)


def _png_size(path: Path) -> tuple[int, int]:
    """Return (height, width) from a PNG's header.

    Raises:
        DataError: If it is none.
    """
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return image.height, image.width
    except (OSError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: not a PNG image") from error
