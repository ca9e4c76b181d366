from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import nn

from trilitenet.engine.optim import Schedule, build_optimiser, parameter_groups
from trilitenet.errors import ConfigError


def test_warm_up_then_cosine_to_the_final_rate() -> None:
    schedule = Schedule(steps=100, warmup=10, lr=0.001, final=0.2)
    rates = [schedule.rate(step) for step in range(101)]
    assert rates[0] == pytest.approx(0.0001)
    assert max(rates) == pytest.approx(rates[10], rel=0.03)
    assert rates[50] == pytest.approx(0.001 * (0.2 + 0.8 * 0.5))
    assert rates[100] == schedule.rate(150) == pytest.approx(0.0002)
    assert all(later < earlier for earlier, later in itertools.pairwise(rates[10:]))


@pytest.mark.parametrize("steps", [100, 1000])
def test_a_run_that_is_all_warm_up_never_has_the_initial_rate(steps: int) -> None:
    schedule = Schedule(steps, warmup=steps, lr=1.0, final=0.2)
    assert 0.30 < max(map(schedule.rate, range(steps))) < 0.31


def test_stairs_keep_the_rate_within_an_epoch() -> None:
    schedule = Schedule(steps=100, warmup=0, lr=1.0, final=0.2, stair=25)
    assert schedule.rate(24) == schedule.rate(0) == 1.0
    assert schedule.rate(25) == pytest.approx(0.2 + 0.8 * (1 + math.cos(math.pi / 4)) / 2)


def test_only_weights_decay_unless_told() -> None:
    module = nn.Sequential(nn.Conv2d(2, 3, 1), nn.BatchNorm2d(3), nn.PReLU(3), nn.Linear(3, 2))
    decayed, free = parameter_groups([module], 0.1)
    assert [p.shape for p in decayed["params"]] == [(3, 2, 1, 1), (2, 3)]
    assert len(free["params"]) == 5
    assert (decayed["weight_decay"], free["weight_decay"]) == (0.1, 0.0)
    (group,) = parameter_groups([module], 0.1, decay_all=True)
    assert len(group["params"]) == 7


def test_apply_sets_every_group() -> None:
    module = nn.Sequential(nn.Conv2d(2, 3, 1), nn.BatchNorm2d(3))
    optimiser = build_optimiser([module], lr=1.0, betas=(0.9, 0.99), weight_decay=0.1)
    rate = Schedule(10, 0, 0.5, 0.1).apply(optimiser, 5)
    assert {group["lr"] for group in optimiser.param_groups} == {rate}
    assert rate == pytest.approx(0.5 * 0.55)


def test_a_wholly_frozen_network_is_refused() -> None:
    with pytest.raises(ConfigError, match="every part is frozen"):
        build_optimiser([nn.Conv2d(1, 1, 1).requires_grad_(False)], lr=1.0, betas=(0.9, 0.99), weight_decay=0.0)


def test_the_fused_step_equals_the_plain_one() -> None:
    torch.manual_seed(0)
    fused, plain = nn.Linear(4, 4), nn.Linear(4, 4)
    plain.load_state_dict(fused.state_dict())
    ours = build_optimiser([fused], lr=0.1, betas=(0.9, 0.99), weight_decay=0.1)
    theirs = torch.optim.AdamW(parameter_groups([plain], 0.1), lr=0.1, betas=(0.9, 0.99), foreach=False)
    x = torch.randn(8, 4)
    for _ in range(3):
        for module, optimiser in ((fused, ours), (plain, theirs)):
            optimiser.zero_grad()
            module(x).square().mean().backward()
            optimiser.step()
    torch.testing.assert_close(dict(fused.named_parameters()), dict(plain.named_parameters()))
