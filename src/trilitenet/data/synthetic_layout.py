"""Draws the cross-sections of roads by chance, one function a kind of road; see `trilitenet.data.synthetic_world`."""

from __future__ import annotations

import dataclasses
from typing import Final, Literal

import numpy as np

from trilitenet.data.synthetic_world import Barrier, Colour, Layout, Marking, SceneKind

__all__ = ["random_layout"]

_WIDTHS: Final[dict[SceneKind, float]] = {
    "motorway": 3.65,
    "country": 3.2,
    "city": 3.2,
    "residential": 3.0,
    "one-way": 3.2,
}
"""Metres of a lane."""
_DASHES: Final = ((3.0, 9.0), (6.0, 12.0), (6.0, 6.0), (4.0, 4.0), (3.0, 4.5), (2.0, 4.0))
"""Metres of paint, and without it, in a period."""
_METAL: Final[Colour] = (168.0, 172.0, 175.0)
_GREEN: Final[Colour] = (52.0, 72.0, 38.0)


@dataclasses.dataclass(frozen=True)
class _Lanes:
    """The lanes in the ego vehicle's direction, and how the lines of the road are painted.

    Attributes:
        right: d in metres where they begin.
        left: d in metres where they end.
        count: How many there are.
        width: Metres of one.
        divider: Colour of lines between the directions.
        paint: Metres that a line is wide.
        dash: Metres of paint in a period of a broken line.
        gap: Metres without paint in it.
        wear: Share of the paint that is gone, in [0, 1].
    """

    right: float
    left: float
    count: int
    width: float
    divider: Literal["white", "yellow"]
    paint: float
    dash: float
    gap: float
    wear: float

    def solid(self, d: float) -> Marking:
        """Return an unbroken white line."""
        return Marking(d, self.paint, wear=self.wear)

    def broken(self, d: float) -> Marking:
        """Return a broken white line."""
        return Marking(d, self.paint, self.dash, self.gap, wear=self.wear)

    def divide(self, dash: float = 0.0, gap: float = 0.0) -> Marking:
        """Return the single line between the directions."""
        return Marking(self.left, self.paint, dash, gap, colour=self.divider, wear=self.wear)

    def divide_twice(self, dash: float = 0.0, gap: float = 0.0) -> list[Marking]:
        """Return the double line between the directions; the far one may be broken."""
        return [
            Marking(self.left - 0.14, 0.11, colour=self.divider, wear=self.wear),
            Marking(self.left + 0.14, 0.11, dash, gap, colour=self.divider, wear=self.wear, twin=True),
        ]


@dataclasses.dataclass(frozen=True)
class _Rest:
    """What a kind of road has beside those lanes; the names are those of `Layout`."""

    drivable: tuple[float, float]
    paved: tuple[float, float]
    markings: list[Marking]
    opposite: tuple[float, float] | None = None
    oncoming: tuple[float, ...] = ()
    barriers: list[Barrier] = dataclasses.field(default_factory=list)
    kerbs: tuple[float, ...] = ()
    pavement: float = 0.0
    parking: list[float] = dataclasses.field(default_factory=list)


def random_layout(rng: np.random.Generator, kind: SceneKind) -> Layout:
    """Draw the cross-section of a road with traffic on the right."""
    width = _WIDTHS[kind] * float(rng.uniform(0.92, 1.06))
    paint = float(rng.uniform(0.10, 0.20))
    wear = float(rng.uniform(0.0, 0.75)) ** 1.5
    american = rng.random() < 0.5
    dash, gap = _DASHES[int(rng.integers(6))]
    counts = {"motorway": int(rng.integers(2, 5)), "city": int(rng.integers(1, 4)), "one-way": int(rng.integers(2, 4))}
    count = counts.get(kind, 1)
    ego = int(rng.integers(count))
    lanes = _Lanes(
        right=-(ego + 0.5) * width,
        left=(count - ego - 0.5) * width,
        count=count,
        width=width,
        divider="yellow" if american else "white",
        paint=paint,
        dash=dash,
        gap=gap,
        wear=wear,
    )
    between = [lanes.right + i * width for i in range(1, count)]
    markings = [lanes.broken(d) if rng.random() < 0.93 else lanes.solid(d) for d in between]
    rest = {
        "motorway": _motorway,
        "country": _country,
        "city": _city,
        "residential": _residential,
        "one-way": _one_way,
    }[kind](rng, lanes)
    shade = float(rng.uniform(72, 132))
    brown = rng.random() < 0.25
    verge = (112.0, 98.0, 70.0) if brown else (84.0, float(rng.uniform(86, 106)), 56.0)
    terrain = (120.0, 104.0, 76.0) if brown else (78.0, float(rng.uniform(80, 100)), 52.0)
    if rest.pavement:
        verge = (130.0, 126.0, 120.0) if rng.random() < 0.6 else verge
    return Layout(
        kind=kind,
        lane_width=width,
        drivable=rest.drivable,
        paved=rest.paved,
        opposite=rest.opposite,
        markings=(*markings, *rest.markings),
        kerbs=rest.kerbs,
        pavement=rest.pavement,
        barriers=tuple(rest.barriers),
        lanes=tuple(lanes.right + (i + 0.5) * width for i in range(count)),
        oncoming=rest.oncoming,
        parking=tuple(rest.parking),
        asphalt=(shade, shade * float(rng.uniform(0.97, 1.01)), shade * float(rng.uniform(0.94, 1.04))),
        verge=verge,
        terrain=terrain,
        rough=float(rng.uniform(0.6, 1.6)),
    )


def _motorway(rng: np.random.Generator, lanes: _Lanes) -> _Rest:
    """Hard shoulders, and a carriageway for the other direction beyond a median."""
    count, width = lanes.count, lanes.width
    hard, inner = float(rng.uniform(0.8, 3.2)), float(rng.uniform(0.4, 1.4))
    markings = [
        Marking(lanes.right, lanes.paint * 1.3, wear=lanes.wear * 0.5),
        Marking(lanes.left, lanes.paint, colour=lanes.divider, wear=lanes.wear * 0.5),
    ]
    paved = (lanes.right - hard, lanes.left + inner)
    median = float(rng.uniform(1.2, 8.0))
    opposite = (paved[1] + median, paved[1] + median + count * width + 3.0)
    if rng.random() < 0.7:
        lines = [opposite[0] + 1.0 + i * width for i in range(count + 1)]
        markings += [lanes.solid(lines[0]), *map(lanes.broken, lines[1:-1]), lanes.solid(lines[-1])]
    barriers: list[Barrier] = []
    if median < 5.0 or rng.random() < 0.5:
        if rng.random() < 0.6:
            barriers.append(Barrier(paved[1] + 0.4, "rail", 0.75, _METAL))
        else:
            barriers.append(Barrier(paved[1] + 0.4, "concrete", 0.9, (150.0, 148.0, 142.0)))
    if rng.random() < 0.55:
        barriers.append(Barrier(paved[0] - 0.5, "rail", 0.75, _METAL, *_stretch(rng)))
    if rng.random() < 0.2:
        barriers.append(Barrier(paved[0] - 4.0, "wall", float(rng.uniform(2, 5)), (140.0, 135.0, 125.0)))
    return _Rest(
        drivable=(lanes.right, lanes.left),
        paved=paved,
        markings=markings,
        opposite=opposite,
        oncoming=tuple(opposite[0] + 1.0 + (i + 0.5) * width for i in range(count)),
        barriers=barriers,
    )


def _country(rng: np.random.Generator, lanes: _Lanes) -> _Rest:
    """A lane for each direction between verges."""
    style = int(rng.integers(5))
    far = lanes.left + lanes.width
    if style == 0:
        markings = [lanes.divide()]
    elif style < 3:
        markings = [lanes.divide(lanes.dash, lanes.gap)]
    else:
        markings = lanes.divide_twice(lanes.dash, lanes.gap) if style == 4 else lanes.divide_twice()
    verge = float(rng.uniform(0.15, 1.2))
    if rng.random() < 0.75:
        markings += [lanes.solid(lanes.right), lanes.solid(far)]
    paved = (lanes.right - verge, far + verge)
    barriers: list[Barrier] = []
    if rng.random() < 0.3:
        barriers.append(Barrier(paved[0] - 0.5, "rail", 0.75, _METAL, *_stretch(rng)))
    if rng.random() < 0.25:
        barriers.append(Barrier(paved[1] + 1.5, "hedge", float(rng.uniform(1.2, 2.8)), _GREEN, *_stretch(rng)))
    if rng.random() < 0.25:
        barriers.append(Barrier(paved[0] - 2.0, "hedge", float(rng.uniform(1.0, 2.5)), _GREEN, *_stretch(rng)))
    return _Rest(
        drivable=(lanes.right, lanes.left),
        paved=paved,
        markings=markings,
        oncoming=(lanes.left + lanes.width / 2,),
        barriers=barriers,
    )


def _city(rng: np.random.Generator, lanes: _Lanes) -> _Rest:
    """As many lanes for each direction, perhaps parked cars, and kerbs."""
    far = lanes.left + lanes.count * lanes.width
    markings = [lanes.broken(lanes.left + i * lanes.width) for i in range(1, lanes.count)]
    if rng.random() < 0.5:
        markings += lanes.divide_twice()
    else:
        markings.append(lanes.divide(lanes.dash, lanes.gap))
    sides = [2.3 if rng.random() < 0.45 else float(rng.uniform(0.2, 0.8)) for _ in range(2)]
    parking: list[float] = []
    if sides[0] > 1:
        parking.append(lanes.right - 1.2)
        if rng.random() < 0.5:
            markings.append(Marking(lanes.right, 0.11, wear=lanes.wear))
    if sides[1] > 1:
        parking.append(far + 1.2)
    paved = (lanes.right - sides[0], far + sides[1])
    return _Rest(
        drivable=(lanes.right, lanes.left),
        paved=paved,
        markings=markings,
        oncoming=tuple(lanes.left + (i + 0.5) * lanes.width for i in range(lanes.count)),
        kerbs=paved,
        pavement=float(rng.uniform(1.5, 4.0)),
        parking=parking,
    )


def _one_way(rng: np.random.Generator, lanes: _Lanes) -> _Rest:
    """No other direction, perhaps parked cars, and kerbs."""
    sides = [2.3 if rng.random() < 0.4 else float(rng.uniform(0.1, 0.5)) for _ in range(2)]
    parking: list[float] = []
    if sides[0] > 1:
        parking.append(lanes.right - 1.2)
    if sides[1] > 1:
        parking.append(lanes.left + 1.2)
    paved = (lanes.right - sides[0], lanes.left + sides[1])
    return _Rest(
        drivable=(lanes.right, lanes.left),
        paved=paved,
        markings=[],
        kerbs=paved,
        pavement=float(rng.uniform(1.5, 4.0)),
        parking=parking,
    )


def _residential(rng: np.random.Generator, lanes: _Lanes) -> _Rest:
    """A street without lines that both directions share, all of it drivable; perhaps parked cars, and kerbs."""
    far = lanes.left + lanes.width * float(rng.uniform(0.7, 1.0))
    drivable = paved = (lanes.right, far)
    parking: list[float] = []
    if rng.random() < 0.5:
        paved = (lanes.right - 2.2, far)
        parking.append(lanes.right - 1.1)
    return _Rest(
        drivable=drivable,
        paved=paved,
        markings=[],
        oncoming=(lanes.left + lanes.width * 0.4,),
        kerbs=paved,
        pavement=float(rng.choice([0.0, 1.5, 2.5])),
        parking=parking,
    )


def _stretch(rng: np.random.Generator) -> tuple[float, float]:
    """Draw where along the road something begins and ends, in metres."""
    start = float(rng.uniform(0, 40)) if rng.random() < 0.4 else 0.0
    return start, start + float(rng.uniform(40, 200))
