"""What each figure of a report means: a title and the formula, printed beside every value."""

from __future__ import annotations

import dataclasses
from typing import Final

__all__ = ["CONDITION_FIGURES", "FIGURES", "HEADLINES", "FigureMeaning", "meaning"]


@dataclasses.dataclass(frozen=True)
class FigureMeaning:
    """A figure in words.

    Attributes:
        title: A few words.
        formula: How it is computed.
    """

    title: str
    formula: str


_BEST = "confidence of best F1 over all images, kept in draws, IoU 0.5"
_TOLERANT = "share of {} pixels within {} px of a {} one"

FIGURES: Final[dict[str, FigureMeaning]] = {
    # fair
    "fair/detection/ap50": FigureMeaning("AP50", "101-point COCO average precision at IoU 0.5, mean over classes"),
    "fair/detection/ap": FigureMeaning("AP50:95", "mean of COCO AP over IoU 0.50, 0.55 ... 0.95"),
    "fair/detection/ap_small": FigureMeaning("AP50:95, small", "of boxes up to 32 x 32 px"),
    "fair/detection/ap_medium": FigureMeaning("AP50:95, medium", "of boxes from 32 x 32 to 96 x 96 px"),
    "fair/detection/ap_large": FigureMeaning("AP50:95, large", "of boxes from 96 x 96 px"),
    "fair/detection/precision": FigureMeaning("precision", "right / (right + wrong) boxes, stated confidence, IoU 0.5"),
    "fair/detection/recall": FigureMeaning("recall", "right boxes / objects, stated confidence, IoU 0.5"),
    "fair/detection/f1": FigureMeaning("F1", "2PR / (P + R), stated confidence, IoU 0.5"),
    "fair/detection/precision_best": FigureMeaning("precision, best F1", f"right / (right + wrong) boxes, {_BEST}"),
    "fair/detection/recall_best": FigureMeaning("recall, best F1", f"right boxes / objects, {_BEST}"),
    "fair/detection/f1_best": FigureMeaning("best F1", f"2PR / (P + R), {_BEST}"),
    "fair/detection/precision_025": FigureMeaning(
        "precision at 0.25", "right / (right + wrong) boxes, confidence 0.25, IoU 0.5"
    ),
    "fair/detection/recall_025": FigureMeaning("recall at 0.25", "right boxes / objects, confidence 0.25, IoU 0.5"),
    "fair/detection/f1_025": FigureMeaning("F1 at 0.25", "2PR / (P + R), confidence 0.25, IoU 0.5"),
    "fair/drivable/miou": FigureMeaning("mIoU", "(IoU foreground + IoU background) / 2, one confusion matrix"),
    "fair/drivable/iou": FigureMeaning("IoU", "TP / (TP + FP + FN), one confusion matrix"),
    "fair/drivable/precision": FigureMeaning("precision", "TP / (TP + FP) pixels"),
    "fair/drivable/recall": FigureMeaning("recall", "TP / (TP + FN) pixels"),
    "fair/drivable/f1": FigureMeaning("F1", "2TP / (2TP + FP + FN) pixels"),
    "fair/drivable/balanced_accuracy": FigureMeaning("balanced accuracy", "(TP/(TP+FN) + TN/(TN+FP)) / 2"),
    "fair/lane/iou": FigureMeaning("IoU as labelled", "TP / (TP + FP + FN), truth as wide as labelled"),
    "fair/lane/iou_width_2": FigureMeaning("IoU, truth 2 px", "TP / (TP + FP + FN), truth thinned and drawn 2 px wide"),
    "fair/lane/iou_width_8": FigureMeaning("IoU, truth 8 px", "TP / (TP + FP + FN), truth thinned and drawn 8 px wide"),
    "fair/lane/precision": FigureMeaning("precision", "TP / (TP + FP) pixels, as labelled"),
    "fair/lane/recall": FigureMeaning("recall", "TP / (TP + FN) pixels, as labelled"),
    "fair/lane/f1": FigureMeaning("F1", "2TP / (2TP + FP + FN) pixels, as labelled"),
    "fair/lane/balanced_accuracy": FigureMeaning("balanced accuracy", "(TP/(TP+FN) + TN/(TN+FP)) / 2, as labelled"),
    "fair/lane/precision_2px": FigureMeaning("precision, 2 px", _TOLERANT.format("predicted", 2, "true")),
    "fair/lane/recall_2px": FigureMeaning("recall, 2 px", _TOLERANT.format("true", 2, "predicted")),
    "fair/lane/f1_2px": FigureMeaning("F1, 2 px", "2PR / (P + R) of the two with 2 px tolerance"),
    "fair/lane/boundary_f_1px": FigureMeaning("boundary F, 1 px", "2PR / (P + R) over boundary pixels, 1 px tolerance"),
    "fair/lane/boundary_f_2px": FigureMeaning("boundary F, 2 px", "2PR / (P + R) over boundary pixels, 2 px tolerance"),
    "fair/lane/boundary_f_5px": FigureMeaning("boundary F, 5 px", "2PR / (P + R) over boundary pixels, 5 px tolerance"),
    # paper
    "paper/detection/recall": FigureMeaning("Recall", "right boxes / objects at confidence 0.001, IoU above 0.5"),
    "paper/detection/precision": FigureMeaning("Precision", "right boxes / boxes at confidence 0.001, IoU above 0.5"),
    "paper/detection/map50": FigureMeaning("mAP50", "101-point trapezoid over the precision envelope, IoU above 0.5"),
    "paper/detection/map": FigureMeaning("mAP50:95", "the same, mean over IoU 0.50, 0.55 ... 0.95"),
}
_PUBLISHED_MASK: Final = {
    "miou": ("mIoU", "(IoU foreground + IoU background) / 2"),
    "acc": ("Acc", "balanced accuracy (TP/(TP+FN) + TN/(TN+FP)) / 2"),
    "iou": ("IoU", "TP / (TP + FP + FN)"),
    "recall": ("recall", "TP / (TP + FN)"),
}
for _task in ("drivable", "lane"):
    for _name, (_title, _formula) in _PUBLISHED_MASK.items():
        FIGURES[f"paper/{_task}/{_name}"] = FigureMeaning(_title, f"{_formula}, mean over batches")
        FIGURES[f"paper/{_task}/dataset_{_name}"] = FigureMeaning(
            f"{_title}, data set", f"{_formula}, one confusion matrix"
        )

CONDITION_FIGURES: Final = {
    "fair": (
        "fair/detection/ap50",
        "fair/detection/f1",
        "fair/drivable/miou",
        "fair/lane/iou",
        "fair/lane/f1_2px",
    ),
    "paper": (
        "paper/detection/recall",
        "paper/detection/map50",
        "paper/drivable/miou",
        "paper/lane/acc",
        "paper/lane/iou",
    ),
}
"""Columns of the tables by condition; those of 'paper' are the paper's own."""
HEADLINES: Final = (*CONDITION_FIGURES["fair"], *CONDITION_FIGURES["paper"])
"""The few that stand first."""


def meaning(key: str) -> FigureMeaning:
    """Return what a figure means; its own name where it is not listed."""
    return FIGURES.get(key, FigureMeaning(key.rpartition("/")[2].replace("_", " "), "see docs/evaluation.md"))
