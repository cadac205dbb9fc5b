"""The base class of figures, which draw `data` and describe the drawing in a caption.

A figure does not write files. All figures of a kind have the same type of `data`; for
figures of runs, it is `benchnav.eval.figures.RunData`.
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


_DPI = 200  # default resolution of a saved figure, in dots per inch


class Figure(Specified, ABC):
    """A figure, which checks whether it applies to some data, and draws them.

    Attributes:
        name: name of the figure's files, without a suffix.
        title: heading above the figure on a page; if empty, there is no heading.
        text: caption in sentences, if it does not depend on the data.
        trim: whether to cut white borders, as for maps, whose aspect ratio is fixed.
    """

    name: str = ""
    title: str = ""
    text: str = ""
    trim: bool = False

    def variants(self, data: Any) -> Sequence[Self]:
        """Return the figures to draw, with distinct names; by default, only this one."""
        return [self] if self.is_available(data) else []

    def variant(self, **changes: Any) -> Self:
        """Return a copy with changed attributes, such as `name`."""
        variant = copy(self)
        vars(variant).update(changes)
        return variant

    def numbered(self, count: int) -> list[Self]:
        """Return `count` variants, whose attribute `index` counts from 0.

        If there are several variants, their names end in a number, from 1.
        """
        if count == 1:
            return [self.variant(index=0)]
        return [
            self.variant(index=index, name=f"{self.name}-{index + 1}")
            for index in range(count)
        ]

    def is_available(self, data: Any) -> bool:
        """Return whether the data contain what the figure shows."""
        return True

    def caption(self, data: Any) -> str:
        """Return the caption in sentences; by default, `text`."""
        return self.text

    @abstractmethod
    def draw(self, data: Any) -> "matplotlib.figure.Figure":
        """Draw the figure; `benchnav.viz` has sizes, colours and names to use."""

    def __call__(self, data: Any) -> "matplotlib.figure.Figure":
        """Draw the figure in the common style."""
        from benchnav.viz.style import styled

        with styled():
            drawing = self.draw(data)
        drawing.set_dpi(_DPI)
        # Notebooks call this method to show an object, with any Matplotlib backend.
        vars(drawing)["_repr_png_"] = partial(_png, drawing)
        return drawing


def _png(drawing: "matplotlib.figure.Figure") -> bytes:
    image = BytesIO()
    drawing.savefig(image, format="png", bbox_inches="tight")
    return image.getvalue()


def applicable(figures: Sequence[Figure], data: Any) -> list[Figure]:
    """Return all variants of the figures that apply to the data."""
    return [variant for figure in figures for variant in figure.variants(data)]
