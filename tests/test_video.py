"""The film: tiles of real episodes, in which scene, observation and trace agree with what was recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import imageio.v2 as imageio
import numpy as np
import pytest

import safeswitch  # noqa: F401  (registers the tasks)
from safeswitch import registry
from safeswitch.handover.episode import Episode, NeverSwitch, run_episode
from safeswitch.protocols import Driver, Prediction
from safeswitch.scoring.style import Marks
from safeswitch.scoring.video import (
    BAR,
    BORDER,
    COLOURS,
    HEIGHT,
    TRACE,
    Trace,
    observations,
    replay,
    replay_frames,
    sees_images,
    write_side_by_side,
)

SEED = 3
TILE = HEIGHT + BAR + BORDER


class HandOver:
    """The expert drives from a step on."""

    def __init__(self, step: int) -> None:
        self.step = step

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def arm(self, step: int) -> Driver:
        """The learner drives."""
        return Driver.LEARNER

    def update(self, step: int, signals: Any) -> Driver:
        """The expert, once it is time."""
        return Driver.EXPERT if step + 1 >= self.step else Driver.LEARNER


class Watcher:
    """A learner of images without a network: pushes gently to where the picture is brighter, and doubts contrast."""

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def predict(self, observation: Any, step: int) -> Prediction:
        """A function of the picture."""
        half = observation.shape[1] // 2
        push = observation[:, half:].mean() - observation[:, :half].mean()
        return Prediction(np.array([0.1 * np.tanh(push)]), np.array([observation.std() / 500]), np.array([0.01]))


def drive(task: str, learner: Any, handover: int | None = 30, **kwargs: Any) -> tuple[Any, Episode]:
    env: Any = gymnasium.make(task, render_mode="rgb_array", **kwargs).unwrapped
    rule = NeverSwitch() if handover is None else HandOver(handover)
    signals = [registry.make_signal("total")]
    return env, run_episode(env, learner, signals, rule, env.make_expert(), SEED, record_snapshots=True)


def trace_of(episode: Episode, control_dt: float, **options: Any) -> Trace:
    marks = Marks(episode.onset, episode.handover)
    return Trace("total", episode.signals["total"], episode.driver, control_dt, marks, **options)


@pytest.fixture(scope="module")
def state(tiny_learner: Path) -> tuple[Any, Episode]:
    """An episode of the cart-pole, disturbed, that the expert takes over at step 30 if it lasts so long."""
    from safeswitch_baselines.learners.bayesian import BayesianLearner

    return drive(
        "SafeSwitch/CartPole-v0", BayesianLearner.load(tiny_learner), disturbance="cart-mass", width=144, height=96
    )


@pytest.fixture(scope="module")
def image() -> tuple[Any, Episode]:
    """An episode of the cart-pole from images with an object, that the expert takes over at step 30."""
    return drive("SafeSwitch/CartPoleImage-v0", Watcher(), disturbance="object", width=192, height=192)


def test_trace_grows_with_time_and_shows_nothing_of_the_future(state: tuple[Any, Episode]) -> None:
    env, episode = state
    trace = trace_of(episode, env.control_dt, threshold=0.3)
    assert 30 == episode.handover < episode.length
    last = trace.picture(episode.length - 1)
    past = 0
    for step in (2, 10, 29, 31, episode.length - 2):
        picture = trace.picture(step)
        assert picture.shape == (HEIGHT, TRACE, 3) and picture.dtype == np.uint8
        changed = np.flatnonzero((picture != last).any(axis=(0, 2)))
        cursor = round(TRACE * (0.14 + 0.82 * step / episode.horizon))
        if step >= 30:  # before, the handover is not shown yet
            assert changed.min() >= cursor - 2
        coloured = is_colour(picture, COLOURS[Driver.LEARNER]) | is_colour(picture, COLOURS[Driver.EXPERT])
        assert np.flatnonzero(coloured.any(axis=0)).max(initial=0) <= cursor + 2
        assert coloured.sum() > past
        past = int(coloured.sum())


def test_handover_is_marked_once_it_has_happened(state: tuple[Any, Episode]) -> None:
    env, episode = state
    trace = trace_of(episode, env.control_dt)
    green = [is_colour(trace.picture(step), (0, 158, 115)).sum() for step in (0, 29, 31, 40)]
    assert green[0] == green[1] == 0 < green[2] and green[3] > 50


def test_expert_and_learner_draw_in_their_colours(state: tuple[Any, Episode]) -> None:
    env, episode = state
    picture = trace_of(episode, env.control_dt).picture(episode.length - 1)
    turn = TRACE * (0.14 + 0.82 * 30 / episode.horizon)
    columns = {driver: np.flatnonzero(is_colour(picture, colour).any(axis=0)) for driver, colour in COLOURS.items()}
    assert columns[Driver.LEARNER].max() <= turn + 2 <= columns[Driver.EXPERT].min() + 4


def is_colour(picture: Any, colour: tuple[int, ...]) -> Any:
    return (np.abs(picture.astype(int) - colour) <= 2).all(axis=2)


@pytest.mark.rendering
def test_tiles_of_a_state_task(state: tuple[Any, Episode]) -> None:
    env, episode = state
    seen = replay(env, episode)
    plain, traced = (replay_frames(episode, seen, "rule", trace) for trace in (None, trace_of(episode, 0.06)))
    assert not sees_images(env) and len(plain) == len(traced) == episode.length
    assert plain[0].shape == (TILE, 288 + 2 * BORDER, 3)  # 144 x 96 at the tile's height
    assert traced[0].shape == (TILE, 288 + TRACE + 3 * BORDER, 3)
    for step in (0, 29, 30, episode.length - 1):
        assert tuple(traced[step][-1, 0]) == COLOURS[Driver(int(episode.driver[step]))]
        scene = slice(BAR, BAR + HEIGHT), slice(BORDER, BORDER + 288)
        assert np.array_equal(plain[step][scene], traced[step][scene])


@pytest.mark.rendering
def test_a_film_shows_the_pixels_that_the_learner_saw(image: tuple[Any, Episode]) -> None:
    env, episode = image
    seen = observations(env, episode, range(episode.horizon + 5))
    assert sees_images(env) and list(seen) == list(range(episode.length))
    frames = replay_frames(episode, replay(env, episode), "rule", trace_of(episode, env.control_dt))
    left = 2 * BORDER + 192
    for step in (0, episode.onset - 1, episode.onset, episode.length - 1):
        view = frames[step][BAR : BAR + HEIGHT, left : left + HEIGHT]
        assert np.array_equal(view, np.kron(seen[step], np.ones((3, 3, 1), np.uint8)))
    env.reset(seed=SEED)
    env.restore(episode.snapshots[episode.onset])
    assert np.array_equal(seen[episode.onset], env.observe())
    assert not np.array_equal(seen[episode.onset], env.observe(clean=True))


@pytest.mark.rendering
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_film_of_four_drivers_is_small_and_as_long_as_its_longest(
    image: tuple[Any, Episode], tmp_path: Path, suffix: str
) -> None:
    env, episode = image
    frames = replay_frames(episode, replay(env, episode), "rule", trace_of(episode, env.control_dt))
    path, fps = tmp_path / f"film{suffix}", round(1 / env.control_dt)
    frames = frames if suffix == ".mp4" else frames[:12]
    write_side_by_side([frames, frames[:8], frames, frames[:10]], path, fps, columns=2)
    film = list(iter(imageio.get_reader(path)))
    still = fps if suffix == ".mp4" else 0  # a .gif keeps pictures that repeat as one
    assert len(film) == len(frames) + still
    assert film[0].shape[:2] == (2 * TILE, 2 * frames[0].shape[1])
    assert path.stat().st_size < 1_000_000
    ended = np.asarray(film[11])[:TILE, frames[0].shape[1] :, :3].astype(int)  # keeps its last frame
    assert np.abs(ended - frames[7]).mean() < 8


@pytest.mark.rendering
def test_an_empty_place_of_the_grid_is_black(state: tuple[Any, Episode], tmp_path: Path) -> None:
    env, episode = state
    frames = replay_frames(episode, replay(env, episode), "rule")[:3]
    write_side_by_side([frames] * 3, tmp_path / "film.gif", 2, columns=2)
    first = np.asarray(imageio.mimread(tmp_path / "film.gif")[0])[..., :3]
    assert first[TILE:, frames[0].shape[1] :].max() == 0 < first[TILE:, : frames[0].shape[1]].max()


def test_a_replay_needs_snapshots(tiny_learner: Path) -> None:
    from safeswitch_baselines.learners.bayesian import BayesianLearner

    env: Any = gymnasium.make("SafeSwitch/CartPole-v0", render_mode="rgb_array").unwrapped
    learner = BayesianLearner.load(tiny_learner)
    episode = run_episode(env, learner, [], NeverSwitch(), None, SEED)
    with pytest.raises(ValueError, match="record_snapshots=True"):
        replay(env, episode)
    with pytest.raises(ValueError, match="record_snapshots=True"):
        observations(env, episode, [0])
