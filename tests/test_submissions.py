"""Submissions: what is written is read back, and nothing else is; reruns on kept-back episodes."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from micro import MICRO, TASK
from safeswitch import cli, scoring_stages, submissions, suite
from safeswitch.console import console
from safeswitch.evaluation import Evaluation
from safeswitch.files import load_json, save_json
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import concatenate, new_table
from safeswitch.pipeline import Run
from safeswitch.protocols import Arming
from safeswitch.registry import make_method
from safeswitch.scoring.leaderboard import leaderboard, read_csv
from safeswitch.scoring.rows import latched_rows
from safeswitch.store import Store
from safeswitch.submission_laws import check_laws
from safeswitch.submissions import Refused, content_hash, read
from safeswitch.suite import SPLIT_SIZE, SPLITS
from safeswitch.verification import commitment, kept_back_seeds, merge, overlap, record_path

SECRET = "correct horse battery staple"
METHODS = ("learner", "expert", "timer", "best@total", "fixed-0.1@total")


def table(seeds: list[int], disturbed: bool, horizon: int, rng: np.random.Generator) -> Any:
    """A table without a simulator whose traces and outcomes are arbitrary."""
    count = len(seeds)
    success = rng.random(count) < (0.5 if disturbed else 0.9)
    length = np.where(success, horizon, rng.integers(60, horizon, count))
    onset = rng.integers(8, 48, count) if disturbed else np.full(count, -1)
    last = np.maximum(onset, 0) + rng.integers(0, 30, count) if disturbed else np.full(count, horizon)
    outcome = np.arange(horizon + 1)[None, :] <= last[:, None]
    trace = rng.gamma(2.0, 0.03, (count, horizon))
    trace[np.arange(horizon)[None, :] >= length[:, None]] = np.nan
    return new_table(np.array(seeds), onset, length, success, {"total": trace}, outcome)


def evaluation(root: Path, arming: Arming = "start", learners: int = 1, episodes: int = 40) -> Evaluation:
    """What an evaluation of a fixed threshold finds, on tables without a simulator."""
    profile = replace(MICRO, learners=learners, test=episodes, calibrate=episodes)
    run, cell = Run(TASK, profile, Store(root), 1), TASK.paper_cell
    run.learners = []  # type: ignore[misc]  # nothing is trained
    frames, rng = [], np.random.default_rng(5)
    for learner in range(learners):
        seeds = profile.seeds_of(TASK, cell, "test")
        halves = [table(seeds, kind, run.task_info.horizon, rng) for kind in (True, False)]
        panel = Panel(concatenate(halves) if arming == "start" else halves[0], arming)
        for name in METHODS:
            calibrated = make_method(name).calibrate(Calibration(panel, halves[1], seed=learner))
            rows = latched_rows(panel, calibrated)
            frames.append(scoring_stages.labelled(rows, cell, arming, name, learner, calibrated, ""))
    frame = pd.concat(frames, ignore_index=True)
    row = leaderboard(frame, {TASK.name: run.task_info})
    scores = dict(row[row["method"] == METHODS[-1]].iloc[0])
    return Evaluation(run, METHODS[-1], cell, arming, frame, scores)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A submission of the leaderboard folder two levels up."""
    root = tmp_path_factory.mktemp("results")
    return submissions.write(evaluation(root / "store"), root / "submissions", "Fixed 0.1!", "A. Nobody", "https://x.y")


@pytest.mark.parametrize("arming", ["onset", "start"])
@pytest.mark.parametrize("learners", [1, 3])
def test_what_is_written_holds(tmp_path: Path, arming: Arming, learners: int) -> None:
    found = evaluation(tmp_path, arming, learners)
    path = submissions.write(found, tmp_path / "submissions", "Fixed 0.1!", "A. Nobody")
    assert path.name == f"cart-pole-cart-mass-3-{arming}-fixed-0-1.json"
    submission = read(path)
    for name, value in ((key, value) for key, value in found.scores.items() if key != "calibrated_on"):
        np.testing.assert_equal(submission.scores[name], value)
    assert submission.content["profile"] == {"name": "micro", "learners": learners, "calibrate": 40, "test": 40}
    text = path.read_text()
    assert "NaN" not in text and str(tmp_path) not in text, "JSON, and nothing of the machine's folders"


def edited(path: Path, edit: Callable[[dict[str, Any]], Any], rehash: bool = True) -> Path:
    """A copy of a submission, changed; with the hash of its episodes put right, as a careful cheat would."""
    content = copy.deepcopy(load_json(path))
    edit(content)
    if rehash and isinstance(content.get("episodes"), dict) and isinstance(content.get("hashes"), dict):
        content["hashes"]["episodes"] = content_hash(content["episodes"])
    target = path.parent / "edited" / path.name
    save_json(target, content)
    return target


def rows_of(content: dict[str, Any], method: str, **wanted: Any) -> list[int]:
    episodes = content["episodes"]
    named = {"method": method, **wanted}
    return [i for i in range(len(episodes["method"])) if all(episodes[key][i] == value for key, value in named.items())]


def set_score(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["scores"].update({name: value})


def set_field(*path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def edit(content: dict[str, Any]) -> None:
        for name in path[:-1]:
            content = content[name]
        content[path[-1]] = value

    return edit


def flip_failure(content: dict[str, Any]) -> None:
    """One failure of the method becomes a success, and the scores are left as they were."""
    content["episodes"]["success"][rows_of(content, METHODS[-1], success=False)[0]] = True


def drop_row(content: dict[str, Any]) -> None:
    for values in content["episodes"].values():
        values.pop(0)


def other_seed(content: dict[str, Any]) -> None:
    seeds = content["episodes"]["seed"]
    content["episodes"]["seed"] = [seed + 1000 for seed in seeds]


def later(content: dict[str, Any]) -> None:
    index = rows_of(content, METHODS[-1])[0]
    content["episodes"]["armed_learner_steps"][index] = content["episodes"]["learner_steps"][index] + 1


def rename(content: dict[str, Any]) -> None:
    content["episodes"]["method"] = ["mine" if name == "timer" else name for name in content["episodes"]["method"]]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (set_score("return_mean", 5.9), "inconsistent: scores.return_mean is 5.9, but the episodes in cart-pole/"),
        (set_score("success", 1.0), "inconsistent: scores.success is 1.0, but the episodes in .* give"),
        (set_score("calibrated_on", "cart-pole/none"), "inconsistent: scores.calibrated_on is not blank"),
        (set_score("success_lo", 0.99), "inconsistent: scores.success_lo"),
        (set_score("autonomy", None), "inconsistent: scores.autonomy is nan"),
        (set_score("glory", 1.0), r"malformed: the scores \['glory'\] are unknown"),
        (lambda content: content["scores"].pop("autonomy"), "inconsistent: scores.autonomy is nan"),
        (flip_failure, "inconsistent: (.* break the law|scores)"),
        (drop_row, "inconsistent"),
        (other_seed, "must be the first ones of the test split"),
        (later, "inconsistent: .* armed_learner_steps"),
        (rename, "inconsistent: episodes must be of"),
        (set_field("schema", value=0), "outdated: its schema is 0"),
        (set_field("schema", value=99), "malformed or newer than this checkout"),
        (set_field("suite", "benchmark", value="0" * 64), "outdated: task, expert or protocol of cart-pole have"),
        (set_field("cell", "task", value="cart-pol"), "malformed: unknown task 'cart-pol'; valid, nearest"),
        (set_field("cell", "disturbance", value="cart-mas"), "malformed: unknown cell"),
        (set_field("cell", "severity", value=4), "inconsistent|malformed"),
        (set_field("cell", "protocol", value="onset"), "inconsistent"),
        (set_field("method", "latched", value="yes"), "malformed: latched in method must be bool, got 'yes'"),
        (set_field("profile", "test", value=41), "is not what the episodes hold"),
        (set_field("profile", "test", value=-1), "is not what the episodes hold"),
        (set_field("authors", value=None), "malformed: authors must be str, got None"),
        (set_field("price", value=1), r"malformed: the fields \['price'\] are unknown"),
        (lambda content: content.pop("manifest"), r"malformed: the fields \['manifest'\] are missing"),
        (set_field("episodes", value={}), "malformed: episodes must have the columns"),
        (lambda content: content["episodes"]["seed"].pop(), "must be lists of one length"),
        (lambda content: content["episodes"].update(success=["x"] * len(content["episodes"]["seed"])), "inconsistent"),
        (lambda content: content["episodes"].update(seed=[None] * len(content["episodes"]["seed"])), "inconsistent"),
    ],
)
def test_what_does_not_follow_is_refused_with_the_reason(
    written: Path, edit: Callable[[dict[str, Any]], Any], message: str
) -> None:
    with pytest.raises(Refused, match=message):
        read(edited(written, edit))


def test_episodes_that_were_touched_are_refused_even_where_the_scores_do_not_move(written: Path) -> None:
    def touch(content: dict[str, Any]) -> None:
        content["episodes"]["t_first"] = [None if value == 80 else value for value in content["episodes"]["t_first"]]

    with pytest.raises(Refused, match=r"hashes\.episodes is not the hash of the episodes"):
        read(edited(written, touch, rehash=False))


@pytest.mark.parametrize("text", ["", "{", "[1]", '"x"', "null", '{"schema": true}'])
def test_files_that_are_no_submission_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(Refused, match="malformed|outdated"):
        read(tmp_path / "x.json")


def test_a_cheat_who_computes_the_scores_again_still_breaks_a_law(tmp_path: Path) -> None:
    """Every failure after a handover becomes a success, and the scores with it: o(s) says otherwise."""
    found = evaluation(tmp_path)
    frame = found.episodes.copy()
    check_laws(frame, found.run.task_info)
    mine = (frame["method"] == METHODS[-1]) & (frame["handover"] < found.run.task_info.horizon)
    frame.loc[mine, "success"] = True
    with pytest.raises(ValueError, match="break the law"):
        check_laws(frame, found.run.task_info)


def test_the_hash_of_the_benchmark_sees_code_and_not_comments() -> None:
    before = submissions._meaning('"""What."""\ndef f(x):\n    """It."""\n    return x + 1\n')
    assert before == submissions._meaning("def f(x):  # anything\n    return (x\n            + 1)\n")
    for other in ("def f(x):\n    return x + 2\n", "def f(y):\n    return y + 1\n", "def f(x):\n    return x - 1\n"):
        assert before != submissions._meaning(other)


# ---- the table


def test_merging_writes_those_that_hold_and_names_the_others(written: Path, tmp_path: Path) -> None:
    folder = tmp_path / "submissions"
    folder.mkdir()
    (folder / "a.json").write_bytes(written.read_bytes())
    (folder / "b.json").write_bytes(written.read_bytes())
    (folder / "c.json").write_bytes(edited(written, set_score("return_mean", 9.0)).read_bytes())
    (folder / "d.json").write_text("{}")
    found, refused = merge(tmp_path)
    assert found["file"].tolist() == ["a.json"] and found["status"].tolist() == ["self-reported"]
    assert refused["b.json"].startswith("double: a.json") and "scores.return_mean" in refused["c.json"]
    assert set(refused) == {"b.json", "c.json", "d.json"}
    first = (tmp_path / "submissions.csv").read_bytes(), (tmp_path / "submissions.md").read_bytes()
    merge(tmp_path)
    assert first == ((tmp_path / "submissions.csv").read_bytes(), (tmp_path / "submissions.md").read_bytes())
    assert read_csv(tmp_path / "submissions.csv")["name"].tolist() == ["Fixed 0.1!"]
    assert b"self-reported" in first[1]
    assert merge(tmp_path, minimum_episodes=41)[1]["a.json"].startswith("too small: 40 test episodes")


@pytest.mark.parametrize(("agrees", "state"), [(True, "verified"), (False, "not confirmed")])
def test_a_rerun_marks_the_very_file_that_was_rerun(written: Path, tmp_path: Path, agrees: bool, state: str) -> None:
    target = tmp_path / "submissions" / "a.json"
    target.parent.mkdir()
    target.write_bytes(written.read_bytes())
    scores = {"return_mean": 5.0, "return_lo": 4.9, "return_hi": 5.1, "success": 0.9}
    save_json(record_path(target), {"sha256": read(target).sha256, "agrees": agrees, "scores": scores})
    found, _ = merge(tmp_path)
    assert found["status"].tolist() == [state] and found["kept_back_return"].tolist() == [5.0]
    content = load_json(target)
    content["description"] = "another file"
    save_json(target, content)
    assert merge(tmp_path)[0]["status"].tolist() == ["self-reported"]


# ---- kept-back episodes


def test_kept_back_seeds_are_the_secrets_and_nobody_elses() -> None:
    seeds = kept_back_seeds(SECRET, "cart-pole", 100)
    assert seeds == kept_back_seeds(SECRET, "cart-pole", 100) and len(set(seeds)) == 100
    low = SPLITS.index("kept-back") * SPLIT_SIZE
    assert all(low <= seed < low + SPLIT_SIZE for seed in seeds)
    others = [kept_back_seeds(SECRET + ".", "cart-pole", 100), kept_back_seeds(SECRET, "cart-pole-image", 100)]
    assert all(len(set(seeds) & set(other)) < 5 for other in others)
    assert SPLITS[:5] == ("train", "design", "calibrate", "pilot", "test"), "the order decides the seeds"
    for short in ("", "secret"):
        with pytest.raises(ValueError, match="at least 16 characters"):
            kept_back_seeds(short, "cart-pole", 3)
        with pytest.raises(ValueError, match="at least 16 characters"):
            commitment(short)
    assert SECRET not in commitment(SECRET) and commitment(SECRET) != commitment(SECRET + ".")


def test_intervals_agree_where_they_overlap() -> None:
    def interval(lo: float, hi: float) -> dict[str, float]:
        return {"return_lo": lo, "return_hi": hi}

    assert overlap(interval(1, 3), interval(2, 4), "return") and overlap(interval(2, 4), interval(1, 3), "return")
    assert overlap(interval(1, 1), interval(1, 1), "return")
    assert not overlap(interval(1, 2), interval(3, 4), "return")
    assert not overlap(interval(3, 4), interval(1, 2), "return")


@pytest.mark.slow
def test_the_commands_from_submission_to_verified_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setitem(suite.PROFILES, "micro", MICRO)
    monkeypatch.setattr(console, "quiet", False)
    monkeypatch.setattr(console, "width", 300)  # whatever COLUMNS was when the console was made
    store, results = ["--store", str(tmp_path / "store")], ["--results", str(tmp_path / "results")]

    def run(*arguments: str) -> tuple[int, str]:
        code = cli.main(list(arguments))
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    options = ["--profile", "micro", "--task", "cart-pole", "--jobs", "1", *store]
    about = ["--rule", "cem@total", "--name", "CEM", "--authors", "A. Nobody", *results]
    code, text = run("submit", *options, *about)
    assert code == 0, text
    (path,) = (tmp_path / "results" / "submissions").glob("*.json")
    code, text = run("leaderboard", *results)
    assert code == 1 and "too small" in text
    small = ["--minimum-episodes", "2"]
    assert run("leaderboard", *results, *small)[0] == 0
    code, text = run("verify", str(path), "--secret", "short")
    assert code == 2 and "at least 16 characters" in text
    code, text = run("verify", str(path), "--secret", SECRET, "--jobs", "1", *store)
    assert "on kept-back episodes" in text and code in (0, 1)
    record = load_json(record_path(path))
    assert record["agrees"] == (code == 0)
    assert record["kept_back"] == {"episodes": MICRO.test, "commitment": commitment(SECRET)}
    written = json.dumps(record)
    assert not any(str(seed) in written for seed in kept_back_seeds(SECRET, "cart-pole", MICRO.test))
    run("leaderboard", *results, *small)
    state = read_csv(tmp_path / "results" / "submissions.csv")["status"].tolist()
    assert state == ["verified" if code == 0 else "not confirmed"]
