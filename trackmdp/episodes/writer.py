"""Writing a log, episode by episode; after each `add` fewer than `FLUSH_STEPS` steps would be lost by a kill."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from trackmdp.durable import create, sync, sync_folder
from trackmdp.episodes import messages, schema
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.grids import grid_messages
from trackmdp.episodes.schema import LoggedRun, time_of
from trackmdp.policies.policy import Policy
from trackmdp.world.coverage import Coverage
from trackmdp.world.files import csr_bytes, csr_in, npy_bytes
from trackmdp.world.modes import HiddenWorld, Modelled

FLUSH_STEPS = 100
"""An episode's end closes the chunk once so many steps are in it, and hands it to the operating system."""

DENSE_CELLS = 64 * 64
"""Cells up to which kernel and policies are written dense: 134 MB of kernel at that size."""

_BYTES = "application/octet-stream"
_MEDIA = {".yaml": "application/yaml", ".json": "application/json", ".npy": _BYTES, ".npz": _BYTES}


class EpisodeWriter:
    """One log, written by one process: `FILE.part` while it grows, `FILE` once `finish` has it on the disk.

    Args:
        file: the log; its folder exists.
        run: the metadata `trackmdp.run` that it begins with.
        tables: the attachments that they name: the world of all its episodes, so that it can be re-simulated.
    """

    @classmethod
    def of(cls, file: Path, world: Modelled, *, facts: Mapping[str, str], config: str) -> EpisodeWriter:
        """A log of `world`; `facts` is what else it says of the run, such as `seed`, `config` its `config.yaml`.

        Raises:
            UserError: the world is larger than a log may say.
        """
        tables = {"config.yaml": config.encode(), **_kernel(world), "cost.npy": npy_bytes(world.cost)}
        if not (world.perfect and world.safe):
            tables["sensors.npy"] = npy_bytes(np.stack([world.detection, world.safe_detection]))
        if world.coverage is not None:
            tables["footprints.npz"] = csr_bytes(world.coverage.matrix)
        said = {
            **schema.versions(),
            **facts,
            "format_version": schema.LOG_FORMAT,
            "size": str(world.rows),
            **({} if world.rows == world.columns else {"columns": str(world.columns)}),
            **({} if world.window is None else {"window": str(world.window)}),
            **({} if world.coverage is None else {"sensors": str(world.total_sensors)}),
            **({"modes": str(world.modes), "revealed": str(world.revealed)} if isinstance(world, HiddenWorld) else {}),
            "t_max": str(world.t_max),
            "max_steps": "" if world.max_steps is None else str(world.max_steps),
            # repr: the shortest text that reads back as the same float64.
            "reward": repr(float(world.reward)),
            "safe_cost": repr(float(world.safe_cost)),
            "tick_ns": str(schema.TICK_NS),
            **{f"{name}.sha256": schema.digest(content) for name, content in tables.items()},
        }
        return cls(file, LoggedRun.of(file, said), tables)

    def __init__(self, file: Path, run: LoggedRun, tables: Mapping[str, bytes]) -> None:
        self.run = run
        footprints = csr_in(tables["footprints.npz"]) if "footprints.npz" in tables else None
        self._coverage = Coverage.of(footprints, run.cells)
        self.file, self.part = file, file.with_name(f"{file.name}.part")
        self._lock, self._process = threading.RLock(), os.getpid()
        self._rows: list[dict[str, Any]] = []
        self.policies = self._unflushed = self._tick = 0
        # Opened here and not by the Writer, which closes a file of its own in finish(), before it could be synced.
        # CRCs over the data section are off by default; `Container.check_data` needs them.
        self._stream = create(self.part)
        self._writer = Writer(self._stream, enable_data_crcs=True)
        self._writer.start(library=f"trackmdp {run.said['trackmdp']}")
        # Once, and the numbers kept: registering a topic a second time would make a second channel of the same name.
        more = schema.MODE if run.modes else {}
        self._channels = {topic: self._register(topic, more.get(topic, {})) for topic in schema.SCHEMAS}
        self._tell(schema.RUN, run.said)
        for name, content in tables.items():
            self._attach(name, content)
        # In the file at once: a log that is cut off later can be recovered only with what it starts with.
        self.flush()

    def _register(self, topic: str, more: dict[str, Any]) -> int:
        name, description = schema.SCHEMAS[topic]
        description = description | {"properties": description["properties"] | more}
        text = json.dumps(description, separators=(",", ":")).encode()
        number = self._writer.register_schema(name, "jsonschema", text)
        return self._writer.register_channel(topic, "json", number)

    @property
    def episodes(self) -> int:
        """How many episodes the log holds."""
        return len(self._rows)

    def add_policy(self, facts: Mapping[str, str], policy: Policy | None) -> int:
        """Add the policy of the episodes that follow; returns its number.

        Args:
            facts: what the log says of it, for a reader: its `label`.
            policy: from which `replay verify=true` simulates them again; None where there is none.
        """
        kind, table = _described(policy, sparse=self.run.sparse)
        if policy is not None and policy.task.keyed:
            kind |= {name: str(getattr(policy.task, name)) for name in ("memory", "clip", "revealed")}
        return self.copy_policy({**facts, **kind}, table)

    def copy_policy(self, facts: Mapping[str, str], table: bytes | None) -> int:
        """Add a policy as it was read from another log."""
        with self._lock:
            sha256 = schema.digest(table) if table is not None else ""
            self._tell(f"{schema.POLICY}.{self.policies}", {**facts, "table.sha256": sha256})
            if table is not None:
                self._attach(self.run.policy_file(self.policies), table)
            self.flush()
            self.policies += 1
            return self.policies - 1

    def add(self, episode: Episode) -> None:
        """Append an episode.

        Raises:
            OSError: the disk is full, or the file cannot be written for another reason.
        """
        # After a fork both processes would write through the same descriptor, one into the other's chunk.
        if os.getpid() != self._process:
            raise RuntimeError(f"{self.file}: opened by process {self._process}, written by {os.getpid()}")
        # The mcap Writer is not thread-safe: messages from two threads mix within a chunk, and the file cannot be
        # read.
        with self._lock:
            tick = self._tick if episode.first_tick is None else episode.first_tick
            row = messages.row_of(episode, self.run.t_max, tick)
            self._add_messages(episode, tick, row)
            self._rows.append(row)
            self._tick = tick + len(episode) + schema.GAP
            self._unflushed += len(episode)
            if self._unflushed >= FLUSH_STEPS:
                self.flush()

    def _add_messages(self, episode: Episode, tick: int, row: dict[str, Any]) -> None:
        if episode.belief is None or episode.probability is None:
            raise ValueError(f"episode {episode.number}: without its belief; log those of `Episodes.complete`")
        # Before the first message of the episode: NaN is no JSON, and a time that does not fit into its field makes
        # the Writer raise within a chunk, which finish() could then no longer write.
        if not (np.isfinite(episode.reward).all() and 0 <= tick < 2**37):
            raise ValueError(f"episode {episode.number}: a reward that is not finite, or a time out of range")
        add, channels = self._writer.add_message, self._channels
        steps = messages.step_messages(episode, self.run)
        covered = None if self._coverage is None else self._coverage.cells(episode.action)
        grids = grid_messages(episode, self.run.size, tick, covered)
        for place, (said, layers) in enumerate(zip(steps, grids, strict=True), start=tick):
            # MCAP's sequence number has 32 bits, the log time 64.
            time, sequence = time_of(place), place & 0xFFFFFFFF
            for topic, text in ({"/step": said} | layers).items():
                add(channels[topic], time, text, time, sequence)
        text = json.dumps(row, allow_nan=False, separators=(",", ":")).encode()
        add(channels["/episode"], time, text, time, sequence)

    def flush(self) -> None:
        """Close the chunk and hand it to the operating system: it then survives a kill of this process."""
        # The first flush closes the chunk of the Writer, the second empties Python's buffer; neither reaches the disk:
        # the bytes survive the end of this process, not a power failure.
        with self._lock:
            self._writer.flush()
            self._stream.flush()
            self._unflushed = 0

    def sync(self) -> None:
        """Close the chunk and put it on the disk: it then survives a power failure as well."""
        with self._lock:
            self.flush()
            sync(self._stream, self.part)

    def finish(self) -> Path:
        """Complete the file and give it its name; returns it."""
        with self._lock:
            index = json.dumps(self._rows, allow_nan=False, separators=(",", ":")).encode()
            self.flush()
            self._attach("episodes.json", index)
            steps = sum(row["length"] for row in self._rows)
            counts = {"episodes": str(len(self._rows)), "steps": str(steps), "policies": str(self.policies)}
            self._tell(schema.END, {"complete": "true", **counts, "episodes.json.sha256": schema.digest(index)})
            # finish() writes the summary: with it, under its `.part` name, the file is complete. Sync, then rename:
            # whoever sees the final name sees all bytes. A kill before the rename leaves a `.part` that can be
            # recovered.
            self._writer.finish()
            sync(self._stream, self.part)
            self._stream.close()
        self.part.replace(self.file)
        sync_folder(self.file.parent)
        return self.file

    def abandon(self) -> None:
        """Close the file as it is, under its `.part` name; what was flushed can be recovered."""
        try:
            self._stream.close()
        except OSError:
            # close() writes what is buffered, which fails again on a full disk, and would leave the descriptor open.
            self._stream.raw.close()

    def _tell(self, name: str, content: dict[str, str]) -> None:
        self._writer.add_metadata(name, schema.seal(name, content))

    def _attach(self, name: str, content: bytes) -> None:
        time = time_of(self._tick)
        self._writer.add_attachment(time, time, name, _MEDIA[Path(name).suffix], content)


def _described(policy: Policy | None, *, sparse: bool) -> tuple[dict[str, str], bytes | None]:
    """What a log says of how a policy acts, and its table.

    `[keys, t_max+1, ceil(S/8)]`, eight sensors to a byte; where the kernel is `sparse` the CSR matrix of its sets, as
    SciPy saves it.
    """
    if policy is None:
        return {"kind": "unknown"}, None
    if policy.k is not None:
        return {"kind": "random_k", "k": str(policy.k)}, None
    if not policy.deterministic:
        return {"kind": "probabilities"}, None
    if sparse:
        if policy.sets is None:  # all on or none: as many as there are drawn, or not one, which needs no table
            return {"kind": "random_k", "k": str(round((policy.probability or 0.0) * policy.task.total_sensors))}, None
        return {"kind": "chains"}, csr_bytes(policy.sets)
    return {"kind": "chains"}, npy_bytes(np.packbits(policy.dense(), axis=-1))


def _kernel(world: Modelled) -> dict[str, bytes]:
    """The attachment that holds the kernel: dense, for any reader, or as SciPy saves a CSR matrix.

    That on a large grid, and of targets with a mode, whose kernel is on (cell, mode).
    """
    if world.num_cells > DENSE_CELLS or isinstance(world, HiddenWorld):
        return {"kernel.npz": csr_bytes(world.kernel)}
    return {"kernel.npy": npy_bytes(world.kernel.toarray())}
