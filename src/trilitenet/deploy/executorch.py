"""The deploy graph as an ExecuTorch program (``.pte``) for XNNPACK; card and description are methods without inputs.

The graph is the portable one (float planes of 0 .. 255 in, mask logits out), for one size. Boxes are decoded inside.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator

import torch

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.graph import DeployGraph, Traceable
from trilitenet.deploy.quiet import quiet
from trilitenet.errors import BackendError, import_extra

__all__ = ["build_executorch"]


def build_executorch(graph: DeployGraph, card: ModelCard, info: ArtefactInfo) -> bytes:
    """Lower the deploy graph; what XNNPACK does not know stays on ExecuTorch's own kernels.

    Args:
        graph: The deploy graph, planar and with mask logits.
        card: What the network is.
        info: How the artefact takes pixels and returns results: of a fixed size.

    Returns:
        Content of the ``.pte``.

    Raises:
        MissingExtraError: If ExecuTorch is not installed.
        BackendError: If it cannot lower the graph.
    """
    with quiet(), _uncollected():
        exir = import_extra("executorch.exir", "executorch")
        folding = import_extra("executorch.exir.passes.constant_prop_pass", "executorch")
        xnnpack = import_extra("executorch.backends.xnnpack.partition.xnnpack_partitioner", "executorch")
        traceable = Traceable(graph, card, info)
        try:
            with torch.no_grad():
                program = torch.export.export(traceable, (traceable.image,)).run_decompositions({})
            lowered = exir.to_edge_transform_and_lower(
                folding.constant_prop_pass(program),  # the grids and anchors of the decoding
                partitioner=[xnnpack.XnnpackPartitioner()],
                constant_methods={CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()},
            )
            return bytes(lowered.to_executorch().buffer)
        except Exception as error:  # its passes raise what they like
            raise BackendError(
                f"ExecuTorch cannot lower the deploy graph ({' '.join(str(error).split())[:160]})"
            ) from error


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Inside, no garbage is looked for, which takes a third of the time of lowering and finds next to none."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
