import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex

from benchnav.eval.report.charts.outcomes import COLOURS, SUCCESS_COLOUR, outcome_figure
from benchnav.planning.world.outcome import FAILURES
from tests.eval.report import made


def bars(panel: Axes) -> dict[float, list[tuple[str, float]]]:
    """By height what is stacked, from left to right: colour and share."""
    found: dict[float, list[tuple[str, float]]] = {}
    for bar in sorted(panel.patches, key=lambda bar: bar.get_x()):  # type: ignore[attr-defined]
        height = round(bar.get_y() + bar.get_height() / 2, 6)  # type: ignore[attr-defined]
        if bar.get_width():  # type: ignore[attr-defined]
            found.setdefault(height, []).append((to_hex(bar.get_facecolor()).upper(), bar.get_width()))  # type: ignore[attr-defined]
    return found


def test_every_failure_has_a_colour_of_its_own() -> None:
    assert set(COLOURS) == {outcome.name.lower() for outcome in FAILURES}
    assert len({*COLOURS.values(), SUCCESS_COLOUR}) == len(COLOURS) + 1


def test_shares_stand_in_one_order_and_fill_the_bar() -> None:
    first, second = made.condition("a"), made.condition("b")
    ends = ["timeout", "immobilised", "immobilised", "timeout", "stuck"]
    rows = made.rows(
        (made.row(first, i, None, outcome=name) for i, name in enumerate(ends)),
        (made.row(first, i) for i in range(5, 10)),
        (made.row(second, i, None, outcome="stuck") for i in range(1)),
        (made.row(second, i) for i in range(1, 4)),
    )
    figure = outcome_figure(made.summarised(rows))
    above, below = (drawn for _, drawn in sorted(bars(figure.axes[0]).items()))
    expected = [("immobilised", 20), ("stuck", 10), ("timeout", 20)]
    assert above == [
        *((COLOURS[name], pytest.approx(share)) for name, share in expected),
        (SUCCESS_COLOUR, 50),
    ]
    assert below == [(COLOURS["stuck"], 25), (SUCCESS_COLOUR, 75)]
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["immobilised", "stuck", "timeout", "success"]


def test_each_scenario_has_its_panel() -> None:
    rows = made.rows(made.row(made.condition(scenario=name)) for name in ("std", "hg"))
    figure = outcome_figure(made.summarised(rows))
    assert [panel.get_title() for panel in figure.axes] == ["std", "hg"]
    assert figure.get_figwidth() * 25.4 == pytest.approx(180)
