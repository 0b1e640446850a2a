"""Train sb3-contrib's MaskablePPO on the Gymnasium environment: python docs/examples/maskable_ppo.py

Needs ``pip install sb3-contrib``. Some three minutes on one CPU core, on a small tote. pickplace's own training is far
faster; this shows that other libraries can learn on the same task.
"""

import gymnasium
import numpy as np
from sb3_contrib import MaskablePPO

import pickplace  # noqa: F401  (registers the environment)

SETTINGS = {"tote_size": (4, 4, 1)}


def mean_occupancy(choose, episodes: int = 200) -> float:
    """Play the test stream with ``choose(observation, mask) -> action``."""
    env = gymnasium.make("pickplace/PickPlace-v0", stream="test", **SETTINGS)
    total = 0.0
    for episode in range(episodes):
        observation, info = env.reset(seed=0 if episode == 0 else None)
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(choose(observation, info["action_mask"]))
            done = terminated or truncated
        total += info["occupancy"]
    return total / episodes


if __name__ == "__main__":
    generator = np.random.default_rng(0)
    random = mean_occupancy(lambda _, mask: generator.choice(np.flatnonzero(mask)))
    print(f"random feasible actions: {random:.3f}")  # noqa: T201

    env = gymnasium.make("pickplace/PickPlace-v0", **SETTINGS)
    model = MaskablePPO("MultiInputPolicy", env, n_steps=512, batch_size=128, gamma=0.99, seed=0)
    model.learn(40_000)
    trained = mean_occupancy(lambda seen, mask: int(model.predict(seen, action_masks=mask, deterministic=True)[0]))
    print(f"MaskablePPO after {model.num_timesteps:,} steps: {trained:.3f}")  # noqa: T201
