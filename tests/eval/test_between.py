"""Runs in several worlds: the same draws, and their comparison by object and command."""

from pathlib import Path

import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval import evaluate
from benchnav.eval.figures import Waterfall
from benchnav.eval.results import Results
from benchnav.planning import AStarDWA, CVaR, Mean, Straight, Unicycle, World
from tests.commands import call

LONG = "stakes time_budget_s=20"
SHORT = "stakes time_budget_s=6"


@pytest.fixture(scope="module")
def run(dataset_path: Path) -> Results:
    return evaluate(
        dataset_path,
        planners=[AStarDWA(), Straight()],
        models=["oracle"],
        risks=[CVaR(0.8), Mean()],
        robots=[Unicycle(speed_mps=(0.0, 2.0))],
        world=[
            World.stakes(time_budget_s=20.0),
            {"preset": "stakes", "time_budget_s": 6.0},
        ],
        scenarios=["std"],
        realisations=2,
        hypotheses=[
            {
                "one": {"risk": "cvar:0.8", "world": SHORT},
                "other": {"risk": "mean", "world": SHORT},
                "metric": "success",
            }
        ],
        maps=2,
        verbose=False,
    )


def test_all_worlds_have_the_same_draws_and_starts(run: Results) -> None:
    keys = ["planner", "risk", "seed", "realisation", "map"]
    by_world = dict(list(run.episodes.groupby("world")))
    paired = by_world[LONG].merge(by_world[SHORT], on=keys, suffixes=("", "_short"))
    assert len(paired) == len(run.episodes) / 2
    for column in ("rejected_draws", "reference_time_s"):
        assert paired[column].equals(paired[f"{column}_short"])
    succeeded = paired[paired["success_short"]]
    assert 0 < len(succeeded) < paired["success"].sum()
    for column in ("success", "total_time_s", "path_length_m", "traversability"):
        assert succeeded[column].equals(succeeded[f"{column}_short"])


def test_results_compare_worlds(run: Results) -> None:
    between = run.between()
    assert list(between.settings["world"].unique()) == [LONG, SHORT]
    assert len(between.settings) == 6
    rates = run.episodes.groupby("condition")["success"].mean()
    for row in between.settings.to_dict("records"):
        assert row["success_rate"] == rates[row["condition"]]
    (agreement,) = between.agreement.to_dict("records")
    assert (agreement["world"], agreement["other"]) == (LONG, SHORT)
    assert agreement["same_draws"]
    assert list(between.hypotheses["world"]) == [LONG, SHORT]
    assert list(between.hypotheses["registered"]) == [False, True]
    registered = between.hypotheses.iloc[1]
    (expected,) = run.hypotheses.to_dict("records")
    for name in ("difference", "low", "high", "p"):
        assert registered[name] == expected[name]
    assert len(repr(between).splitlines()) == 1
    assert [table.title for table in between.tables] == [
        "Between worlds",
        "Agreement between worlds",
        "Hypotheses in each world",
    ]
    chosen = run.between(planner="astar_dwa")
    assert set(chosen.settings["planner"]) == {"astar_dwa"}


def test_one_world_cannot_be_compared(run: Results) -> None:
    with pytest.raises(ConfigError, match="in two or more worlds, got conditions with"):
        run.between(world=LONG)
    with pytest.raises(ConfigError, match="labels among"):
        run.between(worlds=LONG)
    with pytest.raises(ConfigError, match="`planner`"):
        run.between(planner="mppi")


def test_the_command_compares_worlds_as_results_do(
    run: Results, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(run.save(tmp_path / "run").folder)
    out = str(tmp_path / "table")
    assert call("eval", "compare", folder, "--by", "world", "--out", out) == 0
    printed = capsys.readouterr().out
    between = run.between()
    for sentence in between.findings:
        assert sentence in printed
    written = pd.read_csv(f"{out}-worlds.csv")
    pd.testing.assert_frame_equal(written, between.settings, False, rtol=1e-5)
    assert "Agreement between worlds" in Path(f"{out}-worlds.md").read_text()
    assert r"$\kappa$" in Path(f"{out}-worlds.tex").read_text()
    assert call("eval", "compare", folder, "--by", "risk") == 0
    assert "Agreement" not in capsys.readouterr().out


def test_runs_of_one_world_each_are_compared(
    run: Results, dataset_path: Path, tmp_path: Path
) -> None:
    """Two runs with one world each give the tables of one run with both worlds."""
    folders = []
    for budget_s in (20.0, 6.0):
        folder = tmp_path / f"{budget_s:g}"
        evaluate(
            dataset_path,
            folder=folder,
            planners=[Straight()],
            models=["oracle"],
            robots=[Unicycle(speed_mps=(0.0, 2.0))],
            world=World.stakes(time_budget_s=budget_s),
            scenarios=["std"],
            realisations=2,
            maps=2,
            verbose=False,
        )
        folders.append(str(folder))
    out = str(tmp_path / "table")
    assert call("eval", "compare", *folders, "--by", "world", "--out", out) == 0
    written = pd.read_csv(f"{out}-worlds.csv")
    expected = run.between(planner="straight").settings
    columns = ["world", "success_rate", "n_episodes", "n_maps"]
    pd.testing.assert_frame_equal(written[columns], expected[columns], False, rtol=1e-5)


def test_the_report_has_a_section_only_with_several_worlds(
    run: Results, tmp_path: Path
) -> None:
    contrast = Waterfall({"planner": "straight"}, {"risk": "mean"}, name="contrast")
    page = run.report(tmp_path, [contrast])
    assert '<h2 id="worlds">Between worlds</h2>' in page.read_text()
    summary = (tmp_path / "summary.md").read_text()
    assert "Agreement between worlds:\n\n|" in summary
    names = ("worlds.csv", "worlds-agreement.csv", "worlds-hypotheses.csv")
    figures = ("figures/between-worlds.png", "figures/contrast.png")
    assert all((tmp_path / name).is_file() for name in (*names, *figures))
