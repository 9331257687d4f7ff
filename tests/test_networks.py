from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from safeswitch_baselines.learners.gaussian import bounded_log_var, bounded_variance, gaussian_nll
from safeswitch_baselines.learners.networks import BayesianMLP, InputEncoding, MLPConfig


def samples(n: int = 12) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(n, 2, generator=generator, dtype=torch.float64) for _ in range(3)]


def test_nll_is_that_of_a_gaussian():
    mean, log_var, target = samples()
    normal = torch.distributions.Normal(mean, torch.exp(0.5 * log_var))
    constant = 0.5 * np.log(2 * np.pi)
    torch.testing.assert_close(gaussian_nll(mean, log_var, target), -normal.log_prob(target) - constant)


def test_nll_gradient_agrees_with_finite_differences():
    mean, log_var, target = samples()
    assert torch.autograd.gradcheck(
        lambda m, s: gaussian_nll(m, s, target), (mean.requires_grad_(), log_var.requires_grad_())
    )


def test_beta_zero_is_plain_nll():
    mean, log_var, target = samples()
    assert torch.equal(gaussian_nll(mean, log_var, target, beta=0.0), gaussian_nll(mean, log_var, target))


@pytest.mark.parametrize("beta", [0.25, 0.5, 1.0])
def test_beta_weights_the_gradient_by_the_variance_to_the_beta(beta):
    mean, log_var, target = samples()
    inputs = (mean.requires_grad_(), log_var.requires_grad_())
    plain = torch.autograd.grad(gaussian_nll(*inputs, target).sum(), inputs)
    weighted = torch.autograd.grad(gaussian_nll(*inputs, target, beta).sum(), inputs)
    weight = torch.exp(log_var.detach()) ** beta
    for a, b in zip(plain, weighted, strict=True):
        torch.testing.assert_close(b, a * weight)


def test_log_variance_stays_within_its_bounds_and_is_the_raw_one_inside():
    raw = torch.linspace(-40.0, 40.0, 401, dtype=torch.float64)
    bounded = bounded_log_var(raw, (-10.0, 5.0))
    assert bounded.min() >= -10.0 and bounded.max() <= 5.0 + 1e-6
    assert torch.all(torch.diff(bounded) >= 0)
    inside = (raw > -6) & (raw < 1)
    torch.testing.assert_close(bounded[inside], raw[inside], atol=0.03, rtol=0)
    # torch's softplus returns its argument beyond 20, which leaves out about 1e-9 of it.
    np.testing.assert_allclose(bounded_variance(raw.numpy(), (-10.0, 5.0)), np.exp(bounded.numpy()), rtol=1e-9)
    assert np.isfinite(bounded_variance(np.array([-1e4, 1e4]), (-10.0, 5.0))).all()


def test_initial_weights_depend_on_the_generator_alone():
    state = torch.get_rng_state()
    networks = [BayesianMLP(5, 2, MLPConfig(), torch.Generator().manual_seed(4)) for _ in range(2)]
    assert torch.equal(torch.get_rng_state(), state), "torch's global generator was used"
    for a, b in zip(networks[0].parameters(), networks[1].parameters(), strict=True):
        assert torch.equal(a, b)


def test_masks_drop_and_scale_units():
    config = MLPConfig(hidden=(8,), dropout=0.5)
    network = BayesianMLP(3, 1, config, torch.Generator().manual_seed(0))
    inputs = torch.randn(1, 3, generator=torch.Generator().manual_seed(1))
    mask = torch.tensor([[2.0, 0.0] * 4])
    hidden = torch.relu(inputs @ network.linears()[0].weight.T) * mask
    expected = hidden @ network.output.weight.T
    mean, log_var = network(inputs, [mask])
    torch.testing.assert_close(mean, expected[:, :1])
    torch.testing.assert_close(log_var, bounded_log_var(expected[:, 1:], config.log_var_bounds))


def test_dropout_rates_are_met_in_every_layer():
    config = MLPConfig(hidden=(64, 32, 16), dropout=(0.1, 0.0, 0.4))
    layout = config.layout
    first, second, third = layout.draw(np.random.PCG64DXSM(0), 4000)
    assert second is None and first is not None and third is not None
    assert first.shape == (4000, 64) and third.shape == (4000, 16)
    for mask, rate in ((first, 0.1), (third, 0.4)):
        deviation = np.sqrt(rate * (1 - rate) / mask.size)
        assert abs(1 - mask.mean() - rate) < 4 * deviation
        correlation = np.corrcoef(mask[:, :16].T.astype(float)) - np.eye(16)
        assert np.abs(correlation).max() < 0.08, "units are dropped together"


def test_encoding_standardises_and_does_not_see_whole_turns():
    rng = np.random.default_rng(0)
    observations = rng.normal([1.0, -2.0, 0.0, 5.0], [2.0, 0.1, 3.0, 1.0], (5000, 4))
    encoding = InputEncoding.fit(observations, (2,))
    inputs = encoding(observations)
    assert inputs.shape == (5000, 5) and encoding.size == 5
    np.testing.assert_allclose(inputs.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(inputs.std(axis=0), 1.0, atol=1e-12)
    np.testing.assert_allclose(encoding(observations + [0, 0, 2 * np.pi, 0]), inputs, atol=1e-9)


def test_encoding_of_a_constant_component_is_finite():
    observations = np.column_stack([np.arange(10.0), np.full(10, 0.1)])
    inputs = InputEncoding.fit(observations, ())(observations)
    assert np.isfinite(inputs).all()
    np.testing.assert_allclose(inputs[:, 1], 0.0, atol=1e-12)


def test_config_survives_json():
    config = MLPConfig(hidden=(8, 4), dropout=(0.1, 0.2), angles=(1,), loss="beta-nll")
    assert MLPConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dropuot": 0.1}, r"'dropuot'.*nearest first: dropout"),
        ({"loss": "beta_nll"}, r"'beta_nll'.*nearest first: beta-nll"),
        ({"dropout": 1.0}, r"dropout=1.0.*\[0, 1\)"),
        ({"dropout": (0.1, 0.2)}, r"one rate or 3 of them"),
        ({"last_dropout": 1.0}, r"last_dropout=1.0.*\[0, 1\)"),
        ({"last_dropout": (0.1, 0.2)}, r"last_dropout=.*one rate or 1 of them"),
        ({"hidden": ()}, "hidden"),
        ({"angles": (1, 1)}, "without repetition"),
        ({"samples": 0}, "samples=0"),
        ({"beta": 2.0}, "beta=2.0"),
        ({"log_var_bounds": (1.0, -1.0)}, "log_var_bounds"),
    ],
)
def test_wrong_settings_name_value_and_what_is_allowed(values, message):
    with pytest.raises(ValueError, match=message):
        MLPConfig.from_json(values)


@pytest.mark.parametrize("hidden", [(8,), (8, 4), (8, 4, 4)])
def test_last_dropout_is_that_of_the_last_hidden_layer_whatever_their_number(hidden):
    plain, last = MLPConfig(hidden=hidden, dropout=0.2), MLPConfig(hidden=hidden, dropout=0.2, last_dropout=0.0)
    assert plain.rates == (0.2,) * len(hidden)
    assert last.rates == (*plain.rates[:-1], 0.0)
    assert MLPConfig.from_json(json.loads(json.dumps(last.to_json()))) == last


def test_angle_out_of_range_is_refused():
    with pytest.raises(ValueError, match=r"angles=\(4,\).*4 components"):
        InputEncoding.fit(np.zeros((10, 4)), (4,))
    with pytest.raises(ValueError, match=r"\(n, d\)"):
        InputEncoding.fit(np.zeros((10, 4, 4)), ())
