import pytest

from benchnav.errors import ConfigError
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.world.world import PRESETS, World


def test_the_papers_world() -> None:
    paper = PRESETS["paper"]
    assert paper.world == World(noise="resampled", time_budget_s=100.0)
    assert paper.rules == Rules(free_space=FreeSpace(by="risk", above=0.3), slowest=0.3, goal_radius_m=1.0)


@pytest.mark.parametrize(("budget", "dt", "steps"), [(100.0, 0.1, 1000), (0.3, 0.1, 3), (1.0, 0.3, 3)])
def test_the_time_budget_in_steps(budget: float, dt: float, steps: int) -> None:
    assert World(time_budget_s=budget).steps(dt) == steps


@pytest.mark.parametrize("budget", [0.0, -1.0, float("inf"), float("nan")])
def test_a_time_budget_that_is_none_is_refused(budget: float) -> None:
    with pytest.raises(ConfigError, match="time_budget_s"):
        World(time_budget_s=budget)


def test_a_time_budget_without_a_step_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"at least one time step of 0.1 s, got 0.01"):
        World(time_budget_s=0.01).steps(0.1)


def test_noise_of_another_name_is_refused_and_the_old_name_told() -> None:
    with pytest.raises(ConfigError, match="got 'frozen', which is now 'stored'"):
        World(noise="frozen")
    with pytest.raises(ConfigError, match="'resampled' or 'stored', got 'loud'"):
        World(noise="loud")
