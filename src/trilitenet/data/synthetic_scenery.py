"""What stands beside the road in synthetic scenes: barriers, houses, trees, signs, lamps, people."""

from __future__ import annotations

import functools
import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_optics import noise
from trilitenet.data.synthetic_vehicles import SHIFT, Lamp, fixed
from trilitenet.data.synthetic_world import FAR, Barrier, Colour, Item, Light, World
from trilitenet.processing.geometry import Camera

__all__ = ["SCENERY", "draw_barrier", "draw_item", "fill"]

SCENERY: Final = 1
"""Mark of scenery in the map of objects; 0 is ground or sky."""


def fill(image: NDArray[np.uint8], ids: NDArray[np.uint8], pixels: NDArray[np.float64], colour: Colour) -> None:
    """Fill a polygon (N, 2) in the picture, and mark it as scenery in the map of objects."""
    if np.isnan(pixels).any():
        return
    outline = fixed(pixels)
    cv2.fillPoly(image, [outline], colour, cv2.LINE_AA, SHIFT)
    cv2.fillPoly(ids, [outline], SCENERY, cv2.LINE_8, SHIFT)


def draw_barrier(world: World, barrier: Barrier, image: NDArray[np.uint8], ids: NDArray[np.uint8]) -> None:
    """Draw a barrier along the road, far to near."""
    course = world.course
    s = np.concatenate([np.arange(2.0, 40, 2.0), np.arange(40.0, FAR * 0.8, 8.0)]) - world.travelled % 8
    s = s[(s >= barrier.start) & (s <= barrier.end)]
    if len(s) < 2:
        return
    angle = np.interp(s, course.s, course.angle)
    x = np.interp(s, course.s, course.x) - barrier.d * np.sin(angle)
    y = np.interp(s, course.s, course.y) + barrier.d * np.cos(angle)
    keep = x > 1.2
    x, y, s = x[keep], y[keep], s[keep]
    if len(x) < 2:
        return
    if barrier.kind == "rail":
        post = np.arange(math.ceil((s[0] + world.travelled) / 4) * 4 - world.travelled, min(s[-1], 80.0), 4.0)
        for at in post[::-1]:
            px, py, _ = course.at(float(at), barrier.d)
            if px > 2:
                ends = np.array([[px, py, 0.0], [px, py, barrier.height]])
                (u0, v0), (u1, v1) = world.camera.to_pixels(ends)
                half = max(0.3, world.camera.fx * 0.05 / px)
                box = np.array([[u0 - half, v0], [u0 + half, v0], [u1 + half, v1], [u1 - half, v1]])
                fill(image, ids, box, world.light.tone((96.0, 98.0, 100.0), px, py))
        strips: tuple[tuple[float, float, float], ...] = ((0.42, 0.75, 1.0), (0.54, 0.60, 0.62))
    elif barrier.kind == "concrete":
        strips = ((0.0, 1.0, 0.85), (0.0, 0.3, 0.7))
    else:
        strips = ((0.0, 1.0, 0.9),)
    height = barrier.height
    step = 3
    for i in range(len(x) - 1 - (len(x) - 2) % step, -1, -step):
        j = min(i + step, len(x) - 1)
        if j == i:
            continue
        span = slice(i, j + 1)
        grain = 1 + (0.08 if barrier.kind == "hedge" else 0.03) * math.sin((s[i] + world.travelled) * 1.7)
        for low, high, gain in strips:
            base = low * height if barrier.kind != "rail" else low
            peak = high * height if barrier.kind != "rail" else high
            lower = np.stack([x[span], y[span], np.full(j + 1 - i, base)], axis=1)
            upper = np.stack([x[span], y[span], np.full(j + 1 - i, peak)], axis=1)
            pixels = world.camera.to_pixels(np.concatenate([lower, upper[::-1]]))
            red, green, blue = barrier.colour
            shade = world.light.tone(
                (red * gain * grain, green * gain * grain, blue * gain * grain), float(x[i]), float(y[i])
            )
            fill(image, ids, pixels, shade)


def draw_item(world: World, item: Item, image: NDArray[np.uint8], ids: NDArray[np.uint8], lamps: list[Lamp]) -> None:
    """Draw a thing beside the road; its lights are added to ``lamps``."""
    camera, light = world.camera, world.light
    x, y, _ = world.course.at(item.s, item.d)
    scale = camera.fx / x
    if item.kind in ("tree", "bush"):
        foot = camera.to_pixels(np.array([[x, y, 0.0], [x, y, item.height]]))
        if np.isnan(foot).any():
            return
        sprite = _tree(item.style % 20) if item.kind == "tree" else _bush(item.style % 8)
        _paste(image, ids, sprite, foot, item.width * scale, light, x, y)
    elif item.kind == "building":
        _draw_building(world, item, image, ids)
    elif item.kind == "lamp":
        tone = light.tone((88.0, 90.0, 92.0), x, y)
        half = 0.07
        ends = np.array(
            [[x, y - half, 0], [x, y + half, 0], [x, y + half * 0.7, item.height], [x, y - half * 0.7, item.height]]
        )
        fill(image, ids, camera.to_pixels(ends), tone)
        arm = np.array([[x, y, item.height], [x, y + item.width, item.height + 0.2],
                        [x, y + item.width, item.height + 0.08], [x, y, item.height - 0.1]])  # fmt: skip
        pixels = camera.to_pixels(arm)
        fill(image, ids, pixels, tone)
        if light.time != "day" and not np.isnan(pixels).any():
            u, v = pixels[1:3].mean(axis=0)
            lamps.append(Lamp(float(u), float(v), max(0.6, scale * 0.15), (255.0, 214.0, 150.0), 0.8, SCENERY))
    elif item.kind == "post":
        tall = item.height
        for low, high, grey in ((0.0, tall, (225.0, 225.0, 222.0)), (tall * 0.7, tall * 0.85, (40.0, 40.0, 42.0))):
            fill(image, ids, camera.to_pixels(_upright(x, y, 0.06, low, high)), light.tone(grey, x, y))
    elif item.kind == "sign":
        _draw_sign(camera, item, x, y, image, ids, light)
    elif item.kind == "gantry":
        right, left = world.layout.paved
        grey = light.tone((120.0, 122.0, 125.0), x, y)
        for edge in (right - 0.8, left + 0.8):
            px, py, _ = world.course.at(item.s, edge)
            fill(image, ids, camera.to_pixels(_upright(px, py, 0.2, 0.0, 6.6)), grey)
        beam = np.array(
            [
                (*world.course.at(item.s, e)[:2], z)
                for e, z in ((right - 1, 6.4), (left + 1, 6.4), (left + 1, 6.8), (right - 1, 6.8))
            ]
        )
        fill(image, ids, camera.to_pixels(beam), grey)
        for lane in world.layout.lanes[:3]:
            board = np.array(
                [
                    (*world.course.at(item.s, lane + e)[:2], z)
                    for e, z in ((-1.5, 5.5), (1.5, 5.5), (1.5, 7.4), (-1.5, 7.4))
                ]
            )
            shine = max(0.35, light.ambient[1])
            tint: Colour = (18.0 * shine, 62.0 * shine, 140.0 * shine)
            if item.style % 2 == 0:
                tint = (12.0 * shine, 96.0 * shine, 62.0 * shine)
            fill(image, ids, camera.to_pixels(board), light.lamp_tone(tint, x))
    elif item.kind == "pedestrian":
        _draw_person(world, item, x, y, image, ids)


def _upright(x: float, y: float, half: float, low: float, high: float) -> NDArray[np.float64]:
    """Return (4, 3) corners of a rectangle across the road, ``half`` metres to either side of y."""
    return np.array([[x, y - half, low], [x, y + half, low], [x, y + half, high], [x, y - half, high]])


def _draw_person(
    world: World, item: Item, x: float, y: float, image: NDArray[np.uint8], ids: NDArray[np.uint8]
) -> None:
    rng = np.random.default_rng(item.style)
    coat, legs, skin = rng.uniform(20, 190, 3), rng.uniform(20, 90, 3), np.array([190.0, 150.0, 125.0])
    turn = np.linspace(0, 2 * math.pi, 10, endpoint=False)
    for low, high, wide, colour in ((0.0, 0.5, 0.15, legs), (0.45, 0.84, 0.23, coat), (0.85, 1.0, 0.1, skin)):
        z = item.height * ((low + high) / 2 + (high - low) / 2 * np.sin(turn))
        ring = np.stack([np.full(10, x), y + wide * np.cos(turn), z], axis=1)
        red, green, blue = colour.tolist()
        fill(image, ids, world.camera.to_pixels(ring), world.light.tone((red, green, blue), x, y))


def _draw_sign(
    camera: Camera,
    item: Item,
    x: float,
    y: float,
    image: NDArray[np.uint8],
    ids: NDArray[np.uint8],
    light: Light,
) -> None:
    pole = _upright(x, y, 0.04, 0.0, item.height)
    fill(image, ids, camera.to_pixels(pole), light.tone((130.0, 132.0, 134.0), x, y))
    half, centre = item.width / 2, item.height
    style = item.style % 4
    if item.width > 1.2:
        board = _upright(x, y, half, centre - half * 0.6, centre + half * 0.6)
        tint: Colour = ((22, 66, 146), (14, 98, 62), (228, 228, 226), (225, 178, 40))[style]
        fill(image, ids, camera.to_pixels(board), light.tone(tint, x, y))
        return
    corners = (20, 20, 3, 4)[style]
    turn = np.linspace(0, 2 * math.pi, corners, endpoint=False) + (math.pi / 2)
    for share, tint in ((1.0, (196.0, 28.0, 34.0)), (0.74, (236.0, 236.0, 234.0))):
        if style == 1 and share == 1.0:
            tint = (30.0, 80.0, 170.0)
        ring = np.stack(
            [np.full(corners, x), y + half * share * np.cos(turn), centre + half * share * np.sin(turn)], axis=1
        )
        fill(image, ids, camera.to_pixels(ring), light.tone(tint, x, y))


@functools.lru_cache(maxsize=16)
def _facade(style: int) -> NDArray[np.uint8]:
    """Return an (160, 256, 3) uint8 picture of a house front."""
    rng = np.random.default_rng(900 + style)
    base = np.array(
        [(168, 150, 132), (188, 180, 168), (140, 92, 74), (120, 118, 116), (196, 186, 150), (96, 84, 78)][style % 6]
    )
    wall = np.clip(base + 6 * noise(1.2, 18)[:160, :256, None], 0, 255).astype(np.uint8)
    floors, columns = int(rng.integers(3, 6)), int(rng.integers(5, 11))
    fh, fw = 160 / floors, 256 / columns
    for i in range(floors):
        for j in range(columns):
            wide, tall = fw * 0.5, fh * 0.55
            if i == floors - 1 and style % 3 == 0:
                wide, tall = fw * 0.86, fh * 0.7
            x0, y0 = int(j * fw + (fw - wide) / 2), int(i * fh + (fh - tall) / 2)
            x1, y1 = int(x0 + wide), int(y0 + tall)
            dark = int(rng.integers(30, 90))
            wall[max(0, y0 - 1) : y1 + 2, max(0, x0 - 1) : x1 + 1] = np.clip(base * 1.2, 0, 255)
            wall[y0:y1, x0:x1] = (dark, dark * 1.06, dark * 1.14)
    return wall


def _draw_building(world: World, item: Item, image: NDArray[np.uint8], ids: NDArray[np.uint8]) -> None:
    course, camera = world.course, world.camera
    side = math.copysign(1.0, item.d)
    start, end = max(item.s, 2.5), item.s + item.width
    if end - start < 2:
        return
    x0, y0, _ = course.at(start, item.d)
    x1, y1, _ = course.at(end, item.d)
    x2, y2, _ = course.at(start, item.d + side * 9)
    if min(x0, x1, x2) < 2.0:
        return
    height, width = image.shape[:2]
    for (ax, ay), (bx, by), gain in (((x0, y0), (x2, y2), 0.72), ((x0, y0), (x1, y1), 1.0)):
        corners = np.array([[ax, ay, item.height], [bx, by, item.height], [bx, by, 0.0], [ax, ay, 0.0]])
        pixels = camera.to_pixels(corners)
        if np.isnan(pixels).any():
            continue
        left, right = max(0, int(pixels[:, 0].min()) - 1), min(width, int(pixels[:, 0].max()) + 2)
        top, bottom = max(0, int(pixels[:, 1].min()) - 1), min(height, int(pixels[:, 1].max()) + 2)
        if right - left < 2 or bottom - top < 2:
            continue
        texture = _facade(item.style % 16)
        th, tw = texture.shape[:2]
        matrix = cv2.getPerspectiveTransform(
            np.array([[0, 0], [tw, 0], [tw, th], [0, th]], np.float32), (pixels - (left, top)).astype(np.float32)
        )
        shade = [
            world.light.tone((255.0 * gain, 255.0 * gain, 255.0 * gain), px, py) for px, py in ((ax, ay), (bx, by))
        ]
        level = np.mean(shade, axis=0) / 255
        warped = cv2.warpPerspective(texture, matrix, (right - left, bottom - top), flags=cv2.INTER_LINEAR)
        haze = 1 - math.exp(-world.light.haze * (ax + bx) / 2)
        fog = np.array(world.light.horizon) * haze
        lit = cv2.transform(warped, np.concatenate([np.diag((level * 255 - fog) / 255), fog[:, None]], axis=1))
        mask = np.zeros(warped.shape[:2], np.uint8)
        cv2.fillConvexPoly(mask, fixed(pixels - (left, top)), 255, cv2.LINE_8, SHIFT)
        cv2.copyTo(lit, mask, image[top:bottom, left:right])
        ids[top:bottom, left:right][mask > 0] = SCENERY


@functools.lru_cache(maxsize=32)
def _tree(style: int) -> NDArray[np.uint8]:
    """Return a (192, 144, 4) uint8 picture of a tree with transparency."""
    rng = np.random.default_rng(300 + style)
    sprite = np.zeros((192, 144, 4), np.uint8)
    bark = int(rng.integers(40, 75))
    cv2.rectangle(sprite, (68, 100), (76, 191), (bark, int(bark * 0.85), int(bark * 0.7), 255), -1)
    bare, conifer = style % 5 == 0, style % 5 == 1
    autumn = style % 7 == 3
    if bare:
        for _ in range(70):
            angle, long = rng.uniform(-1.2, 1.2), rng.uniform(30, 110)
            base = 130 - rng.uniform(0, 60)
            tip = (int(72 + long * math.sin(angle) * 0.6), int(base - long * math.cos(angle) * 0.8))
            cv2.line(
                sprite, (72, int(base)), tip, (bark, int(bark * 0.87), int(bark * 0.78), 255), int(rng.integers(1, 3))
            )
        return np.asarray(cv2.GaussianBlur(sprite, (3, 3), 0), np.uint8)
    count = 520
    # A crown is a handful of clumps; each clump is lit from above.
    clumps = [
        (72 + rng.normal(0, 24), rng.uniform(30, 112), rng.uniform(16, 34)) for _ in range(int(rng.integers(6, 12)))
    ]
    clumps.sort(key=lambda clump: -clump[1])
    leaf = (142, 96, 46) if autumn else (66 + 12 * (style % 3), 84, 44)
    for i in range(count):
        if conifer:
            v = 172 * (1 - i / count) ** 0.8 + 6
            u = 72 + rng.normal(0, 0.36) * (v - 2) * 0.34
            size, bright = int(rng.integers(3, 7)), rng.uniform(0.45, 0.95)
        else:
            cu, cv, radius = clumps[i * len(clumps) // count]
            angle, share = rng.uniform(0, 2 * math.pi), math.sqrt(rng.uniform(0, 1))
            u, v = cu + radius * share * math.cos(angle), cv + radius * 0.8 * share * math.sin(angle)
            size, bright = int(rng.integers(2, 6)), 0.72 - 0.42 * share * math.sin(angle) + rng.normal(0, 0.12)
        colour = tuple(int(np.clip(c * bright, 6, 255)) for c in leaf)
        cv2.circle(sprite, (int(u), int(v)), size, (*colour, 255), -1)
    return np.asarray(cv2.GaussianBlur(sprite, (3, 3), 0), np.uint8)


@functools.lru_cache(maxsize=8)
def _bush(style: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(500 + style)
    sprite = np.zeros((96, 144, 4), np.uint8)
    for i in range(260):
        u = rng.uniform(10, 134)
        top = 90 - 78 * math.sqrt(max(0.0, 1 - ((u - 72) / 66) ** 2)) * rng.uniform(0.75, 1)
        v = rng.uniform(top, 94)
        bright = (0.4 + 0.5 * i / 260) * rng.uniform(0.75, 1.1) * (1.15 - 0.5 * v / 96)
        colour = (int(66 * bright), int(86 * bright), int(42 * bright))
        cv2.circle(sprite, (int(u), int(v)), int(rng.integers(3, 8)), (*colour, 255), -1)
    return np.asarray(cv2.GaussianBlur(sprite, (3, 3), 0), np.uint8)


def _paste(
    image: NDArray[np.uint8],
    ids: NDArray[np.uint8],
    sprite: NDArray[np.uint8],
    foot: NDArray[np.float64],
    wide: float,
    light: Light,
    x: float,
    y: float,
) -> None:
    """Blend a picture with transparency over the image; ``foot`` is (2, 2): pixels of its foot and of its top."""
    tall = foot[0, 1] - foot[1, 1]
    left, top = foot[0, 0] - wide / 2, foot[1, 1]
    height, width = image.shape[:2]
    x0, x1 = max(0, round(left)), min(width, round(left + wide))
    y0, y1 = max(0, round(top)), min(height, round(foot[0, 1]))
    if x1 - x0 < 1 or y1 - y0 < 1 or tall < 2:
        return
    sh, sw = sprite.shape[:2]
    # Cut the part of the picture that is in view before it is scaled.
    cx0, cx1 = int((x0 - left) / wide * sw), max(math.ceil((x1 - left) / wide * sw), 1)
    cy0, cy1 = int((y0 - top) / tall * sh), max(math.ceil((y1 - top) / tall * sh), 1)
    part = sprite[max(cy0, 0) : min(cy1, sh), max(cx0, 0) : min(cx1, sw)]
    if part.size == 0:
        return
    shrink = part.shape[1] > x1 - x0
    part = cv2.resize(part, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    white, black = light.tone((255.0, 255.0, 255.0), x, y), light.tone((0.0, 0.0, 0.0), x, y)
    colours = cv2.transform(
        part,
        np.array(
            [
                [(white[0] - black[0]) / 255, 0, 0, 0, black[0]],
                [0, (white[1] - black[1]) / 255, 0, 0, black[1]],
                [0, 0, (white[2] - black[2]) / 255, 0, black[2]],
            ]
        ),
    )
    alpha = part[..., 3]
    region = image[y0:y1, x0:x1]
    weight = alpha.astype(np.float32) / 255
    region[:] = np.asarray(
        cv2.blendLinear(np.ascontiguousarray(colours), np.ascontiguousarray(region), weight, 1 - weight)
    )
    ids[y0:y1, x0:x1][alpha > 127] = SCENERY
