"""Train every row of a table of the paper, measure it as published, and print the table as the paper does."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from pathlib import Path
from typing import Any, Final

from trilitenet.commands.evaluate import evaluate, hash_dataset, known_report
from trilitenet.commands.paths import StrPath, check_writable
from trilitenet.commands.tables import PAPER_COLUMNS, markdown_row
from trilitenet.commands.train import train, training_data
from trilitenet.config import TASKS, Task, parse, parse_yaml, read_yaml
from trilitenet.data.identity import identify, tell_apart
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.checkpoint import read_checkpoint
from trilitenet.engine.recipe import TrainConfig, read_recipe
from trilitenet.engine.train import CHECKPOINT_NAME, holds_run
from trilitenet.errors import ConfigError, OutputError, brief, did_you_mean, shown, write_file
from trilitenet.models.cost import count_multiply_adds, count_parameters
from trilitenet.models.trilitenet import TriLiteNet
from trilitenet.models.weights import load_network, read_card

__all__ = ["TableResult", "TableRow", "train_table"]

_REPORT: Final = "evaluation"
_WEIGHTS: Final = "final.safetensors"
_FREE: Final = frozenset(
    {"data", "cache", "output", "device", "devices", "num_nodes", "workers", "compile"}
    | {"loggers", "log_every", "pictures", "checkpoint_every"}
)
"""Settings in which a row may differ from what is asked for: the data's content is compared by itself."""
_TICKS: Final[dict[Task, str]] = dict(zip(TASKS, ("Det", "DA", "LL"), strict=True))
"""Tasks -> the paper's headings of columns that tick them."""


@dataclasses.dataclass(frozen=True)
class TableRow:
    """One trained network.

    Attributes:
        name: Of the row.
        tasks: Of the network.
        figures: ``paper/task/name`` -> value in [0, 1] on the validation split; a task it lacks is left out.
        parameters: Number of parameters.
        multiply_adds: For one input.
    """

    name: str
    tasks: tuple[Task, ...]
    figures: dict[str, float]
    parameters: int
    multiply_adds: int


@dataclasses.dataclass(frozen=True)
class TableResult:
    """A table.

    Attributes:
        title: Of the table.
        rows: In the paper's order.
        finished: False if a run was stopped; its row and those after it are missing.
        compare: Name of the row that the others are shown beside, with how much they are above it; None for none.
        tick_tasks: Rows are told by their tasks, each ticked in a column of its own, not by their names.
        first: Whether this is the first of the runs' processes, which alone tells of them.
    """

    title: str
    rows: tuple[TableRow, ...]
    finished: bool
    compare: str | None = None
    tick_tasks: bool = False
    first: bool = True

    @property
    def exit_code(self) -> int:
        """0 if every row is there, 130 if a run was stopped."""
        return 0 if self.finished else 130

    def summary(self) -> str:
        """Return the table in Markdown; nothing for a process that is not the first."""
        if not self.first:
            return ""
        names = tuple(_TICKS.values()) if self.tick_tasks else ("Method",)
        head = (*names, *PAPER_COLUMNS.values(), "Params (M)", "Multiply-adds (G)")
        lines = [
            self.title if self.finished else f"{self.title} (stopped; go on with --resume)",
            "",
            "Validation split, protocol `paper`:",
            "",
            markdown_row(head),
            markdown_row(["---"] * len(head)),
        ]
        digits = (*(1 for _ in PAPER_COLUMNS), 2, 2)
        base = next((row for row in self.rows if row.name == self.compare), None)
        for row in self.rows:
            told = tuple("✓" if task in row.tasks else "" for task in _TICKS) if self.tick_tasks else (row.name,)
            before = [math.nan] * len(digits) if base is None or row is base else _numbers(base)
            lines.append(markdown_row([*told, *map(_cell, _numbers(row), before, digits)]))
        return "\n".join(lines)


def _numbers(row: TableRow) -> list[float]:
    """Return what a row shows: figures in per cent (NaN where it lacks one), parameters in M, multiply-adds in G."""
    figures = [100 * row.figures.get(name, math.nan) for name in PAPER_COLUMNS]
    return [*figures, row.parameters / 1e6, row.multiply_adds / 1e9]


def _cell(value: float, before: float, digits: int) -> str:
    """Return a number, and by how much it is above another one, where there are such."""
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}" + ("" if math.isnan(before) else f" ({value - before:+.{digits}f})")


def train_table(
    table: StrPath, /, *, data: StrPath, output: StrPath, resume: bool = False, settings: str = ""
) -> TableResult:
    """Train every row of a table of the paper, measure it under the published protocol, and print the table.

    Rows that are done are not trained again. A row's report is in its folder, under evaluation.

    Args:
        table: A YAML file with a title and rows: name -> recipe, relative to the file; with ``compare`` (a row's name)
            the others show how much they are above that one, with ``tick_tasks: true`` tasks are ticked in columns.
        data: Root folder of a data set in the published layout.
        output: Folder of the runs, a folder each, and of the table, called as its file but .md.
        resume: Go on with rows that were stopped, of which those without a checkpoint start anew; otherwise they are
            refused.
        settings: Settings of every run that replace the recipes', in YAML: '{epochs: 10, workers: 4}'.

    Returns:
        The table.

    Raises:
        OutputError: If a row that is done, or gone on with, was trained with other settings or on other data; if one
            was stopped and is not gone on with.
    """
    plan = _read(Path(table))
    recipes, printed = plan.recipes, Path(output, f"{Path(table).stem}.md")
    more = parse_yaml(settings, "settings") if settings else {}
    if not isinstance(more, dict) or {"data", "output"} & more.keys() or None in more.values():
        raise ConfigError(
            f"settings must be YAML such as '{{epochs: 10}}', without data and output, and no null, got {settings!r}"
        )
    check_writable(printed)
    fields: dict[str, Any] = {str(name): value for name, value in more.items()} | {"data": str(Path(data))}
    configs = {name: read_recipe(recipe, fields) for name, recipe in recipes.items()}
    done = {name: _is_done(Path(output, recipe.stem), configs[name], resume=resume) for name, recipe in recipes.items()}
    rows: list[TableRow] = []
    first = True
    for name, recipe in recipes.items():
        folder = Path(output, recipe.stem)
        weights = folder / _WEIGHTS
        if not done[name]:
            going_on = resume and (folder / CHECKPOINT_NAME).is_file()
            anew = resume and not going_on  # it was killed before its first checkpoint
            result = train(recipe, resume=going_on, overwrite=anew, **fields, output=str(folder))
            first = result.first
            if not result.finished:
                break
        network = load_network(weights, configs[name].network)
        figures = _measure(weights, network, configs[name]) if first else {}
        rows.append(
            TableRow(
                name,
                network.tasks,
                figures,
                count_parameters(network),
                count_multiply_adds(network, network.card.input_size),
            )
        )
    whole = TableResult(plan.title, tuple(rows), len(rows) == len(recipes), plan.compare, plan.tick_tasks, first)
    if first:
        write_file(printed, whole.summary() + "\n")
    return whole


def _measure(weights: Path, network: TriLiteNet, config: TrainConfig) -> dict[str, float]:
    """Return a row's figures as published, by the report in its folder, which is made if it is not there."""
    if not config.val_split:
        return {}
    dataset = DrivingDataset(config.data, config.val_split, class_names=network.card.class_names)
    folder = weights.parent / _REPORT
    known = known_report(
        folder,
        str(weights),
        lambda: hash_dataset(dataset),
        card=network.card,
        protocols=("paper",),
        backend="torch",
    )
    report = known or evaluate(
        str(weights),
        network=config.network,
        data=Path(config.data),
        split=config.val_split,
        protocol="paper",
        output=folder,
        overwrite=True,
        resamples=0,
        worst=0,
        device=config.device,
        backend="torch",
    )
    figures = {name: report.figures[name].value for name in PAPER_COLUMNS if name in report.figures}
    return {name: value for name, value in figures.items() if not math.isnan(value)}  # as of a task without labels


def _is_done(folder: Path, config: TrainConfig, *, resume: bool) -> bool:
    """Return whether a row is done.

    Raises:
        OutputError: If it can neither be taken as it is nor gone on with.
    """
    weights, checkpoint = folder / _WEIGHTS, folder / CHECKPOINT_NAME
    state = read_checkpoint(checkpoint) if checkpoint.is_file() else None
    done = weights.is_file()
    if done and state is not None:  # they may be older: of a run that went on for more epochs, and was stopped
        done = read_card(weights).provenance.get("steps") == str(state["step"])
    if not (done or resume) and holds_run(folder):
        raise OutputError(
            f"{folder}: holds a run that was stopped; --resume goes on with it, or remove the folder to train it anew"
        )
    if done or state is not None:
        _check_trained(folder, config, state)
    return done


def _check_trained(folder: Path, config: TrainConfig, state: dict[str, Any] | None) -> None:
    """Refuse a row that was trained with other settings or on other data than it would be now.

    Args:
        folder: Of the row.
        config: What is asked for now.
        state: Its checkpoint; None without one.

    Raises:
        OutputError: If so, or if that cannot be told.
    """
    cure = "give another --output, or remove the folder to train it anew"
    try:
        told = [read_recipe(folder / "config.yaml")]
        if state is not None:  # whose settings are others where the run went on and was killed before it was saved
            told.append(parse(TrainConfig, state["config"], str(folder / CHECKPOINT_NAME)))
    except ConfigError as error:
        raise OutputError(f"{folder}: what it was trained with cannot be told ({error}); {cure}") from error
    new = _flat(config.to_dict())
    for old in (_flat(settings.to_dict()) for settings in told):
        for name in sorted((old.keys() | new.keys()) - _FREE):
            if old.get(name) != new.get(name):
                asked = f"was trained with {name} {old.get(name)!r}, now {new.get(name)!r} is asked for"
                raise OutputError(f"{folder}: {asked}; {cure}")
    identity = state["data"] if state is not None else None
    difference = tell_apart(identity, identify(training_data(config)), strict=True) if identity else None
    if difference:
        raise OutputError(f"{folder}: was trained on {difference}; {cure}")


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return settings with those of mappings within under names such as ``augmentation.flip``."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


@dataclasses.dataclass(frozen=True)
class _Table:
    """What a table's file says."""

    title: str
    recipes: dict[str, Path]
    compare: str | None
    tick_tasks: bool


def _read(path: Path) -> _Table:
    content = read_yaml(path)
    known = ("title", "rows", "compare", "tick_tasks")
    for key in content:
        if key not in known:
            raise ConfigError(f"{path}: unknown key {key!r}{did_you_mean(str(key), known)}")
    try:
        rows = {str(name): path.parent / str(recipe) for name, recipe in content["rows"].items()}
        title = str(content["title"])
    except (KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: must hold a title and rows of 'name: recipe' ({brief(error)})") from error
    twice = [stem for stem, count in Counter(recipe.stem for recipe in rows.values()).items() if count > 1]
    if twice:
        raise ConfigError(f"{path}: two recipes are called {twice[0]!r}, and would share a folder; rename one")
    compare, tick_tasks = content.get("compare"), content.get("tick_tasks", False)
    if compare is not None and str(compare) not in rows:
        raise ConfigError(f"{path}: compare names no row{did_you_mean(str(compare), rows)}")
    if not isinstance(tick_tasks, bool):
        raise ConfigError(f"{path}: tick_tasks must be true or false, got {shown(tick_tasks)}")
    return _Table(title, rows, None if compare is None else str(compare), tick_tasks)
