import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from benchnav.core import registry, rng
from benchnav.core.errors import ConfigError
from benchnav.core.terrain import Terrain
from benchnav.datagen.synth.elevation import fractal
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.sensor import Appearance, NoiseKey
from tests.planning.sensing import made

KEYS = (21, 22, 23)
CLEAR = Near(colour_noise=0, elevation_noise=0)


def ground(elevation_m: Tensor, resolution_m: float = 0.5) -> Terrain:
    """Grey ground with a layer, of elevation [B, H, W]."""
    batch, height, width = elevation_m.shape
    truth = made.mixture(batch, height, width)
    terrain = made.terrain(truth, torch.zeros(batch, height, width), resolution_m)
    generator = torch.Generator().manual_seed(1)
    vegetation = torch.rand(elevation_m.shape, generator=generator)
    return replace(
        terrain,
        rgb=torch.full_like(terrain.rgb, 120),
        elevation_m=elevation_m.float(),
        layers={"vegetation_m": vegetation},
    )


def look(
    near: Near, terrain: Terrain, *states: tuple[float, ...], step: int = 3
) -> Appearance:
    noise_key = NoiseKey(KEYS[: len(states)], step)
    sensed = near.sense(
        terrain,
        terrain.traversability,
        torch.tensor(states, dtype=torch.float64),
        noise_key,
    )
    assert sensed.appearance is not None
    assert not sensed.mask.any()
    return sensed.appearance


def centred(row: int, column: int, heading: float = 0.0) -> tuple[float, float, float]:
    return (column + 0.5) * 0.5, (row + 0.5) * 0.5, heading


def offsets(shape: torch.Size, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """From a place to the centre of each cell, metres."""
    rows, columns = np.indices(shape[-2:])
    return (columns + 0.5) * 0.5 - x, (rows + 0.5) * 0.5 - y


def beside(shape: torch.Size, x: float, y: float) -> np.ndarray:
    """The cell of a place and its neighbours."""
    rows, columns = np.indices(shape[-2:])
    return np.maximum(abs(rows - y // 0.5), abs(columns - x // 0.5)) <= 1


@pytest.mark.parametrize("range_m", [0.2, 1.4, 3.0, 40.0])
def test_on_flat_ground_a_disc_is_seen_and_what_is_beside_the_robot(
    range_m: float,
) -> None:
    terrain = ground(torch.zeros(2, 14, 18))
    places = ((2.45, 3.2, 0.4), (8.9, 0.1, -2.0))
    seen = look(replace(CLEAR, range_m=range_m), terrain, *places).seen
    for own, (x, y, _) in enumerate(places):
        expected = np.hypot(*offsets(seen.shape, x, y)) <= range_m
        np.testing.assert_array_equal(seen[own], expected | beside(seen.shape, x, y))


@pytest.mark.parametrize("fov_deg", [20.0, 90.0, 200.0, 359.0, 360.0])
@pytest.mark.parametrize("heading", [0.3, 3.0, -9.0])
def test_the_field_of_view_is_centred_on_the_heading(
    fov_deg: float, heading: float
) -> None:
    terrain, x, y = ground(torch.zeros(1, 20, 18)), 4.4, 4.7
    seen = look(
        replace(CLEAR, range_m=3.0, fov_deg=fov_deg), terrain, (x, y, heading)
    ).seen[0]
    to_x, to_y = offsets(seen.shape, x, y)
    away = np.hypot(to_x, to_y)
    within = (
        to_x * np.cos(heading) + to_y * np.sin(heading)
        >= away * np.cos(np.radians(fov_deg / 2)) - 1e-12
    )
    np.testing.assert_array_equal(
        seen, (within & (away <= 3.0)) | beside(seen.shape, x, y)
    )


@pytest.mark.parametrize(
    ("wall_m", "height_m"), [(0.3, 1.0), (0.61, 1.0), (1.2, 1.0), (0.61, 30.0)]
)
@pytest.mark.parametrize("turned", [False, True])
def test_a_wall_hides_what_is_under_the_line_from_the_mast_over_it(
    wall_m: float, height_m: float, turned: bool
) -> None:
    elevation, ahead = torch.full((1, 40, 31), 5.0), 4
    elevation[0, 10 + ahead] += wall_m
    place = (10, 15)
    if turned:
        elevation, place = elevation.mT, (15, 10)
    near = replace(CLEAR, range_m=50.0, height_m=height_m)
    seen = look(near, ground(elevation), centred(*place)).seen[0]
    seen = seen.T if turned else seen
    rows = torch.arange(40)[:, None] - 10
    over = height_m * (1 - ahead / rows.clamp(min=1)) >= wall_m
    assert torch.equal(seen, ((rows <= ahead) | over).expand_as(seen))


@given(
    st.floats(-1, 1),
    st.floats(-1, 1),
    st.floats(0.05, 5),
    st.integers(0, 15),
    st.integers(0, 17),
)
@settings(deadline=None, max_examples=30)
def test_a_plane_hides_nothing(
    along_x: float, along_y: float, height_m: float, row: int, column: int
) -> None:
    to_x, to_y = offsets(torch.Size((1, 16, 18)), 0.0, 0.0)
    plane = ground(torch.from_numpy(along_x * to_x + along_y * to_y)[None])
    assert look(
        replace(CLEAR, range_m=50.0, height_m=height_m), plane, centred(row, column)
    ).seen.all()


def hills(batch: int, size: int, relief_m: float) -> Tensor:
    surface = fractal(rng.stream_key(4, "hills"), np.arange(batch), (size, size), 0.8)
    return torch.from_numpy(relief_m * surface)


def test_line_of_sight_is_nearly_that_of_rays_over_ground_between_the_centres_of_cells() -> (
    None
):
    size, height_m, places = 40, 1.0, [(20, 20), (4, 33), (30, 2)]
    elevation = hills(3, size, 4.0)
    states = [centred(*place) for place in places]
    seen = look(
        replace(CLEAR, range_m=50.0, height_m=height_m), ground(elevation), *states
    ).seen
    agrees, shares = [], []
    for own, (row, column) in enumerate(places):
        z = elevation[own].float().double()
        expected = torch.ones(size, size, dtype=torch.bool)
        for i in range(size):
            for j in range(size):
                steps = max(abs(i - row), abs(j - column))
                part = torch.arange(1, max(steps, 1), dtype=torch.float64) / max(
                    steps, 1
                )
                at_row, at_column = row + part * (i - row), column + part * (j - column)
                least, left = at_row.floor().long(), at_column.floor().long()
                below, right = (
                    (at_row - 1e-9).ceil().long(),
                    (at_column - 1e-9).ceil().long(),
                )
                up = torch.lerp(z[least, left], z[least, right], at_column - left)
                down = torch.lerp(z[below, left], z[below, right], at_column - left)
                between = torch.lerp(up, down, at_row - least)
                mast = z[row, column] + height_m
                expected[i, j] = bool((between <= mast + part * (z[i, j] - mast)).all())
        agrees.append((expected == seen[own]).double().mean())
        shares.append(expected.double().mean())
    assert 0.2 < np.mean(shares) < 0.8
    assert np.mean(agrees) > 0.97


@given(st.integers(0, 2**31), st.floats(0.2, 3), st.floats(20, 360), st.floats(1, 20))
@settings(deadline=None, max_examples=30)
def test_what_is_seen_hangs_on_nothing_but_the_ground_that_is_seen(
    seed: int, height_m: float, fov_deg: float, range_m: float
) -> None:
    generator = torch.Generator().manual_seed(seed)
    elevation = hills(1, 24, 5.0) + 0.3 * torch.rand(1, 24, 24, generator=generator)
    near = Near(range_m=range_m, height_m=height_m, fov_deg=fov_deg)
    x, y, heading = (
        torch.rand(3, generator=generator) * torch.tensor([12.0, 12.0, 6.0])
    ).tolist()
    first = look(near, ground(elevation), (x, y, heading))
    sunk = elevation - torch.where(
        first.seen, 0, 4 * torch.rand(1, 24, 24, generator=generator)
    )
    again = look(near, ground(sunk), (x, y, heading))
    assert torch.equal(first.seen, again.seen)
    assert torch.equal(
        first.observation.elevation_m.nan_to_num(-99),
        again.observation.elevation_m.nan_to_num(-99),
    )


def test_ground_out_of_view_hides_nothing() -> None:
    elevation = torch.zeros(1, 21, 21)
    elevation[0, :, :8] = 9.0
    ahead = look(replace(CLEAR, fov_deg=90.0), ground(elevation), centred(10, 10, 0.0))
    assert ahead.seen.sum() > 20
    assert not ahead.seen[0, :, :8].any()
    assert look(CLEAR, ground(elevation), centred(10, 10)).seen[0, :, 7].any()


def test_robots_off_the_map_see_nothing_and_borders_do_not_join() -> None:
    terrain = ground(torch.zeros(3, 12, 12))
    states = ((-0.1, 3.0, 0.0), (0.1, 0.1, 0.0), (3.0, math.nan, 0.0))
    seen = look(replace(CLEAR, range_m=1.0), terrain, *states).seen
    assert seen[1, :3, :3].sum() == seen[1].sum() > 0
    assert not seen[[0, 2]].any()


def test_noise_is_normal_and_grows_with_distance() -> None:
    terrain, (x, y, _) = ground(torch.full((1, 24, 24), 7.0)), centred(11, 12)
    near = Near(range_m=6.0, colour_noise=3.0, elevation_noise=0.02)
    looks = [look(near, terrain, (x, y, 0.0), step=step) for step in range(300)]
    seen = looks[0].seen[0]
    away = torch.from_numpy(np.hypot(*offsets(seen.shape, x, y)))[seen]
    torch.testing.assert_close(looks[0].noise_level[0][seen], away.float())
    assert (looks[0].noise_level[0][~seen] == math.inf).all()
    heights = (
        torch.stack([each.observation.elevation_m[0][seen] for each in looks]).double()
        - 7
    )
    colours = (
        torch.stack([each.observation.rgb[0][:, seen] for each in looks]).double() - 120
    )
    for low, high in ((0.4, 2.0), (2.0, 4.0), (4.0, 6.0)):
        far = (away > low) & (away <= high)
        noise = heights[:, far] / away[far]
        assert float(noise.std()) == pytest.approx(0.02, rel=0.02)
        assert abs(float(noise.mean())) < 0.02 * 4 / math.sqrt(noise.numel())
        for channel in colours.unbind(1):
            expected = (9 * away[far] ** 2 + 1 / 12).mean().sqrt()  # and of rounding
            assert float(channel[:, far].square().mean().sqrt()) == pytest.approx(
                float(expected), rel=0.02
            )
    together = (
        torch.cat((colours, heights[:, None]), 1)[..., away > 2]
        .movedim(1, 0)
        .flatten(1)
    )
    assert (torch.corrcoef(together) - torch.eye(4)).abs().max() < 0.02
    # Nor are cells alike, nor steps.
    scores = heights[:, away > 0] / away[away > 0]
    for one, other in ((scores[:, :-1], scores[:, 1:]), (scores[:-1], scores[1:])):
        assert abs(float((one * other).mean())) < 0.02 * 0.02 * 0.03


def test_defaults_keep_slopes_of_half_a_metre_usable_at_8_m() -> None:
    # Of Horn's gradient: √12 / 8 of the noise of a cell, by the cell's size.
    noise = math.sqrt(12) / 8 * Near().elevation_noise * 8 / 0.5
    assert math.degrees(math.atan(noise)) < 1


def test_colours_stay_colours_and_nothing_is_told_of_cells_that_are_not_seen() -> None:
    terrain = ground(hills(1, 20, 5.0))
    rgb = terrain.rgb.clone()
    rgb[:, 0], rgb[:, 1] = 255, 0
    terrain = replace(terrain, rgb=rgb)
    appearance = look(Near(range_m=6.0, colour_noise=20.0), terrain, centred(9, 9))
    seen, observation = appearance.seen, appearance.observation
    assert 0 < seen.sum() < seen.numel()
    red, green, _ = observation.rgb.movedim(1, -1)[seen].T.double()
    assert 180 < red.mean() < 255
    assert 0 < green.mean() < 75
    vegetation = observation.layers["vegetation_m"]
    assert torch.equal(vegetation[seen], terrain.layers["vegetation_m"][seen])
    assert vegetation[~seen].isnan().all()
    assert observation.elevation_m[~seen].isnan().all()
    assert not observation.rgb.movedim(1, -1)[~seen].any()
    clear = look(replace(CLEAR, range_m=6.0), terrain, centred(9, 9)).observation
    assert torch.equal(clear.rgb.movedim(1, -1)[seen], rgb.movedim(1, -1)[seen])
    assert torch.equal(clear.elevation_m[seen], terrain.elevation_m[seen])


def test_noise_is_of_the_episode_the_cell_and_the_step_alone() -> None:
    terrain = ground(hills(3, 20, 1.0))
    states = (centred(3, 4), centred(10, 9), centred(18, 2))

    def elevations(
        near: Near, members: list[int], step: int = 3, keys: tuple[int, ...] = KEYS
    ) -> Tensor:
        some = terrain.select(torch.tensor(members))
        state = torch.tensor([states[own] for own in members])
        noise_key = NoiseKey([keys[own] for own in members], step)
        found = near.sense(some, some.traversability, state, noise_key).appearance
        assert found is not None
        return found.observation.elevation_m

    every = elevations(Near(range_m=3.0), [0, 1, 2])
    known = ~every.isnan()
    assert torch.equal(elevations(Near(range_m=5.0), [0, 1, 2])[known], every[known])
    order = elevations(Near(range_m=3.0), [2, 0])
    assert torch.equal(order.nan_to_num(-9), every[[2, 0]].nan_to_num(-9))
    away = known & (every != terrain.elevation_m)
    assert (
        elevations(Near(range_m=3.0), [0, 1, 2], step=4)[away] != every[away]
    ).double().mean() > 0.99
    other = elevations(Near(range_m=3.0), [0, 1, 2], keys=(21, 5, 23))
    changed = (other.nan_to_num(-9) != every.nan_to_num(-9)).flatten(1).any(1)
    assert changed.tolist() == [False, True, False]


@pytest.mark.parametrize(
    "wrong",
    [
        {"range_m": 0.0},
        {"range_m": math.inf},
        {"fov_deg": 0.0},
        {"fov_deg": 361.0},
        {"height_m": 0.0},
        {"colour_noise": -1.0},
        {"elevation_noise": math.nan},
    ],
)
def test_cameras_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Near(**wrong)


def test_near_is_known_by_name_and_its_first_option_is_its_range() -> None:
    assert registry.make("sensor", "near:4") == Near(range_m=4.0)
