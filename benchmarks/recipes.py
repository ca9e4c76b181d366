"""The default recipe against the paper's constants and the published switches: same data, budget, seeds and device.

    python benchmarks/recipes.py --data DATA --output runs/recipes --epochs 20 --seeds 0 1 2

Packs the training images once for each way at its own `mask_above`, trains each with each seed (runs that are done are
kept, stopped ones go on), scores each run's weights on the validation split at full size by the evaluation command's
own code ('fair' protocol), and prints mean and range of the five figures of the paper.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trilitenet.commands.train import train, validation_figures
from trilitenet.data.prepared import is_prepared, prepare
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.recipe import TrainConfig, read_recipe
from trilitenet.engine.train import CHECKPOINT_NAME
from trilitenet.models.weights import load_network

RECIPES = Path(__file__).resolve().parent.parent / "recipes"
WAYS = {
    "default": RECIPES / "default_tiny.yaml",
    "paper": RECIPES / "bdd100k_tiny.yaml",
    "published": RECIPES / "paper" / "published.yaml",
}
FIGURES = ("detection/recall", "detection/ap50", "drivable/miou", "lane/accuracy", "lane/iou")


def packed(data: str, config: TrainConfig, folder: Path) -> str:
    """Return the training images at the input size, masks reduced by the recipe's own threshold."""
    if not is_prepared(folder):
        prepare(
            data,
            folder,
            canvas=config.input_size,
            splits=("train",),
            mask_above=config.augmentation.mask_above,
            workers=1,
        )
    return str(folder)


def run(data: str, way: str, folder: Path, settings: Mapping[str, Any]) -> dict[str, float]:
    """Train by one recipe unless that is done; return the figures on the validation split."""
    figures, weights = folder / "figures.json", folder / "final.safetensors"
    if figures.is_file():
        done: dict[str, float] = json.loads(figures.read_text())
        return done
    if not weights.is_file():
        config = read_recipe(WAYS[way], {"input_size": list(settings["input_size"])})
        settings = {**settings, "data": packed(data, config, folder.parent / f"packed-{way}"), "output": str(folder)}
        if not train(WAYS[way], resume=(folder / CHECKPOINT_NAME).is_file(), **settings).finished:
            raise SystemExit(130)
    network = load_network(weights)
    scores = validation_figures(network, DrivingDataset(data, "val", class_names=network.card.class_names), "cpu")
    figures.write_text(json.dumps(scores, indent=1))
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True)
    parser.add_argument("--output", type=Path, default=Path("runs/recipes"))
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--warmup-epochs", type=float, default=None, help="min(3, a tenth of the epochs) if left out")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--input-size", type=int, nargs=2, default=(384, 640))
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--ema-ramp", type=float, default=200)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    warmup = min(3.0, options.epochs / 10) if options.warmup_epochs is None else options.warmup_epochs
    results: dict[str, list[dict[str, float]]] = {way: [] for way in options.ways}
    for seed in options.seeds:
        for way in options.ways:
            settings: dict[str, Any] = {
                "epochs": options.epochs,
                "warmup_steps": 0,
                "warmup_epochs": warmup,
                "seed": seed,
                "input_size": tuple(options.input_size),
                "batch_size": options.batch_size,
                "workers": options.workers,
                "val_split": "",
                "ema_ramp": options.ema_ramp,
            }
            results[way].append(run(options.data, way, options.output / f"{way}-{seed}", settings))
            print(f"{way} {seed}: {results[way][-1]}", flush=True)
    print("| Figure | " + " | ".join(results) + " |\n|---|" + "---|" * len(results))
    for name in FIGURES:
        cells = []
        for runs in results.values():
            values = [scores[name] for scores in runs]
            cells.append(f"{statistics.mean(values):.4f} ({min(values):.4f} to {max(values):.4f})")
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
