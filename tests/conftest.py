"""Shared by all tests: markers, hypothesis settings, and whether pictures can be made on this machine."""

from __future__ import annotations

from functools import cache

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
