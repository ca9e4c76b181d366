"""The same evaluation under other circumstances: corrupted images, other input sizes."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.engine.evaluate import EvaluatedPredictor, LabelledImages, evaluate
from trilitenet.engine.figures import HEADLINES
from trilitenet.engine.report import Report, Variation
from trilitenet.processing.corruptions import CORRUPTIONS, SEVERITIES, corrupt

__all__ = ["CORRUPTED", "SIZES", "corrupted_figures", "figures_by_size"]

CORRUPTED: Final = "Corrupted images"
"""Heading of the variations of `corrupted_figures`."""
SIZES: Final = "Input sizes"
"""Heading of the variations of `figures_by_size`."""


def corrupted_figures(
    predictor: EvaluatedPredictor,
    dataset: LabelledImages,
    clean: Report,
    *,
    corruptions: Sequence[str] = tuple(CORRUPTIONS),
    severities: Sequence[int] = SEVERITIES,
    seed: int = 0,
    on_pass: Callable[[str], None] | None = None,
    **settings: Any,
) -> tuple[Variation, ...]:
    """Evaluate on corrupted images.

    Args:
        predictor: As `evaluate` takes it.
        dataset: As `evaluate` takes it.
        clean: The report on the images as they are.
        corruptions: Keys of `trilitenet.processing.corruptions.CORRUPTIONS`.
        severities: 1 to 5.
        seed: Of what is random; every image has its own draw, the same for every model.
        on_pass: Called with the name of each pass before it starts.
        **settings: Further settings of `evaluate`.

    Returns:
        A row a corruption and severity, the mean a corruption, the mean of all, and the drop from the clean images:
        the mean corruption drop, a figure.

    Raises:
        ConfigError: If there is no such corruption or severity.
    """
    keys = [key for key in HEADLINES if key in clean.figures]
    rows: list[Variation] = []
    means: list[Variation] = []
    for name in corruptions:
        members = []
        for severity in severities:
            if on_pass is not None:
                on_pass(f"{name} {severity}")
            report = evaluate(
                predictor, dataset, change=_change(name, severity, seed), resamples=0, worst=0, **settings
            )
            figures = report.values()
            members.append(Variation(CORRUPTED, f"{name} {severity}", figures, detail=True))
        rows += members
        means.append(Variation(CORRUPTED, name, _mean(members, keys)))
    overall = _mean(means, keys)
    drop: dict[str, float] = {key: clean.figures[key].value - overall[key] for key in keys}
    note = f"Means over severities {', '.join(map(str, severities))}. The drop is the loss from the clean images."
    return (
        Variation(CORRUPTED, "clean", clean.values(), note),
        *means,
        Variation(CORRUPTED, "mean of corruptions", overall),
        Variation(CORRUPTED, "mean corruption drop", drop),
        *rows,
    )


def figures_by_size(
    predictors: Mapping[int, EvaluatedPredictor], dataset: LabelledImages, **settings: Any
) -> tuple[Variation, ...]:
    """Evaluate at several input sizes.

    Args:
        predictors: The longer side in pixels -> a predictor that resizes to it.
        dataset: As `evaluate` takes it.
        **settings: Further settings of `evaluate`.
    """
    rows = []
    for long_side, predictor in predictors.items():
        report = evaluate(predictor, dataset, resamples=0, worst=0, **settings)
        figures = report.values()
        rows.append(Variation(SIZES, str(long_side), figures, "By the longer side of the network's input, in pixels."))
    return tuple(rows)


def _change(name: str, severity: int, seed: int) -> Callable[[NDArray[np.uint8], str], NDArray[np.uint8]]:
    def change(image: NDArray[np.uint8], image_name: str) -> NDArray[np.uint8]:
        draw = zlib.crc32(f"{seed} {name} {severity} {image_name}".encode(errors="surrogateescape"))
        return corrupt(image, name, severity, np.random.default_rng(draw))

    return change


def _mean(rows: Sequence[Variation], keys: Sequence[str]) -> dict[str, float]:
    means = {}
    for key in keys:
        known = [row.figures[key] for row in rows if not np.isnan(row.figures[key])]
        means[key] = float(np.mean(known)) if known else float("nan")
    return means
