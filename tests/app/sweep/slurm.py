"""A SLURM of one machine: put in a folder as sbatch, srun, sacct and scontrol, it runs what is submitted at once."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

STATE = Path(os.environ["FAKE_SLURM"])
JOB = "4711"


def sbatch(script: str) -> None:
    text = Path(script).read_text()
    (STATE / "script").write_text(text)
    array = re.search(r"^#SBATCH --array=0-(\d+)", text, flags=re.MULTILINE)
    for task in range(int(array[1]) + 1) if array else [None]:
        begin(task)
    sys.stdout.write(f"Submitted batch job {JOB}\n")


def begin(task: int | None) -> None:
    """Run the script of a task of the array, as a batch step does: a shell that calls srun."""
    name = JOB if task is None else f"{JOB}_{task}"
    mine = {
        "SLURM_JOB_ID": name,
        "SLURM_NTASKS": "1",
        "SLURM_JOB_NUM_NODES": "1",
        "SLURM_NODEID": "0",
    }
    mine |= {"SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
    if task is not None:
        mine |= {"SLURM_ARRAY_JOB_ID": JOB, "SLURM_ARRAY_TASK_ID": str(task)}
    log = (STATE / f"{name}.out").open("a")
    process = subprocess.Popen(
        ["bash", STATE / "script"],
        env=os.environ | mine,
        stdout=log,
        stderr=log,
        start_new_session=True,
    )
    (STATE / f"{name}.json").write_text(json.dumps({"task": task, "pid": process.pid}))


def srun(*words: str) -> None:
    command = words[
        next(place for place, word in enumerate(words) if Path(word).name.startswith("python")) :
    ]
    (STATE / f"{os.environ['SLURM_JOB_ID']}.pid").write_text(str(os.getpid()))
    os.execvp(command[0], command)


def sacct() -> None:
    sys.stdout.write("JobID|State|NodeList\n")
    for file in STATE.glob("*.json"):
        alive = Path(f"/proc/{json.loads(file.read_text())['pid']}").exists()
        sys.stdout.write(f"{file.stem}|{'RUNNING' if alive else 'COMPLETED'}|here\n")


def scontrol(verb: str, name: str) -> None:
    assert verb == "requeue"
    with (STATE / "requeued").open("a") as log:
        log.write(f"{name}\n")
    begin(json.loads((STATE / f"{name}.json").read_text())["task"])


if __name__ == "__main__":
    name = Path(sys.argv[0]).name
    if name == "sbatch":
        sbatch(sys.argv[-1])
    elif name == "srun":
        srun(*sys.argv[1:])
    elif name == "sacct":
        sacct()
    elif name == "scontrol":
        scontrol(*sys.argv[1:])
