"""The one list of tasks, cells, splits, seeds, methods and profiles. A new task or rule adds a line here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from safeswitch.entries import Cell, Split, Task, others
from safeswitch.names import unknown

__all__ = ["PROFILES", "SPLITS", "SPLIT_SIZE", "TASKS", "Cell", "Profile", "Split", "Task"]
__all__ += ["episode_seeds", "methods", "others", "profile", "task", "without_extra"]

SPLITS: tuple[Split, ...] = ("train", "design", "calibrate", "pilot", "test", "kept-back")
"""The order decides the seeds: append, never insert. Which seeds of `kept-back` are used depends on a maintainer's
secret: reruns of submissions are tested on them (`safeswitch.verification`). `pilot` is retired: it was the test split
of a first trial of the whole benchmark, after which the length of the cart-pole's episodes was revised. Nothing that is
published comes from it."""
SPLIT_SIZE = 1_000_000
"""Seeds per split: split k owns [k SPLIT_SIZE, (k + 1) SPLIT_SIZE), so no two splits share one."""


def episode_seeds(split: Split, count: int, first: int = 0) -> list[int]:
    """Episode seeds `first` .. `first + count - 1` of a split."""
    if split not in SPLITS:
        raise unknown("split", split, SPLITS)
    if not 0 <= first <= first + count <= SPLIT_SIZE:
        raise ValueError(f"a split has seeds 0 .. {SPLIT_SIZE - 1}, got {first} .. {first + count - 1}")
    start = SPLITS.index(split) * SPLIT_SIZE + first
    return list(range(start, start + count))


def _cart_pole_cells() -> tuple[Cell, ...]:
    name, others = "cart-pole", ("pole-length", "motor-gain", "push", "joint-friction", "sensor-bias", "sensor-noise")
    return (
        Cell(name, "cart-mass", 3, "paper"),
        Cell(name, "none", 0, "none"),
        Cell(name, "repaint", 3, "benign"),
        *(Cell(name, "cart-mass", severity, "paper") for severity in (1, 2, 4, 5)),
        *(Cell(name, other, 3, "other") for other in others),
    )


VGG: Mapping[str, Any] = {
    "channels": (16, 32, 64),
    "strides": (2, 1, 1),
    "pools": 2,
    "epochs": 6,
    "batch_size": 32,
    "learning_rate": 2e-3,
    "pool_episodes": 1000,
}
"""Size and training of the image learners. Many demonstrations seen a few times fit better than few seen often, and
batches drawn from all of them (1 GB in memory) better than from a hundred at a time."""


RALLY_LEARNER: Mapping[str, Any] = {
    "frames": 1,
    "differences": False,
    "feature_dropout": 0.2,
    "hidden_dropout": (0.3, 0.1),
    "components": 64,
    "excess_gain": 150.0,
    "warmup_epochs": 2,
    "epochs": 6,
    "batch_size": 32,
    "learning_rate": 2e-3,
    "pool_episodes": 1000,
}
"""One frame shows what the expert steers by: where the car is on the track, how it stands, how the track bends."""


def _cart_pole_image_cells() -> tuple[Cell, ...]:
    name = "cart-pole-image"
    others = ("object-passing", "occlusion", "lighting", "camera-shift", "pixel-noise", "background", "cart-mass")
    return (
        Cell(name, "object", 3, "paper"),
        Cell(name, "none", 0, "none"),
        Cell(name, "object-far", 3, "benign"),
        *(Cell(name, "object", severity, "paper") for severity in (1, 2, 4, 5)),
        Cell(name, "object-held-out", 3, "held-out"),
        *(Cell(name, other, 3, "other") for other in others),
    )


def _rally_car_image_cells() -> tuple[Cell, ...]:
    name, others = "rally-car-image", ("mud", "dusk", "camera-dirt", "camera-pitch", "steering-bias")
    return (
        Cell(name, "obstacle", 3, "paper"),
        Cell(name, "none", 0, "none"),
        Cell(name, "roadside", 3, "benign"),
        *(Cell(name, "obstacle", severity, "paper") for severity in (1, 2, 4, 5)),
        Cell(name, "obstacle-held-out", 3, "held-out"),
        Cell(name, "obstacle", 3, "held-out", track="hollow"),
        Cell(name, "none", 0, "none", track="hollow"),
        Cell(name, "puddle-paint", 3, "benign"),
        *(Cell(name, other, 3, "other") for other in others),
    )


TASKS: dict[str, Task] = {
    "cart-pole": Task(
        name="cart-pole",
        env_id="SafeSwitch/CartPole-v0",
        learner="bayesian-mlp",
        learner_options={"angles": (2,), "epochs": 60},
        demonstrations={
            "episodes": 300,
            "noise": {"low": 0.23, "high": 0.23, "correlated_fraction": 1.0, "correlation": 0.5},
        },
        dataset="safeswitch/cart-pole/expert-v0",
        signals=(
            "epistemic",
            "aleatoric",
            "total",
            "total-mean3",
            "total-mean5",
            "epistemic-mean3",
            "epistemic-mean5",
            "mahalanobis",
            "discrepancy",
        ),
        cells=_cart_pole_cells(),
        modules=("safeswitch.tasks.cart_pole", "safeswitch.expert.cart_pole_model"),
        assets=("cart_pole", "common"),
    ),
    "cart-pole-image": Task(
        name="cart-pole-image",
        env_id="SafeSwitch/CartPoleImage-v0",
        learner="dropout-vgg",
        learner_options={**VGG, "hidden_dropout": (0.3, 0.1), "warmup_epochs": 1},
        demonstrations={
            "episodes": 1000,
            "noise": {"low": 0.23, "high": 0.23, "correlated_fraction": 1.0, "correlation": 0.5},
        },
        dataset="safeswitch/cart-pole-image/expert-v0",
        signals=(
            "epistemic",
            "aleatoric",
            "total",
            "total-mean3",
            "epistemic-mean3",
            "ensemble",
            "ensemble-mean3",
            "mahalanobis",
            "mahalanobis-mean3",
            "rnd",
            "discrepancy",
        ),
        cells=_cart_pole_image_cells(),
        modules=(
            "safeswitch.tasks.cart_pole",
            "safeswitch.tasks.cart_pole_image",
            "safeswitch.tasks.image_env",
            "safeswitch.tasks.rendering",
            "safeswitch.tasks.visual",
            "safeswitch.expert.cart_pole_model",
        ),
        assets=("cart_pole", "common"),
        showcase=("ensemble-mean3", "mahalanobis"),
        literal="paper-literal",
        literal_options=VGG,
        costly=True,
    ),
    "rally-car-image": Task(
        name="rally-car-image",
        env_id="SafeSwitch/RallyCarImage-v0",
        learner="dropout-vgg",
        learner_options=RALLY_LEARNER,
        demonstrations={
            "episodes": 120,
            "noise": {"low": 0.05, "high": 0.3, "correlated_fraction": 0.5, "correlation": 0.8},
        },
        dataset="safeswitch/rally-car-image/expert-v0",
        signals=(
            "epistemic",
            "aleatoric",
            "total",
            "total-mean3",
            "epistemic-mean3",
            "ensemble",
            "ensemble-mean3",
            "mahalanobis",
            "rnd",
            "discrepancy",
        ),
        cells=_rally_car_image_cells(),
        modules=(
            "safeswitch.tasks.car_geometry",
            "safeswitch.tasks.course",
            "safeswitch.tasks.image_env",
            "safeswitch.tasks.placing",
            "safeswitch.tasks.rally_car",
            "safeswitch.tasks.rally_car_config",
            "safeswitch.tasks.rally_car_image",
            "safeswitch.tasks.rally_disturbances",
            "safeswitch.tasks.rally_visual",
            "safeswitch.tasks.rendering",
            "safeswitch.tasks.sight",
            "safeswitch.tasks.track",
            "safeswitch.expert.bicycle",
            "safeswitch.expert.rally_car_model",
        ),
        assets=("rally_car", "common"),
        showcase=("ensemble-mean3", "mahalanobis"),
        ruled=("epistemic", "aleatoric", "total", "total-mean3", "ensemble-mean3", "mahalanobis"),
        spared=frozenset({"obstacle-2", "obstacle-4", "camera-pitch-3", "puddle-paint-3"}),
        others=2,
        costly=True,
    ),
}


def task(name: str) -> Task:
    """The task `name`; an unknown name lists the valid ones.

    Other packages register theirs in the entry-point group `safeswitch.tasks`; `package.module:TASK` needs no
    registration.
    """
    from safeswitch import registry

    if name in TASKS:
        return TASKS[name]
    if ":" not in name and name not in registry.names("task"):
        raise unknown("task", name, [*TASKS, *registry.names("task")])
    found = registry.find("task", name)
    if not isinstance(found, Task):
        raise ValueError(f"task {name!r} is a {type(found).__name__}, not a safeswitch.suite.Task")
    return found


def _methods(signals: tuple[str, ...], rules: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{rule}@{signal}" for signal in signals for rule in rules)


SHARES = (5, 10, 20, 40)
"""Shares of expert steps at which all signals are compared [%]."""
BOUNDS = ("learner", "expert", "oracle-onset", "oracle-hindsight", "simplex", "timer")
CONTROLS = ("random", "periodic", "shuffled@total", *(f"random-{share}" for share in SHARES))
QUANTILES = ("fixed-q95", "fixed-q99", "fixed-q999", "fixed-epmax95")
VALUES = ("fixed-0.05@total", "fixed-0.1@total", "fixed-0.2@total", "fixed-0.4@total")
CEM_VARIANTS = ("cem-literal@total", "cem-single@total", "cem-high@total", "cem-low@total")
OPTIONAL: Mapping[str, tuple[str, str]] = {"ppo@signals": ("stable_baselines3", "rl")}
"""Methods that need a library which is not installed by default: the module, and the extra that brings it."""
MONITORS = ("conformal", "conformal-band", "patience")
MATCHED = tuple(f"share-{share}" for share in SHARES)
PER_SIGNAL = ("cem", "grid", "random-search", *QUANTILES, *MONITORS, *MATCHED, "best")
OURS = ("cem-vector", "cem-vector-return")
GIVE_BACK = ("cem-two@total", "cem-two@epistemic", "safe-dagger@discrepancy", "lazy@discrepancy")
DOUBTS = ("ensemble", "epistemic")
"""Signals that are a doubt in the sense of EnsembleDAgger and a novelty in that of ThriftyDAgger; the first counts."""


def methods(signals: tuple[str, ...]) -> tuple[str, ...]:
    """Every method of the comparison on these signals; optional ones where their library is installed."""
    doubts = tuple(signal for signal in DOUBTS if signal in signals)[:1]
    give_back = [method for method in GIVE_BACK if method.partition("@")[2] in signals]
    give_back += _methods(doubts, ("ensemble-dagger", "thrifty"))
    optional = [method for method in OPTIONAL if method not in without_extra()]
    return (*BOUNDS, *CONTROLS, *VALUES, *CEM_VARIANTS, *OURS, *_methods(signals, PER_SIGNAL), *give_back, *optional)


def without_extra() -> dict[str, str]:
    """Optional methods whose library is not installed, each with its remedy."""
    return {
        name: f"{name} is left out: it needs {module.replace('_', '-')}, pip install 'safeswitch[{extra}]'"
        for name, (module, extra) in OPTIONAL.items()
        if find_spec(module) is None
    }


@dataclass(frozen=True)
class Profile:
    """How much is run.

    Attributes:
        name: `smoke`, `standard` or `full`.
        learners: number of learner seeds.
        cells: cells per task, from the front of its list; None for all.
        calibrate: calibrate episodes per (learner, cell).
        test: test episodes per (learner, cell).
        give_back_cells: cells, from the front, in which rules that give control back are run as plain episodes.
        demonstrations: overrides of the task's demonstrations.
        learner_options: overrides of the learner's configuration.
        tables: whether the tables of the first three cells hold both splits and every outcome; otherwise they have the
            test episodes with what is known.
        signal_severities: further severities of every disturbance at which the signals, and nothing else, are scored.
        signal_episodes: test episodes of those.
        literal_learners: number of learner seeds of the paper's learner taken literally.
        sensitivity: learner seeds that drive episodes with other numbers of dropout samples; 0 leaves out all that is
            about what results hang on.
        kept_back: test episodes in place of the test split's, drawn from a secret (`safeswitch.verification`).
    """

    name: str
    learners: int
    cells: int | None
    calibrate: int
    test: int
    give_back_cells: int = 0
    demonstrations: Mapping[str, Any] = field(default_factory=dict)
    learner_options: Mapping[str, Any] = field(default_factory=dict)
    tables: bool = False
    signal_severities: tuple[int, ...] = ()
    signal_episodes: int = 20
    literal_learners: int = 0
    sensitivity: int = 0
    kept_back: tuple[int, ...] = ()

    def seeds_of(self, task: Task, cell: Cell, split: Split) -> list[int]:
        """Seeds of the calibrate or the test episodes of a cell for each learner."""
        if split == "test" and self.kept_back:
            return list(self.kept_back)
        return episode_seeds(split, self.episodes(task, cell, split))

    def cells_of(self, task: Task) -> tuple[Cell, ...]:
        """The cells of `task` in this profile."""
        cells = [cell for cell in task.cells if f"{cell.label}-{cell.severity}" not in task.spared]
        return tuple(cells[: self.cells])

    def episodes(self, task: Task, cell: Cell, split: Split) -> int:
        """Calibrate or test episodes of a cell for each learner."""
        count = self.test if split == "test" else self.calibrate
        return -(-count // 2) if task.costly and cell not in task.cells[:3] else count


PROFILES: dict[str, Profile] = {
    "smoke": Profile(
        "smoke",
        learners=1,
        cells=2,
        calibrate=4,
        test=4,
        demonstrations={"episodes": 12},
        learner_options={"hidden": (64, 64), "epochs": 20},
    ),
    "standard": Profile("standard", learners=1, cells=3, calibrate=100, test=100),
    "full": Profile(
        "full",
        learners=5,
        cells=None,
        calibrate=40,
        test=40,
        give_back_cells=2,
        tables=True,
        signal_severities=(1, 5),
        literal_learners=2,
        sensitivity=2,
    ),
}


def profile(name: str) -> Profile:
    """The profile `name`; an unknown name lists the valid ones."""
    if name not in PROFILES:
        raise unknown("profile", name, PROFILES)
    return PROFILES[name]
