"""The parity gate: an artefact must say what the float32 network says, on real frames, or it is not written."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.processing.boxes import box_iou, cxcywh_to_xyxy
from trilitenet.processing.postprocess import judge, mask_limit
from trilitenet.structures import RawOutputs

__all__ = ["TOLERANCES", "Parity", "Tolerance", "compare"]


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """What an artefact may differ by.

    Attributes:
        pixels: Least share of mask pixels that agree.
        overlap: Least intersection over union of a task's masks, over all frames together; lanes are so few pixels
            that most agree where there is none.
        boxes: Least share of the network's confident boxes that the artefact has too (IoU of at least 0.9, or
            sides less than half a pixel apart), and the reverse.
        confidence: Most that the confidence of such a pair may differ.
    """

    pixels: float
    overlap: float
    boxes: float
    confidence: float


TOLERANCES: Final[dict[str, Tolerance]] = {
    "fp32": Tolerance(pixels=0.9999, overlap=0.99, boxes=0.995, confidence=0.02),
    "fp16": Tolerance(pixels=0.998, overlap=0.90, boxes=0.95, confidence=0.1),
    "bf16": Tolerance(pixels=0.99, overlap=0.85, boxes=0.85, confidence=0.3),
    "int8": Tolerance(pixels=0.90, overlap=0.50, boxes=0.50, confidence=0.5),
}
"""A precision. INT8 is judged by its scores (``--max-drop``); here it is only kept from being nonsense."""


@dataclasses.dataclass(frozen=True)
class Parity:
    """How an artefact compares with the network.

    Attributes:
        frames: Frames compared.
        pixels: Share of mask pixels that agree, the worse of the two tasks; None without masks.
        overlap: Intersection over union of the masks, the worse of the two tasks; None without masks, or without
            foreground worth comparing.
        boxes: Share of confident boxes found in both; None without detection, or without any box.
        box_error: Mean distance of the sides of such pairs in pixels; None likewise.
        tolerance: What was asked for.
        detection: Whether there is detection.
    """

    frames: int
    pixels: float | None
    overlap: float | None
    boxes: float | None
    box_error: float | None
    tolerance: Tolerance
    detection: bool

    @property
    def failures(self) -> list[str]:
        """What is beyond the tolerance, in words; empty if nothing is."""
        found = []
        if self.pixels is not None and self.pixels < self.tolerance.pixels:
            found.append(f"{self.pixels:.5f} of mask pixels agree, at least {self.tolerance.pixels} must")
        if self.overlap is not None and self.overlap < self.tolerance.overlap:
            found.append(
                f"masks overlap with an IoU of {self.overlap:.4f}, it must be at least {self.tolerance.overlap}"
            )
        if self.boxes is not None and self.boxes < self.tolerance.boxes:
            found.append(f"{self.boxes:.4f} of boxes agree, at least {self.tolerance.boxes} must")
        if self.pixels is None and self.boxes is None:
            found.append("there was no box to compare; give --frames with vehicles, or leave --nms out")
        return found

    def summary(self) -> str:
        """Return one line."""
        parts = [f"{self.frames} frames"]
        if self.pixels is not None:
            parts.append(f"mask pixels equal {self.pixels:.6f}")
        if self.overlap is not None:
            parts.append(f"IoU of masks {self.overlap:.4f}")
        if self.boxes is not None:
            parts.append(f"boxes in both {self.boxes:.4f} (sides {self.box_error:.2f} px apart)")
        elif self.detection:
            parts.append("no box to compare (give --frames with vehicles)")
        return "parity: " + ", ".join(parts)


LIMIT: Final = 300
"""At most so many boxes of a frame are looked for, the most confident."""
FOREGROUND: Final = 300
"""Masks of fewer foreground pixels in all frames together are too small for their overlap to say anything."""


def compare(
    reference: Callable[[NDArray[np.uint8]], RawOutputs],
    artefact: Callable[[NDArray[np.uint8]], RawOutputs],
    canvases: Sequence[NDArray[np.uint8]],
    tolerance: Tolerance,
    *,
    masks: tuple[float, float] = (0.5, 0.5),
    confidence: float = 0.25,
) -> Parity:
    """Run both on the same canvases.

    Args:
        reference: The network, giving probabilities.
        artefact: The artefact, giving probabilities or decisions, with masks of the same size.
        canvases: (H, W, 3) uint8 RGB each.
        tolerance: What the artefact may differ by.
        masks: Thresholds of drivable and lane.
        confidence: Boxes above this are compared; if neither side has any, those of more than half of the highest
            confidence that there is.
    """
    equal: dict[str, list[float]] = {"drivable": [], "lane": []}
    areas = {name: np.zeros(2, np.int64) for name in equal}  # intersection, union
    rows: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    for canvas in canvases:
        expected, got = reference(canvas[None]), artefact(canvas[None])
        for name, threshold in zip(("drivable", "lane"), masks, strict=True):
            wanted, mask = getattr(expected, name), getattr(got, name)
            if wanted is not None:
                limit = mask_limit(threshold)
                one, other = wanted[0] > limit, mask[0] > limit
                equal[name].append(float(np.mean(one == other)))
                areas[name] += np.count_nonzero(one & other), np.count_nonzero(one | other)
        if expected.detection is not None and got.detection is not None:
            rows += [(expected.detection[0], got.detection[0]), (got.detection[0], expected.detection[0])]
    levels = _levels([one for one, _ in rows], confidence)
    pairs = [_match(one, other, levels, tolerance.confidence) for one, other in rows]
    matched, total = sum(count for count, _, _ in pairs), sum(count for _, count, _ in pairs)
    errors = [error for _, _, found in pairs for error in found]
    shares = [float(np.mean(values)) for values in equal.values() if values]
    overlaps = [float(intersection / union) for intersection, union in areas.values() if union >= FOREGROUND]
    return Parity(
        frames=len(canvases),
        pixels=min(shares) if shares else None,
        overlap=min(overlaps) if overlaps else None,
        boxes=matched / total if total else None,
        box_error=float(np.mean(errors)) if errors else (0.0 if total else None),
        tolerance=tolerance,
        detection=bool(rows),
    )


def _levels(frames: Sequence[NDArray[np.float32]], confidence: float) -> tuple[float, float]:
    """Return above which confidence a row must be found, and above which one it is.

    A row must be clearly above the threshold on one side, and need only be near it on the other: rows at the very
    threshold are decided by rounding.
    """
    best = max((float(np.nan_to_num(judge(rows)[1]).max(initial=0)) for rows in frames), default=0.0)
    if best > confidence + 0.05:
        return confidence + 0.05, confidence - 0.05
    return 0.55 * best, 0.45 * best


def _match(
    wanted: NDArray[np.float32], offered: NDArray[np.float32], levels: tuple[float, float], apart: float
) -> tuple[int, int, list[float]]:
    """Return how many of the confident rows of ``wanted`` have a like row in ``offered``, of how many, and how far off.

    Like is a row of the same most probable class and of a confidence no more than ``apart`` off, with much the same
    box.
    """
    class_id, scores = judge(wanted)
    best = np.argsort(-scores, kind="stable")[:LIMIT]
    best = best[scores[best] > levels[0]]
    other_class, other_scores = judge(offered)
    around = other_scores > levels[1]
    sure, near = wanted[best], offered[around]
    if not len(sure) or not len(near):
        return 0, len(sure), []
    a, b = cxcywh_to_xyxy(sure[:, :4]), cxcywh_to_xyxy(near[:, :4])
    same = class_id[best][:, None] == other_class[around][None]
    same &= np.abs(scores[best][:, None] - other_scores[around][None]) <= apart
    iou = np.where(same, box_iou(a, b), 0)
    nearest = iou.argmax(1)
    sides = np.where(same, np.abs(a[:, None] - b[None]).max(2), np.inf)
    good = (iou.max(1) >= 0.9) | (sides.min(1) < 0.5)  # specks have no meaningful IoU
    nearest = np.where(iou.max(1) >= 0.9, nearest, sides.argmin(1))
    return int(good.sum()), len(sure), np.abs(a - b[nearest]).mean(1)[good].tolist()
