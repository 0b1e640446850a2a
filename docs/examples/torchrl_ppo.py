"""Plain TorchRL: PPO on a 4x4x1 tote, from TorchRL's own parts: python docs/examples/torchrl_ppo.py

Half a minute on one CPU core. ``pickplace-train`` adds better networks, curricula, validation and checkpoints.
"""

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import ActionMask, TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from pickplace import PickPlaceEnv


class Network(nn.Module):
    """Two fully connected layers over both depth maps, ``[..., outputs]``; a mask excludes actions that would fail."""

    def __init__(self, cell, outputs: int):
        super().__init__()
        inputs = cell.num_picks + cell.num_places
        self.layers = nn.Sequential(nn.Linear(inputs, 256), nn.ReLU(), nn.Linear(256, outputs))

    def forward(self, bin_depth, tote_depth, mask=None):
        out = self.layers(torch.cat([bin_depth.flatten(-2), tote_depth.flatten(-2)], -1))
        return out if mask is None else out.masked_fill(~mask, -1e38)


def make_env(**settings) -> TransformedEnv:
    """Return an environment whose random actions are feasible; without ``ActionMask`` nearly all would fail."""
    return TransformedEnv(PickPlaceEnv(tote_size=(4, 4, 1), **settings), ActionMask())


def mean_occupancy(policy=None) -> float:
    """Return the mean occupancy of 128 test episodes, one a slot; None plays random feasible actions."""
    env = make_env(num_envs=128, stream="test")
    after = env.rollout(16, policy, break_when_any_done=False)["next"]  # [128, 16]: each item fills a cell or more
    first_end = after["done"].int().argmax(1, keepdim=True)
    return after["occupancy"].gather(1, first_end).mean().item()


def train(total_frames: int = 30_720) -> tuple[float, float]:
    """Train, and return the mean occupancy of random actions and of the trained policy, on the same items."""
    torch.manual_seed(0)
    env = make_env(num_envs=64)
    cell, maps = env.base_env.cell, ["bin_depth", "tote_depth"]
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(Network(cell, cell.num_actions), [*maps, "action_mask"], ["logits"]),
        ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=Categorical, return_log_prob=True),
    )
    critic = ValueOperator(Network(cell, 1), maps)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.002, critic_coeff=0.1, normalize_advantage=True)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    limits = {"frames_per_batch": 1024, "total_frames": total_frames}
    collector = Collector(env, actor, **limits, auto_register_policy_transforms=False)
    before, frames = mean_occupancy(), 0
    print(f"random feasible actions: occupancy {before:.3f}")  # noqa: T201
    for batch in collector:  # [64, 16]
        frames += batch.numel()
        with torch.no_grad():
            advantage(batch)
        for _ in range(4):
            for part in batch.reshape(-1)[torch.randperm(batch.numel())].split(256):
                losses = loss(part)
                optimizer.zero_grad()
                sum(losses[key] for key in ("loss_objective", "loss_critic", "loss_entropy")).backward()
                optimizer.step()
        ended = batch["next", "done"]
        print(f"{frames:>6} frames: occupancy {batch['next', 'occupancy'][ended].mean():.3f}")  # noqa: T201
    collector.shutdown()
    after = mean_occupancy(actor)
    print(f"the trained policy: occupancy {after:.3f}")  # noqa: T201
    return before, after


if __name__ == "__main__":
    train()
