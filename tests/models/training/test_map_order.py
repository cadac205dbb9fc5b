from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core import rng
from benchnav.datagen.files import reader
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.training import map_order as module
from benchnav.models.training.data import Loading, MapData
from benchnav.models.training.map_order import WINDOW_SHARDS, MapSampler, map_order
from tests.factories import tiny_recipe

SEEDS = st.integers(0, 3), st.integers(0, 5)


def windows_of(order: np.ndarray, shards: Sequence[int], most: int) -> list[set[int]]:
    """Cuts an order into the windows of shards that it was drawn from, of nearly the
    same number each.
    """
    owner = np.repeat(np.arange(len(shards)), shards)[order]
    count = -(-len(shards) // most)
    windows, start = [], 0
    for window in range(count):
        # Of n shards window w has those with the turns t for which t·count // n is w.
        size = sum(turn * count // len(shards) == window for turn in range(len(shards)))
        # An empty shard is in no order, and may be in any window.
        own = list(dict.fromkeys(owner[start:]))[:size]
        stop = start + sum(shards[shard] for shard in own)
        assert set(owner[start:stop]) == set(own)
        windows.append(set(own))
        start = stop
    assert start == len(order)
    return windows


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 4), min_size=1, max_size=WINDOW_SHARDS), *SEEDS)
def test_as_many_shards_as_fit_a_window_are_shuffled_as_one_file_is(
    shards: list[int], seed: int, epoch: int
) -> None:
    """Which was the order before there were windows."""
    key = rng.stream_key(seed, "models", "map order")
    before = rng.permutation(key, np.array([epoch]), sum(shards))[0]
    np.testing.assert_array_equal(map_order(shards, seed, epoch), before)
    np.testing.assert_array_equal(map_order([sum(shards)], seed, epoch), before)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=30), *SEEDS)
def test_every_map_comes_once_and_every_window_is_of_whole_shards(
    shards: list[int], seed: int, epoch: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "WINDOW_SHARDS", 4)
        order = map_order(shards, seed, epoch)
    assert sorted(order.tolist()) == list(range(sum(shards)))
    windows = windows_of(order, shards, 4)
    assert max(map(len, windows)) <= 4
    assert max(map(len, windows)) - min(map(len, windows)) <= 1


def test_shards_and_maps_are_drawn_by_seed_and_epoch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "WINDOW_SHARDS", 5)
    shards = [7] * 20
    orders = [
        map_order(shards, seed, epoch)
        for seed, epoch in ((0, 0), (0, 0), (0, 1), (1, 0))
    ]
    np.testing.assert_array_equal(orders[0], orders[1])
    first, _, *others = (
        [frozenset(one) for one in windows_of(order, shards, 5)] for order in orders
    )
    for order, windows in zip(orders[2:], others, strict=True):
        assert (order != orders[0]).mean() > 0.9
        assert set(windows) != set(first)  # other shards are together


def test_a_map_may_come_at_any_time_and_beside_any_shard_of_its_window(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "WINDOW_SHARDS", 5)
    shards, epochs = [7] * 20, 600
    orders = np.stack([map_order(shards, 3, epoch) for epoch in range(epochs)])
    place = np.argsort(orders, axis=1)
    # Of a uniform place among n the mean is (n − 1) / 2 and the variance (n² − 1) / 12.
    error = (place.mean(0) - 69.5) / np.sqrt((140**2 - 1) / 12 / epochs)
    assert np.abs(error).max() < 4.5
    assert (error**2).mean() == pytest.approx(1, abs=0.5)
    # Of 35 shuffled maps, 7 a shard, the next is of the same shard in 6 of 34 cases.
    same = np.diff(orders.reshape(epochs, 4, 35) // 7, axis=-1) == 0
    assert same.mean() == pytest.approx(6 / 34, abs=0.01)


def test_batches_of_many_shards_are_the_same_however_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in create(
        tiny_recipe(), tmp_path / "d", shard_cells=32 * 32
    ):  # a map a shard
        pass
    monkeypatch.setattr(module, "WINDOW_SHARDS", 3)
    monkeypatch.setattr(reader, "_MAX_OPEN", 4)
    opened = []
    plainly = reader.open_file
    monkeypatch.setattr(
        reader, "open_file", lambda path: opened.append(path) or plainly(path)
    )
    dataset = TerrainDataset(tmp_path / "d")
    data = MapData(dataset, 2, seed=4)
    order = map_order([1] * 8, 4, 0)
    assert order.tolist() != map_order([8], 4, 0).tolist()
    sampler = data.train_dataloader().sampler
    assert torch.cat([index for index, *_ in sampler]).tolist() == order.tolist()
    plain = [batch["rgb"] for batch in data.train_dataloader()]
    # each once
    assert sorted(opened) == sorted(piece.path for piece in dataset.pieces["train"])
    for how in ({"workers": 2}, {"in_memory": True}):
        other = MapData(dataset, 2, seed=4, loading=Loading(**how)).train_dataloader()
        assert all(
            torch.equal(*pair)
            for pair in zip(plain, (batch["rgb"] for batch in other), strict=True)
        )


def test_processes_share_batches_of_windows() -> None:
    shards = (3, 1, 4) * 50
    whole = [index for index, *_ in MapSampler(400, 7, 2, shuffle=True, shards=shards)]
    shares = [
        [
            index
            for index, *_ in MapSampler(
                400, 7, 2, shuffle=True, shards=shards, process=(which, 2)
            )
        ]
        for which in (0, 1)
    ]
    for batch, one, two in zip(whole, *shares, strict=True):
        assert sorted(batch.tolist()) == sorted([*one.tolist(), *two.tolist()])
    assert torch.cat(whole).tolist() == map_order(shards, 2, 0).tolist()
    plain = torch.cat([index for index, *_ in MapSampler(400, 7, 2, shards=shards)])
    assert plain.tolist() == list(range(400))
    assert all(len(batch) in (6, 7) for batch in whole)
    assert any(a > b for a, b in pairwise(torch.cat(whole).tolist()))
