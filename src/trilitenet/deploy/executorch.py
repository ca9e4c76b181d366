"""The deploy graph as an ExecuTorch program (``.pte``) for XNNPACK; card and description are methods without inputs.

Its SHA-256 stands after the program, which ExecuTorch leaves unread; a further method says that it must stand there.

The graph is the portable one (float planes of 0 .. 255 in, mask logits out), for one size. Boxes are decoded inside.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch
import torch.fx.config
import torch.fx.traceback
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.graph import DeployGraph, Traceable
from trilitenet.deploy.quantize import kept_nodes
from trilitenet.deploy.quiet import quiet
from trilitenet.errors import BackendError, gist, import_extra

__all__ = ["build_executorch"]


def build_executorch(
    graph: DeployGraph,
    card: ModelCard,
    info: ArtefactInfo,
    images: Sequence[NDArray[Any]] = (),
    keep: Sequence[str] = (),
) -> bytes:
    """Lower the deploy graph; what XNNPACK does not know stays on ExecuTorch's own kernels.

    Args:
        graph: The deploy graph, planar and with mask logits.
        card: What the network is.
        info: How the artefact takes pixels and returns results: of a fixed size.
        images: Inputs of the artefact, each with a leading 1, to calibrate INT8 with; without them it is not quantised.
        keep: Parts that INT8 leaves in floating point, see `trilitenet.deploy.quantize.KEEP_STEPS`.

    Returns:
        Content of the ``.pte``.

    Raises:
        MissingExtraError: If ExecuTorch is not installed.
        BackendError: If it cannot lower the graph.
    """
    with quiet(), _uncollected(), _unrecorded():
        exir = import_extra("executorch.exir", "executorch")
        xnnpack = import_extra("executorch.backends.xnnpack.partition.xnnpack_partitioner", "executorch")
        traceable = Traceable(graph, card, info)
        try:
            with torch.no_grad():
                program = torch.export.export(traceable, (traceable.image,))
                if images:
                    program = torch.export.export(_quantised(program, images, keep), (traceable.image,))
                program = program.run_decompositions({})
            lowered = exir.to_edge_transform_and_lower(
                _folded(program),
                partitioner=[xnnpack.XnnpackPartitioner()],
                constant_methods={
                    CARD_KEY: card.to_json(),
                    ARTEFACT_KEY: info.to_json(),
                    GRAPH_HASH_KEY: "after the program",
                },
            )
            made = bytes(lowered.to_executorch().buffer)
            return made + f"\n{GRAPH_HASH_KEY} {hashlib.sha256(made).hexdigest()}".encode()
        except Exception as error:  # its passes raise what they like
            raise BackendError(f"ExecuTorch cannot lower the deploy graph ({gist(error)})") from error


def _folded(program: Any) -> Any:
    """Return an exported program with the grids and anchors of the decoding computed; weights of INT8 stay so."""
    folding = import_extra("executorch.exir.passes.constant_prop_pass", "executorch")
    return folding.constant_prop_pass(program, custom_skip_targets=set(folding._QUANT_PRIMITIVES))


def _quantised(program: Any, images: Sequence[NDArray[Any]], keep: Sequence[str]) -> Any:
    """Return the module of an exported program with static INT8: weights symmetric a channel, activations a tensor.

    Depthwise convolutions stay in floating point.
    """
    xnnpack = import_extra("executorch.backends.xnnpack.quantizer.xnnpack_quantizer", "executorch")
    pt2e = import_extra("torchao.quantization.pt2e.quantize_pt2e", "executorch")

    class Quantizer(xnnpack.XNNPACKQuantizer):  # type: ignore[misc, name-defined]
        def annotate(self, model: torch.fx.GraphModule) -> torch.fx.GraphModule:
            """Mark what is quantised: all but depthwise convolutions, which cost points of AP50, and what is kept.

            The quantiser's own filter of modules forgets concatenations: boxes and scores would share a scale.
            """
            model = super().annotate(model)
            for node in model.graph.nodes:
                modules = (path for path, _ in node.meta.get("nn_module_stack", {}).values())
                groups = node.args[6] if str(node.target) == "aten.conv2d.default" and len(node.args) > 6 else 1
                if groups > 1 or kept_nodes(["/".join(modules).replace(".", "/")], keep):
                    node.meta.pop("quantization_annotation", None)
            return model

    quantizer = Quantizer().set_global(xnnpack.get_symmetric_quantization_config(is_per_channel=True))
    module = pt2e.prepare_pt2e(program.module(), quantizer)
    for image in images:
        module(torch.from_numpy(image))
    return pt2e.convert_pt2e(module)


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


@contextlib.contextmanager
def _unrecorded() -> Iterator[None]:
    """Inside, nodes of graphs are made without a note of the lines of Python that made them, a fifth of the time.

    Of which nodes they are made stays noted; those notes, which nothing changes, are shared instead of copied.
    """
    config, source = torch.fx.config, torch.fx.traceback.NodeSource
    before = config.do_not_emit_stack_traces
    config.do_not_emit_stack_traces = True
    source.__deepcopy__ = lambda self, memo: self
    try:
        yield
    finally:
        config.do_not_emit_stack_traces = before
        del source.__deepcopy__
