"""The switching problem as an environment: it earns what the table says, for any latched threshold and any seed."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

import safeswitch
from safeswitch import reference, stages, suite
from safeswitch.files import load_json
from safeswitch.handover import served
from safeswitch.handover.env import HISTORY, LIMIT, Decisions, HandoverEnv, HandoverVectorEnv
from safeswitch.handover.panel import Panel
from safeswitch.handover.published import PublishedTables, file_name, panel_of, write_table
from safeswitch.handover.table import record_table
from safeswitch.protocols import ARMINGS
from safeswitch_baselines.rules.base import ThresholdRule
from synthetic import HORIZON, random_table

SIGNALS = ("total", "epistemic")


def random_panel(seed: int, arming: Any) -> Panel:
    return panel_of(random_table(seed, signals=SIGNALS), random_table(seed + 1, 6, False, SIGNALS), arming)


def drive(env: HandoverEnv, episode: int, threshold: float) -> tuple[float, int, bool]:
    """Return, handover step and success of `total > threshold`, read off the newest observation."""
    observation, _ = env.reset(options={"episode": episode})
    earned, done, info = 0.0, False, {}
    while not done:
        observation, reward, done, _, info = env.step(int(observation[-1, 0] > threshold))
        earned += reward
    return earned, info["handover"], info["is_success"]


@given(st.integers(0, 10_000), st.floats(-1, 6), st.sampled_from(ARMINGS), st.sampled_from([0.5, 5.0]))
def test_a_threshold_earns_in_the_environment_what_it_earns_on_the_table(seed, threshold, arming, phi) -> None:
    panel = random_panel(seed, arming)
    handover = panel.handover_of(ThresholdRule("total", threshold))
    env = HandoverEnv(Decisions(panel, SIGNALS, phi=phi))
    for episode in env.decisions.playable:
        earned, at, success = drive(env, episode, threshold)
        assert earned == pytest.approx(panel.returns(handover, phi)[episode], abs=1e-12)
        assert at == handover[episode] and success == panel.success(handover)[episode]


@given(st.integers(0, 10_000), st.sampled_from(ARMINGS), st.integers(1, 6))
def test_observations_are_the_last_armed_steps_of_the_signals(seed, arming, history) -> None:
    panel = random_panel(seed, arming)
    env = HandoverEnv(Decisions(panel, SIGNALS, history))
    episode = int(env.decisions.playable[seed % len(env.decisions.playable)])
    observation, info = env.reset(options={"episode": episode})
    step = info["step"]
    assert step == panel.arming_step[episode]
    done = False
    while not done:
        rows = np.maximum(np.arange(step - history + 1, step + 1), panel.arming_step[episode])
        expected = np.stack([panel.signal(name)[episode, rows] for name in SIGNALS], axis=-1)
        np.testing.assert_array_equal(observation, expected)
        assert env.observation_space.contains(observation)
        observation, _, done, _, _ = env.step(0)
        step += 1
    assert step == panel.table.length[episode]


@given(st.integers(0, 10_000), st.sampled_from(ARMINGS), st.integers(1, 9), st.floats(-1, 6))
def test_the_vector_environment_plays_the_same_game(seed, arming, count, threshold) -> None:
    decisions = Decisions(random_panel(seed, arming), SIGNALS)
    one, many = HandoverEnv(decisions), HandoverVectorEnv(decisions, count)
    observation, info = many.reset(seed=seed)
    episodes, earned = info["episode"].copy(), np.zeros(count)
    for _ in range(3 * HORIZON):
        observation, reward, done, truncated, info = many.step(observation[:, -1, 0] > threshold)
        assert not truncated.any() and many.observation_space.contains(observation)
        earned += reward
        for i in np.flatnonzero(done):
            expected = drive(one, int(episodes[i]), threshold)
            final = info["final_info"]
            assert (earned[i], final["handover"][i], final["is_success"][i]) == pytest.approx(expected, abs=1e-12)
        earned[done], episodes = 0.0, info["episode"].copy()


def test_episodes_that_end_before_they_are_armed_are_not_drawn() -> None:
    table = random_table(3)
    table = type(table)(**{**table.__dict__, "onset": table.length - 1})
    table.length[0] = table.onset[0]  # ends before t0
    env = HandoverEnv(Decisions(Panel(table, "onset"), ("total",)))
    assert {env.reset(seed=seed)[1]["episode"] for seed in range(60)} == set(range(1, len(table)))
    with pytest.raises(ValueError, match="armed"):
        env.reset(options={"episode": 0})


def test_large_signals_are_cut_and_bad_input_is_named() -> None:
    table = random_table(0)
    table.signals["total"][:, 0] = 1e12
    env = HandoverEnv(Decisions(Panel(table, "start"), ("total",)))
    assert env.reset(seed=0)[0].max() == LIMIT
    with pytest.raises(ValueError, match="0 .learner. or 1 .expert., got 2"):
        env.step(2)
    env.step(1)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(0)
    for bad in ({"signals": ()}, {"signals": ("totl",)}, {"signals": ("total",), "history": 0}):
        with pytest.raises(ValueError, match="signal|history"):
            Decisions(Panel(table, "start"), **bad)


# ---- by id


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Published tables of the cart-pole: arbitrary outcomes, seeds of their splits."""
    folder = tmp_path_factory.mktemp("tables") / "cart-pole"
    for k, split in enumerate(served.SPLITS):
        for cell in suite.task("cart-pole").cells[:2]:
            table = random_table(k, 6, cell.tag != "none", SIGNALS)
            table = type(table)(**{**table.__dict__, "seeds": np.array(suite.episode_seeds(split, 6))})
            write_table(table, folder, cell, split, 0)
    return folder


ID = "SafeSwitch/CartPoleHandover-v0"


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.filterwarnings("error")
def test_the_checker_has_nothing_to_say(folder: Any, arming: Any) -> None:
    check_env(gym.make(ID, tables=folder, arming=arming, signals=SIGNALS).unwrapped)


def test_seeds_decide_everything(folder: Any) -> None:
    def trace(seed: int) -> list[Any]:
        env = gym.make(ID, tables=folder, signals=SIGNALS)
        env.action_space.seed(seed)
        seen = [env.reset(seed=seed)[0].tolist()]
        for _ in range(40):
            observation, reward, done, _, _ = env.step(env.action_space.sample())
            seen += [observation.tolist(), reward, done]
            if done:
                seen.append(env.reset()[0].tolist())
        return seen

    assert trace(1) == trace(1) != trace(2)


@pytest.mark.parametrize("mode", [None, "sync", "vector_entry_point"])
def test_make_vec(folder: Any, mode: Any) -> None:
    envs = gym.make_vec(ID, num_envs=3, vectorization_mode=mode, tables=str(folder), signals=SIGNALS)
    observation, _ = envs.reset(seed=0)
    assert observation.shape == (3, HISTORY, 2)
    assert isinstance(envs.unwrapped, HandoverVectorEnv) == (mode != "sync")
    observation, reward, done, truncated, _ = envs.step(np.ones(3, int))
    assert done.all() and not truncated.any() and reward.shape == (3,)
    envs.close()


def test_calibrate_and_test_episodes_are_never_the_same(folder: Any) -> None:
    seeds = {}
    for split in served.SPLITS:
        table = gym.make(ID, tables=folder, split=split, signals=SIGNALS).unwrapped.decisions.panel.table
        seeds[split] = set(table.seeds.tolist())
        assert {suite.SPLITS[seed // suite.SPLIT_SIZE] for seed in seeds[split]} == {split}
    assert not seeds["calibrate"] & seeds["test"]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"disturbance": "cart-mas"}, "unknown cell 'cart-pole/cart-mas-3'; valid, nearest first: cart-pole/cart-mass"),
        ({"severity": 6}, "unknown cell"),
        ({"split": "train"}, "unknown split 'train'; valid"),
        ({"arming": "onst"}, "unknown arming 'onst'; valid, nearest first: onset"),
        ({"disturbance": "none", "arming": "onset"}, "has no onset"),
        ({"signals": ("totl",)}, "unknown signal 'totl'; valid, nearest first: total"),
        ({"learner": 3}, "unknown handover table"),
        ({"disturbance": "push"}, "unknown handover table"),
        ({"tables": "nowhere"}, "holds no handover tables"),
    ],
)
def test_bad_arguments_are_named(folder: Any, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **{"tables": str(folder), "signals": SIGNALS, **kwargs})


def test_held_out_disturbances_are_for_testing_only() -> None:
    with pytest.raises(ValueError, match="held out: train on cart-pole-image/object-3"):
        gym.make("SafeSwitch/CartPoleImageHandover-v0", disturbance="object-held-out", split="calibrate")


def test_a_file_of_another_split_or_with_unknown_outcomes_is_refused(folder: Any, tmp_path: Any) -> None:
    name = file_name("cart-mass", 3, "test", 0)
    (tmp_path / name).write_bytes((folder / file_name("cart-mass", 3, "calibrate", 0)).read_bytes())
    with pytest.raises(ValueError, match="holds episodes of calibrate, not of test"):
        PublishedTables.find(tmp_path).load("cart-mass", 3, "test", 0)
    table = PublishedTables.find(folder).load("cart-mass", 3, "test", 0)
    known = table.known()
    known[0, 0] = -1
    incomplete = type(table)(**{**table.__dict__, "sources": (type(table.sources[0])(known),)})
    incomplete.save(tmp_path / name)
    with pytest.raises(ValueError, match="1 of 78 outcomes .* are unknown.*--profile full"):
        PublishedTables.find(tmp_path).complete_panel("cart-mass", 3, "test", 0, "onset")
    with pytest.raises(ValueError, match="complete it first"):
        write_table(incomplete, tmp_path, suite.task("cart-pole").paper_cell, "test", 0)


# ---- reference learners


def test_every_handover_id_names_a_task_and_says_how_to_make_what_is_missing(tmp_path: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(reference, "reference_folder", lambda task: tmp_path / task.name)
    for env_id, name in safeswitch.HANDOVER_TASKS.items():
        if name in suite.TASKS:
            with pytest.raises(FileNotFoundError, match=f"safeswitch reference --task {name}"):
                gym.make(env_id, phi=7.25)
        else:
            with pytest.raises(ValueError, match="unknown task"):
                gym.make(env_id)


SHIPPED = [name for name in suite.TASKS if reference.reference_folder(suite.task(name)).is_dir()]


@pytest.mark.parametrize("name", SHIPPED)
def test_reference_learners_are_what_their_manifest_says(name: str) -> None:
    task = suite.task(name)
    folder = reference.reference_folder(task)
    manifest = load_json(folder / reference.MANIFEST)
    assert manifest["learner"] == task.learner and "dirty" not in manifest["commit"]
    assert manifest["bytes"] < 3e6  # in the wheel; half of the rally car's weights are principal components
    weights = hashlib.sha256((folder / reference.LEARNER / "model.safetensors").read_bytes()).hexdigest()
    assert weights == manifest["weights_sha256"] == reference.reference(task).weights
    for file, sha in manifest["tables_sha256"].items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == sha
    env_id = next(env_id for env_id, task_name in safeswitch.HANDOVER_TASKS.items() if task_name == name)
    for split in served.SPLITS:
        decisions = gym.make(env_id, split=split).unwrapped.decisions
        assert len(decisions.panel) == 2 * manifest["episodes"]
        assert set(decisions.panel.table.signals) == set(reference.reference_signals(task))
        assert (decisions.panel.table.known() >= 0).all()


def test_smoothed_signals_of_a_reference_are_made_again_to_the_last_bit() -> None:
    task = suite.task("cart-pole")
    task = replace(task, signals=reference.reference_signals(task))
    learner, env = reference.reference(task), stages.make_env(task, task.paper_cell)
    seeds = suite.episode_seeds("test", 8)
    table = record_table(env, learner.learner(task), learner.signals(task), env.make_expert(), seeds)
    assert (table.length < table.horizon).any() and "total-mean3" in table.signals
    bare = reference.unsmoothed(table)
    assert set(bare.signals) == {"total", "epistemic", "aleatoric"}
    again = reference.smoothed(bare, task)
    assert set(again.signals) == set(table.signals)
    for name, trace in table.signals.items():
        np.testing.assert_array_equal(again.signals[name], trace)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SHIPPED if name == "cart-pole"])
def test_a_shipped_table_can_be_recorded_again(name: str, tmp_path: Any, monkeypatch: Any) -> None:
    """From the shipped weights; another machine may round differently, so signals agree to a part in a thousand."""
    monkeypatch.setenv("SAFESWITCH_CACHE", str(tmp_path))
    task = suite.task(name)
    shipped = reference.reference_table(task, task.paper_cell, "test", 3)
    again = reference.record(reference.reference(task), task, task.paper_cell, "test", 3)
    np.testing.assert_array_equal(again.seeds, shipped.seeds)
    np.testing.assert_array_equal(again.onset, shipped.onset)
    for signal, trace in shipped.signals.items():
        np.testing.assert_allclose(again.signals[signal][:, :5], trace[:, :5], rtol=1e-3)
    assert (again.known() == shipped.known()).mean() > 0.99
