import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from benchnav.datagen import cli as datagen_cli
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


def test_datagen_commands(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)

    def datagen(*arguments: str) -> int:
        return call(datagen_cli.main, "benchnav-datagen", arguments, monkeypatch)

    assert datagen("create", "tiny-v1", "--out", "d.h5", "--splits", "[test/std,test/hg]") == 0
    assert datagen("create", "tiny-v1", "--out", "d.h5") == 2
    assert datagen("show", "d.h5") == 0
    assert "scree" in capsys.readouterr().out
    assert datagen("validate", "d.h5") == 0
    assert datagen("preview", "d.h5", "--split", "test/hg", "--maps", "[1]", "--out", "p.png") == 0
    assert (tmp_path / "p.png").stat().st_size > 10_000
    assert datagen("list", "--folder", ".") == 0
    assert "tiny-v1" in capsys.readouterr().out
    with h5py.File("d.h5") as file:
        chunk = file["test/hg"]["elevation_m"].id.get_chunk_info(0)
    raw = bytearray((tmp_path / "d.h5").read_bytes())
    raw[chunk.byte_offset + 9] ^= 255
    (tmp_path / "bad.h5").write_bytes(raw)
    assert datagen("validate", "bad.h5") == 1
    for bad in (("create", "nope"), ("show", "nope"), ("preview", "d.h5", "--maps", "[99]"), ("create",)):
        capsys.readouterr()
        assert datagen(*bad) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize("command", ["datagen", "train", "eval"])
def test_help_needs_no_heavy_import(command: str) -> None:
    package = {"train": "models"}.get(command, command)
    code = (
        f"import sys; sys.argv = ['x', '--help']\nfrom benchnav.{package}.cli import main\n"
        "try:\n    main()\nexcept SystemExit as ended:\n    assert not ended.code\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
