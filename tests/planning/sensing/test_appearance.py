from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.core.terrain import Observation, Terrain
from benchnav.datagen.files.stored_terrain import terrain_of
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.synth import elevation
from benchnav.datagen.synth.generate import generate
from benchnav.planning.sensing.appearance import Memory, model_input, remember
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.sensor import Appearance, Full, NoiseKey

MEANS = {
    "rgb": (10.4, 99.6, 200.5),
    "elevation_m": (1.75,),
    "slope_deg": (12.5,),
    "vegetation_m": (0.3,),
}


def terrain_from(recipe_id: str, maps: int = 3) -> Terrain:
    recipe = load_recipe(recipe_id)
    split = next(iter(recipe.splits))
    return terrain_of(generate(recipe, split, np.arange(maps)), recipe)


def appearance_of(
    terrain: Terrain, seen: Tensor, noise_level: float | Tensor = 0.0
) -> Appearance:
    doubts = (
        torch.full(seen.shape, noise_level)
        if isinstance(noise_level, float)
        else noise_level
    )
    return Appearance(seen=seen, observation=terrain.observe(), noise_level=doubts)


@pytest.mark.parametrize("recipe_id", ["tiny-v1", "stakes-v1", "vegetation-v1"])
def test_what_was_all_seen_without_noise_is_the_observation_bit_for_bit(
    recipe_id: str,
) -> None:
    terrain = terrain_from(recipe_id)
    states = torch.zeros(3, 3)
    sensed = Full().sense(
        terrain, terrain.traversability, states, NoiseKey((1, 2, 3), 0)
    )
    assert sensed.appearance is not None
    known = model_input(remember(Memory.empty(terrain), sensed.appearance), MEANS)
    truth = terrain.observe()
    for name in ("rgb", "elevation_m", "slope_deg"):
        assert torch.equal(getattr(known, name), getattr(truth, name))
        assert getattr(known, name).dtype == getattr(truth, name).dtype
    assert known.layers.keys() == truth.layers.keys() | {"seen"}
    for name, layer in truth.layers.items():
        assert torch.equal(known.layers[name].nan_to_num(-1), layer.nan_to_num(-1))
    assert (known.layers["seen"] == 1).all()


def test_a_clear_look_near_the_robot_is_the_observation_there() -> None:
    terrain = terrain_from("vegetation-v1")
    near = Near(range_m=4.0, colour_noise=0, elevation_noise=0)
    states = torch.tensor([[9.0, 9.0, 0.0], [1.0, 9.0, 0.0], [0.3, 0.2, 0.0]])
    memory = Memory.empty(terrain)
    for step in range(3):
        looked = near.sense(
            terrain, terrain.traversability, states + step, NoiseKey((1, 2, 3), step)
        ).appearance
        assert looked is not None
        memory = remember(memory, looked)
    known, truth, seen = model_input(memory, MEANS), terrain.observe(), memory.seen
    assert 0.01 < seen.double().mean() < 0.5
    assert torch.equal(known.layers["seen"], seen.float())
    assert torch.equal(known.rgb.movedim(1, -1)[seen], truth.rgb.movedim(1, -1)[seen])
    assert torch.equal(known.elevation_m[seen], truth.elevation_m[seen])
    assert torch.equal(
        known.layers["vegetation_m"][seen], truth.layers["vegetation_m"][seen]
    )
    inner = known.slope_deg != 12.5
    assert inner.double().mean() > 0.01
    assert torch.equal(known.slope_deg[inner], truth.slope_deg[inner])


@given(st.integers(0, 2**31), st.floats(0.5, 0.97))
@settings(deadline=None, max_examples=20)
def test_where_nothing_was_seen_are_the_training_means(seed: int, share: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    height, width = 9, 11
    grid = Grid(height, width, 0.5)
    seen = torch.rand(2, height, width, generator=generator) < share
    ground = torch.rand(2, height, width, generator=generator)
    memory = Memory(
        seen=seen,
        rgb=torch.full((2, 3, height, width), 7, dtype=torch.uint8),
        elevation_m=torch.where(seen, ground, torch.nan),
        layers={"vegetation_m": ground},
        noise_level=ground,
        grid=grid,
    )
    known = model_input(memory, MEANS)
    # halves go to the even number
    expected = torch.tensor([10, 100, 200], dtype=torch.uint8)
    assert (known.rgb.movedim(1, -1)[~seen] == expected).all()
    assert (known.rgb.movedim(1, -1)[seen] == 7).all()
    assert (known.elevation_m[~seen] == 1.75).all()
    assert torch.equal(known.elevation_m[seen], ground[seen])
    assert torch.equal(known.layers["vegetation_m"].isnan(), ~seen)
    assert torch.equal(known.layers["seen"], seen.float())
    slopes = elevation.inclination_deg(
        *elevation.horn_gradient(elevation.pad_missing(ground.double().numpy()), 0.5)
    )
    for own in range(2):
        for row in range(height):
            for column in range(width):
                around = seen[
                    own, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2
                ]
                right = slopes[own, row, column] if bool(around.all()) else 12.5
                assert float(known.slope_deg[own, row, column]) == pytest.approx(
                    right, abs=1e-3
                )


def test_of_two_looks_the_one_with_less_doubt_is_kept_and_of_equal_ones_the_earlier() -> (
    None
):
    terrain = terrain_from("vegetation-v1", 1)
    shape = terrain.elevation_m.shape

    def look(value: int, cells: slice, noise_level: float) -> Appearance:
        observation = Observation(
            rgb=torch.full_like(terrain.rgb, value),
            elevation_m=torch.full(shape, float(value)),
            slope_deg=torch.full(shape, torch.nan),
            grid=terrain.grid,
            layers={"vegetation_m": torch.full(shape, float(value))},
        )
        seen = torch.zeros(shape, dtype=torch.bool)
        seen[:, :, cells] = True
        return Appearance(
            seen=seen,
            observation=observation,
            noise_level=torch.full(shape, noise_level),
        )

    memory = before = Memory.empty(terrain)
    for value, cells, noise_level in (
        (1, slice(0, 4), 2.0),
        (2, slice(2, 6), 1.0),
        (3, slice(0, 8), 2.0),
        (4, slice(7, 9), torch.inf),
        (5, slice(0, 9), torch.inf),
    ):
        memory = remember(memory, look(value, cells, noise_level))
    expected = [1, 1, 2, 2, 2, 2, 3, 3, 4]
    assert memory.elevation_m[0, 5, :9].tolist() == expected
    assert memory.rgb[0, :, 5, :9].tolist() == [expected] * 3
    assert memory.layers["vegetation_m"][0, 5, :9].tolist() == expected
    assert memory.noise_level[0, 5, :9].tolist() == [2, 2, 1, 1, 1, 1, 2, 2, torch.inf]
    assert memory.seen[0, 5].tolist() == [True] * 9 + [False] * (shape[2] - 9)
    assert not before.seen.any()
    assert not before.rgb.any()


def test_memories_are_of_their_own_episodes() -> None:
    terrain = terrain_from("tiny-v1")
    seen = torch.zeros_like(terrain.elevation_m, dtype=torch.bool)
    for own in range(3):
        seen[own, : 4 * own + 4] = True
    memory = remember(Memory.empty(terrain), appearance_of(terrain, seen, 1.0))
    order = torch.tensor([2, 0])
    alone = remember(
        Memory.empty(terrain.select(order)),
        appearance_of(terrain.select(order), seen[order], 1.0),
    )
    some, same = model_input(memory.select(order), MEANS), model_input(alone, MEANS)
    for name in ("rgb", "elevation_m", "slope_deg"):
        assert torch.equal(getattr(some, name), getattr(same, name))
    kept = replace(memory, seen=torch.zeros_like(seen))
    assert (model_input(kept, MEANS).slope_deg == 12.5).all()
