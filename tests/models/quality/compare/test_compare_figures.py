from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.predictor import Oracle
from benchnav.models.quality.compare.figures import comparison_figures, model_looks
from benchnav.models.quality.map_sums import MapTally
from benchnav.models.quality.measure import measure_split
from benchnav.models.quality.scores_of_maps import COMPARED
from benchnav.stats.scores import summarise
from tests.models.stub import ColourModel

MODELS = ("colours", "oracle")
SPLITS = ("train", "test/std")
HEADINGS = {score.name: score.title for score in COMPARED}
Tallies = dict[tuple[str, str], MapTally]


@pytest.fixture(scope="module")
def tallies(dataset: TerrainDataset) -> Tallies:
    found = {
        (split, name): measure_split(model, dataset, split, by_map=True).by_map
        for split in SPLITS
        for name, model in (("colours", ColourModel()), ("oracle", Oracle()))
    }
    return {key: tally for key, tally in found.items() if tally}


def summary_of(tallies: Tallies) -> pd.DataFrame:
    splits = dict.fromkeys(split for split, _ in tallies)
    tables = {
        split: summarise(
            COMPARED,
            {name: own.sums() for (of, name), own in tallies.items() if of == split},
        )
        for split in splits
    }
    return pd.concat(tables, names=["split", "model"]).reset_index()


def draw(name: str, summary: pd.DataFrame | None = None, **data: Any) -> Figure:
    """Draw the figure of a name from what it needs of `Comparison`."""
    given = {
        "summary": summary,
        "models": MODELS,
        "privileged": ["oracle"],
        "splits": SPLITS,
        **data,
    }
    comparison: Any = SimpleNamespace(**given)
    (figure,) = [own for own in comparison_figures(comparison) if own.name == name]
    return figure.draw(comparison)


def panel(figure: Figure, title: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_title() == title)


def test_models_differ_in_look_and_privileged_ones_are_grey() -> None:
    names = [f"m{number}" for number in range(16)]
    looks = model_looks([*names, "oracle", "ideal"], ["oracle", "ideal"])
    assert list(looks) == [*names, "oracle", "ideal"]
    assert (
        len({(look["color"], look["marker"], look["ls"]) for look in looks.values()})
        == 18
    )
    assert looks["oracle"]["color"].startswith("0.")


def test_marks_and_lines_are_the_measures_and_their_intervals(tallies: Tallies) -> None:
    summary = summary_of(tallies)
    figure = draw("measures", summary)
    axes = panel(figure, f"{HEADINGS['crps']} ↓")
    titles = [axes.get_title() for axes in figure.axes]
    assert {
        f"{HEADINGS['accuracy']} ↑",
        f"{HEADINGS['ause']} ↓",
        HEADINGS["width"],
    } < set(titles)
    marks = {line.get_label(): line.get_xdata() for line in axes.lines}
    for split in SPLITS:
        wanted = (
            summary[summary["split"] == split]
            .set_index("model")["crps"]
            .reindex(MODELS)
        )
        np.testing.assert_allclose(np.asarray(marks[split], dtype=float), wanted)
    train = summary[summary["split"] == "train"].set_index("model")
    ends = [segment[:, 0] for segment in axes.collections[0].get_segments()]
    np.testing.assert_allclose(
        ends[0], train.loc["colours", ["crps_low", "crps_high"]].astype(float)
    )
    labels = {
        label.get_text(): label.get_color()
        for label in figure.axes[0].get_yticklabels()
    }
    assert labels == {"colours": "black", "oracle": "0.5"}
    assert panel(figure, HEADINGS["coverage"]).lines[-1].get_xdata()[0] == 0.9  # type: ignore[index]


def test_calibration_is_the_share_under_each_quantile(tallies: Tallies) -> None:
    figure = draw("calibration", tallies=tallies)
    for split in SPLITS:
        lines = {line.get_label(): line for line in panel(figure, split).lines}
        for model in MODELS:
            counts = tallies[split, model].pit
            level, excess = lines[model].get_data()
            assert level[2] == pytest.approx(0.1)  # type: ignore[index]
            assert excess[2] == pytest.approx(counts[:2].sum() / counts.sum() - 0.1)  # type: ignore[index]
            assert excess[-1] == pytest.approx(0)  # type: ignore[index]


def test_sparsification_shows_both_rankings_of_every_split(tallies: Tallies) -> None:
    figure = draw("sparsification", tallies=tallies)
    for split in SPLITS:
        axes = panel(figure, split)
        assert len(axes.lines) == 2 * len(MODELS)
        left_out, by_width, by_error = tallies[split, "colours"].curves()
        for line, values in zip(axes.lines[:2], (by_width, by_error), strict=True):
            np.testing.assert_allclose(line.get_data(), [left_out, values])
        low, high = axes.get_ylim()
        assert low == 0
        assert high > max(float(np.max(line.get_ydata())) for line in axes.lines)  # type: ignore[arg-type]
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == [*MODELS, "largest errors first (best possible order)"]
    assert (
        axes.lines[1].get_linestyle()
        == figure.legends[0].get_lines()[-1].get_linestyle()
        == ":"
    )


def test_severity_has_a_line_a_model_and_leaves_out_what_was_not_measured(
    tallies: Tallies,
) -> None:
    summary = summary_of(
        {key: own for key, own in tallies.items() if key != ("train", "oracle")}
    )
    summary["split"] = summary["split"].replace({"train": "test/hg-050"})
    figure = draw("severity", summary, splits=["test/std", "test/hg-050"])
    for axes, name in zip(figure.axes[:2], ("crps", "pinball"), strict=True):
        lines = {line.get_label(): line.get_data() for line in axes.lines}
        own = summary[summary["model"] == "colours"].set_index("split")[name]
        np.testing.assert_allclose(
            lines["colours"], [[0, 0.5], [own["test/std"], own["test/hg-050"]]]
        )
        assert len(lines["oracle"][0]) == 1
