from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.eval.figures.between_worlds import WorldAgreement
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.shipped import is_shipped
from benchnav.eval.figures.waterfall import Waterfall
from benchnav.eval.stats.between import compare_worlds
from benchnav.stats.intervals import success_interval
from tests.eval.report import made
from tests.eval.stats.test_between_worlds import (
    DRAWS,
    MAPS,
    RISKS,
    WORLDS,
    by_map,
    condition_id,
    entries,
    episodes,
)

RATES = np.array([[0.86, 0.8, 0.9, 0.3], [0.5, 0.6, 0.9, 0.2], [0.8, 0.6, 0.7, 0.1]])
CHOSEN = {"one": {"risk": "cvar:0.8"}, "other": {"risk": "mean"}}


def run_data(worlds: tuple[str, ...] = WORLDS, **labels: str) -> RunData:
    conditions = []
    for w, world in enumerate(worlds):
        for r, risk in enumerate(RISKS):
            shown = made.condition("mppi", risk, world=world, **labels)
            conditions.append(episodes(shown, RATES[w, r], seed=r))
    rows = made.rows(*conditions)
    about = {"conditions": entries(rows)}
    test: dict[str, Any] = {"metric": "success", "kind": "difference", "direction": ""}
    test |= {"margin": 0.0, "names": ["a", "b"], "claim": "c"}
    test["one"] = condition_id(worlds[0], "cvar:0.8")
    test["other"] = condition_id(worlds[0], "mean")
    of_time = test | {"metric": "T_total", "one": condition_id(worlds[0], "low")}
    between = compare_worlds(about["conditions"], rows, {"tests": [test, of_time]})
    return made.run_data(about=about, episodes=rows, between=between)


@pytest.fixture(scope="module")
def data() -> RunData:
    return run_data()


def points(panel: Axes) -> set[tuple[float, float]]:
    marked = [line for line in panel.lines if line.get_marker() not in ("", "None")]
    return {(line.get_xdata()[0], line.get_ydata()[0]) for line in marked}


def test_a_point_is_success_in_both_worlds(data: RunData) -> None:
    figure = WorldAgreement().draw(data)
    assert len(figure.axes) == 3
    for panel, (x, y) in zip(figure.axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        rates = [100 * by_map(data.episodes, WORLDS[w]).mean(0) / DRAWS for w in (x, y)]
        expected = set(zip(*np.round(rates, 9), strict=True))
        shown = {(round(a, 9), round(b, 9)) for a, b in points(panel)}
        assert shown == expected
        agreement = data.between.agreement
        (row,) = agreement[
            (agreement["world"] == WORLDS[x]) & (agreement["other"] == WORLDS[y])
        ].to_dict("records")
        assert panel.get_title() == (
            f"r {row['pearson']:.2f}, MMRV {100 * row['mmrv']:.1f}"
        )
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["mean", "CVaR₀.₈", "CVaR₀.₉₅", "low"]


def test_filled_points_are_the_robust_set(data: RunData) -> None:
    (panel, *_) = WorldAgreement().draw(data).axes
    settings = data.between.settings
    first = settings[settings["world"] == WORLDS[0]]
    assert 0 < first["robust"].sum() < first["in_best"].sum() < 4
    faces = {}
    for line in panel.lines:
        if line.get_marker() not in ("", "None"):
            faces[round(line.get_xdata()[0], 9)] = line.get_markerfacecolor() != "white"
    for row in first.to_dict("records"):
        assert faces[round(100 * row["success_rate"], 9)] == row["robust"]


def test_figures_of_worlds_need_several_worlds(data: RunData) -> None:
    one = made.run_data(about=data.about, episodes=data.episodes)
    for figure in (WorldAgreement(), Waterfall(), Waterfall(**CHOSEN)):
        assert not figure.is_available(one)
        assert figure.is_available(data)
    two = run_data(WORLDS[:2])
    assert WorldAgreement().is_available(two)
    assert Waterfall(**CHOSEN).is_available(two)
    assert not Waterfall().is_available(two)  # two worlds are too few


def test_bars_are_differences_and_changes(data: RunData) -> None:
    (panel,) = Waterfall().draw(data).axes
    gains = np.stack([by_map(data.episodes, w)[:, 1] for w in WORLDS])
    gains -= np.stack([by_map(data.episodes, w)[:, 0] for w in WORLDS])
    differences = 100 * gains.sum(1) / (MAPS * DRAWS)
    bars = {round(bar.get_y() + bar.get_height() / 2): bar for bar in panel.patches}
    widths = [bars[height].get_width() for height in range(4)]
    changes = np.diff(differences)
    assert widths == pytest.approx([differences[0], *changes, differences[-1]])
    starts = [bars[height].get_x() for height in (1, 2)]
    assert starts == pytest.approx(differences[:2])
    intervals = [success_interval(gains[0], DRAWS)]
    intervals += [success_interval(gains[w] - gains[w - 1], DRAWS) for w in (1, 2)]
    intervals.append(success_interval(gains[2], DRAWS))
    texts = [text.get_text().replace("−", "-") for text in panel.texts]
    for text, (mean, low, high) in zip(
        sorted_texts(panel, texts), intervals, strict=True
    ):
        assert text == f"{100 * mean:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
    names = [label.get_text() for label in panel.get_yticklabels()]
    assert names == [WORLDS[0], f"→ {WORLDS[1]}", "→ paper", "paper"]
    assert panel.get_title() == "CVaR₀.₈ − mean"


def sorted_texts(panel: Axes, texts: list[str]) -> list[str]:
    heights = [text.get_position()[1] for text in panel.texts]
    return [texts[index] for index in np.argsort(heights)]


def test_the_contrast_and_the_worlds_are_chosen(data: RunData) -> None:
    chosen = Waterfall(
        {"risk": "low"}, {"risk": "mean"}, worlds=WORLDS[::-2], name="low"
    )
    (panel,) = chosen.draw(data).axes
    assert panel.get_title() == "low − mean"
    names = [label.get_text() for label in panel.get_yticklabels()]
    assert names == ["paper", "→ stakes", "stakes"]
    assert not Waterfall(**CHOSEN, worlds=("stakes", "elsewhere")).is_available(data)
    with pytest.raises(ConfigError, match="both `one` and `other`"):
        Waterfall({"risk": "low"})
    with pytest.raises(ConfigError, match=r"labels among .* got 'risks'"):
        Waterfall({"risks": "low"}, {"risk": "mean"})


def test_a_waterfall_with_arguments_is_no_shipped_figure() -> None:
    assert is_shipped(Waterfall())
    assert not is_shipped(Waterfall(**CHOSEN))
    spec = {"part": "benchnav.eval.figures.waterfall:Waterfall", "options": CHOSEN}
    figure = registry.take("figure", spec)
    assert isinstance(figure, Waterfall)
    assert (figure.one, figure.other) == (CHOSEN["one"], CHOSEN["other"])
