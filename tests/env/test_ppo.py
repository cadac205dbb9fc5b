"""The example for stable-baselines3."""

import runpy
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from benchnav.testing import check_planner

EXAMPLE = Path(__file__).parents[2] / "examples" / "ppo.py"
SETTINGS: dict[str, Any] = {
    "split": "train", "world": {"preset": "stakes", "time_budget_s": 0.8}, "normalised_actions": True,
    "model": "oracle",
}  # fmt: skip


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLE))


def test_the_batch_is_what_environments_one_after_the_other_are(
    example: dict[str, Any], dataset_path: Path
) -> None:
    given = {**SETTINGS, "data": dataset_path, "ground": "probe", "belief": "copula"}
    batch = example["Batched"](3, **given)
    from stable_baselines3.common.vec_env import DummyVecEnv

    single = DummyVecEnv([lambda: gymnasium.make("benchnav/OffRoad-v1", **given)] * 3)
    for envs in (batch, single):
        envs.seed(5)
    found, wanted = batch.reset(), single.reset()
    generator, ended = np.random.default_rng(0), 0
    for _ in range(20):
        for name, values in wanted.items():
            np.testing.assert_allclose(found[name], values, atol=2e-5)
        actions = generator.uniform(-1, 1, (3, 2)).astype(np.float32)
        (found, *told), (wanted, *meant) = batch.step(actions), single.step(actions)
        np.testing.assert_allclose(told[0], meant[0], atol=1e-6)
        np.testing.assert_array_equal(told[1], meant[1])
        for own, other in zip(told[2], meant[2], strict=True):
            assert ("terminal_observation" in own) == ("terminal_observation" in other)
            assert own["distance_m"] == pytest.approx(other["distance_m"])
            if "terminal_observation" in own:
                ended += 1
                assert own["TimeLimit.truncated"] == other["TimeLimit.truncated"]
                for name, values in other["terminal_observation"].items():
                    np.testing.assert_allclose(
                        own["terminal_observation"][name], values, atol=2e-5
                    )
    assert ended == 6


def test_ppo_trains_and_its_policy_is_a_planner(
    example: dict[str, Any],
    dataset_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(example["train"].__globals__, "KNOWS", {"model": "oracle"})
    monkeypatch.setattr(
        example["Batched"], "__init__", _short(example["Batched"].__init__)
    )
    path = tmp_path / "ppo.zip"
    ppo = example["train"](str(dataset_path), str(path), steps=64, count=4, rollout=16)
    assert ppo.num_timesteps == 64
    assert ppo.ep_info_buffer
    check_planner(
        {"part": f"{EXAMPLE}:Policy", "options": {"path": str(path)}},
        robots=["unicycle"],
    )


def _short(init: Any) -> Any:
    def wrapped(self: Any, count: int, **settings: Any) -> None:
        init(self, count, **{**settings, **SETTINGS})

    return wrapped
