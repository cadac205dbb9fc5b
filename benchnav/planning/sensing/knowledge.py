"""Knowledge of robots about their maps: observations, belief, λ̂ and free mask.

A belief that learns receives measured λ at each step. At some steps, the appearance
sensor also observes terrain. If it observed something new, the model predicts again.
Then the belief is updated. A `Learner` contains the sensors, the model and the belief;
a `Knowledge` contains their results so far. Only sensors and privileged models receive
the `Truth`.
Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of all maps
together.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch, find_tensor_fault
from benchnav.core.device import GPU_FAULTS
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import fault
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.sensing.appearance import Memory
from benchnav.planning.sensing.sensor import Measurement
from benchnav.planning.world.outcome import Outcome

_PESSIMISTIC_LEVEL = 0.8  # CVaR level of unobserved λ under `pessimistic`

Result = TypeVar("Result")


class KnowledgeError(BenchnavError):
    """Failure of a sensor, belief, model or risk measure during an episode.

    Attributes:
        outcome: outcome with which the episodes end; `__cause__` is the original
            exception.
    """

    def __init__(self, message: str, outcome: Outcome) -> None:
        """Store the message and the outcome of the episodes."""
        super().__init__(message)
        self.outcome = outcome


@dataclass(frozen=True, kw_only=True)
class Truth(Batch):
    """True state of the episodes; only sensors and privileged models receive it.

    Args:
        terrain: the B true maps.
        field: current λ of all cells, shape [B, H, W].
        keys: key of the random stream of each episode's sensor noise, length B.
    """

    terrain: Terrain
    field: Tensor
    keys: tuple[int, ...]

    def select(self, members: Tensor) -> "Truth":
        """Return the episodes at these indices (int64)."""
        keys = tuple(self.keys[index] for index in members.tolist())
        return replace(super().select(members), keys=keys)

    def put(self, members: Tensor, others: "Truth") -> "Truth":
        """Return a copy in which the episodes at these indices (int64) are replaced."""
        keys = list(self.keys)
        for index, key in zip(members.tolist(), others.keys, strict=True):
            keys[index] = key
        return replace(super().put(members, others), keys=tuple(keys))


@dataclass(frozen=True, kw_only=True)
class Knowledge(Batch):
    """Knowledge of the robots in B episodes.

    Args:
        memory: observed appearance; None if the whole map was observed at the start.
        has_new_appearance: mask of episodes with appearance that the prediction does
            not yet include, newly observed or less noisy than before, bool, shape [B].
        sensed: λ measured since the last update; if a cell was measured more than once,
            its last measurement.
        ever_sensed: mask of cells whose λ was measured in the episode, bool, shape
            [B, H, W].
        footprint: mask of cells that any sensor observed in the last step, bool, shape
            [B, H, W].
        observation: the model's last input.
        belief_state: state of the belief.
        risk_map: λ̂, shape [B, H, W].
        spread: half of the range from the 16 % to the 84 % quantile of λ under the
            belief, shape [B, H, W]; None if it is not stored.
        free: mask of free cells, before the cells around the goal are set free, bool,
            shape [B, H, W].
    """

    memory: Memory | None
    has_new_appearance: Tensor
    sensed: Measurement
    ever_sensed: Tensor
    footprint: Tensor
    observation: Observation
    belief_state: Any
    risk_map: Tensor
    spread: Tensor | None
    free: Tensor

    @property
    def seen(self) -> Tensor:
        """Mask of observed cells, bool, shape [B, H, W]."""
        if self.memory is None:
            return torch.ones_like(self.free)
        return self.memory.seen


def prior_of_unobserved(
    statistics: GroundStatistics, unseen: str, shape: torch.Size, like: Tensor
) -> TraversabilityMixture:
    """Return the distribution of λ that is assumed for unobserved terrain.

    Args:
        statistics: statistics of the training maps.
        unseen: assumption, as in `Rules.unseen`: `prior` for the distribution over all
            training maps, `optimistic` for λ = 1, or `pessimistic` for the CVaR of that
            distribution.
        shape: shape of the result, [B, H, W].
        like: tensor whose dtype and device the result takes.
    """
    prior = statistics.mixture(shape, like)
    if unseen == "prior":
        return prior
    value = 1.0
    if unseen == "pessimistic":
        single_cell = statistics.mixture((1, 1, 1), like.double())
        value = float(single_cell.cvar(_PESSIMISTIC_LEVEL))
    means = torch.full_like(prior.means[:, :1], value)
    return TraversabilityMixture(torch.ones_like(means), means, torch.zeros_like(means))


def no_measurement(like: Tensor) -> Measurement:
    """Return a measurement of no cell.

    Args:
        like: tensor whose shape [B, H, W], dtype and device the result takes.
    """
    unmeasured = torch.full_like(like, torch.nan)
    return Measurement(traversability=unmeasured, std=torch.ones_like(unmeasured))


def sensor_keys(noise_key: int, maps: Any) -> tuple[int, ...]:
    """Return the key of the random stream of each episode's sensor noise.

    Args:
        noise_key: root key of the world's noise.
        maps: integer that identifies each episode's stream, B of them; in an
            evaluation, the index of its map.
    """
    return tuple(rng.stream_key(noise_key, "sensor", int(index)) for index in maps)


def check_map(name: str, values: Any, dtype: torch.dtype, like: Tensor) -> None:
    """Check a map's dtype, shape and device.

    Args:
        name: name of the map for the message.
        values: the map; any type.
        dtype: expected dtype.
        like: tensor of the expected shape and device.

    Raises:
        ConfigError: If the map is not a tensor of this dtype, shape and device.
    """
    fault_text = find_tensor_fault(name, values, dtype, tuple(like.shape), like.device)
    if fault_text:
        raise ConfigError(fault_text)


def call_user_code(outcome: Outcome, work: Callable[[], Result]) -> Result:
    """Call a function that may run user code, and convert its exceptions.

    Args:
        outcome: outcome with which the episodes end if the function fails.
        work: the function, without arguments.

    Raises:
        KnowledgeError: If `work` raises anything but a GPU fault.
    """
    try:
        return work()
    except GPU_FAULTS:
        raise
    except (Exception, SystemExit) as error:
        raise KnowledgeError(fault(error), outcome) from error
