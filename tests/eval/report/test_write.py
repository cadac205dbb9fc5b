import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.folder.run_folder import write_run
from benchnav.eval.report import header
from benchnav.eval.report.write import (
    print_report,
    provenance_lines,
    read_report,
    write_report,
)
from tests.eval.forged import code_with, forge_run
from tests.eval.report import made


def episodes() -> pd.DataFrame:
    blind = made.condition("straight", "–", model="–")
    return made.rows(
        (
            made.row(made.condition(p), i, seed=s)
            for p in ("mppi", "cl_rrt")
            for i in range(2)
            for s in (0, 7)
        ),
        (
            made.row(blind, i, None, seed=s, outcome="stuck")
            for i in range(2)
            for s in (0, 7)
        ),
    )


def draws(rows: pd.DataFrame) -> list[list[int]]:
    """How often a condition was run, as `run.json` says it."""
    counted = rows.groupby(["seed", "realisation"], sort=False)["map"].nunique()
    return [
        [seed, realisation, count] for (seed, realisation), count in counted.items()
    ]


def run_folder(folder: Path, rows: pd.DataFrame, **changes: object) -> Path:
    """A run folder with what a report reads of it; parts of the conditions stand in for
    any.
    """
    parts = {
        kind: {"part": kind, "options": {}}
        for kind in ("model", "risk", "planner", "robot", "objective")
    }
    known = made.conditions(rows, cl_rrt={"follows": "its own time"})
    known = {
        name: about
        | {
            "value": {"data": "paper-v1", "split": "test/std", **parts, **made.PAPER},
            "draws": draws(rows[rows["condition"] == name]),
        }
        for name, about in known.items()
    }
    command = "benchnav-eval run --seeds '[0,7]'"
    history = [{"command": command, "commit": "abc", "benchnav": "0.8"}]
    return forge_run(folder, rows, known, **({"history": history} | changes))


@pytest.mark.usefixtures("whole_fonts")
def test_report_has_its_files_and_gives_the_summary(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", episodes())
    summary = write_report(folder).summary
    known = made.summarised(episodes())
    pd.testing.assert_frame_equal(summary[list(known.columns)], known)
    assert {
        "planning_ms_p95_median",
        "planning_start_ms_median",
        "best_difference",
        "best_p",
        "best_alike",
    } <= set(summary.columns)
    again = pd.read_csv(folder / "summary.csv")
    assert list(again.columns) == list(summary.columns)
    np.testing.assert_allclose(again["success_low"], summary["success_low"], rtol=1e-5)
    text = (folder / "summary.md").read_text()
    for line in (
        "- World paper: λ resampled; time budget T = 100 s; free terrain has λ̂ above 0.3.",
        "- Data: paper-v1. Models: paper-v1. Seeds: 0, 7.",
        "- Each condition: 4 episodes on 2 maps.",
        "¹ Cost minimised instead of J: its own time.",
        "    benchnav-eval run --seeds '[0,7]'",
    ):
        assert line in text.splitlines()
    assert "| std | CL-RRT¹ | CVaR | 100 |" in text
    assert " the highest success rate: " in text.partition("## Results")[0]
    assert "figures/success.png" in text
    assert "trajectories" not in text
    assert r"\begin{tabular}" in (folder / "summary.tex").read_text()
    names = ("success", "outcomes", "distributions")
    assert {path.name for path in (folder / "figures").iterdir()} == {
        f"{n}.{s}" for n in names for s in ("png", "pdf")
    }
    for name in names:
        assert f"![{name}](figures/{name}.png)" in text
        fonts = (folder / "figures" / f"{name}.pdf").read_bytes()
        assert b"/Type3" not in fonts
        assert b"/FontFile2" in fonts or b"/Type /ObjStm" in fonts
    assert len(pd.read_csv(folder / "failures.csv")) == 4
    page = (folder / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(names)
    for part in (
        " the highest success rate: ",
        "benchnav-eval run --seeds &#39;[0,7]&#39;",
        "no setting can be called worse",
    ):
        assert part in page
    assert not list(folder.rglob("*partial*"))


def test_trajectories_are_drawn_of_what_was_recorded(tmp_path: Path) -> None:
    rows = episodes()
    folder = run_folder(tmp_path / "run", rows)
    for name, group in rows.groupby("condition", sort=False):
        labels = {
            label: group[label].iloc[0]
            for label in ("planner", "risk", "scenario", "model", "data", "world")
        }
        about = {
            "condition": str(name),
            **labels,
            "map": "0",
            "seed": "0",
            "realisation": "0",
            "outcome": "stuck",
        }
        made.recording(20, about=about).save(
            folder / "playback" / f"{labels['planner']}.npz"
        )
    write_report(folder)
    assert (folder / "figures" / "trajectories.png").stat().st_size > 10_000
    text = (folder / "summary.md").read_text()
    assert "![trajectories](figures/trajectories.png)" in text
    assert "λ field" not in text


def test_a_figure_with_λ_as_it_was_says_so(tmp_path: Path) -> None:
    rows = made.rows(
        made.row(made.condition(world="stakes"), i, None, outcome="immobilised")
        for i in range(5)
    )
    folder = run_folder(tmp_path / "run", rows)
    about = {**made.held_recording().about, "condition": rows["condition"][0]}
    made.held_recording(about=about).save(folder / "playback" / "a.npz")
    write_report(folder)
    text = (folder / "summary.md").read_text()
    assert "Below: complete driven path over the λ field." in text


@pytest.mark.parametrize("outcome", ["planner_error", "model_error"])
def test_tracebacks_are_pointed_at(outcome: str, tmp_path: Path) -> None:
    rows = made.rows(
        made.row(made.condition(), 0),
        made.row(made.condition(), 1, None, outcome=outcome),
    )
    folder = run_folder(tmp_path / "run", rows)
    warning = read_report(folder).warnings[0]
    assert warning.startswith(
        "warning: a planner, model, sensor or belief failed in 1 episode; see "
    )
    assert str(folder / "errors.txt") in warning
    write_report(folder)
    assert warning in (folder / "summary.md").read_text()


def test_without_faults_there_is_nothing_to_point_at(tmp_path: Path) -> None:
    rows = episodes()
    folder = run_folder(tmp_path / "run", rows[rows["success"]])
    assert read_report(folder).warnings == ()


def test_what_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_report(read_report(run_folder(tmp_path / "run", episodes())))
    printed = capsys.readouterr().out
    assert printed.startswith("World paper: λ resampled; time budget T = 100 s")
    assert "T if success [s]" in printed
    assert "¹ Cost minimised instead of J: its own time." in printed
    assert re.search(r"\nstd:\n.+ the highest success rate: ", printed)
    assert "\x1b" not in printed


def test_an_unfinished_run_and_no_run_are_refused(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", episodes())
    (folder / "episodes.parquet").unlink()
    with pytest.raises(ConfigError, match="finished"):
        write_report(folder)
    with pytest.raises(ConfigError, match="run folder"):
        write_report(tmp_path)


def test_the_share_of_lambda_drawn_again_is_that_of_frozen_worlds_whatever_failed(
    tmp_path: Path,
) -> None:
    """Two conditions met the same three draws, of which one was the third; one of a
    resampled world met none.
    """
    worlds = {"a": "frozen", "b": "frozen", "c": "resampled"}
    conditions = {
        name: {"value": {"world": {"noise": noise}}} for name, noise in worlds.items()
    }
    rows = pd.DataFrame(
        {
            "condition": ["a"] * 2 + ["b"] * 2 + ["c"] * 2,
            "data": "d", "scenario": "std", "seed": 0, "realisation": 0,
            "world": ["stakes"] * 4 + ["paper"] * 2,
            "map": [0, 1] * 3,
            # the model of the first failed: it drew nothing
            "rejected_draws": [0, 0, 2, 0, 0, 0],
        }
    )  # fmt: skip
    (line,) = header._rejected_draws(rows, conditions)
    assert line.startswith("50.0 % of the draws of λ had no feasible path")
    assert header._rejected_draws(rows[rows["condition"] == "c"], conditions) == []


def test_a_sweep_has_its_figure(tmp_path: Path) -> None:
    rows = made.rows(
        made.row(made.condition(risk=f"cvar:{level}"), i)
        for level in (0.5, 0.8, 0.9)
        for i in range(2)
    )
    folder = run_folder(tmp_path / "run", rows)
    about = json.loads((folder / "run.json").read_text())
    for condition in about["conditions"].values():
        part, _, level = condition["labels"]["risk"].partition(":")
        condition["value"]["risk"] = {"part": part, "options": {"level": float(level)}}
    write_run(folder, about)
    write_report(folder)
    assert (folder / "figures" / "over-level.pdf").stat().st_size > 1000
    assert (
        "![over-level](figures/over-level.png)" in (folder / "summary.md").read_text()
    )


def test_provenance_of_a_run() -> None:
    about = {
        "history": [
            {"commit": "old", "benchnav": "0"},
            {"commit": "abc", "benchnav": "1.2"},
        ],
        "codes": {
            "a": code_with(parts={"model m": "1f"}),
            "b": code_with(
                parts={"risk r.py:f": "9e"}, environment={"compiles": False}
            ),
        },
        "machine": {"processor": "x86_64", "cores": 2},
        "datasets": {"paper-v1": {"id": "paper-v1", "maps": {"test/std": ["d"] * 20}}},
        "conditions": {"t": {"seeds": [0, 7]}},
    }
    assert provenance_lines(about) == [
        ("commit of benchnav", "abc"), ("version of benchnav", "1.2"),
        ("torch", "2.1"), ("processor", "AVX2"), ("compiles", "True"), ("device", "cpu"), ("planner_limit_s", "0.0"),
        ("torch", "2.1"), ("processor", "AVX2"), ("compiles", "False"), ("device", "cpu"), ("planner_limit_s", "0.0"),
        ("machine", "x86_64, 2 cores"), ("dataset paper-v1", "paper-v1; maps: test/std 20"),
        ("model m", "1f"), ("risk r.py:f", "9e"), ("seeds", "0, 7"),
    ]  # fmt: skip
    assert ("device", "cpu") in provenance_lines(about | {"device": "cpu", "gpu": None})
