"""Submissions: one JSON file with a method's scores in one cell, and the outcomes that they follow from.

`write` makes one of an evaluation; `read` takes nothing on trust. It recomputes every score from the episodes, holds
these against what can and what cannot happen in an episode (`submission_laws`), and against the code of the benchmark
as it is now. docs/submit.md has the format field by field.
"""

from __future__ import annotations

import ast
import hashlib
import json
import platform
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from safeswitch import __version__, registry, suite
from safeswitch.evaluate import find_cell
from safeswitch.evaluation import REFERENCES
from safeswitch.files import jsonable, save_json
from safeswitch.publish import git_commit
from safeswitch.scoring.leaderboard import format_number, leaderboard
from safeswitch.scoring.metrics import CELL, COLUMNS, TaskInfo, signal_of
from safeswitch.stages import HANDOVER, PHYSICS, make_env, source_of
from safeswitch.store import module_files
from safeswitch.submission_laws import check_laws

if TYPE_CHECKING:
    from safeswitch.evaluation import Evaluation
    from safeswitch.suite import Task

SCHEMA = 1
"""Version of the format; a file of another version is refused."""
EPISODE_COLUMNS = [name for name in COLUMNS if name not in CELL]
TEXT, NUMBER = (str,), (int, float)
FIELDS: Mapping[str, Any] = {
    "schema": (int,),
    "name": TEXT,
    "authors": TEXT,
    "url": TEXT,
    "description": TEXT,
    "suite": {"version": TEXT, "commit": TEXT, "benchmark": TEXT},
    "method": {"learner": TEXT, "rule": TEXT, "needs": (list,), "latched": (bool,), "signals": (list,)},
    "cell": {"task": TEXT, "disturbance": TEXT, "severity": (int,), "protocol": TEXT},
    "profile": {"name": TEXT, "learners": (int,), "calibrate": (int,), "test": (int,)},
    "scores": (dict,),
    "episodes": (dict,),
    "manifest": {"made": TEXT, "versions": (dict,), "hardware": (dict,)},
    "hashes": {"episodes": TEXT, "learner": TEXT, "rule": TEXT, "store_keys": (dict,)},
}
"""Every field of the format and its types."""
UNSCORED = ("task", "disturbance", "severity", "protocol", "method")
"""Columns of the leaderboard that are no scores."""


class Refused(ValueError):  # noqa: N818 (a verdict, not a fault)
    """A submission that is not merged, and why."""


@dataclass(frozen=True)
class Submission:
    """A submission that holds.

    Attributes:
        path: its file.
        content: the fields of `FIELDS`.
        scores: the leaderboard's row, recomputed.
        sha256: of the file.
    """

    path: Path
    content: Mapping[str, Any]
    scores: Mapping[str, Any]
    sha256: str


def write(found: Evaluation, folder: Path, name: str, authors: str, url: str = "", description: str = "") -> Path:
    """Write an evaluation as a submission into `folder`; returns the file, named after cell and `name`.

    Args:
        found: what was evaluated.
        folder: usually results/submissions.
        name: of the entry, as the table shows it.
        authors: who submits it.
        url: where the code of learner and rule is.
        description: one or two sentences.
    """
    slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if not slug or not authors.strip():
        raise ValueError(f"a submission needs a name with letters or digits and its authors, got {name!r}, {authors!r}")
    task, cell, profile = found.run.task, found.cell, found.run.profile
    method = registry.make_method(found.method)
    episodes = {column: found.episodes[column].tolist() for column in EPISODE_COLUMNS}
    episodes = jsonable(episodes, "episodes", nan_as_null=True)
    content = {
        "schema": SCHEMA,
        "name": name,
        "authors": authors,
        "url": url,
        "description": description,
        "suite": {"version": __version__, "commit": git_commit(), "benchmark": benchmark_hash(task)},
        "method": {
            "learner": task.learner,
            "rule": found.method,
            "needs": sorted(method.needs),
            "latched": method.latched,
            "signals": list(task.signals),
        },
        "cell": {
            "task": cell.task,
            "disturbance": cell.label,
            "severity": cell.severity,
            "protocol": found.protocol,
        },
        "profile": {
            "name": profile.name,
            "learners": profile.learners,
            "calibrate": profile.episodes(task, cell, "calibrate"),
            "test": profile.episodes(task, cell, "test"),
        },
        "scores": {key: value for key, value in found.scores.items() if key not in UNSCORED},
        "episodes": episodes,
        "manifest": {
            "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "versions": {"python": platform.python_version(), **found.run.store.key("none", {}).recipe["libraries"]},
            "hardware": {"machine": platform.machine(), "processor": platform.processor()},
        },
        "hashes": {
            "episodes": content_hash(episodes),
            "learner": source_hash("learner", task.learner),
            "rule": source_hash("method", found.method.partition("@")[0]),
            "store_keys": {"learners": [job.key for job in found.run.learners]},
        },
    }
    path = folder / f"{str(cell).replace('/', '-')}-{found.protocol}-{slug}.json"
    save_json(path, content)
    read(path)  # what would be refused is not worth sending
    return path


def read(path: Path) -> Submission:
    """Read a submission and check all that can be checked without running it.

    Raises:
        Refused: it is malformed, outdated, or its scores do not follow from its episodes; the message says what.
    """
    data = path.read_bytes()
    try:
        content = json.loads(data)
    except ValueError as error:
        raise Refused(f"malformed: it is no JSON ({error})") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        kind = "outdated" if isinstance(schema, int) and schema < SCHEMA else "malformed or newer than this checkout"
        raise Refused(f"{kind}: its schema is {schema!r}, this checkout reads {SCHEMA}")
    _check_fields(content, FIELDS, "")
    try:
        task = suite.task(content["cell"]["task"])
        cell = find_cell(task, content["cell"]["disturbance"], content["cell"]["severity"])
    except ValueError as error:
        raise Refused(f"malformed: {error}") from error
    if content["suite"]["benchmark"] != benchmark_hash(task):
        raise Refused(
            f"outdated: task, expert or protocol of {task.name} have changed since (made with safeswitch "
            f"{content['suite']['version']}, commit {content['suite']['commit']}); run and submit it again"
        )
    if content_hash(content["episodes"]) != content["hashes"]["episodes"]:
        raise Refused(
            "inconsistent: hashes.episodes is not the hash of the episodes; these were changed after they were written"
        )
    info = task_info(task)
    frame = _episodes(content, info)
    return Submission(path, content, _checked_scores(content, frame, str(cell), info), hashlib.sha256(data).hexdigest())


def content_hash(value: Any) -> str:
    """SHA-256 of JSON values in one canonical spelling."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@cache
def benchmark_hash(task: Task) -> str:
    """What outcomes of a task depend on: the code of task, expert and protocol, comments and docstrings aside."""
    modules = [*PHYSICS, *(str(name) for name in task.modules), *HANDOVER, "safeswitch.handover.panel"]
    parts = [[name, [_meaning(file.read_text()) for file in module_files(name)]] for name in sorted(set(modules))]
    assets = [each for each in task.code() if isinstance(each, Path)]
    files = [file for each in assets for file in ([each] if each.is_file() else sorted(each.rglob("*.xml")))]
    parts += [[file.name, hashlib.sha256(file.read_bytes()).hexdigest()] for file in files]
    return content_hash(parts)


def source_hash(kind: registry.Kind, name: str) -> str:
    """Hash of the source that a learner or rule is made from."""
    return content_hash([file.read_text() for file in module_files(source_of(kind, name))])


@cache
def task_info(task: Task) -> TaskInfo:
    """What scoring knows of the task."""
    env = make_env(task, task.none_cell)
    return TaskInfo(horizon=env.horizon, control_dt=env.control_dt)


def _meaning(source: str) -> list[Any]:
    """What a program says, whatever its comments and its layout: nodes of its syntax tree, docstrings left out."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if (
            isinstance(body, list)
            and body
            and isinstance(body[0], ast.Expr)
            and isinstance(body[0].value, ast.Constant)
        ):
            body.pop(0)
    rows = []
    for node in ast.walk(tree):
        fields = [each for each in ast.iter_fields(node) if each[0] not in ("kind", "type_comment", "type_params")]
        said = [[key, len(value) if isinstance(value, list) else repr(value)] for key, value in fields
                if isinstance(value, list | str | int | float | bytes | complex | type(None))]  # fmt: skip
        rows.append([type(node).__name__, said])
    return rows


def _check_fields(value: Any, fields: Mapping[str, Any], where: str) -> None:
    if not isinstance(value, dict):
        raise Refused(f"malformed: {where or 'the file'} must be an object, got {type(value).__name__}")
    inside = f" in {where}" if where else ""
    if missing := sorted(set(fields) - set(value)):
        raise Refused(f"malformed: the fields {missing} are missing{inside}")
    if unknown := sorted(set(value) - set(fields)):
        raise Refused(f"malformed: the fields {unknown} are unknown{inside}; the format has {sorted(fields)}")
    for name, kinds in fields.items():
        if isinstance(kinds, Mapping):
            _check_fields(value[name], kinds, f"{where}{name}")
        elif type(value[name]) not in kinds:
            wanted = " or ".join(kind.__name__ for kind in kinds)
            raise Refused(f"malformed: {name}{inside} must be {wanted}, got {value[name]!r}")


def _episodes(content: Mapping[str, Any], info: TaskInfo) -> pd.DataFrame:
    """The episodes as a table that obeys every law of an episode."""
    columns, method = content["episodes"], content["method"]["rule"]
    if set(columns) != set(EPISODE_COLUMNS):
        raise Refused(f"malformed: episodes must have the columns {EPISODE_COLUMNS}, got {sorted(columns)}")
    if len({len(values) if isinstance(values, list) else -1 for values in columns.values()} | {-1}) != 2:
        raise Refused("malformed: the columns of episodes must be lists of one length")
    frame = pd.DataFrame(columns).assign(**content["cell"])
    signal = signal_of(method)
    wanted = {*REFERENCES, method, *([f"best@{signal}"] if signal else [])}
    if set(frame["method"]) != wanted:
        raise Refused(
            f"inconsistent: episodes must be of {sorted(wanted)}, got {sorted(set(map(str, frame['method'])))}"
        )
    profile = content["profile"]
    seeds = suite.episode_seeds("test", profile["test"]) if 0 < profile["test"] <= suite.SPLIT_SIZE else []
    if set(frame["learner"]) != set(range(profile["learners"])) or set(frame["seed"]) != set(seeds):
        raise Refused(
            f"inconsistent: profile {profile['name']!r} of {profile['learners']} learners and {profile['test']} test "
            "episodes is not what the episodes hold: these must be the first ones of the test split, for every learner"
        )
    twice = 2 if content["cell"]["protocol"] == "start" and content["cell"]["disturbance"] != "none" else 1
    if len(frame) != len(wanted) * profile["learners"] * profile["test"] * twice:
        raise Refused(f"inconsistent: {len(frame)} rows are not every method on every episode")
    try:
        check_laws(frame, info, {method} if not content["method"]["latched"] else set())
    except (ValueError, TypeError, OverflowError) as error:
        raise Refused(f"inconsistent: {error}") from error
    return frame


def _checked_scores(content: Mapping[str, Any], frame: pd.DataFrame, cell: str, info: TaskInfo) -> dict[str, Any]:
    """The scores that follow from the episodes; refused where the submission states others."""
    try:
        table = leaderboard(frame, {content["cell"]["task"]: info})
    except (ValueError, TypeError) as error:
        raise Refused(f"inconsistent: {error}") from error
    row = dict(table[table["method"] == content["method"]["rule"]].iloc[0])
    scores, stated = {key: value for key, value in row.items() if key not in UNSCORED}, dict(content["scores"])
    if stated.pop("calibrated_on", "") != "":
        raise Refused("inconsistent: scores.calibrated_on is not blank, but every method is calibrated in its own cell")
    for key, value in scores.items():
        given = stated.pop(key, None)
        given = float("nan") if given is None else given
        if isinstance(given, bool) or not isinstance(given, NUMBER + TEXT) or _spelled(given) != _spelled(value):
            follows = _spelled(value) or "no value"
            raise Refused(f"inconsistent: scores.{key} is {given!r}, but the episodes in {cell} give {follows}")
    if stated:
        raise Refused(f"malformed: the scores {sorted(stated)} are unknown")
    return row


def _spelled(value: Any) -> str:
    """A number to five significant digits: different machines may round the sixth differently."""
    return value if isinstance(value, str) else format_number(float(f"{float(value):.5g}"))
