import re

import numpy as np
import pandas as pd
import pytest

from benchnav.core.tables import to_markdown
from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.report.comparison_tables import comparison_table, metric_table
from benchnav.eval.report.result_tables import learning_table, paper_table, result_table
from benchnav.eval.stats.comparison import compare, compare_by
from benchnav.eval.stats.pairs import Compared, Pair
from benchnav.eval.stats.summary import summarise
from benchnav.metrics import Energy
from benchnav.metrics.shipped import STUCK_FRACTION
from tests.eval.report import made
from tests.eval.stats.test_comparison import A, B, pair

BLIND = {"planner": "straight", "risk": "–", "model": "–"}


def table_of(episodes, **notes):  # type: ignore[no-untyped-def]
    return result_table(made.summary(episodes), made.conditions(episodes, **notes))


def test_golden_table() -> None:
    quick = [
        made.row(
            made.condition("mppi"),
            i,
            time,
            traversability=0.7,
            planning_ms=2.0 * i,
            planning_ms_p95=4.0 * i,
        )
        for i, time in enumerate((20.0, 30.0))
    ]
    slow = [
        made.row(
            made.condition("cl_rrt", "mean"),
            0,
            40.0,
            traversability=0.9,
            compiled=False,
        ),
        made.row(
            made.condition("cl_rrt", "mean"),
            1,
            None,
            outcome="stuck",
            traversability=0.5,
            compiled=False,
        ),
    ]
    blind = [
        made.row(
            made.condition(**BLIND),
            0,
            None,
            outcome="out_of_bounds",
            planning_ms=np.nan,
        ),
        made.row(
            made.condition(**BLIND),
            1,
            None,
            outcome="planner_failure",
            traversability=np.nan,
            planning_ms=np.nan,
        ),
    ]
    notes = {"cl_rrt": {"follows": "its own time", "remarks": ["limits 0.5 m/s²"]}}
    table = table_of(made.rows(quick, slow, blind), **notes)
    assert to_markdown(table).partition("\n\n- **")[0] == (
        "| scenario | planner | risk | Succ. [%] | 95 % interval | T_total [s] | T if success [s] | λ̄ [%] "
        "| per episode of a batch [ms] | failures |\n"
        "|---|---|---|---|---|---|---|---|---|---|\n"
        "| std | MPPI | CVaR | 100 | 34–100 | 25.0 | 25.0 ± 7.1 | 70.0 ± 0.0 | 1 (2)¶ | – |\n"
        "| std | CL-RRT¹,² | mean | 50 | 9–91 | 70.0 | 40.0 | 70.0 ± 28.3 | 1 (3) | 1 stuck |\n"
        "| std | straight | – | 0 | 0–66 | 100.0 | – | 80.0 (n = 1) | – | 1 out of bounds, "
        "1 planner failure |\n"
        "\n¹ Cost minimised instead of J: its own time.\n"
        "\n² limits 0.5 m/s²\n"
        "\n¶ The planner ran as compiled code.\n"
        "\nNo rate is bold: with fewer than 6 maps, no setting can be called worse than the best."
    )


def test_eight_maps_give_times_an_interval() -> None:
    seven, eight = (
        table_of(
            made.rows([made.row(made.condition(), i, 20.0 + i) for i in range(n)])
        ).rows[0]
        for n in (7, 8)
    )
    assert "23.0" in seven
    assert any(re.fullmatch(r"23\.5 \(21\.\d–4\d\.\d\)", cell) for cell in eight)


def test_tables_without_planning_have_no_column_of_it() -> None:
    without = table_of(made.rows(made.row(made.condition(), planning_ms=np.nan)))
    assert "per episode of a batch [ms]" not in without.headings
    assert {len(row) for row in without.rows} == {len(without.headings)}
    assert without.rows[0][-1] == "–"
    others = [(name, value, n) for name in LABELS for n, value in enumerate("abc", 1)]
    every = made.rows(
        *(
            [made.row(made.condition(**{name: value}), i) for i in range(n)]
            for name, value, n in others
        ),
        (made.row(made.condition(), 0, seed=seed) for seed in (0, 1)),
    )
    assert {*LABELS, "maps", "episodes"} <= {
        heading for heading, _ in table_of(every).explained
    }


def test_bold_is_what_is_not_worse_than_the_best_where_another_is() -> None:
    rates = {"mean": 10, "var": 28, "cvar": 30}
    rows = made.rows(
        *(
            [
                made.row(made.condition(risk=r), i, 20.0 if i < n else None)
                for i in range(30)
            ]
            for r, n in rates.items()
        ),
        (made.row(made.condition(model="oracle"), i) for i in range(30)),
    )
    table = table_of(rows)
    rate = table.headings.index("Succ. [%]")
    assert made.bold_cells(table) == {(1, rate), (2, rate)}
    assert table.bold_note == (
        "the highest success rate, and all rates without a significant difference from it "
        "(max-T bootstrap test by map, p ≥ 0.05). Privileged models (oracle) do not compete."
    )
    alike = table_of(
        rows[rows["risk"].isin(["var", "cvar"]) & (rows["model"] != "oracle")]
    )
    assert (made.bold_cells(alike), alike.bold_note) == (set(), "")
    no_difference = "No rate is bold: no setting is significantly worse than the best."
    assert no_difference in alike.notes
    assert no_difference not in table.notes
    alone = table_of(made.rows(made.row(made.condition())))
    assert (made.bold_cells(alone), alone.bold_note) == (set(), "")
    assert no_difference not in alone.notes


def test_labels_that_differ_are_shown_and_others_are_not() -> None:
    def headings(*labels: dict[str, str]) -> tuple[str, ...]:
        table = table_of(made.rows(made.row(one) for one in labels))
        assert {len(row) for row in table.rows} == {len(table.headings)}
        return table.headings[: table.n_labels]

    one = made.condition()
    assert headings(one) == ("scenario", "planner", "risk")
    assert headings(one, made.condition(**BLIND)) == ("scenario", "planner", "risk")
    for name in ("data", "world", "robot", "objective", "model"):
        assert name in headings(one, made.condition(**{name: "another"}))
    several = headings(
        one,
        made.condition(model="mdn"),
        made.condition(**BLIND),
        made.condition(world="stakes"),
    )
    assert several == ("scenario", "world", "model", "planner", "risk")


def test_a_blind_planner_has_neither_risk_nor_model() -> None:
    table = table_of(made.rows(made.row(made.condition(model=m)) for m in ("a", "b")))
    blind = table_of(
        made.rows(
            made.row(labels)
            for labels in (
                made.condition(**BLIND),
                made.condition(),
                made.condition(model="b"),
            )
        )
    )
    assert [row[1] for row in table.rows] == ["a", "b"]
    assert blind.rows[0][:4] == ("std", "–", "straight", "–")


def test_numbers_of_maps_and_episodes_are_shown_where_they_are_not_the_same() -> None:
    few, many = made.condition("mppi"), made.condition("cl_rrt")
    episodes = [made.row(few, i) for i in range(2)]
    same = table_of(made.rows(episodes, (made.row(many, i) for i in range(2))))
    assert "maps" not in same.headings
    assert "episodes" not in same.headings
    more = (made.row(many, i, seed=seed) for i in range(3) for seed in range(4))
    more_maps = table_of(made.rows(episodes, more))
    assert more_maps.headings[3:5] == ("maps", "episodes")
    assert [row[3:5] for row in more_maps.rows] == [("2", "2"), ("3", "12")]
    more_seeds = table_of(
        made.rows(
            episodes, (made.row(many, i, seed=s) for i in range(2) for s in range(2))
        )
    )
    assert more_seeds.headings[3:5] == ("episodes", "Succ. [%]")
    assert [row[3] for row in more_seeds.rows] == ["2", "4"]


def test_notes_are_numbered_once_and_marked_at_every_condition_they_hold_for() -> None:
    episodes = made.rows(
        made.row(made.condition(planner, risk), compiled=False)
        for planner in ("mppi", "a", "b")
        for risk in ("mean", "cvar")
    )
    shared = {"follows": "path length", "remarks": []}
    table = table_of(episodes, a=shared, b=shared | {"remarks": ["slow"]})
    assert [row[1] for row in table.rows] == [
        "MPPI",
        "MPPI",
        "a¹",
        "a¹",
        "b¹,²",
        "b¹,²",
    ]
    assert table.notes[:2] == ("¹ Cost minimised instead of J: path length.", "² slow")


@pytest.mark.parametrize("follows", ["", "J"])
def test_a_planner_that_follows_the_users_objective_alone_needs_no_note(
    follows: str,
) -> None:
    table = table_of(
        made.rows(made.row(made.condition(), compiled=False)), mppi={"follows": follows}
    )
    assert table.rows[0][1] == "MPPI"
    assert table.notes == ()


def test_groups_are_counted_and_named_where_there_are_such() -> None:
    def grouped(labels: dict[str, str], maps: int) -> list[dict]:  # type: ignore[type-arg]
        return [
            made.row(labels, i, 30.0 if i < 20 else None, group=i // 2)
            for i in range(maps)
        ]

    table = table_of(
        made.rows(
            grouped(made.condition(risk="a"), 40), grouped(made.condition(risk="b"), 36)
        )
    )
    assert table.headings[3:6] == ("groups", "maps", "episodes")
    assert [row[3:5] for row in table.rows] == [("20", "40"), ("18", "36")]
    worse = [
        made.row(made.condition(risk="c"), i, None, group=i // 2) for i in range(40)
    ]
    text = table_of(made.rows(grouped(made.condition(risk="a"), 40), worse)).bold_note
    assert "bootstrap test by group" in text
    paper = paper_table(made.summary(made.rows(grouped(made.condition(), 40))), "run")
    assert "on 40 maps in 20 groups per scenario" in paper


def paper_of(*conditions: tuple[dict[str, str], int]) -> str:
    rows = made.rows(
        *(
            [made.row(labels, i, 20.0 if i < n else None) for i in range(40)]
            for labels, n in conditions
        )
    )
    return paper_table(made.summary(rows), "run_1")


def body(text: str) -> list[list[str]]:
    """Cells of all lines of the tabulars."""
    lines = [line.strip() for line in text.splitlines()]
    return [
        [cell.strip() for cell in line[:-2].split("&")]
        for line in lines
        if line.endswith(r"\\")
    ]


def test_settings_stand_down_and_scenarios_across() -> None:
    text = paper_of(
        (made.condition("astar_dwa", "mean"), 40), (made.condition("astar_dwa", "cvar:0.9"), 10),
        (made.condition("mppi", "mean"), 38), (made.condition("mppi", "mean", scenario="hg"), 20),
    )  # fmt: skip
    titles, heads, *rows = body(text)
    assert titles == ["", "", r"\multicolumn{3}{c}{std}", r"\multicolumn{3}{c}{hg}"]
    assert heads == [
        "Planner",
        "Risk",
        *(
            [r"Succ. {[}\%]", r"$T_\mathrm{total}$ {[}s]", r"$\bar{\lambda}$ {[}\%]"]
            * 2
        ),
    ]
    assert r"\cmidrule(lr){3-5} \cmidrule(lr){6-8}" in text
    assert [row[:2] for row in rows] == [
        ["A*+DWA", "mean"],
        ["", r"CVaR$_{0.9}$"],
        ["MPPI", "mean"],
    ]
    # Not 38 but 10 of 40 are significantly worse than 40; hg has one setting alone, so
    # none is bold.
    assert [row[2].split(" ")[0] for row in rows] == [
        r"\textbf{100}",
        "25",
        r"\textbf{95}",
    ]
    assert rows[1][3] == r"80.0 $\pm$ 35.1"
    assert rows[0][5:] == ["--"] * 3
    assert rows[2][5].startswith("50 {")
    # A line parts the planners, as it parts the heading from the first.
    lines = [line.strip() for line in text.splitlines()]
    under = [
        lines[place + 1].split(" &")[0]
        for place, line in enumerate(lines)
        if line == r"\midrule"
    ]
    assert under == ["A*+DWA", "MPPI"]


def test_it_is_a_whole_table_for_booktabs_alone() -> None:
    scenarios = ("std", "hg", "hs", "a_b", "50%")
    text = paper_of(
        *(
            (made.condition("my_planner&", "r_1", scenario=s, model=m), 9)
            for s in scenarios
            for m in "ab"
        )
    )
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    for name in ("table*", "tabular"):
        assert text.count(rf"\begin{{{name}}}") == text.count(rf"\end{{{name}}}")
    assert text.count(r"\begin{tabular}") == 2  # at most three scenarios across
    assert r"\caption{" in text
    assert r"\label{tab:run_1}" in text
    assert r"my\_planner\&" in text
    assert r"50\%" in text
    for tabular in re.findall(
        r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", text, re.DOTALL
    ):
        columns, inner = len(tabular[0]), tabular[1]
        for line in (line for line in inner.splitlines() if line.endswith(r"\\")):
            unescaped = line.replace(r"\&", "")
            spanned = sum(
                int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d)\}", line)
            )
            assert unescaped.count("&") + 1 + spanned == columns
    assert not re.search(r"\\(multirow|resizebox|usepackage)", text)


def test_a_model_is_named_where_there_are_several() -> None:
    text = paper_of((made.condition(model="a"), 30), (made.condition(model="b"), 30))
    assert body(text)[1][:3] == ["Planner", "Model", "Risk"]
    assert [row[:3] for row in body(text)[2:]] == [
        ["MPPI", "a", "CVaR"],
        ["", "b", "CVaR"],
    ]
    assert r"\begin{table}[t]" in text


def cells(table: pd.DataFrame, difference: float = 0.05) -> list[dict[str, str]]:
    shown = comparison_table(table, difference, "risk")
    names = [
        f"{heading}{i}" if heading == "95 %" else heading
        for i, heading in enumerate(shown.headings)
    ]
    return [dict(zip(names, row, strict=True)) for row in shown.rows]


def test_success_is_in_points_and_p_is_the_corrected_one() -> None:
    table = compare([pair(A, B), pair(B, A, ("var", "mean"))])
    table["success_p_holm"], table["success_p"] = [0.032, 0.00001], 0.9
    first, second = cells(table)
    assert (
        first["risk"],
        first["against"],
        first["Succ. [%]"],
        first["Δ [points]"],
    ) == (
        "CVaR",
        "mean",
        "75 : 50",
        "+25.0",
    )
    low, high = 100 * table["success_low"][0], 100 * table["success_high"][0]
    assert f"{low:+.1f} to {high:+.1f}" in first.values()
    assert "0.032" in first.values()
    assert first["significant"] == "yes"
    assert "≤ 0.0001" in second.values()
    assert second["Δ [points]"] == "-25.0"


def test_what_is_not_significant_says_so() -> None:
    table = compare([pair(A, B)])
    assert table["success_p_holm"][0] > 0.05
    assert cells(table)[0]["significant"] == "no"


def test_labels_that_differ_have_a_column_and_notes_name_the_family() -> None:
    table = compare([pair(A, B), pair(A, B)]).assign(
        planner=["mppi", "cl_rrt"], model="–"
    )
    shown = comparison_table(table, 0.2, "risk")
    assert shown.headings[:3] == ("planner", "risk", "against")
    assert shown.n_labels == 3
    notes = " ".join(shown.notes)
    assert "corrected over 2 pairs (Holm)" in notes
    needed = np.unique(table["maps_needed"])
    assert f"20 points need {needed[0]} maps" in notes
    assert "too few" not in notes


def test_maps_too_few_to_show_any_difference_say_so() -> None:
    table = compare([pair(A[:4], B[:4]), pair(A * 10, B * 10)])
    few, many = cells(table)
    assert table["success_detectable"][0] > 1
    assert few["detectable"] == "–"
    assert many["detectable"] == f"{100 * table['success_detectable'][1]:.0f}"
    (_, note) = comparison_table(table, 0.2, "risk").notes
    assert note.endswith(
        "There are too few maps for a significant difference, and for an estimate of the number of maps needed."
    )


def test_times_in_shares_of_unlike_budgets_say_so() -> None:
    table = compare([pair([30.0, 300, 60], [10.0, 50, 25], budgets_s=(300.0, 100.0))])
    shown = comparison_table(table, 0.05, "risk")
    (row,) = cells(table)
    # shares 0.1, 1, 0.2 less 0.1, 0.5, 0.25
    assert row["Δ T_total [% of T]"] == "+15.0"
    assert not [heading for heading in shown.headings if "T_total [s]" in heading]
    assert (
        "in fractions of each condition's own T"
        in dict(shown.explained)["Δ T_total [% of T], 95 %"]
    )


def test_what_robots_learnt_stands_in_a_table_of_its_own() -> None:
    learns = made.condition("astar_dwa", "mean", ground="probe:1", belief="copula")
    told = {"seen_cells": 4096.0, "learning_ms": 3.0, "ahead_log_score": 0.5}
    episodes = made.rows(
        [made.row(made.condition("astar_dwa", "mean"), place) for place in range(2)],
        made.row(learns, 0, sensed_cells=100.0, revisions=10.0, ahead_rmse=0.1, **told),
        made.row(learns, 1, sensed_cells=301.0, revisions=21.0, ahead_rmse=0.3, **told),
    )
    table = learning_table(made.summary(episodes))
    assert table is not None
    (cells,) = table.rows
    shown = dict(zip(table.headings, cells, strict=True))
    assert shown["ground"] == "probe:1"
    assert shown["belief"] == "copula"
    means = (
        "cells seen",
        "cells sensed",
        "revisions",
        "RMSE ahead",
        "log score ahead",
        "belief [ms]",
        "planning [ms]",
    )
    assert [shown[name] for name in means] == [
        "4096",
        "200",
        "16",
        "0.200",
        "0.500",
        "3",
        "1",
    ]
    assert [heading for heading, _ in table.explained] == list(table.headings)
    assert (
        learning_table(
            made.summary(made.rows(made.row(made.condition("mppi", "mean"))))
        )
        is None
    )


def test_what_is_lost_to_a_robot_that_sees_all_stands_beside_what_it_learnt() -> None:
    def rows(
        sensor: str, *times_s: float | None, **labels: str
    ) -> list[dict[str, object]]:
        condition = made.condition("astar_dwa", "mean", sensor=sensor, **labels)
        learnt = (
            {}
            if sensor == "full" and not labels
            else {"revisions": 3.0, "seen_cells": 9.0}
        )
        return [
            made.row(condition, place, time_s, **learnt)
            for place, time_s in enumerate(times_s)
        ]

    learns = {"ground": "probe:1", "belief": "copula"}
    episodes = made.rows(
        rows("full", 10.0, 20.0),
        rows("near:4", 30.0, None),
        rows("full", 10.0, 12.0, **learns),
        rows("near:8", 10.0, 10.0, ground="contact", belief="copula"),
    )
    table = learning_table(made.summary(episodes))
    assert table is not None
    lost = {
        row[table.headings.index("sensor")] + row[table.headings.index("belief")]: row[
            -2:
        ]
        for row in table.rows
    }
    assert lost == {
        "near:4static": ("-50.0", "+50.0"),
        "fullcopula": ("–", "–"),
        "near:8copula": ("–", "–"),
    }


def test_a_further_metric_has_a_column_in_its_unit_with_its_meaning() -> None:
    episodes = made.rows(
        made.row(made.condition(), i, energy_j=np.nan if i == 9 else 100.0 * i)
        for i in range(10)
    )
    further = [Energy().quantity, STUCK_FRACTION.quantity]
    worlds = {str(episodes["condition"][0]): made.PAPER["world"]}
    summary = made.summary(episodes).drop(
        columns=["stuck_share_mean", "stuck_share_std", "stuck_share_n"]
    )
    own = summarise(episodes, worlds, further)
    summary = summary.join(own[[name for name in own if name not in summary]])
    table = result_table(summary, made.conditions(episodes), further)
    cells = dict(zip(table.headings, table.rows[0], strict=True))
    low, high = own[["energy_low_j", "energy_high_j"]].iloc[0]
    assert cells["energy [J]"] == f"400 ({low:.4g}–{high:.4g}) (n = 9)"
    assert cells["stuck steps [%]"] == "10 (10–10)"
    assert dict(table.explained)["energy [J]"].startswith(
        "energy ∫ P/λ dt that the drive draws"
    )


def test_a_comparison_by_a_metric_is_in_its_unit_over_the_episodes_that_both_have() -> (
    None
):
    labels = [made.condition(risk=risk) for risk in ("cvar", "mean")]
    sides = []
    for side, own in enumerate(labels):
        episodes = made.rows(
            # Neither the last map, without a value, nor the first, where the mean
            # fails, counts.
            made.row(
                own,
                i,
                30.0 if i + side != 1 else None,
                energy_j=np.nan if i == 9 else 100.0 * i + 50 * side,
            )
            for i in range(10)
        )
        sides.append(
            Compared(
                labels=own,
                value={},
                maps=(),
                episodes=episodes.assign(time_budget_s=100.0),
            )
        )
    given = Pair(
        one="cvar",
        other="mean",
        shared={"planner": "mppi"},
        episodes=pd.DataFrame(),
        members=tuple(sides),
    )
    (row,) = compare_by([given], Energy().quantity).to_dict("records")
    assert (row["n_maps"], row["n_episodes"], row["unit"]) == (7, 7, "J")
    assert (row["mean_one"], row["mean_other"], row["difference"]) == (500, 550, -50)
    # All seven differences have one sign: 2 of the 2^7 ways to flip are as far.
    assert row["p"] == row["p_holm"] == pytest.approx(2 / 2**7)
    table = metric_table(
        compare_by([given], Energy().quantity), Energy().quantity, "risk"
    )
    cells = dict(zip(table.headings, table.rows[0], strict=True))
    assert (cells["energy [J]"], cells["Δ [J]"], cells["95 %"], cells["significant"]) == (
        "500 : 550", "-50", "–", "yes",
    )  # fmt: skip
    assert (
        "lower is better. Over the episodes in which both reached the goal."
        in dict(table.explained)["energy [J]"]
    )
