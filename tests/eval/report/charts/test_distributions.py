import numpy as np
import pytest
from matplotlib.axes import Axes

from benchnav.eval.report.charts.distributions import distribution_figure
from tests.eval.report import made


def medians(panel: Axes) -> list[float]:
    return [float(x) for x, _ in places(panel)]


def places(panel: Axes) -> np.ndarray:
    """Median and height of each condition."""
    return np.concatenate([line.get_xydata() for line in panel.lines if line.get_marker() == "|"])


def dots(panel: Axes) -> list[np.ndarray]:
    """Values of each condition, sorted."""
    (group,) = panel.collections
    values, up = np.asarray(group.get_offsets()).T
    return [np.sort(values[np.abs(up - height) < 0.5]) for _, height in places(panel)]


def test_every_episode_is_a_dot_under_its_quantity_and_its_condition() -> None:
    rows = made.rows(
        (
            made.row(made.condition("a"), i, time, traversability=0.1 * i)
            for i, time in enumerate((20.0, 30.0, None))
        ),
        (made.row(made.condition("b"), i, 50.0, traversability=0.9) for i in range(2)),
    )
    figure = distribution_figure(made.summarised(rows), rows)
    times, met = figure.axes
    np.testing.assert_allclose(np.concatenate(dots(times)), [20, 30, 100, 50, 50])
    np.testing.assert_allclose(np.concatenate(dots(met)), [0, 0.1, 0.2, 0.9, 0.9], atol=1e-12)
    assert medians(times) == [30, 50]
    assert medians(met) == pytest.approx([0.1, 0.9])
    quartiles = next(line for line in times.lines if line.get_marker() == "None")
    assert list(quartiles.get_xdata()) == [25, 65]
    # Successes and failures differ in colour.
    colours = {tuple(colour) for colour in times.collections[0].get_facecolors()}
    assert len(colours) == 2
    assert figure.get_figwidth() * 25.4 == pytest.approx(180)


def test_each_scenario_has_a_line_of_panels() -> None:
    rows = made.rows(
        made.row(made.condition(scenario=name), 0, 20.0 + n) for n, name in enumerate(("std", "hg"))
    )
    figure = distribution_figure(made.summarised(rows), rows)
    assert [panel.get_title() for panel in figure.axes] == ["std", "std", "hg", "hg"]
    assert [medians(panel) for panel in figure.axes] == [[20], [0.8], [21], [0.8]]


def test_an_episode_that_met_nothing_is_no_dot() -> None:
    rows = made.rows(made.row(made.condition(), 0, None, traversability=np.nan))
    _, met = distribution_figure(made.summarised(rows), rows).axes
    assert not met.collections
