"""Weight files: convert published checkpoints, and see what a file says of itself."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

from trilitenet.config import ModelCard
from trilitenet.errors import OutputError
from trilitenet.models.weights import import_published, read_card, resolve_weights

__all__ = ["import_weights", "info"]


def import_weights(
    source: Path, destination: Path, /, *, variant: str | None = None, overwrite: bool = False
) -> ModelCard:
    """Convert a published checkpoint (.pth) to safetensors, strictly and without running code in it.

    Args:
        source: The published checkpoint, a pickled state dict.
        destination: The .safetensors file to write.
        variant: tiny, small or base; guessed from the shapes if left out.
        overwrite: Replace an existing destination.

    Returns:
        The card written into the file.
    """
    if destination.exists() and not overwrite:
        raise OutputError(f"{destination}: exists already; give another name or --overwrite")
    card = import_published(source, destination, variant)
    sys.stdout.write(f"{destination}: {card.variant}, {card.classes} class(es), from {source.name}\n")
    return card


def info(file: str, /, *, json_output: bool = False) -> ModelCard:
    """Print the card of a weight file: classes, input size, anchors, training data, metrics, licence.

    Args:
        file: A .safetensors file, or the name of shipped weights (tiny).
        json_output: Print JSON instead of text.

    Returns:
        The card.
    """
    card = read_card(file)
    if json_output:
        sys.stdout.write(json.dumps(dataclasses.asdict(card), indent=2, ensure_ascii=False) + "\n")
        return card
    thresholds = card.thresholds
    lines = [
        ("file", str(resolve_weights(file))),
        ("variant", card.variant),
        ("tasks", ", ".join(card.tasks)),
        ("blocks", ", ".join(card.blocks)),
        ("classes", ", ".join(card.class_names)),
        ("input", f"{card.input_size[1]}x{card.input_size[0]} RGB, mean {card.mean}, std {card.std}"),
        *(
            (f"anchors 1/{stride}", ", ".join(f"{width:g}x{height:g}" for width, height in level))
            for stride, level in zip((8, 16, 32), card.anchors, strict=True)
        ),
        (
            "thresholds",
            f"box {thresholds.confidence:g} (NMS {thresholds.iou:g}), drivable {thresholds.drivable:g}, "
            f"lane {thresholds.lane:g}",
        ),
        *(("trained on", line) for line in card.training_data),
        *((name, f"{value:g}") for name, value in card.metrics.items()),
        *((name, value) for name, value in card.provenance.items()),
        ("licence", card.licence),
        *(("note", line) for line in card.notes),
    ]
    width = max(len(name) for name, _ in lines)
    sys.stdout.write("".join(f"{name:<{width}}  {value}\n" for name, value in lines))
    return card
