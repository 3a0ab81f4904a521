"""The configuration: typed options with unit and range (Hydra structured configs); their values live in `conf/`.

Here stand the names that commands and plugins use most; each schema is in a module of its own.
"""

from trackmdp.config.baselines import BaselineConfig, PlaybackConfig
from trackmdp.config.hidden_kernels import HiddenKernelConfig
from trackmdp.config.learning import AlgoConfig, CollectorConfig
from trackmdp.config.logs import (
    CsvConfig,
    LogConfig,
    McapConfig,
    MlflowConfig,
    WandbConfig,
)
from trackmdp.config.options import (
    GROUPS,
    ChoiceConfig,
    NodeConfig,
    Option,
    choice,
    option,
    options,
    refuse,
)
from trackmdp.config.registry import conf_dir, load_plugins
from trackmdp.config.roots import (
    ROOTS,
    CheckpointConfig,
    CommandConfig,
    CompareConfig,
    EvaluateConfig,
    ExportConfig,
    FrontierConfig,
    ReplayConfig,
    ReportConfig,
    SolveConfig,
    TrainConfig,
    VerifyConfig,
    WorldConfig,
)
from trackmdp.config.sensors import CostConfig, FalseAlarmConfig, SensorConfig
from trackmdp.config.tree import load_run_config, to_dict, to_yaml, train_config_of
from trackmdp.config.world import MEMORIES, KernelConfig

load_plugins()  # at the end: they import the names above
