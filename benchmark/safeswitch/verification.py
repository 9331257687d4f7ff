"""Reruns of submissions on kept-back episodes, and the table of submissions.

The benchmark is public, test seeds included, so a self-reported score may come from a method that was fitted to them
(learner and rule are even told the episode's seed). A maintainer therefore runs the method again, trained and
calibrated as it was, on test episodes that nobody else can know: seeds of the split `kept-back`, drawn by a secret.
The secret's hash is published with the result. Once the secret itself is published, which uses it up, anybody can
check which seeds it drew.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safeswitch import suite
from safeswitch.evaluation import evaluate
from safeswitch.files import load_json, save_json
from safeswitch.publish import git_commit
from safeswitch.scoring.leaderboard import csv_text, write_text
from safeswitch.submissions import UNSCORED, Refused, Submission, read

if TYPE_CHECKING:
    from safeswitch.pipeline import Run

SECRET_LENGTH = 16
"""Fewest characters of a secret: shorter ones can be found from the published hash by trying."""
MINIMUM_EPISODES = 40
"""Fewest test episodes a learner of a submission that is merged."""
COMPARED = {"return_mean": "return", "success": "success"}
"""Scores that a rerun is compared by -> prefix of their intervals."""
COLUMNS = [
    *UNSCORED[:4], "name", "authors", "learner", "rule", "status", "learner_seeds", "episodes", "return_mean",
    "return_lo", "return_hi", "skill", "skill_lo", "skill_hi", "success", "success_lo", "success_hi", "autonomy",
    "false_alarms", "tuning_episodes", "needs", "kept_back_return", "kept_back_return_lo", "kept_back_return_hi",
    "kept_back_success", "url", "file",
]  # fmt: skip


def kept_back_seeds(secret: str, task: str, count: int) -> tuple[int, ...]:
    """Episode seeds of the split `kept-back` that a secret draws for a task, without repetition.

    Raises:
        ValueError: the secret is too short to be one.
    """
    _check_secret(secret)
    digest = hashlib.sha256(f"safeswitch kept-back seeds\n{task}\n{secret}".encode()).digest()
    chosen = np.random.default_rng(int.from_bytes(digest, "big")).choice(suite.SPLIT_SIZE, count, replace=False)
    first = suite.SPLITS.index("kept-back") * suite.SPLIT_SIZE
    return tuple(first + int(index) for index in chosen)


def commitment(secret: str) -> str:
    """Hash of a secret that may be published: it binds the maintainer and gives nothing away."""
    _check_secret(secret)
    return hashlib.sha256(f"safeswitch commitment\n{secret}".encode()).hexdigest()


def verify(run: Run, submission: Submission, secret: str) -> dict[str, Any]:
    """Run a submission's method again on kept-back episodes, and record beside it what came out.

    Args:
        run: its task and profile, and the maintainer's store. The store then holds the kept-back seeds: keep it.
        submission: what is verified.
        secret: decides the test episodes.

    Returns:
        What was written: the rerun's scores, and whether their intervals and the reported ones overlap.
    """
    content = submission.content
    profile = replace(run.profile, kept_back=kept_back_seeds(secret, run.task.name, content["profile"]["test"]))
    cell, method = content["cell"], content["method"]
    found = evaluate(
        type(run)(run.task, profile, run.store, run.workers),
        method["rule"],
        cell["disturbance"],
        cell["severity"],
        cell["protocol"],
        None if method["learner"] == run.task.learner else method["learner"],
        () if method["learner"] == run.task.learner else method["signals"],
    )
    agreement = {name: overlap(submission.scores, found.scores, prefix) for name, prefix in COMPARED.items()}
    record = {
        "submission": submission.path.name,
        "sha256": submission.sha256,
        "agrees": all(agreement.values()),
        "agreement": agreement,
        "scores": {key: value for key, value in found.scores.items() if key not in UNSCORED},
        "kept_back": {"episodes": len(profile.kept_back), "commitment": commitment(secret)},
        "commit": git_commit(),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    save_json(record_path(submission.path), record)
    return record


def overlap(reported: Mapping[str, Any], rerun: Mapping[str, Any], prefix: str) -> bool:
    """Whether two 95 % intervals have a point in common. Of two runs of one method, fewer than 1 in 100 have none."""
    lo, hi = f"{prefix}_lo", f"{prefix}_hi"
    return bool(reported[lo] <= rerun[hi] and rerun[lo] <= reported[hi])


def record_path(submission: Path) -> Path:
    """Where the rerun of a submission is recorded."""
    return submission.parent / "verified" / submission.name


def merge(folder: Path, minimum_episodes: int = MINIMUM_EPISODES) -> tuple[pd.DataFrame, dict[str, str]]:
    """Write `submissions.csv` and `submissions.md` from the submissions that hold.

    Args:
        folder: of the leaderboard; submissions are in its folder `submissions`.
        minimum_episodes: a submission with fewer test episodes a learner is refused.

    Returns:
        The table, and file name -> reason for every submission that was refused.
    """
    rows, refused = [], {}
    entries: dict[tuple[Any, ...], str] = {}
    for path in sorted((folder / "submissions").glob("*.json")):
        try:
            submission = read(path)
            if (count := submission.content["profile"]["test"]) < minimum_episodes:
                raise Refused(f"too small: {count} test episodes a learner, at least {minimum_episodes} are needed")
            entry = (submission.content["name"], *submission.content["cell"].values())
            if entry in entries:
                raise Refused(f"double: {entries[entry]} is an entry of the same name in the same cell")
            entries[entry] = path.name
            rows.append(_row(submission))
        except Refused as reason:
            refused[path.name] = str(reason)
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = table.sort_values(
        [*UNSCORED[:4], "return_mean", "name"], ascending=[True] * 4 + [False, True], kind="stable", ignore_index=True
    )
    write_text(folder / "submissions.csv", csv_text(table))
    write_text(folder / "submissions.md", _markdown(table))
    return table, refused


def status(submission: Submission) -> tuple[str, dict[str, Any]]:
    """`self-reported`, `verified` or `not confirmed`, and the record of the rerun that says so."""
    path = record_path(submission.path)
    record = load_json(path) if path.is_file() else {}
    if record.get("sha256") != submission.sha256:  # never rerun, or another file since
        return "self-reported", {}
    return ("verified" if record["agrees"] else "not confirmed"), record


def _row(submission: Submission) -> dict[str, Any]:
    content, scores = submission.content, submission.scores
    state, record = status(submission)
    again = {key: math.nan if value is None else value for key, value in record.get("scores", {}).items()}
    return {
        **{name: scores[name] for name in COLUMNS if name in scores},
        **content["cell"],
        "name": content["name"],
        "authors": content["authors"],
        "learner": content["method"]["learner"],
        "rule": content["method"]["rule"],
        "status": state,
        "needs": " ".join(content["method"]["needs"]),
        "kept_back_return": again.get("return_mean", math.nan),
        "kept_back_return_lo": again.get("return_lo", math.nan),
        "kept_back_return_hi": again.get("return_hi", math.nan),
        "kept_back_success": again.get("success", math.nan),
        "url": content["url"],
        "file": submission.path.name,
    }


def _markdown(table: pd.DataFrame) -> str:
    lines = ["# Submissions", "", "What others have submitted, by cell and protocol; docs/submit.md says how.", ""]
    for cell, rows in table.groupby(list(UNSCORED[:4]), sort=True):
        task, disturbance, severity, protocol = cell
        lines += [f"## {task}, {disturbance} {severity or ''}".rstrip() + f", protocol `{protocol}`", ""]
        lines += ["| name | learner, rule | status | return | skill | success | autonomy | on kept-back episodes |"]
        lines += ["| :-- | :-- | :-- | --: | --: | --: | --: | --: |"]
        lines += ["| " + " | ".join(_cells(row)) + " |" for row in rows.to_dict("records")] + [""]
    lines += [
        "Scores are recomputed from the outcomes that a submission carries. *Self-reported*: nobody else has run it. "
        "*Verified*: a maintainer ran it again on kept-back episodes, and the intervals of return and success overlap; "
        "*not confirmed*: they do not.",
    ]
    return "\n".join(lines) + "\n"


def _cells(row: Mapping[str, Any]) -> list[str]:
    def number(name: str) -> str:
        return "–" if pd.isna(row[name]) else f"{row[name]:.2f}"

    def interval(name: str, low: str, high: str) -> str:
        return number(name) if pd.isna(row[low]) else f"{number(name)} [{number(low)}, {number(high)}]"

    words = ("name", "authors", "learner", "rule")
    safe = {name: str(row[name]).replace("|", "\\|").replace("\n", " ") for name in words}
    return [
        f"{safe['name']} ({safe['authors']})",
        f"`{safe['learner']}`, `{safe['rule']}`",
        str(row["status"]),
        interval("return_mean", "return_lo", "return_hi"),
        interval("skill", "skill_lo", "skill_hi"),
        interval("success", "success_lo", "success_hi"),
        number("autonomy"),
        interval("kept_back_return", "kept_back_return_lo", "kept_back_return_hi"),
    ]


def _check_secret(secret: str) -> None:
    if len(secret) < SECRET_LENGTH:
        raise ValueError(
            f"a secret has at least {SECRET_LENGTH} characters, got {len(secret)}: make one with "
            'python -c "import secrets; print(secrets.token_hex(16))" and give it as --secret or $SAFESWITCH_SECRET'
        )
