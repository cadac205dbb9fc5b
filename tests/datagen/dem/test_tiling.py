"""How ground is cut: for any ground and shares, splits that stay a map's width apart."""

import itertools

import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from benchnav.core.errors import ConfigError, DatasetError
from benchnav.datagen.dem.extent import Layout
from benchnav.datagen.dem.recipe_fit import _cells_of
from benchnav.datagen.dem.tiling import Tiling, cut, read_shares

SHARES = {"train": 0.7, "valid": 0.1, "test/site": 0.2}


def places(tiling: Tiling) -> dict[str, list[tuple[int, int]]]:
    """Rows and columns of each split's maps, in the order they are gone through."""
    found: dict[str, list[tuple[int, int]]] = {}
    for run in tiling.runs(7):
        assert 1 <= len(run.columns) <= 7
        found.setdefault(run.split, []).extend(
            (run.row, column) for column in run.columns
        )
    return found


@settings(deadline=None)
@given(
    cells=st.tuples(st.integers(8, 250), st.integers(8, 250)),
    shape=st.tuples(st.integers(3, 8), st.integers(3, 8)),
    stride=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    weights=st.lists(st.integers(1, 9), min_size=1, max_size=4),
)
def test_maps_lie_on_the_ground_and_splits_a_map_apart(
    cells: tuple[int, int],
    shape: tuple[int, int],
    stride: tuple[int, int],
    weights: list[int],
) -> None:
    shares = {f"split{i}": weight / sum(weights) for i, weight in enumerate(weights)}
    try:
        tiling = cut(cells, shape, stride, shares)
    except DatasetError:
        assume(False)
    assert cut(cells, shape, stride, shares) == tiling
    found = places(tiling)
    assert list(tiling.strips) == list(shares)
    assert set(found) == set(shares)
    for axis in (0, 1):
        last = (tiling.tiles[axis] - 1) * stride[axis] + shape[axis]
        assert tiling.cells[axis] == last <= cells[axis] < last + stride[axis]
    for own in found.values():
        assert own == sorted(set(own))
    for one, other in itertools.combinations(found, 2):
        edges = [
            {(row * stride[0], column * stride[1]) for row, column in found[split]}
            for split in (one, other)
        ]
        # Along the longer side, the nearest maps of the two.
        axis = 0 if tiling.tiles[0] > tiling.tiles[1] else 1
        low, high = sorted(
            (min(e[axis] for e in own), max(e[axis] for e in own) + shape[axis])
            for own in edges
        )
        assert high[0] - low[1] >= shape[axis]
    assert tiling.maps == sum(map(len, found.values()))
    assert tiling.maps + tiling.n_omitted == tiling.tiles[0] * tiling.tiles[1]
    lines = sum(map(len, tiling.strips.values()))
    for split, share in shares.items():
        assert abs(len(tiling.strips[split]) - share * lines) <= len(shares)


def test_shares_are_kept_and_no_more_is_lost_than_the_gaps() -> None:
    tiling = cut((64 * 5, 64 * 102), (64, 64), (64, 64), SHARES)
    assert {split: len(own) for split, own in places(tiling).items()} == {
        "train": 350,
        "valid": 50,
        "test/site": 100,
    }
    assert tiling.n_omitted == 2 * 5
    northward = cut((64 * 102, 64 * 5), (64, 64), (64, 64), SHARES)
    assert (northward.strips, northward.maps) == (tiling.strips, tiling.maps)
    assert {row for row, _ in places(northward)["valid"]} == set(range(71, 81))
    # At half the stride a gap of a map's width takes three maps.
    assert cut((64, 64 * 60), (64, 64), (32, 32), {"a": 0.5, "b": 0.5}).n_omitted == 3
    # Maps that lie further apart than their width need none.
    assert cut((64, 64 * 60), (64, 64), (128, 128), {"a": 0.5, "b": 0.5}).n_omitted == 0


def test_a_small_share_is_one_strip_and_small_ground_is_refused() -> None:
    shares = {"train": 0.98, "valid": 0.01, "test": 0.01}
    assert [
        len(strip) for strip in cut((8, 56), (8, 8), (8, 8), shares).strips.values()
    ] == [3, 1, 1]
    with pytest.raises(DatasetError, match=r"terrain for 3 splits.*got 4 maps"):
        cut((8, 39), (8, 8), (8, 8), shares)


def test_shares_are_read() -> None:
    assert read_shares("train:0.7, valid:0.1,test/site:0.2") == SHARES
    assert read_shares("test/hills") == {"test/hills": 1.0}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("train:0.7,valid:0.2", "sum to 1, got 0.9"),
        ("train,valid", "sum to 1, got 2"),
        ("train:0.5,train:0.5", "'train:0.5'"),
        ("train:1.0,valid:0", "'valid:0'"),
        ("train:nan", "'train:nan'"),
        ("train:most", "'train:most'"),
        (":1", "':1'"),
        ("", "''"),
        ("train:0.5,,valid:0.5", "''"),
    ],
)
def test_shares_of_another_form_are_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_shares(text)
    assert said in str(caught.value)


@given(
    st.tuples(st.integers(1, 6), st.integers(1, 6)),
    st.tuples(st.integers(1, 7), st.integers(1, 7)),
    st.sets(st.integers(0, 41), min_size=1, max_size=25),
)
def test_maps_are_of_one_group_just_where_they_overlap_directly_or_by_others(
    shape: tuple[int, int], stride: tuple[int, int], numbers: set[int]
) -> None:
    tiling = Tiling(
        shape=shape, stride=stride, tiles=(7, 6), strips={"train": range(7)}
    )
    own = sorted(numbers)
    cells = {
        number: {
            (number // 6 * stride[0] + row, number % 6 * stride[1] + column)
            for row in range(shape[0])
            for column in range(shape[1])
        }
        for number in own
    }
    graph = nx.Graph(
        [(one, other) for one in own for other in own if cells[one] & cells[other]]
    )
    expected = {
        number: min(part) for part in nx.connected_components(graph) for number in part
    }
    assert tiling.groups(own).tolist() == [expected[number] for number in own]
    assert tiling.overlaps == (stride[0] < shape[0] or stride[1] < shape[1])


@pytest.mark.parametrize("stride", [(5, 7), (3, 9)])
def test_the_cells_of_a_run_begin_with_those_of_a_map_of_its_split(
    stride: tuple[int, int],
) -> None:
    tiling = cut((60, 90), (5, 7), stride, SHARES)
    for run in tiling.runs(4):
        cells = _cells_of(run, Layout(tiling, np.zeros(2), "bilinear"))
        assert tuple(map(len, cells)) == tiling.shape
        row, column = np.meshgrid(*cells)
        split = list(tiling.strips).index(run.split)
        assert (tiling.split_of(row, column) == split).all()
