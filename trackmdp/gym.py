"""Registers `trackmdp/Track-v0` with Gymnasium.

    import gymnasium, trackmdp
    env = gymnasium.make("trackmdp/Track-v0", kernel="random_walk", size=5, cost=0.1)
    env = gymnasium.make_vec("trackmdp/Track-v0", num_envs=64, world=world)

`import trackmdp` does it where Gymnasium is loaded already; else this module does, also as
``gymnasium.make("trackmdp.gym:trackmdp/Track-v0")``. (Gymnasium 1.0 and later look at no entry points.)
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

ID = "trackmdp/Track-v0"

if ID not in registry:
    # By name: torch is loaded when an environment is made.
    register(ID, "trackmdp.world.gym_env:TrackGym", vector_entry_point="trackmdp.world.gym_env:TrackVector")
