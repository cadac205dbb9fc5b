"""Values that recordings keep of bodies: closed forms on planes, and the round trip."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchnav.eval.experiment.suite import Suite
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.folder.run_folder import EPISODES, read_table
from benchnav.eval.recording import read_recordings
from benchnav.eval.run.recordings import record_driven
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, build
from tests.planning.world.physics.worlds import (
    CENTRE,
    ENTRAPMENT,
    ROBOT,
    drive,
    simulation,
    uniform,
)

RADIUS_M = 0.165
# Ruts grow on all cells of the small dataset.
PHYSICS = {"entrapment": {"firm": 1.5, "sinkage": 0.5}}


@pytest.mark.parametrize("slope_deg", [0.0, 12.0])
def test_a_body_lies_on_the_plane_on_which_its_wheels_stand(slope_deg: float) -> None:
    # Uphill, downhill, and across; on soft cells, so that there are ruts.
    headings = (0.0, 180.0, 90.0)
    sim = simulation(uniform([0.1] * 3), ENTRAPMENT, slope_deg=slope_deg)
    driven = drive(sim, headings, (1.0, 0.0), steps=30)
    drawn = {name: value.numpy() for name, value in sim.drawn(driven.last).items()}
    normal = np.array([-math.sin(math.radians(slope_deg)), 0, 0])
    normal[2] = math.cos(math.radians(slope_deg))
    contact = drawn["wheels_m"] - RADIUS_M * normal
    np.testing.assert_allclose(contact[..., :2], drawn["contacts_m"], atol=2e-3)
    rise = math.tan(math.radians(slope_deg)) * (contact[..., 0] - CENTRE)
    np.testing.assert_allclose(contact[..., 2], rise, atol=2e-3)
    rotation = Rotation.from_quat(np.roll(drawn["rotation"], -1, axis=1))
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    np.testing.assert_allclose(rotation.apply(up), np.tile(normal, (3, 1)), atol=0.01)
    # In the body's axes, wheels are where the footprint has its contacts.
    offsets = drawn["wheels_m"] - drawn["position_m"][:, None]
    origin = torch.zeros(1, 3)
    corners = {
        tuple(p) for p in ROBOT.footprint.contacts(origin).flatten(0, 2).tolist()
    }
    for episode in range(3):
        local = rotation[episode].inv().apply(offsets[episode])
        np.testing.assert_allclose(local[:, 2], 0, atol=1e-6)
        assert {tuple(p) for p in local[:, :2].round(6).tolist()} == corners
    np.testing.assert_array_equal(drawn["wheel_radius_m"], np.full((3, 4), RADIUS_M))
    np.testing.assert_array_equal(drawn["ruts_m"], driven.last.memory[:, 6:10])
    assert drawn["ruts_m"].max() > 0.005


@pytest.mark.parametrize(
    ("robot", "changes", "names"),
    [
        ("unicycle", {}, set()),
        ("skid_steer", {}, {"contacts_m"}),
        ("skid_steer", {"backend": "tracks"}, {"contacts_m"}),
        (
            "skid_steer",
            {"backend": "physics", "physics": PHYSICS},
            {"contacts_m", "position_m", "rotation", "wheels_m", "wheel_radius_m", "ruts_m"},
        ),
    ],
)  # fmt: skip
def test_a_recording_has_the_values_of_the_simulation_at_each_step(
    robot: str,
    changes: dict[str, Any],
    names: set[str],
    dataset_path: Path,
    tmp_path: Path,
) -> None:
    world = {"preset": "stakes", "immobile": None, "time_budget_s": 5.0} | changes
    suite = Suite(
        data=str(dataset_path),
        scenarios=("std",),
        model="oracle",
        planners=("straight",),
        robots=(robot,),
        world=world,
        maps=2,
        record="all",
    )
    folder = tmp_path / "run"
    for _ in run_suite(suite, folder, say=lambda line: None):
        pass
    recordings = read_recordings(folder)
    ((unit, _),) = find_episodes(folder, {}, None, 0, 0)
    assert unit.maps == (0, 1)
    inputs = build(unit, Settings().origins().of(unit))
    sim = inputs.simulation
    n_steps = [len(recording.actions) for recording in recordings]
    assert max(n_steps) > 20
    actions = np.zeros((2, max(n_steps), 2), np.float32)
    for recording, padded in zip(recordings, actions, strict=True):
        padded[: len(recording.actions)] = recording.actions
    now = sim.init(inputs.problem.start)
    for step in range(max(n_steps) + 1):
        drawn = sim.drawn(now)
        assert drawn.keys() == names
        for member, recording in enumerate(recordings):
            assert recording.body.keys() == names
            for name, values in drawn.items():
                assert len(recording.body[name]) == n_steps[member] + 1
                if step <= n_steps[member]:
                    expected = values[member].float().numpy()
                    np.testing.assert_array_equal(recording.body[name][step], expected)
        if step < max(n_steps):
            now, _ = sim.step(now, torch.from_numpy(actions[:, step]))
    if "ruts_m" in names:
        assert max(recording.body["ruts_m"].max() for recording in recordings) > 0.01
    # From stored steps, only a level footprint is known.
    rows = read_table(folder, EPISODES)
    for recording, again in zip(recordings, record_driven(folder, rows), strict=True):
        assert again.body.keys() == names & {"contacts_m"}
        for name, values in again.body.items():
            expected = recording.body[name]
            atol = 1e-5
            if "ruts_m" in names:
                # Bodies have their front wheels first, footprints their left contacts.
                expected = expected[:, [0, 2, 1, 3]]
                atol = 0.05
            np.testing.assert_allclose(values, expected, atol=atol)
