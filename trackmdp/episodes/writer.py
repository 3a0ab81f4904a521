"""Writing a log, episode by episode; after each `add` fewer than `FLUSH_STEPS` steps would be lost by a kill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from trackmdp.arrays.files import npz_bytes
from trackmdp.durable import create, sync, sync_folder
from trackmdp.episodes import schema
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.messages import form_of
from trackmdp.episodes.schema import time_of
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import packed
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.several.merging import Rule
from trackmdp.untrusted import decoded
from trackmdp.world.group import Group, Subject
from trackmdp.world.problem_file import PROBLEM, problem_bytes

FLUSH_STEPS = 100
"""An episode's end closes the chunk once so many steps are in it, and hands it to the operating system."""

_BYTES = "application/octet-stream"
_MEDIA = {".yaml": "application/yaml", ".json": "application/json", ".npz": _BYTES}


class EpisodeWriter:
    """One log, written by one process: `FILE.part` while it grows, `FILE` once `finish` has it on the disk.

    Args:
        file: the log; its folder exists.
        said: the metadata `trackmdp.run` that it begins with.
        tables: the attachments that they name: the world of all its episodes, so that it can be re-simulated.
    """

    @classmethod
    def of(
        cls, file: Path, problem: Subject, *, facts: Mapping[str, str], config: str
    ) -> EpisodeWriter:
        """A log of `problem`, of recorded tracks those held out.

        Args:
            file: the log.
            problem: where the episodes take place.
            facts: further metadata of the run, such as `seed`.
            config: its `config.yaml`.

        Raises:
            UserError: the problem is too large for a log.
        """
        logged = problem
        if (own := problem.recorded) is not None:
            judged = own.held_out
            # Those to learn from predict the moves of several targets.
            tracks = own.tracks if problem.targets else judged
            own = replace(own, tracks=tracks, validation=judged, loaded={})
            logged = replace(problem, recorded=own) if isinstance(problem, Group) else own
        tables = {schema.TABLES[0]: config.encode(), PROBLEM: problem_bytes(logged)}
        said = {
            **schema.versions(),
            **facts,
            "format_version": schema.LOG_FORMAT,
            **schema.shape_of(problem),
            "tick_ns": str(schema.TICK_NS),
            **{f"{name}.sha256": schema.digest(content) for name, content in tables.items()},
        }
        return cls(file, said, tables)

    def __init__(self, file: Path, said: dict[str, str], tables: Mapping[str, bytes]) -> None:
        with decoded(f"file={file}", "a log of trackmdp"):
            self.form = form_of(schema.logged_problem(said, tables[PROBLEM]))
        self.file, self.part = file, file.with_name(f"{file.name}.part")
        self._rows: list[dict[str, Any]] = []
        self.policies = self._unflushed = self._tick = 0
        # Opened here and not by the Writer, which closes a file of its own in finish(), before it could be synced.
        # CRCs over the data section are off by default; `Container.check_data` needs them.
        self._stream = create(self.part)
        self._writer = Writer(self._stream, enable_data_crcs=True)
        self._writer.start(library=f"trackmdp {said['trackmdp']}")
        # Once, and the numbers kept: registering a topic a second time would make a second channel of the same name.
        self._channels: dict[str, int] = {}
        for topic, (name, description) in schema.schemas_of(self.form.problem).items():
            text = schema.json_bytes(description)
            number = self._writer.register_schema(name, "jsonschema", text)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        self._tell(schema.RUN, said)
        for name, content in tables.items():
            self._attach(name, content)
        # In the file at once: a log that is cut off later can be recovered only with its head.
        self.flush()

    @property
    def episodes(self) -> int:
        """How many episodes the log holds."""
        return len(self._rows)

    def add_policy(self, facts: Mapping[str, str], policy: Policy | Rule | None) -> int:
        """Add the policy of the episodes that follow; returns its number.

        Args:
            facts: description of the policy for readers of the log: its `label`.
            policy: from which `replay verify=true` simulates them again; None where there is none.
        """
        tables: list[dict[str, Any]] = []
        plans: Sequence[PolicyTable] = ()
        if isinstance(policy, Rule):
            facts, tables, plans = {**facts, "merge": policy.name}, policy.packed(), policy.tables
        elif policy is not None:
            tables, plans = [packed(policy)], [policy]
        if plans and (task := plans[0].task).keyed:
            names = ("memory", "clip", "revealed")
            facts = {**facts, **{name: str(getattr(task, name)) for name in names}}
        return self.copy_policy(facts, list(map(npz_bytes, tables)))

    def copy_policy(self, facts: Mapping[str, str], tables: Sequence[bytes]) -> int:
        """Add a policy as it was read from another log: of each motion its table; none where it has none."""
        digests = {
            schema.table_digest(kind): schema.digest(table) for kind, table in enumerate(tables)
        }
        sealed = {schema.table_digest(0): "", **digests}
        self._tell(f"{schema.POLICY}.{self.policies}", {**facts, **sealed})
        for kind, table in enumerate(tables):
            self._attach(schema.policy_file(self.policies, kind), table)
        self.flush()
        self.policies += 1
        return self.policies - 1

    def add(self, episode: Episode) -> None:
        """Append an episode with its belief, as of `Episodes.complete`.

        Raises:
            OSError: the disk is full, or the file cannot be written for another reason.
        """
        tick = self._tick if episode.first_tick is None else episode.first_tick
        row = self.form.row(episode, tick)
        # Before the first message of the episode: NaN is no JSON, and a time that does not fit into its field makes
        # the Writer raise within a chunk, which finish() could then no longer write.
        if not (np.isfinite(episode.reward).all() and self._tick <= tick < 2**37):
            raise ValueError(
                f"episode {episode.number}: a reward that is not finite, or times out of order"
            )
        add, channels = self._writer.add_message, self._channels
        steps, grids = self.form.steps(episode), self.form.layers(episode, tick)
        for place, (said, layers) in enumerate(zip(steps, grids, strict=True), start=tick):
            # MCAP's sequence number has 32 bits, the log time 64.
            time, sequence = time_of(place), place & 0xFFFFFFFF
            for topic, text in ({"/step": said} | layers).items():
                add(channels[topic], time, text, time, sequence)
        add(channels["/episode"], time, schema.json_bytes(row), time, sequence)
        self._rows.append(row)
        self._tick = tick + len(episode) + schema.GAP
        self._unflushed += len(episode)
        if self._unflushed >= FLUSH_STEPS:
            self.flush()

    def flush(self) -> None:
        """Close the chunk and hand it to the operating system: it then survives a kill of this process."""
        # The first flush closes the chunk of the Writer, the second empties Python's buffer; neither reaches the disk:
        # the bytes survive the end of this process, not a power failure.
        self._writer.flush()
        self._stream.flush()
        self._unflushed = 0

    def sync(self) -> None:
        """Close the chunk and put it on the disk: it then survives a power failure as well."""
        self.flush()
        sync(self._stream, self.part)

    def finish(self) -> Path:
        """Complete the file and give it its name; returns it."""
        index = schema.json_bytes(self._rows)
        self.flush()
        self._attach("episodes.json", index)
        counts = {
            "episodes": str(len(self._rows)),
            "steps": str(sum(row["length"] for row in self._rows)),
            "policies": str(self.policies),
        }
        self._tell(schema.END, {**counts, "episodes.json.sha256": schema.digest(index)})
        # finish() writes the summary: with it, under its `.part` name, the file is complete. Sync, then rename: under
        # the final name all bytes are on the disk. A `.part` that a kill leaves can be recovered.
        self._writer.finish()
        sync(self._stream, self.part)
        self._stream.close()
        self.part.replace(self.file)
        sync_folder(self.file.parent)
        return self.file

    def abandon(self) -> None:
        """Close the file as it is, under its `.part` name; all flushed messages can be recovered."""
        try:
            self._stream.close()
        except OSError:
            # close() writes the buffer, which fails again on a full disk, and would leave the descriptor open.
            self._stream.raw.close()

    def _tell(self, name: str, content: dict[str, str]) -> None:
        self._writer.add_metadata(name, schema.seal(name, content))

    def _attach(self, name: str, content: bytes) -> None:
        time = time_of(self._tick)
        self._writer.add_attachment(time, time, name, _MEDIA[Path(name).suffix], content)
