from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.tables import latex
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairs import Compared, find_pairs
from tests.commands import call
from tests.eval.forged import code_with, forge_run
from tests.eval.report.made import condition, row, rows
from tests.eval.stats.test_pairs import value_of

MAPS = 12


def settings(shift: int = 0) -> pd.DataFrame:
    """Two planners under three settings, of which the cautious ones arrive more often,
    and `straight`.
    """
    generator = np.random.default_rng(5)
    noise = generator.random(MAPS)
    made = []
    for planner in ("mppi", "cl_rrt"):
        for risk, rate in (("mean", 0.3), ("cvar", 0.6), ("var", 0.9)):
            labels = condition(planner, risk)
            late = {"mean": 0, "cvar": 3, "var": 7}[risk] + shift
            made.append(
                [
                    row(labels, i, 30.0 + i + late if noise[i] < rate else None)
                    for i in range(MAPS)
                ]
            )
    made.append(
        [
            row(condition("straight", NOT_USED, model=NOT_USED), i, None)
            for i in range(MAPS)
        ]
    )
    return rows(*made)


OTHER_MODULE = code_with(modules={"benchnav.eval.run.unit": "t"})
PARTS = code_with(parts={"planner mppi": "1"})
PAPER = {"noise": "resampled", "time_budget_s": 100.0}


def run_folder(
    folder: Path,
    episodes: pd.DataFrame,
    values: Mapping[str, Mapping[str, Any]] | None = None,
    **changes: Any,
) -> Path:
    """A finished run with what a comparison reads of it; `values` are what is told of
    conditions by their label.
    """
    known = {}
    for name, group in episodes.groupby("condition", sort=False):
        labels = {label: group[label].iloc[0] for label in condition()}
        own = {
            key: value
            for label in labels.values()
            for key, value in (values or {}).get(label, {}).items()
        }
        draws = group.groupby(["seed", "realisation"]).size()
        known[name] = {
            "value": value_of(labels, world=PAPER) | own,
            "labels": labels,
            "seeds": sorted({int(seed) for seed in group["seed"]}),
            "draws": [
                [int(seed), int(realisation), int(n)]
                for (seed, realisation), n in draws.items()
            ],
        }
    about = {
        "datasets": {
            "paper-v1": {
                "id": "paper-v1",
                "maps": {"test/std": [f"{i:x}" for i in range(MAPS)]},
                "about": {},
            }
        },
    }
    given = {"code": PARTS | {"touched": {"file a.npz": "1"}}} | about | changes
    return forge_run(folder, episodes, known, **given)


def test_the_numbers_are_those_of_the_pairs_of_the_run(tmp_path: Path) -> None:
    episodes = settings()
    table, _ = compare_runs(
        [run_folder(tmp_path / "run", episodes)],
        "",
        "mean",
        {"planner": ("mppi",)},
        0.05,
    )
    conditions = [
        Compared(
            labels={**condition("mppi", risk), "run": NOT_USED},
            value=value_of(condition("mppi", risk)), maps=["m"] * MAPS,
            episodes=episodes[(episodes["planner"] == "mppi") & (episodes["risk"] == risk)].assign(time_budget_s=100.0),
        )
        for risk in ("mean", "cvar", "var")
    ]  # fmt: skip
    pd.testing.assert_frame_equal(
        table.drop(columns="different_code"),
        compare(find_pairs(conditions, against="mean")),
    )
    assert (table["different_code"] == "").all()
    assert list(table["one"]) == ["cvar", "var"]
    assert (table["arrival_time_difference_s"] == [3, 7]).all()


def test_how_long_many_pairs_take_is_said_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of three settings each of two planners makes three pairs."""
    folder = run_folder(tmp_path / "run", settings())
    compare_runs([folder], "risk", "", {}, 0.05)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("benchnav.eval.compare._MANY", 7)
    compare_runs([folder], "risk", "", {}, 0.05)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("benchnav.eval.compare._MANY", 6)
    clock = iter([0.0, 5.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    compare_runs([folder], "risk", "", {}, 0.05)
    assert (
        capsys.readouterr().err
        == "benchnav-eval: comparing 6 pairs takes about 0:00:06.\n"
    )


def test_what_is_looked_at_can_be_narrowed(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", settings())
    every, _ = compare_runs([folder], "", "", {}, 0.05)
    assert len(every) == 6
    some, shown = compare_runs([folder], "", "", {"risk": ("mean", "var")}, 0.05)
    assert [(r["planner"], r["one"], r["other"]) for r in some.to_dict("records")] == [
        ("mppi", "var", "mean"),
        ("cl_rrt", "var", "mean"),
    ]
    assert any("corrected over 2 pairs (Holm)" in note for note in shown.notes)
    assert some["success_p_holm"].iloc[0] < every["success_p_holm"].iloc[1]
    planners, _ = compare_runs([folder], "planner", "", {"risk": ("cvar",)}, 0.05)
    assert [(r["one"], r["other"]) for r in planners.to_dict("records")] == [
        ("cl_rrt", "mppi")
    ]
    blind, _ = compare_runs([folder], "", "straight", {}, 0.05)
    assert len(blind) == 6
    assert set(blind["other"]) == {"straight"}


def test_two_runs_are_compared_condition_by_condition(tmp_path: Path) -> None:
    before = run_folder(tmp_path / "a" / "run", settings())
    after = run_folder(tmp_path / "b" / "run", settings(shift=2), code=OTHER_MODULE)
    table, shown = compare_runs([before, after], "", "", {}, 0.05)
    assert len(table) == 7
    assert set(table["one"]) == {"b/run"}
    assert set(table["other"]) == {"a/run"}
    assert (table["arrival_time_difference_s"].dropna() == 2).all()
    # What differs between runs is what is asked here, so that it is said and not
    # refused.
    assert (
        "Different code: b/run differs from a/run in benchnav.eval.run.unit."
        in shown.notes
    )
    assert set(table["different_code"]) == {
        "b/run differs from a/run in benchnav.eval.run.unit"
    }


# What made the second run, and how it is told.
OTHER_CODE = {
    "part": (code_with(parts={"planner mppi": "2"}), "planner mppi"),
    "module": (OTHER_MODULE, "benchnav.eval.run.unit"),
    "data": (
        PARTS | {"touched": {"file a.npz": "2", "variable GAIN": "1"}},
        "file a.npz",
    ),
    "GPU": (code_with(environment={"device": "H100"}), "device (cpu to H100)"),
}


@pytest.mark.parametrize("name", OTHER_CODE)
def test_what_other_code_made_is_compared_only_when_asked_and_then_said_in_every_table(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = OTHER_CODE[name]
    episodes, out = (
        settings()[lambda rows: rows["planner"] == "mppi"],
        tmp_path / "table",
    )
    cautious = run_folder(tmp_path / "a", episodes[episodes["risk"] == "cvar"])
    plain = run_folder(tmp_path / "b", episodes[episodes["risk"] == "mean"], code=code)
    asked = (str(cautious), str(plain), "--by", "risk", "--out", str(out))
    assert call("eval", "compare", *asked) == 2
    refused = capsys.readouterr().err
    assert refused.count("\n") == 1
    assert (
        f"only in their risk, got conditions that were run with different code: b differs from a in {told}. "
        in refused
    )
    assert not list(tmp_path.glob("table*"))
    assert call("eval", "compare", *asked, "--allow-different", "code") == 0
    line = f"b differs from a in {told}"
    assert f"Different code: {line}." in capsys.readouterr().out
    assert f"Different code: {line}." in out.with_suffix(".md").read_text()
    assert f"Different code: {latex(line)}." in out.with_suffix(".tex").read_text()
    assert list(pd.read_csv(out.with_suffix(".csv"))["different_code"]) == [line]
    same = run_folder(tmp_path / "c", episodes[episodes["risk"] == "mean"])
    _, shown = compare_runs([cautious, same], "risk", "", {}, 0.05)
    assert not any("Different" in note for note in shown.notes)


def test_a_planner_that_was_edited_is_not_compared_with_another_either(
    tmp_path: Path,
) -> None:
    """By planner the two have parts of their own; what both runs name has to be one."""
    episodes = settings()[lambda rows: rows["risk"] == "mean"]
    first = run_folder(tmp_path / "a", episodes[episodes["planner"] != "cl_rrt"])
    edited = code_with(parts={"planner mppi": "2"})
    second = run_folder(
        tmp_path / "b", episodes[episodes["planner"] == "cl_rrt"], code=code_with()
    )
    # Rows of `cl_rrt` have no part in common with those of `mppi`.
    assert len(compare_runs([first, second], "planner", "", {}, 0.05)[0]) == 1
    # Of two scenarios each in a run of its own each pair has one code, and the label of
    # a row two.
    moved = episodes[episodes["planner"] == "mppi"].assign(
        scenario="hg", condition=lambda rows: rows["condition"] + "hg"
    )
    cautious = settings()[
        lambda rows: (rows["risk"] == "cvar") & (rows["planner"] == "mppi")
    ]
    here = run_folder(
        tmp_path / "c", pd.concat([episodes[episodes["planner"] == "mppi"], cautious])
    )
    two = pd.concat(
        [
            moved,
            cautious.assign(
                scenario="hg", condition=lambda rows: rows["condition"] + "hg"
            ),
        ]
    )
    maps = {"paper-v1": {"maps": {"test/hg": ["m"] * MAPS}}}
    there = run_folder(tmp_path / "d", two, code=edited, datasets=maps)
    with pytest.raises(ConfigError, match="d differs from c in planner mppi"):
        compare_runs([here, there], "risk", "", {}, 0.05)


def test_a_condition_that_two_runs_hold_counts_once(tmp_path: Path) -> None:
    episodes = settings()[lambda rows: rows["planner"] == "mppi"]
    whole, _ = compare_runs(
        [run_folder(tmp_path / "whole", episodes)], "risk", "", {}, 0.05
    )
    mean = episodes["risk"] == "mean"
    first = run_folder(tmp_path / "a", episodes[mean | (episodes["risk"] == "cvar")])
    # The second run holds `mean` again, on fewer maps and timed anew.
    again = episodes[
        (mean & (episodes["map"] < 9)) | (episodes["risk"] == "var")
    ].assign(planning_ms=77.0)
    second = run_folder(tmp_path / "b", again)
    table, shown = compare_runs([first, second], "risk", "", {}, 0.05)
    pd.testing.assert_frame_equal(table.drop(columns="run"), whole.drop(columns="run"))
    assert not any("left out" in note for note in shown.notes)
    # The other way round the longer one comes last.
    turned, _ = compare_runs([second, first], "risk", "mean", {}, 0.05)
    assert set(turned["n_episodes"]) == {MAPS}


def test_rows_of_one_condition_that_disagree_are_refused(tmp_path: Path) -> None:
    episodes = settings()[lambda rows: rows["planner"] == "mppi"]
    mean, late = episodes["risk"] == "mean", episodes.copy()
    late.loc[mean & (late["map"] < 2), "total_time_s"] += 1
    first = run_folder(tmp_path / "a", episodes[mean | (episodes["risk"] == "cvar")])
    edited = code_with(parts={"planner mppi": "2"})
    second = run_folder(
        tmp_path / "b", late[mean | (late["risk"] == "var")], code=edited
    )
    for allowed in (False, True):
        with pytest.raises(
            ConfigError,
            match=r"2 of 12 episodes of .* that differ between a and b \(b differs from a in planner mppi\)",
        ):
            compare_runs([first, second], "risk", "", {}, 0.05, allowed)


def test_what_found_no_partner_is_named(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", settings())
    _, shown = compare_runs([folder], "planner", "", {"risk": ("mean", "–")}, 0.05)
    assert not any("Conditions not in the table" in note for note in shown.notes)
    lonely = {"part": "mppi", "options": {"theta": 5.0}}
    episodes = settings()[
        lambda rows: (rows["planner"] != "cl_rrt") | (rows["risk"] != "var")
    ]
    other = run_folder(tmp_path / "other", episodes, values={"var": {"risk": lonely}})
    _, shown = compare_runs(
        [other], "planner", "", {"planner": ("mppi", "cl_rrt")}, 0.05
    )
    assert (
        "Conditions not in the table, since no other condition differs from them only in planner: MPPI VaR."
        in shown.notes
    )
    _, shown = compare_runs([folder], "", "mean", {}, 0.05)
    assert (
        "Conditions not in the table, since no other condition differs from them only in risk: straight."
        in shown.notes
    )


def test_maps_of_unequally_many_draws_all_count_and_what_is_left_out_is_named(
    tmp_path: Path,
) -> None:
    def drawn(risk: str, *draws: tuple[int, int]) -> pd.DataFrame:
        return rows(
            [
                row(condition("mppi", risk), i, seed=seed)
                for seed, maps in draws
                for i in range(maps)
            ]
        )

    uneven = run_folder(
        tmp_path / "a",
        pd.concat([drawn("mean", (0, 12), (1, 5)), drawn("cvar", (0, 12), (1, 5))]),
    )
    table, shown = compare_runs([uneven], "risk", "", {}, 0.05)
    assert (table["n_maps"][0], table["n_episodes"][0]) == (12, 17)
    assert shown.notes[0].endswith(
        ", 12 maps, 17 episodes per condition, the same draws of λ."
    )
    assert not any("left out" in note for note in shown.notes)
    short = run_folder(
        tmp_path / "b",
        pd.concat([drawn("mean", (0, 12), (1, 9)), drawn("cvar", (0, 10), (2, 1))]),
    )
    table, shown = compare_runs([short], "risk", "", {}, 0.05)
    assert (table["n_maps"][0], table["n_episodes"][0]) == (10, 10)
    assert [note for note in shown.notes if "left out" in note] == [
        "1 of 11 episodes of CVaR are left out: mean was not run on them (seed 2 on map 0).",
        "11 of 21 episodes of mean are left out: CVaR was not run on them "
        "(seed 0 on maps 10 to 11; seed 1 on maps 0 to 8).",
    ]


def test_pairs_that_a_run_left_out_are_told_where_both_planner_and_robot_are_compared(
    tmp_path: Path,
) -> None:
    robot = condition()["robot"]
    pairs = [
        ("mppi", robot),
        ("mppi", "bicycle"),
        ("astar_dwa", robot),
        ("astar_dwa", "bicycle"),
    ]
    dropped = [
        {"planner": planner, "robot": name, "reason": "no"} for planner, name in pairs
    ]
    folder = run_folder(tmp_path / "run", settings(), dropped=dropped)
    _, shown = compare_runs([folder], "", "mean", {"planner": ("mppi",)}, 0.05)
    told = [note for note in shown.notes if note.startswith("left out: planner")]
    assert told == [f"left out: planner mppi, robot {robot}: no"]


def test_groups_of_maps_are_the_unit(tmp_path: Path) -> None:
    episodes = settings()
    folder = run_folder(tmp_path / "run", episodes.assign(group=episodes["map"] // 3))
    table, shown = compare_runs([folder], "risk", "", {}, 0.05)
    assert set(zip(table["n_maps"], table["n_groups"], strict=True)) == {(12, 4)}
    assert "4 groups of maps (the statistical unit)" in shown.notes[0]


def test_robots_under_unlike_budgets_are_compared_in_shares(tmp_path: Path) -> None:
    """T is thrice the reference time at each robot's top speed, 1 and 2 m/s: a failure
    of the slow one costs 75 s.
    """
    slow, fast = (condition(robot=name) for name in ("slow", "fast"))
    times = {"slow": [30.0, 45.0, None], "fast": [15.0, 20.0, 20.0]}
    made = [
        row(
            labels,
            i,
            time_s,
            time_ratio=time_s * speed / 25 if time_s else np.nan,
            total_time_s=time_s or 75.0,
        )
        for labels, speed in ((slow, 1), (fast, 2))
        for i, time_s in enumerate(times[labels["robot"]])
    ]
    world = {"paper": {"world": {"noise": "resampled", "time_budget_ratio": 3.0}}}
    table, shown = compare_runs(
        [run_folder(tmp_path / "run", rows(made), values=world)],
        "robot",
        "slow",
        {},
        0.05,
    )
    shares = np.array([15 / 37.5 - 30 / 75, 20 / 37.5 - 45 / 75, 20 / 37.5 - 1])
    assert table["time_difference_share"][0] == pytest.approx(shares.mean())
    assert "Δ T_total [% of T]" in shown.headings


def test_runs_with_conditions_of_their_own_are_compared_across(tmp_path: Path) -> None:
    episodes = settings()
    cautious = run_folder(tmp_path / "a", episodes[episodes["risk"] == "cvar"])
    plain = run_folder(tmp_path / "b", episodes[episodes["risk"] == "mean"])
    table, _ = compare_runs([cautious, plain], "", "mean", {}, 0.05)
    assert list(table["planner"]) == ["mppi", "cl_rrt"]
    other = {"paper-v1": {"maps": {"test/std": ["x"] * MAPS}}}
    elsewhere = run_folder(
        tmp_path / "c", episodes[episodes["risk"] == "mean"], datasets=other
    )
    with pytest.raises(ConfigError, match="whose maps differ"):
        compare_runs([cautious, elsewhere], "", "mean", {}, 0.05)


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(
    ("about", "groups", "words"),
    [
        ({"test/std": "2"}, 1, "differ in class table, λ_stuck, resolution or kind of truth of paper-v1 test/std"),
        ({"test/std": "1"}, 2, "differ in groups of maps of paper-v1 test/std"),
        ({"test/std": "2"}, 2, "kind of truth of paper-v1 test/std, groups of maps"),
    ],
)  # fmt: skip
def test_maps_of_another_meaning_are_no_pair_and_no_joined_condition(
    tmp_path: Path, joined: bool, about: Mapping[str, str], groups: int, words: str
) -> None:
    episodes = settings()[lambda rows: rows["planner"] == "mppi"]

    def made(name: str, risks: set[str], about: Mapping[str, str], size: int) -> Path:
        maps = {"test/std": [f"{i:x}" for i in range(MAPS)]}
        own = episodes[episodes["risk"].isin(risks)].assign(
            group=lambda rows: rows["map"] // size
        )
        datasets = {"paper-v1": {"id": "paper-v1", "maps": maps, "about": about}}
        return run_folder(tmp_path / name, own, datasets=datasets)

    first = made("a", {"mean", "cvar"} if joined else {"cvar"}, {"test/std": "1"}, 1)
    alike = made("b", {"mean"}, {"test/std": "1"}, 1)
    assert len(compare_runs([first, alike], "risk", "", {}, 0.05)[0]) == 1
    # An earlier version did not write what maps mean.
    assert (
        len(compare_runs([first, made("c", {"mean"}, {}, 1)], "risk", "", {}, 0.05)[0])
        == 1
    )
    with pytest.raises(ConfigError, match=words):
        compare_runs([first, made("d", {"mean"}, about, groups)], "risk", "", {}, 0.05)


def test_command_prints_and_writes(tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    folder = run_folder(tmp_path / "run", settings())
    out = tmp_path / "made" / "cautious"
    assert (
        call(
            "eval",
            "compare",
            str(folder),
            "--against",
            "mean",
            "--points",
            "20",
            "--out",
            str(out),
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "corrected over 4 pairs (Holm)" in printed
    assert "12 maps, 12 episodes per condition" in printed
    assert "20 points need" in printed
    numbers = pd.read_csv(out.with_suffix(".csv"))
    assert list(numbers["one"]) == ["cvar", "var"] * 2
    assert out.with_suffix(".md").read_text().count("\n| ") == 4
    paper = out.with_suffix(".tex").read_text()
    assert r"\toprule" in paper
    assert rf"\label{{tab:{out.name}}}" in paper


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "one or more run folders"),
        (("RUN", "--planner", "mpi"), "Did you mean 'mppi'"),
        (("RUN", "--points", "0"), r"`points` in [0.001, 100]"),
        (("RUN", "RUN"), "Expected runs that differ"),
        (("RUN", "--by", "data"), "determine the maps"),
    ],
)
def test_bad_input_ends_with_one_line_and_status_2(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys
) -> None:  # type: ignore[no-untyped-def]
    folder = run_folder(tmp_path / "run", settings())
    assert (
        call(
            "eval",
            "compare",
            *(str(folder) if word == "RUN" else word for word in arguments),
        )
        == 2
    )
    written = capsys.readouterr().err
    assert message in written
    assert written.count("\n") == 1
