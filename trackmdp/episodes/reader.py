"""Reading a log: episodes as TensorDicts, in any order, without loading the file."""

from __future__ import annotations

import io
import json
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict

from trackmdp.episodes import schema
from trackmdp.episodes.container import Container, Damaged, Message, reading
from trackmdp.episodes.episode import Episode, first_difference
from trackmdp.episodes.messages import decode
from trackmdp.episodes.schema import LoggedRun, versions_apart
from trackmdp.episodes.simulate import resimulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.world.files import csr_in, load_npy
from trackmdp.world.model import BoolArray, World
from trackmdp.world.modes import HiddenWorld, Modelled


class EpisodeReader:
    """The episodes of a finished log, by number.

    `reader[12]` is episode 12 as a TensorDict `[T]` with the keys of `TrackEnv`, iteration yields one after another,
    `reader.read(12)` has belief and policy as well. Checksums are always checked: a damaged part raises.

    Args:
        file: the log.

    Raises:
        UserError: not a finished log of this format, or a damaged one; also raised when damage is met later.
    """

    def __init__(self, file: Path | str) -> None:
        self.file = Path(file)
        self._container = Container(self.file)
        self._built: Modelled | None = None
        # A constructor that raises leaves nobody to close the file.
        with ExitStack() as opened, reading(self.file):
            opened.callback(self.close)
            self._open()
            opened.pop_all()

    def _open(self) -> None:
        file, container = self.file, self._container
        if container.profile or schema.RUN not in container.metadata:
            kind = f"profile {container.profile!r}" if container.profile else f"it has no metadata {schema.RUN}"
            raise UserError(f"file={file}: not a log of trackmdp ({kind})")
        self.run = LoggedRun.of(file, self._told(schema.RUN))
        # No checksum that is read here covers the header: it is held against the sealed metadata.
        if container.made_by != f"trackmdp {self.run.said['trackmdp']}":
            raise Damaged("the header")
        if schema.END not in container.metadata:
            # Written last: without it the log was finished by another program, or a part was cut out.
            raise Damaged(f"no metadata {schema.END}")
        self.end = self._told(schema.END)
        self._index(self.attachment("episodes.json", self.end.get("episodes.json.sha256", "")))
        # Short episodes share a chunk: read one after another, the chunk is decompressed once.
        self._held: tuple[int, list[Message]] = (-1, [])

    def _index(self, index: bytes) -> None:
        """Policies and episodes, held against each other."""
        # A count that is too large ends at the first name that is missing, before any list has that length.
        self.policies = [self._told(f"{schema.POLICY}.{k}") for k in range(int(self.end["policies"]))]
        for facts in self.policies:
            self.run.check_policy(facts)
        self.rows: list[dict[str, Any]] = [self.run.checked_row(row) for row in json.loads(index)]
        self._numbers = [row["episode"] for row in self.rows]
        steps = sum(row["length"] for row in self.rows)
        if (str(len(self.rows)), str(steps)) != (self.end["episodes"], self.end["steps"]):
            raise Damaged("the index of episodes")
        # Increasing, for the bisection in `row`; not consecutive, since a recovered log lacks the episodes that were
        # damaged.
        unknown = any(row["policy"] >= len(self.policies) for row in self.rows)
        if unknown or any(b <= a for a, b in pairwise(self._numbers)):
            raise Damaged("the order of the episodes, or a policy that is not there")

    def __enter__(self) -> EpisodeReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.stream.close()

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[TensorDict]:
        return (self[number] for number in self._numbers)

    def __getitem__(self, number: int) -> TensorDict:
        """Episode `number` as a TensorDict `[T]`, keys as in `TrackEnv`."""
        return self.read(number).to_tensordict(self.world())

    def episodes(self) -> Iterator[Episode]:
        """All episodes, one after another, with belief and policy."""
        return (self.read(number) for number in self._numbers)

    def row(self, number: int) -> dict[str, Any]:
        """What the index says of an episode.

        Raises:
            UserError: there is no such episode.
        """
        place = bisect_left(self._numbers, number)
        # A slice, which is empty where `place` is behind the last one.
        if self._numbers[place : place + 1] != [number]:
            ends = f"{self._numbers[0]} to {self._numbers[-1]}" if self._numbers else "none"
            raise UserError(f"episode={number}: {self.file} holds {len(self)} episodes ({ends})")
        return self.rows[place]

    def read(self, number: int) -> Episode:
        """Episode `number`."""
        row = self.row(number)
        mine: dict[str, list[bytes]] = {"/step": [], "/grid": [], "/episode": []}
        with reading(self.file):
            for message in self._between(int(row["start_time"]), int(row["end_time"])):
                mine.setdefault(message.topic, []).append(message.data)
            # The index at the end and the message at the episode's own place say the same, or one of them was changed.
            if [json.loads(text) for text in mine["/episode"]] != [row]:
                raise Damaged(f"episode {number} is not what the index says")
            return decode(row, mine["/step"], mine["/grid"], self.run)

    def _between(self, begin: int, end: int) -> list[Message]:
        """The messages from one log time to another; the chunk read last is kept, for the episode after."""
        found = []
        for chunk in self._container.chunks_between(begin, end):
            if self._held[0] != chunk.chunk_start_offset:
                self._held = chunk.chunk_start_offset, self._container.messages(chunk)
            found += [message for message in self._held[1] if begin <= message.log_time <= end]
        return found

    def attachment(self, name: str, sha256: str | None = None) -> bytes:
        """An attachment, its digest checked; that of `trackmdp.run` unless given."""
        with reading(self.file):
            content = self._container.attachment(name)
            if schema.digest(content) != (self.run.said.get(f"{name}.sha256") if sha256 is None else sha256):
                raise Damaged(f"attachment {name} is not what was written")
        return content

    def policy_table(self, number: int) -> bytes | None:
        """The file of policy `number`; None if it has no table."""
        sha256 = self.policies[number]["table.sha256"]
        return self.attachment(self.run.policy_file(number), sha256) if sha256 else None

    def policy(self, number: int) -> Policy:
        """Policy `number`, as it acted.

        Raises:
            UserError: it is of a kind that cannot act again.
        """
        facts, task, table = self.policies[number], self.world().remembering(), self.policy_table(number)
        if "memory" in facts:
            clip, revealed = int(facts["clip"]), int(facts["revealed"])
            task = task.remembering(facts["memory"], clip=clip, revealed=revealed)
        if facts["kind"] == "random_k":
            return Policy.random_k(task, int(facts["k"]))
        if facts["kind"] != "chains" or table is None:
            raise UserError(f"file={self.file}: policy {number} is a {facts['kind']!r}, expected chains or random_k")
        with reading(self.file):
            if self.run.sparse:
                return Policy(task, csr_in(table))
            return Policy.from_dense(task, self._unpacked(table, task.num_keys))

    def _unpacked(self, table: bytes, keys: int) -> BoolArray:
        sensors, bits = self.run.sensors, _loaded(".npy", table)
        if bits.dtype != np.uint8 or bits.shape != (keys, self.run.t_max + 1, -(-sensors // 8)):
            raise Damaged("the table of a policy")
        # `[keys, t_max+1, ceil(S/8)]` to `[keys, t_max+1, S]`; `count` drops the bits that fill the last byte.
        return np.unpackbits(bits, axis=-1, count=sensors).astype(bool)

    def world(self) -> Modelled:
        """The world in which the episodes were recorded."""
        # Kept, since every episode that becomes a TensorDict needs it.
        if self._built is None:
            with reading(self.file):
                self._built = self._world()
        return self._built

    def _world(self) -> Modelled:
        run = self.run
        config, kernel, *_ = run.tables
        tables = {name: _loaded(name, self.attachment(name)) for name in run.tables if name != config}
        # `[2, M]`, p_d and p_s, where sensors may miss; `[S, M]` where they have footprints.
        chances, footprints = tables.get("sensors.npy"), tables.get("footprints.npz")
        if footprints is not None and footprints.shape[0] != run.sensors:
            raise Damaged("how many sensors there are")
        of_task: dict[str, Any] = {
            **({} if chances is None else dict(zip(("detection", "safe_detection"), chances, strict=True))),
            "coverage": footprints,
            "cost": tables["cost.npy"],
            **{name: getattr(run, name) for name in ("size", "safe_cost", "t_max", "reward", "max_steps", "window")},
        }
        if run.modes:
            return HiddenWorld(tables[kernel], modes=run.modes, revealed=run.revealed, **of_task)
        return World(tables[kernel], **of_task)

    def check_all(self) -> None:
        """Check every byte of the file, those without meaning to this reader included."""
        with reading(self.file):
            self._container.check_data()
        for name in self.run.tables:
            self.attachment(name)
        for number in range(len(self.policies)):
            self.policy_table(number)

    def _told(self, name: str) -> dict[str, str]:
        content = schema.unsealed_record(name, self._container.tell(name))
        if content is None:
            raise Damaged(f"metadata {name} is not what was written")
        return content


def _loaded(name: str, content: bytes) -> Any:
    return csr_in(content) if name.endswith(".npz") else load_npy(io.BytesIO(content), len(content))


BELIEF_TOLERANCE = 1e-6
"""How far the belief may be off where other versions wrote the log; all else must still be the same to the bit."""

_AT_ONCE = 64  # episodes


@dataclass(frozen=True)
class Verified:
    """How many episodes came out the same, and the first difference (None if there is none)."""

    episodes: int
    steps: int
    difference: str | None


def verify(reader: EpisodeReader, *, numbers: list[int] | None = None) -> Verified:
    """Re-simulate the episodes `numbers` (all, with every byte of the file, if None) up to the first difference.

    Raises:
        UserError: the file is damaged.
    """
    if numbers is None:
        reader.check_all()
    wanted = [row["episode"] for row in reader.rows] if numbers is None else numbers
    # The belief is a sum of products, which another version or processor may add up in another order.
    tolerance = BELIEF_TOLERANCE if versions_apart(reader.run.said) else 0.0
    world, done, steps = reader.world(), 0, 0
    for number_of_policy, group in groupby(wanted, lambda number: reader.row(number)["policy"]):
        policy, mine = reader.policy(number_of_policy), list(group)
        for begin in range(0, len(mine), _AT_ONCE):
            for number, again in _again(reader, world, policy, mine[begin : begin + _AT_ONCE]):
                logged = reader.read(number)
                if difference := first_difference(logged, again, belief_tolerance=tolerance):
                    return Verified(done, steps, f"episode {number}, {difference}")
                done, steps = done + 1, steps + len(logged)
    return Verified(done, steps, None)


def _again(reader: EpisodeReader, world: Modelled, policy: Policy, numbers: list[int]) -> Iterator[tuple[int, Episode]]:
    rows = [reader.row(number) for number in numbers]
    again = resimulate(world, policy, [int(row["seed"]) for row in rows]).complete()
    # Simulated episodes do not know under which number and policy they were logged.
    return ((row["episode"], replace(one, policy=row["policy"])) for row, one in zip(rows, again, strict=True))
