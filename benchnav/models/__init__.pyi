from benchnav.models.base import ModelFamily, TraversabilityModel, predict
from benchnav.models.checkpoint import (
    Checkpoint,
    Part,
    load_checkpoint,
    save_checkpoint,
)
from benchnav.models.checkpoint_folders import find_checkpoint, list_checkpoints
from benchnav.models.config import TrainingConfig, TrainOptions
from benchnav.models.nets.trainable import TrainableModel
from benchnav.models.predictor import load_model
from benchnav.models.quality.measure import evaluate as evaluate_model
from benchnav.models.tiles import Window, measure_margin, predict_tiles, write_risk_maps
from benchnav.models.training.networks import fit_model

__all__ = [
    "Checkpoint",
    "ModelFamily",
    "Part",
    "TrainOptions",
    "TrainableModel",
    "TrainingConfig",
    "TraversabilityModel",
    "Window",
    "evaluate_model",
    "find_checkpoint",
    "fit_model",
    "list_checkpoints",
    "load_checkpoint",
    "load_model",
    "measure_margin",
    "predict",
    "predict_tiles",
    "save_checkpoint",
    "write_risk_maps",
]
