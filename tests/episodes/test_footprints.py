"""Logs of sensors with footprints: re-simulated to the bit, read, recovered, played back, and refused where changed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.special import comb

from tests.helpers import small_world
from trackmdp.app.cli import main
from trackmdp.episodes.episode_page import page
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.policy import Policy
from trackmdp.sensing.coverage import discs
from trackmdp.world.model import World

WORDS = [
    "sensor=footprint",
    "grid.size=4",
    "cost.sensor=.3",
    "kernel.exit_probability=.1",
    "quiet=true",
]


def _world() -> World:
    places = np.array([(0, 0), (0, 2), (2, 0), (2, 2)])
    return World.of(
        small_world(),
        small_world().kernel,
        coverage=discs((3, 3), places, 1),
        cost=[0.1, 0.2, 0.3, 0.4],
    )


def _log(folder: Path, *policies: Policy) -> Path:
    world = _world()
    log = EpisodeLog(folder, world, seed=3, config="{}", layout=False, tell=print)
    for number, policy in enumerate(policies):
        log.add(simulate(world, policy, 6, seed=3, names=[number]), {"label": f"{number}"})
    assert log.close()
    return folder / "episodes.mcap"


def test_a_log_is_simulated_again_to_the_bit_and_recovered(tmp_path: Path) -> None:
    world, rng = _world(), np.random.default_rng(0)
    chains = Policy.from_dense(world, rng.random((9, 2, 4)) < 0.5)
    file = _log(tmp_path, chains, Policy.random_k(world, 2), Policy.all_on(world))
    with EpisodeReader(file) as reader:
        assert verify(reader).difference is None
        again = reader.world()
        assert again.coverage is not None
        assert again.coverage.same_as(world.coverage)
        assert np.array_equal(again.cost, world.cost)
        episode = reader.read(0)
        assert episode.action.shape[1] == 4
        assert episode.probability is not None
        # A policy that does not draw sees a cell or not: what its sensors cover.
        assert np.array_equal(episode.probability > 0, world.covered(episode.action))
        mixed = reader.read(7).probability
        assert mixed is not None
        assert world.coverage is not None
        # All d sensors of a cell are off in C(4 - d, 2) of the C(4, 2) = 6 pairs.
        assert mixed[0] == pytest.approx(
            1 - comb(4 - np.diff(world.coverage.by_cell.indptr), 2) / 6
        )
        assert reader[0]["action"].shape[1] == 4
        whole = [reader.read(row["episode"]) for row in reader.rows]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-3000])
    with EpisodeReader(recover(cut).file) as reader:
        assert verify(reader).difference is None
        assert np.array_equal(reader.read(0).action, whole[0].action)


def test_a_page_counts_sensors_and_frames_what_they_see(tmp_path: Path) -> None:
    """Sensor 0 of `_world` sees the corner and the two cells beside it."""
    chains = np.zeros((9, 2, 4), dtype=bool)
    chains[..., 0] = True
    with EpisodeReader(_log(tmp_path, Policy.from_dense(_world(), chains))) as reader:
        content = re.search(
            r'type="application/json">(.*?)</script>', page(reader.world(), reader.read(0))
        )
    assert content is not None
    said = json.loads(content[1])
    assert (said["on"][0], said["sensed"][0], said["frame"]) == (1, [0, 2, 3, 4], "cell sensed")


def test_beliefs_leave_out_what_was_covered(tmp_path: Path) -> None:
    """Predicted .45 and .45 over two of three cells; the sensor of the first two saw nothing: the third is certain."""
    kernel = np.array([[0.3, 0.3, 0.3], [0.3, 0.3, 0.3], [0.0, 0.0, 0.9]])
    world = World(kernel, (1, 3), cost=0.1, t_max=1, coverage=[[1, 1, 0]])
    for episode in simulate(world, Policy.all_on(world), 40).complete():
        assert episode.belief is not None
        for t in np.flatnonzero(episode.misses[1:] == 1) + 1:
            assert episode.belief[t] == pytest.approx([0.0, 0.0, 0.9])


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    there = f"hydra.run.dir={run}"
    assert main(["evaluate", *WORDS, "baseline=clocked", "episodes=12", "log=[mcap]", there]) == 0
    file = run / "episodes.mcap"
    assert main(["replay", f"file={file}", "verify=true"]) == 0
    assert "the same to the bit" in capsys.readouterr().out
    assert (
        main(["replay", f"file={file}", f"html={tmp_path / 'a.html'}", f"csv={tmp_path / 'csv'}"])
        == 0
    )
    assert (tmp_path / "csv" / "steps.csv").read_text().count("\n") > 12
    assert main(["replay", f"file={file}", "episode=0"]) == 0
    again = ["baseline=playback", f"baseline.file={file}", "baseline.episode=0", "episodes=3"]
    assert main(["evaluate", *WORDS, *again, f"hydra.run.dir={tmp_path / 'again'}"]) == 0
    capsys.readouterr()
    # Actions of four sensors say nothing to sixteen, nor to four that see more.
    for others in ([], [WORDS[0], "sensor.radius=3"]):
        there = f"hydra.run.dir={tmp_path / 'other'}"
        assert main(["evaluate", *WORDS[1:], *others, *again, there]) == 2
        assert "with sensors of other footprints" in capsys.readouterr().err
    assert main(["solve", *WORDS, f"hydra.run.dir={tmp_path / 'solved'}"]) == 0
    sets = ["baseline=sets", f"baseline.file={tmp_path / 'solved' / 'sets.json'}", "episodes=0"]
    assert main(["evaluate", *WORDS, *sets, f"hydra.run.dir={tmp_path / 'valued'}"]) == 0
