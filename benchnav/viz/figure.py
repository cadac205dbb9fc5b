"""The base class of figures: an object that says what it needs, what it shows, and
draws it.

A figure knows no path and writes nothing. `data` is one value for all figures of a
kind; for those of runs it is `benchnav.eval.figures.RunData`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, Any, Self

from benchnav.core.specified import Specified

if TYPE_CHECKING:
    import matplotlib.figure


class Figure(Specified, ABC):
    """A figure.

    Attributes:
        name: of its files.
        title: heading over it on a page; if empty, none.
        text: what it shows, in sentences, where that is the same for all data.
        trim: whether white borders are cut away, as of maps, which keep their shape.
    """

    name: str = ""
    title: str = ""
    text: str = ""
    trim: bool = False

    def variants(self, data: Any) -> Sequence[Self]:
        """Return the figures to draw, each with a name of its own: itself where `needs`
        is met, else none.
        """
        return [self] if self.needs(data) else []

    def variant(self, **changes: Any) -> Self:
        """Return a copy with other attributes, such as its `name`."""
        made = copy(self)
        vars(made).update(changes)
        return made

    def numbered(self, count: int) -> list[Self]:
        """Return so many variants with their `place`, named with a number from 1 where
        there are several.
        """
        names = (
            [self.name]
            if count == 1
            else [f"{self.name}-{number}" for number in range(1, count + 1)]
        )
        return [
            self.variant(place=place, name=name) for place, name in enumerate(names)
        ]

    def needs(self, data: Any) -> bool:
        """Return whether the data hold what it draws."""
        return True

    def caption(self, data: Any) -> str:
        """Return what it shows, in sentences; `text` unless it depends on the data."""
        return self.text

    @abstractmethod
    def draw(self, data: Any) -> "matplotlib.figure.Figure":
        """Return the drawing; sizes, colours and names are in `benchnav.viz`."""

    def __call__(self, data: Any) -> "matplotlib.figure.Figure":
        """Draw it in the style of all figures."""
        from benchnav.viz.style import styled

        with styled():
            drawing = self.draw(data)
        # Notebooks show an object by this method, whatever backend is active.
        vars(drawing)["_repr_png_"] = partial(_png, drawing)
        return drawing


def _png(drawing: "matplotlib.figure.Figure") -> bytes:
    image = BytesIO()
    drawing.savefig(image, format="png", dpi=150, bbox_inches="tight")
    return image.getvalue()


def applicable(figures: Sequence[Figure], data: Any) -> list[Figure]:
    """List the figures whose needs the data meet, in all their variants."""
    return [variant for figure in figures for variant in figure.variants(data)]
