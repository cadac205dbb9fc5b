"""The command `replay`, and what `run` says of recordings."""

import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import pandas as pd
import pytest
from rerun.chunk import RrdReader

from benchnav.eval.find_episodes import propose
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.recording import GROUND, RecordedMap
from benchnav.eval.report.playback import video, web
from benchnav.eval.report.playback.video import frame_times
from tests.commands import call

SMALL = (
    "--planners", "[straight,'tests.eval.parts:Faulty']", "--risks", "[mean,cvar:0.5]", "--scenarios", "[std]",
    "--maps", "2", "--model", "oracle", "--world.time_budget_s", "5", "--world.noise", "stored",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("replay") / "run"
    assert (
        call("eval", "run", "--data", str(dataset_path), "--out", str(out), *SMALL) == 0
    )
    return out


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def shown(printed: str) -> Path:
    """The recording that a command named."""
    (line,) = [line for line in printed.splitlines() if line.startswith("recording: ")]
    return Path(line.removeprefix("recording: "))


def test_one_episode_is_shown_alone(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--planner", "Faulty", "--risk", "cvar:0.5", "--map", "1")
    assert call("eval", "replay", str(folder), *asked, "--view", "no") == 0
    printed = capsys.readouterr().out
    path = shown(printed)
    assert path.name.startswith("Faulty-cvar-0-5-std")
    assert path.name.endswith("00001.rrd")
    assert "/world/robot" in entities(path)
    assert "rerun" in printed.splitlines()[-1]


@pytest.mark.parametrize("risks", ["mean,cvar:0.5", "[mean, 'cvar:0.5']"])
def test_several_labels_show_their_conditions_together(
    risks: str, folder: Path, capsys: Any
) -> None:
    assert (
        call(
            "eval",
            "replay",
            str(folder),
            "--planner",
            "Faulty",
            "--risk",
            risks,
            "--view",
            "false",
        )
        == 0
    )
    path = shown(capsys.readouterr().out)
    assert path.name.startswith("together-std")
    assert {
        "/world/conditions/mean/robot",
        "/world/conditions/CVaR₀.₅/robot",
    } <= entities(path)


def test_other_episodes_together_are_another_file(folder: Path, capsys: Any) -> None:
    paths = []
    for more in ((), ("--map", "1"), ("--planner", "straight,Faulty")):
        assert (
            call(
                "eval",
                "replay",
                folder,
                "--planner=Faulty",
                "--risk=mean,cvar:0.5",
                *more,
                "--view=false",
            )
            == 0
        )
        paths.append(shown(capsys.readouterr().out))
    assert len(set(paths)) == 3


@pytest.mark.parametrize("seed", ["0", "9"])
def test_each_option_asks_for_what_it_names(
    seed: str, folder: Path, capsys: Any
) -> None:
    """Of an episode that the run does not have, the refusal tells what was looked for."""
    columns = (
        "planner",
        "risk",
        "scenario",
        "model",
        "robot",
        "objective",
        "world",
        "data",
    )
    words = [word for name in columns for word in (f"--{name}", f"some {name}")]
    words += ["--seed", seed, "--realisation", "3", "--map", "4"]
    assert call("eval", "replay", str(folder), *words) == 2
    labels = ", ".join(f"{name} 'some {name}'" for name in columns)
    assert (
        f"got {labels}, realisation 3, map 4, seed {seed}, " in capsys.readouterr().err
    )


def test_what_is_proposed_are_unlike_outcomes_on_the_map_where_they_differ_most(
    folder: Path,
) -> None:
    rows = pd.read_parquet(folder / "episodes.parquet")
    faulty = rows["planner"] == "Faulty"
    for arrived in (True, False):
        rows["success"] = (
            faulty & (rows["map"] == 1) & ((rows["risk"] == "mean") == arrived)
        )
        with pytest.MonkeyPatch.context() as patch:
            about = {**RecordedMap.load(folder / GROUND).about, "map": 1}
            patch.setattr(
                "benchnav.eval.find_episodes.read_table", lambda *_, own=rows: own
            )
            patch.setattr(
                RecordedMap, "load", lambda _, own=about: SimpleNamespace(about=own)
            )
            labels, place = propose(folder)
        assert (labels["planner"], labels["risk"]) == (["Faulty"], ["mean", "cvar:0.5"])
        assert place == {"map": 1, "seed": 0, "realisation": 0}
    # Settings of the first hypothesis come before others.
    faulty &= rows["map"] == 1
    ids = {
        risk: rows.loc[faulty & (rows["risk"] == risk), "condition"].iloc[0]
        for risk in ("mean", "cvar:0.5")
    }
    tests = [{"one": ids["cvar:0.5"], "other": ids["mean"]}]
    with pytest.MonkeyPatch.context() as patch:
        run = open_run(folder)
        patch.setattr(
            "benchnav.eval.find_episodes.open_run",
            lambda _: replace(
                run, manifest=run.manifest | {"hypotheses": {"tests": tests}}
            ),
        )
        patch.setattr(
            "benchnav.eval.find_episodes.read_table", lambda *_, own=rows: own
        )
        patch.setattr(
            RecordedMap, "load", lambda _, own=about: SimpleNamespace(about=own)
        )
        assert propose(folder)[0]["risk"] == ["cvar:0.5", "mean"]
    rows["success"] = True
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchnav.eval.find_episodes.read_table", lambda *_: rows)
        assert propose(folder)[0]["risk"] == ["mean"]


def test_a_video_shows_conditions_side_by_side(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    drawn: list[list[str]] = []

    class Noted(video.Frames):
        def __init__(self, recordings: Any) -> None:
            drawn.append([own.about["risk"] for own in recordings])
            super().__init__(recordings)

    monkeypatch.setattr(video, "Frames", Noted)
    for name, risk in (("one", "mean"), ("two", "mean,cvar:0.5")):
        path = tmp_path / f"{name}.mp4"
        drawn.clear()
        assert (
            call(
                "eval",
                "replay",
                folder,
                "--planner",
                "Faulty",
                "--risk",
                risk,
                "--video",
                path,
            )
            == 0
        )
        assert str(path) in capsys.readouterr().out
        assert drawn == [risk.split(",")]
        with av.open(str(path)) as container:
            assert sum(1 for _ in container.decode(video=0)) == len(frame_times(5.0))


def test_the_viewer_is_served_with_the_recording(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    served: list[Path] = []
    monkeypatch.setattr(web, "serve", served.append)
    assert call("eval", "replay", str(folder), "--web") == 0
    assert served == [shown(capsys.readouterr().out)]


def test_run_says_what_it_recorded_and_how_it_is_replayed(
    dataset_path: Path, tmp_path: Path, capsys: Any
) -> None:
    out = tmp_path / "run"
    assert (
        call(
            "eval",
            "run",
            "--data",
            dataset_path,
            "--out",
            out,
            *SMALL,
            "--record",
            "failures",
        )
        == 0
    )
    printed = capsys.readouterr().out.splitlines()
    count = len(list((out / "playback").glob("*.rrd")))
    assert any(
        line.startswith(f"recorded: {count} episodes in {out / 'playback'}, ")
        for line in printed
    )
    (line,) = [line for line in printed if line.startswith("replay:  ")]
    words = shlex.split(line.removeprefix("replay:  "))
    assert "straight" not in words
    assert "--map" in words
    assert call("eval", *words[1:], "--view", "false") == 0
    assert (
        call(
            "eval",
            "run",
            "--data",
            dataset_path,
            "--out",
            tmp_path / "none",
            *SMALL,
            "--record",
            "steps",
        )
        == 0
    )
    assert "recorded:" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            ("replay", "RUN", "--video", "a.avi"),
            "Expected `video` to be a .mp4 file, got 'a.avi'",
        ),
        (
            ("replay", "RUN", "--video", "a.mp4", "--web"),
            "Expected `video` or `web`, got both.",
        ),
        (("replay", "RUN", "--video", "mp4"), "Expected `video` to be a .mp4 file"),
        (("replay", "RUN", "--planner", "mpi"), "planner straight, Faulty; "),
        (
            ("run", "--record", "some"),
            "'none' or 'steps' or 'first' or 'failures' or 'all'",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: tuple[str, ...],
    told: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: Any,
    capsys: Any,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.yaml").write_text("recorded: 4\n")
    assert (
        call("eval", *(str(folder) if word == "RUN" else word for word in arguments))
        == 2
    )
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert told in line
    assert [path.name for path in tmp_path.iterdir()] == ["old.yaml"]
