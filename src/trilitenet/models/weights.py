"""Weight files: safetensors with their card inside, and the one-way import of published checkpoints.

A file is read strictly: a missing, surplus or misshapen tensor is an error, never a silent random layer.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import pickle
import pickletools
import re
import struct
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from trilitenet.config import (
    ARTEFACT_SUFFIXES,
    CARD_KEY,
    STRIDES,
    VARIANTS,
    ModelCard,
    check_anchors,
    check_tasks,
    get_variant,
    shipped_weights,
)
from trilitenet.errors import ConfigError, OutputError, WeightsError, few, replacing
from trilitenet.models.builders import Builder, build_by, name_of
from trilitenet.models.trilitenet import TriLiteNet, build_network, foreign_layers

__all__ = [
    "import_published",
    "load_network",
    "read_builder",
    "read_card",
    "resolve_weights",
    "save_network",
]


_RENAMES: Final = (
    (r"model\.0\.level2_0\.c1\.conv\.", "encoder.level2_down.reduce."),
    (r"model\.0\.level3_0\.c1\.conv\.", "encoder.level3_down.reduce."),
    (r"model\.0\.level([23])_0\.(d\d+)\.conv\.", r"encoder.level\1_down.\2."),
    (r"model\.0\.level([23])_0\.", r"encoder.level\1_down."),
    (r"model\.0\.level([23])\.(\d+)\.c1\.", r"encoder.level\1.\2.reduce."),
    (r"model\.0\.level([23])\.(\d+)\.bn\.", r"encoder.level\1.\2.bn_act."),
    (r"model\.0\.", "encoder."),
    (r"model\.1\.cbr1\.", "encoder.c4."),
    (r"model\.1\.cbr2\.", "encoder.c5."),
    (r"model\.1\.spp\.cv1\.", "spp.reduce."),
    (r"model\.1\.spp\.cv2\.", "spp.expand."),
    (r"model\.1\.fpn\.lateral_convs\.", "litepan.laterals."),
    (r"model\.1\.fpn\.output_convs\.", "litepan.top_down."),
    (r"model\.1\.pan\.bottom_up_convs\.", "litepan.bottom_up."),
    (r"model\.1\.pan\.smooth_convs\.", "litepan.smooth."),
    (r"model\.2\.m\.", "detection.convs."),
    (r"model\.3\.caam\.conv_cam\.", "pcaa.class_maps."),
    (r"model\.3\.caam\.gcn\.conv1\.", "pcaa.graph.nodes."),
    (r"model\.3\.caam\.gcn\.relu\.", "pcaa.graph.act."),
    (r"model\.3\.caam\.gcn\.conv2\.", "pcaa.graph.channels."),
    (r"model\.3\.caam\.proj_(query|key|value)\.", r"pcaa.\1."),
    (r"model\.3\.caam\.conv_out\.", "pcaa.out."),
    (r"model\.3\.caam\.relu\.", "pcaa.fuse_act."),
    (r"model\.3\.caam\.fuse\.", "pcaa.fuse."),
    (r"model\.3\.conv_caam\.", "reduce."),
    (r"model\.3\.up_([12])_da\.up_conv\.", r"drivable.up\1.up."),
    (r"model\.3\.up_([12])_ll\.up_conv\.", r"lane.up\1.up."),
    (r"model\.3\.up_([12])_da\.", r"drivable.up\1."),
    (r"model\.3\.up_([12])_ll\.", r"lane.up\1."),
    (r"model\.4\.", "drivable.out."),
    (r"model\.5\.", "lane.out."),
)
"""Published key prefixes and ours; the first match wins."""

_ANCHOR_KEYS: Final = ("model.2.anchors", "model.2.anchor_grid")
"""Published keys of the anchors: in cells, and in pixels."""

_FOREIGN_KEY: Final = "trilitenet.foreign_layers"
"""Key, in a file's metadata, of the layers that `build_network` does not make; absent where there are none."""

_NETWORK_KEY: Final = "trilitenet.network"
"""Key, in a file's metadata, of the name of the function that built the network; absent for `build_network`."""

_UNREADABLE: Final = (
    RuntimeError, EOFError, OSError, ValueError, KeyError, IndexError, AttributeError, TypeError, AssertionError,
    struct.error,
)  # fmt: skip
"""What PyTorch raises, beside `pickle.UnpicklingError`, of a file that is no checkpoint, cut or damaged."""

_LONGEST_HEADER: Final = 100_000_000
"""Bytes of a safetensors file's header, which the format limits; the file begins with their number."""

_NAMING: Final = frozenset({"GLOBAL", "STACK_GLOBAL", "INST"})
"""Opcodes of a pickle that name a function or a class."""
_PICKLES: Final = 5
"""Pickles in a row in a checkpoint of the older format: magic number, version, system, state, keys of its storages."""

_IN_ITS_PLACE: Final = {
    b"<": "a web page; download the file itself",
    b"version https://git-lfs": "a Git LFS pointer; download the file itself",
    b"{": "text; download the file itself",
    b"\x1f\x8b": "compressed; unpack it",
}
"""What is often saved in a file's place, and the cure, by how it begins, in small letters."""

_TRAINING_STATE: Final = frozenset({"schema", "config", "network", "optimiser"})
"""Keys that tell the training state of `trilitenet train` from other pickles."""


def resolve_weights(model: str | os.PathLike[str]) -> Path:
    """Return the file of a shipped name (``"tiny"``) or a path.

    Raises:
        WeightsError: If there is no such file.
    """
    shipped = shipped_weights()
    if isinstance(model, str) and model in shipped:
        return shipped[model]
    path = Path(os.fspath(model))  # whose message about another type is the same in every Python
    if path.is_file():
        return path
    if isinstance(model, str) and model in VARIANTS:
        known = ", ".join(shipped) or "none"
        raise WeightsError(f"no weights are shipped for {model!r} (shipped: {known}); give a file")
    what = "is a folder" if path.is_dir() else "does not exist"
    raise WeightsError(f"{path}: {what}; give a .safetensors file or one of: {', '.join(shipped) or 'none shipped'}")


def save_network(network: TriLiteNet, path: str | os.PathLike[str], card: ModelCard, *, half: bool = False) -> None:
    """Write weights and card to one safetensors file, atomically.

    Of a network with layers that `build_network` does not make, `load_network` must be told the function that makes it.

    Args:
        network: What to save; its anchors replace the card's.
        path: Where to; an existing file is replaced only when the new one is complete.
        card: What is known of the weights.
        half: Store floating-point tensors as fp16 (half the size).

    Raises:
        ConfigError: If the card has another number of classes than the network.
        WeightsError: If a value is not finite.
        OutputError: If the file cannot be written.
    """
    path = Path(path)
    if "detection" in network.tasks and card.classes != network.classes:
        raise ConfigError(f"{path}: the card has {card.classes} classes, the network {network.classes}")
    card = dataclasses.replace(
        card,
        variant=network.variant,
        tasks=network.tasks,
        blocks=network.blocks,
        anchors=check_anchors(network.anchors),
    )
    tensors = {}
    for name, tensor in network.state_dict().items():
        if name == "anchors" or name.endswith("num_batches_tracked"):
            continue
        data = tensor.detach().to("cpu").contiguous()
        data = data.half() if half and data.is_floating_point() else data.clone()
        if not data.isfinite().all():
            raise WeightsError(
                f"{path}: not written, {name} holds values that are not finite{' in fp16' if half else ''}"
            )
        tensors[name] = data
    metadata = {CARD_KEY: card.to_json()}  # a second entry would come before or after it by chance
    if foreign := foreign_layers(network):
        metadata[_FOREIGN_KEY] = ", ".join(foreign)
    if network.built_by is not None:
        metadata[_NETWORK_KEY] = network.built_by
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            save_file(tensors, part, metadata=metadata)
    except (OSError, SafetensorError) as error:
        raise OutputError(f"{path}: cannot write the weights ({error})") from error


def read_card(path: str | os.PathLike[str]) -> ModelCard:
    """Read the card of a safetensors file without its tensors.

    Raises:
        WeightsError: If the file is missing, broken, foreign or of a newer layout.
    """
    path = resolve_weights(path)
    card, _, _ = _open(path, tensors=False)
    return card


def read_builder(path: str | os.PathLike[str]) -> str | None:
    """Read from a safetensors file which function built its network; None for `build_network`.

    Raises:
        WeightsError: If the file is missing, broken, foreign or of a newer layout.
    """
    _, metadata, _ = _open(resolve_weights(path), tensors=False)
    return metadata.get(_NETWORK_KEY)


def load_network(path: str | os.PathLike[str], network: Builder | None = None) -> TriLiteNet:
    """Load a network from its safetensors file, in evaluation mode on the CPU.

    Args:
        path: A file, or the name of shipped weights.
        network: The function that builds the network, or its name (``"FILE.py:FUNCTION"`` or ``"MODULE:FUNCTION"``),
            where that is not `build_network`; see `trilitenet.models.builders`. It is called with what the card tells.

    Returns:
        The network, with its ``card``.

    Raises:
        WeightsError: If the file is missing, broken, foreign, of a newer layout or of a network with other layers, or
            if any tensor is missing, surplus, misshapen or not finite.
        ConfigError: If the function is missing, raises, or builds something else.
    """
    path = resolve_weights(path)
    card, metadata, tensors = _open(path, tensors=True)
    layers = metadata.get(_FOREIGN_KEY, "")
    if network is None and _NETWORK_KEY in metadata:
        name = metadata[_NETWORK_KEY]
        raise WeightsError(
            f"{path}: is of a network that {name} builds; that code is run only where it is named: network={name!r} "
            f"(--network {name})"
        )
    if network is None and layers:
        raise WeightsError(
            f"{path}: is of a network with layers that build_network does not make: {layers}; name the function that "
            "makes them: network='FILE.py:FUNCTION' (docs/network.md)"
        )
    blocks = {name: name in card.blocks for name in ("pcaa", "litepan", "spp")}
    with torch.random.fork_rng(devices=()):  # the random weights that are replaced take nothing from a seeded run
        built = build_by(
            network, card.variant, card.classes, card.tasks, size=card.input_size, anchors=card.anchors, **blocks
        )
    if network is not None and (found := ", ".join(foreign_layers(built))) != layers:
        ordinary = "no layers but those of build_network"
        raise WeightsError(
            f"{path}: is of a network with {layers or ordinary}, {name_of(network)} builds one with {found or ordinary}"
        )
    _load_strictly(built, tensors, str(path))
    built.card = card
    return built.eval()


def import_published(
    source: str | os.PathLike[str],
    destination: str | os.PathLike[str],
    variant: str | None = None,
) -> ModelCard:
    """Convert a published checkpoint (a pickled state dict) to safetensors.

    The pickle is read with ``weights_only=True``: code in it is refused, never run. Anchors are taken from the file
    (in pixels, ``model.2.anchor_grid``).

    Args:
        source: The published ``.pth`` file.
        destination: The safetensors file to write.
        variant: Guessed from the shapes if left out.

    Returns:
        The card that was written.

    Raises:
        WeightsError: If it is not such a checkpoint, is truncated, holds code, is another model's or another variant's.
        OutputError: If the destination cannot be written.
    """
    source = Path(source)
    state = _read_pickle(source)
    guessed = _guess_variant(state, source)
    if variant is not None and get_variant(variant).name != guessed:
        raise WeightsError(f"{source}: holds the {guessed} variant, not {variant}; leave --variant out or correct it")
    anchors = _published_anchors(state, source)
    classes = _published_classes(state, source)
    network = build_network(guessed, classes, anchors=anchors)
    ours: dict[str, Tensor] = {}
    foreign = []
    for key, value in state.items():
        name = rename_published(key)
        if key in _ANCHOR_KEYS:
            continue
        if name == key or name in ours:  # no published name, though it may be one of ours, or a second of one tensor
            foreign.append(key)
        else:
            ours[name] = value
    _load_strictly(network, ours, str(source), published=True, foreign=foreign)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    card = dataclasses.replace(
        network.card,
        training_data=("as stated by the publisher of the checkpoint",),
        licence="as stated by the publisher of the checkpoint",
        provenance={"imported from": source.name, "sha256": digest},
    )
    save_network(network, destination, card)
    return card


def rename_published(key: str) -> str:
    """Return our name of a published state-dict key (the key itself if it is unknown)."""
    for pattern, replacement in _RENAMES:
        renamed, count = re.subn(rf"^{pattern}", replacement, key)
        if count:
            return renamed
    return key


def _open(path: Path, *, tensors: bool) -> tuple[ModelCard, dict[str, str], dict[str, Tensor]]:
    if path.stat().st_size == 0:
        raise WeightsError(f"{path}: is empty; copy or download it again")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if CARD_KEY not in metadata:
                raise WeightsError(f"{path}: is safetensors, but has no trilitenet card; it is another model's")
            card = ModelCard.from_json(metadata[CARD_KEY], str(path))
            get_variant(card.variant)
            check_tasks(card.tasks)
            keys = list(file.keys()) if tensors else []
            return card, metadata, {key: file.get_tensor(key) for key in keys}
    except SafetensorError as error:
        if path.name.lower().endswith(tuple(ARTEFACT_SUFFIXES.values())):
            raise WeightsError(
                f"{path}: is an exported file, not weights; trilitenet.load({str(path)!r}).card tells what it is"
            ) from error
        if _is_pickle(path):
            raise WeightsError(_about_pickle(path)) from error
        raise WeightsError(f"{path}: is not a safetensors file{_what_instead(path, error)}") from error
    except ValueError as error:
        raise WeightsError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def _is_pickle(path: Path) -> bool:
    if zipfile.is_zipfile(path):
        return True
    with path.open("rb") as file:
        return file.read(2) in {b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"}


def _about_pickle(path: Path) -> str:
    """Return why a pickle is not weights, and what to do."""
    try:
        state = _load_pickle(path)
    except WeightsError:
        state = None  # the import says what is wrong with it
    if _is_training_state(state):
        return _about_training_state(path)
    return f"{path}: is a pickled checkpoint; convert it first: trilitenet weights import {path} OUT.safetensors"


def _is_training_state(state: object) -> bool:
    return isinstance(state, dict) and state.keys() >= _TRAINING_STATE


def _about_training_state(path: Path) -> str:
    return (
        f"{path}: is a training state, to --resume from; the weights are final.safetensors (once the run has ended) "
        "or best-*.safetensors beside it"
    )


def _load_strictly(
    network: TriLiteNet,
    tensors: Mapping[str, Tensor],
    source: str,
    *,
    published: bool = False,
    foreign: Sequence[str] = (),
) -> None:
    own = network.state_dict()
    optional = {key for key in own if key == "anchors" or key.endswith("num_batches_tracked")}
    missing = [key for key in own if key not in tensors and key not in optional]
    surplus = [*foreign, *(key for key in tensors if key not in own)]
    if missing or surplus:
        hint = " (it is not a TriLiteNet checkpoint)" if published and len(missing) > len(own) // 2 else ""
        wrong = [f"{what} {few(keys)}" for what, keys in (("missing", missing), ("surplus", surplus)) if keys]
        raise WeightsError(f"{source}: {'; '.join(wrong)}{hint}")
    for key, tensor in tensors.items():
        if tensor.shape != own[key].shape:
            raise WeightsError(f"{source}: {key} is {tuple(tensor.shape)}, must be {tuple(own[key].shape)}")
        if own[key].is_floating_point() and not tensor.is_floating_point():
            raise WeightsError(f"{source}: {key} is of {tensor.dtype}, must be of floating-point numbers")
        value = tensor.to(own[key].dtype)  # as it is loaded: of 8-bit floats it cannot be told
        if not torch.isfinite(value).all():
            raise WeightsError(f"{source}: {key} holds values that are not finite; the file is damaged")
        if key.endswith("running_var") and (value < 0).any():
            raise WeightsError(f"{source}: {key} holds negative variances; the file is damaged")
    network.load_state_dict({key: tensors.get(key, own[key]).to(own[key].dtype) for key in own})


def _is_safetensors(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(9)
    return head[8:] == b"{" and int.from_bytes(head[:8], "little") <= _LONGEST_HEADER


def _load_pickle(path: Path) -> Any:
    """Load what a pickle or safetensors file holds, of tensors and plain values; code is refused."""
    if not path.is_file():
        raise WeightsError(f"{path}: {'is a folder' if path.is_dir() else 'does not exist'}")
    if path.stat().st_size == 0:
        raise WeightsError(f"{path}: is empty; download it again")
    called = path.name.lower().endswith(".safetensors")
    try:
        if called or _is_safetensors(path):  # PyTorch 2.6 would take it for a pickle
            return load_file(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on pickle protocols: what cannot be read raises below
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        text = str(error)
        if found := re.search(r"(?:GLOBAL|global) (\S+)", text):
            message = f"{path}: holds code or objects beside tensors ({found.group(1)}); it was not run, nor read"
            raise WeightsError(message) from error
        if "Unsupported" in text and _names_code(path):
            raise WeightsError(
                f"{path}: holds code or objects beside tensors, or is of another pickle protocol than torch.save's "
                "own; it was not run, nor read"
            ) from error
        raise WeightsError(f"{path}: is not a PyTorch checkpoint{_what_instead(path)}") from error
    except _UNREADABLE as error:
        raise WeightsError(f"{path}: is not a PyTorch checkpoint{_what_instead(path)}") from error
    except SafetensorError as error:
        what = "ends in .safetensors, but is not such a file" if called else "is a safetensors file, but is damaged"
        raise WeightsError(f"{path}: {what}{_what_instead(path, error)}") from error


def _names_code(path: Path) -> bool:
    """Return whether a pickle names functions or classes, as that of a zipped checkpoint always does; none is run."""
    if zipfile.is_zipfile(path):
        return True
    with path.open("rb") as file:
        try:
            for _ in range(_PICKLES):
                if any(opcode.name in _NAMING for opcode, _, _ in pickletools.genops(file)):
                    return True
        except (ValueError, MemoryError, OverflowError):  # no pickle, its end, or a text longer than can be
            pass
    return False


def _what_instead(path: Path, error: Exception | None = None) -> str:
    """Return the end of a message on a file that is not what it should be: what it is, as far as can be seen."""
    with path.open("rb") as file:
        head = file.read(256).lstrip().lower()
    for begins, what in _IN_ITS_PLACE.items():
        if head.startswith(begins) and not _is_safetensors(path):  # whose first bytes are a number
            return f": it is {what}"
    return ", or is truncated" + (f" ({error}); copy it again" if error is not None else "")


def _read_pickle(path: Path) -> dict[str, Tensor]:
    state = _load_pickle(path)
    if _is_training_state(state):
        raise WeightsError(_about_training_state(path))
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()) or not state:
        raise WeightsError(f"{path}: is a pickle, but not a state dict of tensors")
    tensors: dict[str, Tensor] = {str(key): value for key, value in state.items()}
    if odd := [key for key, value in tensors.items() if not _is_dense(value)]:
        raise WeightsError(f"{path}: {few(odd)}: sparse, quantised or without values; save plain tensors of floats")
    if all(key.startswith("module.") for key in tensors):  # saved from a distributed wrapper
        tensors = {key.removeprefix("module."): value for key, value in tensors.items()}
    return tensors


def _is_dense(tensor: Tensor) -> bool:
    return tensor.layout is torch.strided and not (tensor.is_meta or tensor.is_quantized or tensor.is_nested)


def _guess_variant(state: Mapping[str, Tensor], source: Path) -> str:
    first = state.get("model.0.level1.conv.weight")
    for config in VARIANTS.values():
        if first is not None and first.ndim == 4 and first.shape[0] == config.channels[0]:
            return config.name
    raise WeightsError(f"{source}: is not a published TriLiteNet checkpoint (no known model.0.level1.conv.weight)")


def _published_classes(state: Mapping[str, Tensor], source: Path) -> int:
    weight = state.get("model.2.m.0.weight")
    if weight is None or weight.ndim != 4 or weight.shape[0] % len(STRIDES) or weight.shape[0] // len(STRIDES) < 6:
        raise WeightsError(f"{source}: missing or misshapen model.2.m.0.weight, the detection head")
    return int(weight.shape[0]) // len(STRIDES) - 5


def _published_anchors(state: Mapping[str, Tensor], source: Path) -> Tensor:
    for key in _ANCHOR_KEYS:
        if key not in state:
            raise WeightsError(f"{source}: missing {key}; the boxes cannot be decoded without its anchors")
        sizes = state[key]
        usable = sizes.is_floating_point() and bool(((sizes.float() > 0) & (sizes.float() < torch.inf)).all())
        if sizes.numel() != 18 or not usable:
            raise WeightsError(f"{source}: {key} must hold 3 x 3 positive sizes, got {tuple(sizes.shape)}")
    return state["model.2.anchor_grid"].float().view(len(STRIDES), -1, 2)
