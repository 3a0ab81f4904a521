"""The options of `algo=counts`: what they are, in which unit and range; their values are in `conf/algo/counts.yaml`."""

from trackmdp.config import AlgoConfig, choice, option


@choice("algo", "counts", makes="trackmdp_counts.learner:Counts")
class CountsConfig(AlgoConfig):
    """Count the moves that are sensed, and look where the target is most often found so many steps later."""

    prior: float = option("moves to nowhere added to the counts of each cell", unit="moves", gt=0)
