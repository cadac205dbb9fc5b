import gzip
import hashlib
import random
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core.errors import DatasetError
from benchnav.models.config import LatentGPConfig
from benchnav.models.slope_gp.cells import (
    SlopeSums,
    cell_nll,
    hold_out,
    hold_out_drives,
)
from benchnav.models.slope_gp.slip_logs import read_slip_log
from benchnav.models.training.gaussian_processes import fit_gps
from tests.models.support import make_cells

GOOD = "class,slope_deg,traversability,note\nsand,3.5,0.9,x\nrock,10,1,y\nsand,,0.5,\nsand,4,NaN,\nNA,0,0,\n"


def write(folder: Path, text: str | bytes, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_a_csv_gives_its_observed_rows(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    logs = read_slip_log(path)
    assert logs.class_names == ("NA", "rock", "sand")
    assert logs.cells.class_id.tolist() == [2, 1, 0]
    assert logs.cells.slope_deg.tolist() == [3.5, 10, 0]
    np.testing.assert_allclose(logs.cells.traversability, [0.9, 1, 0])
    assert logs.digest == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "classes", [["b", "a", "b"], pd.Categorical(["b", "a", "b"]), [1, 0, 1]]
)
def test_parquet_and_csv_give_the_same(tmp_path: Path, classes: list[str]) -> None:
    rows = pd.DataFrame(
        {"class": classes, "slope_deg": [1.0, 2.0, None], "traversability": [0, 1, 1]}
    )
    rows.to_csv(tmp_path / "log.csv", index=False)
    rows.to_parquet(tmp_path / "log.parquet")
    text, binary = (
        read_slip_log(tmp_path / name) for name in ("log.csv", "log.parquet")
    )
    assert text.class_names == binary.class_names
    for name in ("class_id", "slope_deg", "traversability"):
        assert torch.equal(getattr(text.cells, name), getattr(binary.cells, name))
    assert text.cells.class_id.tolist() == [1, 0]


def test_rows_are_put_under_the_ids_of_a_class_table(tmp_path: Path) -> None:
    path, table = write(tmp_path, GOOD), ("rock", "mud", "sand", "NA")
    logs = read_slip_log(path, table)
    assert logs.class_names == table
    cells = logs.cells
    assert cells.class_id.tolist() == [2, 0, 3]
    assert cells.slope_deg.tolist() == [3.5, 10, 0]
    with pytest.raises(
        DatasetError,
        match=r"among rock, sands, NA .* got 'sand'\. Did you mean 'sands'\?",
    ):
        read_slip_log(path, ("rock", "sands", "NA"))


def test_integer_classes_are_indices_into_the_class_table(tmp_path: Path) -> None:
    path = write(
        tmp_path, "class,slope_deg,traversability\n3,1,0.25\n0,2,0.5\n3,5,\n10,3,0.75\n"
    )
    alone, logs = read_slip_log(path), read_slip_log(path, tuple("abcdefghijkl"))
    assert alone.class_names == tuple(str(i) for i in range(11))
    assert logs.class_names == tuple("abcdefghijkl")
    assert logs.cells.slope_deg.tolist() == [1, 2, 3]
    assert logs.cells.class_id.tolist() == alone.cells.class_id.tolist() == [3, 0, 10]
    with pytest.raises(DatasetError, match=r"in 0–9 .* got 10"):
        read_slip_log(path, tuple("abcdefghij"))


HEADER = "class,slope_deg,traversability\n"


def test_the_number_that_means_no_class_in_maps_is_a_class_of_a_log(
    tmp_path: Path,
) -> None:
    cells = read_slip_log(write(tmp_path, HEADER + "255,1,0.5\n3,2,0.4\n")).cells
    assert cells.class_id.tolist() == [255, 3]
    assert SlopeSums.of(cells, 256).steepest_deg[[3, 255]].tolist() == [2, 1]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "cannot be read: No columns"),
        (HEADER, "got 0 of 0"),
        (HEADER + "a,1,\nb,,1\n", "got 0 of 2"),
        (
            "class,slope,traversability\na,1,1\n",
            "got no slope_deg.*The file has class, slope, traversability",
        ),
        ("a;b\n1;2\n", "got no class and no slope_deg and no traversability"),
        (HEADER + "a,1,0.5\na,,0.5\na,steep,0.5\n", "`slope_deg`.*got steep in row 3"),
        (HEADER + "a,1,0.5\na,1,high\n", "`traversability`.*got high in row 2"),
        (HEADER + "a,1,0.5\na,91,0.5\n", r"within \[0, 90\].*got 91 in row 2"),
        (HEADER + "a,1,-0.1\n", r"within \[0, 1\].*got -0.1 in row 1"),
        (HEADER + "a,inf,0.1\n", "got inf in row 1"),
        (HEADER + "a,1,0.1\n,1,0.1\n", "`class` in each row.*row 2"),
        (
            "class,slope_deg,traversability,drive\na,1,0.1,x\na,1,0.1, \n",
            "`drive` in each row.*row 2",
        ),
        (
            "klass,slope_deg,traversability\na,1,1\n",
            "got no class.*Did you mean 'klass'",
        ),
        (HEADER + "256,1,0.1\n", "at most 256 classes.*got 257"),
        (
            HEADER + "99999999999999999999,1,0.1\n",
            "at most 256 classes.*got 100000000000000000001",
        ),
        (HEADER + "a,1,0.1\na,1,0.1,0.2,0.3\n", "cannot be read: .*line 3"),
        (b"\x89\xff\x00\x01" * 50, "cannot be read"),
    ],
)
def test_a_bad_csv_is_refused_in_one_line(
    tmp_path: Path, text: str | bytes, why: str
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(DatasetError, match=why) as caught:
        read_slip_log(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="No such file"):
        read_slip_log(tmp_path / "none.csv")
    with pytest.raises(DatasetError, match="PARQUET table"):
        read_slip_log(write(tmp_path, GOOD, "log.parquet"))


def test_gps_learn_from_logs_and_report_a_held_out_nll(tmp_path: Path) -> None:
    made = make_cells(400)
    rows = pd.DataFrame(
        {
            "class": np.repeat(["a", "b", "c"], 400),
            "slope_deg": made.slope_deg,
            "traversability": made.traversability,
        }
    )
    rows.sample(frac=1, random_state=0).to_parquet(tmp_path / "log.parquet")
    logs = read_slip_log(tmp_path / "log.parquet")
    kept, held = hold_out(logs.cells, 0.25)
    sums, fresh = SlopeSums.of(kept, 3), make_cells(40_000, 5)
    table = fit_gps(LatentGPConfig(), sums).tabulate()
    nll = cell_nll(fresh, table)
    assert cell_nll(held, table) == pytest.approx(nll, abs=0.1)
    assert nll < cell_nll(
        fresh, fit_gps(LatentGPConfig(epochs=1, epoch_steps=1), sums).tabulate()
    )


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_ids_that_pandas_wrote_with_a_decimal_are_ids(
    tmp_path: Path, kind: str
) -> None:
    rows = pd.DataFrame(
        {
            "class": [0.0, 2.0, np.nan],
            "slope_deg": [3.0, 9.0, np.nan],
            "traversability": 0.5,
        }
    )
    path = tmp_path / f"log.{kind}"
    rows.to_csv(path, index=False) if kind == "csv" else rows.to_parquet(path)
    logs = read_slip_log(path)
    assert logs.class_names == ("0", "1", "2")
    assert logs.cells.class_id.tolist() == [0, 2]
    with pytest.raises(DatasetError, match="class ids as whole numbers"):
        read_slip_log(
            write(tmp_path, "class,slope_deg,traversability\n0.5,3,1\n1,3,1\n")
        )


@pytest.mark.parametrize("name", ["log.tsv", "log.csv.gz", "log.tsv.gz"])
def test_tables_of_tabs_and_packed_ones_are_read(tmp_path: Path, name: str) -> None:
    text = GOOD.replace(",", "\t") if ".tsv" in name else GOOD
    content = gzip.compress(text.encode()) if name.endswith(".gz") else text.encode()
    expected = read_slip_log(write(tmp_path, GOOD, "plain.csv"))
    logs = read_slip_log(write(tmp_path, content, name))
    assert logs.class_names == expected.class_names
    assert logs.cells.slope_deg.tolist() == expected.cells.slope_deg.tolist()
    if name.endswith(".gz"):
        with pytest.raises(DatasetError, match="cannot be read"):
            read_slip_log(write(tmp_path, content[:-9], name))


def test_slopes_in_radians_are_refused(tmp_path: Path) -> None:
    head = "class,slope_deg,traversability\n"
    for most, count, is_refused in (
        (0.5, 20, True),
        (0.5, 19, False),
        (2.0, 20, False),
        (0.0, 20, False),
    ):
        path = write(
            tmp_path,
            head
            + "".join(f"sand,{most * k / count},0.5\n" for k in range(1, count + 1)),
        )
        if is_refused:
            with pytest.raises(DatasetError, match="suggests radians"):
                read_slip_log(path)
        else:
            assert len(read_slip_log(path).cells) == count


def test_drives_of_a_log_are_known_whatever_they_are_called(tmp_path: Path) -> None:
    rows = pd.DataFrame(
        {
            "class": "a",
            "slope_deg": [1.0, 2, None, 4],
            "traversability": 0.5,
            "drive": ["n", "m", "m", " n"],
        }
    )
    rows.to_csv(tmp_path / "log.csv", index=False)
    drive = read_slip_log(tmp_path / "log.csv").drive
    assert drive is not None
    assert drive.tolist() == [1, 0, 1]
    rows["drive"] = [7, 3, 3, 7]
    rows.to_parquet(tmp_path / "log.parquet")
    drive = read_slip_log(tmp_path / "log.parquet").drive
    assert drive is not None
    assert drive.tolist() == [1, 0, 1]
    assert read_slip_log(write(tmp_path, GOOD)).drive is None


@given(
    st.lists(st.integers(1, 50), min_size=2, max_size=20),
    st.floats(0.05, 0.95),
    st.integers(0, 5),
    st.randoms(),
)
def test_whole_drives_are_held_out_near_the_share(
    sizes: list[int], share: float, seed: int, shuffled: random.Random
) -> None:
    rows = [drive for drive, size in enumerate(sizes) for _ in range(size)]
    shuffled.shuffle(rows)
    drive = torch.tensor(rows)
    held = hold_out_drives(drive, share, seed)
    assert not set(drive[held].tolist()) & set(drive[~held].tolist())
    assert 0 < held.sum() < len(rows)
    assert torch.equal(held, hold_out_drives(drive, share, seed))
    # As near to the share as half of the longest drive, where one of them is not too
    # long for it.
    if max(sizes) <= share * len(rows) and len(rows) * (1 - share) > max(sizes):
        assert abs(int(held.sum()) - share * len(rows)) <= max(sizes) / 2


def test_which_drives_are_held_out_is_drawn() -> None:
    drive = torch.arange(20).repeat_interleave(10)
    held = [
        tuple(drive[hold_out_drives(drive, 0.1, seed)].unique().tolist())
        for seed in range(200)
    ]
    assert {len(one) for one in held} == {2}
    counts = np.bincount([drive for one in held for drive in one], minlength=20)
    assert 8 <= counts.min() <= counts.max() <= 36  # 20 each, four deviations
    assert (
        hold_out_drives(torch.tensor([0] * 60 + [1] * 30), 0.1).tolist()
        == [False] * 60 + [True] * 30
    )
