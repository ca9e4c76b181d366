from __future__ import annotations

import dataclasses
import json
import math

import pytest

from trilitenet.config import (
    DEFAULT_ANCHORS,
    ArtefactInfo,
    ModelCard,
    Thresholds,
    parse,
    parse_json,
    parse_yaml,
)
from trilitenet.errors import ConfigError, WeightsError


@dataclasses.dataclass(frozen=True)
class Settings:
    rate: float = 1.0
    names: tuple[str, ...] = ("a", "b")
    on: bool = False
    size: tuple[int, int] = (1, 1)
    thresholds: Thresholds = dataclasses.field(default_factory=Thresholds)

    def __post_init__(self) -> None:
        if self.rate <= 0:
            raise ConfigError(f"rate must be above 0, got {self.rate}")


def test_what_a_dataclass_refuses_is_told_in_its_own_words() -> None:
    with pytest.raises(ConfigError) as caught:
        parse(Settings, {"rate": 0, "names": ["x"]}, "here")
    assert str(caught.value) == "here: rate must be above 0, got 0.0"
    with pytest.raises(ConfigError) as caught:
        parse(Settings, {"thresholds": {"iou": 2, "lane": 0.1}}, "here")
    assert str(caught.value) == "here: thresholds: iou must be between 0 and 1, got 2.0"


def test_an_unknown_key_of_a_part_is_told_with_the_nearest_of_its_own() -> None:
    with pytest.raises(ConfigError, match=r"^here: unknown key 'thresholds.iuo'; did you mean 'iou'\?$"):
        parse(Settings, {"thresholds": {"iuo": 0.5}}, "here")


def test_a_value_of_the_wrong_type_is_told_with_its_field() -> None:
    with pytest.raises(ConfigError, match=r"^here: rate: .*number.*, got 'fast'$"):
        parse(Settings, {"rate": "fast"}, "here")


@pytest.mark.parametrize("value", ["x" * 300_000, ["x"] * 300_000, 10**5000], ids=["text", "list", "number"])
def test_a_message_shows_the_beginning_of_a_long_value(value: object) -> None:
    with pytest.raises(ConfigError, match=r"^here: rate: .*number.*, got ") as caught:
        parse(Settings, {"rate": value}, "here")
    assert len(str(caught.value)) < 400


ALIASES = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"a0: &a0 [x]\n{ALIASES}rate: *a8\n", "its aliases stand for more than 100000 values"),
        ("rate: &a [1, *a]\n", "an alias stands for what it is in"),
        ("rate: !!int ''\n", "a value is not what its tag, such as !!int, says"),
        ("rate: !!bool perhaps\n", "a value is not what its tag, such as !!int, says"),
        ("rate: !!timestamp soon\n", "a value is not what its tag, such as !!int, says"),
    ],
    ids=["aliases", "itself", "int", "bool", "timestamp"],
)
def test_yaml_of_what_cannot_be_is_told_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "here")
    assert str(caught.value) == f"here: not YAML ({message})"


def test_json_that_is_nested_too_deeply_is_no_json() -> None:
    with pytest.raises(ValueError, match=r"^nested too deeply$"):
        parse_json("[" * 500_000)
    with pytest.raises(WeightsError, match=r"^here: its card is not JSON \(nested too deeply\)$"):
        ModelCard.from_json("[" * 500_000, "here")


@pytest.mark.parametrize(
    ("given", "where"),
    [({"rate": True}, "rate"), ({"thresholds": {"lane": False}}, "thresholds.lane"), ({"size": [True, 2]}, "size.0")],
)
def test_a_flag_is_no_number(given: dict[str, object], where: str) -> None:
    with pytest.raises(ConfigError, match=rf"^here: {where}: Input should be a number, got (True|False)$"):
        parse(Settings, given, "here")
    assert parse(Settings, {"on": True, "size": ("1", 2)}, "here") == Settings(on=True, size=(1, 2))


def test_yaml_with_a_key_twice_is_refused_with_its_line() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml("epochs: 2\nlr: 1\nepochs: 3\n", "here")
    assert str(caught.value) == "here: not YAML (line 3: key 'epochs' twice)"
    with pytest.raises(ConfigError, match=r"line 1: key 'a' twice"):
        parse_yaml("x: {a: 1, a: 1}", "here")
    anchors = "one: &one {a: 1, b: 2}\ntwo: {<<: *one, b: 3}\nthree: {<<: *one, <<: {c: 1}}"
    assert parse_yaml(anchors, "here")["two"] == {"a": 1, "b": 3}
    merged_first = "one: {<<: &two {<<: {a: 1}, a: 2}}\ntwo: *two"
    assert parse_yaml(merged_first, "here")["two"] == {"a": 2}
    assert parse_yaml("{1: a, '1': b}", "here") == {1: "a", "1": "b"}


def test_broken_yaml_is_told_with_its_line() -> None:
    with pytest.raises(ConfigError, match=r"^here: not YAML \(line 2: while parsing .*\)$"):
        parse_yaml("a: [1,\nb: }", "here")
    with pytest.raises(ConfigError, match=r"here: not YAML .*recursion"):
        parse_yaml("[" * 3000, "here")
    with pytest.raises(ConfigError, match=r"here: not YAML .*month"):
        parse_yaml("day: 2024-13-01", "here")


@pytest.mark.parametrize(
    ("anchors", "message"),
    [
        (DEFAULT_ANCHORS[:2], r"3 levels of 3 sizes, got \[3, 3\]"),
        ((), r"got \[\]"),
        ((*DEFAULT_ANCHORS[:2], DEFAULT_ANCHORS[2][:2]), r"got \[3, 3, 2\]"),
        ((*DEFAULT_ANCHORS[:2], ((1.0, 0.0),) * 3), r"above 0 and finite, got 0\.0"),
        ((*DEFAULT_ANCHORS[:2], ((math.nan, 1.0),) * 3), "got nan"),
        ((*DEFAULT_ANCHORS[:2], ((1.0, math.inf),) * 3), "got inf"),
    ],
)
def test_unusable_anchors_are_refused(anchors: tuple[tuple[tuple[float, float], ...], ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ModelCard("tiny", anchors=anchors)


def test_an_input_that_no_network_takes_is_refused() -> None:
    with pytest.raises(ConfigError, match="input_size must be multiples of 32, got 360x640"):
        ModelCard("tiny", input_size=(360, 640))


def test_a_card_holds_no_figure_that_json_has_not() -> None:
    card = ModelCard("tiny", metrics={"val lane/iou": math.nan, "val drivable/miou": 0.5})
    assert card.metrics == {"val drivable/miou": 0.5}
    text = json.dumps(json.loads(card.to_json()) | {"metrics": {"val lane/iou": math.nan}})
    assert ModelCard.from_json(text, "file").metrics == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, "has no schema"),
        ({"schema": "x"}, "schema must be a whole number from 1 on, got 'x'"),
        ({"schema": None}, "schema must be a whole number from 1 on, got None"),
        ({"schema": True}, "schema must be a whole number from 1 on, got True"),
        ({"schema": 0}, "schema must be a whole number from 1 on, got 0"),
        ({"schema": 99}, "schema 99 is newer than 1, which this version reads; upgrade"),
    ],
)
def test_a_schema_is_missing_wrong_or_newer(change: dict[str, object], message: str) -> None:
    for cls, text in ((ModelCard, ModelCard("tiny").to_json()), (ArtefactInfo, ArtefactInfo("onnx").to_json())):
        mapping = json.loads(text)
        del mapping["schema"]
        with pytest.raises(WeightsError, match=f"^file: .*{message}"):
            cls.from_json(json.dumps(mapping | change), "file")


@pytest.mark.parametrize("scale", [0, 3])
def test_masks_are_as_large_as_the_input_or_twice_that(scale: int) -> None:
    with pytest.raises(ConfigError, match=f"mask_scale must be 1 or 2, got {scale}"):
        ArtefactInfo("onnx", mask_scale=scale)
