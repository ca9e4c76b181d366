"""The mean of two networks: what fine-tuning gains with less of what it loses."""

from __future__ import annotations

import torch

from trilitenet.errors import ConfigError, WeightsError
from trilitenet.models.trilitenet import TriLiteNet

__all__ = ["average_networks"]

_COMMON = ("variant", "class_names", "tasks", "blocks", "mean", "std", "anchors")
"""What the cards of both must agree in."""


def average_networks(first: TriLiteNet, second: TriLiteNet, share: float) -> TriLiteNet:
    """Turn a network into the mean of itself and the one it was fine-tuned from, statistics of batches included.

    Wortsman et al., "Robust fine-tuning of zero-shot models" (2022). The mean of networks of which neither was trained
    from the other, nor both from a third, is worth nothing.

    Args:
        first: The network before; it is not changed.
        second: The network after, at the same input size or another; it becomes the mean, and keeps its card.
        share: Of the second, 0 to 1.

    Returns:
        ``second``.

    Raises:
        ConfigError: If the share is not within 0 and 1.
        WeightsError: If the two differ in variant, classes, tasks, parts, anchors, mean, std or layers.
    """
    if not 0 <= share <= 1:
        raise ConfigError(f"share must be 0 to 1, got {share:g}")
    for name in _COMMON:
        before, after = (getattr(network.card, name) for network in (first, second))
        if before != after:
            raise WeightsError(f"no mean of two networks that differ in {name}: {before} and {after}")
    old, new = first.state_dict(), second.state_dict()
    if old.keys() != new.keys() or any(old[key].shape != new[key].shape for key in new):
        raise WeightsError("no mean of two networks that differ in their layers")
    with torch.no_grad():
        for key, value in new.items():
            if value.is_floating_point():
                value.lerp_(old[key], 1 - share)
    return second
