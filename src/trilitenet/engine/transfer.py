"""Starting from other weights, and keeping parts as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import torch
from torch import nn

from trilitenet.errors import ConfigError, did_you_mean, few
from trilitenet.models.detection import DetectionHead

__all__ = ["TransferReport", "check_frozen", "freeze", "initialise", "keep_frozen", "order_classes"]


LEAST_SHARE: Final = 0.25
"""Initial weights that fit less of a network than this are another's: what they have in common is chance."""


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
        ConfigError: If less than `LEAST_SHARE` of the network's parameters would be taken over; nothing is then.
    """
    ours, theirs = network.state_dict(), source.state_dict()
    loaded, misshapen, missing = [], [], []
    for name, tensor in ours.items():
        if name not in theirs:
            missing.append(name)
        elif theirs[name].shape != tensor.shape:
            misshapen.append(name)
        else:
            loaded.append(name)
    sizes = {name: parameter.numel() for name, parameter in network.named_parameters()}
    fitting, total = sum(sizes.get(name, 0) for name in loaded), sum(sizes.values())
    if fitting < LEAST_SHARE * total:
        raise ConfigError(
            f"{fitting:,} of {total:,} parameters of the initial weights fit this network; are they of another variant?"
        )
    for name in loaded:
        ours[name].copy_(theirs[name])
    surplus = [name for name in theirs if name not in ours]
    return TransferReport(tuple(loaded), tuple(misshapen), tuple(missing), tuple(surplus))


@torch.no_grad()
def order_classes(head: DetectionHead, names: Sequence[str], wanted: Sequence[str]) -> None:
    """Put the classes of a detection head in another order.

    Args:
        head: The head.
        names: Its classes, each once.
        wanted: The same classes in the order to put them in.
    """
    order = [*range(5), *(5 + names.index(name) for name in wanted)]  # box and objectness stay
    for parameter in head.parameters():  # (anchors x (5 + classes), ...) each
        rows = parameter.unflatten(0, (-1, len(order)))
        parameter.copy_(rows[:, order].flatten(0, 1))


def check_frozen(network: nn.Module, other: nn.Module, parts: Sequence[str]) -> None:
    """Refuse to freeze what begins at random: neither taken over from other weights nor set by what built the network.

    Args:
        network: The network.
        other: One made in the same way from another random state.
        parts: Module names, as for `freeze`.

    Raises:
        ConfigError: If the two differ in one of the parts, or if there is no such part.
    """
    for part in parts:
        ours, theirs = (dict(_part(one, part).named_parameters()) for one in (network, other))
        if random := [name for name, parameter in ours.items() if not torch.equal(parameter, theirs[name])]:
            raise ConfigError(
                f"--freeze {part}: {len(random)} of its {len(ours)} tensors would stay as they begin, at random "
                f"({few(random)}); give weights that have them with --init, or leave the part out of --freeze"
            )


def freeze(network: nn.Module, parts: Sequence[str]) -> None:
    """Exclude parts from training.

    Args:
        network: The network.
        parts: Module names, for example ``"encoder"`` or ``"encoder.level1"``.

    Raises:
        ConfigError: If there is no such part.
    """
    for part in parts:
        _part(network, part).requires_grad_(False)


def keep_frozen(network: nn.Module, parts: Sequence[str]) -> None:
    """Put frozen parts in evaluation mode, so that their statistics stay too."""
    for part in parts:
        _part(network, part).eval()


def _part(network: nn.Module, name: str) -> nn.Module:
    modules: dict[str, nn.Module] = dict(network.named_modules())
    if name and name in modules:
        return modules[name]
    within = name
    while within not in modules:
        within = within.rpartition(".")[0]
    wrong = name.removeprefix(within).lstrip(".").partition(".")[0]
    known = [part for part, _ in modules[within].named_children()]
    of = f" of {within}" if within else ""
    raise ConfigError(f"no part {wrong!r}{of} to freeze{did_you_mean(wrong, known)}")
