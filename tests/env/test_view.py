import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.env.view import CHANNELS, MapKnowledge, View, bounds

GRID = Grid(13, 17, 0.5)
RISK, SPREAD, RISE, KNOWN = (
    CHANNELS.index(name) for name in ("risk", "spread", "rise", "known")
)


def known(batch: int = 1, seed: int = 0) -> MapKnowledge:
    generator = torch.Generator().manual_seed(seed)
    maps = torch.rand(3, batch, *GRID.shape, generator=generator)
    seen = torch.rand(batch, *GRID.shape, generator=generator) > 0.3
    return MapKnowledge(
        risk_map=maps[0], spread=maps[1] / 2, elevation_m=4 * maps[2], seen=seen
    )


@settings(max_examples=40, deadline=None)
@given(
    x=st.floats(-1, 9.5),
    y=st.floats(-1, 7.5),
    heading=st.floats(-7, 7),
    cells=st.integers(2, 9),
    behind=st.sampled_from([0.0, 1 / 3, 0.5, 0.9]),
)
def test_a_crop_is_what_lies_around_the_robot(
    x: float, y: float, heading: float, cells: int, behind: float
) -> None:
    ground, length = known(), cells * 0.5
    state = torch.tensor([[x, y, heading]], dtype=torch.float64)
    found = View(cells=cells, behind=behind).crop(GRID, ground, state)[0]
    own_row, own_column = (
        min(max(int(at // 0.5), 0), most - 1) for at, most in ((y, 13), (x, 17))
    )
    own = float(ground.elevation_m[0, own_row, own_column])
    for i in range(cells):
        for j in range(cells):
            ahead, left = (
                (j + 0.5) * 0.5 - behind * length,
                (i + 0.5) * 0.5 - length / 2,
            )
            at_x = x + ahead * math.cos(heading) - left * math.sin(heading)
            at_y = y + ahead * math.sin(heading) + left * math.cos(heading)
            if min(abs(2 * at - round(2 * at)) for at in (at_x, at_y)) < 1e-6:
                continue  # on an edge between cells
            row, column = math.floor(at_y / 0.5), math.floor(at_x / 0.5)
            if not (0 <= row < 13 and 0 <= column < 17):
                assert found[:, i, j].tolist() == [0, 0, 0, 0]
                continue
            seen = bool(ground.seen[0, row, column])
            rise = (float(ground.elevation_m[0, row, column]) - own) / (length / 2)
            assert float(found[RISK, i, j]) == float(ground.risk_map[0, row, column])
            assert float(found[SPREAD, i, j]) == 2 * float(
                ground.spread[0, row, column]
            )
            assert float(found[RISE, i, j]) == pytest.approx(
                max(-1, min(1, rise)) * seen, abs=1e-6
            )
            assert float(found[KNOWN, i, j]) == seen


def test_each_member_of_a_batch_has_a_crop_of_its_own() -> None:
    ground, view = known(3), View(cells=6)
    state = torch.tensor([[1.0, 2.0, 0.3], [4.0, 3.0, -2.0], [8.4, 0.2, 1.0]])
    whole = view.crop(GRID, ground, state)
    assert whole.dtype == torch.float32
    for member in range(3):
        own = torch.tensor([member])
        assert torch.equal(
            view.crop(GRID, ground.select(own), state[own])[0], whole[member]
        )


def test_the_corners_enclose_the_crop() -> None:
    view, state = View(cells=4, behind=0.25), torch.tensor([[3.0, 2.0, math.pi / 2]])
    # 2 m long: 0.5 m behind, which is down, 1.5 m ahead, and 1 m to each side.
    wanted = [[4.0, 1.5], [4.0, 3.5], [2.0, 3.5], [2.0, 1.5]]
    torch.testing.assert_close(view.corners_m(GRID, state)[0], torch.tensor(wanted))


def observe(**changes: Any) -> torch.Tensor:
    given = {
        "state": torch.tensor([[1.0, 1.0, math.pi / 2]]), "goal_m": torch.tensor([[1.0, 5.0]]),
        "observed": torch.tensor([0.25]), "time_left": torch.tensor([0.5], dtype=torch.float64),
    }  # fmt: skip
    return View(cells=8).observe(GRID, known(), **given | changes)["state"][0]


def test_the_numbers_are_goal_observed_traversability_and_time() -> None:
    # 4 m away, twice the half of a crop of 4 m.
    torch.testing.assert_close(observe(), torch.tensor([2 / 3, 1.0, 0.0, 0.25, 0.5]))
    left = observe(state=torch.tensor([[1.0, 1.0, 0.0]]))
    torch.testing.assert_close(left[1:3], torch.tensor([0.0, 1.0]))
    assert observe(observed=torch.tensor([torch.nan]))[3] == 1
    assert observe(time_left=torch.tensor([-0.01]))[4] == 0


def test_what_a_robot_has_beyond_its_pose_follows_within_bounds() -> None:
    found = observe(state=torch.tensor([[1.0, 1.0, 0.0, 1.0, -3.0]]))
    torch.testing.assert_close(found[5:], torch.tensor([0.5, -0.75]))
    low, high = bounds(5)
    assert len(low) == len(high) == len(found)
    assert all(
        least <= value <= most
        for least, value, most in zip(low, found.tolist(), high, strict=True)
    )


@pytest.mark.parametrize("changes", [{"cells": 1}, {"behind": 1.0}, {"behind": -0.1}])
def test_views_that_are_none_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="crop_"):
        View(**changes)
