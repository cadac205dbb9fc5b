from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.shipped import figures_of
from benchnav.eval.figures.waterfall import Waterfall

__all__ = ["RunData", "Waterfall", "figures_of"]
