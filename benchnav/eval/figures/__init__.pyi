from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.shipped import figures_of

__all__ = ["RunData", "figures_of"]
