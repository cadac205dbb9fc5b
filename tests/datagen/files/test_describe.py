from pathlib import Path

import pytest

from benchnav.datagen.files.describe import describe, tables, written
from benchnav.datagen.files.reader import TerrainDataset
from tests.factories import tiny_dataset

LONG = "test/a-scenario-of-many-letters"


def test_digests_stand_in_one_column_whatever_the_names_of_splits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    described = describe(TerrainDataset(path))
    described["splits"][LONG] = described["splits"]["train"]
    lines = [
        line
        for line in tables(described)
        if isinstance(line, str) and line.startswith("  ")
    ]
    assert any(line.startswith(f"  {LONG} ") for line in lines)
    assert len({line.rindex(" ") for line in lines}) == 1
    splits = TerrainDataset(path).splits
    monkeypatch.setattr(TerrainDataset, "splits", {**splits, LONG: splits["train"]})
    written(path)
    assert (
        len({line.rindex(" ") for line in capsys.readouterr().out.splitlines()[1:]})
        == 1
    )
