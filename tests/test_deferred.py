"""The compiler of torch is not loaded by a command, and works where a learner of a plugin uses it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import later

_TRAIN = """
import sys
from trackmdp.app.cli import main
assert main(["train", "algo={algo}", "collector.total_frames=10000", "hydra.run.dir=run", "quiet=true"]) == 0
loaded = {{name for name in sys.modules if name.startswith("torch._dynamo.")}}
"""
_COMPILE = """
import torch
from torch._dynamo import utils
assert utils is torch._dynamo.utils is sys.modules["torch._dynamo.utils"]
assert torch._dynamo.__file__
add_param_group = torch.optim.Optimizer.add_param_group.__wrapped__
assert add_param_group.__dynamo_disable is not add_param_group
doubled = torch.compile(lambda x: 2 * x, backend="eager", fullgraph=True)
assert doubled(torch.ones(3)).sum() == 6
"""


def _python(code: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("algo", later(["ppo", "hindsight", "dqn"]))
def test_training_loads_no_compiler(algo: str, tmp_path: Path) -> None:
    assert _python(_TRAIN.format(algo=algo) + "print(sorted(loaded))", tmp_path) == "[]\n"


@pytest.mark.slow
def test_after_a_command_the_compiler_is_the_real_one_with_all_marks(tmp_path: Path) -> None:
    _python(_TRAIN.format(algo="hindsight") + _COMPILE, tmp_path)
