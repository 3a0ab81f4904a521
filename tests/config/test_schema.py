"""The schema and conf/ say the same things once each."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]  # a dependency of OmegaConf
from omegaconf import OmegaConf

from tests.config.cases import COMBINATIONS, composed, files_of
from tests.helpers import configured
from tests.reads import record_reads, unread
from trackmdp.config import (
    GROUPS,
    ROOTS,
    Option,
    TrainConfig,
    conf_dir,
    options,
    to_yaml,
    train_config_of,
)
from trackmdp.config.tree import load_config
from trackmdp.errors import UserError

CONF = Path(conf_dir())
CHOICES = [(group, name) for group, names in GROUPS.items() for name in names]


def read(file: Path) -> dict[str, Any]:
    plain = OmegaConf.to_container(OmegaConf.load(file))
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def keys(values: dict[str, Any]) -> set[str]:
    return set(values) - {"defaults", "hydra"}


@pytest.mark.parametrize(("group", "name"), CHOICES)
def test_yaml_of_a_choice_holds_exactly_the_options_of_its_schema(group: str, name: str) -> None:
    values = read(CONF / group / f"{name}.yaml")
    if group == "solver":
        assert values == {"defaults": [{"/baseline@_here_": name}]}
        return
    schema = GROUPS[group][name]
    assert values["defaults"] == [f"base_{name}"]
    assert keys(values) == set(options(schema))
    for key, item in options(schema).items():
        if not isinstance(item, Option):
            assert set(values[key]) == set(options(item.schema))


@pytest.mark.parametrize("command", ROOTS)
def test_yaml_of_a_command_holds_exactly_the_options_of_its_schema(command: str) -> None:
    values = read(CONF / f"{command}.yaml")
    schema = options(ROOTS[command])
    groups = {
        name for name, item in schema.items() if name in GROUPS and not isinstance(item, Option)
    }
    chosen = {key for entry in values["defaults"] if isinstance(entry, dict) for key in entry}
    assert groups <= chosen
    assert keys(values) - groups == set(schema) - groups
    for key in set(schema) - groups:
        if not isinstance(item := schema[key], Option):
            assert set(values[key]) == set(options(item.schema))


def test_every_yaml_file_belongs_to_a_schema() -> None:
    found = {
        str(file.relative_to(CONF))
        for file in CONF.rglob("*.yaml")
        if file.parent.name != "experiment"
    }
    expected = {f"{group}/{name}.yaml" for group, name in CHOICES} | {
        f"{command}.yaml" for command in ROOTS
    }
    assert found - {"hydra/folders.yaml"} == expected


def test_schemas_hold_no_values() -> None:
    for schema in [*ROOTS.values(), *(GROUPS[group][name] for group, name in CHOICES)]:
        for field in dataclasses.fields(schema):
            assert field.default is dataclasses.MISSING
            assert field.default_factory is dataclasses.MISSING


def every_option() -> list[tuple[str, Option]]:
    found: list[tuple[str, Option]] = []

    def walk(schema: type[Any], where: str) -> None:
        for key, item in options(schema).items():
            if isinstance(item, Option):
                found.append((f"{where}.{key}", item))
            else:
                walk(item.schema, f"{where}.{key}")

    for schema in [*ROOTS.values(), *(GROUPS[group][name] for group, name in CHOICES)]:
        walk(schema, schema.__name__)
    return found


@pytest.mark.parametrize(("where", "item"), every_option())
def test_every_option_says_what_it_is_and_what_it_may_be(where: str, item: Option) -> None:
    assert item.help, where
    if item.kind in (int, float) and not item.many:
        assert max(item.ge, item.gt) > -math.inf, where
        assert not item.allows(math.nan)
        assert not item.allows(math.inf)
        assert not item.allows(10**400)  # more digits than a float has
    if item.kind is str:
        assert item.choices or item.expects, where


def test_a_mapping_is_a_value_of_the_options_that_are_one() -> None:
    slurm = options(GROUPS["hydra/launcher"]["submitit_slurm"])
    given = {"mail-type": "END"}
    assert [slurm[name].allows(given) for name in ("additional_parameters", "partition")] == [
        True,
        False,
    ]  # type: ignore[union-attr]


@pytest.mark.parametrize(("command", "choice"), COMBINATIONS)
def test_every_choice_composes_and_survives_config_yaml(
    command: str, choice: str, tmp_path: Path
) -> None:
    words = [choice, *files_of(command, choice)]
    words += ["baseline=qmdp"] * (command == "evaluate" and not choice.startswith("baseline="))
    cfg = configured(command, *words)
    group, name = choice.split("=")
    chosen = getattr(cfg, group)
    assert [node.name for node in (chosen.values() if isinstance(chosen, dict) else [chosen])] == [
        name
    ]
    file = tmp_path / "config.yaml"
    file.write_text(to_yaml(cfg), encoding="utf-8")
    assert load_config(file, ROOTS[command]) == cfg


def test_paths_are_resolved_where_the_command_was_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cfg = composed("train", "kernel=table", "kernel.path=sub/my.npy", "cost.sensor=/abs/c.csv")
    assert (cfg.kernel.path, cfg.cost.sensor) == (f"{tmp_path}/sub/my.npy", "/abs/c.csv")


def test_kernel_seed_follows_the_support_size() -> None:
    assert composed("train", "kernel.support_size=3").kernel.seed == 3
    assert composed("train", "kernel.support_size=3", "kernel.seed=7").kernel.seed == 7


RULES = [
    ("train", "kernel.support_size=10", "kernel.support_size=10: expected an integer from 1 to 9"),
    (
        "train",
        "grid.window=2147483648",
        "grid.window=2147483648: expected an integer from 0 to 1024 or null (cells)",
    ),
    ("train", "kernel.low_probability=0.995", "kernel.low_probability=0.995: expected less than"),
    ("train", "cost.sensor=[1,2,3]", "cost.sensor: 3 values, expected one number or 100"),
    ("train", "cost.sensor=-0.1", "cost.sensor=-0.1: expected a number from 0 to 1e15"),
    ("train", "cost.sensor=true", "cost.sensor=True: expected a number from 0 to 1e15"),
    (
        "train",
        "collector.total_frames=1000000000000000000",
        "collector.total_frames=1000000000000000000: expected an",
    ),
    ("train", "cost.sensor=1e16", "cost.sensor=1e+16: expected a number from 0 to 1e15"),
    ("train", "cost.reward=5e-324", "cost.reward=5e-324: expected a number from 1e-15 to 1e15"),
    ("train", "cost.safe=1e308", "cost.safe=1e+308: expected a number from 0 to 1e15"),
    (
        "train",
        "algo=a2c algo.entropy.end=1e308",
        "algo.entropy.end=1e+308: expected a number from 0 to 1e6",
    ),
    ("train", "cost.sensor=prices.txt", "cost.sensor=prices.txt: expected a number from 0 to 1e15"),
    (
        "train",
        "algo=ppo collector.envs=100",
        "algo.frames_per_batch=4096: expected a multiple of 100",
    ),
    (
        "train",
        "algo=ppo collector.total_frames=4095",
        "collector.total_frames=4095: expected at least algo.frames_per_batch=4096",
    ),
    (
        "train",
        "algo=ppo algo.total_frames=4095",
        "algo.total_frames=4095: expected at least algo.frames_per_batch=4096",
    ),
    (
        "train",
        "algo=hindsight algo.explore.start=1.5",
        "algo.explore.start=1.5: expected a number from 0 to 1",
    ),
    ("train", "algo=ppo algo.minibatches=3", "algo.minibatches=3: expected a divisor"),
    ("train", "algo=dqn algo.buffer_size=1000", "algo.buffer_size=1000: expected at least"),
    (
        "train",
        "algo=ppo algo.entropy.begin=0.6 algo.entropy.until=0.5",
        "algo.entropy.until=0.5: expected not less than",
    ),
    ("train", "device=cuda:x", "device=cuda:x: expected cpu, cuda, cuda:N or auto"),
    ("evaluate", "baseline=random_k baseline.k=101", "baseline.k=101: expected at most 100"),
    (
        "evaluate",
        "run=a baseline=qmdp",
        "expected exactly one of run=FOLDER and baseline=NAME, got both",
    ),
]


@pytest.mark.parametrize(("command", "words", "message"), RULES)
def test_rules_between_options(command: str, words: str, message: str) -> None:
    with pytest.raises(UserError) as caught:
        configured(command, *words.split())
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("size: 10", "grid.size: missing"),
        ("name: random_support", "kernel=null: expected one of random_support"),
    ],
)
def test_a_config_file_with_a_missing_key_is_refused(
    change: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(to_yaml(composed("train")).replace(f"  {change}\n", "", 1), encoding="utf-8")
    with pytest.raises(UserError, match="config\\.yaml: ") as caught:
        load_config(file, TrainConfig)
    assert message in str(caught.value)


@pytest.mark.parametrize("part", ["grid", "sensor", "algo", "optimal"])
def test_a_config_file_with_a_part_that_is_null_is_refused(part: str, tmp_path: Path) -> None:
    plain = yaml.safe_load(to_yaml(composed("train"))) | {part: None}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(plain), encoding="utf-8")
    with pytest.raises(UserError, match=f"config\\.yaml: {part}=None: expected a mapping"):
        load_config(tmp_path / "config.yaml", TrainConfig)


@pytest.mark.parametrize("text", ["[1, 2]", "just words", "a: [", "seed: 3", ""])
def test_a_file_that_is_no_config_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(UserError):
        load_config(file, TrainConfig)


def test_recorded_reads_are_those_that_happened() -> None:
    cfg = composed("train", "algo=hindsight")
    with record_reads(cfg) as reads:
        assert cfg.algo.learning_rate.start > cfg.algo.learning_rate.end
        to_yaml(cfg)
    assert reads == {"algo.learning_rate.start", "algo.learning_rate.end"}
    assert "seed" in unread(cfg, reads)
    assert "algo.learning_rate.end" not in unread(cfg, reads)
    assert cfg.seed == 0
    assert reads == {"algo.learning_rate.start", "algo.learning_rate.end"}


@pytest.mark.parametrize("choice", ["algo=hindsight", "algo=a2c_per_sensor", "algo=dqn_per_sensor"])
@pytest.mark.parametrize(("size", "frames"), [(3, 300_000), (10, 300_000), (40, 4_800_000)])
def test_the_budget_grows_with_the_number_of_cells(choice: str, size: int, frames: int) -> None:
    cfg = configured("train", choice, f"grid.size={size}")
    assert cfg.algo.total_frames == cfg.collector.total_frames == cfg.algo.buffer_size == frames
    typed = configured("train", choice, f"grid.size={size}", "algo.total_frames=20000")
    assert typed.collector.total_frames == typed.algo.buffer_size == 20_000


def test_bytes_that_are_no_text_are_no_config() -> None:
    with pytest.raises(UserError, match=r"^config.yaml: not a config \("):
        train_config_of(b"\xff\xfe\xfa")
