"""What TorchRL's collector adds to a vector step, on one core: python benchmarks/collector.py

The same environment and the same random choice among feasible actions, once in a raw loop and once through the
collector of ``collector=single``, turn by turn. The collector also keeps every frame, mask included, for the learner.
"""

import time

import torch
from common import save, spread, use_one_core
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from pickplace import PickPlaceEnv
from pickplace.training.collectors import single
from pickplace.training.curriculum import Current, Curriculum, NoAdvance

BATCHES = (256, 1024)
MASKS = (("action",), ("outcome",))
STEPS, REPEATS = 16, 20


def choose(mask: torch.Tensor) -> torch.Tensor:
    """One feasible entry of each row: the highest of as many random bytes as there are entries, masked."""
    draw = torch.randint(1, 256, mask.shape, dtype=torch.uint8)
    return (draw * mask).argmax(1)


def measure(batch: int, masks: tuple[str, ...]) -> dict:
    """Milliseconds a vector step of both loops."""
    curriculum = Curriculum(NoAdvance(), Current())

    def make(first_episode: int = 0, num_envs: int = batch) -> TransformedEnv:
        env = PickPlaceEnv(num_envs=num_envs, masks=masks, first_episode=first_episode)
        curriculum.setup(env.min_tote_height, env.rules.tote_size[2], 1)
        return TransformedEnv(env, Compose(curriculum.transform()))

    env = make()
    reach = env.base_env.rules.actions_reaching

    def act(mask, bin_depth, tote_depth, tote_height):
        choice = choose(mask)
        if masks == ("action",):
            return choice
        rules = env.base_env.rules
        return reach(rules.placements_from_depth(bin_depth, tote_depth, tote_height), choice).amax(1)

    keys = [f"{masks[0]}_mask", "bin_depth", "tote_depth", "tote_height"]
    policy = TensorDictModule(act, in_keys=keys, out_keys=["action"])
    collector = single(make, policy, batch, STEPS, seed=0)
    batches, state = iter(collector), env.reset()
    times = {"raw loop": [], "collector": []}
    for _ in range(REPEATS + 2):
        start = time.perf_counter()
        for _ in range(STEPS):
            _, state = env.step_and_maybe_reset(policy(state))
        raw = time.perf_counter()
        next(batches)
        end = time.perf_counter()
        for name, passed in (("raw loop", raw - start), ("collector", end - raw)):
            times[name].append(passed / STEPS * 1e3)
    collector.shutdown()
    row = {name: spread(values[2:]) for name, values in times.items()}
    row["added ms"] = row["collector"]["ms"] - row["raw loop"]["ms"]
    return row


def main() -> None:
    use_one_core()
    torch.manual_seed(0)
    rows = {f"{batch}, {masks[0]} mask": measure(batch, masks) for masks in MASKS for batch in BATCHES}
    save("collector", {"rows": rows})


if __name__ == "__main__":
    main()
