"""Reading a log: episodes as TensorDicts, in any order, without loading the file."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from trackmdp.config import train_config_of
from trackmdp.episodes import schema
from trackmdp.episodes.container import Container, Damaged, fitting, reading
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.messages import form_of
from trackmdp.episodes.schema import versions_apart
from trackmdp.episodes.simulate import resimulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import unpacked_policy
from trackmdp.solvers.several.merging import Rule, make_rule
from trackmdp.training.group_run import joint_policy
from trackmdp.untrusted import load_npz
from trackmdp.world.group import Group
from trackmdp.world.problem_file import PROBLEM


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
        # A constructor that raises leaves nobody to close the file.
        with ExitStack() as opened, reading(self.file):
            opened.callback(self.close)
            self._open()
            opened.pop_all()

    def _open(self) -> None:
        try:
            self.said = self._metadata(schema.RUN)
        except Damaged as error:
            raise UserError(f"file={self.file}: not a log of trackmdp ({error})") from error
        schema.check_format(self.file, self.said)
        self.form = form_of(schema.logged_problem(self.said, self.attachment(PROBLEM)))
        self.end = self._metadata(schema.END)
        count = int(self.end["policies"])
        # One by one: a count that is too large ends at the first name that is missing.
        self.policies = [self._metadata(f"{schema.POLICY}.{number}") for number in range(count)]
        index = self.attachment("episodes.json", self.end["episodes.json.sha256"])
        self.rows: list[dict[str, Any]] = json.loads(index)
        self._rows = {row["episode"]: self._checked(row) for row in self.rows}

    def _checked(self, row: dict[str, Any]) -> dict[str, Any]:
        """The row, if its policy is in the log and its seed has 63 bits."""
        if int(row["seed"]) >> 63 or not self.policies[row["policy"]]:
            raise Damaged(f"policy or seed of episode {row['episode']}")
        return row

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
        return (self[number] for number in self._rows)

    def __getitem__(self, number: int) -> TensorDict:
        """Episode `number` as a TensorDict `[T]`, keys as in `TrackEnv`."""
        return self.read(number).to_tensordict(self.world().task)

    def episodes(self) -> Iterator[Any]:
        """All episodes, one after another, with belief and policy."""
        return (self.read(number) for number in self._rows)

    def row(self, number: int) -> dict[str, Any]:
        """The entry of an episode in the index.

        Raises:
            UserError: there is no such episode.
        """
        if number not in self._rows:
            ends = f"{min(self._rows)} to {max(self._rows)}" if self._rows else "none"
            raise UserError(f"episode={number}: {self.file} holds {len(self)} episodes ({ends})")
        return self._rows[number]

    def read(self, number: int, *, whole: bool = False) -> Any:
        """Episode `number`, of one target or of several; for `whole` see `Form.decode`."""
        row = self.row(number)
        with reading(self.file):
            ends = int(row["start_time"]), int(row["end_time"])
            messages = fitting(self.file, self._container.messages_around(*ends))
            found = self.form.decode(row, messages, whole=whole)
            if self.form.row(found, found.first_tick or 0) != row:
                raise Damaged(f"the figures of episode {number}")
            return found

    def attachment(self, name: str, sha256: str | None = None) -> bytes:
        """An attachment with its digest, by default that of `trackmdp.run`."""
        with reading(self.file):
            content = self._container.attachment(name)
            if schema.digest(content) != (sha256 or self.said.get(f"{name}.sha256")):
                raise Damaged(f"the digest of attachment {name}")
        return content

    def policy_tables(self, number: int) -> list[bytes]:
        """The files of policy `number`, one for each motion; empty if it has no table."""
        tables = schema.policy_tables(number, self.policies[number])
        return [self.attachment(*each) for each in tables.items()]

    def policy(self, number: int) -> Policy | Rule:
        """Policy `number`, as it acted.

        Raises:
            UserError: it has no table.
        """
        facts, problem = self.policies[number], self.world()
        tables = self.policy_tables(number)
        if not tables:
            raise UserError(f"file={self.file}: policy {number} has no table, and cannot act again")
        task = problem.task.remembering()
        with reading(self.file):
            if "memory" in facts:
                clip, revealed = int(facts["clip"]), int(facts["revealed"])
                task = task.remembering(facts["memory"], clip=clip, revealed=revealed)
            arrays = [load_npz(io.BytesIO(table)) for table in tables]
            if facts.get("merge") == "joint":
                cfg = train_config_of(self.attachment(schema.TABLES[0]))
                return joint_policy(cfg, problem, arrays[0])
            found = [unpacked_policy(task, each) for each in arrays]
            if isinstance(problem, Group):
                return make_rule(problem, found, facts["merge"])
            return Policy.from_table(found[0])

    def world(self) -> Any:
        """The world in which the episodes were recorded, the tracks along which they were, or a `Group` of targets."""
        return self.form.problem

    def check_all(self) -> None:
        """Check every byte of the file, those without meaning to this reader included."""
        with reading(self.file):
            self._container.check_data()

    def _metadata(self, name: str) -> dict[str, str]:
        return schema.unseal(name, self._container.metadata(name))


BELIEF_TOLERANCE = 1e-6
"""How far the belief may be off where other versions wrote the log; all else must still be the same to the bit."""

_AT_ONCE, _CELLS = 256, 2**22
"""Episodes simulated together, since a step of fewer takes nearly as long, and their cells; at least 64 episodes."""


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
    rows = reader.rows if numbers is None else [reader.row(number) for number in numbers]
    # The belief is a sum of products, which another version or processor may add up in another order.
    tolerance = BELIEF_TOLERANCE if versions_apart(reader.said) else 0.0
    world, done, steps = reader.world(), 0, 0
    at_once = max(64, min(_AT_ONCE, _CELLS // world.task.num_cells))
    for number, group in groupby(rows, lambda row: row["policy"]):
        policy, mine = reader.policy(number), list(group)
        for begin in range(0, len(mine), at_once):
            some = mine[begin : begin + at_once]
            again = resimulate(world, policy, [int(row["seed"]) for row in some]).complete()
            for row, one in zip(some, again, strict=True):
                logged = reader.read(row["episode"], whole=True)
                # A simulated episode does not know under which policy it was logged.
                mended = replace(one, policy=row["policy"])
                if difference := first_difference(logged, mended, belief_tolerance=tolerance):
                    return Verified(done, steps, f"episode {row['episode']}, {difference}")
                done, steps = done + 1, steps + len(logged)
    return Verified(done, steps, None)
