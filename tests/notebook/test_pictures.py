"""Objects in a notebook: a card beside a picture, the picture on axes of one's own, columns as a frame."""

from __future__ import annotations

import base64
import io
import re
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.notebook.objects import NAMES, objects, recorded
from trackmdp.episodes import video
from trackmdp.episodes.target_colours import shares_of
from trackmdp.errors import UserError
from trackmdp.notebook import drawing
from trackmdp.notebook.pictures import Heat, Lines, picture_of

pyplot = pytest.importorskip("matplotlib.pyplot")
WITHOUT = {"task", "episode", "comparison", "mixture", "group_evaluation"}
"""Objects without a picture; all prices of the task are the same."""


@pytest.mark.parametrize("name", NAMES)
def test_an_object_is_shown_as_a_card_beside_its_picture(name: str) -> None:
    found = objects()[name]
    text = found._repr_html_()
    rows = re.findall(r"<th[^>]*>(.*?)</th><td[^>]*>(.*?)</td>", text)
    assert len(rows) == len(found.card().rows())
    assert ("<img " in text) == (name not in WITHOUT)
    if name not in WITHOUT:
        code = re.search(r"base64,([^\"]+)", text)
        assert code and base64.b64decode(code[1]).startswith(b"\x89PNG")


def test_what_a_card_says_cannot_break_out_of_the_page() -> None:
    text = objects()["in_folder"]._repr_html_()
    assert "runs/&lt;a &amp; b&gt;" in text and "<a & b>" not in text


def test_without_matplotlib_the_card_stands_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "find_spec", lambda name: None)
    text = objects()["world"]._repr_html_()
    assert "<table>" in text and "<img" not in text


@pytest.mark.parametrize("name", sorted({*NAMES} - WITHOUT))
def test_a_plot_goes_on_axes_of_ones_own(name: str) -> None:
    figure, axes = pyplot.subplots()
    assert objects()[name].plot(axes) is axes
    assert axes.get_title(loc="left") == picture_of(objects()[name]).title
    pyplot.close(figure)
    pyplot.close(objects()[name].plot().figure)


def test_an_object_without_a_picture_is_one_line() -> None:
    with pytest.raises(UserError, match="no picture of this Task"):
        objects()["task"].plot()


def heat(shown: Any) -> Heat:
    found = picture_of(shown)
    assert isinstance(found, Heat)
    return found


def test_the_picture_of_a_world_is_the_move_from_the_middle() -> None:
    world = objects()["world"]
    found = heat(world)
    assert found.mark == [6]  # row 1, column 2 of 3 x 4
    assert np.array_equal(found.values, world.kernel.toarray()[6].reshape(3, 4))
    hidden = heat(objects()["hidden"])
    assert np.isclose(hidden.values.sum(), 0.95)  # averaged over the modes; 5 % leave


def test_the_picture_of_tracks_counts_visits() -> None:
    assert heat(recorded()).values.tolist() == [[1, 1, 2], [0, 3, 1], [0, 1, 1]]


def test_the_picture_of_a_policy_is_its_plan_in_the_middle() -> None:
    world = tm.World(np.eye(9) * 0.5, 3, cost=0.1, t_max=1)
    table = np.zeros((9, 2, 9), dtype=bool)
    table[4, 0, [3, 4]] = table[4, 1, [4, 5]] = True
    found = heat(tm.Policy.from_dense(world, table))
    assert np.array_equal(found.values, [[np.nan] * 3, [0, 0, 1], [np.nan] * 3], equal_nan=True)


def test_the_picture_of_a_solution_is_its_value_map() -> None:
    solution = objects()["solution"]
    assert np.array_equal(heat(solution).values.ravel(), solution.value)


def test_the_picture_of_episodes_is_the_first_path() -> None:
    episodes = objects()["episodes"]
    first, found = episodes[0], heat(episodes)
    assert list(found.path) == [first.start, *first.target[first.target < 12].tolist()]
    assert list(found.hollow[1:]) == (~first.located[first.target < 12]).tolist()
    assert picture_of(tm.simulate(objects()["world"], "qmdp", 0)) is None


def test_the_picture_of_a_run_names_what_its_figures_are_of() -> None:
    found = picture_of(objects()["run"])
    assert isinstance(found, Lines)
    assert set(found.levels) == {"learned", "Q_MDP", "upper bound"}
    batch = {"frames_per_batch": 100, "envs": 10, "total_frames": 200}
    found = picture_of(tm.train(recorded(), "model_based", **batch))
    assert isinstance(found, Lines)
    assert list(found.levels) == ["learned, held-out tracks"]
    assert "validation" in next(iter(found.lines))


def test_metrics_are_a_frame_where_pandas_is(monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = pytest.importorskip("pandas")
    run = objects()["run"]
    assert isinstance(run.metrics, pandas.DataFrame)
    assert run.metrics["frames"].tolist() == run.columns["frames"] == [2000, 4000]
    monkeypatch.setattr("trackmdp.training.run.find_spec", lambda name: None)
    assert run.metrics == run.columns


@pytest.mark.parametrize("ending", ["gif", pytest.param("mp4", marks=pytest.mark.slow)])
def test_an_episode_is_written_as_a_video(
    ending: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame for each step, of a .gif as soon as it is drawn; nothing else is left in the folder."""
    pytest.importorskip("imageio_ffmpeg")
    sizes, draw = [], video._frame

    def noted(*drawn: Any) -> None:
        sizes.append(sum(each.stat().st_size for each in tmp_path.iterdir()))
        draw(*drawn)

    monkeypatch.setattr(video, "_frame", noted)
    episodes = objects()["episodes"]
    short = min(range(len(episodes)), key=lambda number: len(episodes[number]))
    file = episodes.video(tmp_path / f"a.{ending}", short, speed=10)
    assert list(tmp_path.iterdir()) == [file]
    if ending == "gif":
        from PIL import Image

        with Image.open(io.BytesIO(file.read_bytes())) as image:
            assert image.n_frames == len(episodes[short])
            assert image.info["duration"] == 100
        assert 0 == sizes[0] < sizes[-1]
    else:
        import imageio_ffmpeg

        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(file))
        assert frames == len(episodes[short])


def test_several_targets_are_a_video_in_colours_of_their_own(tmp_path: Any) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    world = tm.make_world("random_walk", size=3, exit_probability=0.2, cost=0.3)
    episodes = tm.simulate(tm.Group([world] * 3), "all_on", 4)
    with image.open(episodes.video(tmp_path / "a.gif", 1)) as shown:
        assert shown.n_frames == len(episodes[1])
        pixels = {colour for _, colour in shown.convert("RGB").getcolors(2**20)}
    wanted = [tuple(round(255 * share) for share in shares_of(k).values()) for k in range(3)]
    near = [min(max(abs(a - b) for a, b in zip(c, w, strict=True)) for c in pixels) for w in wanted]
    assert max(near) < 80  # a .gif has few colours; grey and white are farther from all of them


def test_a_video_that_cannot_be_written_is_one_line(tmp_path: Any) -> None:
    episodes = objects()["episodes"]
    with pytest.raises(UserError, match=r"a\.avi, expected a file that ends with \.gif or \.mp4"):
        episodes.video(tmp_path / "a.avi")
    with pytest.raises(UserError, match="episode 6, expected 0 to 5"):
        episodes.video(tmp_path / "a.gif", 6)
    assert not list(tmp_path.iterdir())
