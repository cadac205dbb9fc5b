"""A custom robot and objective; `benchnav.testing` has `check_robot` and `check_objective` to test them.

benchnav-eval run --robots '[examples/own_robot.py:Tracked]' --objectives '[examples/own_robot.py:Energy]' \
  --planners '[straight,astar_dwa,mppi]' --risks '[mean]' --out runs/tracked
"""

from dataclasses import dataclass

from benchnav.planning import Objective, Unicycle, distance


@dataclass(frozen=True, kw_only=True)
class Tracked(Unicycle):
    """Tracked vehicle: a unicycle whose turn rate is scaled by λ to the power of `turn_loss`."""

    speed_mps: tuple[float, float] = (-0.3, 0.8)
    turn_loss: float = 2.0

    def __call__(self, state, action, traversability):
        turning = traversability.clamp(min=0.05) ** (self.turn_loss - 1)
        # Only ω of the action (v, ω) is scaled further.
        slowed = action * turning[..., None] ** action.new_tensor([0.0, 1.0])
        return super().__call__(state, slowed, traversability)


@dataclass(frozen=True, kw_only=True)
class Energy(Objective):
    """Distance to the goal plus the energy that slipping tracks waste; A* minimises `path_cost`."""

    waste: float = 2.0

    def stage(self, state, action, traversability, target):
        return distance(state, target) + self.waste * action[..., 0].abs() * (
            1 - traversability
        )

    def terminal(self, state, traversability, target):
        return distance(state, target)

    def path_cost(self, traversability, grade):
        return 1 + self.waste * (1 / traversability - 1)
