"""How the commands parse, and what they say of mistakes: one line, status 2, in the
user's words.
"""

import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from benchnav.core.command import Command, run
from benchnav.core.device import gpu_failed
from benchnav.core.errors import ConfigError

seen: list[Any] = []


def work(
    place: str,
    rest: list[str],
    deep_cut: bool = False,
    much_more: int = 1,
    some: list[int] | None = None,
) -> None:
    """Work.

    Args:
        place: Where.
        rest: What else.
        deep_cut: Whether.
        much_more: How much.
        some: Which.
    """
    seen.append((place, rest, deep_cut, much_more, *(some or ())))


@dataclass(frozen=True, kw_only=True)
class Depth:
    """Settings within settings.

    Args:
        epochs: How often.
        kind: Which.
    """

    epochs: int = 3
    kind: Literal["censored", "gaussian"] = "censored"

    def __post_init__(self) -> None:
        if self.epochs < 1:
            raise ConfigError(f"Expected `epochs` ≥ 1, got {self.epochs}.")


_DEPTH = Depth()


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Settings.

    Args:
        planners: Names or mappings.
        risks: Names.
        maps: How many.
        rate: How fast.
        world: What.
        model: Which.
        options: More.
    """

    planners: tuple[str | dict[str, Any], ...] = ("a",)
    risks: tuple[str, ...] = ("mean",)
    maps: int = 20
    rate: float | None = None
    world: str | dict[str, Any] = "paper"
    model: str | dict[str, Any] = "shipped"
    options: dict[str, dict[str, Any]] = field(default_factory=dict)


def go(suite: Suite, out: str = "runs", depth: Depth = _DEPTH) -> int:
    """Go.

    Args:
        suite: What.
        out: Where.
        depth: How deep.
    """
    seen.append((suite, out, depth))
    return 0


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    seen.clear()
    Path("shipped").mkdir()
    Path("shipped/demo.yaml").write_text("maps: 2\n")
    Path("shipped/paper.yaml").write_text("maps: 36\n")


def call(*argv: str) -> int:
    commands = {
        "work": Command(work, ("place", "rest")),
        "go": Command(go, configs=Path("shipped")),
    }
    return run("x", "Does.", commands, argv)


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one line that a command ends with, without the program's name."""
    assert call(*argv) == 2
    assert not seen
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("x: error: ")
    for inner in ("<class", "Union", "typing", "Parser key", "Subcommand", "NoneType"):
        assert inner not in err
    return err.removeprefix("x: error: ").rstrip()


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["a"], ("a", [], False, 1)),
        (["a", "--deep-cut"], ("a", [], True, 1)),
        (["--deep_cut", "a"], ("a", [], True, 1)),
        (["--deep-cut", "false", "a"], ("a", [], False, 1)),
        (["a", "--deep-cut=true", "--much-more=3"], ("a", [], True, 3)),
        (["a", "--much-more", "-3"], ("a", [], False, -3)),
        (["a", "b-c=1", "--d=2"], None),
        ([], None),
        (["a", "--some", "3"], ("a", [], False, 1, 3)),
        (["a", "--some=3"], ("a", [], False, 1, 3)),
        (["a", "--some", "3,4", "--deep-cut"], ("a", [], True, 1, 3, 4)),
        (["a", "--some", "[3, 4]"], ("a", [], False, 1, 3, 4)),
        (
            ["a", "b-c=1", "e", "--much-more", "4", "--deep-cut"],
            ("a", ["b-c=1", "e"], True, 4),
        ),
        (["a", "--much-more", "4", "b", "--deep-cut", "c"], ("a", ["b", "c"], True, 4)),
    ],
)
def test_flags_are_spelled_either_way_and_switches_need_no_value(
    argv: list[str], expected: object
) -> None:
    status = call("work", *argv)
    assert (seen, status) == (([expected], 0) if expected else ([], 2))


@pytest.mark.parametrize(
    "argv", [(), ("--help",), ("-h",), ("go", "--help"), ("work", "-h")]
)
def test_a_bare_command_and_help_print_help(
    argv: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = call(*argv)
    except SystemExit as ended:
        status = int(ended.code or 0)
    out, err = capsys.readouterr()
    assert (status, err) == (0, "")
    assert "usage: x" in out
    if "go" in argv:
        assert "one of demo, paper" in " ".join(out.split())
    elif "work" not in argv:
        assert "Go." in out
        assert "Work." in out


@pytest.mark.parametrize("program", ["datagen", "models", "eval"])
def test_each_program_prints_its_help_when_bare(program: str) -> None:
    code = f"import sys; sys.argv = ['it']; from benchnav.{program}.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage: benchnav-" in done.stdout


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (
            ["wrok"],
            "Expected a command among work, go, got 'wrok'. Did you mean 'work'?",
        ),
        (["--maps", "3"], "Expected a command among work, go, got '--maps'."),
        (
            ["go", "--planer", "a"],
            "got --planer. Did you mean '--planners'? See `x go --help`.",
        ),
        (["go", "--planer=a"], "got --planer. Did you mean '--planners'?"),
        (
            ["go", "--depth.epoch", "1"],
            "got --depth.epoch. Did you mean '--depth.epochs'?",
        ),
        (
            ["go", "--depth", "{epoch: 1}"],
            "keys of --depth among epochs, kind, got 'epoch'. Did you mean 'epochs'?",
        ),
        (["go", "--maps.x", "1"], "got --maps.x. Did you mean '--maps'?"),
        (["go", "-i", "1"], "got -i."),
        (["go", "--maps", "ten"], "Expected --maps as a whole number, got 'ten'."),
        (["go", "--maps=1.5"], "Expected --maps as a whole number, got '1.5'."),
        (["go", "--maps"], "Expected a value after --maps (a whole number), got none."),
        (["go", "--maps", "--rate", "1"], "Expected a value after --maps"),
        (["go", "--rate", "fast"], "Expected --rate as a number or null, got 'fast'."),
        (
            ["go", "--depth.epochs", "x"],
            "Expected --depth.epochs as a whole number, got 'x'.",
        ),
        (
            ["go", "--depth.kind", "gausian"],
            "'censored' or 'gaussian', got 'gausian'. Did you mean 'gaussian'?",
        ),
        (["go", "--depth.epochs", "0"], "Expected `epochs` ≥ 1, got 0."),
        (["go", "--depth", "3"], "Expected --depth as a mapping, got '3'."),
        (
            ["go", "--options", "3", "--options.a.b", "1"],
            "a mapping in which 'a.b' can be set, got '3'.",
        ),
        (["go", "--options", "3"], "Expected --options as a mapping, got '3'."),
        (["go", "--risks", "{a: b}"], "Expected --risks as a list, each text, got"),
        (
            ["go", "more"],
            "Expected no further arguments, got 'more'. See `x go --help`.",
        ),
        (["work"], "Expected PLACE, got none. See `x work --help`."),
        (
            ["go", "--config", "nope.yaml"],
            "or one of demo, paper, got 'nope.yaml'.",
        ),
        (["go", "--config", "papr"], "Did you mean 'paper'?"),
        (
            ["work", "a", "--config", "demo"],
            "Expected --config to be an existing YAML file, got 'demo'",
        ),
    ],
)
def test_mistakes_on_the_line_are_told_in_the_users_words(
    argv: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert expected in refused(capsys, *argv)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            "risk: mean\n",
            "keys of s.yaml among planners, risks, maps, rate, world, model, options, out, depth, got 'risk'. Did you",
        ),
        ("maps: ten\n", "Expected `maps` of s.yaml as a whole number, got 'ten'."),
        ("maps:\n", "Expected `maps` of s.yaml as a whole number, got null."),
        (
            "depth: {epoch: 3}\n",
            "keys of `depth` of s.yaml among epochs, kind, got 'epoch'. Did you mean 'epochs'?",
        ),
        (
            "depth: {epochs: x}\n",
            "Expected `depth.epochs` of s.yaml as a whole number, got 'x'.",
        ),
        (
            "- a\n",
            "Expected s.yaml to contain settings as `name: value`, got a value of type list.",
        ),
        ("a: [1\n", "Expected YAML, got s.yaml, line 2: did not find"),
    ],
)
def test_mistakes_in_a_file_are_told_with_its_name(
    content: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("s.yaml").write_text(content)
    assert expected in refused(capsys, "go", "--config", "s.yaml")


def test_shipped_files_are_found_by_name_where_no_such_file_is_here(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert call("go", "--config", "demo", "--rate", "2") == 0
    assert (seen[-1][0].maps, seen[-1][0].rate) == (2, 2.0)
    Path("demo").write_text("maps: 5\n")
    assert call("go", "--config", "demo") == 0
    assert seen[-1][0].maps == 5
    seen.clear()
    Path("mysuite.yaml").write_text("")
    assert "Did you mean 'mysuite.yaml'?" in refused(
        capsys, "go", "--config", "mysuit.yaml"
    )
    assert call("go", "--config", "mysuite.yaml") == 0
    assert seen[-1][0] == Suite()


def test_flags_have_the_last_word_wherever_they_stand() -> None:
    assert call("go", "--maps", "7", "--config", "demo") == 0
    assert seen[-1][0].maps == 7


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        ([], "paper"),
        (["--world", "stakes"], "stakes"),
        (["--world", "{noise: stored}"], {"noise": "stored"}),
        (["--world", "stakes", "--world.noise", "stored"], {"preset": "stakes", "noise": "stored"}),
        (["--world.noise", "stored", "--world", "stakes"], {"preset": "stakes", "noise": "stored"}),
        (["--world.noise=stored", "--world=stakes"], {"preset": "stakes", "noise": "stored"}),
        (["--world.noise", "stored"], {"preset": "paper", "noise": "stored"}),
        (["--world", "{noise: stored}", "--world.time-s", "5"], {"noise": "stored", "time-s": 5}),
        (["--config", "text.yaml", "--world.noise", "stored"], {"preset": "stakes", "noise": "stored"}),
        (["--world.noise", "stored", "--config", "text.yaml"], {"preset": "stakes", "noise": "stored"}),
        (["--config", "mapping.yaml", "--world.noise", "stored"], {"noise": "stored", "time_s": 3}),
        (["--config", "mapping.yaml", "--world", "stakes", "--world.a", "1"],
         {"preset": "stakes", "a": 1}),
        (["--config", "mapping.yaml", "--world", "stakes"], "stakes"),
        (["--world.hold.below", "1e-1", "--world.hold.for_s", "2"],
         {"preset": "paper", "hold": {"below": 0.1, "for_s": 2}}),
        (["--config", "deep.yaml", "--world.hold.for_s", "2"], {"hold": {"below": 0.001, "for_s": 2}}),
    ],
)  # fmt: skip
def test_a_name_and_single_fields_are_one_value(
    argv: list[str], expected: object
) -> None:
    Path("text.yaml").write_text("world: stakes\n")
    Path("deep.yaml").write_text("world: {hold: {below: 1e-3, for_s: 1}}\n")
    Path("mapping.yaml").write_text("world: {noise: resampled, time_s: 3}\n")
    assert call("go", *argv) == 0
    assert seen[-1][0].world == expected
    assert seen[-1][0].model == "shipped"


def test_a_parts_name_stands_under_part() -> None:
    assert call("go", "--model", "./mine.py:Model", "--model.options.depth", "3") == 0
    assert seen[-1][0].model == {"part": "./mine.py:Model", "options": {"depth": 3}}
    assert seen[-1][0].world == "paper"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("b", ("b",)),
        ("b,c:0.5", ("b", "c:0.5")),
        ("[b, c]", ("b", "c")),
        ("[b,./mine.py:Mine]", ("b", "./mine.py:Mine")),
        ("./mine.py:Mine:0.5", ("./mine.py:Mine:0.5",)),
        ("{part: b, label: c}", ({"part": "b", "label": "c"},)),
        ("{part: b},c", ({"part": "b"}, "c")),
        (
            "[b, {part: c, options: {d: 1e-3}}]",
            ("b", {"part": "c", "options": {"d": 1e-3}}),
        ),
    ],
)
def test_lists_are_given_with_or_without_brackets(text: str, expected: object) -> None:
    for argv in (["--planners", text], [f"--planners={text}"]):
        assert call("go", *argv) == 0
        assert seen[-1][0].planners == expected


def test_keys_of_mappings_stay_as_they_are() -> None:
    assert call("go", "--options.single-class.some_thing", "3") == 0
    assert seen[-1][0].options == {"single-class": {"some_thing": 3}}
    Path("o.yaml").write_text(
        "options: {mppi: {samples: 5, noise: 1e-2}, other: {a: 1}}\n"
    )
    assert (
        call(
            "go",
            "--options.mppi.samples",
            "7",
            "--options.mppi.horizon",
            "9",
            "--config",
            "o.yaml",
        )
        == 0
    )
    assert seen[-1][0].options == {
        "mppi": {"samples": 7, "noise": 0.01, "horizon": 9},
        "other": {"a": 1},
    }


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (
            PermissionError(13, "Permission denied", "runs/new/run.json"),
            "could not use {here}/runs/new/run.json: Permission denied. Choose another path with --out, or "
            "change the permissions of {here}.",
        ),
        (
            OSError(30, "Read-only file system", "shipped/x"),
            "change the permissions of {here}/shipped.",
        ),
        (
            OSError(28, "No space left on device", "x"),
            "could not use x: No space left on device",
        ),
        (OSError("odd"), "could not use a file: odd"),
        (ConfigError("two\nlines"), "two lines"),
    ],
)
def test_what_the_system_refuses_is_named_with_a_remedy(
    error: Exception, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(out: str = "runs") -> None:
        """Fail."""
        raise error

    assert run("x", "Does.", {"fail": Command(fail)}, ["fail"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert expected.format(here=Path.cwd()) in err


@pytest.mark.parametrize(
    ("said", "expected"), [((), ""), (("2 maps are kept",), "; 2 maps are kept")]
)
def test_an_interruption_ends_with_130_and_says_what_the_command_kept(
    said: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop() -> None:
        """Stop."""
        raise KeyboardInterrupt(*said)

    assert run("x", "Does.", {"stop": Command(stop)}, ["stop"]) == 130
    assert capsys.readouterr().err == f"x: interrupted{expected}\n"


def test_a_schedulers_signal_to_end_is_an_interruption(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stop() -> None:
        """Stop."""
        signal.raise_signal(signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    try:
        assert run("x", "Does.", {"stop": Command(stop)}, ["stop"]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == "x: interrupted\n"


@pytest.mark.parametrize(
    "argv",
    [
        ("--some", "[1,2]", "--some", "3"),
        ("--some", "1", "--some", "2", "--some=3"),
        ("--some", "[]", "--some", "[1, 2, 3]"),
        ("--some", "1,2", "--some", "[3]"),
    ],
)
def test_a_flag_of_a_list_that_is_given_again_adds_to_it_where_the_command_says_so(
    argv: tuple[str, ...],
) -> None:
    command = Command(work, ("place", "rest"), repeated=("some",))
    assert run("x", "Does.", {"work": command}, ("work", "here", *argv)) == 0
    assert seen[-1] == ("here", [], False, 1, 1, 2, 3)


def test_of_any_other_flag_the_last_one_holds() -> None:
    assert call("work", "here", "--some", "[1,2]", "--some", "3") == 0
    assert seen[-1] == ("here", [], False, 1, 3)


def test_what_pytorch_says_of_a_gpu_is_one_sentence_with_one_stop() -> None:
    for said in (
        "no memory left.\nand more",
        "no memory left",
        "\n no memory left. \n",
    ):
        assert str(gpu_failed(said)).startswith(
            "The GPU failed: no memory left. Finished work is kept"
        )
