"""Published figures to stand beside one's own, as printed, each with where it stands and how it was measured.

From the paper's tables of comparison, of configurations and of precision levels.
"""

from __future__ import annotations

import dataclasses
from typing import Final

__all__ = ["PAPER", "PAPER_OWN", "PEERS", "PUBLISHED_ROWS", "PublishedRow"]

PAPER: Final = (
    'Che and Lam, "TriLiteNet: Lightweight Model for Multi-Task Visual Perception"; '
    "BDD100K validation split, 10,000 images"
)
"""Where all rows are from, and what they were measured on."""
PAPER_OWN: Final = "paper: 640x384, averages over batches, Acc balanced, recall at confidence 0.001"
"""How the TriLiteNet rows were measured."""
PEERS: Final = "as the paper prints it; each work's own evaluation, not repeated here; Acc balanced, says the paper"
"""What is known of how the other rows were measured."""


@dataclasses.dataclass(frozen=True)
class PublishedRow:
    """One row of a published table, per cent as printed; None where the table has a dash or a cross.

    Attributes:
        name: Of the model.
        source: Table of the paper.
        protocol: How it was measured, as far as known.
        recall: Vehicle detection.
        map50: Vehicle detection.
        miou: Drivable area.
        acc: Lane marking.
        iou: Lane marking.
        parameters: In millions.
        multiply_adds: In thousand millions ("FLOPs" in the paper).
    """

    name: str
    source: str
    protocol: str
    recall: float | None
    map50: float | None
    miou: float | None
    acc: float | None
    iou: float | None
    parameters: float | None = None
    multiply_adds: float | None = None

    @property
    def figures(self) -> dict[str, float | None]:
        """Figure key of the 'paper' protocol -> value in [0, 1]."""
        values = {
            "paper/detection/recall": self.recall,
            "paper/detection/map50": self.map50,
            "paper/drivable/miou": self.miou,
            "paper/lane/acc": self.acc,
            "paper/lane/iou": self.iou,
        }
        return {key: None if value is None else value / 100 for key, value in values.items()}

    @property
    def printed(self) -> list[str]:
        """The figures as the paper prints them, a dash where it has none."""
        return _printed(self.recall, self.map50, self.miou, self.acc, self.iou)

    @property
    def printed_cost(self) -> list[str]:
        """Parameters and multiply-adds likewise."""
        return _printed(self.parameters, self.multiply_adds)


def _printed(*values: float | None) -> list[str]:
    return ["-" if value is None else f"{value:.2f}".removesuffix("0") for value in values]


_CONFIGURATIONS = "table of configurations"
_COMPARISON = "table of comparison"
_PRECISION = "table of precision levels (captioned base, holds small's values)"

PUBLISHED_ROWS: Final[tuple[PublishedRow, ...]] = (
    PublishedRow("TriLiteNet tiny", _CONFIGURATIONS, PAPER_OWN, 76.5, 49.6, 88.5, 75.6, 24.2, 0.15, 0.55),
    PublishedRow("TriLiteNet small", _CONFIGURATIONS, PAPER_OWN, 81.6, 63.2, 91.0, 79.5, 27.6, 0.59, 1.99),
    PublishedRow("TriLiteNet base", _CONFIGURATIONS, PAPER_OWN, 85.6, 72.3, 92.4, 82.3, 29.8, 2.35, 7.72),
    PublishedRow("TriLiteNet small FP16", _PRECISION, PAPER_OWN, 81.6, 63.2, 91.0, 79.5, 27.6),
    PublishedRow("TriLiteNet small INT8", _PRECISION, PAPER_OWN, 81.2, 61.7, 90.5, 78.2, 27.1),
    PublishedRow("YOLOP", _COMPARISON, PEERS, 89.2, 76.5, 91.5, 84.8, 26.2, 7.9, 9.38),
    PublishedRow("HybridNets", _COMPARISON, PEERS, 92.8, 77.3, 90.5, None, 31.6, 12.83, 25.69),
    PublishedRow("YOLOPv2", _COMPARISON, PEERS, 91.1, 83.4, 93.2, None, 27.25, 38.9),
    PublishedRow("A-YOLOM (n)", _COMPARISON, PEERS, 85.3, 78.0, 90.5, 81.3, 28.2, 4.43, 6.66),
    PublishedRow("A-YOLOM (s)", _COMPARISON, PEERS, 86.9, 81.1, 91.0, 84.9, 28.8, 13.61, 19.22),
    PublishedRow("YOLOPX", _COMPARISON, PEERS, 93.7, 83.3, 93.2, None, 27.2, 32.9, 44.86),
    PublishedRow("YOLOPv3", _COMPARISON, PEERS, 96.9, 84.3, 93.2, None, 28.0, 30.2, 35.38),
    PublishedRow("YOLOv5s", _COMPARISON, PEERS, 86.8, 77.2, None, None, None),
    PublishedRow("Faster R-CNN", _COMPARISON, PEERS, 77.2, 55.6, None, None, None),
    PublishedRow("MultiNet", _COMPARISON, PEERS, 81.3, 60.2, None, None, None),
    PublishedRow("R-CNNP (DET)", _COMPARISON, PEERS, 79.0, 67.3, None, None, None),
    PublishedRow("YOLOP (DET)", _COMPARISON, PEERS, 88.2, 76.9, None, None, None),
    PublishedRow("YOLOv8n (DET)", _COMPARISON, PEERS, 82.2, 75.1, None, None, None, 3.16),
    PublishedRow("GCNet", _COMPARISON, PEERS, None, None, 82.07, None, None),
    PublishedRow("DNLNet", _COMPARISON, PEERS, None, None, 84.35, None, None),
    PublishedRow("PSPNet", _COMPARISON, PEERS, None, None, 89.6, None, None),
    PublishedRow("YOLOP (DA)", _COMPARISON, PEERS, None, None, 92.0, None, None),
    PublishedRow("YOLOv8n (DA)", _COMPARISON, PEERS, None, None, 78.1, None, None, 3.26),
    PublishedRow("ENet", _COMPARISON, PEERS, None, None, None, None, 14.64),
    PublishedRow("ENet-SAD", _COMPARISON, PEERS, None, None, None, None, 16.02),
    PublishedRow("SCNN", _COMPARISON, PEERS, None, None, None, None, 15.84),
    PublishedRow("YOLOP (LL)", _COMPARISON, PEERS, None, None, None, None, 26.5),
    PublishedRow("YOLOv8n (LL)", _COMPARISON, PEERS, None, None, None, 80.5, 22.9, 3.26),
)
"""In the order of the tables."""
