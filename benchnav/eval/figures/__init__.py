"""Figures of a run: one module per figure, each an object that is drawn from `RunData`.

`figures_of` lists the figures of a run: first the shipped ones, then custom ones.
"""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.eval.figures.data": ("RunData",),
        "benchnav.eval.figures.shipped": ("figures_of",),
        "benchnav.eval.figures.waterfall": ("Waterfall",),
    },
)
