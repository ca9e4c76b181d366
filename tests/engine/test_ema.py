from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from trilitenet.engine.ema import MovingAverage


def test_follows_the_published_ramp() -> None:
    network = nn.BatchNorm2d(1)
    ema = MovingAverage(network, decay=0.9, ramp=10)
    expected = 1.0
    for update in range(1, 6):
        network.weight.data.fill_(float(update))
        ema.update(network)
        decay = 0.9 * (1 - math.exp(-update / 10))
        expected = decay * expected + (1 - decay) * update
    assert float(ema.network.weight) == pytest.approx(expected)  # type: ignore[arg-type]


def test_averages_statistics_and_copies_counters() -> None:
    network = nn.BatchNorm2d(1)
    ema = MovingAverage(network, decay=0.5, ramp=0)
    network.running_mean = torch.tensor([4.0])
    network.num_batches_tracked = torch.tensor(7)
    ema.update(network)
    assert float(ema.network.running_mean) == 2.0  # type: ignore[arg-type]
    assert int(ema.network.num_batches_tracked) == 7  # type: ignore[arg-type]


def test_state_goes_round() -> None:
    network = nn.Linear(2, 2)
    ema = MovingAverage(network, decay=0.5, ramp=3)
    network.weight.data.add_(1)
    ema.update(network)
    other = MovingAverage(nn.Linear(2, 2), decay=0.5, ramp=3)
    other.load_state_dict(ema.state_dict())
    for average in (ema, other):
        average.update(network)
    torch.testing.assert_close(ema.network.state_dict(), other.network.state_dict(), rtol=0, atol=0)
    assert other.updates == 2


def test_is_apart_from_the_network() -> None:
    network = nn.Linear(2, 2)
    ema = MovingAverage(network)
    assert not ema.network.training
    assert not any(parameter.requires_grad for parameter in ema.network.parameters())
    network.weight.data.fill_(9)
    assert float(ema.network.weight.max()) < 9  # type: ignore[operator]


def test_goes_on_after_a_change_of_memory_format() -> None:
    """Validation lays the average out channels-last, which gives (C, 1, 1, 1) weights new tensors."""
    network = nn.Conv2d(4, 4, 1, groups=4, bias=False)
    ema = MovingAverage(network, decay=0.5, ramp=0)
    ema.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    (average,) = ema.network.parameters()
    before = average.clone()
    network.weight.data.add_(1)
    ema.update(network)
    torch.testing.assert_close(next(ema.network.parameters()), before + 0.5)
