"""The way of one image through the service: accepted, decoded, letterboxed, batched, post-processed, answered.

Decoding and answering run in two small thread pools and the network in the batcher's thread, so the event loop only
passes messages and a slow client holds nothing but its own connection.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import io
import math
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet import __version__
from trilitenet.apps.server.batching import Admission, Batcher
from trilitenet.apps.server.intake import Header, MemoryBudget, decode
from trilitenet.apps.server.metrics import Metrics
from trilitenet.apps.server.problems import BusyError, ProblemError
from trilitenet.apps.server.settings import Settings
from trilitenet.errors import ShapeError
from trilitenet.inference.predictor import Predictor
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Perception, RawOutputs

__all__ = ["Encoded", "Outcome", "Service", "in_time", "together"]

_T = TypeVar("_T")

_PATIENCE: Final = 0.6
"""Share of the deadline that the images ahead of a new one may be expected to take."""


@dataclasses.dataclass(frozen=True)
class Encoded:
    """The bytes of an image whose header was checked."""

    data: bytes
    header: Header


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of one image.

    Attributes:
        perception: In pixels of the image.
        image: (height, width, 3) uint8 RGB, if it was to be kept.
        milliseconds: By stage; that of the network is the whole batch's.
        batch: Images that went through the network at once.
    """

    perception: Perception
    image: NDArray[np.uint8] | None
    milliseconds: dict[str, float]
    batch: int


class Service:
    """A predictor behind a bounded queue.

    Args:
        predictor: Its stages are run apart from each other.
        name: What clients call the model.
        settings: Limits.
    """

    def __init__(self, predictor: Predictor, name: str, settings: Settings) -> None:
        self.predictor = predictor
        self.name = name
        self.settings = settings
        self.card = predictor.card
        self.metrics = Metrics()
        self.memory = MemoryBudget(settings.memory)
        self.admission = Admission(settings.queue, _PATIENCE * settings.deadline)
        self.draining = False
        self.failure: BaseException | None = None
        """What came in the way of the first image, with which the service starts."""
        self._warm = False
        self._batcher = Batcher(
            predictor.backend.run,
            max_batch=settings.max_batch,
            delay=settings.batch_delay,
            observe=self._observe_batch,
        )
        self._intake = ThreadPoolExecutor(settings.thread_count, "trilitenet-intake")
        self._outcome = ThreadPoolExecutor(settings.thread_count, "trilitenet-outcome")
        self.metrics.model(name, predictor.backend.name, __version__)
        self.metrics.gauge("queue_length", "Images that wait for the network.", lambda: self._batcher.length)
        self.metrics.gauge("accepted", "Images accepted and not yet answered.", lambda: self.admission.taken)
        self.metrics.gauge("memory_bytes", "Memory that requests in work hold.", lambda: self.memory.used)
        self.metrics.gauge("ready", "1 when new requests are welcome.", lambda: float(self.ready))

    @property
    def ready(self) -> bool:
        """Whether new requests are welcome."""
        return self._warm and not self.draining and self._works

    @property
    def alive(self) -> bool:
        """Whether the service can still do its work, now or once it is ready."""
        return not self._warm or self._works

    @property
    def _works(self) -> bool:
        """Whether images come through: a batch that the backend does not return from holds all others up."""
        return self._batcher.alive and self._batcher.busy <= self.settings.deadline

    async def start(self) -> None:
        """Start the threads and take one grey image the whole way, so that the first request is not slow."""
        self._batcher.start()
        mask = self.predictor.ego_mask
        height, width = self.card.input_size if mask is None else mask.size
        file = io.BytesIO()
        Image.new("RGB", (width, height), (114, 114, 114)).save(file, "JPEG")
        image = Encoded(file.getvalue(), Header("JPEG", width, height, 1))
        try:
            await self._stages(image, math.inf, lambda outcome: outcome.perception.to_dict(), self.predictor, False)
        except BaseException as error:
            self.failure = error
            raise
        self._warm = True

    async def stop(self) -> None:
        """Finish what was accepted, then end the threads."""
        self.draining = True
        await asyncio.to_thread(self._batcher.close, self.settings.shutdown_timeout)
        self._intake.shutdown(wait=True, cancel_futures=True)
        self._outcome.shutdown(wait=True, cancel_futures=True)

    @contextmanager
    def admit(self, count: int) -> Iterator[float]:
        """Accept ``count`` images, until the end of the block.

        Yields:
            The time, on `time.monotonic`, by which they must be answered.

        Raises:
            BusyError: If there is no room for all of them.
        """
        self.admission.enter(count)
        try:
            yield time.monotonic() + self.settings.deadline
        except BusyError:  # it waited for its turn: those ahead took the time
            raise
        except BaseException:
            self.admission.skip()
            raise
        finally:
            self.admission.leave(count)

    async def in_pool(self, function: Callable[..., _T], *arguments: Any) -> _T:
        """Run something slow that comes before the network, off the event loop.

        Of what nobody waits for any longer nothing is kept, though its turn may be far.
        """
        handed = [arguments]
        del arguments
        future = asyncio.get_running_loop().run_in_executor(self._intake, lambda: function(*handed.pop()))
        future.add_done_callback(lambda _: handed.clear())
        return await future

    async def see(
        self,
        image: Encoded | NDArray[np.uint8],
        deadline: float,
        finish: Callable[[Outcome], _T],
        confidence: float | None = None,
        *,
        keep_image: bool = False,
    ) -> _T:
        """Take an admitted image through all stages.

        Args:
            image: Its bytes, or (height, width, 3) uint8 RGB.
            deadline: What `admit` gave.
            finish: Makes the answer of the outcome, in a thread.
            confidence: Replaces the model's threshold for boxes.
            keep_image: Hand the image to ``finish``; else only its small canvas waits for the network.

        Raises:
            BusyError: If it is not through by the deadline.
            ProblemError: If the image is broken, or of another shape than the ego mask.
        """
        predictor = self.predictor
        if confidence is not None and confidence < predictor.least_confidence:
            raise ProblemError(
                422,
                "confidence_too_low",
                f"this model drops boxes below {predictor.least_confidence:g} itself; ask for that or more",
            )
        if confidence is not None:
            thresholds = dataclasses.replace(predictor.thresholds, confidence=confidence)
            predictor = Predictor(
                predictor.backend, thresholds, long_side=predictor.long_side, ego_mask=predictor.ego_mask
            )
        return await in_time(self._stages(image, deadline, finish, predictor, keep_image), deadline)

    async def see_all(
        self,
        images: Sequence[Encoded | NDArray[np.uint8]],
        deadline: float,
        finish: Callable[[Outcome], _T],
        confidence: float | None = None,
    ) -> list[_T]:
        """Take several admitted images through all stages, as `see`; the first failure ends them all."""
        return await together(self.see(image, deadline, finish, confidence) for image in images)

    async def _stages(
        self,
        image: Encoded | NDArray[np.uint8],
        deadline: float,
        finish: Callable[[Outcome], _T],
        predictor: Predictor,
        keep_image: bool,
    ) -> _T:
        loop = asyncio.get_running_loop()
        pixels, canvas, letterbox, milliseconds = await self.in_pool(self._prepare, image, keep_image)
        raw, waited, ran, batch = await asyncio.wrap_future(self._batcher.submit(canvas, deadline))
        self._note(milliseconds, "queue", waited)
        self._note(milliseconds, "network", ran)
        call = functools.partial(self._answer, raw, letterbox, pixels, milliseconds, batch, predictor, finish)
        return await loop.run_in_executor(self._outcome, call)

    def _prepare(
        self, image: Encoded | NDArray[np.uint8], keep_image: bool
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.uint8], Letterbox, dict[str, float]]:
        start = time.monotonic()
        milliseconds: dict[str, float] = {}
        if isinstance(image, Encoded):
            pixels = decode(image.data, image.header)
            self._note(milliseconds, "decode", time.monotonic() - start)
        else:
            pixels = image
        start = time.monotonic()
        try:
            canvas, letterbox = self.predictor.preprocess(pixels)
        except ShapeError as error:  # of an ego mask
            raise ProblemError(422, "wrong_shape", str(error)) from error
        self._note(milliseconds, "preprocess", time.monotonic() - start)
        return pixels if keep_image else None, canvas, letterbox, milliseconds

    def _answer(
        self,
        raw: RawOutputs,
        letterbox: Letterbox,
        pixels: NDArray[np.uint8] | None,
        milliseconds: dict[str, float],
        batch: int,
        predictor: Predictor,
        finish: Callable[[Outcome], _T],
    ) -> _T:
        start = time.monotonic()
        (perception,) = predictor.postprocess(raw, [letterbox])
        self._note(milliseconds, "postprocess", time.monotonic() - start)
        start = time.monotonic()
        answer = finish(Outcome(perception, pixels, milliseconds, batch))
        self.metrics.stage("encode", time.monotonic() - start)
        return answer

    def _note(self, milliseconds: dict[str, float], stage: str, seconds: float) -> None:
        milliseconds[stage] = round(seconds * 1e3, 3)
        self.metrics.stage(stage, seconds)

    def _observe_batch(self, size: int) -> None:
        self.metrics.batch(size)
        self.admission.observe(size)


async def together(works: Iterable[Coroutine[Any, Any, _T]]) -> list[_T]:
    """Await several works at once; the first failure ends them all, and so does it when this is cancelled."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        return list(await asyncio.gather(*tasks))
    finally:
        for task in tasks:
            task.cancel()


async def in_time(work: Awaitable[_T], deadline: float) -> _T:
    """Await work until a deadline on `time.monotonic`; then it is cancelled.

    Raises:
        BusyError: If it is not done by then.
    """
    try:
        return await asyncio.wait_for(work, deadline - time.monotonic())
    except asyncio.TimeoutError:
        raise BusyError("deadline", "the image waited too long; try again soon") from None
