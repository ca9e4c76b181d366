"""Where the figures of a run go: CSV and TensorBoard at hand, MLflow and Weights & Biases if installed."""

from __future__ import annotations

import abc
import contextlib
import csv
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Protocol, TypeAlias

from trilitenet.data.description import folder_name
from trilitenet.errors import TrainingError, TriLiteNetError, gist, import_extra, replacing, write_file

__all__ = [
    "CsvLogger",
    "MLflowLogger",
    "RunEnd",
    "RunLogger",
    "TensorBoardLogger",
    "WandbLogger",
    "build_loggers",
    "check_loggers",
    "read_csv",
]

_LOGGER: Final = logging.getLogger(__name__)

RunEnd: TypeAlias = Literal["finished", "stopped", "failed"]
"""How a run ends."""

_PAUSE: Final = 10.0
"""Times as long as a try took that failed, a server is not tried again: one that is away slows a run by a tenth."""


class RunLogger(Protocol):
    """Takes the figures of a run."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""

    def close(self, end: RunEnd = "finished") -> None:
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

    def close(self, end: RunEnd = "finished") -> None:
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

    def close(self, end: RunEnd = "finished") -> None:
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


class _ServerLogger(abc.ABC):
    """Tells a server, of whose errors none ends a run that has begun: the first is warned of.

    Attributes:
        run_id: What the server knows the run by.
    """

    run_id: str

    def __init__(self, name: str) -> None:
        self._name = name
        self._warned = False
        self._again = 0.0

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Take named figures of a step."""
        if time.monotonic() >= self._again:
            self._try(lambda: self._log(dict(values), step))

    def close(self, end: RunEnd = "finished") -> None:
        """End the run."""
        self._try(lambda: self._close(end))

    def _try(self, tell: Callable[[], None]) -> None:
        began = time.monotonic()
        try:
            tell()
        except Exception as error:  # what these packages raise shares no base class
            now = time.monotonic()
            self._again = now + _PAUSE * (now - began)
            if not self._warned:
                self._warned = True
                reason = gist(error) or type(error).__name__
                _LOGGER.warning("%s: cannot log (%s); the run goes on, and may miss figures there", self._name, reason)

    @abc.abstractmethod
    def _log(self, values: dict[str, float], step: int) -> None: ...

    @abc.abstractmethod
    def _close(self, end: RunEnd) -> None: ...


class MLflowLogger(_ServerLogger):
    """An MLflow run, at the tracking server that MLFLOW_TRACKING_URI names.

    Args:
        name: Of the run.
        config: The resolved configuration.
        run_id: Of the server's run to go on with; None begins one.
    """

    def __init__(self, name: str, config: Mapping[str, Any], run_id: str | None = None) -> None:
        super().__init__("mlflow")
        self._mlflow: Any = import_extra(*_PACKAGES["mlflow"])
        self.run_id = self._mlflow.start_run(run_id=run_id, run_name=name).info.run_id
        if run_id is None:  # it lets no parameter be changed
            self._try(lambda: self._mlflow.log_params({key: str(value)[:250] for key, value in config.items()}))

    def _log(self, values: dict[str, float], step: int) -> None:
        self._mlflow.log_metrics(values, step=step)

    def _close(self, end: RunEnd) -> None:
        self._mlflow.end_run({"finished": "FINISHED", "stopped": "KILLED", "failed": "FAILED"}[end])


class WandbLogger(_ServerLogger):
    """A Weights & Biases run; WANDB_MODE=offline keeps it on this machine.

    Args:
        name: Of the run.
        config: The resolved configuration.
        folder: Where its files go; there is one.
        run_id: Of the server's run to go on with; None begins one.
    """

    def __init__(self, name: str, config: Mapping[str, Any], folder: Path, run_id: str | None = None) -> None:
        super().__init__("wandb")
        wandb: Any = import_extra(*_PACKAGES["wandb"])
        self._run = wandb.init(
            project="trilitenet",
            name=name,
            config=dict(config),
            dir=str(folder),
            id=run_id,
            resume=None if run_id is None else "allow",
        )
        self.run_id = self._run.id
        # It would leave out a figure of a step before its own latest one, as of a validation that is done anew.
        self._try(lambda: self._run.define_metric("*", step_metric="step"))

    def _log(self, values: dict[str, float], step: int) -> None:
        self._run.log({**values, "step": step})

    def _close(self, end: RunEnd) -> None:
        self._run.finish(exit_code={"finished": 0, "stopped": 130, "failed": 1}[end])


_PACKAGES: Final = {
    "tensorboard": ("torch.utils.tensorboard", "train"),
    "mlflow": ("mlflow", "mlflow"),
    "wandb": ("wandb", "wandb"),
}
"""What a logger needs, and the extra that installs it."""

_SERVERS: Final = {"mlflow": "MLFLOW_TRACKING_URI", "wandb": "`wandb login` and WANDB_MODE"}
"""Loggers that tell a server, and what says which one and who one is."""


def check_loggers(names: Sequence[str]) -> None:
    """Refuse loggers whose package is not installed, before anything is written.

    Raises:
        MissingExtraError: If one is not.
    """
    for name in names:
        if name in _PACKAGES:
            import_extra(*_PACKAGES[name])


def build_loggers(
    names: Sequence[str],
    folder: Path,
    config: Mapping[str, Any],
    step: int = 0,
    validated: int = 0,
    begin: Callable[[], None] = lambda: None,
) -> list[RunLogger]:
    """Build loggers by name.

    Args:
        names: Of csv, tensorboard, mlflow and wandb.
        folder: The run's folder.
        config: The resolved configuration.
        step: Step the run goes on from.
        validated: Step of the last validation that it does not do anew.
        begin: Is called once servers have let the run in, and before any file is made.

    Raises:
        MissingExtraError: If a logger's package is not installed.
        TrainingError: If a server does not let the run in.
    """
    path = folder / "loggers.json"
    known = _read_run_ids(path) if step else {}
    servers: dict[str, _ServerLogger] = {}
    files: list[RunLogger] = []
    with contextlib.ExitStack() as opened:
        for name in dict.fromkeys(names):
            if name in _SERVERS:
                servers[name] = _let_in(name, folder, config, known.get(name))
                opened.callback(servers[name].close, "failed")
        begin()
        if servers:
            ids = known | {name: server.run_id for name, server in servers.items()}
            write_file(path, json.dumps(ids, indent=2) + "\n")
        for name in dict.fromkeys(names):
            if name == "csv":
                files.append(CsvLogger(folder / "metrics.csv", step, validated))
            elif name == "tensorboard":
                files.append(TensorBoardLogger(folder / "tensorboard", step))
        opened.pop_all()
    return [*files, *servers.values()]


def _let_in(name: str, folder: Path, config: Mapping[str, Any], run_id: str | None) -> _ServerLogger:
    """Begin a run at a server, or go on with one.

    Raises:
        TrainingError: If the server does not let it.
    """
    folder.mkdir(parents=True, exist_ok=True)  # wandb would take another
    try:
        if name == "mlflow":
            return MLflowLogger(folder_name(folder), config, run_id)
        return WandbLogger(folder_name(folder), config, folder, run_id)
    except TriLiteNetError:
        raise
    except Exception as error:  # what these packages raise shares no base class
        anew = "" if run_id is None else f"remove {folder / 'loggers.json'} to begin another run there, "
        reason = gist(error) or type(error).__name__
        raise TrainingError(
            f"{name}: cannot log ({reason}); see {_SERVERS[name]}, {anew}or leave it out of --loggers"
        ) from error


def _read_run_ids(path: Path) -> dict[str, str]:
    """Return what servers know a run by, by logger; nothing of a file that is not there or damaged."""
    with contextlib.suppress(FileNotFoundError, ValueError):
        ids = json.loads(path.read_text(encoding="utf-8"))
        return ids if isinstance(ids, dict) else {}
    return {}
