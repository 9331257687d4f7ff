from __future__ import annotations

import dataclasses
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from safeswitch.demos import Demonstrations
from safeswitch.protocols import Learner
from safeswitch_baselines.learners.bayesian import BayesianLearner
from safeswitch_baselines.learners.dropout import MaskStream
from safeswitch_baselines.learners.networks import BayesianMLP, InputEncoding, MLPConfig
from safeswitch_baselines.learners.storage import CONFIG, WEIGHTS

OBSERVATIONS = np.random.default_rng(3).normal(size=(50, 4)).astype(np.float32)
CONFIGS = {
    "default": MLPConfig(angles=(2,)),
    "late dropout": MLPConfig(hidden=(32, 24, 16), dropout=(0.0, 0.3, 0.1), samples=7),
    "one layer": MLPConfig(hidden=(48,), dropout=0.2, samples=5),
    "deep bare end": MLPConfig(hidden=(32, 32), dropout=(0.2, 0.0)),
}


def make_learner(config: MLPConfig = CONFIGS["default"], actions: int = 2) -> BayesianLearner:
    encoding = InputEncoding.fit(OBSERVATIONS, config.angles)
    model = BayesianMLP(encoding.size, actions, config, torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.output.weight.mul_(5.0)  # predictions far from zero, so that errors show
    return BayesianLearner(model, encoding, config, {"loss": [1.0, 0.5]})


def bits(learner: BayesianLearner, seed: int = 11) -> bytes:
    learner.reset(seed)
    predictions = [learner.predict(observation, step) for step, observation in enumerate(OBSERVATIONS)]
    return b"".join(p.action.tobytes() + p.epistemic_var.tobytes() + p.aleatoric_var.tobytes() for p in predictions)


@pytest.mark.parametrize("name", CONFIGS)
def test_batched_samples_agree_with_a_loop_over_the_masks(name):
    config = CONFIGS[name]
    learner = make_learner(config)
    learner.reset(5)
    stream = MaskStream(config.layout, config.samples)
    stream.reset(5)
    inputs = torch.from_numpy(learner.encoding(OBSERVATIONS[:1]).astype(np.float32))
    for step in (0, 3):
        masks = stream.draw(step)
        means, variances = [], []
        for k in range(config.samples):
            factors = [
                None if mask is None else torch.from_numpy(mask[k : k + 1] / np.float32(1 - rate))
                for mask, rate in zip(masks, config.rates, strict=True)
            ]
            with torch.no_grad():
                mean, log_var = learner.model(inputs, factors)
            means.append(mean[0].double().numpy())
            variances.append(np.exp(log_var[0].double().numpy()))
        prediction = learner.predict(OBSERVATIONS[0], step)
        np.testing.assert_allclose(prediction.action, np.clip(np.mean(means, axis=0), -1, 1), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(prediction.epistemic_var, np.var(means, axis=0), rtol=1e-3, atol=1e-9)
        np.testing.assert_allclose(prediction.aleatoric_var, np.mean(variances, axis=0), rtol=1e-4)


def test_without_dropout_there_is_no_epistemic_variance():
    learner = make_learner(MLPConfig(hidden=(16, 16), dropout=0.0))
    prediction = learner.predict(OBSERVATIONS[0], 0)
    with torch.no_grad():
        mean, _ = learner.model(torch.from_numpy(learner.encoding(OBSERVATIONS[:1]).astype(np.float32)))
    assert np.all(prediction.epistemic_var == 0)
    np.testing.assert_allclose(prediction.action, np.clip(mean[0].numpy(), -1, 1), rtol=1e-5, atol=1e-7)


def test_prediction_has_the_promised_types():
    learner = make_learner()
    assert isinstance(learner, Learner)
    prediction = learner.predict(OBSERVATIONS[0], 0)
    for value in (prediction.action, prediction.epistemic_var, prediction.aleatoric_var):
        assert value.shape == (2,) and value.dtype == np.float64
    assert prediction.features is not None and prediction.features.shape == (256,)
    assert prediction.features.dtype == np.float32
    assert np.all(prediction.epistemic_var > 0) and np.all(prediction.aleatoric_var > 0)


def test_features_are_kept_when_the_next_decision_is_made():
    learner = make_learner()
    first = learner.predict(OBSERVATIONS[0], 0)
    copies = [np.copy(value) for value in (first.action, first.epistemic_var, first.features)]
    learner.predict(OBSERVATIONS[1], 1)
    for value, copy in zip((first.action, first.epistemic_var, first.features), copies, strict=True):
        np.testing.assert_array_equal(value, copy)


def test_only_the_action_is_clipped():
    learner = make_learner()
    with torch.no_grad():
        learner.model.output.bias[:2] = 3.0
    clipped = BayesianLearner(learner.model, learner.encoding, learner.config)
    prediction = clipped.predict(OBSERVATIONS[0], 0)
    np.testing.assert_array_equal(prediction.action, 1.0)
    reference = make_learner().predict(OBSERVATIONS[0], 0)
    np.testing.assert_allclose(prediction.epistemic_var, reference.epistemic_var, rtol=1e-3)


def test_masks_are_a_function_of_seed_and_step_alone():
    learner = make_learner()
    learner.reset(8)
    ahead = [learner.predict(OBSERVATIONS[0], step) for step in range(6)]
    learner.reset(9)
    other = learner.predict(OBSERVATIONS[0], 3)
    learner.reset(8)
    for step in (5, 0, 3, 3, 1):
        again = learner.predict(OBSERVATIONS[0], step)
        np.testing.assert_array_equal(again.action, ahead[step].action)
        np.testing.assert_array_equal(again.epistemic_var, ahead[step].epistemic_var)
    assert not np.array_equal(other.action, ahead[3].action), "the seed does not matter"
    assert len({prediction.action.tobytes() for prediction in ahead}) == 6, "the step does not matter"


def test_masks_of_different_steps_do_not_overlap():
    config = MLPConfig(hidden=(64, 64), dropout=0.5, samples=16)
    stream = MaskStream(config.layout, config.samples)
    masks = [np.concatenate([mask.ravel() for mask in stream.draw(step) if mask is not None]) for step in range(8)]
    agreement = np.corrcoef(np.array(masks, dtype=float)) - np.eye(8)
    assert np.abs(agreement).max() < 5 / np.sqrt(masks[0].size)


def test_decisions_leave_global_generators_and_threads_alone():
    learner = make_learner()
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), torch.get_num_threads()
    learner.reset(0)
    learner.predict(OBSERVATIONS[0], 0)
    assert torch.equal(torch.get_rng_state(), before[0])
    np.testing.assert_array_equal(np.random.get_state()[1], before[1])
    assert torch.get_num_threads() == before[2]


def test_bits_do_not_depend_on_the_number_of_threads():
    learner, threads = make_learner(), torch.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(bits(learner))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1]


def test_saved_learner_predicts_the_same_bits(tmp_path):
    learner = make_learner()
    learner.save(tmp_path / "learner")
    loaded = BayesianLearner.load(tmp_path / "learner")
    assert bits(loaded) == bits(learner)
    assert loaded.config == learner.config and loaded.history == learner.history
    loaded.save(tmp_path / "again")
    for name in (WEIGHTS, CONFIG):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "learner" / name).read_bytes()


def test_another_process_with_other_threads_predicts_the_same_bits(tmp_path):
    learner = make_learner()
    learner.save(tmp_path)
    np.save(tmp_path / "observations.npy", OBSERVATIONS)
    code = f"""
import hashlib, numpy as np
from safeswitch_baselines.learners.bayesian import BayesianLearner
learner = BayesianLearner.load({str(tmp_path)!r})
learner.reset(11)
digest = hashlib.sha256()
for step, observation in enumerate(np.load({str(tmp_path / "observations.npy")!r})):
    p = learner.predict(observation, step)
    digest.update(p.action.tobytes() + p.epistemic_var.tobytes() + p.aleatoric_var.tobytes())
print(digest.hexdigest())
"""
    import hashlib

    environment = {**os.environ, "OMP_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == hashlib.sha256(bits(learner)).hexdigest()


def test_a_copy_sent_to_a_worker_predicts_the_same_bits():
    learner = make_learner(CONFIGS["late dropout"])
    assert bits(pickle.loads(pickle.dumps(learner))) == bits(learner)


def test_damaged_folders_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="config.json is missing"):
        BayesianLearner.load(tmp_path)
    make_learner().save(tmp_path)
    other = make_learner(dataclasses.replace(CONFIGS["default"], dropout=0.2))
    with torch.no_grad():
        other.model.output.bias.add_(1.0)
    other.save(tmp_path / "other")
    (tmp_path / WEIGHTS).write_bytes((tmp_path / "other" / WEIGHTS).read_bytes())
    with pytest.raises(ValueError, match="is not the file that config.json describes"):
        BayesianLearner.load(tmp_path)


def test_wrong_observations_name_what_was_expected():
    learner = make_learner()
    with pytest.raises(ValueError, match=r"shape \(5,\).*shape \(4,\)"):
        learner.predict(np.zeros(5), 0)
    with pytest.raises(ValueError, match=r"shape \(1, 4\).*shape \(4,\)"):
        learner.predict(np.zeros((1, 4)), 0)
    with pytest.raises(ValueError, match="finite.*nan"):
        learner.predict(np.array([0.0, np.nan, 0.0, 0.0]), 0)
    with pytest.raises(ValueError, match="step=-1"):
        learner.predict(OBSERVATIONS[0], -1)


def test_features_of_demonstrations_are_those_of_the_decisions():
    learner = make_learner()
    demos = Demonstrations(OBSERVATIONS, np.zeros((50, 2)), np.repeat(np.arange(5), 10))
    features = learner.features(demos)
    assert features.shape == (50, 256) and features.dtype == np.float32
    decisions = np.stack([learner.predict(observation, 0).features for observation in OBSERVATIONS])
    np.testing.assert_allclose(features, decisions, rtol=1e-5, atol=1e-6)
