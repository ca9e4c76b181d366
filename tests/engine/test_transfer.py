from __future__ import annotations

import pytest
import torch
from torch import nn

from trilitenet.engine.transfer import check_frozen, freeze, initialise, keep_frozen, order_classes
from trilitenet.errors import ConfigError
from trilitenet.models.trilitenet import build_network


def test_other_classes_keep_all_but_the_heads() -> None:
    source, network = build_network("tiny"), build_network("tiny", 3)
    report = initialise(network, source)
    assert set(report.misshapen) == {f"detection.convs.{i}.{what}" for i in range(3) for what in ("weight", "bias")}
    assert (report.missing, report.surplus) == ((), ())
    torch.testing.assert_close(network.encoder.state_dict(), source.encoder.state_dict())
    assert "detection.convs.0.weight" in report.summary()


def test_a_task_more_and_a_task_less_are_told() -> None:
    report = initialise(build_network("tiny"), build_network("tiny", tasks=("detection", "drivable")))
    assert report.missing
    assert all(name.startswith("lane.") for name in report.missing)
    report = initialise(build_network("tiny", tasks=("lane",)), build_network("tiny"))
    assert report.missing == ()
    assert any(name.startswith("drivable.") for name in report.surplus)


def test_nothing_that_fits_is_an_error() -> None:
    with pytest.raises(ConfigError, match="another variant"):
        initialise(nn.Linear(2, 2), nn.Conv2d(1, 1, 1))


def test_weights_of_another_variant_are_refused_and_nothing_is_taken() -> None:
    network = build_network("base")
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(ConfigError, match=r"of 2,350,206 parameters .* another variant"):
        initialise(network, build_network("tiny"))
    torch.testing.assert_close(network.state_dict(), before)


def test_classes_in_another_order_answer_to_their_names() -> None:
    source, network = build_network("tiny", 3), build_network("tiny", 3)
    network.load_state_dict(source.state_dict())
    assert network.detection is not None
    order_classes(network.detection, ("car", "person", "bus"), ("bus", "car", "person"))
    image = torch.randn(1, 3, 64, 64)
    with torch.no_grad():
        before, after = source.eval()(image).detection, network.eval()(image).detection
    assert before is not None
    assert after is not None
    for old, new in zip(before, after, strict=True):
        torch.testing.assert_close(new, old[..., [0, 1, 2, 3, 4, 7, 5, 6]])


def test_frozen_parts_learn_nothing() -> None:
    network = build_network("tiny").train()
    freeze(network, ("encoder", "lane.up1"))
    keep_frozen(network, ("encoder", "lane.up1"))
    before = {name: value.clone() for name, value in network.encoder.state_dict().items()}
    out = network(torch.randn(2, 3, 64, 128))
    assert out.drivable is not None
    out.drivable.square().mean().backward()
    for part in ("encoder", "lane.up1"):
        parameters = [*network.get_submodule(part).parameters()]
        assert all(parameter.grad is None and not parameter.requires_grad for parameter in parameters)
    assert all(parameter.grad is not None for parameter in network.get_submodule("drivable").parameters())
    torch.testing.assert_close(network.encoder.state_dict(), before)


def test_what_begins_at_random_cannot_be_frozen() -> None:
    network, other = build_network("tiny"), build_network("tiny")
    with pytest.raises(ConfigError, match=r"^--freeze encoder: \d+ of its \d+ tensors would .* random \(level1\.conv"):
        check_frozen(network, other, ("lane.up1.up.act", "encoder"))  # slopes are no chance
    source = build_network("tiny", tasks=("drivable",))
    for one in (network, other):
        initialise(one, source)
    check_frozen(network, other, ("encoder.level3", "drivable"))
    with pytest.raises(ConfigError, match=r"^--freeze encoder: \d of its \d+ tensors .* \(c4\.conv.* leave the part"):
        check_frozen(network, other, ("drivable", "encoder"))  # without detection there is no C4


def test_an_unknown_part_is_named() -> None:
    with pytest.raises(ConfigError, match="did you mean 'encoder'"):
        freeze(build_network("tiny"), ("encodr",))
    with pytest.raises(ConfigError, match="no part ''"):
        freeze(build_network("tiny"), ("",))
    tops = "detection, drivable, encoder, lane, litepan, pcaa, reduce, spp"
    for name in ("backbone", "backbone.stage1"):  # not the names of two hundred modules
        with pytest.raises(ConfigError, match=f"no part 'backbone' to freeze; known: {tops}$"):
            freeze(build_network("tiny"), (name,))
    for name in ("levl1", "levl1.conv"):
        with pytest.raises(ConfigError, match="no part 'levl1' of encoder to freeze; did you mean 'level1'"):
            freeze(build_network("tiny"), (f"encoder.{name}",))
