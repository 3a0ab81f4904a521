"""Checks that run before anything is built: every range, every rule between two options."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from types import NoneType
from typing import Any

from trackmdp.config.baselines import AllOnConfig, NoSensorsConfig, PlaybackConfig, RandomKConfig
from trackmdp.config.learning import CollectorConfig, DqnConfig, McapConfig, PpoConfig, ScheduleConfig, WorkersConfig
from trackmdp.config.options import Option, options, refuse
from trackmdp.config.per_sensor import PerSensorConfig
from trackmdp.config.roots import (
    BenchmarkConfig,
    CommandConfig,
    EvaluateConfig,
    ExportConfig,
    ReplayConfig,
    ReportConfig,
    SolveConfig,
    TrainConfig,
    WorldConfig,
)
from trackmdp.config.world import CostConfig, PaperCostConfig, RandomSupportConfig, TableConfig, TracksConfig
from trackmdp.errors import UserError

__all__ = ["absolute_paths", "leaves", "validate"]


def leaves(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Option, Any]]:
    """Every option of a config with its dotted key and its value."""
    for name, described in options(type(cfg)).items():
        key, value = f"{prefix}{name}", vars(cfg)[name]
        if isinstance(described, Option):
            yield key, described, value
        elif value is not None:
            yield from leaves(value, f"{key}.")


def nodes(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every dataclass of a config with its dotted key, the outermost first."""
    yield prefix, cfg
    for name, value in vars(cfg).items():
        if dataclasses.is_dataclass(value):
            yield from nodes(value, f"{prefix}.{name}".lstrip("."))


def validate(cfg: CommandConfig) -> None:
    """Raise a `UserError` naming key, value and allowed range for the first option that breaks a rule."""
    for key, described, value in leaves(cfg):
        if not described.allows(value):
            raise refuse(key, value, described.expected)
        if key.split(".")[-1] == "device":
            _check_device(key, value)
    for key, node in nodes(cfg):
        if isinstance(node, ScheduleConfig) and node.until < node.begin:
            raise refuse(f"{key}.until", node.until, f"not less than {key}.begin={node.begin}")
    if not isinstance(cfg, WorldConfig):
        return
    _check_kernel(cfg)
    _check_tracks(cfg)
    _check_cost(cfg.cost, cfg.grid.size**2)
    if isinstance(cfg, TrainConfig):
        _check_collector(cfg.collector)
        _check_learning(cfg)
    if isinstance(cfg, EvaluateConfig):
        _check_judged(cfg)


def absolute_paths(cfg: CommandConfig, folder: Path) -> None:
    """Resolve every path of the config against `folder`, where the user typed the command."""
    if isinstance(cfg, ReplayConfig):
        cfg.file = str(folder / cfg.file)
        cfg.html, cfg.csv, cfg.layout = (path and str(folder / path) for path in (cfg.html, cfg.csv, cfg.layout))
    if isinstance(cfg, ExportConfig):
        cfg.run = str(folder / cfg.run)
    if isinstance(cfg, ReportConfig):
        cfg.sweep = str(folder / cfg.sweep)
    if not isinstance(cfg, WorldConfig):
        return
    if isinstance(cfg.kernel, (TableConfig, TracksConfig)):
        cfg.kernel.path = str(folder / cfg.kernel.path)
    if isinstance(cfg.cost, PaperCostConfig) and isinstance(cfg.cost.sensor, str):
        cfg.cost.sensor = str(folder / cfg.cost.sensor)
    if isinstance(cfg, EvaluateConfig) and cfg.run is not None:
        cfg.run = str(folder / cfg.run)
    if isinstance(cfg, EvaluateConfig) and isinstance(cfg.baseline, PlaybackConfig):
        cfg.baseline.file = str(folder / cfg.baseline.file)
    if isinstance(cfg, TrainConfig):
        if cfg.resume not in (None, "auto"):
            cfg.resume = str(folder / cfg.resume)
        cfg.init_from = cfg.init_from and str(folder / cfg.init_from)
    if isinstance(cfg, BenchmarkConfig) and cfg.peers is not None:
        cfg.peers = str(folder / cfg.peers)


def _check_device(key: str, value: str) -> None:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", value):
        raise refuse(key, value, "cpu, cuda, cuda:N or auto")


def _check_kernel(cfg: WorldConfig) -> None:
    kernel = cfg.kernel
    if not isinstance(kernel, RandomSupportConfig):
        return
    window = (2 * kernel.radius + 1) ** 2
    if kernel.support_size > window:
        where = f"kernel.radius={kernel.radius} gives"
        raise refuse(
            "kernel.support_size", kernel.support_size, f"an integer from 1 to {window} ({where} {window} cells)"
        )
    if kernel.low_probability + kernel.exit_probability >= 1:
        expected = f"less than 1 - kernel.exit_probability = {1 - kernel.exit_probability:g}"
        raise refuse("kernel.low_probability", kernel.low_probability, expected)


def _check_tracks(cfg: WorldConfig) -> None:
    """Recorded tracks hold no motion model."""
    if not isinstance(cfg.kernel, TracksConfig):
        return
    if not isinstance(cfg, (TrainConfig, EvaluateConfig)):
        raise refuse("kernel", "tracks", "a motion model, which train and evaluate do without")
    if isinstance(cfg.log, McapConfig):
        raise refuse("log", "mcap", "csv or tensorboard with kernel=tracks; episodes are logged with a motion model")
    if isinstance(cfg, EvaluateConfig) and not isinstance(
        cfg.baseline, (AllOnConfig, NoSensorsConfig, RandomKConfig, NoneType)
    ):
        raise refuse(
            "baseline", cfg.baseline.name, "all_on, none or random_k with kernel=tracks, without a motion model"
        )


def _check_cost(cost: CostConfig, cells: int) -> None:
    if not isinstance(cost, PaperCostConfig):
        return
    price = cost.sensor
    expected = f"a number >= 0, a list of {cells} of them (one per cell), or a path to a .npy or .csv file"
    if isinstance(price, str):
        if Path(price).suffix not in (".npy", ".csv"):
            raise refuse("cost.sensor", price, expected)
        return
    number = Option("", ge=0, kind=float)
    prices = price if isinstance(price, list) else [price]
    if isinstance(price, list) and len(price) != cells:
        raise UserError(f"cost.sensor: {len(price)} values, expected one number or {cells} (one per cell)")
    for index, value in enumerate(prices):
        if value is None or not number.allows(value):
            key = f"cost.sensor[{index}]" if isinstance(price, list) else "cost.sensor"
            raise refuse(key, value, "a finite number >= 0" if isinstance(price, list) else expected)


def _check_collector(collector: CollectorConfig) -> None:
    workers = collector.workers if isinstance(collector, WorkersConfig) else 1
    stepped = collector.envs * workers
    if collector.frames_per_batch % stepped:
        expected = f"a multiple of {stepped} (collector.envs" + (" x collector.workers)" if workers > 1 else ")")
        raise refuse("collector.frames_per_batch", collector.frames_per_batch, expected)
    if collector.total_frames < collector.frames_per_batch:
        expected = f"at least collector.frames_per_batch={collector.frames_per_batch}"
        raise refuse("collector.total_frames", collector.total_frames, expected)


def _check_learning(cfg: TrainConfig) -> None:
    algo, frames = cfg.algo, cfg.collector.frames_per_batch
    if isinstance(algo, PpoConfig) and frames % algo.minibatches:
        raise refuse("algo.minibatches", algo.minibatches, f"a divisor of collector.frames_per_batch={frames}")
    if isinstance(algo, PerSensorConfig):
        for end in ("start", "end"):
            if (probability := getattr(algo.explore, end)) > 1:
                raise refuse(f"algo.explore.{end}", probability, "a number from 0 to 1, a probability")
    if isinstance(algo, DqnConfig) and algo.buffer_size < max(frames, algo.batch_size):
        expected = f"at least collector.frames_per_batch={frames} and algo.batch_size={algo.batch_size}"
        raise refuse("algo.buffer_size", algo.buffer_size, expected)


def _check_judged(cfg: EvaluateConfig | SolveConfig) -> None:
    if isinstance(cfg, EvaluateConfig):
        if (cfg.run is None) == (cfg.baseline is None):
            given = "neither" if cfg.run is None else "both"
            raise UserError(f"expected exactly one of run=FOLDER and baseline=NAME, got {given}")
        if cfg.log is not None and not isinstance(cfg.log, McapConfig):
            raise refuse("log", cfg.log.name, "mcap or null; an evaluation has no iterations")
        if isinstance(cfg.baseline, PlaybackConfig) and cfg.log is not None:
            raise refuse("log", cfg.log.name, "null with baseline=playback, whose episodes are logged already")
        if isinstance(cfg.baseline, PlaybackConfig) and cfg.episodes == 0:
            raise refuse("episodes", 0, "at least 1 with baseline=playback, which is only simulated")
        if isinstance(cfg.baseline, RandomKConfig) and cfg.baseline.k > cfg.grid.size**2:
            cells = cfg.grid.size**2
            raise refuse(
                "baseline.k", cfg.baseline.k, f"at most {cells}, the sensors of a grid.size={cfg.grid.size} grid"
            )
