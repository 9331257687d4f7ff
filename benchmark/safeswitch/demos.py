"""Demonstrations of the expert: noise in the executed action, the clean action as label, kept as a Minari dataset.

Noise drives the expert off its own trajectories, so the learner also sees how to come back (Laskey et al. 2017,
arXiv 1703.09327). The dataset holds the executed action as Minari's `actions` and the expert's own action, the label,
in ``infos["expert_action"]``. Every episode is a function of its seed: the same bits for any number of workers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.datasets import METADATA, EpisodeFrames, is_image, make_task, write
from safeswitch.names import unknown
from safeswitch.seeding import stream

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

CHUNK = 10
"""Episodes that a worker rolls out with one environment and one expert."""


@dataclass(frozen=True)
class Noise:
    """Gaussian noise in the executed action; each episode draws its own size.

    Attributes:
        low: smallest standard deviation of an episode, action units.
        high: largest one; the episodes' values are uniform between the two.
        correlated_fraction: share of the episodes whose noise is a first-order autoregressive process.
        correlation: its correlation between neighbouring steps; the standard deviation stays the same.
    """

    low: float = 0.0
    high: float = 0.2
    correlated_fraction: float = 0.0
    correlation: float = 0.8

    def __post_init__(self) -> None:
        """Reject values that are no noise."""
        if not 0 <= self.low <= self.high:
            raise ValueError(f"noise must have 0 <= low <= high, got low={self.low}, high={self.high}")
        if not 0 <= self.correlated_fraction <= 1:
            raise ValueError(f"correlated_fraction must lie in [0, 1], got {self.correlated_fraction}")
        if not 0 <= self.correlation < 1:
            raise ValueError(f"correlation must lie in [0, 1), got {self.correlation}")

    def draw(self, seed: int, horizon: int, nu: int) -> NDArray[np.float64]:
        """Noise (horizon, nu) of the episode `seed`, action units."""
        rng = stream(seed, "demonstration-noise")
        std = rng.uniform(self.low, self.high)
        correlation = self.correlation if rng.random() < self.correlated_fraction else 0.0
        noise = rng.standard_normal((horizon, nu))
        innovation = np.sqrt(1.0 - correlation**2)
        for step in range(1, horizon):
            noise[step] = correlation * noise[step - 1] + innovation * noise[step]
        return std * noise


@dataclass(frozen=True)
class Rollout:
    """One demonstration of L steps.

    Attributes:
        seed: episode seed.
        success: the task's criterion at the end.
        observations: (L + 1, ...).
        actions: (L, nu), executed.
        labels: (L + 1, nu), the expert's own action in every state.
        states: (L + 1, nx), full states, SI units.
        rewards: (L,).
        terminated: (L,) bool.
        truncated: (L,) bool.
    """

    seed: int
    success: bool
    observations: NDArray[Any]
    actions: NDArray[Any]
    labels: NDArray[np.float64]
    states: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


@dataclass(frozen=True)
class Demonstrations:
    """What a learner is trained on: n steps of several episodes, in order.

    Attributes:
        observations: (n, ...), as the environment gives them; images stay in their file until an episode is asked for.
        actions: (n, nu), clean expert labels in action units.
        episodes: (n,), index of the episode that a step belongs to.
        settings: how they were made (environment, seeds, noise).
        executed: (n, nu), the actions that were executed, noise included; None where nobody kept them.
    """

    observations: NDArray[Any] | EpisodeFrames
    actions: NDArray[np.float64]
    episodes: NDArray[np.int64]
    settings: Mapping[str, Any] = field(default_factory=dict)
    executed: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.observations)

    def steps(self, episode: int) -> slice:
        """Where the steps of an episode are."""
        start, stop = np.searchsorted(self.episodes, [episode, episode + 1])
        return slice(int(start), int(stop))

    def episode(self, episode: int) -> NDArray[Any]:
        """Observations (L, ...) of an episode."""
        if isinstance(self.observations, EpisodeFrames):
            return self.observations.episode(episode)
        return self.observations[self.steps(episode)]

    def first(self, count: int) -> Demonstrations:
        """The first `count` episodes; all of them if there are no more."""
        end = int(np.searchsorted(self.episodes, count))
        images = self.observations
        return replace(
            self,
            observations=images.first(count) if isinstance(images, EpisodeFrames) else images[:end],
            actions=self.actions[:end],
            episodes=self.episodes[:end],
            executed=None if self.executed is None else self.executed[:end],
        )


def collect(
    env_id: str,
    dataset_id: str,
    root: Path | str,
    seeds: Sequence[int],
    *,
    noise: Noise | Mapping[str, float] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    n_jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Roll the expert out and write the Minari dataset `dataset_id` below `root`, in place of an older one.

    Args:
        env_id: Gymnasium id, for example "SafeSwitch/CartPole-v0".
        dataset_id: Minari id, for example "safeswitch/cart-pole/expert-v0".
        root: folder of the datasets (Minari's MINARI_DATASETS_PATH).
        seeds: episode seeds, one demonstration each.
        noise: `Noise`, or its fields by name; None for the default.
        env_kwargs: arguments of `gymnasium.make`.
        n_jobs: worker processes.
        progress: called with (demonstrations done, demonstrations).

    Returns:
        Folder of the dataset.
    """
    setting = make_noise(noise)
    rollouts: list[Rollout] = []
    for rollout in roll_out(env_id, seeds, setting, env_kwargs, n_jobs):
        rollouts.append(rollout)
        if progress is not None:
            progress(len(rollouts), len(seeds))
    return write(rollouts, env_id, dataset_id, root, setting, env_kwargs)


def make_noise(noise: Noise | Mapping[str, float] | None) -> Noise:
    """`noise` as a `Noise`; unknown field names are errors that name the valid ones."""
    if noise is None or isinstance(noise, Noise):
        return noise or Noise()
    for name in noise:
        if name not in Noise.__dataclass_fields__:
            raise unknown("noise setting", name, Noise.__dataclass_fields__)
    return Noise(**noise)


def roll_out(
    env_id: str,
    seeds: Sequence[int],
    noise: Noise,
    env_kwargs: Mapping[str, Any] | None = None,
    n_jobs: int = 1,
) -> Iterator[Rollout]:
    """Demonstrations of the episodes `seeds`, in their order."""
    if len(seeds) == 0:
        raise ValueError("no demonstrations: seeds is empty")
    if len(set(seeds)) < len(seeds):
        raise ValueError("seeds must differ: an episode that occurs twice teaches nothing new")
    from joblib import Parallel, delayed

    chunks = [list(seeds[start : start + CHUNK]) for start in range(0, len(seeds), CHUNK)]
    parallel = Parallel(n_jobs=n_jobs, return_as="generator")
    for rollouts in parallel(
        delayed(_roll_out_chunk)(env_id, chunk, noise, dict(env_kwargs or {})) for chunk in chunks
    ):
        yield from rollouts


def _roll_out_chunk(env_id: str, seeds: Sequence[int], noise: Noise, env_kwargs: Mapping[str, Any]) -> list[Rollout]:
    """Episodes with one environment and one expert; both forget everything between episodes."""
    env = make_task(env_id, env_kwargs)
    try:
        expert = env.make_expert()
        return [_roll_out_episode(env, expert, seed, noise) for seed in seeds]
    finally:
        env.close()


def _roll_out_episode(env: TaskEnv, expert: Any, seed: int, noise: Noise) -> Rollout:
    observation, _ = env.reset(seed=seed)
    expert.reset()
    space: Any = env.action_space
    disturbances = noise.draw(seed, env.horizon, space.shape[0])
    observations, states, labels = [observation], [env.state], [expert.action(env.state, env.parameters)]
    actions: list[NDArray[Any]] = []
    rewards, terminated, truncated = [], [], []
    while not env.done:
        # Rounded to the type of the action space before it is executed: the stored episode replays bit for bit.
        action = np.clip(labels[-1] + disturbances[len(actions)], space.low, space.high).astype(space.dtype)
        observation, reward, failed, over, _ = env.step(action)
        observations.append(observation)
        actions.append(action)
        rewards.append(float(reward))
        terminated.append(failed)
        truncated.append(over)
        states.append(env.state)
        labels.append(expert.action(env.state, env.parameters))
    return Rollout(
        seed=seed,
        success=env.is_success,
        observations=np.stack(observations),
        actions=np.stack(actions),
        labels=np.stack(labels).astype(np.float64),
        states=np.stack(states),
        rewards=np.array(rewards),
        terminated=np.array(terminated, dtype=bool),
        truncated=np.array(truncated, dtype=bool),
    )


def load(dataset_id: str, root: Path | str) -> Demonstrations:
    """Read the observations and clean expert labels of a dataset back from Minari.

    Raises:
        FileNotFoundError: there is no such dataset below `root`; the message names those that are there.
    """
    import h5py

    folder = Path(root) / dataset_id / "data"
    if not (folder / "metadata.json").is_file():
        there = sorted(str(path.parent.parent.relative_to(root)) for path in Path(root).glob("**/data/metadata.json"))
        listing = ", ".join(there) if there else "there are none; `collect` makes one"
        raise FileNotFoundError(f"no Minari dataset {dataset_id!r} below {root}; datasets there: {listing}")
    file = folder / "main_data.hdf5"
    settings = json.loads(json.loads((folder / "metadata.json").read_text(encoding="utf-8")).get(METADATA, "{}"))
    observations, labels, executed, lengths = [], [], [], []
    with h5py.File(file, "r") as data:
        for index in range(len(data)):
            episode = data[f"episode_{index}"]
            if "expert_action" not in episode.get("infos", {}):
                raise ValueError(
                    f"dataset {dataset_id!r} has no infos['expert_action']: it is no set of demonstrations"
                )
            lengths.append(len(episode["rewards"]))
            labels.append(episode["infos"]["expert_action"][: lengths[-1]])
            executed.append(episode["actions"][: lengths[-1]])
            if not is_image(episode["observations"]):
                observations.append(episode["observations"][: lengths[-1]])
    images = EpisodeFrames(file, lengths) if not observations else None
    return Demonstrations(
        images or np.concatenate(observations),
        np.concatenate(labels).astype(np.float64),
        np.repeat(np.arange(len(lengths)), lengths),
        settings,
        np.concatenate(executed).astype(np.float64),
    )
