"""How a learner is made from what its name stands for: an entry point, or `package.module:factory`.

A factory is one of three things (`safeswitch.protocols.LearnerFactory` has them with examples):

* a class with `train`, `save` and `load`: trained once per learner seed and kept in the store as files;
* a function of `demonstrations`, and `seed` if it wants: called in every process that drives the learner;
* a function of neither, or of `seed` alone: a ready-made learner; no demonstration is recorded for it.

Nothing here, and nothing that it calls, knows what a learner is computed with.
"""

from __future__ import annotations

import hashlib
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safeswitch import demos, registry
from safeswitch.files import load_json, save_json
from safeswitch.seeding import stream

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

PARAMETERS = ("demonstrations", "seed")
"""What a factory that is a function may ask for, by these names."""
RECIPE = "factory.json"
PROBED = 10
"""Steps on which a learner that is made again is compared with the one that was made before."""


def is_kept(factory: Any) -> bool:
    """Whether what the factory trains is kept as files."""
    return hasattr(factory, "train")


def wants_demonstrations(name: str) -> bool:
    """Whether the learner `name` is trained here."""
    factory = registry.find("learner", name)
    return is_kept(factory) or "demonstrations" in parameters(name, factory)


def parameters(name: str, factory: Any) -> list[str]:
    """Names of what a factory that is a function asks for.

    Raises:
        ValueError: it cannot be called, or asks for something that is not there.
    """
    if not callable(factory):
        raise ValueError(f"learner {name!r} is a {type(factory).__name__}: it must be a function that makes a learner")
    named = inspect.signature(factory).parameters.values()
    asked = [each for each in named if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]
    for each in asked:
        if each.name not in PARAMETERS and each.default is each.empty:
            raise ValueError(
                f"learner {name!r} asks for {each.name!r}; a factory may ask for {' and '.join(PARAMETERS)}, by these "
                "names, and give everything else a default"
            )
    return [each.name for each in asked if each.name in PARAMETERS]


def train(folder: Path, name: str, env: TaskEnv, dataset: str, root: str, seed: int, options: dict[str, Any]) -> None:
    """Make the learner `name` and write into `folder` what `load` makes it from.

    Args:
        folder: of the result.
        name: of the learner.
        env: the task, undisturbed, on whose first observations the learner is tried.
        dataset: Minari id of the demonstrations.
        root: folder that they are in; empty for a ready-made learner.
        seed: learner seed.
        options: for a class with `train`, which is the only kind that has options.
    """
    factory = registry.find("learner", name)
    if is_kept(factory):
        learner = factory.train(demos.load(dataset, Path(root)), seed, options)
        probe(learner, env, name)
        learner.save(folder / "learner")
        return
    if options:
        raise ValueError(f"learner {name!r} takes no options, got {sorted(options)}: give it a class method `train`")
    made = {"name": name, "seed": seed, "dataset": dataset, "demonstrations": Path(root).name if root else ""}
    learner = _make(made, Path(root).parent)
    save_json(folder / RECIPE, {**made, "predictions": probe(learner, env, name).tolist()})


def load(name: str, folder: Path, make_env: Any) -> Any:
    """The learner of a finished result.

    Args:
        name: of the learner.
        folder: of the result, in the store.
        make_env: makes the undisturbed task; called where a learner is made again, to see that it is the same.

    Raises:
        ValueError: the factory made another learner this time.
    """
    if not (folder / RECIPE).is_file():
        return registry.find("learner", name).load(folder / "learner")
    made = load_json(folder / RECIPE)
    learner = _make(made, folder.parent)
    env = make_env()
    # Another process may sum in another order: close, not equal.
    same = np.allclose(probe(learner, env, name), np.array(made["predictions"], float), rtol=1e-6, equal_nan=True)
    env.close()
    if not same:
        raise ValueError(
            f"learner {name!r} was made twice and predicts two things: its factory must be a function of its "
            "arguments, with random numbers from a generator that `seed` seeds (or a class with train, save, load)"
        )
    return learner


def fingerprint(name: str, seed: int, env: TaskEnv) -> str:
    """What tells two ready-made learners apart, whose weights no source code shows: a hash of their predictions."""
    learner = _make({"name": name, "seed": seed, "dataset": "", "demonstrations": ""}, Path())
    return hashlib.sha256(np.round(probe(learner, env, name), 6).tobytes()).hexdigest()[:24]


def probe(learner: Any, env: TaskEnv, name: str) -> np.ndarray:
    """Predictions (PROBED, 3 nu) at the first steps of an episode: action, epistemic and aleatoric variance.

    Raises:
        ValueError: what the learner must change; found here and not after an hour.
    """
    for method in ("reset", "predict"):
        if not callable(getattr(learner, method, None)):
            raise ValueError(f"learner {name!r} made a {type(learner).__name__}, which has no method {method!r}")
    shape = env.simulator.action_shape
    env.reset(seed=0)
    learner.reset(0)
    pushes = stream(0, "probe").uniform(-1.0, 1.0, (PROBED, *shape))
    rows = []
    for step in range(PROBED):
        prediction = learner.predict(env.observe(), step)
        action = np.asarray(prediction.action, float)
        if action.shape != shape or not np.isfinite(action).all():
            raise ValueError(
                f"learner {name!r} predicts the action {prediction.action!r}: needs {shape} finite numbers"
            )
        variances = [np.asarray(prediction.epistemic_var, float), np.asarray(prediction.aleatoric_var, float)]
        for kind, variance in zip(("epistemic_var", "aleatoric_var"), variances, strict=True):
            if not np.isnan(variance).all() and (variance.shape != shape or not (variance >= 0).all()):
                raise ValueError(f"learner {name!r} gives {kind} {variance!r}: {shape} numbers >= 0, or nothing at all")
        rows.append(np.concatenate([action, *(np.broadcast_to(each, shape) for each in variances)]))
        env.advance(pushes[step])
    return np.stack(rows)


def _make(made: dict[str, Any], store: Path) -> Any:
    factory = registry.find("learner", made["name"])
    asked = parameters(made["name"], factory)
    given: dict[str, Any] = {"seed": made["seed"]}
    if "demonstrations" in asked:
        given["demonstrations"] = demos.load(made["dataset"], store / made["demonstrations"])
    return factory(**{name: given[name] for name in asked})
