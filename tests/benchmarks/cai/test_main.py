from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.cai import __main__ as command
from benchmarks.cai.task import THEIR_MPPI, Setup


def given(*words: str) -> Setup:
    parser = command.make_parser()
    return parser.instantiate(parser.parse_args(words)).setup


def test_a_changed_option_leaves_the_others_theirs() -> None:
    assert given() == Setup()
    changed = given("--setup.mppi.samples", "16", "--setup.risk_map", "histogram")
    assert changed.mppi.samples == 16
    assert (changed.mppi.horizon_s, changed.mppi.control_cost) == (
        THEIR_MPPI.horizon_s,
        THEIR_MPPI.control_cost,
    )
    assert changed.mppi.noise == THEIR_MPPI.noise
    assert changed.mppi.temperature == THEIR_MPPI.temperature == 1.0
    assert changed.risk_map == "histogram"


def test_trials_are_written_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def two_trials(densities: list[float], settings: list[str], *rest: object) -> Iterator[pd.DataFrame]:
        assert (densities, settings) == ([0.4], ["mean", "cvar:0.8"])
        assert rest[:3] == (1, 2, 3)
        for realisation in range(2):
            yield pd.DataFrame(
                {
                    "density": 0.4, "setting": settings, "map": 0, "realisation": realisation,
                    "success": [False, True], "time_s": [float("nan"), 9.0],
                }
            )  # fmt: skip

    monkeypatch.setattr(command, "run_trials", two_trials)
    out = tmp_path / "made" / "trials.csv"
    words = "--density 0.4 --risk mean cvar:0.8 --maps 1 --realisations 2 --seed 3 --out"
    monkeypatch.setattr("sys.argv", ["cai", *words.split(), str(out)])
    assert command.main() == 0
    rows = pd.read_csv(out)
    assert rows["setting"].tolist() == ["mean", "mean", "cvar:0.8", "cvar:0.8"]
    assert rows["success"].tolist() == [False, False, True, True]
    printed = capsys.readouterr().out
    assert "| 40 % | `mean` | 0.0 [" in printed
    assert "| 40 % | +100.0 | 2, 0 |" in printed


@pytest.mark.parametrize(
    ("word", "value"),
    [("--density", "1.5"), ("--maps", "0"), ("--risk", "meen"), ("--setup.mppi.samples", "0")],
)
def test_bad_input_ends_in_one_line_and_status_2(
    word: str, value: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["cai", word, value])
    assert command.main() == 2
    assert "Expected" in capsys.readouterr().err
