"""Figures are saved as publishers ask."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from benchnav import drawing
from tests.conftest import SAVED


def test_fonts_are_embedded_as_truetype_and_not_as_type_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "_SAVED", SAVED)
    figure = Figure()
    figure.text(0.5, 0.5, "λ")
    drawing.save(figure, tmp_path / "figure.pdf", "pdf")
    saved = (tmp_path / "figure.pdf").read_bytes()
    assert b"/CIDFontType2" in saved
    assert b"/FontFile2" in saved
    assert b"/Type3" not in saved
