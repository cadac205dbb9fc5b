import itertools
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from benchnav.eval.figures.distributions import Distributions
from benchnav.eval.figures.outcomes import LOOKS, SUCCESS_COLOUR, Outcomes
from benchnav.eval.figures.success import Success
from benchnav.planning.world.outcome import FAILURES
from tests.eval.report import made


def draw_success(summary: pd.DataFrame) -> Figure:
    return Success().draw(made.run_data(summary))


def draw_outcomes(summary: pd.DataFrame) -> Figure:
    return Outcomes().draw(made.run_data(summary))


def draw_distributions(rows: pd.DataFrame) -> Figure:
    return Distributions().draw(made.run_data(made.summarised(rows), episodes=rows))


BLIND = {"planner": "straight", "risk": "–", "model": "–"}


def shares(labels: dict[str, str], successes: int) -> list[dict]:  # type: ignore[type-arg]
    return [made.row(labels, i, 30.0 if i < successes else None) for i in range(10)]


def panels(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.get_visible()]


def points(panel: Axes) -> dict[str, float]:
    """Rates by the name of their row."""
    names = {
        place: label.get_text()
        for place, label in zip(
            panel.get_yticks(), panel.get_yticklabels(), strict=True
        )
    }
    marked = [line for line in panel.lines if line.get_marker() == "o"]
    return {
        names[float(line.get_ydata()[0])]: float(line.get_xdata()[0]) for line in marked
    }


def test_each_rate_stands_at_its_name_with_its_interval() -> None:
    summary = made.summarised(
        made.rows(
            shares(made.condition(**BLIND), 2), shares(made.condition("astar_dwa", "mean"), 9),
            shares(made.condition(), 7), shares(made.condition("astar_dwa"), 8),
        )
    )  # fmt: skip
    (panel,) = panels(draw_success(summary))
    expected = {
        "straight": 20,
        "A*+DWA, mean": 90,
        "A*+DWA, CVaR": 80,
        "MPPI, CVaR": 70,
    }
    assert points(panel) == pytest.approx(expected)
    ends = {
        tuple(np.round(line.get_xdata(), 6))
        for line in panel.lines
        if line.get_marker() == "None"
    }
    for low, high in summary[["success_low", "success_high"]].to_numpy():
        assert (round(100 * low, 6), round(100 * high, 6)) in ends


def test_the_blind_baseline_is_a_line_through_its_own_panel() -> None:
    summary = made.summarised(
        made.rows(
            *(
                shares(made.condition(**BLIND, scenario=name), count)
                for name, count in (("std", 4), ("hg", 1))
            ),
            *(shares(made.condition(scenario=name), 10) for name in ("std", "hg")),
        )
    )
    drawn = {panel.get_title(): panel for panel in panels(draw_success(summary))}
    for scenario, rate in (("std", 40), ("hg", 10)):
        (line,) = [
            line for line in drawn[scenario].lines if line.get_linestyle() == "--"
        ]
        assert list(line.get_xdata()) == [rate, rate]


@pytest.mark.parametrize(
    ("planners", "risks", "scenarios"), [(1, 1, 1), (4, 20, 2), (12, 4, 3), (2, 2, 9)]
)
def test_any_number_of_planners_risks_and_scenarios_fit(
    planners: int, risks: int, scenarios: int, tmp_path
) -> None:  # type: ignore[no-untyped-def]
    summary = made.summarised(
        made.rows(
            made.row(made.condition(f"planner_{p}", f"cvar:{r}", scenario=f"scenario-{s}"))
            for p in range(planners) for r in range(risks) for s in range(scenarios)
        )
    )  # fmt: skip
    figure = draw_success(summary)
    assert len(panels(figure)) == scenarios
    for panel in panels(figure):
        assert len(points(figure.axes[0])) == planners * risks
        assert panel.get_title()
    figure.draw_without_rendering()
    heights = [label.get_window_extent() for label in figure.axes[0].get_yticklabels()]
    assert all(not above.overlaps(below) for above, below in pairwise(heights))
    assert all(panel.get_window_extent().width > 100 for panel in panels(figure))
    width, height = figure.get_size_inches()
    assert width < 13
    assert height < 25


def test_models_and_worlds_are_distinguished() -> None:
    several = [
        made.condition(model=model, world=world)
        for model in ("a", "b")
        for world in ("paper", "stakes")
    ]
    figure = draw_success(
        made.summarised(
            made.rows(*(shares(labels, n) for n, labels in enumerate(several)))
        )
    )
    assert [panel.get_title() for panel in panels(figure)] == [
        "std, paper",
        "std, stakes",
    ]
    first, second = panels(figure)
    assert points(first) == {"MPPI, a, CVaR": 0, "MPPI, b, CVaR": 20}
    expected = {"MPPI, a, CVaR": 10, "MPPI, b, CVaR": 30}
    assert dict(zip(points(first), points_by_height(second), strict=True)) == expected


def test_one_that_is_told_λ_itself_is_named_by_its_model_and_is_not_drawn_as_blind() -> (
    None
):
    told = made.condition("astar_dwa", "–", model="clairvoyant")
    for others in ((), (made.condition("astar_dwa", model="oracle"),)):
        labels = [made.condition(**BLIND), told, *others]
        (panel,) = panels(
            draw_success(
                made.summarised(made.rows(*(shares(one, 5) for one in labels)))
            )
        )
        named = [label.get_text() for label in panel.get_yticklabels()]
        assert (
            named
            == ["straight", "A*+DWA, clairvoyant", "A*+DWA, oracle, CVaR"][
                : len(labels)
            ]
        )
        marked = [line for line in panel.lines if line.get_marker() == "o"]
        grey = [len(set(to_rgb(line.get_color()))) == 1 for line in marked]
        assert grey == [True, False, False][: len(labels)]
        assert len([line for line in panel.lines if line.get_linestyle() == "--"]) == 1


def test_a_setting_that_a_block_lacks_is_said_not_to_have_run() -> None:
    labels = [
        made.condition(),
        made.condition(risk="mean"),
        made.condition(risk="mean", scenario="hs"),
    ]
    summary = made.summarised(made.rows(*(shares(one, 5) for one in labels)))
    for figure in (draw_success(summary), draw_outcomes(summary)):
        names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
        heights = dict(zip(names, figure.axes[0].get_yticks(), strict=True))
        said = {
            panel.get_title(): [
                (text.get_text(), text.get_position()[1]) for text in panel.texts
            ]
            for panel in panels(figure)
        }
        assert said == {"std": [], "hs": [("not run", heights["MPPI, CVaR"])]}


def points_by_height(panel: Axes) -> list[float]:
    marked = [line for line in panel.lines if line.get_marker() == "o"]
    return [
        float(line.get_xdata()[0])
        for line in sorted(marked, key=lambda line: line.get_ydata()[0])
    ]


def test_points_are_filled_where_they_are_marked() -> None:
    summary = made.summarised(
        made.rows(
            shares(made.condition(risk="a"), 9), shares(made.condition(risk="b"), 2)
        )
    )
    first = summary["condition"] == summary["condition"][0]
    (panel,) = panels(draw_success(summary.assign(best_marked=first)))
    marked = [line for line in panel.lines if line.get_marker() == "o"]
    assert [to_rgb(line.get_markerfacecolor()) == (1, 1, 1) for line in marked] == [
        False,
        True,
    ]


def test_figures_have_the_width_of_a_column_or_a_page() -> None:
    one = made.summarised(made.rows(shares(made.condition(), 5)))
    assert draw_success(one).get_figwidth() * 25.4 == pytest.approx(88)
    two = made.summarised(
        made.rows(*(shares(made.condition(scenario=name), 5) for name in ("std", "hg")))
    )
    assert draw_success(two).get_figwidth() * 25.4 == pytest.approx(180)


def bars(panel: Axes) -> dict[float, list[tuple[str, float]]]:
    """By height what is stacked, from left to right: colour and share."""
    found: dict[float, list[tuple[str, float]]] = {}
    for bar in sorted(panel.patches, key=lambda bar: bar.get_x()):  # type: ignore[attr-defined]
        height = round(bar.get_y() + bar.get_height() / 2, 6)  # type: ignore[attr-defined]
        if bar.get_width():  # type: ignore[attr-defined]
            found.setdefault(height, []).append(
                (to_hex(bar.get_facecolor()).upper(), bar.get_width())
            )  # type: ignore[attr-defined]
    return found


def test_every_failure_has_a_colour_of_its_own() -> None:
    assert set(LOOKS) == {outcome.name.lower() for outcome in FAILURES}
    assert (
        len({*(colour for colour, _ in LOOKS.values()), SUCCESS_COLOUR})
        == len(LOOKS) + 1
    )


def test_outcomes_differ_in_grey_by_lightness_or_hatching() -> None:
    looks = [(name, *look) for name, look in LOOKS.items()]
    for (_, one, hatch), (_, other, beside) in itertools.combinations(
        [*looks, ("success", SUCCESS_COLOUR, "")], 2
    ):
        light, dark = (
            np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722)) for colour in (one, other)
        )
        assert hatch != beside or abs(light - dark) > 0.25


def test_shares_stand_in_one_order_and_fill_the_bar() -> None:
    first, second = made.condition("a"), made.condition("b")
    ends = ["timeout", "immobilised", "immobilised", "timeout", "stuck"]
    rows = made.rows(
        (made.row(first, i, None, outcome=name) for i, name in enumerate(ends)),
        (made.row(first, i) for i in range(5, 10)),
        (made.row(second, i, None, outcome="stuck") for i in range(1)),
        (made.row(second, i) for i in range(1, 4)),
    )
    figure = draw_outcomes(made.summarised(rows))
    above, below = (drawn for _, drawn in sorted(bars(figure.axes[0]).items()))
    expected = [("immobilised", 20), ("stuck", 10), ("timeout", 20)]
    assert above == [
        *((LOOKS[name][0], pytest.approx(share)) for name, share in expected),
        (SUCCESS_COLOUR, 50),
    ]
    assert below == [(LOOKS["stuck"][0], 25), (SUCCESS_COLOUR, 75)]
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["immobilised", "stuck", "timeout", "success"]


def medians(panel: Axes) -> list[float]:
    return [float(x) for x, _ in places(panel)]


def places(panel: Axes) -> np.ndarray:
    """Median and height of each condition."""
    return np.concatenate(
        [line.get_xydata() for line in panel.lines if line.get_marker() == "|"]
    )


def dots(panel: Axes) -> list[np.ndarray]:
    """Values of each condition, sorted."""
    values, up = np.concatenate(
        [np.asarray(group.get_offsets()) for group in panel.collections]
    ).T
    return [np.sort(values[np.abs(up - height) < 0.5]) for _, height in places(panel)]


def test_every_episode_is_a_dot_under_its_quantity_and_its_condition() -> None:
    rows = made.rows(
        (
            made.row(made.condition("a"), i, time, traversability=0.1 * i)
            for i, time in enumerate((20.0, 30.0, None))
        ),
        (made.row(made.condition("b"), i, 50.0, traversability=0.9) for i in range(2)),
    )
    figure = draw_distributions(rows)
    times, met = figure.axes
    np.testing.assert_allclose(np.concatenate(dots(times)), [20, 30, 100, 50, 50])
    np.testing.assert_allclose(
        np.concatenate(dots(met)), [0, 0.1, 0.2, 0.9, 0.9], atol=1e-12
    )
    assert medians(times) == [30, 50]
    assert medians(met) == pytest.approx([0.1, 0.9])
    quartiles = next(line for line in times.lines if line.get_marker() == "None")
    assert list(quartiles.get_xdata()) == [25, 65]
    # Successes and failures differ in colour, and in shape.
    arrived, failed = times.collections
    assert np.sort(np.asarray(arrived.get_offsets())[:, 0]).tolist() == [20, 30, 50, 50]
    assert np.asarray(failed.get_offsets())[:, 0].tolist() == [100]
    assert not np.allclose(arrived.get_facecolor(), failed.get_edgecolor())
    assert len(arrived.get_paths()[0]) != len(failed.get_paths()[0])
    assert figure.get_figwidth() * 25.4 == pytest.approx(180)
