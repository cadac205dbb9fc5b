import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.preview import class_colours
from benchnav.models.predictor import Oracle
from benchnav.models.quality.map_sheet import (
    map_sheet_figure,
    read_sheet,
    shared_scales,
)
from benchnav.models.quality.scores import mutual_information, predictive_entropy
from tests.factories import draw
from tests.models.stub import ColourModel


def panel(figure: Figure, label: str) -> Axes:
    (found,) = [axes for axes in figure.axes if axes.get_label() == label]
    return found


def test_a_sheet_holds_truth_prediction_error_and_uncertainty(
    dataset: TerrainDataset,
) -> None:
    model, indices = ColourModel(), [2, 0]
    terrain = dataset.terrain("valid", indices)
    mixture, members = (
        model.predict(terrain.observe()),
        model.member_probabilities(terrain.observe()),
    )
    true = Oracle().predict_terrain(terrain).mean()
    expected = {
        "rgb": terrain.rgb.movedim(1, -1),
        "class_true": terrain.class_id,
        "class_found": mixture.weights.argmax(1),
        "expected_true": true,
        "expected": mixture.mean(),
        "error": mixture.mean() - true,
        "entropy": predictive_entropy(mixture.weights),
        "information": mutual_information(members),
    }
    layers = read_sheet(model, dataset, "valid", indices).layers
    for name, layer in expected.items():
        np.testing.assert_allclose(layers[name], layer.numpy(), atol=1e-6)
    assert set(layers) == {*expected, "width"}
    parameters = (mixture.weights, mixture.means, mixture.stds)
    corner = TraversabilityMixture(*(values[..., :4, :4] for values in parameters))
    drawn = draw(corner, 4000, torch.Generator().manual_seed(0))
    ends = torch.quantile(drawn, torch.tensor([0.05, 0.95]), dim=0)
    np.testing.assert_allclose(
        layers["width"][:, :4, :4], (ends[1] - ends[0]).numpy(), atol=0.06
    )


def test_what_a_model_has_not_is_not_drawn(dataset: TerrainDataset) -> None:
    single = read_sheet(ColourModel((40.0,)), dataset, "valid", [0])
    assert "information" not in single.layers
    sheet = read_sheet(Oracle(), dataset, "valid", [0])
    assert set(sheet.layers) == {"rgb", "expected_true", "expected", "error", "width"}
    figure = map_sheet_figure(
        sheet,
        shared_scales([sheet], dataset.recipe.classes),
        dataset.recipe.classes,
        "",
    )
    assert not figure.legends
    figure.set_dpi(20)
    figure.draw_without_rendering()


def test_a_quantity_has_one_scale_in_all_sheets(dataset: TerrainDataset) -> None:
    sheets = [
        read_sheet(ColourModel(), dataset, split, [0, 1])
        for split in ("test/std", "test/hs")
    ]
    scales = shared_scales(sheets, dataset.recipe.classes)
    for name in ("error", "width", "entropy", "information"):
        values = np.concatenate(
            [np.abs(sheet.layers[name]).ravel() for sheet in sheets]
        )
        most = scales[name]["vmax"]
        assert np.mean(values <= most) >= 0.995
        assert most <= 2 * np.quantile(values, 0.995)
        assert scales[name]["vmin"] == (-most if name == "error" else 0)


def test_panels_show_their_layers_in_rows_of_maps(dataset: TerrainDataset) -> None:
    classes = dataset.recipe.classes
    sheet = read_sheet(ColourModel(), dataset, "test/std", [1, 0])
    figure = map_sheet_figure(
        sheet, shared_scales([sheet], classes), classes, "model m on dataset d"
    )
    for name, layer in sheet.layers.items():
        for row in range(2):
            image = panel(figure, f"{name} {row}").images[0]
            np.testing.assert_array_equal(np.asarray(image.get_array()), layer[row])
            assert image.origin == "lower"
            assert image.get_extent() == [0, sheet.extent_m[0], 0, sheet.extent_m[1]]
    texts = {text.get_text() for text in figure.findobj(Text)}
    assert {
        "model m on dataset d, split test/std",
        "map 1",
        "map 0",
        "Mutual information",
    } <= texts
    image = panel(figure, "class_true 0").images[0]
    drawn = image.cmap(image.norm(sheet.layers["class_true"][0]))[..., :3]
    np.testing.assert_allclose(
        drawn, class_colours(classes)[sheet.layers["class_true"][0]], atol=1 / 255
    )
    there = {*sheet.layers["class_true"].flat, *sheet.layers["class_found"].flat}
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        classes[number].name.replace("_", " ") for number in sorted(there)
    ]


@pytest.mark.parametrize("maps", [1, 3])
def test_nothing_stands_outside_the_sheet(maps: int, dataset: TerrainDataset) -> None:
    classes = dataset.recipe.classes
    sheet = read_sheet(ColourModel(), dataset, "valid", range(maps))
    figure = map_sheet_figure(
        sheet, shared_scales([sheet], classes), classes, "model m on dataset d"
    )
    figure.set_dpi(50)
    figure.draw_without_rendering()
    box = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= width
    assert box.y1 <= height
