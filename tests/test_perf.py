"""The benchmark of the expert: it compares equals, and says what is missing where it cannot."""

from __future__ import annotations

import importlib.metadata

import pytest

from safeswitch import perf, perf_crocoddyl


@pytest.mark.slow
def test_the_expert_is_at_least_twice_as_fast_as_crocoddyl() -> None:
    results = perf.expert_benchmark(horizon=34, repeats=24)
    if "skipped" in results:
        pytest.skip(results["skipped"])
    assert results["equal_cost"], results
    assert results["ratio_per_iteration"] <= 0.5, results
    assert results["ratio_per_warm_step"] <= 0.5, results


def test_without_crocoddyl_the_expert_is_timed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(perf_crocoddyl.importlib.metadata, "distribution", missing)
    monkeypatch.setattr(perf_crocoddyl.shutil, "which", lambda name: f"/usr/bin/{name}")
    results = perf.expert_benchmark(horizon=34, repeats=2)
    assert "pip install crocoddyl" in results["skipped"]
    assert results["us_per_iteration"] > 0 and "crocoddyl_us_per_iteration" not in results


@pytest.mark.slow
def test_the_rally_cars_expert_is_faster_than_crocoddyl() -> None:
    results = perf.rally_car_benchmark(repeats=24)
    if "skipped" in results:
        pytest.skip(results["skipped"])
    assert results["equal_cost"], results
    assert results["ratio_per_iteration"] <= 0.6, results
    assert results["ratio_per_warm_step"] <= 0.6, results
