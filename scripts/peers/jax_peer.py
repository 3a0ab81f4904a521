"""PPO in JAX, the way of PureJaxRL: environment, collecting and learning in one compiled function on the CPU."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false"
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
import optax
import track

ENVS, STEPS, HIDDEN = 1024, 4, 256
EPOCHS, MINIBATCHES, UPDATES_A_CALL = 2, 4, 4
GAMMA, GAE_LAMBDA, CLIP, ENTROPY, VALUE = 0.7, 0.5, 0.2, 0.02, 0.5
FALL = 4_000_000
"""Env steps over which the step size falls to a twentieth."""
SCALE = 0.1
"""Of the rewards that the learner sees."""


class State(NamedTuple):
    """One episode: the target's cell, where it was last located, the misses since, and the sets sensed since."""

    target: jax.Array
    last: jax.Array
    misses: jax.Array
    history: jax.Array


class Env:
    """The instance as pure functions of one row; `vmap` makes the batch."""

    def __init__(self, at: track.Instance) -> None:
        self.at = at
        self.cells, self.cumulated, self.cost = (
            jnp.asarray(at.cells),
            jnp.asarray(at.cumulated),
            jnp.asarray(at.cost),
        )

    def begin(self, key: jax.Array) -> State:
        cell = jax.random.randint(key, (), 0, self.at.num_cells)
        return State(
            cell, cell, jnp.zeros((), jnp.int32), jnp.zeros((self.at.choices, self.at.num_cells))
        )

    def observe(self, state: State) -> jax.Array:
        at = self.at
        parts = (
            jax.nn.one_hot(state.last, at.num_cells),
            jax.nn.one_hot(state.misses, at.choices + 1),
        )
        return jnp.concatenate([*parts, state.history.ravel()])

    def step(
        self, key: jax.Array, state: State, action: jax.Array
    ) -> tuple[State, jax.Array, jax.Array]:
        """The next state, the scaled reward, and whether the target has exited (a new episode has begun then)."""
        draw, start = jax.random.split(key)
        number = (jax.random.uniform(draw) > self.cumulated[state.target]).sum()
        exited, moved = number == self.cumulated.shape[1], self.cells[state.target, number]
        forced = state.misses == self.at.choices
        found = forced | (action[moved] > 0)
        spent = jnp.where(forced, self.at.safe_cost, action @ self.cost)
        history = state.history.at[state.misses].set(
            action
        )  # one past the end is dropped: there it is forced
        located = State(moved, moved, jnp.zeros((), jnp.int32), jnp.zeros_like(history))
        missed = State(moved, state.last, state.misses + 1, history)
        after = jax.tree.map(lambda a, b: jnp.where(found, a, b), located, missed)
        after = jax.tree.map(lambda a, b: jnp.where(exited, a, b), self.begin(start), after)
        return after, jnp.where(exited, 0.0, SCALE * (self.at.reward * found - spent)), exited


def network(
    key: jax.Array, inputs: int, outputs: int, scale: float
) -> list[tuple[jax.Array, jax.Array]]:
    """Weights of a network with one hidden layer, orthogonal as is usual in PPO."""
    first, second = jax.random.split(key)
    make = jax.nn.initializers.orthogonal
    layers = (make(2**0.5)(first, (inputs, HIDDEN)), make(scale)(second, (HIDDEN, outputs)))
    return [(weights, jnp.zeros(weights.shape[1])) for weights in layers]


def apply(layers: list[tuple[jax.Array, jax.Array]], shown: jax.Array) -> jax.Array:
    (first, bias), (second, shift) = layers
    return jax.nn.relu(shown @ first + bias) @ second + shift


def log_probability(logits: jax.Array, action: jax.Array) -> jax.Array:
    return (action * jax.nn.log_sigmoid(logits) + (1 - action) * jax.nn.log_sigmoid(-logits)).sum(
        axis=-1
    )


def loss(parameters: Any, batch: dict[str, jax.Array]) -> jax.Array:
    """The clipped surrogate with one advantage for all sensors, value and entropy."""
    logits = apply(parameters["actor"], batch["shown"])
    ratio = jnp.exp(log_probability(logits, batch["action"]) - batch["log_probability"])
    gain = (batch["advantage"] - batch["advantage"].mean()) / (batch["advantage"].std() + 1e-8)
    surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain)
    entropy = (jax.nn.softplus(logits) - logits * jax.nn.sigmoid(logits)).sum(axis=-1)
    error = apply(parameters["critic"], batch["shown"])[..., 0] - batch["target"]
    return (VALUE * error**2 - surrogate - ENTROPY * entropy).mean()


def collect(
    env: Env, parameters: Any, states: State, key: jax.Array
) -> tuple[State, dict[str, jax.Array]]:
    """`STEPS` steps of every row, with their advantages (generalised advantage estimation)."""

    def step(states: State, key: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        act, move = jax.random.split(key)
        shown = jax.vmap(env.observe)(states)
        logits = apply(parameters["actor"], shown)
        action = jax.random.bernoulli(act, jax.nn.sigmoid(logits)).astype(jnp.float32)
        after, reward, exited = jax.vmap(env.step)(jax.random.split(move, ENVS), states, action)
        row = {"shown": shown, "action": action, "log_probability": log_probability(logits, action)}
        return after, row | {
            "reward": reward,
            "goes_on": 1.0 - exited,
            "value": apply(parameters["critic"], shown)[..., 0],
        }

    states, rows = jax.lax.scan(step, states, jax.random.split(key, STEPS))
    final = apply(parameters["critic"], jax.vmap(env.observe)(states))[..., 0]

    def back(
        carry: tuple[jax.Array, jax.Array], row: Any
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        advantage, value = carry
        error = row["reward"] + GAMMA * row["goes_on"] * value - row["value"]
        advantage = error + GAMMA * GAE_LAMBDA * row["goes_on"] * advantage
        return (advantage, row["value"]), advantage

    _, advantage = jax.lax.scan(back, (jnp.zeros(ENVS), final), rows, reverse=True)
    rows |= {"advantage": advantage, "target": advantage + rows["value"]}
    return states, jax.tree.map(lambda x: x.reshape(STEPS * ENVS, *x.shape[2:]), rows)


def learner(env: Env, optimizer: optax.GradientTransformation) -> Any:
    """One call: some updates, each on fresh steps."""

    def minibatch(carry: Any, batch: dict[str, jax.Array]) -> tuple[Any, None]:
        parameters, moments = carry
        change, moments = optimizer.update(jax.grad(loss)(parameters, batch), moments, parameters)
        return (optax.apply_updates(parameters, change), moments), None

    def update(carry: Any, key: jax.Array) -> tuple[Any, None]:
        parameters, moments, states = carry
        first, second = jax.random.split(key)
        states, rows = collect(env, parameters, states, first)

        def epoch(carry: Any, key: jax.Array) -> tuple[Any, None]:
            order = jax.random.permutation(key, STEPS * ENVS).reshape(MINIBATCHES, -1)
            return jax.lax.scan(minibatch, carry, jax.tree.map(lambda x: x[order], rows))

        (parameters, moments), _ = jax.lax.scan(
            epoch, (parameters, moments), jax.random.split(second, EPOCHS)
        )
        return (parameters, moments, states), None

    return jax.jit(
        lambda carry, key: jax.lax.scan(update, carry, jax.random.split(key, UPDATES_A_CALL))[0]
    )


def main() -> None:
    """Learn until the time is up."""
    words = track.arguments(__doc__).parse_args()
    at = track.Instance(words.instance)
    env = Env(at)
    record = track.Record(words.record, words.seconds)
    actor, critic, begin, key = jax.random.split(jax.random.key(words.seed), 4)
    parameters = {
        "actor": network(actor, at.width, at.num_cells, 0.01),
        "critic": network(critic, at.width, 1, 1.0),
    }
    gradients = FALL // (ENVS * STEPS) * EPOCHS * MINIBATCHES
    schedule = optax.linear_schedule(5e-3, 5e-3 / 20, gradients)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule, eps=1e-5))
    carry = (
        parameters,
        optimizer.init(parameters),
        jax.vmap(env.begin)(jax.random.split(begin, ENVS)),
    )
    learn, steps = learner(env, optimizer).lower(carry, key).compile(), 0
    logits = jax.jit(lambda parameters, shown: apply(parameters["actor"], shown))

    def greedy(shown: np.ndarray) -> np.ndarray:
        return np.asarray(logits(carry[0], shown)) > 0

    while record.keep(lambda: at.table(greedy), steps):
        key, now = jax.random.split(key)
        carry = jax.block_until_ready(learn(carry, now))
        steps += UPDATES_A_CALL * ENVS * STEPS
    record.save()


if __name__ == "__main__":
    main()
