"""``trilitenet data synthesize``: procedural road scenes with exact labels, as a data set on disk."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from trilitenet.commands.paths import StrPath
from trilitenet.commands.progress import show_progress
from trilitenet.data.synthetic import LaneLabels
from trilitenet.data.synthetic_files import write_dataset

__all__ = ["Synthesized", "synthesize"]


@dataclasses.dataclass(frozen=True)
class Synthesized:
    """What was written.

    Attributes:
        output: The data set's folder.
        split: The split.
        count: How many scenes.
    """

    output: Path
    split: str
    count: int

    def summary(self) -> str:
        """Return one line for people."""
        return f"{self.count} scenes in {self.output} (split {self.split})"


def synthesize(
    output: StrPath,
    *,
    count: int = 100,
    seed: int = 0,
    split: str = "train",
    size: tuple[int, int] = (384, 640),
    labels: LaneLabels = "lines",
    workers: int = 1,
) -> Synthesized:
    """Write synthetic road scenes with labels for all three tasks, in the published layout.

    Run again after an interruption, the same command goes on where it stood.

    Args:
        output: Folder of the data set.
        count: How many scenes.
        seed: The same seed gives the same scenes; use another one for another split.
        split: Name of the split.
        size: Height and width of the images in pixels.
        labels: Lanes as annotators draw them (lines of constant width, through gaps of dashes, and kerbs), or the
            painted pixels.
        workers: Processes to share the work.

    Raises:
        OutputError: If the split is there already, whole or of another command, or the folder's ``dataset.yaml`` leaves
            vehicles out.
    """
    with show_progress("scenes") as shown:
        write_dataset(output, split, count, seed, size=size, labels=labels, workers=workers, progress=shown)
    return Synthesized(Path(output), split, count)
