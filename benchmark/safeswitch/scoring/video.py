"""Short videos: the same seed under several drivers side by side, the driver shown by the colour of the frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio.v2 as imageio
import numpy as np
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from safeswitch.handover.episode import Episode
from safeswitch.protocols import Driver

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

COLOURS = {Driver.LEARNER: (0, 114, 178), Driver.EXPERT: (230, 159, 0)}
"""Okabe & Ito's colour-blind-safe blue and orange."""

PANEL = (320, 212)
"""Width and height of one panel [pixel]; even, as video encoders want."""

BAR = 24
"""Height of the caption bar [pixel]."""


def replay_frames(env: TaskEnv, episode: Episode, caption: str) -> list[NDArray[np.uint8]]:
    """Pictures of every executed step of a recorded episode.

    Args:
        env: the unwrapped environment of the episode's cell, with ``render_mode="rgb_array"``.
        episode: recorded with snapshots.
        caption: written above the pictures.
    """
    if episode.snapshots is None:
        raise ValueError("a replay needs the episode's snapshots: record it with record_snapshots=True")
    env.reset(seed=episode.seed)
    frames = []
    for step in range(episode.length):
        env.restore(episode.snapshots[step])
        picture = env.render()
        assert isinstance(picture, np.ndarray)
        frames.append(_panel(picture, caption, _remark(episode, step), Driver(int(episode.driver[step]))))
    verdict = "success" if episode.success else "failure"
    last = frames[-1].copy()
    frames[-1] = _overlay(last, verdict, episode.success)
    return frames


def write_side_by_side(panels: Sequence[list[NDArray[np.uint8]]], path: Path, fps: int) -> None:
    """Write panels beside one another as .mp4 or .gif; a panel that ends early keeps its last frame."""
    count = max(len(frames) for frames in panels)
    hold = fps  # one second on the last frame, so that the verdict can be read
    film = {"fps": fps, "codec": "libx264", "quality": 6, "macro_block_size": 2}
    options: dict[str, Any] = {"duration": 1000 / fps} if path.suffix == ".gif" else film
    with imageio.get_writer(path, **options) as writer:
        for index in range(count + hold):
            writer.append_data(np.concatenate([frames[min(index, len(frames) - 1)] for frames in panels], axis=1))


def _remark(episode: Episode, step: int) -> str:
    remarks = []
    if 0 <= episode.onset <= step:
        remarks.append("disturbed")
    remarks.append("EXPERT" if episode.driver[step] == Driver.EXPERT else "learner")
    return " · ".join(remarks)


def _panel(picture: NDArray[np.uint8], caption: str, remark: str, driver: Driver) -> NDArray[np.uint8]:
    image = Image.new("RGB", (PANEL[0], PANEL[1] + BAR), COLOURS[driver])
    image.paste(Image.fromarray(picture).resize((PANEL[0] - 8, PANEL[1] - 4)), (4, BAR))
    draw = ImageDraw.Draw(image)
    draw.text((8, BAR // 2), caption, fill="white", font=_font(), anchor="lm")
    draw.text((PANEL[0] - 8, BAR // 2), remark, fill="white", font=_font(), anchor="rm")
    return np.asarray(image)


def _overlay(frame: NDArray[np.uint8], text: str, good: bool) -> NDArray[np.uint8]:
    image = Image.fromarray(frame)
    fill = (0, 158, 115) if good else (213, 94, 0)
    ImageDraw.Draw(image).text((PANEL[0] // 2, BAR + 20), text, fill=fill, font=_font(20), anchor="mm")
    return np.asarray(image)


def _font(size: int = 13) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib ships."""
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)
