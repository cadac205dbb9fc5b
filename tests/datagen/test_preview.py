from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchnav.core.errors import DatasetError
from benchnav.core.grid import outline
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.vegetation import Growth
from benchnav.datagen.preview import (
    FIELDS,
    class_colours,
    contact_columns,
    contact_sheet_figure,
    preview_figure,
    soft_ground,
)
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.viz.maps import hatching
from benchnav.viz.sheet import layer_column
from benchnav.viz.style import TWO_COLUMNS_IN, save
from tests.datagen.small import grown, small_stakes
from tests.factories import tiny_dataset, tiny_recipe

BARS = ("elevation_m", "slope_deg", "traversability")


@pytest.fixture
def dataset(dataset_path: Path) -> TerrainDataset:
    return TerrainDataset(dataset_path)


def train_only(maps: int = 3, **changes: Any) -> Recipe:
    recipe = tiny_recipe(train=maps)
    kept = {
        "splits": {"train": recipe.splits["train"]},
        "scenarios": {"std": recipe.scenarios["std"]},
    }
    return replace(recipe, **kept | changes)


def panels(figure: Figure) -> dict[str, Axes]:
    return {str(panel.get_label()): panel for panel in figure.axes}


def legend_names(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def seen_texts(figure: Figure) -> list[Text]:
    figure.draw_without_rendering()
    hidden = set()
    for panel in figure.axes:
        for axis in (panel.xaxis, panel.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                if not low <= tick.get_loc() <= high or not panel.axison:
                    hidden |= {tick.label1, tick.label2}
    texts = figure.findobj(
        lambda artist: isinstance(artist, Text) and artist.get_visible()
    )
    return [text for text in texts if text.get_text().strip() and text not in hidden]


def check_texts(figure: Figure) -> None:
    """All text is of a legible size, on the page, and clear of other text and of the
    panels of others.
    """
    texts = seen_texts(figure)
    page = figure.bbox
    boxes = [text.get_window_extent().padded(-0.5) for text in texts]
    for text, box in zip(texts, boxes, strict=True):
        assert text.get_fontsize() >= 7
        inside = (
            page.x0 <= box.x0
            and box.x1 <= page.x1
            and page.y0 <= box.y0
            and box.y1 <= page.y1
        )
        assert inside, f"{text.get_text()!r} leaves the page"
    for (one, first), (other, second) in combinations(
        zip(texts, boxes, strict=True), 2
    ):
        assert not first.overlaps(second), (
            f"{one.get_text()!r} is on {other.get_text()!r}"
        )


def test_a_panel_per_field_and_row_shows_what_is_stored(
    dataset: TerrainDataset,
) -> None:
    indices = [1, 0]
    figure = preview_figure(dataset, "test/hg", indices)
    drawn, stored = panels(figure), dataset.read("test/hg", indices)
    assert set(drawn) == {f"{field} {row}" for field in FIELDS for row in (0, 1)} | {
        f"{field} bar" for field in BARS
    }
    for row in (0, 1):
        for field in FIELDS:
            panel, values = drawn[f"{field} {row}"], stored[field][row]
            if field == "rgb":
                values = values.transpose(1, 2, 0)
            elif field == "elevation_m":
                values = values - values.min()
            np.testing.assert_array_equal(panel.images[0].get_array(), values)
            assert panel.images[0].origin == "lower"
            assert panel.images[0].get_extent() == [0, 16, 0, 16]
            assert (panel.get_xlim(), panel.get_ylim()) == ((0, 16), (0, 16))
            marked = [tuple(np.concatenate(line.get_data())) for line in panel.lines]
            assert not any(line.get_clip_on() for line in panel.lines)
            assert marked == [
                tuple(stored["start_m"][row]),
                tuple(stored["goal_m"][row]),
            ]
    texts = [text.get_text() for text in seen_texts(figure)]
    for once in (
        "tiny-v1, split test/hg",
        "map 1",
        "map 0",
        "x [m]",
        "y [m]",
        "start",
        "goal",
    ):
        assert texts.count(once) == 1
    for title in ("RGB", "Class", "Elevation [m]", "Slope [°]", "Traversability λ"):
        assert texts.count(title) == 1


def test_axes_are_numbered_once(dataset: TerrainDataset) -> None:
    figure = preview_figure(dataset, "train", [0, 1])
    figure.draw_without_rendering()
    for label, panel in panels(figure).items():
        field, row = label.split()
        if row != "bar":
            assert panel.yaxis.get_major_ticks()[0].label1.get_visible() == (
                field == "rgb"
            )
            assert panel.xaxis.get_major_ticks()[0].label1.get_visible() == (row == "1")


def test_a_class_has_one_colour_in_every_map_and_figure(
    dataset: TerrainDataset,
) -> None:
    colours = class_colours(dataset.recipe.classes)
    for split, indices in (("train", [0, 1, 2, 3, 4]), ("test/hs", [1])):
        figure, stored = (
            preview_figure(dataset, split, indices),
            dataset.read(split, indices)["class_id"],
        )
        for row in range(len(indices)):
            image = panels(figure)[f"class_id {row}"].images[0]
            np.testing.assert_allclose(
                image.to_rgba(stored[row])[..., :3], colours[stored[row]]
            )
        shown = np.unique(stored)
        names = [
            f"{number} {dataset.recipe.classes[number].name.replace('_', ' ')}"
            for number in shown
        ]
        legend = figure.legends[1]
        assert [text.get_text() for text in legend.get_texts()] == names
        for patch, number in zip(legend.get_patches(), shown, strict=True):
            np.testing.assert_allclose(patch.get_facecolor()[:3], colours[number])


def test_classes_are_drawn_in_their_own_colours_and_look_alikes_apart() -> None:
    classes = load_recipe("paper-v1").classes
    np.testing.assert_allclose(
        class_colours(classes), np.array([item.colour for item in classes]) / 255
    )
    alike = [replace(classes[0], colour=(40, 60, 50)) for _ in range(3)]
    colours = class_colours([*classes, *alike])
    np.testing.assert_allclose(colours[len(classes)], np.array([40, 60, 50]) / 255)
    assert np.abs(np.diff(colours[len(classes) :], axis=0)).min() > 0.1
    np.testing.assert_allclose(colours[: len(classes)], class_colours(classes))


@pytest.mark.parametrize("count", [1, 2, 255])
def test_tables_of_any_size_have_colours(count: int) -> None:
    one = load_recipe("paper-v1").classes[0]
    colours = class_colours([replace(one, colour=(k, k, k)) for k in range(count)])
    assert colours.shape == (count, 3)
    assert len(np.unique(colours.round(6), axis=0)) == count


@pytest.mark.parametrize("indices", [[0], [0, 1, 2], list(range(8))])
def test_texts_are_legible(dataset: TerrainDataset, indices: list[int]) -> None:
    figure = preview_figure(dataset, "train", indices)
    check_texts(figure)
    assert (
        figure.get_figwidth() == pytest.approx(TWO_COLUMNS_IN)
        if len(indices) < 5
        else figure.get_figheight() < 9.7
    )


@pytest.mark.parametrize(("height", "width"), [(16, 16), (12, 96), (48, 12), (20, 30)])
def test_grids_of_any_shape(tmp_path: Path, height: int, width: int) -> None:
    goal = (width / 2 - 2, height / 2 - 2)
    recipe = train_only(height=height, width=width, start_m=(1, 1), goal_m=goal)
    shaped = TerrainDataset(tiny_dataset(tmp_path / "shaped.h5", recipe))
    figure = preview_figure(shaped, "train", [0, 1])
    check_texts(figure)
    for field in FIELDS:
        panel = panels(figure)[f"{field} 1"]
        assert panel.images[0].get_array().shape[:2] == (height, width)
        box = panel.get_window_extent()
        assert box.height / box.width == pytest.approx(height / width)
        for axis, cells in ((panel.xaxis, width), (panel.yaxis, height)):
            numbered = [
                place for place in axis.get_ticklocs() if 0 <= place <= cells / 2
            ]
            assert numbered, "an axis has no number"
            assert max(numbered) < cells / 2, (
                "a number at the end touches the next panel's first"
            )
    sheet = contact_sheet_figure(shaped, "train")
    check_texts(sheet)
    box = sheet.axes[0].images[2].get_window_extent()
    assert box.height / box.width == pytest.approx(height / width)


def with_values(
    dataset: TerrainDataset,
    monkeypatch: pytest.MonkeyPatch,
    **changed: Callable[..., Any],
) -> None:
    """Lets a dataset read what `changed` makes of its arrays."""
    read = dataset.read

    def reading(
        split: str, indices: Sequence[int], fields: Iterable[str]
    ) -> dict[str, np.ndarray]:
        stored = read(split, indices, fields)
        return stored | {
            name: change(stored[name])
            for name, change in changed.items()
            if name in stored
        }

    monkeypatch.setattr(dataset, "read", reading)


def test_unobserved_traversability_is_grey_and_explained(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert legend_names(preview_figure(dataset, "train", [0]))[:2] == ["start", "goal"]
    assert "unknown" not in legend_names(preview_figure(dataset, "train", [0]))
    hole = np.zeros((32, 32), dtype=bool)
    hole[4:9, 10:30] = True
    with_values(
        dataset,
        monkeypatch,
        traversability=lambda values: np.where(hole, np.nan, values),
        reference_time_s=lambda values: np.full_like(values, np.nan),
    )
    figure = preview_figure(dataset, "train", [0])
    assert legend_names(figure)[:3] == ["start", "goal", "unknown"]
    image = panels(figure)["traversability 0"].images[0]
    rgba = image.to_rgba(image.get_array())
    grey = figure.legends[0].get_patches()[0].get_facecolor()
    assert len(set(grey[:3])) == 1
    np.testing.assert_array_equal((rgba == grey).all(-1), hole)


def test_hillshade_lights_the_north_west(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    y, x = np.mgrid[:32, :32]
    dome = 3 - np.hypot(x - 15.5, y - 15.5)[None] / 10
    with_values(dataset, monkeypatch, elevation_m=lambda z: dome)
    veil = (
        panels(preview_figure(dataset, "train", [0]))["elevation_m 0"]
        .images[1]
        .get_array()
    )
    assert veil[24, 8, 0] == 1
    assert veil[8, 24, 0] == 0


@pytest.mark.usefixtures("whole_fonts")
@pytest.mark.parametrize(
    ("kind", "magic"),
    [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml"), ("jpg", b"\xff\xd8")],
)
def test_pictures_are_written(
    dataset: TerrainDataset, tmp_path: Path, kind: str, magic: bytes
) -> None:
    settings = dict(matplotlib.rcParams)
    save(preview_figure(dataset, "test/std", [0, 1]), tmp_path / "sheet", kind)
    save(contact_sheet_figure(dataset, "test/std"), tmp_path / "contact", kind)
    assert dict(matplotlib.rcParams) == settings
    for name in ("sheet", "contact"):
        written = (tmp_path / name).read_bytes()
        assert written.startswith(magic)
        if kind == "pdf":
            assert b"/CIDFontType2" in written
            assert b"/Type3" not in written


def test_a_contact_sheet_has_every_map_in_order(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored, asked = dataset.read("train")["rgb"], []
    read = dataset.read
    monkeypatch.setattr(
        dataset, "read", lambda *given: asked.append(given) or read(*given)
    )
    figure = contact_sheet_figure(dataset, "train")
    (sheet,) = figure.axes
    assert [list(indices) for _, indices, _ in asked] == [[index] for index in range(8)]
    assert {tuple(fields) for *_, fields in asked} == {("rgb",)}
    assert len(sheet.images) == 8
    corners = []
    for index, (image, label) in enumerate(zip(sheet.images, sheet.texts, strict=True)):
        np.testing.assert_array_equal(
            image.get_array(), stored[index].transpose(1, 2, 0)
        )
        assert image.get_interpolation() == "none"
        assert label.get_text() == str(index)
        left, right, bottom, top = image.get_extent()
        # The page counts inches downward.
        assert top < bottom
        assert left <= label.get_position()[0] < right
        assert top <= label.get_position()[1] < bottom
        corners.append((round(top, 6), left))
    assert corners == sorted(corners)
    assert (
        figure.texts[0].get_text().replace("\n", " ")
        == "tiny-v1, split train (scenario std): 8 maps"
    )
    check_texts(figure)


def test_a_contact_sheet_stops_at_most(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "first" not in contact_sheet_figure(dataset, "train").texts[0].get_text()
    monkeypatch.setattr("benchnav.datagen.preview._MAX_THUMBNAILS", 5)
    figure = contact_sheet_figure(dataset, "train")
    assert len(figure.axes[0].images) == 5
    assert "first 5 of 8 maps" in figure.texts[0].get_text().replace("\n", " ")


@given(count=st.integers(1, 1000), ratio=st.floats(0.25, 4))
def test_contact_grids_are_nearly_square_and_full(count: int, ratio: float) -> None:
    columns = contact_columns(count, ratio)
    rows = -(-count // columns)
    assert (rows - 1) * columns < count <= rows * columns
    if count >= 50:
        assert 0.5 <= columns / (rows * ratio) <= 2


@pytest.mark.parametrize(
    "draw",
    [
        lambda d: preview_figure(d, "nope", [0]),
        lambda d: contact_sheet_figure(d, "nope"),
    ],
)
def test_an_unknown_split_is_refused(
    dataset: TerrainDataset, draw: Callable[[TerrainDataset], Figure]
) -> None:
    with pytest.raises(DatasetError, match="'nope'"):
        draw(dataset)


def test_a_map_that_is_not_there_is_refused(dataset: TerrainDataset) -> None:
    with pytest.raises(DatasetError, match="indices in 0–7"):
        preview_figure(dataset, "train", [8])


@pytest.fixture(scope="module")
def stakes(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    return TerrainDataset(
        tiny_dataset(tmp_path_factory.mktemp("stakes") / "d.h5", small_stakes())
    )


def lines_of(panel: Axes) -> list[np.ndarray]:
    return [np.array(drawn.get_segments()) for drawn in panel.collections]


def test_soft_ground_is_hatched_and_outlined(stakes: TerrainDataset) -> None:
    figure = preview_figure(stakes, "train", [0, 1])
    drawn = panels(figure)
    maps = stakes.read("train", [0, 1])
    soft = soft_ground(maps["class_id"], stakes.recipe.classes)
    names = {"wet_clay", "loose_soil", "fine_sand", "dune_sand"}
    for number, item in enumerate(stakes.recipe.classes):
        assert (soft[maps["class_id"] == number] == (item.name in names)).all()
    for row in range(2):
        edges = outline(soft[row], stakes.grid.resolution_m)
        hatched, *outlines = lines_of(drawn[f"class_id {row}"])
        np.testing.assert_array_equal(
            hatched, hatching(soft[row], stakes.grid.resolution_m)
        )
        for lines in (*outlines, *lines_of(drawn[f"traversability {row}"])):
            np.testing.assert_array_equal(lines, edges)
        assert len(outlines) == len(drawn[f"traversability {row}"].collections) == 2
        for plain in ("rgb", "slope_deg"):
            assert not drawn[f"{plain} {row}"].collections
    assert legend_names(figure)[:3] == ["start", "goal", "may hide soft spots"]
    check_texts(figure)


def test_a_contact_sheet_of_soft_ground_shows_stored_traversability(
    stakes: TerrainDataset,
) -> None:
    figure = contact_sheet_figure(stakes, "train")
    maps = stakes.read("train")
    (sheet,) = figure.axes
    assert len(sheet.images) == 8
    for index, image in enumerate(sheet.images):
        shown = np.asarray(image.get_array())
        assert shown.shape == (32, 64, 3)
        np.testing.assert_array_equal(
            shown[:, :32], maps["rgb"][index].transpose(1, 2, 0)
        )
        shade = matplotlib.colormaps["viridis"](
            maps["traversability"][index], bytes=True
        )[..., :3]
        np.testing.assert_array_equal(shown[:, 32:], shade)
        left, right, bottom, top = image.get_extent()
        assert (right - left) == pytest.approx(2 * (bottom - top))
    check_texts(figure)


def test_layers_have_a_panel_a_bar_and_a_unit_each(tmp_path: Path) -> None:
    recipe = small_stakes()
    grass = Growth(height_m=(0.1, 0.8), cover=0.5, colour=(60, 110, 30))
    names = ("wet_clay", "gravel", "scree", "packed_soil", "crusted_soil")
    recipe = grown(small_stakes(), **dict.fromkeys(names, grass))
    dataset = TerrainDataset(tiny_dataset(tmp_path / "grown.h5", recipe))
    figure = preview_figure(dataset, "train", [0, 3])
    check_texts(figure)
    stored, shown = dataset.read("train", [0, 3])["vegetation_m"], panels(figure)
    for row in (0, 1):
        image = shown[f"vegetation_m {row}"].get_images()[0]
        np.testing.assert_array_equal(image.get_array(), stored[row])
        assert image.get_clim() == (0.0, stored.max())
    assert shown["vegetation_m 0"].get_title() == "Vegetation [m]"
    assert "vegetation_m bar" in shown
    assert "unknown" not in legend_names(figure)
    assert "vegetation_m 0" not in panels(
        preview_figure(TerrainDataset(tiny_dataset(tmp_path / "b.h5")), "train", [0])
    )


def test_a_layers_column_says_its_unit_and_where_nothing_is_known() -> None:
    values = np.array([[[-20.0, 50.0], [np.nan, 350.0]]], np.float32)
    titles = {
        ("dust", "1"): "Dust",
        ("dust_cover", "%"): "Dust cover [%]",
        ("canopy_m", "m"): "Canopy [m]",
        ("tilt_deg", "deg"): "Tilt [°]",
        ("rows_azimuth_deg", "deg"): "Rows azimuth [°]",
    }
    for (name, unit), title in titles.items():
        column = layer_column(name, values, unit)
        assert (column.name, column.title, column.unit) == (name, title, "")
        assert np.ma.getmaskarray(column.layers).ravel().tolist() == [
            False,
            False,
            True,
            False,
        ]
        limits = (0.0, 360.0) if "azimuth" in name else (-20.0, 350.0)
        assert (column.shades["vmin"], column.shades["vmax"]) == limits
    turned = layer_column("rows_azimuth_deg", values, "deg").layers
    assert turned.compressed().tolist() == [340.0, 50.0, 350.0]
