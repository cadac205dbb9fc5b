"""Models of traversability: base classes, checkpoints, training and quality."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.models.base": ("ModelFamily", "TraversabilityModel", "predict"),
        "benchnav.models.config": ("TrainOptions", "TrainingConfig"),
        "benchnav.models.nets.trainable": ("TrainableModel",),
        "benchnav.models.training.networks": ("fit_model",),
        "benchnav.models.checkpoint": (
            "Checkpoint",
            "Part",
            "load_checkpoint",
            "save_checkpoint",
        ),
        "benchnav.models.checkpoint_folders": ("find_checkpoint", "list_checkpoints"),
        "benchnav.models.predictor": ("load_model",),
        "benchnav.models.quality.measure": ("evaluate as evaluate_model",),
        "benchnav.models.tiles": (
            "Window",
            "measure_margin",
            "predict_tiles",
            "write_risk_maps",
        ),
    },
)
