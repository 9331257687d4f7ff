"""Short videos: the same seed under several drivers, each with what its learner sees and the trace of its signal.

A tile is the picture of the scene, the observation where that is an image, and the trace, under a bar in the colour of
who drives. A trace is drawn once without its curve and once with it; a frame takes the columns up to the present from
the one and the rest from the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio.v2 as imageio
import numpy as np
from matplotlib import font_manager
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from safeswitch.handover.episode import Episode
from safeswitch.protocols import Driver
from safeswitch.scoring.style import BLACK, DRIVERS, GREY, Marks, canvas, log_axis, mark_events, positive

if TYPE_CHECKING:
    from safeswitch.protocols import Array
    from safeswitch.tasks.base import TaskEnv

Picture = NDArray[np.uint8]

HEIGHT = 192
"""Of everything below the bar [pixel]: three times that of a 64 x 64 observation."""
TRACE = 320
"""Width of a trace [pixel]."""
BAR, BORDER = 24, 4
"""Height of the bar and width of the frame around a tile [pixel]."""
COLOURS = {driver: tuple(round(255 * part) for part in to_rgb(colour)) for driver, colour in DRIVERS.items()}
INK = {Driver.LEARNER: "white", Driver.EXPERT: "black"}
"""Text on the bar."""


@dataclass(frozen=True)
class Trace:
    """The signal of an episode, to be drawn as it grows.

    Attributes:
        name: signal id.
        values: (T,), NaN after an early end.
        driver: (T,) `Driver` of each step.
        control_dt: control step [s].
        marks: what happens when; the handover shows once it has happened.
        threshold: of the rule on it; None without a rule.
        limits: lowest and highest value of the vertical axis; None for those of this signal.
    """

    name: str
    values: Array
    driver: NDArray[np.int8]
    control_dt: float
    marks: Marks
    threshold: float | None = None
    limits: tuple[float, float] | None = None

    def picture(self, step: int) -> Picture:
        """(HEIGHT, TRACE, 3) the trace up to `step`, with a line at the present."""
        handover = self.marks.handover
        layers, (left, right), (top, bottom) = self._drawn
        empty, full = layers[handover is not None and 0 <= handover <= step]
        now = int(left + (right - left) * step / len(self.values))
        picture = np.concatenate([full[:, : now + 1], empty[:, now + 1 :]], axis=1)
        picture[top:bottom, now] = 90
        return picture

    @cached_property
    def _drawn(self) -> tuple[dict[bool, tuple[Picture, Picture]], tuple[float, float], tuple[int, int]]:
        """Pictures (without, with curve) before and after the handover, and the axes' columns and rows [pixel]."""
        horizon = len(self.values)
        with canvas(TRACE / 80, HEIGHT / 80, 80) as figure:
            axes = figure.add_axes((0.14, 0.16, 0.82, 0.57))
            curves = self._curves(axes)
            low, high = self.limits or (float(np.nanmin(self.values)), float(np.nanmax(self.values)))
            spare = 1.15 if positive([low, high]) else 1.0
            axes.set_ylim(low / spare, high * spare if high > low else high + 1.0)
            if positive([low, high]):
                log_axis(axes, "y")
            axes.set_xlim(0, horizon * self.control_dt)
            axes.set_xlabel("time [s]", labelpad=0)
            figure.text(0.01, 0.98, self.name, ha="left", va="top", weight="bold")
            events = mark_events(axes, self.marks, self.control_dt, horizon, apart=0.22).get("handover", [])
            layers = {}
            for after in (False, True):
                for artist in events:
                    artist.set_visible(after)
                layers[after] = (_shot(figure, curves, False), _shot(figure, curves, True))
            box = axes.get_window_extent()
            return layers, (box.x0, box.x1), (HEIGHT - round(box.y1), HEIGHT - round(box.y0))

    def _curves(self, axes: Any) -> list[Any]:
        """The threshold, and the curve in the colours of the drivers, which alone is returned."""
        time = np.arange(len(self.values)) * self.control_dt
        if self.threshold is not None and np.isfinite(self.threshold):
            axes.axhline(self.threshold, color=BLACK, lw=1.2, ls=":")
            text = f"··· threshold {self.threshold:.3g}"
            axes.get_figure().text(0.96, 0.98, text, ha="right", va="top")
        curves = [axes.plot(time, self.values, color=GREY, lw=1.0)[0]]
        for driver, colour in DRIVERS.items():
            theirs = self.driver == driver
            curves += axes.plot(time, np.where(theirs, self.values, np.nan), color=colour, lw=2.0)
        return curves


def _shot(figure: Any, curves: Iterable[Any], visible: bool) -> Picture:
    """What the figure looks like with its curves or without."""
    for curve in curves:
        curve.set_visible(visible)
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba())[..., :3]


def sees_images(env: TaskEnv) -> bool:
    """Whether the task's observation is a picture."""
    return len(env.observation_space.shape or ()) == 3


def observations(env: TaskEnv, episode: Episode, steps: Iterable[int]) -> dict[int, Picture]:
    """Step -> what the learner saw then; steps after the end are left out.

    Args:
        env: the unwrapped environment of the episode's cell.
        episode: recorded with snapshots.
        steps: of the episode.
    """
    snapshots = _snapshots(episode)
    env.reset(seed=episode.seed)
    seen = {}
    for step in steps:
        if step < episode.length:
            env.restore(snapshots[step])
            seen[step] = env.observe()
    return seen


def replay(env: TaskEnv, episode: Episode) -> list[list[Picture]]:
    """Pictures of every executed step of a recorded episode: the scene and, where it is one, what the learner sees.

    Args:
        env: the unwrapped environment of the episode's cell, with ``render_mode="rgb_array"``.
        episode: recorded with snapshots.
    """
    snapshots = _snapshots(episode)
    env.reset(seed=episode.seed)
    pictures = []
    for step in range(episode.length):
        env.restore(snapshots[step])
        scene = env.render()
        assert scene is not None
        parts = [_scaled(scene, Image.Resampling.LANCZOS)]
        if step == episode.length - 1:
            parts[0] = _overlay(parts[0], "success" if episode.success else "failure", episode.success)
        if sees_images(env):
            parts.append(_scaled(env.observe(), Image.Resampling.NEAREST))
        pictures.append(parts)
    return pictures


def replay_frames(
    episode: Episode, pictures: Sequence[list[Picture]], caption: str, trace: Trace | None = None
) -> list[Picture]:
    """A tile for every executed step of a recorded episode.

    Args:
        episode: as in `replay`.
        pictures: what `replay` gave.
        caption: written above the pictures.
        trace: of a signal in this episode, drawn beside them.
    """
    frames = []
    for step, seen in enumerate(pictures):
        parts = seen if trace is None else [*seen, trace.picture(step)]
        captions = [caption, "what the learner sees"] if len(parts) == 3 else [caption]
        frames.append(_tile(parts, captions, _remark(episode, step), Driver(int(episode.driver[step]))))
    return frames


def write_side_by_side(panels: Sequence[list[Picture]], path: Path, fps: int, columns: int | None = None) -> None:
    """Write tiles beside one another, `columns` in a row, as .mp4 or .gif.

    A tile that ends early keeps its last frame; all keep it for one second, so that the verdict can be read.
    """
    columns = columns or len(panels)
    blank = np.zeros_like(panels[0][0])
    film = {"fps": fps, "codec": "libx264", "quality": 6, "macro_block_size": 2}
    options: dict[str, Any] = {"duration": 1000 / fps} if path.suffix == ".gif" else film
    with imageio.get_writer(path, **options) as writer:
        for index in range(max(map(len, panels)) + fps):
            tiles = [frames[min(index, len(frames) - 1)] for frames in panels]
            tiles += [blank] * (-len(tiles) % columns)
            rows = [np.concatenate(tiles[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
            writer.append_data(np.concatenate(rows))


def _snapshots(episode: Episode) -> Array:
    if episode.snapshots is None:
        raise ValueError("a replay needs the episode's snapshots: record it with record_snapshots=True")
    return episode.snapshots


def _remark(episode: Episode, step: int) -> str:
    remarks = []
    if 0 <= episode.onset <= step:
        remarks.append("disturbed")
    remarks.append("EXPERT" if episode.driver[step] == Driver.EXPERT else "learner")
    return " · ".join(remarks)


def _scaled(picture: Picture, how: Image.Resampling) -> Picture:
    """At the tile's height, its proportions kept; an even width, as video encoders want."""
    width = 2 * round(HEIGHT * picture.shape[1] / picture.shape[0] / 2)
    return np.asarray(Image.fromarray(picture).resize((width, HEIGHT), how))


def _tile(parts: Sequence[Picture], captions: Sequence[str], remark: str, driver: Driver) -> Picture:
    """Parts beside one another, framed in the driver's colour, a caption above each as far as there are any."""
    width = sum(part.shape[1] + BORDER for part in parts) + BORDER
    image = Image.new("RGB", (width, HEIGHT + BAR + BORDER), COLOURS[driver])
    draw = ImageDraw.Draw(image)
    left = BORDER
    for index, part in enumerate(parts):
        image.paste(Image.fromarray(part), (left, BAR))
        if index < len(captions):
            draw.text((left + 4, BAR // 2), captions[index], fill=INK[driver], font=_font(), anchor="lm")
        left += part.shape[1] + BORDER
    draw.text((width - 8, BAR // 2), remark, fill=INK[driver], font=_font(), anchor="rm")
    return np.asarray(image)


def _overlay(picture: Picture, text: str, good: bool) -> Picture:
    image = Image.fromarray(picture)
    fill = (0, 110, 80) if good else (180, 70, 0)
    ImageDraw.Draw(image).text((image.width // 2, 20), text, fill=fill, font=_font(20), anchor="mm")
    return np.asarray(image)


def _font(size: int = 13) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib ships."""
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)
