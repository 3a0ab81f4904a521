"""Peers beside ours: a script that only pretends to learn stands for one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from trackmdp.app.bench.peers import chart
from trackmdp.app.cli import main

PEER = """
import json, sys
words = dict(zip(sys.argv[1::2], sys.argv[2::2]))
assert words["--stop-regret"] == "0.02" and words["--algo"] == "ppo" and words["--threads"] == "1"
assert (words["--z"], words["--c"], words["--t-max"]) == ("4", "0.2", "0")
rows = [{"seconds": 1.0, "steps": 10, "regret_per_step": 0.5}, {"seconds": 2.0, "steps": 20, "regret_per_step": LAST}]
json.dump({"final_regret": LAST, "curve": rows}, open(words["--json"], "w"))
print("said to nobody")
"""


def peers(folder: Path) -> Path:
    folder.mkdir()
    (folder / "good_peer.py").write_text(PEER.replace("LAST", "0.01"))
    (folder / "lost_peer.py").write_text(PEER.replace("LAST", "0.3"))
    (folder / "common.py").write_text("raise SystemExit('not a peer')")
    return folder


@pytest.mark.slow
def test_ours_and_the_peers_take_turns(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    world = ["kernel.support_size=4", "cost.sensor=0.2", "grid.t_max=0"]
    words = ["part=peers", "seeds=[3]", f"peers={peers(tmp_path / 'peers')}", *world]
    assert main(["benchmark", *words, f"hydra.run.dir={tmp_path}/run"]) == 0
    rows = json.loads((tmp_path / "run" / "benchmark.json").read_text())["rows"]
    assert [(row["learner"].split()[0], row["seed"]) for row in rows] == [("trackmdp", 3), ("good", 3), ("lost", 3)]
    ours, good, lost = rows
    assert ours["times_our_wall"] == ours["times_our_cpu"] == 1
    assert ours["last_regret"] < 0.005 < ours["goal"] == 0.02
    assert 0 < ours["frames"] <= 300_000
    assert good["frames"] == 20
    assert good["times_our_wall"] == pytest.approx(good["wall_seconds"] / ours["wall_seconds"])
    # Start and end of the process count, which took less than the seconds that the script claims.
    assert 0 < good["wall_seconds"] < 2 < ours["wall_seconds"]
    assert good["curve"]["seconds"][-1] == pytest.approx(good["wall_seconds"])
    assert lost["frames"] is lost["wall_seconds"] is lost["times_our_cpu"] is None
    assert lost["last_regret"] == 0.3
    out = capfd.readouterr().out
    assert "said to nobody" not in out
    assert "t trackmdp hindsight, g good ppo, l lost ppo" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "peers=null: part=peers needs the folder with the peers' scripts"),
        (["peers={tmp}/none"], "peers={tmp}/none: expected a folder with scripts called <name>_peer.py"),
        (["peers={tmp}/peers", "peers_python=[python]"], "peers_python: 1 interpreters, expected 2"),
        (["peers={tmp}/peers", "peers_python=[/no/python,/no/python]"], "peers_python=/no/python: no such file"),
        (["peers={tmp}/peers", "kernel=random_walk"], "part=peers: the peers know the default kernel"),
        (["peers={tmp}/peers", "kernel.seed=9"], "part=peers: the peers know the default kernel"),
    ],
)
def test_what_is_missing_is_said(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    peers(tmp_path / "peers")
    typed = [word.format(tmp=tmp_path) for word in words]
    assert main(["benchmark", "part=peers", f"hydra.run.dir={tmp_path}/run", *typed]) == 2
    assert message.format(tmp=tmp_path) in capsys.readouterr().err


def test_the_chart_has_a_mark_for_every_point() -> None:
    rows = [
        {"seed": 0, "learner": "ours x", "curve": {"seconds": [0.0, 5.0], "regret": [10.0, 0.0001]}},
        {"seed": 0, "learner": "peer y", "curve": {"seconds": [10.0], "regret": [0.1]}},
        {"seed": 1, "learner": "peer y", "curve": {"seconds": [90.0], "regret": [0.1]}},
    ]
    lines = chart(rows, 0).splitlines()
    assert lines[0] == "     10 |o"
    assert lines[5] == "    0.1 |" + 71 * " " + "p"
    assert lines[12] == " 0.0001 |" + 36 * " " + "o"
    assert [line.strip() for line in lines[1:5]] == ["|", "1 |", "|", "|"]
    assert "10 s" in lines[14]
