"""Data sets at training resolution, packed into WebDataset shards: written once, read back fast and in any order.

    OUT/prepared.json                 canvas, classes, how images are stored, shards and images a split
    OUT/{split}-000000.tar            per image NAME.jpg (or NAME.image.npy), NAME.drivable.npy, NAME.lane.npy,
                                      NAME.valid.npy, NAME.drivable_valid.npy, NAME.lane_valid.npy (where there are
                                      such masks) and NAME.json
    OUT/{split}-000000.index.jsonl    per image a line: where its parts are in the shard, and its boxes and attributes

Images are resized to fit the canvas but not padded. Masks are packed bits along rows (`numpy.packbits`, axis 1). The
shards are plain WebDataset ones, for any other reader; with the index beside them they are read in any order, by the
same loader as everything else.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import http.client
import io
import json
import logging
import multiprocessing
import os
import re
import tarfile
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import Task, check_size, parse_json
from trilitenet.data.description import DESCRIPTION_FILE, read_description
from trilitenet.data.reading import (
    FOLDERS,
    IMAGE_FOLDER,
    LABEL_FILES,
    PREPARED_FILE,
    DrivingDataset,
    SampleSource,
    check_root,
    decode_image,
    is_image_file,
    label_file,
    split_folders,
)
from trilitenet.data.sample import MASKS, VALID, Sample
from trilitenet.data.transforms import shrink
from trilitenet.errors import (
    Claim,
    ConfigError,
    DataError,
    MissingExtraError,
    OutputError,
    import_extra,
    replacing,
    writing,
)
from trilitenet.processing.addresses import as_address
from trilitenet.processing.cores import ProcessPool

try:
    import fcntl
except ModuleNotFoundError:  # on Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["CACHE_FOLDER", "PreparedDataset", "default_cache", "is_prepared", "open_dataset", "prepare"]

_LOGGER: Final = logging.getLogger(__name__)

CACHE_FOLDER: Final = ".prepared"
"""A prepared copy in this folder of a data set is used by itself."""
FORMAT: Final = 1

_LAYOUT: Final = 3
"""Shards of another layout are written anew."""

_BY_SPLIT: Final = ("splits", "shards", "counts", "indexes")
"""What ``prepared.json`` says of a split: hash of what it was made from, shards, count of images, hash of indexes."""
_PATIENCE: Final = 10.0
"""Seconds in which an address must answer, and go on."""
_PAUSES: Final = (1.0, 4.0, 16.0, 30.0)
"""Seconds after which a file that did not come is asked for again."""
_BUSY: Final = (408, 429)
"""What a web server that may answer later says, beside its own faults (500 and above)."""

_ENTRY: Final = frozenset({"name", "size", "boxes", "class_id", "ignored", "attributes", "parts"})
"""What every line of an index holds."""


@dataclasses.dataclass(frozen=True)
class _Plan:
    """What a shard is made with."""

    root: Path
    out: Path
    canvas: tuple[int, int]
    class_names: tuple[str, ...]
    images: Literal["jpeg", "raw"]
    quality: int
    mask_above: int


def prepare(
    root: str | Path,
    out: str | Path | None = None,
    *,
    canvas: tuple[int, int] = (384, 640),
    class_names: Sequence[str] | None = None,
    splits: Iterable[str] | None = None,
    images: Literal["jpeg", "raw"] = "raw",
    quality: int = 95,
    mask_above: int = 1,
    shard_size: int = 1000,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, int]:
    """Pack a data set at training resolution. Shards that are there already are kept.

    Args:
        root: A data set in the published layout.
        out: Folder to write; ``root/.prepared`` if left out, which loading then uses by itself.
        canvas: (height, width) that training will use.
        class_names: Detection classes; those of ``dataset.yaml``.
        splits: Only these; all that have images if left out.
        images: ``raw`` is exact and quickest to read; ``jpeg`` takes about a sixth of the room.
        quality: Of the JPEGs, of 100.
        mask_above: An area-resized mask pixel (0 to 255) above this is foreground (the published rule: 1).
        shard_size: Images a shard.
        workers: Processes; 0 works in this one.
        progress: Called with (images done, images in all).

    Returns:
        Split -> number of images.

    Raises:
        ConfigError: If a number is out of range.
        OutputError: If ``out`` holds something else, was made with other settings, or is being written by another call.
        DataError: If the data set is broken, or no box is of one of the ``class_names`` that are given.
    """
    root = Path(root)
    check_root(root)
    out = Path(out) if out is not None else root / CACHE_FOLDER
    names = tuple(class_names or read_description(root).class_names)
    _check(canvas, quality, mask_above, shard_size)
    plan = _Plan(root, out, canvas, names, images, quality, mask_above)
    if splits is not None:
        chosen = list(splits)
    else:
        folders = split_folders(root)
        chosen = [path.name for path in folders if any(is_image_file(file.name) for file in path.iterdir())]
    if not chosen:
        raise DataError(
            f"{root}: no splits with images below {IMAGE_FOLDER}; expected the published layout, see docs/data.md"
        )
    datasets = {split: DrivingDataset(root, split, class_names=names) for split in chosen}
    if class_names:
        if without := set.intersection(*(set(dataset.classes_without_boxes()[0]) for dataset in datasets.values())):
            raise DataError(
                f"{root}: no box is of the class {', '.join(sorted(without))}; a folder to write goes before --classes"
            )
    else:
        for dataset in datasets.values():
            dataset.warn_of_foreign()
    jobs = [
        (split, number, dataset.names[first : first + shard_size])
        for split, dataset in datasets.items()
        for number, first in enumerate(range(0, len(dataset), shard_size))
    ]
    total = sum(map(len, datasets.values()))
    with writing(out):
        _open_out(plan)
    with writing(out), contextlib.closing(Claim(out / PREPARED_FILE)):
        for part in out.glob(".*.part"):  # of a run that was killed
            part.unlink()
        _forget(plan, datasets)
        _run_jobs(plan, jobs, workers, lambda done: progress(done, total) if progress else None)
        _write_state(plan, datasets)
    return {split: len(dataset) for split, dataset in datasets.items()}


def is_prepared(root: str | Path) -> bool:
    """Return whether a folder holds a prepared data set."""
    return (Path(root) / PREPARED_FILE).is_file()


def open_dataset(
    root: str | Path,
    split: str,
    *,
    canvas: tuple[int, int] | None = None,
    class_names: Sequence[str] | None = None,
    classes: Mapping[str, Sequence[str]] | None = None,
    tasks: Sequence[Task] | None = None,
    mask_above: int | None = None,
    cache: str | Path | None = None,
) -> DrivingDataset | PreparedDataset:
    """Open a split of a data set, whatever its layout.

    A prepared data set is read as such, also one at an address. For one in the published layout, the prepared copy in
    its ``.prepared`` is used if it is for this canvas and these classes and the data set has not changed since.

    Args:
        root: The data set, or the address (``https://...``) of a prepared one.
        split: The split.
        canvas: (height, width) that the samples will be brought to; None reads the images as they are.
        class_names: Detection classes; those of the data set if left out.
        classes: Class name -> categories; with it, no prepared copy is used.
        tasks: Read the labels of these alone.
        mask_above: A resized mask pixel above this, of 255, shall be foreground; None takes any prepared copy.
        cache: Where copies of what is at an address go; `default_cache` if left out.

    Raises:
        DataError: If there is no such split, a prepared data set has masks made otherwise, or there is none at an
            address.
    """
    address = as_address(root)
    root = Path(root)
    if address is not None or is_prepared(root):
        place = address or root
        prepared = PreparedDataset(
            place, split, class_names=class_names, tasks=tasks, cache=default_cache() if cache is None else cache
        )
        if mask_above not in (None, prepared.mask_above):
            raise DataError(
                f"{place}: prepared with --mask-above {prepared.mask_above}, {mask_above} is wanted; prepare it again, "
                f"or set augmentation.mask_above to {prepared.mask_above}"
            )
        if canvas is not None and prepared.canvas != canvas:
            _LOGGER.warning("%s: prepared for %s, used at %s", place, prepared.canvas, canvas)
        return prepared
    cache = root / CACHE_FOLDER
    if canvas is not None and classes is None and is_prepared(cache):
        state = _read_state(cache / PREPARED_FILE)
        wanted = list(class_names or read_description(root).class_names)
        if state["canvas"] != list(canvas) or state["class_names"] != wanted or split not in state["splits"]:
            _LOGGER.info("%s: the prepared copy is for something else and is not used", root)
        elif mask_above not in (None, state["mask_above"]):
            _LOGGER.warning(
                "%s: prepared with --mask-above %d and not used, as %d is wanted; prepare it with that",
                cache, state["mask_above"], mask_above,
            )  # fmt: skip
        elif state["splits"][split] != _fingerprint(root, split):
            _LOGGER.warning("%s: changed since it was prepared; run `trilitenet data prepare` again", root)
        else:
            return PreparedDataset(cache, split, tasks=tasks)
    return DrivingDataset(root, split, class_names=class_names, classes=classes, tasks=tasks)


def default_cache() -> Path | None:
    """Return where copies of what is at an address go unless it is said; None for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "trilitenet")
    except RuntimeError:
        return None


class PreparedDataset:
    """One split of a prepared data set. The images of its samples may be read-only.

    Args:
        root: The folder with ``prepared.json``, or the address of one (``https://...``), whose shards are then copied
            to ``cache`` when they are first used, or by `copy`.
        split: The split.
        class_names: Must be those it was prepared with, if given.
        tasks: Read the labels of these alone.
        cache: Where copies of remote shards go, each state of a split into a folder of its own.

    Raises:
        DataError: If there is no such split, or the classes differ.
    """

    def __init__(
        self,
        root: str | Path,
        split: str,
        *,
        class_names: Sequence[str] | None = None,
        tasks: Sequence[Task] | None = None,
        cache: str | Path | None = None,
    ) -> None:
        self._place, state = _open_place(str(root), split, None if cache is None else Path(cache))
        self.split = split
        self.canvas: tuple[int, int] = (state["canvas"][0], state["canvas"][1])
        self.mask_above: int = state["mask_above"]
        self._class_names = tuple(state["class_names"])
        if class_names is not None and tuple(class_names) != self._class_names:
            raise DataError(
                f"{root}: prepared with the classes {self._class_names}, not {tuple(class_names)}; prepare it again"
            )
        if split not in state["shards"]:
            raise DataError(f"{root}: no split {split!r}; there are {', '.join(state['shards']) or 'none'}")
        self._tasks = None if tasks is None else frozenset(tasks)
        self._lines: list[bytes] = []
        self._shard_of: list[int] = []
        self._digests: list[str | None] = []
        self._shards: list[str] = state["shards"][split]
        for number, shard in enumerate(self._shards):
            lines = self._place.file(_index_name(shard)).read_bytes().splitlines()
            if not lines:
                raise DataError(f"{_index_name(shard)}: is empty; prepare the data set again")
            self._lines += lines
            self._shard_of += [number] * len(lines)
            self._digests.append(_parse_entry(lines[0], _index_name(shard)).get("shard"))
        if len(self) != (prepared := state["counts"][split]):
            raise DataError(
                f"{root}: the index of {split} holds {len(self)} images, not {prepared}; prepare the data set again"
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names that ``Sample.class_id`` indexes."""
        return self._class_names

    @functools.cached_property
    def names(self) -> list[str]:
        """The images' names."""
        return [self._entry(index)["name"] for index in range(len(self))]

    def copy(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Copy all shards from an address, but those that are copied already; ``progress`` is called with their counts.

        Raises:
            DataError: If that fails.
        """
        for number, shard in enumerate(self._shards if self._place.cache else ()):
            self._place.file(shard, self._digests[number])
            if progress:
                progress(number + 1, len(self._shards))

    def __len__(self) -> int:
        return len(self._lines)

    def __iter__(self) -> Iterator[Sample]:
        return (self[index] for index in range(len(self)))

    def attributes(self, index: int) -> dict[str, str]:
        """Return the attributes of an image without decoding it."""
        attributes: dict[str, str] = self._entry(index)["attributes"]
        return attributes

    def has_labels(self, task: Task) -> bool:
        """Return whether an image is labelled for a task; looks up to the first."""
        if self._tasks is not None and task not in self._tasks:
            return False
        entries = map(self._entry, range(len(self)))
        if task == "detection":
            return any(entry["boxes"] is not None for entry in entries)
        return any(f"{task}.npy" in entry["parts"] for entry in entries)

    def fingerprint(self, index: int) -> str:
        """Return a hash of what the shard's index says of a sample: boxes, attributes, and the hash of its parts."""
        entry = self._entry(index)
        for of_the_shard in ("made_from", "shard"):  # its hash, and when what it is made from was written
            entry.pop(of_the_shard, None)
        return hashlib.sha256(json.dumps(entry).encode()).hexdigest()[:16]

    def _entry(self, index: int) -> dict[str, Any]:
        return _parse_entry(self._lines[index], _index_name(self._shards[self._shard_of[index]]))

    def __getitem__(self, index: int) -> Sample:
        """Read a sample.

        Raises:
            DataError: If its shard is missing or broken.
        """
        entry = self._entry(index)
        number = self._shard_of[index]
        path = self._place.file(self._shards[number], self._digests[number])
        shard = _map_shard(path)
        if _end(entry) > len(shard):
            raise DataError(f"{path}: is cut short; prepare the data set again")
        height, width = entry["size"]
        parts = {key: shard[start : start + length] for key, (start, length) in entry["parts"].items()}
        if "image.npy" in parts:
            # A view of the file, which cannot be written to.
            image = parts["image.npy"].reshape(height, width, 3)
        else:
            image = decode_image(parts["jpg"], entry["name"])
        masks: dict[str, NDArray[np.uint8] | None] = {}
        for key in (*MASKS, *VALID):
            packed = parts.get(f"{key}.npy")
            task = key.removesuffix("_valid")
            if packed is None or (task in MASKS and self._tasks is not None and task not in self._tasks):
                masks[key] = None
            else:
                masks[key] = np.unpackbits(packed.reshape(height, -1), axis=1, count=width)
        labelled = entry["boxes"] is not None and (self._tasks is None or "detection" in self._tasks)
        return Sample(
            name=entry["name"],
            image=image,
            boxes=np.array(entry["boxes"], np.float32).reshape(-1, 4) if labelled else None,
            class_id=np.array(entry["class_id"], np.int64) if labelled else None,
            ignored=np.array(entry["ignored"] if labelled else [], np.float32).reshape(-1, 4),
            drivable=masks["drivable"],
            lane=masks["lane"],
            **{key: values.view(np.bool_) for key in VALID if (values := masks[key]) is not None},
            attributes=entry["attributes"],
        )


@dataclasses.dataclass(frozen=True)
class _Place:
    """A folder, or the address of one whose files are copied to ``cache`` when they are needed."""

    root: str
    cache: Path | None

    def file(self, name: str, digest: str | None = None) -> Path:
        """Return a file's path on this machine.

        Args:
            name: Its name.
            digest: SHA-256 that a file must have to be copied.

        Raises:
            DataError: If it is not there.
        """
        if self.cache is None:
            path = Path(self.root) / name
            if not path.is_file():
                raise DataError(f"{path}: missing; make it with `trilitenet data prepare`")
            return path
        path = self.cache / name
        if not path.is_file():
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                with _taking_turns(path):
                    if not path.is_file():  # another process has not copied it meanwhile
                        self._fetch(name, digest, path)
        return path

    def _fetch(self, name: str, digest: str | None, path: Path) -> None:
        with replacing(path) as part:
            found = _fetch(self.root, name, part)
            if digest not in (None, found):
                raise DataError(f"{self.root}/{name}: was prepared anew since it was opened; begin again")


@contextlib.contextmanager
def _taking_turns(path: Path) -> Iterator[None]:
    """Inside, no other process copies a file, which all would, as each reads from every shard.

    Where the system or the file system knows no locks, they do.
    """
    with path.with_name(f".{path.name}.lock").open("ab") as file:
        if fcntl is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _open_place(root: str, split: str, cache: Path | None) -> tuple[_Place, dict[str, Any]]:
    """Return where a split's files are, and what ``prepared.json`` says.

    What is remote is asked for ``prepared.json`` anew each time, so that no copies of another state, or of another data
    set, are read; where it cannot be asked, the copies of its last state are.
    """
    address = as_address(root)
    if address is None:
        place = _Place(root, None)
        return place, _read_state(place.file(PREPARED_FILE))
    root = address.rstrip("/")
    if cache is None:
        raise DataError(f"{root}: give `cache`, a folder for copies of remote shards")
    path = cache / f"{hashlib.sha256(root.encode()).hexdigest()[:16]}.json"
    with writing(cache):
        cache.mkdir(parents=True, exist_ok=True)
    try:
        with writing(cache), replacing(path) as part:
            _fetch(root, PREPARED_FILE, part)
            state = _read_state(part, f"{root}/{PREPARED_FILE}", "prepare the data set again")
    except (DataError, MissingExtraError) as error:
        if not path.is_file():
            raise
        _LOGGER.warning("%s; going on with the copies of it in %s", error, cache)
        state = _read_state(path)
    own = {key: value.get(split) if key in _BY_SPLIT else value for key, value in state.items()}
    key = hashlib.sha256(json.dumps([root, own], sort_keys=True).encode()).hexdigest()[:16]
    return _Place(root, cache / f"{split}-{key}"), state


def _fetch(root: str, name: str, path: Path) -> str:
    """Copy a remote file, and return its SHA-256.

    ``prepared.json`` is asked for once; the others by HTTP again after each of `_PAUSES`, until they come whole.

    Raises:
        DataError: If that fails.
    """
    by_http = root.lower().startswith(("http://", "https://"))
    url = f"{root.rstrip('/')}/{urllib.parse.quote(name) if by_http else name}"
    pauses = list(_PAUSES) if by_http and name != PREPARED_FILE else []
    while True:
        try:
            return _copy(urllib.request.urlopen(url, timeout=_PATIENCE) if by_http else _open_other(url), path)
        except OutputError:
            raise
        except urllib.error.HTTPError as error:
            busy = error.code >= 500 or error.code in _BUSY
            if not (busy and pauses):
                cure = "" if busy else "; give the address of a folder that `trilitenet data prepare` has written"
                raise DataError(f"{url}: cannot be fetched ({error}){cure}") from error
        except (OSError, ValueError, http.client.HTTPException) as error:
            if not pauses:
                reason = error.reason if isinstance(error, urllib.error.URLError) else error
                raise DataError(f"{url}: cannot be fetched ({reason})") from error
        time.sleep(pauses.pop(0))


def _open_other(url: str) -> Any:
    """Open what is at an address of another kind, such as ``s3://...``, by the program that WebDataset has for it."""
    return import_extra("webdataset", "data").gopen(url)


def _copy(source: Any, path: Path) -> str:
    """Write what is read from a stream to a file, and return its SHA-256.

    Raises:
        OSError: If it ends early.
        OutputError: If the file cannot be written, which asking again does not mend.
    """
    digest = hashlib.sha256()
    with source:
        with writing(path):
            target = path.open("wb")
        with target:
            while data := source.read(1 << 20):
                with writing(path):
                    target.write(data)
                    target.flush()
                digest.update(data)
    if missing := getattr(source, "length", None):  # of what an HTTP server announced
        raise OSError(f"{missing} bytes are missing at its end")
    return digest.hexdigest()


def _parse_entry(line: bytes, name: str) -> dict[str, Any]:
    """Return a line of the index called ``name``.

    Raises:
        DataError: If it is none.
    """
    try:
        entry: dict[str, Any] = parse_json(line)
        if entry.keys() >= _ENTRY:
            return entry
    except (ValueError, AttributeError):
        pass
    raise DataError(f"{name}: is damaged; prepare the data set again")


def _end(entry: Mapping[str, Any]) -> int:
    """Return where in its shard the parts of a sample end."""
    end: int = max(start + length for start, length in entry["parts"].values())
    return end


def _map_shard(path: Path) -> NDArray[np.uint8]:
    try:
        state = path.stat()
        return _mapped(path, (state.st_ino, state.st_size, state.st_mtime_ns))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({error}); prepare the data set again") from error


@functools.lru_cache(maxsize=512)
def _mapped(path: Path, state: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Map a file; ``state`` tells it from one that was there before."""
    del state
    return np.asarray(np.memmap(path, np.uint8, "r"))


def _run_jobs(plan: _Plan, jobs: list[tuple[str, int, list[str]]], workers: int, tell: Callable[[int], None]) -> None:
    """Write all shards; tell how many images are done after each, or twice a second of several processes."""
    if workers <= 0 or len(jobs) < 2:
        done = 0

        def add(count: int) -> None:
            nonlocal done
            done += count
            tell(done)

        for job in jobs:
            _write_shard(plan, *job, add)
        return
    counter = multiprocessing.get_context("spawn").Value("q")
    with ProcessPool(workers, _begin, (counter,)) as pool:
        waiting = {pool.submit(_write_shard, plan, *job, _count) for job in jobs}
        while waiting:
            finished, waiting = concurrent.futures.wait(waiting, 0.5, concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                future.result()
            tell(counter.value)


_counter: Synchronized[int]
"""The images done by all processes together, in each of them."""


def _begin(counter: Synchronized[int]) -> None:
    global _counter
    _counter = counter


def _count(images: int) -> None:
    with _counter.get_lock():
        _counter.value += images


def _write_shard(plan: _Plan, split: str, number: int, names: list[str], add: Callable[[int], None]) -> None:
    """Write one shard and its index, unless they are there for these images; ``add`` gets how many are new."""
    path = plan.out / f"{split}-{number:06}.tar"
    index = plan.out / _index_name(path.name)
    dataset = DrivingDataset(plan.root, split, class_names=plan.class_names, names=names)
    made_from = _made_from(dataset)
    if _is_there(path, index, names, made_from):
        add(len(names))
        return
    entries: list[dict[str, Any]] = []
    with replacing(index) as index_part, replacing(path) as part:
        with tarfile.open(part, "w", format=tarfile.PAX_FORMAT) as tar:  # names of any length
            for sample in dataset:
                members, entry = _encode(shrink(sample, plan.canvas, plan.mask_above), plan)
                for ending, data in members.items():
                    member = tarfile.TarInfo(f"{_key(sample.name)}.{ending}")
                    member.size = len(data)
                    tar.addfile(member, io.BytesIO(data))
                entries.append(entry)
                add(1)
        _locate(part, entries)
        entries[0]["made_from"] = made_from
        entries[0]["shard"] = _sha256(part)
        index_part.write_text("".join(json.dumps(entry) + "\n" for entry in entries), encoding="utf-8")


def _is_there(path: Path, index: Path, names: list[str], made_from: str) -> bool:
    """Return whether a shard and its index are there for these images, and whole."""
    if not (path.is_file() and index.is_file()):
        return False
    try:
        there = [_parse_entry(line, index.name) for line in index.read_bytes().splitlines()]
    except DataError:
        return False
    same = [entry["name"] for entry in there] == names and there[0].get("made_from") == made_from
    return same and max(map(_end, there)) <= path.stat().st_size


def _encode(sample: Sample, plan: _Plan) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return a sample's files and its line of the index (where the files are is not known yet)."""
    members: dict[str, bytes] = {}
    if plan.images == "raw":
        members["image.npy"] = _npy(sample.image)
    else:
        bgr = cv2.cvtColor(sample.image, cv2.COLOR_RGB2BGR)
        members["jpg"] = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, plan.quality])[1].tobytes()
    for key in (*MASKS, *VALID):
        mask = getattr(sample, key)
        if mask is not None:
            members[f"{key}.npy"] = _npy(np.packbits(mask, axis=1))
    labels = {
        "name": sample.name,
        "size": list(sample.size),
        "boxes": None if sample.boxes is None else [[float(v) for v in box] for box in sample.boxes],
        "class_id": None if sample.class_id is None else sample.class_id.tolist(),
        "ignored": [[float(v) for v in box] for box in sample.ignored],
        "class_names": plan.class_names,
        "attributes": sample.attributes,
    }
    digest = hashlib.sha256(b"".join(hashlib.sha256(data).digest() for data in members.values())).hexdigest()[:16]
    members["json"] = json.dumps(labels).encode()
    del labels["class_names"]
    return members, {**labels, "digest": digest}


def _locate(path: Path, entries: list[dict[str, Any]]) -> None:
    """Note in each entry where its parts are in the shard; arrays without their NumPy header."""
    by_key = {_key(entry["name"]): entry for entry in entries}
    for entry in entries:
        entry["parts"] = {}
    with tarfile.open(path) as tar, path.open("rb") as file:
        for member in tar:
            key, _, ending = member.name.partition(".")
            if ending == "json":
                continue
            start, length = member.offset_data, member.size
            if ending.endswith("npy"):
                file.seek(start)
                version = np.lib.format.read_magic(file)
                if version != (1, 0):
                    raise DataError(f"{path}: unexpected version of the NumPy format {version}")
                np.lib.format.read_array_header_1_0(file)
                length -= file.tell() - start
                start = file.tell()
            by_key[key]["parts"][ending] = [start, length]


def _key(name: str) -> str:
    """Return a WebDataset key: what comes before the first dot is the sample's name, so there is none in it."""
    return name.replace("%", "%25").replace(".", "%2E")


def _npy(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def _index_name(shard: str) -> str:
    return f"{shard.removesuffix('.tar')}.index.jsonl"


def _settings(plan: _Plan) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "canvas": list(plan.canvas),
        "class_names": list(plan.class_names),
        "images": plan.images,
        "quality": plan.quality,
        "mask_above": plan.mask_above,
    }


def _check(canvas: tuple[int, int], quality: int, mask_above: int, shard_size: int) -> None:
    check_size(canvas)
    if not (1 <= quality <= 100 and 0 <= mask_above <= 254 and shard_size >= 1):
        raise ConfigError(
            "quality must be in 1 .. 100, mask_above in 0 .. 254 and shard_size at least 1, "
            f"got {quality}, {mask_above} and {shard_size}"
        )


def _open_out(plan: _Plan) -> None:
    state = plan.out / PREPARED_FILE
    if state.is_file():
        there = _read_state(plan.out / PREPARED_FILE)
        if {key: there.get(key) for key in _settings(plan)} != _settings(plan):
            raise OutputError(f"{plan.out}: was prepared with other settings; remove it or choose another folder")
    elif plan.out.is_dir() and any(plan.out.iterdir()):
        raise OutputError(f"{plan.out}: is not empty and not prepared earlier; choose another folder")
    plan.out.mkdir(parents=True, exist_ok=True)
    if not state.is_file():
        _replace_state(plan, {part: {} for part in _BY_SPLIT})


def _forget(plan: _Plan, splits: Iterable[str]) -> None:
    """Take splits whose shards may be written again out of the state, so that nobody reads a mixture."""
    there = _read_state(plan.out / PREPARED_FILE)
    for split in splits:
        for part in _BY_SPLIT:
            there.get(part, {}).pop(split, None)
    _replace_state(plan, there)


def _write_state(plan: _Plan, datasets: Mapping[str, SampleSource]) -> None:
    there = _read_state(plan.out / PREPARED_FILE)
    for split, dataset in datasets.items():
        there["splits"][split] = _fingerprint(plan.root, split)
        there["counts"][split] = len(dataset)
        shard_name = re.compile(re.escape(split) + r"-\d{6,}\.tar")
        found = sorted(path.name for path in plan.out.iterdir() if shard_name.fullmatch(path.name))
        kept, count = [], 0
        for name in found:
            if count < len(dataset):
                kept.append(name)
                count += len((plan.out / _index_name(name)).read_bytes().splitlines())
            else:  # of an earlier, larger data set
                (plan.out / name).unlink()
                (plan.out / _index_name(name)).unlink(missing_ok=True)
        there["shards"][split] = kept
        indexes = b"".join((plan.out / _index_name(name)).read_bytes() for name in kept)
        there.setdefault("indexes", {})[split] = hashlib.sha256(indexes).hexdigest()
    _replace_state(plan, there)


def _replace_state(plan: _Plan, state: Mapping[str, Any]) -> None:
    text = json.dumps({**state, **_settings(plan)}, indent=1, sort_keys=True)
    with replacing(plan.out / PREPARED_FILE) as part:
        part.write_text(text, encoding="utf-8")


def _read_state(path: Path, where: str = "", cure: str = "") -> dict[str, Any]:
    """Read ``prepared.json``; ``where`` it is from and the ``cure`` are for messages.

    Raises:
        DataError: If it is broken.
    """
    where, cure = where or str(path), cure or f"remove {path.parent} and prepare the data set again"
    try:
        state: dict[str, Any] = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"{where}: cannot be read ({error}); {cure}") from error
    found = state.get("format") if isinstance(state, dict) else None
    if found != FORMAT:
        raise DataError(f"{where}: format {found!r}, not {FORMAT}; {cure}")
    if missing := {"canvas", "class_names", "mask_above", "splits", "shards", "counts"} - state.keys():
        raise DataError(f"{where}: lacks {', '.join(sorted(missing))}; {cure}")
    return state


def _files_of(root: Path, split: str) -> Iterator[str]:
    """Yield the files that are read, not such as ``.DS_Store`` and ``Thumbs.db``, which looking at a folder makes."""
    for folder in FOLDERS:
        if (root / folder / split).is_dir():
            names = (path.name for path in (root / folder / split).iterdir())
            yield from (
                f"{folder}/{split}/{name}"
                for name in names
                if is_image_file(name) or (name.endswith(".json") and not name.startswith("."))
            )
    yield from _common_files(root)


def _common_files(root: Path) -> tuple[str, ...]:
    """Return the files that say something of every image, where there are such."""
    description = read_description(root)
    return (DESCRIPTION_FILE, "index.csv", *filter(None, (description.ego_mask, *description.ego_masks.values())))


def _fingerprint(root: Path, split: str) -> str:
    """Return what changes when a split changes: the SHA-256 of its files' names, sizes and when they were written."""
    return _digest(root, sorted(_files_of(root, split), key=lambda file: file.split("/")))


def _made_from(dataset: DrivingDataset) -> str:
    """Return the SHA-256 of which files samples are made from, how large they are and when they were written."""
    files = [*_common_files(dataset.root)]
    for index, name in enumerate(dataset.names):
        files.append(f"{IMAGE_FOLDER}/{dataset.split}/{dataset.image_path(index).name}")
        files += [label_file(task, dataset.split, name) for task in LABEL_FILES]
    return _digest(dataset.root, files)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while data := file.read(1 << 20):
            digest.update(data)
    return digest.hexdigest()


def _digest(root: Path, files: Iterable[str]) -> str:
    """Return the SHA-256 of the names, sizes and times of writing of those files below ``root`` that are there."""
    digest = hashlib.sha256(f"layout {_LAYOUT}\n".encode())
    for file in files:
        with contextlib.suppress(OSError, ValueError):
            stat = (root / file).stat()
            digest.update(os.fsencode(f"{file}\n{stat.st_size} {stat.st_mtime_ns}\n"))
    return digest.hexdigest()
