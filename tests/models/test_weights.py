"""Weight files: round trip, strictness, and the import of published checkpoints with its errors."""

from __future__ import annotations

import dataclasses
import gzip
import json
import os
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from tests.models.conftest import published_state
from trilitenet import build_network, load_network
from trilitenet.config import CARD_KEY, ModelCard, Thresholds
from trilitenet.errors import ConfigError, OutputError, WeightsError
from trilitenet.models.weights import import_published, read_card, rename_published, save_network


def test_who_may_read_new_weights_is_as_the_process_makes_files(tmp_path: Path) -> None:
    network = build_network("tiny")
    before = os.umask(0o022)
    try:
        save_network(network, tmp_path / "net.safetensors", network.card)
    finally:
        os.umask(before)
    assert (tmp_path / "net.safetensors").stat().st_mode & 0o777 == 0o644


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    network = build_network("tiny")
    save_network(network, tmp_path / "net.safetensors", network.card)
    return tmp_path / "net.safetensors"


@pytest.mark.parametrize(
    ("classes", "tasks", "blocks"),
    [
        (1, ("detection", "drivable", "lane"), {}),
        (10, ("detection",), {"spp": False}),
        (2, ("drivable", "lane"), {"pcaa": False}),
        (1, ("detection", "lane"), {"litepan": False}),
    ],
)
def test_round_trip(tmp_path: Path, classes: int, tasks: tuple[str, ...], blocks: dict[str, Any]) -> None:
    torch.manual_seed(1)
    network = build_network("tiny", classes, tasks, **blocks).eval()
    card = dataclasses.replace(network.card, thresholds=Thresholds(confidence=0.4, lane=0.7), licence="test")
    save_network(network, tmp_path / "net.safetensors", card)
    loaded = load_network(tmp_path / "net.safetensors")
    assert loaded.card.thresholds == card.thresholds
    assert loaded.card == read_card(tmp_path / "net.safetensors")
    assert loaded.tasks == network.tasks
    assert loaded.blocks == network.blocks
    image = torch.randn(1, 3, 64, 64)
    with torch.no_grad():
        for got, expected in zip(loaded(image), network(image), strict=True):
            assert (got is None) == (expected is None)
            if isinstance(got, torch.Tensor) and isinstance(expected, torch.Tensor):
                assert torch.equal(got, expected)


def test_loading_takes_nothing_from_a_seeded_run(saved: Path) -> None:
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    load_network(saved)
    assert torch.rand(1) == expected


def test_what_is_saved_is_what_the_network_is(tmp_path: Path) -> None:
    network = build_network("tiny")
    network.anchors.mul_(2)  # as fitted to a data set, after the card was written
    save_network(network, tmp_path / "net.safetensors", network.card)
    torch.testing.assert_close(load_network(tmp_path / "net.safetensors").anchors, network.anchors)
    names = load_file(tmp_path / "net.safetensors")
    assert not [name for name in names if name == "anchors" or name.endswith("num_batches_tracked")]


def test_the_same_weights_make_the_same_file(tmp_path: Path, saved: Path) -> None:
    network = load_network(saved)
    again = tmp_path / "again.safetensors"
    for _ in range(10):
        save_network(network, again, network.card)
        assert again.read_bytes() == saved.read_bytes()


def test_half_precision_halves_the_file(tmp_path: Path) -> None:
    network = build_network("tiny")
    save_network(network, tmp_path / "full.safetensors", network.card)
    save_network(network, tmp_path / "half.safetensors", network.card, half=True)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * (tmp_path / "full.safetensors").stat().st_size
    weight = load_network(tmp_path / "half.safetensors").encoder.level1.conv.weight
    torch.testing.assert_close(weight, network.encoder.level1.conv.weight, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("change", ["missing", "surplus", "shape", "nan", "8-bit nan"])
def test_a_damaged_state_is_never_loaded(saved: Path, change: str) -> None:
    tensors = load_file(saved)
    key = "drivable.up1.conv1.conv.weight"
    if change == "missing":
        del tensors[key]
    elif change == "surplus":
        tensors["extra.weight"] = torch.zeros(1)
    elif change == "shape":
        tensors[key] = tensors[key][:1].contiguous()
    else:
        tensors[key][0] = torch.nan
        tensors[key] = tensors[key].to(torch.float8_e4m3fn if change == "8-bit nan" else torch.float32)
    save_file(tensors, saved, metadata={CARD_KEY: read_card(saved).to_json()})
    expected = {"missing": "missing drivable", "surplus": "surplus extra", "shape": "must be"}
    with pytest.raises(WeightsError, match=expected.get(change, "not finite")):
        load_network(saved)


def test_weights_of_other_layers_are_not_loaded_as_those_of_ours(tmp_path: Path) -> None:
    network = build_network("tiny")
    network.encoder.pool = nn.MaxPool2d(3, 2, 1)  # type: ignore[assignment]
    path = tmp_path / "net.safetensors"
    save_network(network, path, network.card)
    assert read_card(path).variant == "tiny"
    with pytest.raises(WeightsError, match=r"does not make: encoder\.pool \(MaxPool2d\)"):
        load_network(path)
    assert network.load_state_dict(load_file(path), strict=False).unexpected_keys == []


def test_files_that_are_not_weights(tmp_path: Path, saved: Path) -> None:
    (tmp_path / "empty.safetensors").touch()
    (tmp_path / "text.safetensors").write_text("not weights at all")
    (tmp_path / "pointer.safetensors").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:12ab\n")
    (tmp_path / "long.safetensors").write_bytes(b'<\0\0\0\0\0\0\0{"a":')  # the header's length is a "<"
    (tmp_path / "model.onnx").write_bytes(b"\x08\x08 exported")
    (tmp_path / "cut.safetensors").write_bytes(saved.read_bytes()[:20_000])
    torch.save({"a": torch.zeros(1)}, tmp_path / "pickle.pth")
    torch.save({"a": torch.zeros(1)}, tmp_path / "program.pt2")
    save_file({"a": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    newer = dataclasses.replace(read_card(saved), schema=99)
    save_file(load_file(saved), tmp_path / "newer.safetensors", metadata={CARD_KEY: newer.to_json()})
    cases = {
        "empty.safetensors": "is empty",
        "text.safetensors": "not a safetensors file",
        "pointer.safetensors": "is not a safetensors file: it is a Git LFS pointer; download the file itself",
        "long.safetensors": r"or is truncated \(.*\); copy it again",
        "cut.safetensors": "truncated",
        "pickle.pth": "weights import",
        "model.onnx": r"is an exported file, not weights; trilitenet\.load\(.*model\.onnx'\)\.card",
        "program.pt2": "is an exported file",
        "foreign.safetensors": "no trilitenet card",
        "newer.safetensors": "upgrade trilitenet",
        "absent.safetensors": "does not exist",
        ".": "is a folder",
    }
    for name, message in cases.items():
        with pytest.raises(WeightsError, match=message):
            load_network(tmp_path / name)


def training_state(path: Path) -> Path:
    torch.save({"schema": 1, "config": {}, "step": 1, "network": {}, "ema": None, "optimiser": {}}, path)
    return path


def test_a_training_state_is_told_from_weights(tmp_path: Path) -> None:
    path = training_state(tmp_path / "last.ckpt")
    for read in (read_card, load_network, lambda path: import_published(path, tmp_path / "out.safetensors")):
        with pytest.raises(WeightsError, match=r"training state.* final\.safetensors .*best-\*\.safetensors beside"):
            read(path)
    assert not (tmp_path / "out.safetensors").exists()


def test_a_card_without_tasks_is_refused(saved: Path) -> None:
    card = json.loads(ModelCard("tiny").to_json()) | {"tasks": []}
    save_file(load_file(saved), saved, metadata={CARD_KEY: json.dumps(card)})
    for read in (read_card, load_network):
        with pytest.raises(WeightsError, match=r"net\.safetensors: at least one task is needed"):
            read(saved)


@pytest.mark.parametrize(
    ("anchors", "message"),
    [
        ([[[7, 6]] * 3] * 2, r"levels of 3 sizes, got \[3, 3\]"),
        ([[[7, 6]] * 3], r"levels of 3 sizes, got \[3\]"),
        ([[[7, 6]] * 3, [[7, 6]] * 3, [[7, 6], [7, -6], [7, 6]]], "above 0 and finite, got -6"),
    ],
)
def test_a_card_with_unusable_anchors_is_refused(saved: Path, anchors: list[Any], message: str) -> None:
    card = json.loads(ModelCard("tiny").to_json()) | {"anchors": anchors}
    save_file(load_file(saved), saved, metadata={CARD_KEY: json.dumps(card)})
    for read in (read_card, load_network):
        with pytest.raises(WeightsError, match=rf"net\.safetensors: anchors must be .*{message}"):
            read(saved)


def test_an_unknown_key_in_the_card_names_the_nearest(saved: Path) -> None:
    card = ModelCard("tiny").to_json().replace('"licence"', '"license"')
    save_file(load_file(saved), saved, metadata={CARD_KEY: card})
    with pytest.raises(WeightsError, match="did you mean 'licence'"):
        load_network(saved)


def test_saving_where_one_cannot_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    network = build_network("tiny")
    with pytest.raises(OutputError, match="cannot write"):
        save_network(network, tmp_path / "file" / "net.safetensors", network.card)


@pytest.mark.parametrize("variant", ["tiny", "small", "base"])
def test_import_of_every_variant(variant: str, golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    torch.save(published_state(variant, golden), tmp_path / "published.pth")
    card = import_published(tmp_path / "published.pth", tmp_path / "ours.safetensors")
    assert card.variant == variant
    assert card.anchors[0][0] == (4.0, 12.0)
    assert load_network(tmp_path / "ours.safetensors").anchors[2, 2].tolist() == [124.0, 412.0]


def test_anchors_come_from_the_file(golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    state = published_state("tiny", golden)
    state["model.2.anchor_grid"] = torch.arange(1, 19).float().view(3, 1, 3, 1, 1, 2)
    torch.save(state, tmp_path / "published.pth")
    import_published(tmp_path / "published.pth", tmp_path / "ours.safetensors")
    assert load_network(tmp_path / "ours.safetensors").anchors.flatten().tolist() == list(range(1, 19))


def test_every_published_key_has_a_name_of_ours(golden: dict[str, NDArray[Any]]) -> None:
    ours = set(build_network("base").state_dict())
    for key in published_state("base", golden):
        if "anchor" not in key:
            assert rename_published(key) in ours


class _Code:
    def __init__(self, touched: Path) -> None:
        self._touched = touched

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.system, (f"touch '{self._touched}'",))


def test_import_refuses_what_is_not_a_checkpoint(golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    state = published_state("tiny", golden)
    torch.save(state, tmp_path / "good.pth")
    (tmp_path / "cut.pth").write_bytes((tmp_path / "good.pth").read_bytes()[:100_000])
    network = build_network("tiny")
    save_network(network, tmp_path / "whole.safetensors", network.card)
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "whole.safetensors").read_bytes()[:20_000])
    (tmp_path / "cut2.pth").write_bytes((tmp_path / "whole.safetensors").read_bytes()[:20_000])
    (tmp_path / "text.pth").write_text("hello")
    (tmp_path / "page.pth").write_text("<!DOCTYPE html>\n<html><body>Not found</body></html>")
    (tmp_path / "page.safetensors").write_text("\n<html></html>")
    (tmp_path / "pointer.pth").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:12ab\nsize 9\n")
    (tmp_path / "answer.pth").write_text('{"message":"Not Found"}')
    (tmp_path / "answer2.pth").write_text("Not Found")
    (tmp_path / "packed.pth").write_bytes(gzip.compress((tmp_path / "good.pth").read_bytes()[:1000]))
    Image.new("RGB", (32, 32)).save(tmp_path / "picture.pth", "JPEG")
    (tmp_path / "plain.pth").write_bytes(pickle.dumps({"a": 1}, protocol=4))
    (tmp_path / "empty.pth").touch()
    for protocol in range(6):
        pickled = pickle.dumps({"a": _Code(tmp_path / "touched")}, protocol=protocol)
        (tmp_path / f"code{protocol}.pth").write_bytes(pickled)
    torch.save(state, tmp_path / "newer.pth", pickle_protocol=4)
    torch.save(state, tmp_path / "older.pth", pickle_protocol=4, _use_new_zipfile_serialization=False)
    torch.save({"zip": _Code(tmp_path / "touched")}, tmp_path / "zipcode.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({"conv.weight": torch.zeros(1)}, tmp_path / "foreign.pth")
    torch.save({k: v for k, v in state.items() if "caam.fuse" not in k}, tmp_path / "missing.pth")
    torch.save({**state, "model.9.weight": torch.zeros(1)}, tmp_path / "surplus.pth")
    torch.save({**state, "module.model.2.m.0.bias": state["model.2.m.0.bias"] + 1}, tmp_path / "mixed.pth")
    torch.save({"lane.out.bn.bias": state["model.5.bn.bias"] + 1, **state}, tmp_path / "ours.pth")
    reduce = state["model.0.level2_0.c1.conv.weight"] + 1
    torch.save({**state, "model.0.level2_down.reduce.weight": reduce}, tmp_path / "twice.pth")
    torch.save({k: v for k, v in state.items() if "anchor_grid" not in k}, tmp_path / "anchors.pth")
    cases = {
        "cut.pth": "truncated",
        "cut.safetensors": "ends in .safetensors, but is not such a file, or is truncated",
        "cut2.pth": "is a safetensors file, but is damaged, or is truncated",
        "text.pth": "not a PyTorch checkpoint",
        "empty.pth": "is empty",
        "page.pth": "is not a PyTorch checkpoint: it is a web page; download the file itself",
        "page.safetensors": "ends in .safetensors, but is not such a file: it is a web page; download the file itself",
        "pointer.pth": "is not a PyTorch checkpoint: it is a Git LFS pointer; download the file itself",
        "answer.pth": "is not a PyTorch checkpoint: it is text; download the file itself",
        "answer2.pth": "is not a PyTorch checkpoint, or is truncated",
        "packed.pth": "is not a PyTorch checkpoint: it is compressed; unpack it",
        "picture.pth": "is not a PyTorch checkpoint, or is truncated",
        "plain.pth": "is not a PyTorch checkpoint, or is truncated",
        **{f"code{protocol}.pth": "holds code" for protocol in range(6)},
        "newer.pth": "or is of another pickle protocol than torch.save's own",
        "older.pth": "or is of another pickle protocol than torch.save's own",
        "zipcode.pth": "holds code",
        "list.pth": "not a state dict",
        "foreign.pth": "not a published TriLiteNet checkpoint",
        "missing.pth": "missing pcaa.fuse",
        "surplus.pth": "surplus model.9",
        "mixed.pth": "surplus module.model.2.m.0.bias",
        "ours.pth": "surplus lane.out.bn.bias",
        "twice.pth": "surplus model.0.level2_down.reduce.weight",
        "anchors.pth": "missing model.2.anchor_grid",
        "absent.pth": "does not exist",
    }
    for name, message in cases.items():
        with pytest.raises(WeightsError, match=message) as caught:
            import_published(tmp_path / name, tmp_path / "out.safetensors")
        assert "it is not a TriLiteNet checkpoint" not in str(caught.value)  # most of it is there
        assert not (tmp_path / "out.safetensors").exists()
    assert not (tmp_path / "touched").exists()


def test_a_cut_or_damaged_checkpoint_of_the_older_format_is_named(tmp_path: Path) -> None:
    path = tmp_path / "old.pth"
    for protocol in (2, 4):
        torch.save({"a": torch.zeros(4)}, path, pickle_protocol=protocol, _use_new_zipfile_serialization=False)
        whole = path.read_bytes()
        for length in range(1, len(whole), 3):
            for rest in (b"", b"\0" + whole[length + 1 :]):
                path.write_bytes(whole[:length] + rest)
                with pytest.raises(WeightsError, match=r"old\.pth: "):
                    import_published(path, tmp_path / "out.safetensors")


@pytest.mark.parametrize("length", [2**55, 2**63 - 1])
def test_a_pickle_that_claims_a_text_longer_than_memory_is_named(tmp_path: Path, length: int) -> None:
    path = tmp_path / "long.pth"
    path.write_bytes(b"\x80\x04\x95" + bytes(8) + b"\x8d" + length.to_bytes(8, "little") + b"text")
    with pytest.raises(WeightsError, match="is not a PyTorch checkpoint"):
        import_published(path, tmp_path / "out.safetensors")


def _with(dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    return lambda tensor: tensor.to(dtype)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("model.5.deconv.weight", lambda tensor: tensor.to_sparse(), "sparse, quantised or without values"),
        ("model.5.deconv.weight", lambda tensor: tensor.to("meta"), "sparse, quantised or without values"),
        (
            "model.5.deconv.weight",
            lambda tensor: torch.nested.nested_tensor([tensor]),
            "sparse, quantised or without values",
        ),
        (
            "model.5.deconv.weight",
            lambda tensor: torch.quantize_per_tensor(tensor, 0.1, 0, torch.qint8),
            "sparse, quantised or without values",
        ),
        ("model.5.deconv.weight", _with(torch.int8), "lane.out.deconv.weight is of torch.int8, must be of floating"),
        ("model.5.deconv.weight", _with(torch.bool), "is of torch.bool"),
        ("model.5.deconv.weight", _with(torch.complex64), "is of torch.complex64"),
        ("model.5.bn.running_var", torch.neg, "lane.out.bn.running_var holds negative variances"),
        ("model.2.anchor_grid", _with(torch.complex64), "model.2.anchor_grid must hold 3 x 3 positive sizes"),
        ("model.2.anchor_grid", lambda tensor: tensor / 0, "model.2.anchor_grid must hold"),
        ("model.2.anchors", torch.neg, "model.2.anchors must hold 3 x 3 positive sizes"),
    ],
)
def test_tensors_that_are_not_what_they_should_be_are_refused(
    key: str, change: Callable[[Tensor], Tensor], message: str, golden: dict[str, NDArray[Any]], tmp_path: Path
) -> None:
    state = published_state("tiny", golden)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of types that PyTorch means to drop
        torch.save({**state, key: change(state[key])}, tmp_path / "odd.pth")
        with pytest.raises(WeightsError, match=message):
            import_published(tmp_path / "odd.pth", tmp_path / "out.safetensors")


def test_a_safetensors_file_is_known_by_its_content(golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    save_file(published_state("tiny", golden), tmp_path / "published.pth")
    assert import_published(tmp_path / "published.pth", tmp_path / "ours.safetensors").variant == "tiny"


def test_import_refuses_the_wrong_variant(golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    torch.save(published_state("tiny", golden), tmp_path / "tiny.pth")
    with pytest.raises(WeightsError, match="holds the tiny variant, not base"):
        import_published(tmp_path / "tiny.pth", tmp_path / "out.safetensors", variant="base")
    with pytest.raises(ConfigError, match="unknown variant"):
        import_published(tmp_path / "tiny.pth", tmp_path / "out.safetensors", variant="huge")


def test_what_could_not_be_loaded_is_not_written(tmp_path: Path) -> None:
    network = build_network("tiny", classes=10)
    path = tmp_path / "a.safetensors"
    with pytest.raises(ConfigError, match="the card has 1 classes, the network 10"):
        save_network(network, path, ModelCard(variant="tiny"))
    with torch.no_grad():
        next(network.parameters()).view(-1)[0] = 1e6
    save_network(network, path, network.card)
    before = path.read_bytes()
    with pytest.raises(WeightsError, match="not finite in fp16"):
        save_network(network, path, network.card, half=True)
    assert path.read_bytes() == before


def test_a_published_checkpoint_of_odd_tensors_is_named(tmp_path: Path) -> None:
    torch.save({"model.0.level1.conv.weight": torch.tensor(3.0)}, tmp_path / "odd.pth")
    with pytest.raises(WeightsError, match="not a published TriLiteNet checkpoint"):
        import_published(tmp_path / "odd.pth", tmp_path / "out.safetensors")


@pytest.mark.parametrize("wrong", [{"std": (0.0, 1.0, 1.0)}, {"mean": (float("nan"), 0.0, 0.0)}, {"class_names": ()}])
def test_a_card_that_cannot_be_used_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        ModelCard("tiny", **wrong)


def test_a_published_checkpoint_saved_by_a_distributed_run(golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    state = {f"module.{key}": value for key, value in published_state("tiny", golden).items()}
    torch.save(state, tmp_path / "published.pth")
    assert import_published(tmp_path / "published.pth", tmp_path / "ours.safetensors").variant == "tiny"
