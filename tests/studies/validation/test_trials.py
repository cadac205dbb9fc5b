from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from studies.study import Study, Work
from studies.validation import trials
from studies.validation.task import THEIR_MPPI, Setup


def work(out: Path) -> Work:
    return Work(out=out, maps_in=out)


def test_trials_are_stored_and_tabulated_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    setups = []

    def two_trials(densities: list[float], settings: list[str], *rest: object) -> Iterator[pd.DataFrame]:
        assert (densities, settings) == ([0.4], ["mean", "cvar:0.8"])
        assert rest[:3] == (1, 2, 3)
        setups.append(rest[3])
        for realisation in range(2):
            yield pd.DataFrame(
                {
                    "density": 0.4, "setting": settings, "map": len(setups), "realisation": realisation,
                    "success": [False, True], "time_s": [float("nan"), 9.0],
                }
            )  # fmt: skip

    monkeypatch.setattr(trials, "run_trials", two_trials)
    for part, options in (("a", {}), ("b", {"mppi": {"samples": 16}, "risk_map": "histogram"})):
        folder = tmp_path / f"validation-{part}"
        folder.mkdir()
        told = trials.trials(work(tmp_path), folder, ["mean", "cvar:0.8"], [0.4], 1, 2, 3, **options)[
            "trials"
        ]
        assert "| 40 % | `mean` | 0.0 [" in told
        assert "| 40 % | +100.0 | 2, 0 |" in told
    rows = pd.read_csv(folder / "trials.csv")
    assert rows["setting"].tolist() == ["mean", "mean", "cvar:0.8", "cvar:0.8"]
    assert rows["success"].tolist() == [False, False, True, True]
    plain, changed = setups
    assert plain == Setup()
    assert (changed.mppi.samples, changed.mppi.noise) == (16, THEIR_MPPI.noise)
    assert changed.risk_map == "histogram"
    both = trials.together(work(tmp_path), folder, ["a", "b"])["trials"]
    assert "| 40 % | +100.0 | 4, 0 |" in both
    runs = trials.compared(work(tmp_path), folder, {"one": "a", "other": "a"})["runs"]
    assert "won with other alone, with one alone" in runs


@pytest.mark.parametrize(
    "options", [{"densities": [1.5]}, {"maps": 0}, {"risks": ["meen"]}, {"off_map": "gone"}]
)
def test_options_that_are_not_usable_are_rejected(options: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Expected"):
        trials.trials(work(tmp_path), tmp_path, **options)  # type: ignore[arg-type]


def test_each_part_has_usable_options() -> None:
    study = Study.load("validation")
    shared = {"risks", "densities", "maps", "realisations", "seed"}
    for part in study.parts.values():
        if part.script == "trials:trials":
            setup = {name: value for name, value in part.options.items() if name not in shared}
            assert trials.read(Setup, setup, trials.of("options"))
        else:
            runs = part.options.get("parts") or part.options["runs"].values()
            assert set(runs) <= set(study.parts)
