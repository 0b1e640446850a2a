"""Plain TorchRL: PPO on a 4x4x1 tote, from TorchRL's own parts: python docs/examples/torchrl_script.py

About a minute on one CPU core. ``pickplace-train`` adds better networks, curricula, validation and checkpoints.
"""

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
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


def train(total_frames: int = 61_440) -> float:
    """Train, and return the mean occupancy of the last quarter's episodes."""
    torch.manual_seed(0)
    env = PickPlaceEnv(tote_size=(4, 4, 1), num_envs=64)
    maps = ["bin_depth", "tote_depth"]
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(Network(env.cell, env.cell.num_actions), [*maps, "action_mask"], ["logits"]),
        ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=Categorical, return_log_prob=True),
    )
    critic = ValueOperator(Network(env.cell, 1), maps)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.002, critic_coeff=0.1, normalize_advantage=True)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    limits = {"frames_per_batch": 1024, "total_frames": total_frames}
    collector = Collector(env, actor, **limits, auto_register_policy_transforms=False)
    means, frames = [], 0
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
        if frames > 0.75 * total_frames:
            means.append(batch["next", "occupancy"][ended].mean().item())
        print(f"{frames:>6} frames, occupancy {batch['next', 'occupancy'][ended].mean():.3f}")  # noqa: T201
    collector.shutdown()
    return sum(means) / len(means)


if __name__ == "__main__":
    train()
