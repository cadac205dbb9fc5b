import json

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.settings import of, read
from benchnav.planning.free_space import FreeSpace, Immobile, Rules
from benchnav.planning.world.world import PRESETS, World, read_world, split_label


def test_the_papers_world() -> None:
    paper = PRESETS["paper"]
    assert paper.world == World(noise="resampled", time_budget_s=100.0)
    assert paper.rules == Rules(
        free_space=FreeSpace(by="risk", above=0.3),
        min_traversability=0.3,
        goal_radius_m=1.0,
    )


def test_the_world_with_stakes() -> None:
    stakes = PRESETS["stakes"]
    assert stakes.world == World(
        noise="frozen", correlation_m=1.5, immobile=Immobile(below=0.1, for_s=2.0), time_budget_s=None,
        time_budget_ratio=3.0,
    )  # fmt: skip
    assert stakes.rules == Rules(
        free_space=FreeSpace(by="mean", above=0.1),
        min_traversability=0.05,
        goal_radius_m=1.0,
    )


def test_a_time_budget_is_in_seconds_or_in_reference_times_at_top_speed() -> None:
    reference = torch.tensor([20.0, 30.0])
    assert World(time_budget_s=50.0).budget_s(reference, 2.0).tolist() == [50, 50]
    ratio = World(time_budget_s=None, time_budget_ratio=3.0)
    assert ratio.budget_s(reference, 2.0).tolist() == [30, 45]
    assert ratio.budget_s(reference, 1.0).tolist() == [60, 90]
    with pytest.raises(ConfigError, match="does not require solvable maps"):
        ratio.budget_s(torch.tensor([20.0, torch.nan]), 1.0)
    for both in ({}, {"time_budget_s": None}):
        world = {"time_budget_ratio": 3.0 if not both else None, **both}
        with pytest.raises(
            ConfigError, match="exactly one of `time_budget_s` and `time_budget_ratio`"
        ):
            World(**world)


@pytest.mark.parametrize("world", [preset.world for preset in PRESETS.values()])
def test_a_world_is_plain_data_and_back(world: World) -> None:
    assert (
        read(
            World,
            {"time_budget_s": None} | json.loads(json.dumps(world.to_dict())),
            of("world"),
        )
        == world
    )


def test_what_the_noise_does_not_use_is_not_in_the_plain_data() -> None:
    assert World().to_dict() == {"noise": "resampled", "time_budget_s": 100.0}
    assert World(correlation_m=2.0).to_dict() == World().to_dict()
    frozen = World(noise="frozen", correlation_m=2.0)
    assert frozen.to_dict() == {
        "noise": "frozen",
        "correlation_m": 2.0,
        "time_budget_s": 100.0,
    }
    assert World(kernel="matern32").to_dict() == World().to_dict()


def test_a_kernel_is_in_the_plain_data_where_it_is_not_that_of_all_worlds_before() -> (
    None
):
    rough = World(noise="frozen", kernel="matern32")
    assert rough.to_dict()["kernel"] == "matern32"
    assert read(World, rough.to_dict(), of("world")) == rough
    assert (
        read_world({"preset": "stakes", "kernel": "gaussian"})[0].to_dict()
        == read_world("stakes")[0].to_dict()
    )
    made, _, label = read_world({"preset": "stakes", "kernel": "matern32"})
    assert made.kernel == "matern32"
    assert label == "stakes kernel=matern32"
    with pytest.raises(
        ConfigError,
        match=r"`world.noise` 'frozen' with `world.kernel`, got 'resampled'",
    ):
        read_world({"kernel": "matern32"})
    with pytest.raises(
        ConfigError, match="`kernel` 'gaussian' or 'matern32', got 'cubic'"
    ):
        World(kernel="cubic")


@pytest.mark.parametrize(
    ("budget", "dt", "steps"), [(100.0, 0.1, 1000), (0.3, 0.1, 3), (1.0, 0.3, 3)]
)
def test_the_time_budget_in_steps(budget: float, dt: float, steps: int) -> None:
    assert World().steps(torch.tensor([budget, 2 * budget]), dt)[0] == steps


@pytest.mark.parametrize("budget", [0.0, -1.0, float("inf"), float("nan")])
def test_a_time_budget_that_is_none_is_refused(budget: float) -> None:
    with pytest.raises(ConfigError, match="time_budget_s"):
        World(time_budget_s=budget)
    with pytest.raises(ConfigError, match="time_budget_ratio"):
        World(time_budget_s=None, time_budget_ratio=budget)


def test_a_time_budget_without_a_step_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"at least 0.1 s .one time step., got 0.01"):
        World().steps(torch.tensor([9.0, 0.01]), 0.1)


def test_noise_of_another_name_and_numbers_out_of_range_are_refused() -> None:
    with pytest.raises(
        ConfigError, match="'resampled', 'stored' or 'frozen', got 'loud'"
    ):
        World(noise="loud")
    with pytest.raises(ConfigError, match="correlation_m"):
        World(correlation_m=-1.0)
    for wrong in (
        {"below": 0.0},
        {"below": 1.1},
        {"for_s": 0.0},
        {"for_s": float("inf")},
    ):
        with pytest.raises(ConfigError, match=f"immobile.{next(iter(wrong))}"):
            Immobile(**wrong)


def test_a_label_is_split_into_world_and_rules() -> None:
    for world in ("stakes", {"preset": "stakes", "correlation_m": 3.0}):
        plain_label = read_world(world)[2]
        for task, changes in (
            ({}, ""),
            ({"goal_radius_m": 2.0}, "goal_radius_m=2"),
            (
                {"free_space": {"by": "risk", "above": 0.2}, "replan_every_s": 1.0},
                "by=risk above=0.2 replan_every_s=1",
            ),
        ):
            _, rules, label = read_world(world, task)
            assert split_label(label, rules) == (plain_label, changes)
    assert split_label("a label of a user", read_world("stakes")[1])[1] == ""
