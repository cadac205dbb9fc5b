"""Environments of robots with a footprint, in a world whose sides slip apart."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.env.egocentric_batch import EgocentricBatch
from benchnav.planning.footprint import minimum_over_footprint
from benchnav.planning.robots import SkidSteer
from benchnav.planning.sensing.sensor import Contact
from benchnav.planning.world.tracks import TrackState

TRACKS = {"preset": "stakes", "backend": "tracks", "lag_s": 0.5}


def batch_of(dataset_path: Path, robot: str = "skid_steer") -> EgocentricBatch:
    return EgocentricBatch(
        2,
        data=dataset_path,
        split="test/std",
        robot=robot,
        world=TRACKS,
        model="oracle",
    )


def test_robots_keep_their_wheel_speeds_when_others_begin(dataset_path: Path) -> None:
    batch = batch_of(dataset_path)
    generators = [np.random.default_rng(seed) for seed in (1, 2)]
    batch.reset(generators, np.array([True, True]), None)
    action = np.array([[1.0, 0.2], [0.5, 0.0]], np.float32)
    for _ in range(4):
        batch.step(action)
    _, before = batch._current()
    batch.reset(generators, np.array([False, True]), None)
    _, after = batch._current()
    assert isinstance(before, TrackState)
    assert isinstance(after, TrackState)
    assert torch.equal(after.velocity[0], before.velocity[0])
    assert float(before.velocity[1, 0]) > 0
    assert after.velocity[1].tolist() == [0, 0]
    assert torch.equal(after.state[0], before.state[0])


def test_policies_see_inflated_maps_of_draws_with_room(dataset_path: Path) -> None:
    batch = batch_of(dataset_path)
    generators = [np.random.default_rng(seed) for seed in (1, 2)]
    batch.reset(generators, np.array([True, True]), None)
    radius_m = SkidSteer().footprint.radius_m
    assert batch._world.clearance_m == radius_m
    assert batch._experience._learner.ground == Contact().mounted(SkidSteer())
    raw = batch._experience._current().risk_map
    expected = minimum_over_footprint(raw, batch._maps.grid, radius_m)
    assert torch.equal(batch._experience.map_knowledge.risk_map, expected)


def test_a_point_is_refused_at_the_door(dataset_path: Path) -> None:
    with pytest.raises(ConfigError, match="a robot with a footprint"):
        batch_of(dataset_path, robot="unicycle")
