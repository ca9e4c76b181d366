"""Constants and plain configuration: variants of the network, the model card, and strict parsing.

Nothing here imports NumPy or PyTorch. Configuration is parsed once, at the edge, into frozen dataclasses; an unknown
key is an error that names the nearest known one.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import operator
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, get_args, get_type_hints

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from trilitenet.errors import ConfigError, WeightsError, did_you_mean, shown

__all__ = [
    "ARTEFACT_KEY",
    "ARTEFACT_SCHEMA",
    "ARTEFACT_SUFFIXES",
    "CARD_KEY",
    "CARD_SCHEMA",
    "DEFAULT_ANCHORS",
    "DYNAMIC_SIDES",
    "GRAPH_HASH_KEY",
    "IMAGE_MEAN",
    "IMAGE_STD",
    "LONG_SIDE",
    "MAX_STRIDE",
    "STRIDES",
    "TASKS",
    "VARIANTS",
    "WEIGHTS_HASH_KEY",
    "Anchors",
    "ArtefactInfo",
    "Masks",
    "ModelCard",
    "Precision",
    "Task",
    "Thresholds",
    "VariantConfig",
    "as_size",
    "check_anchors",
    "check_size",
    "check_tasks",
    "get_variant",
    "parse",
    "parse_json",
    "parse_yaml",
    "plain",
    "read_yaml",
    "shipped_weights",
]

Task = Literal["detection", "drivable", "lane"]
TASKS: Final[tuple[Task, ...]] = get_args(Task)
Precision = Literal["fp32", "fp16", "bf16", "int8"]
"""What an exported artefact is stored in."""
Masks = Literal["decision", "probability", "logit"]
"""What a mask holds: 0 or 1, probability x 255, or foreground minus background logit minus the threshold's."""

IMAGE_MEAN: Final = (0.485, 0.456, 0.406)
"""Mean of RGB / 255 that the network's input is normalised with (ImageNet's)."""
IMAGE_STD: Final = (0.229, 0.224, 0.225)
"""Standard deviation of RGB / 255 that the network's input is normalised with (ImageNet's)."""

STRIDES: Final = (8, 16, 32)
"""Input pixels a cell of P3, P4 and P5."""
MAX_STRIDE: Final = 32
"""Height and width of the network's input are multiples of this."""
DYNAMIC_SIDES: Final = (64, 4096)
"""Pixels of the least and the greatest side that a graph of any size is traced for; ``.pt2`` refuses others."""
LONG_SIDE: Final = 640
"""Pixels the longer side of an image is resized to by default (Section IV-A: 1280x720 becomes 640x384)."""

Anchors = tuple[tuple[tuple[float, float], ...], ...]
"""Anchor sizes (width, height) in input pixels: one tuple a level (1/8, 1/16, 1/32), three anchors each."""

DEFAULT_ANCHORS: Final[Anchors] = (
    ((7.0, 6.0), (13.0, 11.0), (22.0, 18.0)),
    ((36.0, 28.0), (54.0, 45.0), (91.0, 64.0)),
    ((121.0, 103.0), (191.0, 151.0), (320.0, 229.0)),
)
"""Anchors for vehicles in 640-pixel road frames, used until auto-anchor or a checkpoint brings others."""


@dataclasses.dataclass(frozen=True)
class VariantConfig:
    """One column of the paper's configuration table (Section III-B).

    Attributes:
        name: ``"tiny"``, ``"small"`` or ``"base"``.
        channels: c0 .. c4. C1 has c1 channels; C3, C4 and C5 have c4; P3, P4 and P5 have c3; F_pcaa after its 3x3
            convolution has c2.
        p: Depth-wise ESP blocks at 1/4.
        q: Depth-wise ESP blocks at 1/8.
    """

    name: str
    channels: tuple[int, int, int, int, int]
    p: int
    q: int


VARIANTS: Final[dict[str, VariantConfig]] = {
    "tiny": VariantConfig("tiny", (4, 8, 16, 32, 64), p=1, q=1),
    "small": VariantConfig("small", (8, 16, 32, 64, 128), p=2, q=3),
    "base": VariantConfig("base", (16, 32, 64, 128, 256), p=3, q=5),
}


def get_variant(name: str) -> VariantConfig:
    """Return the variant called ``name``.

    Raises:
        ConfigError: If there is none; the message lists those that exist.
    """
    if name not in list(VARIANTS):  # which also takes what cannot be a key
        raise ConfigError(f"unknown variant {name!r}; known: {', '.join(VARIANTS)}")
    return VARIANTS[name]


def shipped_weights() -> dict[str, Path]:
    """Return the weight files that come with the package, by variant name."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "weights").glob("*.safetensors"))}


def check_tasks(tasks: tuple[str, ...] | list[str]) -> tuple[Task, ...]:
    """Return ``tasks`` in canonical order, each once.

    Raises:
        ConfigError: If there is none, or an unknown one.
    """
    for task in tasks:
        if task not in TASKS:
            raise ConfigError(f"unknown task {task!r}{did_you_mean(str(task), TASKS)}")
    chosen = tuple(task for task in TASKS if task in tasks)
    if not chosen:
        raise ConfigError(f"at least one task is needed, of {', '.join(TASKS)}")
    return chosen


@dataclasses.dataclass(frozen=True)
class Thresholds:
    """What turns scores into decisions; fixed on a validation split and stored with the weights.

    Attributes:
        confidence: A box is kept when objectness x class probability is above this, in [0, 1].
        iou: Non-maximum suppression drops a box that overlaps a better one of its class by more, in [0, 1].
        max_boxes: At most so many boxes an image.
        drivable: A pixel is drivable when its probability is above this, in [0, 1].
        lane: A pixel is lane marking when its probability is above this, in [0, 1].
    """

    confidence: float = 0.25
    iou: float = 0.6
    max_boxes: int = 300
    drivable: float = 0.5
    lane: float = 0.5

    def __post_init__(self) -> None:
        for name in ("confidence", "iou", "drivable", "lane"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"{name} must be between 0 and 1, got {value}")
        if self.max_boxes < 1:
            raise ConfigError(f"max_boxes must be at least 1, got {self.max_boxes}")


CARD_SCHEMA: Final = 1
"""Version of the card's layout; a file with a higher one is refused."""


@dataclasses.dataclass(frozen=True)
class ModelCard:
    """All that a file of weights or an exported artefact says of itself, so that it can be used with nothing else.

    Attributes:
        variant: ``"tiny"``, ``"small"`` or ``"base"``.
        class_names: Names of the detection classes, in the order of the network's outputs.
        tasks: The tasks the network was built with.
        blocks: Optional parts the network has, of ``"pcaa"``, ``"litepan"``, ``"spp"`` (all, but in ablations).
        input_size: (height, width) in pixels that training used; other multiples of 32 work too.
        mean: Of RGB / 255, a channel.
        std: Of RGB / 255, a channel.
        anchors: (width, height) in input pixels, three a level.
        thresholds: Decision thresholds fixed on a validation split.
        training_data: What it was trained on: one line a source, with counts and licence.
        metrics: Measured figures, by name, with the split and protocol in the name; what is no number, as of a task
            that nothing is labelled for, is left out.
        licence: Licence and allowed use of the weights (the code's is apart).
        provenance: Recipe, commit, seed, hours, hardware, and whatever else tells where the weights come from.
        notes: What it is bad at, and anything a user should know.
        schema: Version of this layout.
    """

    variant: str
    class_names: tuple[str, ...] = ("vehicle",)
    tasks: tuple[Task, ...] = TASKS
    blocks: tuple[str, ...] = ("pcaa", "litepan", "spp")
    input_size: tuple[int, int] = (384, 640)
    mean: tuple[float, float, float] = IMAGE_MEAN
    std: tuple[float, float, float] = IMAGE_STD
    anchors: Anchors = DEFAULT_ANCHORS
    thresholds: Thresholds = Thresholds()
    training_data: tuple[str, ...] = ()
    metrics: dict[str, float] = dataclasses.field(default_factory=dict)
    licence: str = "not stated"
    provenance: dict[str, str] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    schema: int = CARD_SCHEMA

    def __post_init__(self) -> None:
        known = {name: value for name, value in self.metrics.items() if math.isfinite(value)}  # as JSON has them
        object.__setattr__(self, "metrics", known)
        check_size(self.input_size, "input_size")
        check_anchors(self.anchors)
        if not self.class_names:
            raise ConfigError("class_names must hold at least one name")
        if not all(map(math.isfinite, self.mean)) or not all(0 < value < math.inf for value in self.std):
            raise ConfigError(f"mean and std must be finite, and std above 0, got {self.mean} and {self.std}")

    @property
    def classes(self) -> int:
        """Number of detection classes."""
        return len(self.class_names)

    def to_json(self) -> str:
        """Return the card as one line of JSON."""
        return json.dumps(dataclasses.asdict(self), ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str, source: str) -> ModelCard:
        """Read a card.

        Args:
            text: What `to_json` wrote.
            source: The file it came from, for messages.

        Raises:
            WeightsError: If it is not a card, or of a newer layout.
        """
        return _read_versioned(cls, text, source, "card", CARD_SCHEMA)


CARD_KEY: Final = "trilitenet.card"
"""Key of the card in a file's metadata."""
ARTEFACT_KEY: Final = "trilitenet.artefact"
"""Key of the artefact's description in an exported file's metadata."""
WEIGHTS_HASH_KEY: Final = "trilitenet.weights_sha256"
"""Key of the SHA-256 of an artefact's weights, where these and the metadata are files of their own."""
GRAPH_HASH_KEY: Final = "trilitenet.graph_sha256"
"""Key of the SHA-256 of an artefact's graph: of NCNN's file of it, an engine, or all that stands before the hash."""
ARTEFACT_SCHEMA: Final = 1
"""Version of the artefact's description; a file with a higher one is refused."""
ARTEFACT_SUFFIXES: Final = {
    "onnx": ".onnx",
    "openvino": ".xml",
    "ncnn": ".ncnn.param",
    "executorch": ".pte",
    "tensorrt": ".engine",
    "torch": ".pt2",
}
"""What the file of an exported format ends with."""


@dataclasses.dataclass(frozen=True)
class ArtefactInfo:
    """How an exported artefact takes pixels and returns results; what the network is stands in its card.

    Attributes:
        format: ``"onnx"``, ``"openvino"``, ``"ncnn"``, ``"executorch"``, ``"tensorrt"`` or ``"torch"``.
        precision: See `Precision`.
        size: (height, width) of the input in pixels; None if any multiples of 32 will do.
        input: ``"uint8_nhwc"``: (B, H, W, 3) uint8, or ``"float_nchw"``: (B, 3, H, W) float32 of 0 .. 255. B is 1.
        colour: ``"rgb"`` or ``"bgr"``.
        masks: See `Masks`.
        mask_scale: Mask pixels an input pixel, along an axis.
        nms: Whether detections have been through non-maximum suppression.
        trilitenet: Version of the package that wrote it.
        schema: Version of this layout.
    """

    format: str
    precision: Precision = "fp32"
    size: tuple[int, int] | None = None
    input: Literal["uint8_nhwc", "float_nchw"] = "uint8_nhwc"
    colour: Literal["rgb", "bgr"] = "rgb"
    masks: Masks = "decision"
    mask_scale: int = 1
    nms: bool = False
    trilitenet: str = ""
    schema: int = ARTEFACT_SCHEMA

    def __post_init__(self) -> None:
        if self.mask_scale not in (1, 2):
            raise ConfigError(f"mask_scale must be 1 or 2, got {self.mask_scale}")

    @property
    def decides_masks(self) -> bool:
        """Whether the thresholds of masks are inside and cannot be changed any more."""
        return self.masks != "probability"

    def to_json(self) -> str:
        """Return the description as one line of JSON."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str, source: str) -> ArtefactInfo:
        """Read a description.

        Args:
            text: What `to_json` wrote.
            source: The file it came from, for messages.

        Raises:
            WeightsError: If it is not one, or of a newer layout.
        """
        return _read_versioned(cls, text, source, "artefact description", ARTEFACT_SCHEMA)


_T = TypeVar("_T")
_MOST_ALIASED: Final = 100_000
"""Values that the aliases of a YAML text may stand for."""


def parse(cls: type[_T], mapping: Mapping[str, Any], source: str) -> _T:
    """Build a (frozen) dataclass from a mapping, strictly.

    Args:
        cls: The dataclass; nested dataclasses are parsed alike.
        mapping: Keys to values, as read from YAML, JSON or the command line (strings are converted).
        source: Where it came from, for messages.

    Raises:
        ConfigError: On an unknown key (naming the nearest known one), a missing key or a value of the wrong type.
    """
    _forbid_extra(cls)
    try:
        result = TypeAdapter(cls).validate_python(dict(mapping))
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explain(cls, error)}") from error
    for path, given in _flags_for_numbers(result, mapping):
        raise ConfigError(f"{source}: {path}: Input should be a number, got {given}")
    return result


def check_size(size: tuple[int, int], name: str = "size") -> None:
    """Refuse a (height, width) of the input that the network cannot take; ``name`` is what messages call it.

    Raises:
        ConfigError: If it is no (height, width), or a side is no positive multiple of `MAX_STRIDE`.
    """
    height, width = as_size(size, name)
    if min(height, width) < MAX_STRIDE or height % MAX_STRIDE or width % MAX_STRIDE:
        raise ConfigError(f"{name} must be multiples of {MAX_STRIDE}, got {height}x{width} (height x width)")


def as_size(size: Any, name: str = "size") -> tuple[int, int]:
    """Return a (height, width), which may be a list or an array, as plain numbers; messages call it ``name``.

    Raises:
        ConfigError: If it is not two whole numbers.
    """
    try:
        height, width = map(operator.index, size)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name} must be two whole numbers, (height, width), got {shown(size)}") from error
    return height, width


def check_anchors(anchors: Any) -> Anchors:
    """Return anchors, which may be lists, an array or a tensor, as plain numbers.

    Raises:
        ConfigError: If they are not 3 sizes a level, above 0 and finite.
    """
    try:
        levels = tuple(tuple((float(width), float(height)) for width, height in level) for level in anchors)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"anchors must be {len(STRIDES)} levels of 3 sizes, each a width and a height, got {shown(anchors)}"
        ) from error
    counts = [len(level) for level in levels]
    if counts != [3] * len(STRIDES):
        raise ConfigError(f"anchors must be {len(STRIDES)} levels of 3 sizes, got {counts}")
    for side in (side for level in levels for pair in level for side in pair):
        if not 0 < side < math.inf:
            raise ConfigError(f"anchors must be above 0 and finite, got {side}")
    return levels


def parse_yaml(text: str, source: str) -> Any:
    """Parse YAML; ``source`` is where it came from, for messages.

    Raises:
        ConfigError: If it is not YAML, gives a key twice, or its aliases stand for far more than is written.
    """
    try:
        return yaml.load(text, _YamlLoader)  # noqa: S506 - plain values only
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date that there is not
        reason = str(error)
        if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
            reason = f"line {error.problem_mark.line + 1}: {error.context or ''} {error.problem}"
        raise ConfigError(f"{source}: not YAML ({' '.join(reason.split())})") from error
    except (LookupError, AttributeError) as error:
        raise ConfigError(f"{source}: not YAML (a value is not what its tag, such as !!int, says)") from error


class _YamlLoader(yaml.SafeLoader):
    """Plain values only, no key twice (the last one would silently win), and no more by aliases than memory takes."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._sizes: dict[int, int] = {}  # of nodes that are whole: how many values each stands for

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        alias = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        if alias:
            if id(node) not in self._sizes:
                raise ValueError("an alias stands for what it is in")
        elif node is not None:
            inner = node.value if isinstance(node, yaml.CollectionNode) else ()
            parts = itertools.chain.from_iterable(inner) if isinstance(node, yaml.MappingNode) else inner
            size = self._sizes[id(node)] = 1 + sum(self._sizes[id(part)] for part in parts)
            if size > _MOST_ALIASED and size > len(self.buffer):
                raise ValueError(f"its aliases stand for more than {_MOST_ALIASED} values")
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node: yaml.MappingNode = super().compose_mapping_node(anchor)  # as written, before merges put keys of others in
        keys: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if (key.tag, key.value) in keys:
                    raise yaml.composer.ComposerError(problem=f"key {key.value!r} twice", problem_mark=key.start_mark)
                keys.add((key.tag, key.value))
        return node


def parse_json(text: str | bytes) -> Any:
    """Return what a JSON text says.

    Raises:
        ValueError: If it is not JSON, or is nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML file of ``key: value`` lines; an empty one gives an empty mapping.

    Raises:
        ConfigError: If it cannot be read, is not YAML, or holds something else than a mapping.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not text in UTF-8 ({error})") from error
    content = parse_yaml(text, str(path))
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: must hold 'key: value' lines, got {type(content).__name__}")
    return {str(key): value for key, value in content.items()}


def plain(value: Any) -> Any:
    """Return mappings and sequences within each other with tuples as lists, which YAML writes without tags."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def _read_versioned(cls: type[_T], text: str, source: str, what: str, newest: int) -> _T:
    """Read the JSON of a dataclass with a ``schema`` number, which messages call ``what``.

    Raises:
        WeightsError: If it is not such JSON, or of a layout above ``newest``.
    """
    try:
        mapping = parse_json(text)
    except (TypeError, ValueError) as error:  # the former of what is no text
        raise WeightsError(f"{source}: its {what} is not JSON ({error})") from error
    if not isinstance(mapping, dict):
        raise WeightsError(f"{source}: its {what} is not a JSON object")
    if "schema" not in mapping:
        raise WeightsError(
            f"{source}: its {what} has no schema, which tells the layout; the file is damaged or foreign"
        )
    schema = mapping["schema"]
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise WeightsError(
            f"{source}: {what} schema must be a whole number from 1 on, got {schema!r}; the file is damaged"
        )
    if schema > newest:
        raise WeightsError(
            f"{source}: {what} schema {schema!r} is newer than {newest}, which this version reads; upgrade trilitenet"
        )
    try:
        return parse(cls, mapping, source)
    except ConfigError as error:
        raise WeightsError(str(error)) from error


def _forbid_extra(cls: type[Any]) -> None:
    """Make pydantic refuse unknown keys in ``cls`` and in every dataclass among its fields."""
    if "__pydantic_config__" in cls.__dict__:
        return
    cls.__pydantic_config__ = ConfigDict(extra="forbid")
    for field in dataclasses.fields(cls):
        default = field.default if field.default is not dataclasses.MISSING else None
        if dataclasses.is_dataclass(default) and not isinstance(default, type):
            _forbid_extra(type(default))
        factory = field.default_factory
        if isinstance(factory, type) and dataclasses.is_dataclass(factory):
            _forbid_extra(factory)


def _flags_for_numbers(value: Any, given: Any, path: str = "") -> Iterable[tuple[str, bool]]:
    """Find where pydantic took true for 1 or false for 0, as YAML's ``on``, ``yes`` and ``no`` give them too."""
    if isinstance(given, bool):
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield path, given
    elif isinstance(given, Mapping):
        known = value if isinstance(value, Mapping) else vars(value)
        for key, item in given.items():
            yield from _flags_for_numbers(known.get(key), item, f"{path}.{key}".lstrip("."))
    elif isinstance(given, (list, tuple)):
        for index, (inner, item) in enumerate(zip(value, given, strict=True)):
            yield from _flags_for_numbers(inner, item, f"{path}.{index}".lstrip("."))


def _explain(cls: type[Any], error: ValidationError) -> str:
    errors = error.errors()
    unknown = next((one for one in errors if one["type"] in {"unexpected_keyword_argument", "extra_forbidden"}), None)
    first = unknown or errors[0]  # a key that is missing may be the one that is misspelt
    path = ".".join(str(part) for part in first["loc"])
    if unknown:
        owner: Any = cls
        for part in first["loc"][:-1]:
            kind = get_type_hints(owner).get(str(part))
            owner = next((one for one in (kind, *get_args(kind)) if dataclasses.is_dataclass(one)), owner)
        names = [field.name for field in dataclasses.fields(owner)]
        return f"unknown key {path!r}{did_you_mean(str(first['loc'][-1]), names)}"
    if first["type"] in {"missing", "missing_argument"}:
        return f"missing key {path!r}"
    where = f"{path}: " if path else ""
    if first["type"] == "value_error":  # raised by a dataclass itself; the input is all of its fields
        return f"{where}{first['ctx']['error']}"
    given = first.get("input")
    quotes = first["type"] == "string_type" and isinstance(given, (bool, int, float))  # YAML's off is false
    return f"{where}{first['msg']}, got {shown(given)}{'; put it into quotes' if quotes else ''}"
