import numpy as np
import pytest

from benchnav.eval.report.rendering import to_markdown
from benchnav.eval.report.tables import failures_in_words, result_table
from benchnav.eval.stats.summary import summarise
from tests.eval.report import made

BLIND = {"planner": "straight", "risk": "–", "model": "–"}


def table_of(episodes, **notes):  # type: ignore[no-untyped-def]
    return result_table(summarise(episodes), made.trials(episodes, **notes))


def test_golden_table() -> None:
    quick = [made.row(made.trial("mppi"), i, time, traversability=0.7) for i, time in enumerate((20.0, 30.0))]
    slow = [
        made.row(made.trial("cl_rrt", "mean"), 0, 40.0, traversability=0.9),
        made.row(made.trial("cl_rrt", "mean"), 1, None, outcome="stuck", traversability=0.5),
    ]
    blind = [
        made.row(made.trial(**BLIND), 0, None, outcome="out_of_bounds"),
        made.row(made.trial(**BLIND), 1, None, outcome="planner_failure", traversability=np.nan),
    ]
    notes = {"cl_rrt": {"follows": "its own time", "remarks": ["limits 0.5 m/s²"]}}
    assert to_markdown(table_of(made.rows(quick, slow, blind), **notes)) == (
        "| scenario | planner | risk | Succ. [%] | 95 % interval | T_total [s] | T if success [s] | λ̄ [%] "
        "| failures |\n"
        "|---|---|---|---|---|---|---|---|---|\n"
        "| std | mppi | cvar | 100 | 34–100 | 25.0 ± 7.1 | 25.0 ± 7.1 | 70.0 ± 0.0 | – |\n"
        "| std | cl_rrt¹,² | mean | 50 | 9–91 | 70.0 ± 42.4 | 40.0 | 70.0 ± 28.3 | 1 stuck |\n"
        "| std | straight | – | 0 | 0–66 | 100.0 ± 0.0 | – | 80.0 (n = 1) | 1 out of bounds, 1 planner failure |\n"
        "\n¹ objective: its own time\n"
        "\n² limits 0.5 m/s²\n"
    )


def test_labels_that_differ_are_shown_and_others_are_not() -> None:
    def headings(*labels: dict[str, str]) -> tuple[str, ...]:
        table = table_of(made.rows(made.row(one) for one in labels))
        assert {len(row) for row in table.rows} == {len(table.headings)}
        return table.headings[: table.labels]

    one = made.trial()
    assert headings(one) == ("scenario", "planner", "risk")
    assert headings(one, made.trial(**BLIND)) == ("scenario", "planner", "risk")
    for name in ("data", "world", "robot", "objective", "model"):
        assert name in headings(one, made.trial(**{name: "another"}))
    several = headings(one, made.trial(model="mdn"), made.trial(**BLIND), made.trial(world="stakes"))
    assert several == ("scenario", "world", "model", "planner", "risk")


def test_a_blind_planner_has_neither_risk_nor_model() -> None:
    table = table_of(made.rows(made.row(made.trial(model=m)) for m in ("a", "b")))
    blind = table_of(
        made.rows(made.row(labels) for labels in (made.trial(**BLIND), made.trial(), made.trial(model="b")))
    )
    assert [row[1] for row in table.rows] == ["a", "b"]
    assert blind.rows[0][:4] == ("std", "–", "straight", "–")


def test_numbers_of_maps_and_episodes_are_shown_where_they_are_not_the_same() -> None:
    few, many = made.trial("mppi"), made.trial("cl_rrt")
    episodes = [made.row(few, i) for i in range(2)]
    same = table_of(made.rows(episodes, (made.row(many, i) for i in range(2))))
    assert "maps" not in same.headings
    assert "episodes" not in same.headings
    more = (made.row(many, i, seed=seed) for i in range(3) for seed in range(4))
    more_maps = table_of(made.rows(episodes, more))
    assert more_maps.headings[3:5] == ("maps", "episodes")
    assert [row[3:5] for row in more_maps.rows] == [("2", "2"), ("3", "12")]
    more_seeds = table_of(
        made.rows(episodes, (made.row(many, i, seed=s) for i in range(2) for s in range(2)))
    )
    assert more_seeds.headings[3:5] == ("episodes", "Succ. [%]")
    assert [row[3] for row in more_seeds.rows] == ["2", "4"]


def test_notes_are_numbered_once_and_marked_at_every_trial_they_hold_for() -> None:
    episodes = made.rows(
        made.row(made.trial(planner, risk)) for planner in ("mppi", "a", "b") for risk in ("mean", "cvar")
    )
    shared = {"follows": "path length", "remarks": []}
    table = table_of(episodes, a=shared, b=shared | {"remarks": ["slow"]})
    assert [row[1] for row in table.rows] == ["mppi", "mppi", "a¹", "a¹", "b¹,²", "b¹,²"]
    assert table.notes == ("¹ objective: path length", "² slow")


@pytest.mark.parametrize("follows", ["", "J"])
def test_a_planner_that_follows_the_users_objective_alone_needs_no_note(follows: str) -> None:
    table = table_of(made.rows(made.row(made.trial())), mppi={"follows": follows})
    assert table.rows[0][1] == "mppi"
    assert table.notes == ()


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ([], "–"),
        (["stuck", "stalled", "stuck"], "2 stuck, 1 stalled"),
        (["model_error", "planner_error", "timeout"], "1 timeout, 1 planner error, 1 model error"),
    ],
)
def test_failures_in_words(outcomes: list[str], expected: str) -> None:
    labels = made.trial()
    failed = (made.row(labels, i, None, outcome=outcome) for i, outcome in enumerate(outcomes))
    summary = summarise(made.rows(made.row(labels, 99), failed))
    assert failures_in_words(summary.to_dict("records")[0]) == expected
