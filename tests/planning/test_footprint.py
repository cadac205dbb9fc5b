"""Contacts of robots, and minima of maps over what a robot may touch."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import minimum_filter

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.planning.footprint import Footprint, minimum_over_footprint

GRID = Grid(9, 12, 0.5)


@given(
    pose=st.tuples(*[st.floats(-5, 5)] * 3),
    track_m=st.floats(0.1, 2),
    wheelbase_m=st.floats(0.1, 2),
    ahead_m=st.floats(-1, 1),
)
def test_contacts_are_a_rectangle_that_turns_with_the_robot(
    pose: tuple[float, float, float],
    track_m: float,
    wheelbase_m: float,
    ahead_m: float,
) -> None:
    footprint = Footprint(track_m=track_m, wheelbase_m=wheelbase_m, ahead_m=ahead_m)
    contacts = footprint.contacts(torch.tensor(pose, dtype=torch.float64))
    x, y, heading = pose
    for side, across in enumerate((track_m / 2, -track_m / 2)):
        for end, along in enumerate((wheelbase_m / 2, -wheelbase_m / 2)):
            offset = complex(ahead_m + along, across) * complex(
                math.cos(heading), math.sin(heading)
            )
            expected = torch.tensor([x + offset.real, y + offset.imag])
            torch.testing.assert_close(
                contacts[side, end], expected.double(), atol=1e-6, rtol=0
            )
    centre = torch.tensor([x, y], dtype=torch.float64)
    distance = (contacts - centre).norm(dim=-1)
    assert float(distance.max()) == pytest.approx(footprint.radius_m)


def test_without_a_radius_a_map_is_unchanged() -> None:
    values = torch.rand(2, *GRID.shape)
    assert minimum_over_footprint(values, GRID, 0.0) is values


@pytest.mark.parametrize("radius_m", [0.05, 0.35, 0.5, 0.51, 0.72, 1.2])
def test_the_minimum_is_that_of_all_cells_that_contacts_can_reach(
    radius_m: float,
) -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(3, *GRID.shape, generator=generator)
    # By brute force: robots at many positions in a cell, contacts at many headings.
    inside = (np.arange(40) + 0.5) / 40 * GRID.resolution_m
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    x = inside[:, None, None] + radius_m * np.cos(angles)
    y = inside[None, :, None] + radius_m * np.sin(angles)
    columns = np.floor(x / GRID.resolution_m).astype(int)
    rows = np.floor(y / GRID.resolution_m).astype(int)
    columns, rows = np.broadcast_arrays(columns, rows)
    reached = {*zip(rows.ravel().tolist(), columns.ravel().tolist(), strict=True)}
    margin = max(max(map(abs, offset)) for offset in reached)
    footprint = np.zeros((2 * margin + 1, 2 * margin + 1), dtype=bool)
    for row, column in reached:
        footprint[margin + row, margin + column] = True
    # The disc includes what lies between the contacts.
    footprint |= _filled(footprint)
    for number, single in enumerate(values.numpy()):
        expected = minimum_filter(single, footprint=footprint, mode="constant", cval=0)
        found = minimum_over_footprint(values, GRID, radius_m)[number]
        assert np.array_equal(found.numpy(), expected)


def _filled(mask: np.ndarray) -> np.ndarray:
    """Return a mask with each row filled between its first and last cell."""
    filled = mask.copy()
    for row in filled:
        columns = np.flatnonzero(row)
        row[columns.min() : columns.max() + 1] = True
    return filled


def test_a_mask_is_eroded_as_its_numbers_are() -> None:
    generator = torch.Generator().manual_seed(1)
    mask = torch.rand(2, *GRID.shape, generator=generator) > 0.2
    numbers = minimum_over_footprint(mask.double(), GRID, 0.4)
    eroded = minimum_over_footprint(mask, GRID, 0.4)
    assert eroded.dtype == torch.bool
    assert torch.equal(eroded, numbers == 1)
    border = minimum_over_footprint(torch.ones(1, *GRID.shape), GRID, 0.4)
    assert not border[0, 0].any()
    assert border[0, 1:-1, 1:-1].all()


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_a_footprint_has_finite_lengths(value: float) -> None:
    with pytest.raises(ConfigError, match="`track_m` of a footprint > 0 and finite"):
        Footprint(track_m=value, wheelbase_m=0.5)
