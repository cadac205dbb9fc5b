import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import pytest
import torch
import torch._dynamo.config
import torch._inductor.config

from benchnav.planning.free_space import Immobile
from benchnav.planning.objective import Objective
from benchnav.planning.planners import compilation
from benchnav.planning.planners.astar.astar_dwa import AStarDWA, AStarDWAConfig
from benchnav.planning.planners.astar.dwa import DWAConfig
from benchnav.planning.planners.compilation import Fused, worth_compiling
from benchnav.planning.planners.mppi import MPPI
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.belief import CovarianceModel, Fields, Static
from tests import factories
from tests.planning.planners.driving import first, generator

CPU = torch.device("cpu")
MANY = 5000, 2000
FEW = 100, 2000


def scaled(x: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    assert compiling() or eager.append(x.shape) is None
    return (x * factor + 1).sin()


eager: list[torch.Size] = []
"""Shapes for which `scaled` ran as Python."""
compiling = torch.compiler.is_compiling


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    eager.clear()
    with torch._dynamo.config.patch(
        disable=False
    ):  # `make test` turns compiling off elsewhere
        yield


def inputs(columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.linspace(0, 1, 3 * columns).reshape(3, columns), torch.tensor(2.0)


def test_what_is_worth_compiling_depends_on_rollouts_and_device_alone() -> None:
    assert worth_compiling(5000, 2000, CPU)
    assert worth_compiling(2000, 2000, CPU)
    assert not worth_compiling(1999, 2000, CPU)
    assert worth_compiling(10, 2000, torch.device("cuda"))


def test_more_shapes_than_pytorch_allows_stay_compiled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The limit is the tracer's, so that no C++ need be compiled.
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    limit = torch._dynamo.config.recompile_limit
    fused = Fused(scaled, *MANY)
    assert fused.compiled is None
    for columns in range(1, limit + 3):
        x, factor = inputs(columns)
        torch.testing.assert_close(fused(x, factor), (x * 2 + 1).sin())
        assert fused.compiled is True
    assert eager == []


def test_few_samples_run_eagerly() -> None:
    fused = Fused(scaled, *FEW)
    fused(*inputs(40))
    assert fused.compiled is False
    assert len(eager) == 1


def test_pytorchs_own_switch_turns_it_off() -> None:
    fused = Fused(scaled, *MANY)
    with torch._dynamo.config.patch(disable=True):
        fused(*inputs(41))
    assert fused.compiled is False
    assert len(eager) == 1


def uncompilable(x: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    if x.sum().item() > 1e9:
        return x
    return x * factor


def test_what_cannot_be_compiled_runs_eagerly_and_leaves_all_else_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    hopeless, fine = Fused(uncompilable, *MANY), Fused(scaled, *MANY)
    x, factor = inputs(42)
    for _ in range(2):
        torch.testing.assert_close(hopeless(x, factor), 2 * x)
    assert hopeless.compiled is False
    said = capsys.readouterr().err
    assert (
        said.count(
            "benchnav: compilation failed, so rollouts run uncompiled and several times slower: "
        )
        == 1
    )
    fine(x, factor)
    assert fine.compiled is True
    assert eager == []
    another = Fused(uncompilable, *MANY)
    another(x, factor)
    assert another.compiled is False


def test_without_a_compiler_it_runs_eagerly(capsys: pytest.CaptureFixture[str]) -> None:
    fused = Fused(scaled, *MANY)
    x, factor = inputs(43)
    with torch._inductor.config.patch(
        {
            "cpp.cxx": ("no-such-compiler",),
            "force_disable_caches": True,
            "cpp_wrapper": False,
        }
    ):
        torch.testing.assert_close(fused(x, factor), (x * 2 + 1).sin())
    assert fused.compiled is False
    assert "uncompiled" in capsys.readouterr().err


def test_a_mistake_in_the_function_is_raised_as_it_is() -> None:
    def mistaken(x: torch.Tensor) -> torch.Tensor:
        raise ValueError("not today")

    with pytest.raises(ValueError, match="not today"):
        Fused(mistaken, *MANY)(torch.zeros(3))


def settings() -> dict[str, Any]:
    dynamo = torch._dynamo.config
    return {
        "limits": (dynamo.recompile_limit, dynamo.accumulated_recompile_limit),
        "flags": (dynamo.fail_on_recompile_limit_hit, dynamo.suppress_errors),
        "notices": logging.getLogger("torch.utils.cpp_extension").level,
        "threads": torch.get_num_threads(),
    }


def test_no_setting_of_pytorch_is_left_changed() -> None:
    notices = logging.getLogger("torch.utils.cpp_extension")
    notices.setLevel(logging.DEBUG)
    before = settings()
    during: list[dict[str, Any]] = []

    def look(x: torch.Tensor) -> torch.Tensor:
        during.append(settings())
        return x

    fused = Fused(scaled, *MANY)
    fused(*inputs(44))
    Fused(uncompilable, *MANY)(*inputs(44))
    assert settings() == before
    fused._fused = look  # type: ignore[assignment]
    fused(torch.zeros(1))
    assert during[0]["limits"] == (sys.maxsize, sys.maxsize)
    assert during[0]["flags"] == (True, False)
    assert during[0]["notices"] == logging.ERROR
    # What is compiled already needs none of it.
    fused(torch.zeros(1))
    assert during[1] == settings() == before
    notices.setLevel(logging.NOTSET)


# --- In MPPI.

SMALL = MPPIConfig(samples=64, horizon_s=0.4)


class Doubtful(Objective):
    """An objective that looks at a number, which nothing compiled can do."""

    def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
        return traversability if state.sum() > 0 else 2 * traversability

    def terminal(self, state, traversability, target):  # type: ignore[no-untyped-def]
        return traversability


def test_compiled_and_eager_planners_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = 0.35 + 0.6 * torch.rand(2, 16, 20, generator=generator())
    problem = factories.problem(maps)
    uncompilable_problem = factories.problem(maps, objective=Doubtful())
    actions = []
    for worth in (False, True):
        monkeypatch.setattr(
            compilation, "worth_compiling", lambda *_, worth=worth: worth
        )
        planner = MPPI(SMALL)
        assert planner.compiled is None
        action, state, _ = planner.plan(
            first(problem), planner.init(problem, generator())
        )
        actions.append(torch.cat((action, state.mean.flatten(1)), dim=1))
        assert planner.compiled is worth
    torch.testing.assert_close(actions[0], actions[1], atol=1e-4, rtol=1e-4)
    doubtful, other = MPPI(SMALL), MPPI(SMALL)
    doubtful.plan(first(problem), doubtful.init(uncompilable_problem, generator()))
    assert doubtful.compiled is False
    action, state, _ = other.plan(first(problem), other.init(problem, generator()))
    assert other.compiled is True
    assert torch.equal(action, actions[1][:, :2])


def test_compiled_and_eager_rollouts_on_fields_agree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With risk on the cost, rollouts that stop for good, and A*'s cost to go."""
    maps = 0.02 + 0.9 * torch.rand(2, 16, 20, generator=generator())
    known = factories.normal(maps, torch.full_like(maps, 0.05))
    belief = Static()
    source = Fields(
        belief,
        belief.init(
            known, CovarianceModel(grid=factories.problem(maps).grid, correlation_m=1.0)
        ),
        (7, 3),
    )
    problem = replace(
        factories.problem(maps),
        distribution=known,
        fields=source,
        immobile=Immobile(below=0.3, for_s=0.2),
    )
    config = MPPIConfig(
        samples=64,
        horizon_s=0.4,
        risk_on="cost",
        level=0.5,
        fields=20,
        entrapment=True,
        cost_to_go="map",
    )
    actions = []
    for worth in (False, True):
        monkeypatch.setattr(
            compilation, "worth_compiling", lambda *_, worth=worth: worth
        )
        planner = MPPI(config)
        action, state, _ = planner.plan(
            first(problem), planner.init(problem, generator())
        )
        actions.append(torch.cat((action, state.mean.flatten(1)), dim=1))
        assert planner.compiled is worth
    torch.testing.assert_close(actions[0], actions[1], atol=1e-4, rtol=1e-4)


def test_a_unit_of_three_episodes_and_one_of_twenty_agree_on_compiling() -> None:
    planner = MPPI(MPPIConfig(samples=1000, horizon_s=0.2))
    for batch in (3, 20, 200):
        problem = factories.problem(torch.full((batch, 16, 16), 0.8))
        planner.plan(first(problem), planner.init(problem, generator()))
        assert planner.compiled is False


def test_one_function_serves_any_number_of_episodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    fused = Fused(scaled, *MANY, batched=(0,))
    traced, real = [], compilation._compiling
    monkeypatch.setattr(
        compilation,
        "_compiling",
        lambda checked: traced.append(checked) or real(checked),
    )
    factor = torch.tensor(2.0)
    for rows in (7, 3, 1, 20, 1):
        x = torch.rand(rows, 46, generator=generator())
        torch.testing.assert_close(fused(x, factor), (2 * x + 1).sin())
    assert traced == [False, False]  # of several episodes, and of one
    assert eager == []


@pytest.mark.parametrize("name", ["mppi", "astar_dwa"])
def test_a_solve_is_the_same_compiled_and_eager_alone_and_in_a_batch_on_one_thread_and_two(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = 0.35 + 0.6 * torch.rand(3, 24, 20, generator=generator())
    problem = factories.problem(maps, start=(1.25, 1.25), goal=(8.25, 9.25))
    monkeypatch.setattr(compilation, "worth_compiling", lambda *_: compiled)
    few, short = (
        MPPIConfig(samples=300, horizon_s=0.4),
        AStarDWAConfig(dwa=DWAConfig(horizon_s=0.4)),
    )
    found: dict[tuple[bool, int, int], torch.Tensor] = {}
    threads = torch.get_num_threads()
    for compiled in (False, True):
        for count in (1, 2):
            for episodes in (3, 1):
                torch.set_num_threads(count)
                planner: Any = MPPI(few) if name == "mppi" else AStarDWA(short)
                posed = problem.select(torch.arange(episodes))
                action, _, _ = planner.plan(
                    first(posed), planner.init(posed, generator())
                )
                assert planner.compiled is compiled
                found[compiled, count, episodes] = action
    torch.set_num_threads(threads)
    for action in found.values():
        torch.testing.assert_close(
            action, found[False, 1, 3][: len(action)], atol=1e-4, rtol=0
        )


def test_another_mode_of_pytorch_is_compiled_for_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    fused, factor = Fused(scaled, *MANY, batched=(0,)), torch.tensor(2.0)
    with torch.inference_mode():
        fused(torch.rand(50, 47), factor)
    for rows in range(49, 30, -1):
        x = torch.rand(rows, 47)
        torch.testing.assert_close(fused(x, factor), (2 * x + 1).sin())
    assert fused.compiled is True
    assert eager == []


def test_indices_of_users_parts_stay_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    told, real = [], compilation._compiling
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    monkeypatch.setattr(
        compilation, "_compiling", lambda checked: told.append(checked) or real(checked)
    )
    problem = factories.problem(torch.full((2, 16, 20), 0.8))
    for robot in (
        problem.robot,
        type("Mine", (type(problem.robot),), {"__module__": "mine"})(),
    ):
        posed = replace(problem, task=replace(problem.task, robot=robot))
        planner = MPPI(MPPIConfig(samples=2000, horizon_s=0.2))
        planner.plan(first(posed), planner.init(posed, generator()))
    # The rollouts, whose arguments the robot is one of, and what weighs them.
    assert told == [False, False, True, False]


def test_a_robot_without_a_hash_is_compiled_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Listed(Unicycle):
        gears: list[float] = field(default_factory=lambda: [1.0])

    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    problem = factories.problem(torch.full((2, 16, 20), 0.8), robot=Listed())
    planner = MPPI(MPPIConfig(samples=2000, horizon_s=0.2))
    state = planner.init(problem, generator())
    for _ in range(2):
        _, state, _ = planner.plan(first(problem), state)
    assert planner.compiled is True
