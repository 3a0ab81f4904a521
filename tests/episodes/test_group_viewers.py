"""What viewers ask of a log and a layout of several targets, as Foxglove publishes it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.episodes.test_group_log import GROUP, played
from tests.episodes.test_group_log import write as write_several
from trackmdp.episodes.layouts import layout
from trackmdp.episodes.schema import schemas_of

pytest.importorskip("foxglove", reason="needs the package foxglove-sdk")
pytest.importorskip("google.protobuf", reason="needs the package protobuf")

from foxglove.messages import SceneUpdate

from tests.episodes.test_viewers import PANELS, check, check_json, drawn, messages, parsed

SEVERAL = schemas_of(GROUP)


@pytest.fixture(scope="module")
def group_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_several(tmp_path_factory.mktemp("log") / "several.mcap", played(5))


@pytest.mark.parametrize("topic", SEVERAL)
def test_every_message_of_several_targets_is_what_its_schema_says(
    group_log: Path, topic: str
) -> None:
    found = messages(group_log, topic)
    assert found
    for said in found:
        check_json(said, SEVERAL[topic][1], topic)


def test_several_targets_are_drawn_as_they_were_logged(group_log: Path) -> None:
    """Each belief, their sum, the sensors, and a disc with its number for each target in the grid."""
    topics = ("/grid", "/belief/0", "/belief/1", "/belief/2", "/active", "/targets")
    every = [messages(group_log, topic) for topic in topics]
    steps = [(episode, t) for episode in played(5) for t in range(len(episode))]
    for (episode, t), whole, *each, active, scene in zip(steps, *every, strict=True):
        shown = [drawn(said, (1, 3))["belief"] for said in each]
        assert episode.belief is not None
        assert np.array_equal(shown, episode.belief[3 * t : 3 * t + 3].toarray())
        assert drawn(whole, (1, 3))["belief"] == pytest.approx(sum(shown))
        assert np.array_equal(drawn(active, (1, 3))["active"], episode.action[t])
        made = parsed(scene, SceneUpdate, "foxglove.SceneUpdate")
        assert [each.type for each in made.deletions] == [1]  # all of the step before
        inside = np.flatnonzero(episode.target[t] < 3)
        assert [entity.texts[0].text for entity in made.entities] == [str(k) for k in inside]
        for k, entity in zip(inside, made.entities, strict=True):
            assert entity.id == f"target {k}"
            place = entity.cylinders[0].pose.position
            assert (place.x, place.y) == (episode.target[t, k] + 0.5, 0.5)
            assert (entity.cylinders[0].color.a == 1) == episode.located[t, k]
        colours = {str(entity.cylinders[0].color) for entity in made.entities}
        assert len(colours) == len(inside) or not episode.located[t].all()


@pytest.mark.parametrize("targets", [2, 50])
def test_a_layout_of_several_targets_is_one_of_foxgloves(targets: int, group_log: Path) -> None:
    made = layout((4, 6), targets)
    for name, config in made["configById"].items():
        for viewer in ("foxglove", "lichtblick"):
            assert config.pop(f"{viewer}PanelTitle")
        check(config, PANELS[name.split("!")[0]], name)
    shown = re.findall(r'"([^"]+![^"]+)"', json.dumps(made["layout"]))
    assert sorted(shown) == sorted(made["configById"])
    for topic, key in re.findall(r'"(/[a-z]+)\.([a-z_]+)', json.dumps(made)):
        assert key in messages(group_log, topic)[0]
    topics = made["configById"]["3D!belief"]["topics"]
    assert [topic for topic, each in topics.items() if each["visible"]] == [
        "/grid",
        "/active",
        "/targets",
    ]
    assert made["configById"]["3D!belief"]["cameraState"]["distance"] == pytest.approx(1.2 * 6)
