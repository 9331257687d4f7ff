"""The rally car's world: the car on a dirt track between borders and banks, composed and compiled.

Everything is made from the `Track`: the painted ground, two black tubes along the edges, and earth banks behind them,
which hide one part of the track from the next, so that what stands on the track comes into view at a bend. Only the
ground is touched; whoever touches a border has left the track before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.seeding import stream
from safeswitch.tasks import models
from safeswitch.tasks.track import Track

Array = NDArray[np.float64]

SIDE = 36.0
"""Width of the ground [m], a square about the origin."""
PIXELS = 1024
"""Of the ground's picture, along one side: 3.5 cm each."""
COARSE = 512
"""Pixels in which the distance from the centreline is computed, before it is interpolated."""
TUBE_RADIUS = 0.06
"""[m]"""
TUBE_OFFSET = 0.10
"""Of the tubes' axes beyond the edge [m]."""
PIECE = 0.5
"""Length of the pieces of tubes and banks along the track [m]."""
BANK: tuple[tuple[float, float], ...] = ((0.20, -0.02), (0.65, 0.62), (0.85, 0.75), (1.05, 0.62), (1.55, -0.02))
"""Cross-section of a bank: distance beyond the edge, height [m]. A lens 0.30 m high sees nothing behind it."""
HIDING_GROUP = 2
"""Geom group of banks and tubes, by which rays of sight find them."""
BACKDROP_HEIGHT = 14.0
"""[m]: fills the onboard camera's view above the horizon from anywhere on the track."""
BACKDROP = (128, 512)
"""Pixels of its picture: height, width."""

DIRT, DRY, RUT, GRASS, STONE = (
    np.array(colour, float)
    for colour in ((158, 120, 84), (186, 152, 112), (116, 84, 58), (112, 116, 62), (146, 138, 120))
)
SKY_LOW, SKY_HIGH, HILLS, TREES = (
    np.array(colour, float) for colour in ((222, 228, 232), (150, 182, 214), (120, 138, 130), (72, 88, 58))
)


@lru_cache(maxsize=8)
def rally_car(track: Track, timestep: float, actions: int) -> mujoco.MjModel:
    """Compiled car on `track`, with room for an action of `actions` numbers.

    Shared within the process: copy it before changing it.
    """
    tree = models.compose("rally_car/rally_car.xml")
    tree.include_copy(models.part("rally_car/course.xml"))
    tree.option.timestep = timestep
    tree.size.nuserdata = actions
    tree.statistic.extent = 1.0  # near and far plane are then in metres
    tree.statistic.center = [0.0, 0.0, 0.0]
    tree.visual.map.zfar = 70.0
    tree.visual.map.shadowclip = 2.0
    tree.visual.quality.shadowsize = 2048
    _lay_ground(tree)
    _build_tubes(tree, track)
    _build_banks(tree, track)
    _hang_backdrop(tree)
    model = models.compile_model(tree)
    _fill(model, "ground", ground_picture(track))
    _fill(model, "backdrop", backdrop_picture())
    return model


def _lay_ground(tree: Any) -> None:
    """Have the tyres touch the ground, and give it its picture."""
    for light in tree.find_all("light"):
        if light.parent.tag == "worldbody":
            light.remove()  # the sun of this scene follows the car
    texture, material = tree.find("texture", "ground"), tree.find("material", "ground")
    texture.builtin, texture.width, texture.height = "flat", PIXELS, PIXELS
    material.texrepeat, material.texuniform = [1.0, 1.0], False
    material.specular = material.shininess = 0.0
    ground = tree.find("geom", "ground")
    ground.size = [0.5 * SIDE, 0.5 * SIDE, 1.0]
    ground.conaffinity = 1


def _build_tubes(tree: Any, track: Track) -> None:
    """A black tube along either edge."""
    material = tree.asset.add("material", name="tube", rgba=[0.06, 0.06, 0.07, 1.0], specular=0.4, shininess=0.4)
    angles = np.linspace(math.radians(210), math.radians(-30), 6)  # open where it lies on the ground
    section = [(TUBE_OFFSET + TUBE_RADIUS * math.cos(a), TUBE_RADIUS * (0.5 + math.sin(a))) for a in angles]
    _build_along(tree, track, "tube", material, section)


def _build_banks(tree: Any, track: Track) -> None:
    """An earth bank behind either tube."""
    material = tree.asset.add("material", name="bank", rgba=[0.50, 0.44, 0.28, 1.0], specular=0.0, shininess=0.0)
    _build_along(tree, track, "bank", material, BANK, roughness=0.06)


def _build_along(
    tree: Any,
    track: Track,
    name: str,
    material: Any,
    section: Sequence[tuple[float, float]],
    roughness: float = 0.0,
) -> None:
    """A mesh on either side of the track: a cross-section (distance beyond the edge, height) [m] carried around it."""
    s = _pieces(track)
    rng = stream(0, f"roughness of the {name}")
    for side, where in ((1.0, "left"), (-1.0, "right")):
        rough = 1.0 + roughness * rng.standard_normal((len(section), len(s)))
        rows = [
            np.column_stack([track.point(s, side * (track.half_width + offset)), height * rough[index]])
            for index, (offset, height) in enumerate(section)
        ]
        vertices = np.stack(rows, axis=1)
        faces = _strip_faces(len(s), len(section), flip=side < 0)
        tree.asset.add("mesh", name=f"{name}_{where}", vertex=vertices.ravel(), face=faces.ravel(), inertia="shell")
        tree.worldbody.add(
            "geom",
            name=f"{name}_{where}",
            type="mesh",
            mesh=f"{name}_{where}",
            material=material,
            contype=0,
            conaffinity=0,
            mass=0,
            group=HIDING_GROUP,
        )


def _strip_faces(count: int, width: int, flip: bool) -> NDArray[np.int64]:
    """Triangles (n, 3) between neighbouring cross-sections of `width` vertices, around a closed track."""
    faces = []
    for here in range(count):
        there = (here + 1) % count
        for column in range(width - 1):
            a, b = here * width + column, here * width + column + 1
            c, d = there * width + column, there * width + column + 1
            faces += [(a, b, c), (b, d, c)] if flip else [(a, c, b), (b, c, d)]
    return np.array(faces, np.int64)


def _pieces(track: Track) -> Array:
    """Arc lengths (n,) at which the pieces of borders and banks meet [m]."""
    count = round(track.length / PIECE)
    return np.arange(count, dtype=np.float64) * (track.length / count)


def _hang_backdrop(tree: Any) -> None:
    """Four vertical planes with sky, hills and trees; the camera's view ends there."""
    height, width = BACKDROP
    texture = tree.asset.add("texture", name="backdrop", type="2d", builtin="flat", width=width, height=height)
    material = tree.asset.add(
        "material", name="backdrop", texture=texture, texuniform=False, emission=0.75, specular=0.0, shininess=0.0
    )
    half = 0.5 * SIDE
    for index, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        tree.worldbody.add(
            "geom",
            name=f"backdrop_{index}",
            type="plane",
            size=[half, 0.5 * BACKDROP_HEIGHT, 1.0],
            pos=[half * x, half * y, 0.5 * BACKDROP_HEIGHT],
            xyaxes=[y, -x, 0, 0, 0, 1],  # the normal points inwards
            material=material,
            contype=0,
            conaffinity=0,
            mass=0,
            group=1,
        )


def _fill(model: mujoco.MjModel, texture: str, picture: NDArray[np.uint8]) -> None:
    """Write a picture (height, width, 3), lowest row first, into a texture of the same size."""
    index = model.texture(texture).id
    start = model.tex_adr[index]
    model.tex_data[start : start + picture.size] = picture[::-1].ravel()


# ----------------------------------------------------------------------------------------------------------- pictures


@lru_cache(maxsize=8)
def ground_picture(track: Track) -> NDArray[np.uint8]:
    """Picture (PIXELS, PIXELS, 3) of the ground; rows run along y, columns along x."""
    from scipy.ndimage import gaussian_filter

    offset = _offsets(track)
    rng = stream(0, "ground")

    def grain(*sizes: float) -> Array:
        """Noise of unit variance with patches of these sizes [pixel]."""
        total = np.zeros((PIXELS, PIXELS))
        for size in sizes:
            factor = max(int(size / 2), 1)
            small = rng.standard_normal((PIXELS // factor + 1,) * 2)
            smooth = gaussian_filter(small, max(size / factor / 2, 0.5), mode="wrap")
            smooth /= smooth.std()
            total += np.kron(smooth, np.ones((factor, factor)))[:PIXELS, :PIXELS]
        return total / np.sqrt(len(sizes))

    fine, coarse = grain(1, 3), grain(12, 40)
    ruts = np.exp(-((np.abs(offset) - 0.19) ** 2) / (2 * 0.09**2)) * (0.9 + 0.15 * coarse)
    dust = np.clip((np.abs(offset) - 0.7) / 0.8, 0.0, 1.0)
    dirt = _mix(_mix(DIRT, DRY, np.clip(0.6 * dust + 0.15 * coarse, 0.0, 1.0)), RUT, np.clip(ruts, 0.0, 1.0))
    wild = _mix(GRASS, STONE, np.clip(0.35 + 0.3 * coarse, 0.0, 1.0))
    edge = np.clip((np.abs(offset) - track.half_width - 0.02 - 0.04 * coarse) / 0.10, 0.0, 1.0)
    picture = _mix(dirt, wild, edge) * (1.0 + 0.07 * fine + 0.04 * coarse)[..., None]
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _offsets(track: Track) -> Array:
    """Lateral distance (PIXELS, PIXELS) of every pixel of the ground from the centreline [m], positive to the left."""
    from scipy.ndimage import map_coordinates
    from scipy.spatial import cKDTree

    s = np.linspace(0.0, track.length, 1400, endpoint=False)
    centre, heading = track.position(s), track.heading(s)
    grid = ((np.arange(COARSE) + 0.5) / COARSE - 0.5) * SIDE
    points = np.stack(np.meshgrid(grid, grid), axis=-1)
    distance, nearest = cKDTree(centre).query(points)
    towards = points - centre[nearest]
    left = np.cos(heading[nearest]) * towards[..., 1] - np.sin(heading[nearest]) * towards[..., 0]
    fine = (np.arange(PIXELS) + 0.5) * COARSE / PIXELS - 0.5
    signed = np.copysign(distance, left)
    return np.asarray(map_coordinates(signed, np.meshgrid(fine, fine, indexing="ij"), order=1, mode="nearest"))


def backdrop_picture() -> NDArray[np.uint8]:
    """Picture of the horizon: sky above, a chain of hills, a line of trees; it repeats from left to right."""
    height, width = BACKDROP
    rng = stream(0, "backdrop")
    angle = np.arange(width) / width * 2.0 * np.pi

    def skyline(low: float, high: float, waves: int, roughness: float) -> Array:
        """Height (width,) of an outline as a share of the picture."""
        outline = sum(
            rng.normal() / order**roughness * np.cos(order * angle + rng.uniform(0, 2 * np.pi))
            for order in range(1, waves)
        )
        outline = (outline - np.min(outline)) / np.ptp(outline)
        return low + (high - low) * outline

    up = (np.arange(height) / height)[:, None]
    picture = _mix(SKY_LOW, SKY_HIGH, np.broadcast_to(np.clip(1.4 * up, 0.0, 1.0), (height, width)))
    picture = _mix(picture, HILLS, (up < skyline(0.12, 0.30, 8, 1.0)).astype(float))
    picture = _mix(picture, TREES, (up < skyline(0.05, 0.14, 60, 0.2)).astype(float))
    return np.clip(picture * (1.0 + 0.02 * rng.standard_normal((height, width, 1))), 0, 255).astype(np.uint8)


def _mix(first: Array, second: Array, share: Array) -> Array:
    """Colours with a `share` (...) of the second."""
    return (1.0 - share)[..., None] * first + share[..., None] * second
