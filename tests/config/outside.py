"""A package with a kernel, an algorithm, a solver, a logger and a sensor, three files each, and a memory in one."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

__all__ = ["FILES", "install"]

FILES = {
    "outside/__init__.py": """
        from outside import fading_config, jump_config, lazy_config, lines_config, nearest_config
        from trackmdp.config import MEMORIES

        MEMORIES["misses"] = "outside.misses:Misses"
    """,
    # A kernel.
    "outside/jump.py": """
        from scipy import sparse

        def jump(size, *, stay, exit_probability):
            rows, columns = (size, size) if isinstance(size, int) else size
            m = rows * columns
            here = sparse.eye_array(m).tocsr()
            return (here * stay + here[::-1] * (1 - stay)) * (1 - exit_probability)

        def hidden(size, **options):
            jumps = jump(size, **options)
            return sparse.kron(jumps, sparse.eye_array(2)).tocsr(), 2
    """,
    "outside/jump_config.py": """
        from trackmdp.config import HiddenKernelConfig, KernelConfig, choice, option

        @choice("kernel", "hidden_jump", makes="outside.jump:hidden")
        class HiddenJumpConfig(HiddenKernelConfig):
            '''Has one of two modes.'''

            stay: float = option("probability of staying", ge=0, le=1)
            exit_probability: float = option("probability of leaving the grid", ge=0, lt=1)

        @choice("kernel", "jump", makes="outside.jump:jump")
        class JumpConfig(KernelConfig):
            '''Stays, or jumps to the opposite cell.'''

            stay: float = option("probability of staying", ge=0, le=1)
            exit_probability: float = option("probability of leaving the grid", ge=0, lt=1)
    """,
    "outside/conf/kernel/jump.yaml": """
        defaults: [base_jump]

        stay: 0.5
        exit_probability: 0.1
    """,
    "outside/conf/kernel/hidden_jump.yaml": """
        defaults: [base_hidden_jump]

        stay: 0.5
        exit_probability: 0.1
        reveals: false
    """,
    # An algorithm.
    "outside/lazy.py": """
        from trackmdp.policies.policy import Policy

        class Lazy:
            def __init__(self, task, cfg, *, iterations, seed, device):
                self.policy = self.actor = Policy.all_on(task)
                self.iterations, self.device, self._naps = iterations, device, cfg.naps

            def step(self, batch):
                return {"naps": float(self._naps)}

            def state_dict(self):
                return {}

            def load_state_dict(self, state):
                pass
    """,
    "outside/lazy_config.py": """
        from trackmdp.config import AlgoConfig, choice, option, refuse

        @choice("algo", "lazy", makes="outside.lazy:Lazy")
        class LazyConfig(AlgoConfig):
            '''Sleeps with all sensors on.'''

            naps: int = option("naps of the run", unit="naps", ge=0, le=9)
            bed: int = option("memory to sleep on", unit="bytes", ge=1)

            def check(self, key, root):
                if self.naps > root.collector.envs:
                    raise refuse(f"{key}.naps", self.naps, f"at most collector.envs={root.collector.envs}")

            def needs(self, task, root):
                return {"algo.bed": self.bed}
    """,
    "outside/conf/algo/lazy.yaml": """
        defaults: [base_lazy]

        total_frames: 1024
        frames_per_batch: 256
        envs: 32
        naps: 1
        bed: 1
    """,
    # A solver.
    "outside/nearest.py": """
        import numpy as np
        from trackmdp.policies.policy import Policy

        def solve(world, *, reach):
            table = np.zeros((world.num_cells, world.num_choices, world.num_cells), dtype=bool)
            for cell in range(world.num_cells):
                table[cell, :, max(cell - reach, 0) : cell + reach + 1] = True
            return Policy.from_dense(world, table)
    """,
    "outside/nearest_config.py": """
        from trackmdp.config import BaselineConfig, choice, option

        @choice("solver", "nearest", makes="outside.nearest:solve")
        class NearestConfig(BaselineConfig):
            '''Senses the cells next to the last one.'''

            reach: int = option("cells on either side", unit="cells", ge=0)
    """,
    "outside/conf/solver/nearest.yaml": """
        defaults: [base_nearest]

        reach: 1
    """,
    # A logger.
    "outside/lines.py": """
        from trackmdp.training.callbacks import Callback

        class Lines(Callback):
            name = "lines"

            def __init__(self, cfg, folder):
                self._file = (folder / "lines.txt").open("w")
                self._word = cfg.word

            def on_update(self, trainer, row):
                self._file.write(f"{self._word} {row['iteration']}\\n")

            def on_end(self, trainer):
                self._file.close()
    """,
    "outside/lines_config.py": """
        from trackmdp.config import LogConfig, choice, option

        @choice("log", "lines", makes="outside.lines:Lines")
        class LinesConfig(LogConfig):
            '''`lines.txt`: a word for each iteration.'''

            word: str = option("the word", choices=("row", "line"))
    """,
    "outside/conf/log/lines.yaml": """
        # @package log.lines
        defaults: [base_lines]

        word: line
    """,
    # A sensor.
    "outside/fading.py": """
        import numpy as np

        def fading(size, *, range):
            place = np.stack(np.divmod(np.arange(size**2), size), axis=1)
            apart = np.linalg.norm(place[:, None] - place, axis=2)
            return {"coverage": np.where(apart <= range, np.exp(-apart), 0.0)}
    """,
    "outside/fading_config.py": """
        from typing import ClassVar

        from trackmdp.config import SensorConfig, choice, option

        @choice("sensor", "fading", makes="outside.fading:fading")
        class FadingConfig(SensorConfig):
            '''Sees less far away: p_d = exp(-distance), in cells, up to a range.'''

            covers: ClassVar[bool] = True
            range: float = option("distance up to which a sensor sees", unit="cells", ge=0)
    """,
    "outside/conf/sensor/fading.yaml": """
        defaults: [base_fading]

        range: 1.0
    """,
    # A memory.
    "outside/misses.py": """
        from trackmdp.memory.keys import Memory

        class Misses(Memory):
            '''The misses between the last two detections, and 0 at the start.'''

            @property
            def count(self):
                return self.t_max + 3

            def after(self, known, rows, columns, misses):
                return rows * 0 + misses + 1

            def formula(self, last, known):
                return "1 + misses"
    """,
    # What an installer leaves.
    "outside-1.0.dist-info/METADATA": """
        Metadata-Version: 2.1
        Name: outside
        Version: 1.0
    """,
    "outside-1.0.dist-info/entry_points.txt": """
        [trackmdp.plugins]
        outside = outside
    """,
}


def install(folder: Path, replaced: Mapping[str, str | None] | None = None) -> Path:
    """Write the package to a folder that is to stand in `sys.path`; `replaced`: other contents, None: no such file."""
    for name, text in (FILES | dict(replaced or {})).items():
        if text is None:
            continue
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text).lstrip())
    return folder
