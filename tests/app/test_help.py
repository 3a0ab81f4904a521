"""Help: a screen of what is used most, every option, the options of a choice, examples that can be typed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.config.cases import of_command
from tests.typed import ENVIRONMENT, refused
from trackmdp import __version__
from trackmdp.app.cli import COMMANDS, main
from trackmdp.app.manual import EXAMPLES, USED
from trackmdp.config import GROUPS, ROOTS, options

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_every_option_with_range_unit_and_default(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "all", "--help"]) == 0
    text = capsys.readouterr().out
    flat = " ".join(text.split())
    for key, item in of_command(command):
        assert f" {key}=" in text, key
        assert f"{item.help}; {item.expected}" in flat, key
    for group in set(options(ROOTS[command])) & set(GROUPS):
        for name in GROUPS[group]:
            assert f"  {group}={name}: " in text
    assert max(map(len, text.splitlines())) < 80
    assert [text.count(f"  {line}\n") for line in EXAMPLES[command]] == [1] * len(EXAMPLES[command])
    assert text.index("Examples") < text.index("Options")


@pytest.mark.parametrize("command", USED)
def test_help_fits_a_screen(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """80 lines of 80 columns: the options used most, every group's choices, the way to the other options."""
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert len(lines) <= 80 and max(map(len, lines)) < 80
    every = dict(of_command(command))
    for key in USED[command]:
        assert f"  {key}=" in text and every[key].help in " ".join(text.split()), key
    for group in set(options(ROOTS[command])) & set(GROUPS):
        assert all((name in text) == (name != "given") for name in GROUPS[group])
    assert f"trackmdp {command} --help all lists every option" in text
    # Of a choice only where there are any.
    choices = bool(set(options(ROOTS[command])) & set(GROUPS))
    assert ("Choices" in lines, "kernel=random_walk --help" in text) == (choices, choices)


def test_a_module_run_by_python_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "trackmdp", "--version"],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, f"trackmdp {__version__}\n")


@pytest.mark.parametrize(
    ("words", "shown", "hidden"),
    [
        (["algo=ppo"], "algo.clip_epsilon=0.2", ["algo.blend", "kernel.", "algo.buffer_size"]),
        (
            ["algo=ppo_per_sensor"],
            "algo.surrogate=all_action",
            ["algo.gae_lambda", "  kernel."],
        ),
        (["kernel=drift", "seed=3"], "kernel.persistence=", ["kernel.stay", "algo."]),
        (["hydra/launcher=submitit_slurm"], "hydra.launcher.partition=null", ["n_jobs", "algo."]),
    ],
)
def test_help_of_a_choice_shows_what_it_reads(
    words: list[str], shown: str, hidden: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", *words, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"  {shown}" in text
    assert not any(word in text for word in hidden)
    assert max(map(len, text.splitlines())) < 80
    assert text.endswith("\ntrackmdp train --help all lists every option.\n")
    assert text.index("Examples\n  trackmdp train ") < text.index(shown)
    assert refused(capsys, "train", "algo=sac", "--help").startswith("algo=sac: expected one of ")


def test_help_of_another_word_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for word in ("alll", "kernel", "drift"):
        told = refused(capsys, "train", "--help", word)
        assert told == f"--help {word}: expected all, group=choice or option=value"


def test_examples_of_the_help_can_be_typed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for lines in EXAMPLES.values():
        for line in lines:
            main(
                [word for word in line.split()[1:] if word != "-m" and "," not in word]
                + ["--cfg", "job"]
            )
            assert capsys.readouterr().err == "", line


def test_help_shows_the_values_of_conf(capsys: pytest.CaptureFixture[str]) -> None:
    main(["train", "-h", "all"])
    text = capsys.readouterr().out
    for expected in (
        "grid.size=10 ",
        "grid.max_steps=null ",
        "kernel.low_probability=0.15 ",
        "quiet=false ",
        "seed=0 ",
    ):
        assert f" {expected}" in text
    assert "cost.sensor=0.16 " in text
    assert "  algo.entropy: weight of the entropy bonus\n  algo.entropy.start=0.15 " in text
    assert "(default: random_support)" in " ".join(text.split())


def test_overview_and_unknown_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {command} " in text for command in COMMANDS)
    assert max(map(len, text.splitlines())) < 80
    assert main(["trian"]) == 2
    assert capsys.readouterr().err.startswith(
        "trackmdp: unknown command 'trian': expected one of train, "
    )
    assert main(["exampel"]) == 2
    assert "report, example" in capsys.readouterr().err


def test_help_and_first_line_import_nothing_heavy() -> None:
    code = """
import sys
from trackmdp import __version__
from trackmdp.app.cli import main
import trackmdp.app.prepare
def say(line):
    sys.exit(str(sorted({"torch", "torchrl", "scipy"} & set(sys.modules))))
trackmdp.app.prepare.say = say
main(["train", "--help"])
main(["train"])
"""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT, check=False
    )
    assert result.stderr == "[]\n"


def test_an_example_is_printed_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(__file__).parents[2] / "scripts" / "examples"
    assert main(["example"]) == 0
    names = capsys.readouterr().out.split()
    assert {file.stem for file in folder.glob("*.py")} <= set(names) and "city.csv" in names
    assert main(["example", "own_policy"]) == 0
    assert capsys.readouterr().out == (folder / "own_policy.py").read_text()
    for names in (["own"], ["own_policy", "memory"]):
        assert main(["example", *names]) == 2
        message = f"trackmdp: example {' '.join(names)}: expected one of "
        assert capsys.readouterr().err.startswith(message)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resume=auto"], "resume=auto: expected hydra.run.dir=FOLDER"),
        (["-m", "seed=0,1", "hydra.sweep.subdir=a"], "hydra.sweep.subdir=a: without effect"),
        (["-m", "seed=0,1", "hydra.run.dir=a"], "hydra.run.dir=a: without effect, the folder of a"),
        (["hydra.sweep.dir=a"], "hydra.sweep.dir=a: without effect on a single run, expected -m"),
        (["hydra/launcher=joblib"], "hydra/launcher=joblib: without effect on a single run"),
    ],
)
def test_words_without_effect_are_refused(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refused(capsys, "train", *words).startswith(message)
