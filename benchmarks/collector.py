"""Time that TorchRL's collector adds to a vector step, on one core: python benchmarks/collector.py

The same environment and the same random choice among feasible actions run once in a plain loop and once through the
collector of ``collector=single``, in turn. The collector also keeps every frame with its mask for the learner.
"""

import time

import torch
from common import save, spread, use_one_core
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from pickplace import PickPlaceEnv, State
from pickplace.rules.masks import actions_reaching, placing_maps
from pickplace.rules.observation import STANDARD_TERMS
from pickplace.training.collectors import single
from pickplace.training.curriculum import Current, Curriculum, NoAdvance

BATCHES = (256, 1024)
STEPS, REPEATS = 16, 20


def choose(mask: torch.Tensor) -> torch.Tensor:
    """Return a feasible entry of each row: the highest of as many random bytes as there are entries, masked."""
    draw = torch.randint(1, 256, mask.shape, dtype=torch.uint8)
    return (draw * mask).argmax(1)


def measure(batch: int, mask: str) -> dict:
    """Return the times of a vector step in both loops, with the ``action`` or the ``footprint`` mask."""
    curriculum = Curriculum(NoAdvance(), Current())

    def make(first_episode: int = 0, num_envs: int = batch) -> TransformedEnv:
        env = PickPlaceEnv(num_envs=num_envs, masks=(mask,), first_episode=first_episode)
        curriculum.setup(env.min_tote_height, env.cell.tote_size[2], 1)
        return TransformedEnv(env, Compose(curriculum.transform()))

    env = make()
    cell = env.base_env.cell
    keys = [f"{mask}_mask", *STANDARD_TERMS]

    def act(*values):
        observation = dict(zip(keys, values, strict=True))
        choice = choose(observation[f"{mask}_mask"])
        if mask == "action":
            return choice
        maps = placing_maps(cell, State.from_observation(observation))
        return actions_reaching(cell, maps, choice).amax(1)

    policy = TensorDictModule(act, in_keys=keys, out_keys=["action"])
    collector = single(make, policy, batch, STEPS, seed=0)
    batches, state = iter(collector), env.reset()
    times = {"raw loop": [], "collector": []}
    for _ in range(REPEATS + 2):
        start = time.perf_counter()
        for _ in range(STEPS):
            _, state = env.step_and_maybe_reset(policy(state))
        middle = time.perf_counter()
        next(batches)
        end = time.perf_counter()
        times["raw loop"].append((middle - start) / STEPS * 1e3)
        times["collector"].append((end - middle) / STEPS * 1e3)
    collector.shutdown()
    row = {name: spread(values[2:]) for name, values in times.items()}
    row["added ms"] = row["collector"]["ms"] - row["raw loop"]["ms"]
    return row


def main() -> None:
    use_one_core()
    torch.manual_seed(0)
    masks = ("action", "footprint")
    save("collector", {"rows": {f"{batch}, {mask} mask": measure(batch, mask) for mask in masks for batch in BATCHES}})


if __name__ == "__main__":
    main()
