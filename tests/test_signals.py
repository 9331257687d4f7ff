from __future__ import annotations

import numpy as np
import pytest

from safeswitch import registry
from safeswitch.protocols import Prediction, Signal
from safeswitch_baselines.signals import SIGNALS, Smoothed, Total, make_signal, split_id

OBSERVATION = np.zeros(4)


def prediction(epistemic: list[float], aleatoric: list[float]) -> Prediction:
    return Prediction(np.zeros(len(epistemic)), np.array(epistemic), np.array(aleatoric))


def trace(signal: Signal, values: list[float]) -> list[float]:
    """Response to predictions whose total std is `values`."""
    signal.reset()
    return [signal.update(OBSERVATION, prediction([0.0], [value**2]), None) for value in values]


@pytest.mark.parametrize("name", ["epistemic", "aleatoric", "total"])
def test_signals_satisfy_the_protocol_and_bear_their_id(name):
    signal = make_signal(name)
    assert isinstance(signal, Signal) and signal.id == name


def test_every_signal_of_the_baselines_is_registered_under_its_id():
    assert set(registry.names("signal")) == {*SIGNALS, "smoothed"}
    for name, factory in SIGNALS.items():
        assert registry.find("signal", name) is factory and registry.base_signal(f"{name}-mean3") == name
    with pytest.raises(ValueError, match="unknown signal 'totl'; valid, nearest first: total"):
        registry.base_signal("totl-mean3")


def test_base_signals_are_standard_deviations_in_action_units():
    one = prediction([0.09], [0.16])
    assert make_signal("epistemic").update(OBSERVATION, one, None) == pytest.approx(0.3)
    assert make_signal("aleatoric").update(OBSERVATION, one, None) == pytest.approx(0.4)
    assert make_signal("total").update(OBSERVATION, one, None) == pytest.approx(0.5)


def test_components_add_up_as_variances():
    two = prediction([0.01, 0.08], [0.1, 0.06])
    assert make_signal("epistemic").update(OBSERVATION, two, None) == pytest.approx(0.3)
    assert make_signal("total").update(OBSERVATION, two, None) == pytest.approx(0.5)


@pytest.mark.parametrize("word", ["mean", "max", "min"])
@pytest.mark.parametrize("length", [2, 3, 5])
def test_smoothing_looks_back_over_the_available_steps(word, length):
    values = list(np.random.default_rng(0).uniform(0.1, 2.0, 12))
    signal = make_signal(f"total-{word}{length}")
    assert signal.id == f"total-{word}{length}"
    raw = trace(make_signal("total"), values)
    expected = [getattr(np, word)(raw[max(0, step - length + 1) : step + 1]) for step in range(len(raw))]
    np.testing.assert_allclose(trace(signal, values), expected, rtol=1e-14)


def test_smoothing_never_looks_ahead():
    values = [0.3, 0.1, 0.7, 0.2, 0.9, 0.4]
    whole = trace(make_signal("total-mean3"), values)
    for end in range(1, len(values)):
        assert trace(make_signal("total-mean3"), [*values[:end], 5.0])[:end] == whole[:end]


def test_the_window_alone_decides_to_the_last_bit():
    last = [0.1, 0.2, 0.3]
    assert trace(make_signal("total-mean3"), [1e6, 3.0, *last])[-1] == trace(make_signal("total-mean3"), last)[-1]


def test_reset_forgets_the_window():
    signal = make_signal("total-max4")
    trace(signal, [9.0])
    assert trace(signal, [1.0]) == [1.0]


def test_smoothing_resets_its_base():
    class Counting(Total):
        resets = 0

        def reset(self) -> None:
            self.resets += 1

    base = Counting()
    Smoothed(base, "mean", 3).reset()
    assert base.resets == 1


def test_ids_with_hyphens_stay_whole():
    assert split_id("dynamics-residual") == ("dynamics-residual", None, 1)
    assert split_id("dynamics-residual-mean5") == ("dynamics-residual", "mean", 5)


def test_signals_of_others_are_smoothed_too():
    class Novelty(Total):
        id = "novelty"

    assert make_signal("novelty-mean3", factories={"novelty": Novelty}).id == "novelty-mean3"


def test_registered_signals_of_other_packages_are_found(monkeypatch):
    class Novelty(Total):
        id = "novelty"

    monkeypatch.setattr(registry, "names", lambda kind: ["novelty", "smoothed", "total"])
    monkeypatch.setattr(registry, "find", lambda kind, name: {"novelty": Novelty}[name])
    assert make_signal("novelty-max2").id == "novelty-max2"
    with pytest.raises(ValueError, match="nearest first: novelty, "):
        make_signal("noveltie")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("totl", r"unknown signal 'totl'.*nearest first: total"),
        ("epistemc-mean3", r"unknown signal 'epistemc'.*nearest first: epistemic"),
        ("total-median3", r"unknown smoothing 'median'.*nearest first: mean"),
        ("total-mean1", "at least 2 steps, got 1"),
        ("total-mean0", "at least 2 steps, got 0"),
        ("total-mean03", "without leading zeros"),
        ("total-mean", "unknown signal 'total-mean'"),
        ("", "unknown signal ''"),
    ],
)
def test_wrong_ids_name_the_valid_ones(name, message):
    with pytest.raises(ValueError, match=message):
        make_signal(name)
