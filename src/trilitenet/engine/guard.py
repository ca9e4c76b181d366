"""What to do about steps whose loss or gradient is not finite: skip them, say so, give up after ten in a row."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn

from trilitenet.errors import TrainingError

__all__ = ["MAX_BAD_STEPS", "FiniteGuard"]

_LOGGER: Final = logging.getLogger(__name__)

MAX_BAD_STEPS: Final = 10
"""So many steps in a row without a finite loss and gradient end the run."""


class FiniteGuard:
    """Watches the steps of a run.

    Whether a step was bad is a tensor on the device, read once in ``interval`` steps, so that a GPU is not waited for;
    until then the fused optimiser itself leaves out bad steps (``found_inf``). A bad step's forward pass also spoils
    the running statistics of batch normalisation, and those of a moving average that follows: they are put back to what
    they were when last found good.

    Args:
        networks: Whose buffers are kept: what is trained, and what follows it.
        optimiser: A fused one if ``interval`` is above 1.
        interval: Steps between looks.
    """

    def __init__(self, networks: Sequence[nn.Module], optimiser: torch.optim.Optimizer, interval: int = 1) -> None:
        self.bad_steps = 0
        self._buffers = [buffer for network in networks for buffer in network.buffers()]
        self._kept = [buffer.clone() for buffer in self._buffers]
        self._optimiser = optimiser
        self._interval = interval
        self._flags: list[tuple[int, tuple[str, ...], Tensor]] = []

    def good(self, step: int, names: tuple[str, ...], loss: Tensor, norm: Tensor) -> bool:
        """Return whether the optimiser may step.

        Args:
            step: Of the run, for the report.
            names: The batch's images, for the report.
            loss: 0-dim.
            norm: 0-dim, of the gradient.

        Raises:
            TrainingError: After ten bad steps in a row.
        """
        bad = ~(torch.isfinite(loss.detach()) & torch.isfinite(norm))
        self._flags.append((step, names, bad))
        if self._interval > 1:
            self._optimiser.found_inf = bad.float()  # type: ignore[attr-defined]
        if len(self._flags) >= self._interval:
            return self.look()
        return True

    def look(self) -> bool:
        """Read the flags so far; return whether the last step was good."""
        last = True
        any_bad = False
        for step, names, flag in self._flags:
            last = not bool(flag)
            if last:
                self.bad_steps = 0
                continue
            any_bad = True
            self.bad_steps += 1
            shown = ", ".join(names)
            _LOGGER.warning("step %d skipped: its loss or gradient is not finite (images: %s)", step, shown)
            if self.bad_steps >= MAX_BAD_STEPS:
                raise TrainingError(
                    f"loss or gradient not finite for {MAX_BAD_STEPS} steps in a row, the last being step {step} "
                    f"(images: {shown}); lower --lr, or train with --precision 32-true"
                )
        self._flags.clear()
        if any_bad:
            torch._foreach_copy_(self._buffers, self._kept)
        else:
            torch._foreach_copy_(self._kept, self._buffers)
        return last or self._interval > 1
