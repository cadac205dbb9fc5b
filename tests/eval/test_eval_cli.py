import subprocess
import sys
from pathlib import Path

import pytest

from benchnav.eval import cli as eval_cli

SMALL = (
    "--planners", "[mppi]", "--risks", "[mean]", "--scenarios", "[std]", "--instances", "1", "--model", "oracle",
    "--time_budget_s", "30", "--planner_options", '{"mppi": {"samples": 64}}',
)  # fmt: skip


def call(main, name: str, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> int:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def evaluate(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    return call(eval_cli.main, "benchnav-eval", arguments, monkeypatch)


def test_run_report_and_replay(dataset_path: Path, tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "run"
    assert evaluate(monkeypatch, "run", "--data", str(dataset_path), "--out", str(out), *SMALL) == 0
    printed = capsys.readouterr().out
    assert "mppi" in printed
    assert str(out / "summary.md") in printed
    assert f"replay {out}" in printed
    assert evaluate(monkeypatch, "report", str(out)) == 0
    assert evaluate(monkeypatch, "replay", str(out), "--view", "false") == 0
    assert ".rrd" in capsys.readouterr().out
    # The same command again finds all done; another suite in the folder needs leave to drop it.
    assert evaluate(monkeypatch, "run", "--data", str(dataset_path), "--out", str(out), *SMALL) == 0
    other = ("run", "--data", str(dataset_path), "--out", str(out), *SMALL, "--seed", "1")
    assert evaluate(monkeypatch, *other) == 2
    # A suite that cannot be run drops nothing.
    assert evaluate(monkeypatch, *other, "--overwrite", "true", "--instances", "99") == 2
    assert (out / "episodes.parquet").exists()
    assert evaluate(monkeypatch, *other, "--overwrite", "true") == 0


def test_a_config_file_and_print_config(dataset_path: Path, tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    config = tmp_path / "suite.yaml"
    config.write_text(f"data: {dataset_path}\nmodel: oracle\nrisks: [mean]\n")
    assert evaluate(monkeypatch, "run", "--config", str(config), "--seed", "3", "--print_config") == 0
    printed = capsys.readouterr().out
    assert "seed: 3" in printed
    assert "- mean" in printed


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "--data", "no-such"),
        ("run", "--model", "no-such"),
        ("run", "--instances", "some"),
        ("run", "--jobs", "0"),
        ("run", "--planers", "[mppi]"),
        ("run", "--config", "no-such.yaml"),
        ("run", "--out", "/proc/none/run", "--model", "oracle"),
        ("run", "--out", "/dev/null", "--model", "oracle"),
        ("report", "no-such"),
        ("replay", "no-such"),
        ("fly",),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, dataset_path, tmp_path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)
    extra = ("--data", str(dataset_path)) if arguments[0] == "run" and "--data" not in arguments else ()
    assert evaluate(monkeypatch, *arguments, *extra) == 2
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
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
