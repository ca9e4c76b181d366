"""The default switches against the published ones: same data, budget, seeds and device.

    python benchmarks/recipes.py --data DATA --output runs/recipes --epochs 20 --seeds 0 1 2

Trains both with each seed (runs that are done are kept, stopped ones go on) and prints mean and range of the five
figures of the paper under the 'fair' protocol.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

from trilitenet.commands.train import train
from trilitenet.engine.train import CHECKPOINT_NAME
from trilitenet.models.weights import read_card

RECIPES = Path(__file__).resolve().parent.parent / "recipes"
WAYS = {"default": RECIPES / "bdd100k_tiny.yaml", "published": RECIPES / "paper" / "published.yaml"}
FIGURES = ("detection/recall", "detection/ap50", "drivable/miou", "lane/accuracy", "lane/iou")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True)
    parser.add_argument("--output", type=Path, default=Path("runs/recipes"))
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--input-size", type=int, nargs=2, default=(384, 640))
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    results: dict[str, list[dict[str, float]]] = {way: [] for way in WAYS}
    for seed in options.seeds:
        for way, recipe in WAYS.items():
            folder = options.output / f"{way}-{seed}"
            weights = folder / "final.safetensors"
            if not weights.is_file():
                settings: dict[str, Any] = {
                    "data": options.data,
                    "output": str(folder),
                    "epochs": options.epochs,
                    "warmup_steps": 0,
                    "warmup_epochs": min(3.0, options.epochs / 10),
                    "seed": seed,
                    "input_size": tuple(options.input_size),
                    "batch_size": options.batch_size,
                    "workers": options.workers,
                    "validate_every": options.epochs,
                    "ema_ramp": 200,
                }
                going_on = (folder / CHECKPOINT_NAME).is_file()
                if not train(recipe, resume=going_on, **settings).finished:
                    raise SystemExit(130)
            metrics = read_card(weights).metrics
            results[way].append({name: metrics[f"val {name}"] for name in FIGURES})
    print("| Figure | " + " | ".join(WAYS) + " |\n|---|" + "---|" * len(WAYS))
    for name in FIGURES:
        cells = []
        for runs in results.values():
            values = [run[name] for run in runs]
            cells.append(f"{statistics.mean(values):.4f} ({min(values):.4f} to {max(values):.4f})")
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
