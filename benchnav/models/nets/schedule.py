"""The optimiser of both networks and its schedule."""

import lightning
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler

_WARM_UP_SHARE = 0.15


def one_cycle(
    module: lightning.LightningModule, learning_rate: float, weight_decay: float
) -> OptimizerLRScheduler:
    """AdamW under a one-cycle schedule over all steps of a training (Smith and Topin, 2018).

    Args:
        module: what is trained, attached to its trainer.
        learning_rate: the highest.
        weight_decay: of AdamW.
    """
    # Under mixed precision the fused kind unscales gradients by itself, and Lightning would not clip them.
    fused = not module.trainer.gradient_clip_val
    optimizer = torch.optim.AdamW(module.parameters(), learning_rate, weight_decay=weight_decay, fused=fused)
    steps = int(module.trainer.estimated_stepping_batches)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, learning_rate, total_steps=max(steps, 2), pct_start=_WARM_UP_SHARE
    )
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
