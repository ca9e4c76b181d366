"""Starting from other weights, and keeping parts as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import nn

from trilitenet.errors import ConfigError, did_you_mean

__all__ = ["TransferReport", "freeze", "initialise", "keep_frozen"]


@dataclasses.dataclass(frozen=True)
class TransferReport:
    """What was taken over from other weights, by tensor name.

    Attributes:
        loaded: Tensors taken over.
        misshapen: Tensors in both, of another shape; they start anew.
        missing: Tensors the weights lack; they start anew.
        surplus: Tensors of the weights that the network has no place for.
    """

    loaded: tuple[str, ...]
    misshapen: tuple[str, ...]
    missing: tuple[str, ...]
    surplus: tuple[str, ...]

    def summary(self) -> str:
        """Return what was loaded, and every tensor that was not."""
        lines = [f"{len(self.loaded)} tensors taken over"]
        for what in ("misshapen", "missing", "surplus"):
            names = getattr(self, what)
            if names:
                lines.append(f"{what}: {', '.join(names)}")
        return "; ".join(lines)


@torch.no_grad()
def initialise(network: nn.Module, source: nn.Module) -> TransferReport:
    """Take over from ``source`` every tensor that fits by name and shape.

    Raises:
        ConfigError: If nothing fits.
    """
    ours, theirs = network.state_dict(), source.state_dict()
    loaded, misshapen, missing = [], [], []
    for name, tensor in ours.items():
        if name not in theirs:
            missing.append(name)
        elif theirs[name].shape != tensor.shape:
            misshapen.append(name)
        else:
            tensor.copy_(theirs[name])
            loaded.append(name)
    if not loaded:
        raise ConfigError("no tensor of the initial weights fits this network; is it another variant?")
    surplus = [name for name in theirs if name not in ours]
    return TransferReport(tuple(loaded), tuple(misshapen), tuple(missing), tuple(surplus))


def freeze(network: nn.Module, parts: Sequence[str]) -> int:
    """Exclude parts from training.

    Args:
        network: The network.
        parts: Module names, for example ``"encoder"`` or ``"encoder.level1"``.

    Returns:
        The number of frozen parameters.

    Raises:
        ConfigError: If there is no such part.
    """
    count = 0
    for part in parts:
        for parameter in _part(network, part).parameters():
            parameter.requires_grad_(False)
            count += parameter.numel()
    return count


def keep_frozen(network: nn.Module, parts: Sequence[str]) -> None:
    """Put frozen parts in evaluation mode, so that their statistics stay too."""
    for part in parts:
        _part(network, part).eval()


def _part(network: nn.Module, name: str) -> nn.Module:
    modules: dict[str, nn.Module] = dict(network.named_modules())
    if not name or name not in modules:
        raise ConfigError(f"no part {name!r} to freeze{did_you_mean(name, [n for n in modules if n])}")
    return modules[name]
