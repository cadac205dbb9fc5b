"""The study of risk on the cost: its arms, their table and their figure."""

from collections import Counter
from itertools import product
from operator import itemgetter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import PathCollection

from benchnav.eval.stats.pairs import Compared
from studies.cost import arms
from studies.cost.arms import ARMS, arm_of, frontier
from tests.studies.suites import conditions


def test_arms_of_risk_on_the_cost_differ_in_what_they_are_called_for_alone() -> None:
    found = conditions("cost", "levels")
    told = Counter()
    for each in found:
        family, arm, held, level = itemgetter("planner", "arm", "held", "level")(
            arm_of(each.labels)
        )
        options = dict(each.planner.options)
        own = options["mppi"] if each.planner.part == "astar_mppi" else options
        assert (own["samples"], own["cost_to_go"]) == (1024, "expected-time")
        assert own.get("entrapment", False) is held
        if "cost" in arm:
            assert (own["risk_on"], own.get("level", 0), own.get("fields", 64)) == (
                "cost",
                level,
                64,
            )
            assert each.labels["risk"] == "expected-time"
        else:
            assert own.get("risk_on", "map") == "map"
        told[family, arm, held] += 1
    assert told.pop(("MPPI", "", False)) == 1  # the clairvoyant
    assert told == dict.fromkeys(product(("MPPI", "A*+MPPI"), ARMS, (False, True)), 3)


def test_the_frontiers_have_a_line_an_arm_through_its_levels() -> None:
    rows = []
    for place, each in enumerate(conditions("cost", "levels")):
        middle = 0.5 + 0.01 * place
        rows.append({
            **each.labels, "success_rate": middle, "success_low": middle - 0.1, "success_high": middle + 0.1,
            "success_time_mean_s": 60.0 - place,
        })  # fmt: skip
    figure = frontier(pd.DataFrame(rows))
    planners = ["MPPI", "A*+MPPI"]
    titles = [*planners, *(f"{planner}, entrapment" for planner in planners)]
    panels = {panel.get_title(): panel for panel in figure.axes}
    assert list(panels) == titles
    for panel in panels.values():
        assert [line.get_label() for line in panel.lines] == sorted(ARMS)
        marks = [
            found for found in panel.collections if isinstance(found, PathCollection)
        ]
        assert [list(own.get_sizes()) for own in marks] == len(ARMS) * [
            [9.0, 30.25, 49.0]
        ]
    for name, title in (
        ("mppi cost 0.8", "MPPI"),
        ("mppi cost 0.8 held", "MPPI, entrapment"),
    ):
        own = next(row for row in rows if row["planner"] == name)
        line = next(
            line
            for line in panels[title].lines
            if line.get_label() == "CVaR of the cost"
        )
        # The last level, where the curve ends.
        assert (line.get_xdata()[-1], line.get_ydata()[-1]) == (
            own["success_time_mean_s"],
            100 * own["success_rate"],
        )


# Parts by the names of their runs.
PARTS = {"cost-primary": "primary", "cost-frontier": "frontier50", "cost-own": "own50"}


def table_of_arms(
    name: str,
    arrived: dict[tuple[str, str], int],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> dict[tuple[str, str], list[str]]:
    """Return rows of a run where arms arrive on so many of 40 maps, in 30 s, and all
    others on 35, 2 s later.
    """

    def conditions_in(name: str) -> list[Compared]:
        found = []
        for each in conditions("cost", PARTS[name]):
            arm = (each.labels["planner"], each.labels["risk"])
            success = np.arange(40) < arrived.get(arm, 35)
            episodes = pd.DataFrame({
                "seed": 3027, "realisation": 0, "map": range(40), "group": range(40), "success": success,
                "total_time_s": np.where(success, 30.0 + 2 * (arm not in arrived), 90.0), "time_budget_s": 90.0,
            })  # fmt: skip
            maps = tuple(map(str, range(40)))
            found.append(
                Compared(labels=each.labels, value={}, maps=maps, episodes=episodes)
            )
        return found

    summary = [
        {
            **each.labels, "success_rate": each.episodes["success"].mean(), "success_low": 0.2, "success_high": 0.9,
            "total_time_mean_s": each.episodes["total_time_s"].mean(), "planning_ms_median": 1.5,
        }
        for each in conditions_in(name)
    ]  # fmt: skip
    run = folder / name
    run.mkdir()
    pd.DataFrame(summary).to_csv(run / "summary.csv")
    monkeypatch.setattr(arms, "open_run", lambda run: run)
    monkeypatch.setattr(
        arms, "read_conditions", lambda runs: conditions_in(runs[0].name)
    )
    rows = [list(row) for row in arms.arms(run).rows]
    found = {(row[0], row[1]): row[2:] for row in rows}
    assert len(rows) == len(found) == len(summary)
    return found


def test_the_table_of_arms_sets_each_beside_cvar_of_time_with_its_planner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = {("mppi map", "time-cvar:0.5"): 20, ("astar_mppi map", "time-cvar:0.5"): 30}
    found = table_of_arms("cost-primary", base, tmp_path, monkeypatch)
    assert found["mppi map", "time-cvar:0.5"][:3] == ["50.0 (20–90)", "60.0", "1.5"]
    assert all(found[arm][3:] == ["", "", ""] for arm in base)
    # All 5 maps that differ speak for an arm of A*+MPPI: 2 / 2⁵; after 8 smaller p of
    # 15, Holm's factor is 7.
    for planner, points, least, most in (
        ("mppi", "+37.5", 0, 0.01),
        ("astar_mppi", "+12.5", 0.42, 0.46),
    ):
        gain, p, later = found[f"{planner} cost 0.8", "expected-time"][3:]
        assert gain.startswith(points)
        assert least <= float(p) <= most
        assert later.startswith("+2.0")


def test_an_arm_with_its_own_time_to_go_stands_beside_itself_with_the_shared_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = {
        ("mppi map", "cvar:0.8"): 20, ("mppi map", "time-cvar:0.5"): 25, ("astar_mppi map", "cvar:0.8"): 30,
        ("astar_mppi map", "time-cvar:0.5"): 32, ("mppi cost 0.8", "expected-time"): 33,
    }  # fmt: skip
    found = table_of_arms("cost-own", shared, tmp_path, monkeypatch)
    gains = {arm: row[3].split()[0] for arm, row in found.items()}
    assert gains == {
        ("mppi map own", "cvar:0.8"): "+37.5", ("mppi map own", "time-cvar:0.5"): "+25.0",
        ("astar_mppi map own", "cvar:0.8"): "+12.5", ("astar_mppi map own", "time-cvar:0.5"): "+7.5",
        ("mppi cost 0.8 own", "time-cvar:0.5"): "+5.0",
    }  # fmt: skip
