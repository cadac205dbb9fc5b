import inspect
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.eval import cli as eval_cli
from benchnav.eval.cli import SUITES
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings
from tests.commands import call

SMALL = (
    "--planners", "[straight,{part: mppi, options: {samples: 64}}]", "--risks", "[mean]",
    "--scenarios", "[std]", "--maps", "1", "--model", "oracle", "--world.time_budget_s", "10",
)  # fmt: skip


def test_run_report_and_replay(
    dataset_path: Path, tmp_path: Path, monkeypatch, capsys
) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "run"
    assert (
        call("eval", "run", "--data", str(dataset_path), "--out", str(out), *SMALL) == 0
    )
    printed = capsys.readouterr().out
    assert "mppi" in printed
    assert str(out / "report.html") in printed
    assert f"replay {out}" in printed
    assert call("eval", "report", str(out)) == 0
    assert call("eval", "replay", str(out), "--view", "false") == 0
    assert ".rrd" in capsys.readouterr().out
    # A report takes longer than a run.
    monkeypatch.setattr(eval_cli, "_finish", eval_cli._failed)
    # The same command again finds all done; with another seed it extends the run.
    again = ("run", "--data", str(dataset_path), "--out", str(out), *SMALL)
    assert call("eval", *again) == 0
    assert "2 of 2 units were already finished" in capsys.readouterr().err
    assert call("eval", *again, "--seed", "1") == 0
    assert f"{out} is extended by more episodes" in capsys.readouterr().err
    # A suite that cannot be run drops nothing.
    assert call("eval", *again, "--overwrite", "true", "--maps", "99") == 2
    assert (out / "episodes.parquet").exists()
    assert call("eval", *again, "--overwrite") == 0
    assert "already" not in capsys.readouterr().err


def test_world_and_task_are_set_field_by_field(
    dataset_path: Path, tmp_path: Path, monkeypatch
) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "run"
    arguments = (
        "run",
        "--data",
        str(dataset_path),
        "--out",
        str(out),
        *SMALL,
        "--world",
        "paper",
    )
    arguments += (
        "--world.noise",
        "stored",
        "--task.min_traversability",
        "0.05",
        "--task.free_space",
        "{by: mean, above: 0.1}",
    )
    monkeypatch.setattr(eval_cli, "_finish", eval_cli._failed)
    assert call("eval", *arguments) == 0
    for condition, _ in open_run(out).conditions.values():
        assert (condition.world.noise, condition.world.time_budget_s) == (
            "stored",
            10.0,
        )
        assert condition.rules.min_traversability == 0.05
        assert (condition.rules.free_space.by, condition.rules.free_space.above) == (
            "mean",
            0.1,
        )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--world", "stakes"), "stakes"),
        (("--world", "[paper,stakes]"), ["paper", "stakes"]),
        (
            ("--world", "stakes", "--world.noise", "stored"),
            {"preset": "stakes", "noise": "stored"},
        ),
    ],
)
def test_a_world_is_given_by_name_as_several_or_with_its_fields(
    words: tuple[str, ...], expected: object, capsys
) -> None:  # type: ignore[no-untyped-def]
    assert call("eval", "run", *words, "--print_config") == 0
    assert yaml.safe_load(capsys.readouterr().out)["world"] == expected


LIMITED = Settings.on("auto", planner_limit_s=2.5)


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ((), {}),
        (("--jobs", "3", "--overwrite"), {"jobs": 3, "overwrite": True}),
        (("--planner_limit_s", "2.5", "--shard", "2/4"), {"settings": LIMITED, "shard": Shard(index=2, of=4)}),
        (("--backend", "dask", "--scheduler", "tcp://a:1"), {"jobs": "tcp://a:1"}),
        (("--device", "cpu"), {"settings": Settings.on("cpu")}),
    ],
)  # fmt: skip
def test_the_options_of_run_are_those_that_the_suite_is_run_with(
    words: tuple[str, ...],
    changed: dict[str, object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[dict[str, object]] = []

    def begin(*args: object, **options: object) -> None:
        given.append(inspect.signature(run_suite).bind(*args, **options).arguments)
        raise ConfigError("enough")

    monkeypatch.setattr("benchnav.eval.run.runner.run_suite", begin)
    assert call("eval", "run", "--out", str(tmp_path / "run"), *SMALL, *words) == 2
    (told,) = given
    expected = {
        "jobs": 1,
        "overwrite": False,
        "settings": Settings.on("auto"),
        "shard": None,
    } | changed
    assert {name: told[name] for name in expected} == expected
    assert told["folder"] == tmp_path / "run"


def test_a_planner_that_fails_ends_with_status_1(
    dataset_path: Path, tmp_path: Path, capsys
) -> None:  # type: ignore[no-untyped-def]
    out, faulty = (
        tmp_path / "run",
        "{part: tests.eval.parts:Faulty, label: bad, options: {fault: raise}}",
    )
    arguments = ("run", "--data", str(dataset_path), "--out", str(out), *SMALL[2:-2])
    assert call("eval", *arguments, "--planners", f"[straight,{faulty}]") == 1
    captured = capsys.readouterr()
    assert "failed in some episodes (1 planner_error); first error: " in captured.err
    assert "errors.txt" in captured.err
    assert "straight" in captured.out


def test_list_names_every_part_with_its_options(capsys) -> None:  # type: ignore[no-untyped-def]
    assert call("eval", "list") == 0
    printed = capsys.readouterr().out
    for kind in registry.KINDS:
        for name in registry.names(kind):
            assert name in printed
    assert "samples" in printed
    assert "5000" in printed
    assert call("eval", "list", "risk") == 0
    printed = capsys.readouterr().out
    assert "cvar" in printed
    assert "mppi" not in printed
    assert call("eval", "list", "rsk") == 2


def test_shipped_suites_are_found_by_name_and_have_the_blind_baseline(capsys) -> None:  # type: ignore[no-untyped-def]
    names = [path.stem for path in SUITES.glob("*.yaml")]
    assert {"demo", "paper", "risk", "severity", "full"} == set(names)
    for name in names:
        assert call("eval", "run", "--config", name, "--print_config") == 0
        printed = yaml.safe_load(capsys.readouterr().out)
        listed = [printed, *(printed["conditions"] or [])]
        assert any("straight" in (product.get("planners") or []) for product in listed)
    assert call("eval", "run", "--config", "dmo") == 2
    assert "Did you mean" in capsys.readouterr().err


def test_a_config_file_and_print_config(
    dataset_path: Path, tmp_path: Path, capsys
) -> None:  # type: ignore[no-untyped-def]
    config = tmp_path / "suite.yaml"
    config.write_text(f"data: {dataset_path}\nmodel: oracle\nrisks: [mean]\n")
    assert (
        call("eval", "run", "--config", str(config), "--seed", "3", "--print_config")
        == 0
    )
    printed = capsys.readouterr().out
    assert "seed: 3" in printed
    assert "- mean" in printed


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "--data", "no-such"),
        ("run", "--model", "no-such"),
        ("run", "--maps", "some"),
        ("run", "--jobs", "0"),
        ("run", "--planers", "[mppi]"),
        ("run", "--planners", "[mppi,nowhere.py:Mine]", "--model", "oracle"),
        ("run", "--world", "mars", "--model", "oracle"),
        ("run", "--noise", "stored", "--model", "oracle"),
        ("run", "--planner_limit_s", "-1", "--model", "oracle"),
        ("run", "--device", "gpu", "--model", "oracle"),
        ("run", "--device", "cuda", "--model", "oracle"),
        ("run", "--config", "no-such.yaml"),
        ("run", "--out", "/proc/none/run", "--model", "oracle"),
        ("run", "--out", "/dev/null", "--model", "oracle"),
        ("run", "--shard", "3/2", "--model", "oracle"),
        ("run", "--backend", "dask", "--model", "oracle"),
        ("run", "--scheduler", "tcp://127.0.0.1:1", "--model", "oracle"),
        (
            "run",
            "--backend",
            "dask",
            "--scheduler",
            "tcp://127.0.0.1:1",
            "--jobs",
            "2",
            "--model",
            "oracle",
        ),
        ("merge", "whole"),
        ("merge", "whole", "no-such"),
        ("rerun", "no-such"),
        ("report", "no-such"),
        ("replay", "no-such"),
        ("fly",),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments, dataset_path, tmp_path, monkeypatch, capsys
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    extra = (
        ("--data", str(dataset_path))
        if arguments[0] == "run" and "--data" not in arguments
        else ()
    )
    assert call("eval", *arguments, *extra) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["datagen", "train", "eval"])
def test_help_needs_no_heavy_import(command: str) -> None:
    package = {"train": "models"}.get(command, command)
    code = (
        f"import sys; sys.argv = ['x', '--help']\nfrom benchnav.{package}.cli import main\n"
        "try:\n    main()\nexcept SystemExit as ended:\n    assert not ended.code\n"
        "heavy = {'torch', 'lightning', 'matplotlib', 'pandas', 'benchnav.planning.world.world'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
