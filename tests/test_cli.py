"""The command line as a user types it: bad input, sweeps, tracebacks."""

from __future__ import annotations

import os
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.config.cases import composed
from tests.typed import ROOT, refused, stub, typed
from trackmdp.app.cli import COMMANDS, main
from trackmdp.app.sweep.plan import sweep_name
from trackmdp.config import GROUPS, ROOTS, options
from trackmdp.errors import UserError

pytestmark = pytest.mark.usefixtures("empty_folder")

LONG = "a" * 300  # longer than a name may be


@pytest.mark.parametrize(("given", "found"), [(None, "1"), ("3", "3")])
def test_exact_figures_do_not_depend_on_the_number_of_cores(
    given: str | None, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NumPy reads the variable when it is imported; as soon as it shares a sum out, the sum rounds differently."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    assert main(["--version"]) == 0
    assert os.environ["OPENBLAS_NUM_THREADS"] == found


@pytest.mark.parametrize("group", [group for group in GROUPS if "/" not in group])
def test_unknown_choices_are_refused_naming_the_known_ones(
    group: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = next(command for command, root in ROOTS.items() if group in options(root))
    # The price of a sensor, say, is meant by a number: that message has a line among the mistakes below.
    numbers = [] if group in ("cost", "sensor") else ["3"]
    # `given` stands for a problem made in Python, and cannot be typed.
    names = [name for name in GROUPS[group] if name != "given"]
    for bad in ("nothing_of_the_kind", "null", *numbers):
        end = ", or log=[] for none" if (group, bad) == ("log", "null") else ""
        assert (
            refused(capsys, command, f"{group}={bad}")
            == f"{group}={bad}: expected one of {', '.join(names)}{end}"
        )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train grid.sise=5", "grid.sise: unknown option, did you mean grid.size?"),
        ("train +sead=5", "sead: unknown option, did you mean seed?"),
        ("train grid=5", "grid=5: expected grid.size=value"),
        ("train ~grid.size", "~grid.size: expected grid.size=value, without + or ~"),
        ("train size", "size: expected option=value"),
        ("train grid.size=[", "grid.size=[: expected option=value"),
        (
            "replay file=möß.mcap",
            "file=möß.mcap: expected option=value (a value with commas or letters beyond a to z needs quotes: ",
        ),
        ("train hydra.run.dir=~/a", "hydra.run.dir=~/a: expected $HOME in place of ~"),
        ("train seed=0,1", "seed=0,1: expected one value; add -m"),
        ("train algo=[a2c,ppo]", "algo=[a2c,ppo]: expected one choice, not a list"),
        ("train -m seed=range(10000000)", "seed=range(10000000): expected 1 to 100,000 values"),
        (
            "train -m seed=range(1000) kernel.seed=range(1000)",
            "a sweep of 1,000,000 runs: expected at most 100,000",
        ),
        ("train -m seed=range(0,1,0)", "seed=range(0,1,0): range() arg 3 must not be zero"),
        ("train seed=glob(*)", "seed=glob(*): expected the values themselves, separated by commas"),
        ("train seed=${nope:1} seed=-1", "seed=-1: expected an integer >= 0"),
        ("train --sizzle", "unrecognized arguments: --sizzle"),
        ("train --config-dir nowhere", "--config-dir nowhere: no such folder"),
        ("train --experimental-rerun x", "--experimental-rerun: not offered"),
        ("train kernel=table", "kernel.path: missing, expected a path"),
        ("train ~kernel", "kernel: missing, expected kernel=NAME"),
        ("train algo.epoch=3", "algo.epoch: unknown option, did you mean algo.epochs?"),
        ("train log.evry=3", "log.evry: unknown option, did you mean log.csv.every?"),
        ("evaluate run=", "run=: expected "),
        ("train kernel=table kernel.path=", "kernel.path=: expected a path"),
        ("train seed=${nope}", "seed: Interpolation key 'nope' not found"),
        ("train ~seed", "~seed: expected seed=value, without + or ~"),
        ("train ~optimal", "~optimal: expected optimal.enabled=value"),
        ("train ~grid", "~grid: expected grid.size=value"),
        ("train kernel=table kernel.path=no.npy", "kernel.path="),
        (
            "train kernel.exit_probability=0",
            "kernel=random_support: from cell 0 the target never exits",
        ),
        # The size, and not the frames that follow from it.
        ("train grid.size=1000000 quiet=true", "grid.size=1000000: needs about"),
        ("train cost.sensor=no.csv", "cost.sensor="),
        ("train algo={name:ppo}", "algo={'name': 'ppo'}: expected one of "),
        ("train algo=a2c credit=per_sensor", "credit: renamed, expected algo=a2c_per_sensor"),
        ("train algo=ppo algo.lr=1", "algo.lr: renamed, expected algo.learning_rate"),
        ("train hydra.run.dir=???", "hydra.run.dir: missing, expected a folder"),
        ("train hydra.run.dir=${nope}", "hydra.run.dir: Interpolation key 'nope' not found"),
        ("train -m seed=0,1 hydra.sweep.dir=???", "hydra.sweep.dir: missing, expected a folder"),
        ("solve grid.size=3 hydra.run.dir=", "hydra.run.dir=: empty, expected a folder"),
        ("solve -m seed=0,1 hydra.sweep.dir=", "hydra.sweep.dir=: empty, expected a folder"),
        (
            f"train hydra.run.dir={LONG}",
            f"hydra.run.dir={LONG}: expected a folder that can be written to",
        ),
        (f"train resume={LONG}", f"{Path('/')}"),
        (f"train kernel=table kernel.path={LONG}", f"kernel.path={Path('/')}"),
        ("replay file=log.mcap html=/", "html=/: expected a file to write, not a folder"),
        ("replay file=log.mcap layout=/dev/null", "layout=/dev/null: expected a file to write"),
        ("train cost=0.2", "cost=0.2: expected cost.sensor=0.2"),
        ("train sensor=0.9", "sensor=0.9: expected sensor=miss sensor.p_d=0.9"),
        ("train cost=my/c.csv", "cost=my/c.csv: expected cost.sensor=my/c.csv"),
        ("train sensor=c.npz", "sensor=c.npz: expected sensor=footprint sensor.path=c.npz"),
        ("train kernel=k.npy", "kernel=k.npy: expected kernel=table (or tracks) kernel.path=k.npy"),
        (
            "train kernel.path=x.npy",
            "kernel.path: an option of another choice, expected kernel=table or kernel=tracks",
        ),
        (
            "train seed=${oc.env:NONE,4}",
            "seed: the text '4', expected an integer >= 0 (from the environment: "
            '"${oc.decode:${oc.env:NAME}}")',
        ),
        (
            'train seed="${oc.decode:${oc.env:NONE,-4}}"',  # in this form it is read
            "seed=-4: expected an integer >= 0",
        ),
        ("train --seed 3", "unrecognized arguments: --seed (write seed=VALUE)"),
        (
            "train +experiment=paper",
            "+experiment=paper: in the config already, expected experiment=paper",
        ),
        ("train --shell-completion x", "--shell-completion x: expected install=bash or query=bash"),
        ("train -sc install=zsh", "--shell-completion install=zsh: expected install=bash or"),
        ("train --cfg job --package nope", "--package nope: not in the config"),
        ("train --package grid", "--resolve and --package: only together with --cfg"),
        ("train --cfg job -m", "argument --multirun/-m: not allowed with argument --cfg/-c"),
        (
            "train hydra.verbose={a:1}",
            "hydra.verbose: expected true, false, or a list of loggers",
        ),
        (
            "train +algo._target_=os.system",
            "algo._target_: unknown option",
        ),
        (
            "train -m seed=0,1 ++hydra.sweeper._target_=os.system",
            "hydra.sweeper._target_: unknown option",
        ),
        (
            "train +hydra.callbacks.x._target_=os.getcwd",
            "hydra.callbacks: not read",
        ),
        ("train hydra.searchpath=[pkg://email]", "hydra.searchpath: expected --config-dir FOLDER"),
        ("train --config-path mine", "--config-path: expected --config-dir FOLDER"),
        ("train -cp mine", "--config-path: expected --config-dir FOLDER"),
        (
            "train -m seed=0,1 hydra/launcher=basic,joblib",
            "hydra/launcher=basic,joblib: expected one launcher",
        ),
        (f"train seed={'1' * 5000}", f"seed={'1' * 5000}: expected option=value"),
        (f"train device=cuda:{'9' * 20}", f"device=cuda:{'9' * 20}: no such device"),
        ("train collector.device=cuda:99", "collector.device=cuda:99: no such device"),
        (
            "train hydra.sizzle=1",
            "Could not override 'hydra.sizzle': Key 'sizzle' not in 'HydraConf'",
        ),
        ("evaluate", "expected exactly one of run=FOLDER and baseline=NAME, got neither"),
        ("evaluate run=nowhere", "run="),
        ("evaluate run=. baseline=qmdp", "expected exactly one of"),
        ("evaluate run=nowhere grid.size=5", "grid.size=5: not together with run="),
        ("evaluate run=nowhere kernel=drift", "kernel=drift: not together with run="),
        ("train baseline.k=3", "baseline.k=3: train has no baseline"),
        ("solve algo=ppo", "algo=ppo: solve has no algo"),
        (
            "train log.mcap.episodes=3",
            "log.mcap.episodes: an option of another choice, expected log=mcap beside it",
        ),
        (
            "train algo=ppo algo.ppo.epochs=3",
            "algo.ppo.epochs: unknown option, did you mean algo.epochs?",
        ),
        ("train ++resume=auto", "resume=auto: expected hydra.run.dir=FOLDER beside it"),
        ("report sweep=. every=3", "every=3: without effect with watch=false"),
        (
            "report sweep=. watch=true threshold=1",
            "threshold=1: without effect with watch=true",
        ),
        ("replay file=x layout=y episode=3", "episode=3: without effect with layout= or recover="),
        ("replay file=x recover=true episode=3", "episode=3: without effect with layout= or"),
        ("replay file=x speed=2", "speed=2: without effect where no episode is played"),
        ("replay file=x speed=2 episode=0 verify=true", "speed=2: without effect where no"),
        (
            "evaluate baseline=qmdp log=[mcap] episodes=0",
            "episodes=0: expected at least 1 with log=[mcap]",
        ),
    ],
)
def test_mistakes_end_in_one_line(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refused(capsys, *words.split()).startswith(message)


def test_kernel_files_are_checked_before_a_folder_is_made(
    tmp_path: Path, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "wrong.npy", np.eye(9) * 0.9)
    (tmp_path / "broken.npy").write_bytes(b"nothing")
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    for name, message in (
        ("wrong.npy", "9 rows, but a 10x10 grid has 100 cells"),
        ("broken.npy", "not a table of numbers"),
        ("objects.npy", "not a table of numbers"),
    ):
        assert message in refused(capsys, "train", "kernel=table", f"kernel.path=../{name}")


def test_price_files_are_checked_before_a_folder_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "short.csv").write_text("1,2,3\n")
    (tmp_path / "negative.csv").write_text("\n".join(["1,1,1", "1,-2,1", "1,1,1"]))
    (tmp_path / "broken.csv").write_text("a,b\n")
    (tmp_path / "empty.csv").touch()
    (tmp_path / "semicolons.csv").write_text("1;1;1\n" * 3)
    for name, message in (
        ("short.csv", "3 values, expected one number or 9"),
        ("negative.csv", "cell 4 has -2, expected"),
        ("broken.csv", "not a table of numbers"),
        ("empty.csv", "empty.csv: not a table of numbers (no numbers in it)"),
        ("semicolons.csv", "column 1; expected numbers with commas between them)"),
    ):
        assert message in refused(capsys, "train", "grid.size=3", f"cost.sensor=../{name}")


def test_a_folder_that_cannot_be_made_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for option, flags in (("hydra.run.dir", []), ("hydra.sweep.dir", ["-m"])):
        line = refused(capsys, "train", *flags, f"{option}=../file/run")
        assert (
            line
            == f"{option}=../file/run: expected a folder that can be written to (Not a directory)"
        )


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "expected a folder that can be written to" in refused(
        capsys, "train", "hydra.run.dir=../locked/run"
    )


def test_a_mistake_found_by_the_command_leaves_no_folder(
    monkeypatch: pytest.MonkeyPatch, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(cfg: Any, folder: Path) -> None:
        raise UserError("device=cuda: no such device")

    stub(monkeypatch, "train", run)
    assert refused(capsys, "train", "quiet=true") == "device=cuda: no such device"


def test_a_bug_shows_its_traceback_and_ends_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(cfg: Any, folder: Path) -> None:
        raise ZeroDivisionError("a bug")

    stub(monkeypatch, "train", run)
    assert main(["train"]) == 1
    assert "Traceback" in (said := capsys.readouterr().err)
    assert "ZeroDivisionError: a bug" in said


def test_full_error_shows_the_traceback_of_a_mistake(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    assert main(["train", "grid.size=0"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("Traceback")
    assert (
        said[-1]
        == "trackmdp train: grid.size=0: expected an integer >= 1, or a pair of them (cells)"
    )


def test_a_run_gets_its_config_and_its_folder(
    monkeypatch: pytest.MonkeyPatch, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []
    stub(monkeypatch, "train", lambda cfg, folder: calls.append((cfg, folder)))
    assert main(["train", "algo=ppo", "grid.size=5", "seed=3", "hydra.run.dir=runs/a b"]) == 0
    assert (
        capsys.readouterr().out
        == "train ppo on a 5x5 grid, T_max 1, kernel random_support, seed 3 -> runs/a b\n"
    )
    assert calls == [
        (composed("train", "algo=ppo", "grid.size=5", "seed=3"), empty_folder / "runs/a b")
    ]
    assert main(["train", "quiet=true"]) == 0
    assert capsys.readouterr().out == ""
    assert re.fullmatch(
        r"runs/\d{4}-\d\d-\d\d/\d\d-\d\d-\d\d-\d{6}", str(calls[1][1].relative_to(empty_folder))
    )


def test_a_sweep_with_a_wrong_type_or_choice_starts_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert (
        refused(capsys, "train", "-m", "quiet=true", "seed=0,abc")
        == "seed=abc: expected an integer >= 0"
    )
    assert refused(capsys, "train", "-m", "quiet=true", "algo=ppo,sac").startswith(
        "algo=sac: expected one of "
    )


def test_a_config_is_shown_resolved_with_the_folder_of_its_sweep(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["kernel.support_size=3"]
    assert main(["train", *words, "--cfg", "hydra", "--resolve", "-p", "hydra.sweep.dir"]) == 0
    assert capsys.readouterr().out.strip() == f"multirun/{sweep_name('train', words, [])}"


def test_what_a_terminal_would_obey_is_spelled_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert "\\x1b[31mred" in refused(capsys, "evaluate", "run='\x1b[31mred'")


def test_a_mistake_typed_in_a_shell(empty_folder: Path) -> None:
    result = typed("train", "grid.size=0")
    assert (result.returncode, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert result.stderr.startswith("trackmdp train: grid.size=0: expected")
    assert not list(empty_folder.iterdir())


def test_scripts_are_the_commands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in COMMANDS:
        monkeypatch.setattr(sys, "argv", [f"{command}.py", "quiet=perhaps"])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / "scripts" / f"{command}.py"), run_name="__main__")
        assert ended.value.code == 2
        assert capsys.readouterr().err.startswith(
            f"trackmdp {command}: quiet=perhaps: expected true or false"
        )
