"""Readers that are not ours: the mcap package, and @mcap/core under node."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.episodes.logs import WORLD, recorded, write
from trackmdp.episodes.schema import schemas_of

NODE = shutil.which("node")
READ = """
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const fs = require("fs");
(async () => {
  const decompressHandlers = await loadDecompressHandlers();
  const bytes = new Uint8Array(fs.readFileSync(process.argv[1]));
  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) => bytes.slice(Number(offset), Number(offset + length)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const counts = {}, rewards = [];
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const topic = reader.channelsById.get(message.channelId).topic;
    counts[topic] = (counts[topic] || 0) + 1;
    const said = JSON.parse(new TextDecoder().decode(message.data));
    if (topic === "/step") rewards.push(said.reward);
  }
  const attachments = [];
  for await (const each of reader.readAttachments({ validateCrcs: true })) attachments.push(each.name);
  const metadata = [];
  for await (const each of reader.readMetadata()) metadata.push(each.name);
  const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  stream.append(bytes);
  let records = 0;
  while (stream.nextRecord()) records++;
  console.log(JSON.stringify({ counts, attachments, metadata, records, done: stream.done(), rewards }));
})().catch((error) => { console.error(String(error)); process.exit(1); });
"""


def node_has_mcap() -> bool:
    if NODE is None:
        return False
    asked = subprocess.run(
        [NODE, "-e", "require('@mcap/core'); require('@mcap/support')"],
        capture_output=True,
        check=False,
    )
    return asked.returncode == 0


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write(tmp_path / "a.mcap", recorded(30))


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_mcap_core_reads_the_whole_file(log: Path) -> None:
    if not node_has_mcap():
        pytest.skip("@mcap/core and @mcap/support are not installed where node looks (NODE_PATH)")
    done = subprocess.run(
        [str(NODE), "-e", READ, str(log)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ,
    )
    assert (done.returncode, done.stderr) == (0, "")
    said, episodes = json.loads(done.stdout), recorded(30)
    steps = sum(map(len, episodes))
    assert said["counts"] == {**dict.fromkeys(schemas_of(WORLD), steps), "/episode": 30}
    assert said["attachments"] == [
        "config.yaml",
        "problem.npz",
        "policy-0.npz",
        "episodes.json",
    ]
    assert said["metadata"] == ["trackmdp.run", "trackmdp.policy.0", "trackmdp.end"]
    assert said["done"] is True
    assert said["rewards"] == [reward for episode in episodes for reward in episode.reward.tolist()]


def test_the_mcap_package_reads_the_whole_file(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        counts: dict[str, int] = {}
        for _, channel, message in reader.iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            assert message.publish_time == message.log_time
        summary = reader.get_summary()
    steps = sum(map(len, recorded(30)))
    assert counts == {**dict.fromkeys(schemas_of(WORLD), steps), "/episode": 30}
    assert summary and {schema.name for schema in summary.schemas.values()} >= {"foxglove.Grid"}
