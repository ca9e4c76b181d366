from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor, nn

from trilitenet.engine.guard import MAX_BAD_STEPS, FiniteGuard
from trilitenet.engine.optim import build_optimiser
from trilitenet.errors import TrainingError

GOOD, BAD = torch.tensor(1.0), torch.tensor(float("nan"))


def make(interval: int) -> tuple[nn.BatchNorm1d, torch.optim.Optimizer, FiniteGuard]:
    network = nn.BatchNorm1d(2)
    optimiser = build_optimiser([network], lr=0.1, betas=(0.9, 0.99), weight_decay=0.0)
    return network, optimiser, FiniteGuard([network], optimiser, interval)


@pytest.mark.parametrize(("loss", "norm"), [(BAD, GOOD), (GOOD, BAD), (torch.tensor(float("inf")), GOOD)])
def test_names_the_step_and_its_images(loss: Tensor, norm: Tensor, caplog: pytest.LogCaptureFixture) -> None:
    _, _, guard = make(1)
    with caplog.at_level(logging.WARNING):
        assert not guard.good(41, ("a", "b"), loss, norm)
    assert "step 41 skipped" in caplog.text
    assert "a, b" in caplog.text


def test_stops_after_ten_in_a_row_not_after_ten() -> None:
    _, _, guard = make(1)
    for step in range(3 * MAX_BAD_STEPS):
        guard.good(step, (), GOOD if step % MAX_BAD_STEPS == 0 else BAD, GOOD)
    guard.good(0, (), GOOD, GOOD)
    for step in range(MAX_BAD_STEPS - 1):
        guard.good(step, (), BAD, GOOD)
    with pytest.raises(TrainingError, match=r"10 steps in a row.*lower --lr"):
        guard.good(9, ("x",), BAD, GOOD)


def test_puts_back_the_statistics_that_a_bad_step_spoiled() -> None:
    network, _, guard = make(1)
    network(torch.randn(4, 2))
    kept = {name: buffer.clone() for name, buffer in network.named_buffers()}
    guard.good(0, (), GOOD, GOOD)
    network(torch.full((4, 2), float("nan")))
    guard.good(1, (), BAD, BAD)
    torch.testing.assert_close(dict(network.named_buffers()), kept)
    network(torch.randn(4, 2))
    learned = {name: buffer.clone() for name, buffer in network.named_buffers()}
    assert guard.good(2, (), GOOD, GOOD)  # the bad step is done with
    torch.testing.assert_close(dict(network.named_buffers()), learned)


def test_without_waiting_the_optimiser_skips_by_itself() -> None:
    network, optimiser, guard = make(4)
    weight = network.weight.detach().clone()
    for step in range(3):
        network.weight.grad = torch.full_like(network.weight, float("nan"))
        assert guard.good(step, (), BAD, BAD)
        optimiser.step()
        torch.testing.assert_close(network.weight.detach(), weight)
    network.weight.grad = torch.ones_like(network.weight)
    assert guard.good(3, (), GOOD, GOOD)
    optimiser.step()
    assert guard.bad_steps == 0
    assert bool((network.weight < weight).all())


def test_without_waiting_a_bad_step_that_is_looked_at_was_skipped_by_itself() -> None:
    _, _, guard = make(2)
    assert guard.good(0, (), GOOD, GOOD)
    assert guard.good(1, (), BAD, GOOD)
    assert guard.bad_steps == 1


def test_an_average_that_has_followed_a_bad_step_is_put_back_too() -> None:
    network = nn.BatchNorm1d(2)
    average = nn.BatchNorm1d(2)
    optimiser = build_optimiser([network], lr=0.1, betas=(0.9, 0.99), weight_decay=0.0)
    guard = FiniteGuard([network, average], optimiser, 3)
    kept = {name: buffer.clone() for name, buffer in average.named_buffers()}
    for step, loss in enumerate((GOOD, BAD, GOOD)):
        network(torch.full((4, 2), float("nan")) if loss is BAD else torch.randn(4, 2))
        assert guard.good(step, (), loss, loss)
        average.load_state_dict(network.state_dict())
    torch.testing.assert_close(dict(network.named_buffers()), kept)
    guard.look()
    average.load_state_dict(network.state_dict())
    assert all(buffer.isfinite().all() for buffer in average.buffers())
