"""The base class of figures: an object that says what it needs, what it shows, and draws it.

A figure knows no path and writes nothing. `data` is one value for all figures of a kind; for those of runs it is
`benchnav.eval.figures.RunData`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    import matplotlib.figure


class Figure(ABC):
    """A figure.

    Attributes:
        name: of its files.
        title: heading over it on a page; if empty, none.
        trim: whether white borders are cut away, as of maps, which keep their shape.
    """

    name: str = ""
    title: str = ""
    trim: bool = False

    def variants(self, data: Any) -> Sequence[Self]:
        """Return the figures to draw, each with a name of its own: itself where `needs` is met, else none."""
        return [self] if self.needs(data) else []

    def needs(self, data: Any) -> bool:
        """Return whether the data hold what it draws."""
        return True

    @abstractmethod
    def caption(self, data: Any) -> str:
        """Return what it shows, in sentences."""

    @abstractmethod
    def draw(self, data: Any) -> "matplotlib.figure.Figure":
        """Return the drawing; sizes, colours and names are in `benchnav.viz`."""

    def __call__(self, data: Any) -> "matplotlib.figure.Figure":
        """Draw it in the style of all figures."""
        from benchnav.viz.style import styled

        with styled():
            return self.draw(data)
