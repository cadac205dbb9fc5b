"""Figures of a run: one file a figure, each an object that is drawn from `RunData`.

`figures_of` lists those that a run has; a user's own stand after the shipped ones.
"""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.eval.figures.data": ("RunData",),
        "benchnav.eval.figures.shipped": ("figures_of",),
    },
)
