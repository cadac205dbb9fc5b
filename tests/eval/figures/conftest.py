"""Figures are drawn in their style, as `Figure` objects and reports draw them."""

from collections.abc import Iterator

import pytest

from benchnav.viz.style import styled


@pytest.fixture(autouse=True)
def style() -> Iterator[None]:
    with styled():
        yield
