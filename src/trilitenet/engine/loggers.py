"""Where the figures of a run go: CSV and TensorBoard at hand, MLflow and Weights & Biases if installed."""

from __future__ import annotations

import contextlib
import csv
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from trilitenet.data.description import folder_name
from trilitenet.errors import import_extra, replacing

__all__ = [
    "CsvLogger",
    "MLflowLogger",
    "RunLogger",
    "TensorBoardLogger",
    "WandbLogger",
    "build_loggers",
    "check_loggers",
]


class RunLogger(Protocol):
    """Takes the figures of a run."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""

    def close(self) -> None:
        """Write out what is left."""


class CsvLogger:
    """One line a figure: step, name, value. Going on from a step drops what came after it.

    Args:
        path: The file.
        step: Step the run goes on from; 0 starts the file anew.
        validated: Step of the last validation that the run does not do anew.
    """

    def __init__(self, path: Path, step: int = 0, validated: int = 0) -> None:
        rows = read_csv(path) if step and path.exists() else []
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("step", "name", "value"))
            writer.writerows(row for row in rows if row[0] <= (validated if row[1].startswith("val/") else step))
        self._file = path.open("a", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""
        self._writer.writerows((step, name, repr(float(value))) for name, value in values.items())
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_csv(path: Path) -> list[tuple[int, str, float]]:
    """Return the (step, name, value) rows that `CsvLogger` wrote, without a line that a full disk or a kill cut off."""
    rows: list[tuple[int, str, float]] = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        # A machine that goes down may leave zero bytes, at which Python 3.10 raises csv.Error.
        for row in csv.DictReader(line.replace("\0", "") for line in file):
            with contextlib.suppress(TypeError, ValueError, KeyError):
                rows.append((int(row["step"]), row["name"], float(row["value"])))
    return rows


class TensorBoardLogger:
    """Event files for TensorBoard.

    Args:
        folder: Where they go.
        step: Step the run goes on from.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        module: Any = import_extra(*_PACKAGES["tensorboard"])
        self._writer = module.SummaryWriter(str(folder), purge_step=step + 1 if step else None)
        self._hook = threading.excepthook
        threading.excepthook = self._note

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Write out what is left."""
        try:
            self._writer.close()
        finally:
            if threading.excepthook == self._note:  # another's that came later stays
                threading.excepthook = self._hook

    def _note(self, failure: threading.ExceptHookArgs) -> None:
        """Say nothing of what ends TensorBoard's thread, such as a full disk: the next call raises it."""
        if not type(failure.thread).__module__.startswith("tensorboard."):
            self._hook(failure)


class MLflowLogger:
    """An MLflow run, at the tracking server that MLFLOW_TRACKING_URI names."""

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        self._mlflow: Any = import_extra(*_PACKAGES["mlflow"])
        self._mlflow.start_run(run_name=name)
        self._mlflow.log_params({key: str(value)[:250] for key, value in config.items()})

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""
        self._mlflow.log_metrics(dict(values), step=step)

    def close(self) -> None:
        """End the run."""
        self._mlflow.end_run()


class WandbLogger:
    """A Weights & Biases run; WANDB_MODE=offline keeps it on this machine."""

    def __init__(self, name: str, config: Mapping[str, Any], folder: Path) -> None:
        wandb: Any = import_extra(*_PACKAGES["wandb"])
        self._run = wandb.init(project="trilitenet", name=name, config=dict(config), dir=str(folder))

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """End the run."""
        self._run.finish()


_PACKAGES: Final = {
    "tensorboard": ("torch.utils.tensorboard", "train"),
    "mlflow": ("mlflow", "mlflow"),
    "wandb": ("wandb", "wandb"),
}
"""What a logger needs, and the extra that installs it."""


def check_loggers(names: Sequence[str]) -> None:
    """Refuse loggers whose package is not installed, before anything is written.

    Raises:
        MissingExtraError: If one is not.
    """
    for name in names:
        if name in _PACKAGES:
            import_extra(*_PACKAGES[name])


def build_loggers(
    names: Sequence[str], folder: Path, config: Mapping[str, Any], step: int = 0, validated: int = 0
) -> list[RunLogger]:
    """Build loggers by name.

    Args:
        names: Of csv, tensorboard, mlflow and wandb.
        folder: The run's folder.
        config: The resolved configuration.
        step: Step the run goes on from.
        validated: Step of the last validation that it does not do anew.

    Raises:
        MissingExtraError: If a logger's package is not installed.
    """
    loggers: list[RunLogger] = []
    for name in dict.fromkeys(names):
        if name == "csv":
            loggers.append(CsvLogger(folder / "metrics.csv", step, validated))
        elif name == "tensorboard":
            loggers.append(TensorBoardLogger(folder / "tensorboard", step))
        elif name == "mlflow":
            loggers.append(MLflowLogger(folder_name(folder), config))
        elif name == "wandb":
            loggers.append(WandbLogger(folder_name(folder), config, folder))
    return loggers
