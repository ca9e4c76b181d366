from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import yaml

from trilitenet.config import VARIANTS
from trilitenet.engine.recipe import TrainConfig, merge, read_recipe
from trilitenet.errors import ConfigError

RECIPES = Path(__file__).resolve().parents[2] / "recipes"


def test_file_then_overrides(tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text("variant: small\nlr: 1e-2\naugmentation: {rotation: 3, flip: 0}\n")
    config = read_recipe(path, {"lr": 0.5, "augmentation": {"flip": 0.25}})
    assert (config.variant, config.lr) == ("small", 0.5)
    assert (config.augmentation.rotation, config.augmentation.flip) == (3.0, 0.25)
    assert read_recipe(path).lr == 0.01


def test_base_is_relative_and_laid_under(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.yaml").write_text("epochs: 7\nvariant: base\n")
    (tmp_path / "sub" / "b.yaml").write_text("base: ../a.yaml\nvariant: small\n")
    config = read_recipe(tmp_path / "sub" / "b.yaml")
    assert (config.epochs, config.variant) == (7, "small")


def test_the_resolved_configuration_reads_back(tmp_path: Path) -> None:
    config = read_recipe(None, {"sampling": {"timeofday": {"night": 2}}, "tasks": ["lane"], "multi_scale": [0.5, 1.5]})
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(config.to_dict()))
    assert read_recipe(tmp_path / "c.yaml") == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("epoch: 3", r"unknown key 'epoch'; did you mean 'epochs'\?"),
        ("augmentation: {rotatoin: 1}", "rotatoin"),
        ("lr: fast", "lr"),
        ("lr: 0", "lr must be above 0"),
        ("variant: huge", "unknown variant"),
        ("device: gpu", "device: Input should be 'auto', 'cpu', 'cuda' or 'mps'"),
        ("epochs: 0", "epochs must be at least 1"),
        ("batch_size: 10\naccumulate: 4", "not a multiple"),
        ("extra_data: OWN=2", r"extra_data is written like \{OWN: 2, SCENES: 0.5\}, in quotes .*, got 'OWN=2'$"),
        ("extra_data: {OWN}", r"extra_data is written like .*, got \{'OWN': None\}$"),
        ("sampling: night=2", r"sampling is written like \{timeofday: \{night: 2\}\}, in quotes .*, got 'night=2'$"),
        ("input_size: [100, 130]", r"input_size must be multiples of 32, got 100x130 \(height x width\)"),
        ("samples_per_epoch: 0", "samples_per_epoch must be at least 1, got 0; leave it out for all images"),
        ("ema_decay: 1", "ema_decay"),
        ("multi_scale: [2, 1]", "multi_scale"),
        ("patience: -1", "patience"),
        ("final_lr: -3", "final_lr must not be negative"),
        ("ema_ramp: -1", "ema_ramp must not be negative"),
        ("lr: .inf", "lr must be above 0 and not infinite"),
        ("multi_scale: [1, .inf]", "multi_scale"),
        ("multi_scale: [1, 17]", r"multi_scale must be two factors up to 16, .*17"),
        ("task_weights: [1, .nan, 0]", "task_weights must not hold"),
        ("lane_tversky: [-1, 0]", "lane_tversky must not hold"),
        ("focal: [0.25, -2]", "focal must not hold"),
        ("focal: [2, 2]", r"focal must be alpha in \[0, 1\]"),
        ("tasks: []", "tasks must be some of detection, drivable, lane"),
        ("tasks: [lane, lane]", "each once"),
        ("classes: []", "classes must be names"),
        ("augmentation: {rotation: .nan}", "rotation must not be negative"),
        ("data: 2024-13-45", "r.yaml: not YAML"),
        ("- 1", "must hold 'key: value' lines"),
        ("a: [", "not YAML"),
        ("base: r.yaml", "its own base"),
        ("base: ./sub/../r.yaml", "its own base"),
        ("seed: 9223372036854775808", r"seed must be below 2\*\*63"),
        ("betas: [1, 0.9]", r"betas must be in \[0, 1\)"),
        ("teacher_confidence: [0.6, 0.5]", "the lower first"),
    ],
)
def test_a_wrong_recipe_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "r.yaml"
    path.write_text(text)
    (tmp_path / "sub").mkdir()
    with pytest.raises(ConfigError, match=message):
        read_recipe(path)


def test_the_ends_of_what_is_allowed() -> None:
    config = TrainConfig(
        betas=(0.0, 0.0), ema_decay=0.0, teacher_confidence=(0.3, 0.3), multi_scale=(1.0, 1.0), seed=2**63 - 1
    )
    assert config.multi_scale == (1.0, 1.0)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read \(No such file"):
        read_recipe(tmp_path / "none.yaml")


def test_merge_goes_into_mappings() -> None:
    assert merge({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 4}, "d": {"e": 5}}) == {
        "a": {"b": 4, "c": 2},
        "d": {"e": 5},
    }


def test_an_empty_mapping_takes_the_place_of_another(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        "extra_data: {more: 2}\nsampling: {timeofday: {night: 2}}\naugmentation: {flip: 0.1}\n"
    )
    (tmp_path / "b.yaml").write_text("base: a.yaml\nsampling: {}\naugmentation: {}\n")
    config = read_recipe(tmp_path / "b.yaml")
    assert config == TrainConfig(extra_data={"more": 2.0})
    assert read_recipe(tmp_path / "b.yaml", {"extra_data": {}}) == TrainConfig()


def test_the_recipes_of_bdd100k_are_the_papers() -> None:
    config = read_recipe(RECIPES / "bdd100k_tiny.yaml")
    assert (config.epochs, config.batch_size, config.lr, config.betas) == (200, 16, 0.001, (0.937, 0.999))
    assert (config.box_gains, config.task_weights) == ((0.05, 1.0, 0.5), (1.0, 0.3, 0.3))
    assert (config.drivable_tversky, config.lane_tversky, config.focal) == ((0.7, 0.3), (0.9, 0.1), (0.25, 2.0))


@pytest.mark.parametrize("variant", list(VARIANTS))
def test_the_default_recipes_depart_from_them_in_the_lanes_loss(variant: str) -> None:
    ours, paper = (read_recipe(RECIPES / f"{name}_{variant}.yaml") for name in ("default", "bdd100k"))
    assert ours.variant == variant
    assert ours.lane_tversky == TrainConfig().lane_tversky == (0.3, 0.7)
    assert dataclasses.replace(ours, lane_tversky=paper.lane_tversky) == paper
