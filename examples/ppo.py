"""Train a policy with PPO of stable-baselines3 in `benchnav/OffRoad-v1`; plan with it.

    benchnav-datagen create stakes-v1 --splits '[train]' --first 64 --out datasets/stakes-train.h5
    python examples/ppo.py datasets/stakes-train.h5 ppo.zip --steps 100000
    benchnav-eval run --data stakes-v1 --model stakes-v1 --planners '[straight,examples/ppo.py:Policy]' --out runs/ppo

`Batched` passes all sub-environments to stable-baselines3 as one batch. A step of 16
sub-environments then takes a tenth of the time that it takes one after another.
"""

import argparse

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import benchnav  # noqa: F401 - registers the environment
from benchnav.env import PolicyPlanner

# Model and risk setting of the robot; evaluate the policy with the same ones.
KNOWS = {"model": "stakes-v1", "risk": "expected-time"}


class Batched(VecEnv):
    """Vector environment for stable-baselines3, which resets episodes when they end."""

    def __init__(self, count: int, **settings) -> None:
        self.envs = gymnasium.make_vec(
            "benchnav/OffRoad-v1", num_envs=count, **settings
        )
        self.actions = None
        super().__init__(
            count, self.envs.single_observation_space, self.envs.single_action_space
        )

    def reset(self):
        seen, info = self.envs.reset(seed=self._seeds[0])
        self.reset_infos = self.each(info)
        self._reset_seeds()
        return seen

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self):
        seen, reward, terminated, truncated, info = self.envs.step(self.actions)
        ended, infos = terminated | truncated, self.each(info)
        for i in np.flatnonzero(ended):
            infos[i]["terminal_observation"] = {
                name: values[i] for name, values in seen.items()
            }
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        if ended.any():
            seen, fresh = self.envs.reset(options={"reset_mask": ended})
            for i in np.flatnonzero(ended):
                self.reset_infos[i] = self.each(fresh)[i]
        return seen, reward.astype(np.float32), ended, infos

    def each(self, info: dict[str, np.ndarray]) -> list[dict]:
        return [
            {name: values[i] for name, values in info.items()}
            for i in range(self.num_envs)
        ]

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError(
            "Expected no call of `set_attr`, since the sub-environments are one batch. "
            "Pass settings to `Batched`."
        )

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise NotImplementedError(
            "Expected no call of `env_method`, since the sub-environments are one "
            "batch. Call methods of `Batched.envs`."
        )

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self):
        return self.envs.render()


class Looks(BaseFeaturesExtractor):
    """Features of a policy: a small convolutional network on the crop, and the state."""

    def __init__(self, observation_space, width: int = 128) -> None:
        super().__init__(observation_space, width + observation_space["state"].shape[0])
        layers = []
        for inner, outer in ((4, 16), (16, 32), (32, 32)):
            layers += [
                torch.nn.Conv2d(inner, outer, 3, stride=2, padding=1),
                torch.nn.ReLU(),
            ]
        self.crop = torch.nn.Sequential(
            *layers, torch.nn.Flatten(), torch.nn.LazyLinear(width), torch.nn.ReLU()
        )
        self.crop(torch.zeros(1, *observation_space["crop"].shape))

    def forward(self, seen):
        return torch.cat((self.crop(seen["crop"]), seen["state"]), dim=1)


class Policy(PolicyPlanner):
    """Planner that follows a trained policy."""

    def __init__(self, path: str = "ppo.zip") -> None:
        policy = PPO.load(path, device="cpu").policy
        super().__init__(
            lambda seen: policy.predict(seen, deterministic=True)[0],
            normalised_actions=True,
        )


def train(
    data: str, out: str, steps: int, count: int = 32, seed: int = 0, rollout: int = 128
) -> PPO:
    envs = VecMonitor(
        Batched(count, data=data, world="stakes", normalised_actions=True, **KNOWS)
    )
    ppo = PPO(
        "MultiInputPolicy",
        envs,
        n_steps=rollout,
        batch_size=512,
        gamma=0.995,
        learning_rate=3e-4,
        seed=seed,
        device="cpu",
        verbose=1,
        policy_kwargs={"features_extractor_class": Looks},
    )
    ppo.learn(steps)
    ppo.save(out)
    return ppo


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", help="dataset with the split train")
    parser.add_argument("out", help="file for the policy, .zip")
    parser.add_argument(
        "--steps", type=int, default=100_000, help="number of training steps"
    )
    arguments = parser.parse_args()
    train(arguments.data, arguments.out, arguments.steps)
