"""Which layout suits which runtime and processor, as measured (docs/speed.md)."""

from __future__ import annotations

from typing import Final

from trilitenet.deploy.layers import Layout
from trilitenet.errors import ConfigError, did_you_mean

__all__ = ["LAYOUTS", "pick_layout"]

LAYOUTS: Final[dict[str, Layout]] = {
    "wide": Layout(front=2, quarter=2, half=2, split=True),
    "heads": Layout(half=2),
    "heads-split": Layout(half=2, split=True),
    "pixels": Layout(),
    "planar": Layout(channels_last=False),
    "planar-maximum": Layout(channels_last=False, maximum=True),
    "planar-maximum-heads": Layout(channels_last=False, maximum=True, half=2, split=True),
    "planar-maximum-split": Layout(channels_last=False, maximum=True, split=True),
}
"""Layouts by name: pixels in 2x2 blocks everywhere, in the heads, nowhere; and (B, C, H, W) throughout."""


def pick_layout(name: str, variant: str, runtime: str, *, amx: bool) -> Layout:
    """Return a layout.

    Args:
        name: A key of `LAYOUTS`, or ``"auto"``.
        variant: ``"tiny"``, ``"small"`` or ``"base"``.
        runtime: ``"openvino"``, ``"onnxruntime"``, ``"cuda"`` (PyTorch), or another, which gets the planar one.
        amx: Whether the processor has matrix tiles. They make the 4-fold arithmetic of blocks free; without them only
            tiny, whose heads have fewer channels than a vector has lanes, gains from blocks.

    Raises:
        ConfigError: If the name is unknown.
    """
    if name != "auto":
        if name not in LAYOUTS:
            raise ConfigError(f"unknown layout {name!r}{did_you_mean(name, [*LAYOUTS, 'auto'])}")
        return LAYOUTS[name]
    if runtime == "onnxruntime":
        return LAYOUTS["planar-maximum-split" if variant == "base" else "planar-maximum-heads"]
    if runtime == "cuda":
        return LAYOUTS["pixels"]
    if runtime != "openvino":
        return LAYOUTS["planar"]
    if amx:
        return LAYOUTS["wide" if variant == "tiny" else "heads-split"]
    return LAYOUTS["heads" if variant == "tiny" else "pixels"]
