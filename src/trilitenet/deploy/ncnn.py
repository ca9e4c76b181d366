"""The deploy graph as NCNN's ``.param`` and ``.bin``, by way of pnnx, with a JSON file for the same metadata.

NCNN has no integer images: the graph is the portable one (float planes of 0 .. 255 in, mask logits out), for one size.
Boxes are decoded inside. The ``.param`` holds nothing that plain NCNN does not know; input and outputs go by name.
"""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
from pathlib import Path
from typing import Final, NamedTuple

import torch

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, WEIGHTS_HASH_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.graph import DeployGraph, Traceable
from trilitenet.deploy.quiet import quiet
from trilitenet.errors import BackendError, gist, import_extra, scratch_folder

__all__ = ["NcnnModel", "build_ncnn", "save_ncnn"]

_MAGIC: Final = "7767517"


class NcnnModel(NamedTuple):
    """A converted graph.

    Attributes:
        param: The layers, as NCNN reads them.
        weights: Content of the ``.bin``.
    """

    param: str
    weights: bytes


def build_ncnn(graph: DeployGraph, card: ModelCard, info: ArtefactInfo) -> NcnnModel:
    """Convert the deploy graph.

    Args:
        graph: The deploy graph, planar and with mask logits.
        card: What the network is.
        info: How the artefact takes pixels and returns results: of a fixed size; fp16 stores weights as such.

    Raises:
        MissingExtraError: If pnnx is not installed.
        BackendError: If pnnx cannot convert the graph.
        OutputError: If there is no room for temporary files.
    """
    assert info.size is not None
    pnnx = import_extra("pnnx", "ncnn")
    traceable = Traceable(graph, card, info)
    with scratch_folder() as folder:
        traced = io.BytesIO()  # PyTorch aborts the process where it cannot write to a file
        with quiet(), torch.no_grad():  # a trace is what pnnx reads; PyTorch would rather it read something newer
            torch.jit.save(torch.jit.trace(traceable, (traceable.image,), check_trace=False), traced)
        (folder / "graph.pt").write_bytes(traced.getvalue())
        command = [
            pnnx.EXEC_PATH,
            "graph.pt",
            f"inputshape=[{','.join(map(str, traceable.image.shape))}]",
            f"fp16={int(info.precision == 'fp16')}",
        ]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
        except OSError as error:
            raise BackendError(f"pnnx does not run here ({error})") from error
        param, weights = folder / "graph.ncnn.param", folder / "graph.ncnn.bin"
        if done.returncode or not param.is_file() or not weights.is_file():
            said = gist((done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()[-1])
            raise BackendError(f"pnnx cannot convert the deploy graph (exit status {done.returncode}: {said})")
        names = {"in0": "image"} | {f"out{index}": task for index, task in enumerate(card.tasks)}
        return NcnnModel(_rename_blobs(param.read_text(encoding="utf-8"), names), weights.read_bytes())


def save_ncnn(model: NcnnModel, path: Path, card: ModelCard, info: ArtefactInfo) -> None:
    """Write ``.param``, ``.bin`` and ``.json`` side by side.

    Args:
        model: What `build_ncnn` returned.
        path: The ``.param`` file.
        card: What the network is.
        info: How the artefact takes pixels and returns results.
    """
    graph = model.param.encode()
    path.write_bytes(graph)
    path.with_suffix(".bin").write_bytes(model.weights)
    metadata = {
        CARD_KEY: json.loads(card.to_json()),
        ARTEFACT_KEY: json.loads(info.to_json()),
        GRAPH_HASH_KEY: hashlib.sha256(graph).hexdigest(),
        WEIGHTS_HASH_KEY: hashlib.sha256(model.weights).hexdigest(),
    }
    path.with_suffix(".json").write_text(json.dumps(metadata, indent=2) + "\n", encoding="utf-8")


def _rename_blobs(param: str, names: dict[str, str]) -> str:
    """Rename blobs in NCNN's text: a line a layer, of type, name, counts of inputs and outputs, these, options.

    Raises:
        BackendError: If a layer is one of pnnx's own, which it could not express in NCNN's.
    """
    magic, counts, *layers = param.splitlines()
    if magic != _MAGIC:
        raise BackendError(f"pnnx wrote a .param of another layout ({magic[:20]!r})")
    lines = [magic, counts]
    for layer in layers:
        kind, name, inputs, outputs, *rest = layer.split()
        if "." in kind:
            raise BackendError(f"pnnx cannot express {kind} of the deploy graph in NCNN's layers; leave --layout alone")
        end = int(inputs) + int(outputs)
        blobs = [names.get(blob, blob) for blob in rest[:end]]
        lines.append(" ".join([f"{kind:<24} {name:<24} {inputs} {outputs}", *blobs, *rest[end:]]))
    return "\n".join(lines) + "\n"
