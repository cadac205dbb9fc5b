"""Chains of regret: which conditions are in one, and that their differences are paired
and add up.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba

from benchnav.eval.figures.regret import _GREY, Regret
from benchnav.eval.report.write import write_report
from benchnav.eval.stats.regret import find_chains, split_regret
from benchnav.viz.style import BLUE, ORANGE
from tests.eval.forged import forge_run
from tests.eval.report import made

CHAIN = [
    ("astar_dwa", "paper-v1"),
    ("optimal", "paper-v1"),
    ("optimal", "ideal"),
    ("optimal", "oracle"),
    ("near_optimal", "clairvoyant"),
]
# Seconds of each condition on each of ten maps; None where it did not arrive.
TIMES: list[list[float | None]] = [
    [40, None, 38, 41, None, 36, 39, 44, 40, 42],
    [36, 33, 34, None, 35, 34, 36, 38, 37, 36],
    [36, 34, 33, 36, 35, 34, 36, 38, 36, 36],
    [33, 32, 31, None, 33, 32, 33, 35, 34, 33],
    [29, 28, 27, 31, 30, 28, 30, 31, 29, 30],
]
# Of a reference that fails on two maps, on the last of which no robot can arrive.
LAST: list[float | None] = [29.0, 28.0, 27.0, 31.0, 30.0, 28.0, 30.0, 31.0, None, None]


def name_of(planner: str, model: str, risk: str = "cvar") -> str:
    return f"{planner}+{model}+{risk}"


def episodes(
    times: list[list[float | None]] = TIMES, risk: str = "cvar"
) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for (planner, model), own in zip(CHAIN, times, strict=True):
        labels = made.condition(
            planner, "–" if model == "clairvoyant" else risk, model=model
        )
        name = name_of(planner, model, labels["risk"])
        rows += [
            made.row(labels, place, time, condition=name)
            for place, time in enumerate(own)
        ]
    return pd.DataFrame(rows)


def conditions(rows: pd.DataFrame) -> dict[str, dict[str, Any]]:
    return made.conditions(rows)


def split(rows: pd.DataFrame) -> pd.DataFrame:
    return split_regret(
        conditions(rows),
        rows,
        dict.fromkeys(rows["condition"].unique(), made.PAPER["world"]),
    )


def test_a_chain_goes_from_the_planner_to_the_reference() -> None:
    known = conditions(episodes())
    ((*chain, last),) = find_chains(known)
    assert chain == [name_of(*pair) for pair in CHAIN[:-1]]
    assert last == name_of("near_optimal", "clairvoyant", "–")


@pytest.mark.parametrize("missing", CHAIN)
def test_without_one_of_its_conditions_there_is_no_chain(
    missing: tuple[str, str],
) -> None:
    rows = episodes()
    rows = rows[(rows["planner"] != missing[0]) | (rows["model"] != missing[1])]
    assert find_chains(conditions(rows)) == []
    assert split(rows).empty


@pytest.mark.parametrize("model", ["ideal", "oracle", "clairvoyant"])
def test_another_planner_with_a_privileged_model_neither_begins_a_chain_nor_stands_in_one(
    model: str,
) -> None:
    rows = episodes()
    labels = made.condition("astar_dwa", "cvar", model=model)
    added = [
        made.row(labels, place, 30.0, condition=name_of("astar_dwa", model))
        for place in range(10)
    ]
    more = pd.concat([rows, pd.DataFrame(added)])
    assert find_chains(conditions(more)) == find_chains(conditions(rows))
    fewer = more[more["planner"].eq("astar_dwa") | more["model"].ne(model)]
    assert find_chains(conditions(fewer)) == []


def test_where_entry_counts_as_loss_it_is_no_reference() -> None:
    known = conditions(episodes())
    reference = name_of("near_optimal", "clairvoyant", "–")
    cheaper = {"planner": {"part": "near_optimal", "options": {"levels": 0}}}
    cheap = {**known[reference], "value": {**known[reference]["value"], **cheaper}}
    ((*_, last),) = find_chains({"cheap": cheap, **known})
    assert last == reference
    assert find_chains({**known, reference: cheap}) == []


def test_each_of_two_references_ends_a_chain() -> None:
    known = conditions(episodes())
    reference = name_of("near_optimal", "clairvoyant", "–")
    finer = {"planner": {"part": "near_optimal", "options": {"refine": 2}}}
    fine = {**known[reference], "value": {**known[reference]["value"], **finer}}
    one, other = find_chains({**known, "fine": fine})
    assert one[:-1] == other[:-1]
    assert (one[-1], other[-1]) == (reference, "fine")


def test_risk_settings_have_chains_of_their_own_and_share_the_reference() -> None:
    rows = pd.concat([episodes(), episodes(risk="mean")]).drop_duplicates(
        ["condition", "map"]
    )
    chains = find_chains(conditions(rows))
    assert len(chains) == 2
    for risk, chain in zip(("cvar", "mean"), chains, strict=True):
        assert chain[:-1] == [name_of(*pair, risk) for pair in CHAIN[:-1]]
    assert len({chain[-1] for chain in chains}) == 1


@pytest.mark.parametrize(
    ("key", "other"),
    [
        ("belief", {"part": "copula", "options": {}}),
        ("sensor", {"part": "near", "options": {}}),
        ("world", {"noise": "frozen", "time_budget_s": 100.0}),
        ("split", "test/hg"),
    ],
)
def test_what_else_differs_breaks_a_chain(key: str, other: Any) -> None:
    known = conditions(episodes())
    first = name_of("astar_dwa", "paper-v1")
    known[first]["value"] = {**known[first]["value"], key: other}
    assert find_chains(known) == []


def test_a_blind_planner_begins_no_chain() -> None:
    known = conditions(episodes())
    known[name_of("astar_dwa", "paper-v1")]["labels"]["model"] = "–"
    assert find_chains(known) == []


def test_differences_are_paired_and_add_up_to_the_whole() -> None:
    table = split(episodes())
    time = np.array([[100.0 if one is None else one for one in own] for own in TIMES])
    arrived = np.array([[one is not None for one in own] for own in TIMES])
    for place, row in enumerate(table.to_dict("records")):
        assert row["time_difference"] == pytest.approx(
            time[place].mean() - time[place + 1].mean()
        )
        assert row["success_difference"] == pytest.approx(
            arrived[place].mean() - arrived[place + 1].mean()
        )
        assert row["time_one"] == pytest.approx(time[place].mean())
        assert row["success_other"] == pytest.approx(arrived[place + 1].mean())
        assert row["time_low"] < row["time_difference"] < row["time_high"]
        assert row["success_low"] <= row["success_difference"] <= row["success_high"]
    assert table["time_difference"].sum() == pytest.approx(
        time[0].mean() - time[-1].mean()
    )
    # Against all that vary by map, what is paired is known well.
    last = table.iloc[2]
    assert last["other_model"] == "oracle"
    assert table[["n_maps", "n_episodes"]].eq(10).all(axis=None)


def test_episodes_that_one_condition_lacks_are_left_out_of_all() -> None:
    rows = episodes()
    fewer = rows[(rows["planner"] != "near_optimal") | (rows["map"] > 0)]
    wanted = episodes([own[1:] for own in TIMES])
    columns = [
        "time_difference",
        "time_low",
        "time_high",
        "success_difference",
        "n_maps",
    ]
    pd.testing.assert_frame_equal(split(fewer)[columns], split(wanted)[columns])


def texts_of(table: pd.DataFrame) -> list[str]:
    figure = Regret().draw(made.run_data(regret=table))
    return [
        text.get_text()
        for panel in figure.axes
        for text in (*panel.texts, *panel.get_yticklabels())
    ]


def test_the_waterfall_says_each_step_with_sign_and_interval() -> None:
    table = split(episodes())
    texts = texts_of(table)
    first = table.iloc[0]
    assert "A*+DWA, paper-v1" in texts
    assert "A*+DWA → optimal" in texts
    assert "paper-v1 → ideal" in texts
    assert "optimal → near-optimal\noracle → clairvoyant" in texts
    seconds = f"−{first['time_difference']:.1f} ({-first['time_high']:+.1f} to {-first['time_low']:+.1f})"
    assert seconds.replace("-", "−") in texts
    points = f"+{-100 * first['success_difference']:.1f} ("
    assert any(text.startswith(points) for text in texts)


def test_bars_are_orange_where_the_next_is_better_and_lines_are_their_intervals() -> (
    None
):
    """Less time is better, and more success."""
    table = split(episodes())
    figure = Regret().draw(made.run_data(regret=table))
    for panel, (measure, factor) in zip(
        figure.axes, (("success", 100.0), ("time", 1.0)), strict=False
    ):
        bars = [
            bar
            for bar in panel.patches
            if bar.get_facecolor()[:3] != to_rgba(_GREY)[:3]
        ]
        lines = [line for line in panel.lines if line.get_color() == "black"]
        assert len(bars) == len(lines) == 4
        for row, bar, line in zip(table.to_dict("records"), bars, lines, strict=True):
            one, gain = (
                factor * row[f"{measure}_one"],
                -factor * row[f"{measure}_difference"],
            )
            low, high = (factor * row[f"{measure}_{end}"] for end in ("low", "high"))
            assert (bar.get_x(), bar.get_width()) == pytest.approx((one, gain))
            # Of success no further than all or none.
            ends = np.clip(
                [one - high, one - low], 0, 100 if measure == "success" else None
            )
            assert line.get_xdata() == pytest.approx(ends)
            better = gain > 0 if measure == "success" else gain < 0
            colour = ORANGE if better else BLUE
            assert gain == 0 or bar.get_facecolor() == pytest.approx(to_rgba(colour))


@pytest.mark.usefixtures("whole_fonts")
def test_the_report_of_a_run_with_a_chain_has_it(tmp_path: Path) -> None:
    rows = bounded_episodes()
    parts = {kind: {"part": kind, "options": {}} for kind in ("robot", "objective")}
    known = {
        name: about
        | {
            "value": {
                "data": "paper-v1",
                "split": "test/std",
                **parts,
                **about["value"],
            },
            "draws": [[0, 0, 10]],
        }
        for name, about in conditions(rows).items()
    }
    history = [{"command": "benchnav-eval run", "commit": "abc", "benchnav": "0.8"}]
    folder = forge_run(tmp_path / "run", rows, known, history=history)
    report = write_report(folder)
    pd.testing.assert_frame_equal(report.regret, split(rows))
    assert (folder / "figures/regret.png").is_file()
    assert len(pd.read_csv(folder / "regret.csv")) == 4
    page = (folder / "report.html").read_text()
    assert "another order of steps would give other values" in page
    said = (folder / "summary.md").read_text()
    # 40 s and the limit of 100 s on the last two maps, and the limit on both.
    assert f"T_total {0.09 * 234 + 14:.1f} to {0.1 * 234 + 20:.1f} s" in said
    assert "success 80.0 to 90.0 %" in said
    one = rows[rows["planner"] == "astar_dwa"]
    folder = forge_run(
        tmp_path / "alone",
        one,
        {name: known[name] for name in set(one["condition"])},
        history=history,
    )
    write_report(folder)
    assert not (folder / "regret.csv").exists()


def bounded_episodes() -> pd.DataFrame:
    """Episodes whose reference's rows have lower bounds of the time."""
    rows = episodes([*TIMES[:-1], LAST])
    least = [*(0.9 * time for time in LAST if time is not None), 40.0, np.inf]
    rows.loc[rows["planner"] == "near_optimal", "lower_bound_s"] = least
    return rows


def test_the_lower_bound_stands_beside_the_reference_where_its_rows_have_one() -> None:
    rows = episodes()
    assert split(rows)[["time_bound", "success_bound"]].isna().all(axis=None)
    table = split(bounded_episodes())
    limit_s = made.PAPER["world"]["time_budget_s"]
    assert table["success_bound"].eq(0.9).all()
    assert table["time_bound"].to_numpy() == pytest.approx(
        0.1 * (0.9 * 234 + 40 + limit_s)
    )
    drawn = [
        line
        for panel in Regret().draw(made.run_data(regret=table)).axes
        for line in panel.get_lines()
        if line.get_linestyle() == "--"
    ]
    assert [line.get_xdata()[0] for line in drawn] == pytest.approx(
        [90.0, table["time_bound"][0]]
    )
