"""`evaluate` of the actions of a logged episode."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from trackmdp.config import EvaluateConfig, PlaybackConfig
from trackmdp.durable import write_json
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.simulate import resimulate, simulate
from trackmdp.errors import UserError
from trackmdp.notebook.card import grid_words
from trackmdp.policies.acting import Playback
from trackmdp.training.display import table
from trackmdp.world.problem import Problem


def evaluate_playback(
    cfg: EvaluateConfig, chosen: PlaybackConfig, world: Problem, folder: Path, console: Console
) -> float:
    """Value the actions of a logged episode, on its own target and on others; returns the simulated AIHTR.

    Such a policy ignores its observations, so that it has no table and no exact value.
    """
    with EpisodeReader(chosen.file) as reader:
        own = reader.world()
        recorded = f"baseline.file={chosen.file}: recorded"
        if own.single.size != world.size:
            on, expected = grid_words(own.single.size), grid_words(world.size)
            raise UserError(f"{recorded} on {on}, expected grid.size of {expected}")
        if own.single.footprints != world.footprints:
            raise UserError(f"{recorded} with sensors of other footprints than the world's")
        if own.targets:
            raise UserError(f"baseline.file={chosen.file}: of several targets, expected one")
        logged = reader.read(chosen.episode)
    actions = Playback(world, logged.action)
    # The logged episode's own seed gives its own target again, so that both returns agree where nothing has changed
    # since.
    again = resimulate(world, actions, [logged.seed])[0]
    simulation = simulate(world, actions, cfg.episodes, seed=cfg.seed).figures()
    report = {
        "policy": chosen.name,
        "file": Path(chosen.file).name,
        "episode": logged.number,
        "logged_return": float(logged.returns[-1]),
        "return": float(again.returns[-1]),
        "simulated": asdict(simulation),
    }
    write_json(folder / "evaluation.json", report)
    rows = [
        ["logged", f"{report['logged_return']:,.4f}"],
        ["again, on the same target", f"{report['return']:,.4f}"],
        [
            f"on {cfg.episodes} other targets",
            f"{simulation.aihtr.mean:,.4f} ± {simulation.aihtr.standard_error:.4f}",
        ],
    ]
    console.print(table(f"actions of episode {logged.number}", ["", "return"], rows))
    console.print(f"results in {folder}")
    return simulation.aihtr.mean
