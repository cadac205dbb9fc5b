from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch
from scipy.stats import binom

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import SoftSpots
from benchnav.datagen.recipe.latent import expected_traversability
from benchnav.datagen.recipe.load import load_recipe
from benchnav.models.predictor import Oracle
from benchnav.models.quality.figures import Severity
from benchnav.models.quality.figures_of_classes import Confusion, Reliability
from benchnav.models.quality.figures_of_traversability import PIT, Latent
from benchnav.models.quality.measure import Quality, evaluate
from benchnav.models.slope_gp.table import SoftModes
from benchnav.viz.figure import Figure as BenchnavFigure
from tests.models.stub import ColourModel, true_table

Qualities = dict[str, Quality]


@pytest.fixture(scope="module")
def qualities(dataset: TerrainDataset) -> Qualities:
    return dict(
        evaluate(ColourModel(), dataset, ["test/std", "test/hs", "valid", "train"])
    )


def draw(
    figure: BenchnavFigure, by_class: dict[str, Any] | None = None, **data: Any
) -> Figure:
    """Draw a figure from what it needs of `QualityData`."""
    classes = [SimpleNamespace(name=name) for name in ColourModel().class_names]
    dataset = SimpleNamespace(
        recipe=SimpleNamespace(classes=classes), truth_of=lambda split: "generated"
    )
    return figure.draw(
        SimpleNamespace(**{"by_class": by_class, "dataset": dataset, **data})
    )


def latent_figure(table: Any, classes: Sequence[Any], cells: Any) -> Figure:
    dataset = SimpleNamespace(
        recipe=SimpleNamespace(classes=classes), truth_of=lambda split: "generated"
    )
    measured = {"std": SimpleNamespace(slope_cells=cells)}
    return draw(Latent(), measured, table=table, dataset=dataset, qualities=measured)


def panel(figure: Figure, title: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_title().startswith(title))


def line(axes: Axes, **style: object) -> np.ndarray:
    """The points of the one line with this style, shape [2, N]."""
    (found,) = [
        one
        for one in axes.lines
        if all(getattr(one, f"get_{key}")() == value for key, value in style.items())
    ]
    return np.array(found.get_data())


def test_rows_of_the_confusion_matrix_are_shares_of_the_true_class(
    qualities: Qualities,
) -> None:
    by_class = {split: quality.classes[0] for split, quality in qualities.items()}
    names = ColourModel().class_names
    figure = draw(Confusion(), by_class)
    for split, quality in by_class.items():
        axes = panel(figure, split)
        shares, counts = (
            np.ma.filled(axes.images[0].get_array(), np.nan),
            np.array(quality.confusion),
        )
        there = counts.sum(1) > 0
        np.testing.assert_allclose(shares[there].sum(1), 100)
        np.testing.assert_allclose(
            shares[there], 100 * counts[there] / counts[there].sum(1, keepdims=True)
        )
        assert np.isnan(shares[~there]).all()
        first = np.flatnonzero(there)[0]
        written = {text.get_position(): text.get_text() for text in axes.texts}
        assert written[(first, first)] == f"{shares[first, first]:.0f}"
    assert [
        text.get_text() for text in panel(figure, "test/std").get_yticklabels()
    ] == [name.replace("_", " ") for name in names]


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_the_colour_bar_is_as_high_as_the_panel_beside_it(
    count: int, qualities: Qualities
) -> None:
    quality = qualities["valid"].classes[0]
    figure = draw(Confusion(), {f"split-{n}": quality for n in range(count)})
    figure.set_dpi(50)
    figure.draw_without_rendering()
    beside = panel(figure, f"split-{min(count, 3) - 1}")
    (bar,) = [
        axes
        for axes in (*figure.axes, *beside.child_axes)
        if axes.get_ylabel().startswith("fraction")
    ][:1]
    square, drawn = beside.get_window_extent(), bar.get_window_extent()
    assert (drawn.y0, drawn.y1) == pytest.approx((square.y0, square.y1))
    assert drawn.x0 > square.x1


def test_the_reliability_diagram_shows_the_curve_and_the_cells(
    qualities: Qualities,
) -> None:
    by_class = {split: quality.classes[0] for split, quality in qualities.items()}
    figure = draw(Reliability(), by_class)
    curve = by_class["test/hs"].reliability
    cells = np.array(curve["cells"])
    often = cells >= 1e-3 * cells.sum()
    axes = panel(figure, "test/hs")
    drawn = line(axes, color="#0072B2", linestyle="-")
    np.testing.assert_allclose(
        drawn,
        [np.array(curve["confidence"])[often], np.array(curve["accuracy"])[often]],
    )
    assert axes.get_title() == f"test/hs: ECE {by_class['test/hs'].ece:.3f}"
    assert not axes.texts  # nothing is written where a curve may run
    bars = [axes for axes in figure.axes if len(axes.patches) == len(cells)]
    assert len(bars) == len(by_class)
    np.testing.assert_allclose(
        [bar.get_height() for bar in bars[1].patches], cells / cells.sum()
    )


def test_the_pit_departs_from_one_by_its_counts(qualities: Qualities) -> None:
    figure = draw(PIT(), qualities=qualities)
    quality = qualities["test/hs"].traversability
    axes = panel(figure, "test/hs")
    density = np.array(quality.pit) * 20 / sum(quality.pit)
    tail, rest = [
        one for one in axes.patches if isinstance(one, StepPatch) and one.get_fill()
    ]
    np.testing.assert_allclose(
        np.append(tail.get_data().values, rest.get_data().values), density
    )
    np.testing.assert_allclose(tail.get_data().edges, [0, 0.05, 0.1])
    assert tail.get_data().baseline == 1
    band = axes.collections[0].get_paths()[0].get_extents()
    bounds = (
        np.array(binom.interval(0.9, sum(quality.pit), 0.05)) * 20 / sum(quality.pit)
    )
    np.testing.assert_allclose([band.ymin, band.ymax], bounds)
    (text,) = [text.get_text() for text in axes.texts]
    assert f"{quality.coverage:.3f}" in text
    assert f"{quality.tail_rate:.3f}" in text
    for split, one in qualities.items():
        axes = panel(figure, split)
        density = np.array(one.traversability.pit) * 20 / sum(one.traversability.pit)
        low, high = axes.get_ylim()
        # Each panel is filled by its own histogram: a bad split does not flatten the
        # others.
        assert low < density.min()
        assert high > density.max()
        assert high - low == pytest.approx(
            1.6 * (max(density.max(), 1.05) - min(density.min(), 0.95))
        )
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "calibrated" in labels


def test_the_series_draws_quality_over_severity(qualities: Qualities) -> None:
    named = {
        "test/hg-050": "valid",
        "test/hs-050": "train",
        "test/std": "test/std",
        "test/hs": "test/hs",
    }
    measured = {split: qualities[own] for split, own in named.items()}
    series = ["test/std", "train", "test/hs"]
    figure = draw(Severity(), qualities=measured)
    for title, values in (
        ("Accuracy", [qualities[split].classes[0].accuracy for split in series]),
        ("CRPS", [qualities[split].traversability.crps for split in series]),
        ("Under VaR", [qualities[split].traversability.tail_rate for split in series]),
    ):
        np.testing.assert_allclose(
            line(panel(figure, title), marker="s"), [[0, 0.5, 1], values]
        )
    np.testing.assert_allclose(line(panel(figure, "In the 90"), linestyle="--")[1], 0.9)
    np.testing.assert_allclose(line(panel(figure, "Under VaR"), linestyle="--")[1], 0.1)
    dotted = line(panel(figure, "AUROC"), marker="s", linestyle=":")[1]
    np.testing.assert_allclose(
        dotted,
        [qualities[split].classes[0].mutual_information_auroc for split in series],
    )


def test_a_series_without_classes_is_of_traversability_alone(
    dataset: TerrainDataset,
) -> None:
    found = dict(evaluate(Oracle(), dataset))
    found["test/hs-050"] = found["test/std"]
    figure = draw(Severity(), qualities=found)
    assert len(figure.axes) == 4
    np.testing.assert_allclose(
        line(panel(figure, "CRPS"), marker="o")[1][-1],
        found["test/hs"].traversability.crps,
    )


def test_latent_functions_stand_over_the_true_ones(dataset: TerrainDataset) -> None:
    model, classes = ColourModel(), dataset.recipe.classes
    cells = [[100_000, *[50] * 20, *[0] * 69] for _ in classes]
    cells[0] = [100_000, *[50] * 10, 1, *[0] * 78]
    figure = latent_figure(model.table, classes, cells)
    axes = panel(figure, classes[0].name.replace("_", " "))
    assert axes.get_xlim()[1] == pytest.approx(1.15 * 21, abs=0.1)
    x, true = line(axes, linestyle="--")
    np.testing.assert_allclose(
        true, 1 - classes[0].scale * 1e-3 * x ** classes[0].exponent - classes[0].offset
    )
    np.testing.assert_allclose(line(axes, color="#0072B2")[1], true, atol=1e-6)
    sigma = np.full_like(x, classes[0].noise)
    np.testing.assert_allclose(
        line(axes, linestyle=":")[1], expected_traversability(true, sigma)
    )
    total = np.hypot(sigma, 0.03)
    np.testing.assert_allclose(
        line(axes, color="#D55E00")[1], expected_traversability(true, total), atol=1e-6
    )
    for band, spread in zip(axes.collections[:2], (total[0], 0.03), strict=True):
        corners = band.get_paths()[0].vertices
        flat = corners[corners[:, 0] == 0, 1]
        assert np.ptp(flat) == pytest.approx(4 * spread, rel=1e-3)
    assert sorted(span.get_x() for span in axes.patches) == [10, 12]


@pytest.mark.filterwarnings(
    "error::UserWarning"
)  # matplotlib's where a layout does not work out
@pytest.mark.parametrize("count", [1, 2, 4, 5])
def test_every_number_of_splits_can_be_drawn(count: int, qualities: Qualities) -> None:
    many = {f"split-{number}": qualities["valid"] for number in range(count)}
    sure = {
        "cells": (*[0] * 13, 5, 9),
        "confidence": (*[0.0] * 13, 0.9, 1.0),
        "accuracy": (*[0.0] * 13, 0.8, 1.0),
    }
    by_class = {
        split: replace(one.classes[0], reliability=sure) for split, one in many.items()
    }
    for figure in (
        draw(Confusion(), by_class),
        draw(Reliability(), by_class),
        draw(PIT(), qualities=many),
    ):
        figure.set_dpi(20)
        figure.draw_without_rendering()
        assert len([axes for axes in figure.axes if axes.get_title()]) == count


def test_soft_spots_are_drawn_and_count_in_what_is_expected() -> None:
    classes = load_recipe("tiny-v1").classes
    soft_ground = replace(classes[0], soft=SoftSpots(weight=0.3, mean=0.1, std=0.05))
    table, cells = true_table((soft_ground,)), [[100] * 30 + [0] * 60]
    modes = SoftModes(
        weight=torch.tensor([0.3]), mean=torch.tensor([0.1]), std=torch.tensor([0.05])
    )
    whole = replace(table, soft=modes)
    figures = [latent_figure(one, (soft_ground,), cells) for one in (table, whole)]
    plain, drawn = (figure.axes[0].get_lines() for figure in figures)
    assert len(drawn) == len(plain) + 1
    assert [text.get_text() for text in figures[1].legends[0].get_texts()].count(
        "mean of soft spots"
    ) == 1
    (level,) = [line for line in drawn if line.get_linestyle() == "-."]
    assert list(level.get_ydata()) == pytest.approx([0.1, 0.1])
    slopes = torch.from_numpy(drawn[1].get_xdata()).float().view(1, 1, -1)
    expected = (
        whole.predict_by_class(
            torch.zeros(1, 1, slopes.shape[2], dtype=torch.int64), slopes
        )
        .mean()
        .flatten()
    )
    np.testing.assert_allclose(drawn[1].get_ydata(), expected, atol=1e-4)
    # The true E[λ], dotted, is that of both as well; the table's own spread of 0.03 is
    # between them.
    np.testing.assert_allclose(drawn[3].get_ydata(), drawn[1].get_ydata(), atol=0.01)
