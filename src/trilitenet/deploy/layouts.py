"""Which layout suits which runtime and processor, as measured (docs/speed.md)."""

from __future__ import annotations

from typing import Final

from trilitenet.deploy.layers import Layout
from trilitenet.errors import ConfigError, did_you_mean

__all__ = ["LAYOUTS", "pick_layout"]

LAYOUTS: Final[dict[str, Layout]] = {
    "wide": Layout(front=2, half=2, split=True),
    "heads": Layout(half=2),
    "pixels": Layout(),
    "planar": Layout(channels_last=False),
    "planar-maximum": Layout(channels_last=False, maximum=True),
}
"""Layouts by name: pixels in 2x2 blocks at 1/2 everywhere, in the heads, nowhere; and (B, C, H, W) throughout."""


def pick_layout(name: str, variant: str, runtime: str, *, amx: bool) -> Layout:
    """Return a layout.

    Args:
        name: A key of `LAYOUTS`, or ``"auto"``.
        variant: ``"tiny"``, ``"small"`` or ``"base"``.
        runtime: ``"openvino"``, ``"onnxruntime"``, or another, which gets the planar one.
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
        return LAYOUTS["planar-maximum"]
    if runtime != "openvino":
        return LAYOUTS["planar"]
    if amx:
        return Layout(half=2, split=True) if variant == "base" else LAYOUTS["wide"]
    return LAYOUTS["heads" if variant == "tiny" else "pixels"]
