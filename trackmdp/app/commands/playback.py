"""`evaluate baseline=playback`: the actions of a logged episode again, on its own target and on others."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console

from trackmdp.config import EvaluateConfig, PlaybackConfig
from trackmdp.durable import write_json
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.simulate import resimulate, simulate
from trackmdp.errors import UserError
from trackmdp.policies.playback import Playback
from trackmdp.training.display import table
from trackmdp.world.modes import Modelled
from trackmdp.world.tracks import Problem, Recorded


def run(cfg: EvaluateConfig, folder: Path, world: Problem, console: Console) -> float:
    """Write `evaluation.json` to `folder`; returns the simulated AIHTR.

    Such a policy ignores what it observes, so that it has no table and no exact value.
    """
    assert isinstance(cfg.baseline, PlaybackConfig)
    assert not isinstance(world, Recorded)  # they are refused
    with EpisodeReader(cfg.baseline.file) as reader:
        recorded = reader.run.size
        if recorded != world.size:
            raise UserError(
                f"baseline.file={cfg.baseline.file}: recorded on a grid of size {_size(*recorded)}, "
                f"expected grid.size={_size(*world.size)}"
            )
        logged = reader.read(cfg.baseline.episode)
    # The logged episode's own seed gives its own target again, so that both returns agree where nothing has changed
    # since.
    again = reissued(world, logged)
    simulation = simulate(world, Playback(world, logged.action), cfg.episodes, seed=cfg.seed).figures()
    report = {
        "policy": cfg.baseline.name,
        "file": Path(cfg.baseline.file).name,
        "episode": logged.number,
        "logged_return": float(logged.returns[-1]),
        "return": float(again.returns[-1]),
        "simulated": asdict(simulation),
    }
    write_json(folder / "evaluation.json", report)
    rows = [
        ["logged", f"{report['logged_return']:,.4f}"],
        ["again, on the same target", f"{report['return']:,.4f}"],
        [f"on {cfg.episodes} other targets", f"{simulation.aihtr.mean:,.4f} ± {simulation.aihtr.standard_error:.4f}"],
    ]
    console.print(table(f"actions of episode {logged.number}", ["", "return"], rows))
    console.print(f"results in {folder}")
    return simulation.aihtr.mean


def _size(rows: int, columns: int) -> str:
    return str(rows) if rows == columns else f"[{rows},{columns}]"


def reissued(world: Modelled, logged: Episode) -> Episode:
    """The episode with its own seed and its own actions, in `world`."""
    (again,) = resimulate(world, Playback(world, logged.action), [logged.seed]).complete()
    return replace(again, number=logged.number)
