"""What Cai et al. measured.

Counted in the log of trials that they publish with their code, `mppi_benchmark/envs_40_trials_5_densities_4_
date_20220907-2234.pickle` in https://github.com/mit-acl/mppi_numba, method `risk_dyn`: λ̂ is the mean of the lowest
share α of the distribution, which is our `cvar:1 − α`; α = 1 is our `mean`.
"""

from dataclasses import dataclass

TRIALS = 200


@dataclass(frozen=True)
class Published:
    """200 trials of theirs.

    Args:
        successes: how many arrived within 15 s.
        time_s: mean time of those.
    """

    successes: int
    time_s: float


PUBLISHED = {
    (0.1, "mean"): Published(197, 7.30),
    (0.1, "cvar:0.4"): Published(198, 7.29),
    (0.1, "cvar:0.6"): Published(200, 7.29),
    (0.1, "cvar:0.8"): Published(200, 7.27),
    (0.4, "mean"): Published(138, 9.10),
    (0.4, "cvar:0.4"): Published(154, 9.03),
    (0.4, "cvar:0.6"): Published(189, 8.44),
    (0.4, "cvar:0.8"): Published(192, 8.64),
    (0.7, "mean"): Published(93, 10.79),
    (0.7, "cvar:0.4"): Published(102, 10.05),
    (0.7, "cvar:0.6"): Published(162, 10.02),
    (0.7, "cvar:0.8"): Published(170, 10.03),
    (1.0, "mean"): Published(40, 11.55),
    (1.0, "cvar:0.4"): Published(45, 11.75),
    (1.0, "cvar:0.6"): Published(197, 10.64),
    (1.0, "cvar:0.8"): Published(198, 10.71),
    (0.1, "cost"): Published(200, 7.06),
    (0.1, "cost-cvar:0.6"): Published(200, 7.27),
    (0.4, "cost"): Published(188, 7.95),
    (0.4, "cost-cvar:0.6"): Published(186, 8.15),
    (0.7, "cost"): Published(146, 9.22),
    (0.7, "cost-cvar:0.6"): Published(157, 9.48),
    (1.0, "cost"): Published(108, 10.61),
    (1.0, "cost-cvar:0.6"): Published(200, 10.39),
}

# Of each density the trials in which `cvar:0.8` alone arrived, and those in which `mean` alone did.
PUBLISHED_PAIRS = {0.1: (3, 0), 0.4: (60, 6), 0.7: (86, 9), 1.0: (159, 1)}
