"""The training loop on the tiny network, a few random batches and no data set."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest
import torch

from trilitenet.config import TASKS, Task
from trilitenet.data.batches import Batch, collate
from trilitenet.data.sample import Sample
from trilitenet.engine.loggers import RunEnd
from trilitenet.engine.recipe import TrainConfig
from trilitenet.engine.rescale import draw_size
from trilitenet.engine.train import Trainer, TrainResult
from trilitenet.errors import BackendError, OutputError, TrainingError, WeightsError
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.distillation import DistillationLoss
from trilitenet.losses.multitask import LossTerms, MultiTaskLoss
from trilitenet.losses.segmentation import SegmentationLoss
from trilitenet.models.trilitenet import TriLiteNet, build_network
from trilitenet.models.weights import load_network, read_card

lightning_fabric = pytest.importorskip("lightning_fabric")


class Batches:
    """So many batches of two images an epoch; notes which are asked for, and which are read."""

    def __init__(self, count: int) -> None:
        size = (32, 64)
        self.asked: list[tuple[int, int]] = []
        self.read: list[tuple[int, int]] = []
        rng = np.random.default_rng(0)
        self._batches = [
            collate(
                [
                    Sample(
                        name=f"{index}",
                        image=rng.integers(0, 256, (*size, 3), dtype=np.uint8),
                        boxes=np.array([[4, 4, 20, 24]], np.float32),
                        class_id=np.zeros(1, np.int64),
                        drivable=rng.integers(0, 2, size, dtype=np.uint8),
                        lane=rng.integers(0, 2, size, dtype=np.uint8),
                    )
                    for index in (2 * batch, 2 * batch + 1)
                ]
            )
            for batch in range(count)
        ]

    def __len__(self) -> int:
        return len(self._batches)

    def epoch(self, epoch: int, *, start: int = 0) -> Iterator[Batch]:
        self.asked.append((epoch, start))
        for place in range(start, len(self)):
            self.read.append((epoch, place))
            yield self._batches[place]


class Log:
    """A logger that remembers."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, dict[str, float]]] = []
        self.ends: list[RunEnd] = []

    def log(self, values: Mapping[str, float], step: int) -> None:
        self.rows.append((step, dict(values)))

    def close(self, end: RunEnd = "finished") -> None:
        self.ends.append(end)

    def of(self, name: str) -> list[float]:
        return [values[name] for _, values in self.rows if name in values]


def trainer(
    folder: Path,
    *,
    batches: int = 2,
    validate: Callable[[TriLiteNet, Any], Mapping[str, float]] | None = None,
    measured_on: Mapping[str, Any] | None = None,
    display: Any = None,
    teacher: TriLiteNet | None = None,
    **settings: Any,
) -> Trainer:
    torch.manual_seed(0)
    plain: dict[str, Any] = {"batch_size": 2, "epochs": 10, "warmup_epochs": 0.0, "log_every": 1, "output": str(folder)}
    config = TrainConfig(**plain | settings)
    network = build_network("tiny", 1, config.tasks)
    masks = [SegmentationLoss(0.5, 0.5), SegmentationLoss(0.5, 0.5)]
    boxes = DetectionLoss(network.anchors, 1) if "detection" in config.tasks else None
    loss = MultiTaskLoss(boxes, *masks, balancing=config.balancing)
    fabric = lightning_fabric.Fabric(accelerator="cpu", devices=1, precision="32-true")
    fabric.launch()
    taught = (
        None if teacher is None else (teacher, DistillationLoss(network.anchors, teacher.anchors, config.distillation))
    )
    options: dict[str, Any] = {"validate": validate, "measured_on": measured_on, "display": display}
    return Trainer(config, network, loss, Batches(batches), fabric, network.card, teacher=taught, **options)


def fit(run: Trainer, *, resume: bool = False) -> tuple[TrainResult, Log]:
    told = Log()

    def build(_step: int, _validated: int, begin: Callable[[], None]) -> list[Log]:
        begin()
        return [told]

    return run.fit(run.folder / "last.ckpt" if resume else None, build), told


def test_accumulated_batches_follow_each_other_over_a_stop(tmp_path: Path) -> None:
    first = trainer(tmp_path, batches=5, accumulate=2, batch_size=4, max_steps=1)
    fit(first)
    assert isinstance(first.loader, Batches)
    assert first.loader.read == [(0, 0), (0, 1)]
    later = trainer(tmp_path, batches=5, accumulate=2, batch_size=4, max_steps=3)
    result, told = fit(later, resume=True)
    assert isinstance(later.loader, Batches)
    assert later.loader.asked == [(0, 2), (1, 0)]
    # The fifth batch of an epoch, which is no whole step, is left out.
    assert [place for place in later.loader.read if place != (0, 4)] == [(0, 2), (0, 3), (1, 0), (1, 1)]
    assert (result.steps, len(told.of("lr")), later.images) == (3, 2, 8)


def test_the_gradient_of_a_step_is_of_the_mean_of_its_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    totals: list[float] = []
    run = trainer(tmp_path, accumulate=2, batch_size=4, max_steps=1)
    plain = run.fabric.backward

    def backward(total: torch.Tensor) -> None:
        totals.append(total.item())
        plain(total)

    monkeypatch.setattr(run.fabric, "backward", backward)
    _, told = fit(run)
    assert len(totals) == 2
    assert sum(totals) == pytest.approx(told.of("train/total")[0])
    assert all(parameter.grad is None for parameter in run.network.parameters())


def test_the_gradient_is_clipped_if_asked_for(tmp_path: Path) -> None:
    moved = []
    for largest in (1e-12, 0.0):
        run = trainer(tmp_path / str(largest), max_steps=1, clip_gradient=largest, weight_decay=0.0)
        before = [parameter.detach().clone() for parameter in run.network.parameters()]
        fit(run)
        pairs = zip(run.network.parameters(), before, strict=True)
        moved.append(max((parameter.detach() - old).abs().max().item() for parameter, old in pairs))
    assert moved[0] < 1e-5 < moved[1]  # AdamW divides by the gradient's size, and 1e-8 more


def test_the_rate_does_not_hang_on_where_the_run_is_cut(tmp_path: Path) -> None:
    options: dict[str, Any] = {"tasks": ("drivable",), "epochs": 2}
    whole = fit(trainer(tmp_path / "whole", **options))[1].of("lr")
    assert fit(trainer(tmp_path / "cut", max_steps=3, **options))[1].of("lr") == whole[:3]
    assert whole == sorted(set(whole), reverse=True)
    stairs = fit(trainer(tmp_path / "epochs", max_steps=3, cosine_steps="epoch", **options))[1].of("lr")
    assert stairs[0] == stairs[1] > stairs[2]
    # A warm-up that is longer than the run ends with it.
    warm = fit(trainer(tmp_path / "warm", warmup_epochs=1.0, final_lr=1.0, **options))[1].of("lr")
    assert warm == pytest.approx([1e-3 * step / 4 for step in range(1, 5)])


def test_the_average_is_what_is_measured_and_kept(tmp_path: Path) -> None:
    seen: list[dict[str, torch.Tensor]] = []

    def validate(network: TriLiteNet, _: Any) -> dict[str, float]:
        seen.append({name: tensor.clone() for name, tensor in network.state_dict().items()})
        return {"drivable/miou": 0.5}

    run = trainer(tmp_path, validate=validate, tasks=("drivable",), max_steps=2, ema_decay=0.5, ema_ramp=0.0)
    name = "encoder.level1.conv.weight"
    before = run.network.state_dict()[name].clone()
    result, _ = fit(run)
    (measured,) = seen
    for other in (before, run.network.state_dict()[name]):  # the average is neither what was nor what is
        assert not torch.allclose(measured[name], other, rtol=1e-2)
    for path in (result.weights, tmp_path / "best-drivable.safetensors"):
        torch.testing.assert_close(load_network(path).state_dict()[name], measured[name], rtol=1e-3, atol=1e-5)


def test_the_card_claims_no_figure_that_is_undefined(tmp_path: Path) -> None:
    run = trainer(tmp_path, max_steps=1, validate=lambda _network, _show: {"lane/iou": math.nan, "drivable/miou": 0.5})
    result, _ = fit(run)
    assert math.isnan(result.metrics["lane/iou"])
    assert result.summary().endswith(" (lane/iou -, drivable/miou 0.5000)")
    assert read_card(result.weights).metrics == {"val drivable/miou": 0.5}
    assert read_card(tmp_path / "best-drivable.safetensors").metrics["val drivable/miou"] == 0.5


def test_the_best_of_each_task_and_of_all_is_kept(tmp_path: Path) -> None:
    figures = iter(
        [
            {"drivable/miou": 0.5, "lane/iou": 0.5, "lane/f1_2px": 0.9},
            {"drivable/miou": 0.7, "lane/iou": 0.2, "lane/f1_2px": 0.9},  # the mean is worse
            {"drivable/miou": math.nan, "lane/iou": 0.6, "lane/f1_2px": 0.9},  # ... and of the lane alone better
            {"drivable/miou": 0.1, "lane/iou": 0.7, "lane/f1_2px": 0.9},  # the mean is worse
            {"drivable/miou": 0.1, "lane/iou": 0.1, "lane/f1_2px": 0.9},
        ]
    )
    run = trainer(tmp_path, validate=lambda *_: next(figures), tasks=("drivable", "lane"), epochs=9, patience=2)
    result, told = fit(run)
    assert result.best == {"drivable": 0.7, "lane": 0.7, "overall": 0.6}
    assert (result.finished, result.steps) == (True, 10)  # the means of the last two were no better
    for name, step in (("drivable", "4"), ("lane", "8"), ("overall", "6")):
        card = read_card(tmp_path / f"best-{name}.safetensors")
        assert card.provenance["steps"] == step
        assert card.metrics[f"best {name}"] == result.best[name]
        assert card.metrics["val lane/f1_2px"] == 0.9
    assert told.of("val/lane/iou") == [0.5, 0.2, 0.6, 0.7, 0.1]
    assert read_card(result.weights).metrics["val lane/iou"] == 0.1


@pytest.mark.parametrize("left", [0, 100])
def test_damaged_best_weights_are_replaced_and_stop_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    figures = iter([{"lane/iou": 0.6, "drivable/miou": 0.5}, {"lane/iou": 0.4, "drivable/miou": 0.3}])
    fit(trainer(tmp_path, batches=1, max_steps=1, validate=lambda _network, _show: next(figures)))
    path = tmp_path / "best-lane.safetensors"
    path.write_bytes(path.read_bytes()[:left])
    later = trainer(tmp_path, batches=1, max_steps=2, validate=lambda _network, _show: next(figures))
    shown: list[str] = []
    monkeypatch.setattr(later, "_show", shown.append)
    result, _ = fit(later, resume=True)
    assert shown[0] == f"{path}: is damaged; the next validation replaces it"
    assert result.best == {"lane": 0.4, "drivable": 0.5, "overall": pytest.approx(0.55)}
    assert read_card(path).metrics["best lane"] == 0.4


def test_validations_without_progress_are_counted_over_a_stop(tmp_path: Path) -> None:
    figures = iter([0.5, 0.4, 0.4, 0.4])
    options: dict[str, Any] = {
        "validate": lambda *_: {"drivable/miou": next(figures)},
        "tasks": ("drivable",),
        "patience": 3,
    }
    fit(trainer(tmp_path, max_steps=6, **options))
    result, _ = fit(trainer(tmp_path, **options), resume=True)
    assert (result.steps, result.best["drivable"]) == (8, 0.5)


def test_what_is_best_is_found_anew_on_other_validation_data(tmp_path: Path) -> None:
    part = {"images": 2, "names": "a", "kind": "DrivingDataset", "content": ["x", "y"]}
    data, other = ({"classes": ["car"], "parts": [part | {"images": count}]} for count in (2, 3))
    display = Mock()

    def go_on(score: float, on: Mapping[str, Any], steps: int) -> float:
        run = trainer(
            tmp_path,
            validate=lambda *_: {"drivable/miou": score},
            measured_on=on,
            display=display,
            tasks=("drivable",),
            max_steps=steps,
        )
        result, _ = fit(run, resume=(tmp_path / "last.ckpt").exists())
        assert read_card(tmp_path / "best-drivable.safetensors").metrics["best drivable"] == result.best["drivable"]
        return result.best["drivable"]

    assert go_on(0.9, data, 2) == 0.9
    assert go_on(0.4, data, 4) == 0.9
    stopped = trainer(tmp_path, measured_on=other, tasks=("drivable",), max_steps=5, validate_every=9, display=display)
    fit(stopped, resume=True)  # which has not measured
    told = call.line("was validated on 2 images, not 3: what is best is found anew")
    assert display.mock_calls.count(told) == 1
    assert go_on(0.5, other, 6) == 0.5
    assert go_on(0.4, other, 8) == 0.5
    assert display.mock_calls.count(told) == 2


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 2.00 GiB for an array"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: ..."),
        BackendError("torch cuda is out of memory for 8 images of 640x384; use a smaller batch or a smaller size"),
    ],
)
def test_a_validation_without_memory_is_done_anew_by_resuming(tmp_path: Path, error: Exception) -> None:
    if isinstance(error, BackendError):
        error.__cause__ = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate ...")
    options: dict[str, Any] = {"tasks": ("drivable",), "max_steps": 1}
    told = (
        r"^cpu is out of memory in the validation after step 1; make room, or go without it by --val-split ''; "
        r"--resume goes on after step 1 of 1 \(epoch 1 of 10\)$"
    )
    with pytest.raises(TrainingError, match=told):
        fit(trainer(tmp_path, validate=Mock(side_effect=error), **options))
    result, _ = fit(trainer(tmp_path, validate=lambda *_: {"drivable/miou": 0.5}, **options), resume=True)
    assert (result.steps, result.best["drivable"]) == (1, 0.5)
    with pytest.raises(RuntimeError, match="a mistake"):
        fit(trainer(tmp_path, validate=Mock(side_effect=RuntimeError("a mistake")), **options))


def test_a_run_that_is_done_keeps_its_figures(tmp_path: Path) -> None:
    options: dict[str, Any] = {"tasks": ("drivable",), "max_steps": 1}
    fit(trainer(tmp_path, validate=lambda *_: {"drivable/miou": 0.5}, **options))
    result, _ = fit(trainer(tmp_path, **options), resume=True)
    assert (result.metrics, result.best) == ({"drivable/miou": 0.5}, {"drivable": 0.5, "overall": 0.5})
    assert read_card(result.weights).metrics == {"val drivable/miou": 0.5}
    assert result.summary().startswith("finished after 1 steps, none of them new: ")


def test_validation_and_checkpoints_come_every_so_many_epochs_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured, saved = [], []
    plain = Trainer.save

    def save(self: Trainer) -> None:
        saved.append(self.step)
        plain(self)

    monkeypatch.setattr(Trainer, "save", save)

    def validate(*_: object) -> dict[str, float]:
        measured.append(run.step)
        return {"drivable/miou": 0.5}

    options: dict[str, Any] = {"tasks": ("drivable",), "validate_every": 2, "checkpoint_every": 3, "epochs": 5}
    run = trainer(tmp_path, validate=validate, **options)
    fit(run)
    assert measured == [4, 8, 10]
    assert saved == [6, 10, 10]  # at the end before the validation, too


def test_every_step_draws_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[tuple[int, ...]] = []
    plain = TriLiteNet.forward

    def forward(self: TriLiteNet, image: torch.Tensor) -> Any:
        sizes.append(tuple(image.shape[2:]))
        return plain(self, image)

    monkeypatch.setattr(TriLiteNet, "forward", forward)
    fit(trainer(tmp_path, tasks=("drivable",), max_steps=4, multi_scale=(1.0, 3.0), seed=5))
    assert sizes == [draw_size((32, 64), (1.0, 3.0), 5, step) for step in range(4)]
    assert len(set(sizes)) > 1


def test_a_teacher_adds_to_the_loss(tmp_path: Path) -> None:
    torch.manual_seed(1)
    teacher = build_network("tiny")
    totals = []
    for one in (None, teacher):
        _, told = fit(trainer(tmp_path / str(one is None), teacher=one, max_steps=1))
        totals.append(told.of("train/total")[0])
        parts = sum(value for name, value in told.rows[0][1].items() if name.startswith("train/")) - totals[-1]
        assert parts == pytest.approx(totals[-1])
    assert totals[1] > totals[0] + 0.01
    assert not any(module.training for module in teacher.modules())


@pytest.mark.parametrize(
    ("tasks", "taught", "weights", "terms"),
    [
        (("drivable",), None, (1, 1, 1), "drivable_focal drivable_tversky"),
        (("detection", "lane"), None, (1, 1, 1), "box objectness classification lane_focal lane_tversky"),
        (("drivable",), TASKS, (1, 1, 1), "drivable_focal drivable_tversky distil_drivable"),
        (
            ("drivable", "lane"),
            ("lane",),
            (1, 1, 1),
            "drivable_focal drivable_tversky lane_focal lane_tversky distil_lane",
        ),
        (
            ("drivable", "lane"),
            TASKS,
            (1, 1, 0),
            "drivable_focal drivable_tversky lane_focal lane_tversky distil_drivable",
        ),
        (TASKS, ("detection",), (1, 1, 1), " ".join((*LossTerms._fields[1:], "distil_detection"))),
    ],
)
def test_the_losses_of_the_tasks_and_lessons_that_there_are_are_told(
    tmp_path: Path,
    tasks: tuple[Task, ...],
    taught: tuple[Task, ...] | None,
    weights: tuple[float, float, float],
    terms: str,
) -> None:
    display = Mock()
    teacher = None if taught is None else build_network("tiny", 1, taught)
    _, told = fit(trainer(tmp_path, tasks=tasks, teacher=teacher, distillation=weights, display=display, max_steps=1))
    ((_, values),) = told.rows
    losses = {name: values[f"train/{name}"] for name in ("total", *terms.split())}
    assert list(values) == [*(f"train/{name}" for name in losses), "lr", "images_per_second"]
    assert all(value > 0 for name, value in losses.items() if name != "classification")  # of a single class
    line = display.step.call_args.args[2].partition(": ")[2].partition(" (")[0]
    assert line == " ".join(f"{name} {value:.4f}" for name, value in losses.items())


def test_the_learned_balance_is_told(tmp_path: Path) -> None:
    run = trainer(tmp_path, tasks=("drivable", "lane"), balancing="uncertainty", max_steps=2, lr=0.1)
    _, told = fit(run)
    assert run.loss.log_variance is not None
    learned = [0.3 * math.exp(-value) for value in run.loss.log_variance[1:].tolist()]
    assert [told.of(f"train/weight_{task}")[-1] for task in ("drivable", "lane")] == pytest.approx(learned)
    assert 0.3 not in learned
    assert not told.of("train/weight_detection")


def test_the_loggers_are_told_how_a_run_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ends: list[tuple[RunEnd, bool]] = []

    def close(_: Log, end: RunEnd) -> None:
        ends.append((end, (tmp_path / "final.safetensors").exists()))

    def stop(self: Trainer, *_: object) -> bool:
        return self.step == 2

    monkeypatch.setattr(Log, "close", close)
    options: dict[str, Any] = {"tasks": ("drivable",), "max_steps": 3}
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_stopped", stop)
        fit(trainer(tmp_path, **options))
    for error in (KeyboardInterrupt, RuntimeError):
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "_train_epoch", Mock(side_effect=error))
            with pytest.raises(error):
                fit(trainer(tmp_path, **options), resume=True)
    fit(trainer(tmp_path, **options), resume=True)
    assert ends == [("stopped", False), ("stopped", False), ("failed", False), ("finished", True)]


def test_a_bad_step_is_no_part_of_the_logged_losses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    plain, calls = TriLiteNet.forward, iter(range(100))

    def forward(self: TriLiteNet, image: torch.Tensor) -> Any:
        return plain(self, image * math.nan if next(calls) == 2 else image)

    options: dict[str, Any] = {"tasks": ("drivable",), "batches": 4, "accumulate": 2, "batch_size": 4}
    _, good = fit(trainer(tmp_path / "good", max_steps=1, **options))
    monkeypatch.setattr(TriLiteNet, "forward", forward)
    _, told = fit(trainer(tmp_path / "bad", max_steps=2, log_every=2, **options))
    assert told.of("train/total") == good.of("train/total")
    assert "step 1 skipped: its loss or gradient is not finite (images: 4, 5, 6, 7)" in caplog.text


def test_logged_losses_are_the_mean_of_the_steps_since_the_last_ones(tmp_path: Path) -> None:
    each, both = (
        fit(trainer(tmp_path / str(steps), tasks=("drivable",), max_steps=2, log_every=steps))[1] for steps in (1, 2)
    )
    assert len(each.of("train/total")) == 2
    assert both.of("train/total") == [pytest.approx(sum(each.of("train/total")) / 2)]
    assert each.of("train/total")[0] != pytest.approx(each.of("train/total")[1], rel=1e-3)


def test_processes_tell_each_other_of_a_stop_past_their_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosts, groups = object(), []

    def all_reduce(flags: torch.Tensor, *, group: object) -> None:
        assert flags.device.type == "cpu"
        groups.append(group)
        flags += torch.tensor([0.0, 1.0])  # of the other process

    monkeypatch.setattr("trilitenet.engine.train.hosts_group", lambda _fabric: hosts)
    run = trainer(tmp_path, tasks=("drivable",))
    monkeypatch.setattr(torch.distributed, "all_reduce", all_reduce)
    run.fabric = Mock(world_size=2, device=torch.device("meta"))  # which tells nothing
    assert run._any(True, False) == (True, True)
    assert run._any(False, False) == (False, True)
    assert groups == [hosts, hosts]


def test_an_error_of_the_network_is_not_taken_for_one_of_a_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forward(self: TriLiteNet, image: torch.Tensor) -> Any:
        raise RuntimeError("a mistake in a layer")

    monkeypatch.setattr(TriLiteNet, "forward", forward)
    with pytest.raises(RuntimeError, match="a mistake in a layer"):
        fit(trainer(tmp_path, max_steps=1))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    fit(trainer(folder, max_steps=1))
    return folder / "last.ckpt"


def test_what_must_be_the_same_on_resuming_is_compared(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others: dict[str, Any] = {"variant": "small", "tasks": ["lane"], "batch_size": 4, "accumulate": 2}
    others |= {"balancing": "uncertainty", "freeze": ["lane"]}
    others |= dict.fromkeys(("pcaa", "litepan", "spp"), False) | {"decay_all": True}
    run = trainer(tmp_path)
    state = torch.load(checkpoint, weights_only=True)
    for name, value in others.items():
        other = {**state, "config": state["config"] | {name: value}}
        monkeypatch.setattr("trilitenet.engine.train.read_checkpoint", lambda _, other=other: other)
        with pytest.raises(WeightsError, match=rf"last\.ckpt: was trained with {name} .*, this run has "):
            run.load(checkpoint)


def test_a_log_that_cannot_be_closed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def close(self: Log, end: RunEnd) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Log, "close", close)
    with pytest.raises(
        OutputError, match=r"cannot be written \(No space left on device\); once that is mended, --resume"
    ):
        fit(trainer(tmp_path, tasks=("drivable",), max_steps=1))
