"""A2C, PPO and DQN with a credit per sensor: hindsight learning with the actor losses of these algorithms."""

from __future__ import annotations

from trackmdp.algos.actor_loss import ActorLoss, Poisson, PolicyGradient, Surrogate
from trackmdp.algos.hindsight import Hindsight
from trackmdp.config.credit import A2cPerSensorConfig, PpoPerSensorConfig
from trackmdp.errors import UserError


class PerSensorA2C(Hindsight):
    """The policy gradient over both actions of every sensor."""

    cfg: A2cPerSensorConfig

    def _actor_loss(self) -> ActorLoss:
        return PolicyGradient(self.cfg.entropy)


class PerSensorPPO(Hindsight):
    """The clipped surrogate of every sensor, over both actions or over sets drawn from the old policy."""

    cfg: PpoPerSensorConfig

    def _actor_loss(self) -> ActorLoss:
        cfg, task = self.cfg, self.task
        # Without a generator the surrogate takes its expectation over the old policy's sets.
        rng = self._generator if cfg.surrogate == "sampled" else None
        # It counts paths, which have weights where sensors miss, and each of which one sensor sees.
        if rng is not None and not (task.perfect and task.coverage is None):
            raise UserError(
                "algo.surrogate=sampled: expected all_action where sensors miss or have footprints"
            )
        return Surrogate(
            cfg.entropy, clip_epsilon=cfg.clip_epsilon, minibatches=cfg.minibatches, generator=rng
        )


class PerSensorDQN(Hindsight):
    """A Q that adds up over the sensors."""

    def _actor_loss(self) -> ActorLoss:
        return Poisson()
