"""Shared by all tests: markers, hypothesis settings, and whether pictures can be made on this machine."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from hypothesis import settings

# Derandomised: a test run is a function of the code. No deadline: two cores are often busy.
settings.register_profile("safeswitch", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("safeswitch")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes more than a few seconds; run with `make test-slow`")
    config.addinivalue_line("markers", "rendering: needs off-screen OpenGL")


@cache
def _rendering() -> tuple[bool, str]:
    from safeswitch.tasks.rendering import probe

    return probe()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("rendering") is not None:
        works, message = _rendering()
        if not works:
            pytest.skip(message)


@pytest.fixture(scope="session")
def tiny_learner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small learner of the cart-pole: trained in seconds, and neither good nor bad."""
    from safeswitch import demos
    from safeswitch_baselines.learners.bayesian import BayesianLearner

    folder = tmp_path_factory.mktemp("tiny-learner")
    noise = {"low": 0.23, "high": 0.23, "correlated_fraction": 1.0, "correlation": 0.5}
    demos.collect("SafeSwitch/CartPole-v0", "safeswitch/cart-pole/tiny-v0", folder, range(12), noise=noise)
    data = demos.load("safeswitch/cart-pole/tiny-v0", folder)
    options = {"angles": (2,), "hidden": (32, 32), "epochs": 60, "batch_size": 32}
    BayesianLearner.train(data, 0, options).save(folder / "learner")
    return folder / "learner"
