"""Schema of a problem made in Python: the run's `problem.npz` holds its arrays, the config its words."""

from __future__ import annotations

from typing import Any

from trackmdp.config.hidden_kernels import HiddenKernelConfig
from trackmdp.config.options import choice, count_option, option
from trackmdp.config.sensors import SensorConfig
from trackmdp.config.world import GridConfig

_SET = "another choice than given, which is made by trackmdp.train in Python and cannot be typed"


@choice("kernel", "given", makes="trackmdp.world.problem_file:refuse_given")
class GivenKernelConfig(HiddenKernelConfig):
    """The motion, or the recorded tracks, of the problem given to `trackmdp.train`; not for a command line."""

    motion: bool = option("whether there is a motion model; false: recorded tracks")
    modes: int = count_option("hidden modes of the target", unit="modes")
    digest: str = option("of the problem, so that runs of two problems stay apart", expects=_SET)
    reveals: bool = option("whether a detection reveals the mode as well", expects=_SET)
    markov: bool = option("whether the next move depends on a detection alone", expects=_SET)

    @property
    def is_motion(self) -> bool:  # type: ignore[override]  # a class attribute of the other kernels
        """Whether there is a motion model."""
        return self.motion

    @property
    def hides(self) -> bool:  # type: ignore[override]
        """Whether the target has a mode beside its cell."""
        return self.modes > 1

    def check(self, key: str, root: Any) -> None:
        """The rules of the other kernels with modes."""
        if self.hides:
            super().check(key, root)


@choice("sensor", "given", makes="trackmdp.world.problem_file:refuse_given")
class GivenSensorConfig(SensorConfig):
    """Footprints and probabilities of detection of the problem given to `trackmdp.train`."""

    wide: bool = option("whether a sensor covers a set of cells", expects=_SET)

    @property
    def covers(self) -> bool:  # type: ignore[override]  # a class attribute of the other sensors
        """Whether a sensor covers a set of cells."""
        return self.wide

    def check(self, key: str, root: Any) -> None:
        """The rules of footprints."""
        if self.wide:
            self._check_solver(key, root)

    def count(self, grid: GridConfig) -> int | None:
        """S is known to the problem alone."""
        return None
