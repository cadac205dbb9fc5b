"""How large a run, a product of settings and an episode may be; nothing of what is
larger is built.
"""

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.registry import Part
from benchnav.eval.experiment.suite import (
    MAX_CONDITIONS,
    MAX_EPISODES,
    MAX_UNITS,
    Suite,
    check_size,
)
from benchnav.eval.experiment.sweep import each_mapping, each_part
from benchnav.planning.world.world import MAX_STEPS, World


def test_a_run_has_up_to_so_many_episodes_and_units() -> None:
    check_size(1000, 10, 10, MAX_EPISODES // 10**5, 1000)
    check_size(100, 1, 10_000, 50, 50)
    for given in (
        (1000, 10, 10, MAX_EPISODES // 10**5 + 1, 10**4),
        (100, 1, 10_000, 51, 50),
        (MAX_UNITS + 1, 1, 1, 1),
    ):
        with pytest.raises(
            ConfigError, match="at most 100,000,000 episodes in 1,000,000 units"
        ):
            check_size(*given)


def test_a_suite_is_refused_from_its_numbers() -> None:
    assert Suite(realisations=MAX_UNITS, maps=1).realisations == MAX_UNITS
    for changes in (
        {"realisations": 10**9},
        {"maps": 10**9},
        {"realisations": MAX_UNITS, "seeds": (1, 2), "maps": 0},
    ):
        with pytest.raises(ConfigError, match="units"):
            Suite(**changes)


def test_a_product_is_refused_from_the_lengths_of_its_lists() -> None:
    numbers = list(range(1, 1001))
    assert len(each_mapping({"a": numbers, "b": [1, 2]})) == 2000
    with pytest.raises(ConfigError, match="List fewer"):
        each_part(
            "planner",
            Part(
                part="mppi",
                label="mppi",
                options={"samples": [*range(1, MAX_CONDITIONS + 2)]},
            ),
        )
    with pytest.raises(
        ConfigError, match=r"got 1000 × 1000 × 1000\. List fewer values"
    ):
        each_mapping({"a": numbers, "b": {"c": numbers}, "d": numbers, "e": [1]})


@pytest.mark.parametrize("time_budget_s", [1e6, 1e300])
def test_an_episode_has_an_end(time_budget_s: float) -> None:
    world, budget = World(), torch.tensor([1.0, MAX_STEPS * 0.1], dtype=torch.float64)
    assert world.steps(budget, 0.1).tolist() == [10, MAX_STEPS]
    with pytest.raises(ConfigError, match="at most 1,000,000 time steps"):
        world.steps(torch.tensor([time_budget_s], dtype=torch.float64), 0.1)
