"""Optimism about ground that is not known: where the path leads, and what stays as it
was.
"""

from dataclasses import replace
from typing import Any

import networkx
import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.planning import AStarDWA
from benchnav.planning.objective import TravelTime
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.astar_dwa import AStarDWAConfig
from benchnav.planning.planners.astar.guided import optimistic
from benchnav.planning.planners.astar.waypoint import ground_costs
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from tests import factories
from tests.planning.planners.astar.test_astar import networkx_graph
from tests.planning.planners.driving import drive, first, generator

START, GOAL = (1.25, 6.0), (13.75, 6.0)
NAMES = ("astar_dwa", "astar_mppi")


def two_routes(std: float = 0.2) -> Problem:
    """A block between two ways of one mean λ: the upper is known and a little shorter,
    of the lower little is known.
    """
    mean, spread = torch.full((1, 24, 30), 0.5), torch.zeros(1, 24, 30)
    mean[:, 6:18, 8:22] = 0.05
    spread[:, :6] = std
    posed = factories.problem(mean, START, GOAL, objective=TravelTime(Unicycle(), 1.0))
    return replace(posed, distribution=factories.normal(mean, spread))


def planner(name: str, explore: float) -> Any:
    return registry.make("planner", {"part": name, "options": {"explore": explore}})


def rows_of_the_path(plan_state: Any, posed: Problem) -> Tensor:
    start = astar.cell_at(posed.grid, posed.start)
    return astar.path_cells(plan_state.field, start, 60)[0] // posed.grid.width


@pytest.mark.parametrize("name", NAMES)
def test_it_takes_the_way_that_may_be_good_where_it_explores_and_the_known_one_where_it_does_not(
    name: str,
) -> None:
    posed, ways = two_routes(), []
    for explore in (0.0, 0.5):
        rows = rows_of_the_path(planner(name, explore).init(posed, generator()), posed)
        assert bool((rows < 6).any()) != bool((rows > 17).any())
        ways.append("unknown" if bool((rows < 6).any()) else "known")
    assert ways == ["known", "unknown"]


def test_the_robot_drives_the_way_that_is_explored() -> None:
    posed = two_routes()
    for explore, side in ((0.0, 1), (0.5, -1)):
        driven = drive(planner("astar_dwa", explore), posed)
        away = driven.states[0, :, 1] - 6.0
        assert side * float(away[away.abs().argmax()]) > 3.0


def test_the_search_is_dijkstras_under_the_raised_map_and_free_ground_stays_what_it_is() -> (
    None
):
    generator_ = torch.Generator().manual_seed(3)
    mean, std = (torch.rand(2, 16, 12, generator=generator_) for _ in range(2))
    posed = factories.problem(
        mean, (1.25, 1.25), (4.25, 6.75), objective=TravelTime(Unicycle(), 1.0)
    )
    posed = replace(posed, distribution=factories.normal(mean, 0.3 * std))
    assert not posed.free.all()
    explore, ranks = 0.7, norm.ppf([0.16, 0.84])
    low, high = (np.clip(mean + 0.3 * std * rank, 0, 1) for rank in ranks)
    expected = (mean + explore * (high - low) / 2).clamp(max=1)
    assert float(expected.max()) == 1.0
    raised = replace(posed, risk_map=expected.float())
    field = planner("astar_dwa", explore).init(posed, generator()).field
    goals = {
        (i, j)
        for i in range(16)
        for j in range(12)
        if np.hypot(j / 2 + 0.25 - 4.25, i / 2 + 0.25 - 6.75) < 1
    }
    for b in range(2):
        costs = networkx.multi_source_dijkstra_path_length(
            networkx_graph(raised, b, True), goals
        )
        found = {
            (i, j): field.cost[b, i, j].item() for i in range(16) for j in range(12)
        }
        assert found == pytest.approx(costs, rel=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_way_point_rule_has_the_costs_of_the_path_and_the_local_planner_those_without_bonus(
    name: str,
) -> None:
    posed = two_routes()
    begun = planner(name, 0.5).init(posed, generator())
    raised = optimistic(posed, 0.5)
    assert torch.equal(begun.ground.traversability, ground_costs(raised).traversability)
    for own in (
        begun.local.problem,
        planner(name, 0.5).revise(begun, posed).local.problem,
    ):
        assert torch.equal(own.risk_map, posed.risk_map)
        assert torch.equal(own.free, posed.free)


@pytest.mark.parametrize("name", NAMES)
def test_without_it_all_is_as_it_was(name: str) -> None:
    posed = two_routes()
    assert optimistic(posed, 0.0) is posed
    plain, given = registry.make("planner", name), planner(name, 0.0)
    one, other = (
        each.plan(first(posed), each.init(posed, generator()))
        for each in (plain, given)
    )
    assert torch.equal(one[0], other[0])
    assert torch.equal(one[1].field.cost, astar.search(posed).cost)


@pytest.mark.parametrize("name", NAMES)
def test_it_searches_anew_where_what_is_unknown_has_changed_and_nowhere_else(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    once, nothing = two_routes(), two_routes(0.0)
    posed = once.select(torch.tensor([0, 0]))
    spreads = torch.cat((nothing.distribution.stds, once.distribution.stds))  # type: ignore[attr-defined]
    # The ground of the first map becomes known: λ̂ is what it was.
    known = replace(posed, distribution=replace(posed.distribution, stds=spreads))
    own = planner(name, 0.5)
    begun, searched, whole = own.init(posed, generator()), [], astar.search

    def search(problem: Problem, costs: Any = None) -> astar.CostToGo:
        searched.append(len(problem))
        return whole(problem, costs)

    monkeypatch.setattr(astar, "search", search)
    revised = own.revise(begun, known)
    assert searched == [1]
    anew = own.init(known, generator())
    assert torch.equal(revised.field.cost, anew.field.cost)
    assert torch.equal(revised.field.following, anew.field.following)
    assert not torch.equal(revised.field.cost[0], begun.field.cost[0])
    assert torch.equal(revised.ground.traversability, anew.ground.traversability)
    # Under the next revision the bonus is added to the map itself, not to what had it
    # already.
    again = own.revise(revised, known)
    assert searched == [1, 2]
    assert torch.equal(again.field.cost, anew.field.cost)
    assert bool((rows_of_the_path(revised, known) > 17).any())


def test_its_default_moves_no_id() -> None:
    def id_of(part: Any) -> str:
        suite = Suite(
            data="stakes-v1-test", model="stakes-v1", world="stakes", risks=("mean",), planners=(part,),
            objectives=("travel_time",),
        )  # fmt: skip
        (condition,) = conditions_of(suite, lambda data: ["std"])
        return condition.id

    # Of version 0.10.0, which had no such option.
    for name, known in (
        ("astar_dwa", "ba1ffcce827de18a"),
        ("astar_mppi", "df0e23bf97f58f6e"),
    ):
        assert id_of(name) == known
        assert id_of({"part": name, "options": {"explore": 0}}) == known
        assert id_of({"part": name, "options": {"explore": 0.5}}) != known


def test_pessimism_is_refused() -> None:
    with pytest.raises(ConfigError, match="explore"):
        AStarDWA(AStarDWAConfig(explore=-0.1))
