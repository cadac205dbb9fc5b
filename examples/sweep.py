"""Tune learning rate and width of the example's model with Optuna, and prune trials.

pip install optuna
python examples/sweep.py DATASET FOLDER [TRIALS]
"""

import sys
from pathlib import Path

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from benchnav.models import TrainOptions, fit_model, load_checkpoint

try:
    import optuna
except ImportError:
    sys.exit(
        "Expected optuna to be installed, got no such package. Run: pip install optuna"
    )

MODEL = Path(__file__).with_name("own_model.py")


class Prune(Callback):
    def __init__(self, trial: optuna.Trial) -> None:
        self.trial = trial

    def on_validation_epoch_end(
        self, trainer: Trainer, module: LightningModule
    ) -> None:
        self.trial.report(
            float(trainer.callback_metrics["valid_loss"]), trainer.current_epoch
        )
        if self.trial.should_prune():
            raise optuna.TrialPruned


def sweep(data: str, folder: Path, trials: int = 20) -> optuna.Study:
    def objective(trial: optuna.Trial) -> float:
        rate = trial.suggest_float("learning_rate", 1e-3, 5e-2, log=True)
        settings = {
            "learning_rate": rate,
            "hidden": trial.suggest_int("hidden", 4, 64, log=True),
            "batch_size": 4,
        }
        options = TrainOptions(trainer={"callbacks": Prune(trial)}, overwrite=True)
        out = folder / f"trial-{trial.number}"
        fit_model(options, f"{MODEL}:CellModel", data, str(out), settings)
        return load_checkpoint(out).parts["CellModel"].metrics["valid_loss"]

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
    study.optimize(objective, n_trials=trials)
    return study


if __name__ == "__main__":
    best = sweep(sys.argv[1], Path(sys.argv[2]), *map(int, sys.argv[3:4])).best_trial
    print(
        f"best Optuna trial: {best.number}, validation loss {best.value:.4f}, "
        f"{best.params}"
    )
