"""Forward and backward time of the paper's network, ``fcn4d``, against a naive 4D convolution, on one core.

python benchmarks/conv4d.py

The naive version broadcasts both maps to a 4D input of two channels and computes each 4D convolution as a sum of
``conv3d`` over the taps of its first axis, in float32. Every variant gives the same logits (checked here and in the
tests).
"""

from functools import partial

import torch
import torch.nn.functional as F
from common import interleave, save, use_one_core

from pickplace import PickPlaceEnv
from pickplace.policies.depth import clip_depth, pad_depth
from pickplace.policies.fcn4d.policy import FEW_PLACES, Fcn4d

CASES = {"5x5 bin, 6x6 tote, batch 64": ((6, 6, 5), 64, 5), "5x5 bin, 30x30 tote, batch 1": ((30, 30, 5), 1, 5)}


def conv4d(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    """Return a 4D convolution without padding, of ``[N, C, A, B, X, Y]`` with ``[O, C, k, k, k, k]``."""
    kernel, rows = weight.shape[2], x.shape[2] - weight.shape[2] + 1
    planes = []
    for row in range(rows):
        taps = [F.conv3d(x[:, :, row + tap], weight[:, :, tap]) for tap in range(kernel)]
        planes.append(sum(taps) + bias[:, None, None, None])
    return torch.stack(planes, 2)


def naive(network, bin_depth: torch.Tensor, tote_depth: torch.Tensor) -> torch.Tensor:
    """Return all logits ``[N, P * places * 4]``, computed as the paper describes the network."""
    bins = pad_depth(clip_depth(bin_depth, network.bin_clip), 2, -1.0)
    totes = pad_depth(clip_depth(tote_depth, network.tote_clip), 2, 0.0)
    size = (len(bins), *bins.shape[1:], *totes.shape[1:])
    x = torch.stack([bins[:, :, :, None, None].expand(size), totes[:, None, None].expand(size)], 1)
    for layer in (network.first, network.second):
        x = F.relu(conv4d(x, layer.weight, layer.bias))
    return conv4d(x, network.head.weight, network.head.bias).permute(0, 2, 3, 4, 5, 1).flatten(1)


def matrix_product(dtype: torch.dtype, size: int = 2048):
    """Return a large square matrix product, the reference for this machine's speed, and its arithmetic operations."""
    a, b = (torch.randn(size, size).to(dtype) for _ in range(2))
    return lambda: a @ b, 2 * size**3


def operations(filters: int, pairs: float) -> float:
    """Return the arithmetic operations of so many pairs of a pick and a place, in the second layer and the head."""
    return 2 * pairs * filters * (filters * 3**4 + 4)


def states(tote_size, batch: int):
    """Return a cell and observations from the middle of episodes of random feasible actions."""
    env = PickPlaceEnv(tote_size=tote_size, num_envs=batch)
    state = env.rollout(12, break_when_any_done=False)[:, -1]["next"]
    return env.cell, state


def peak_memory(calls: dict) -> dict[str, float]:
    """Return the peak MiB of one forward pass of each call, beyond the inputs and weights."""
    found = {}
    for name, call in calls.items():
        with torch.no_grad(), torch.profiler.profile(profile_memory=True) as profile:
            call()
        held, most = 0, 0
        for event in profile.profiler.kineto_results.events():
            if event.name() == "[memory]":
                held += event.nbytes()
                most = max(most, held)
        found[name] = round(most / 2**20, 1)
    return found


def measure(tote_size, batch: int, repeats: int) -> dict:
    """Return the times and the memory of one case."""
    cell, state = states(tote_size, batch)
    mask = state["action_mask"]
    policies = {dtype: Fcn4d(cell, True, compute_dtype=dtype) for dtype in ("float32", "bfloat16")}
    policies["bfloat16"].load_state_dict(policies["float32"].state_dict())
    network = policies["float32"].network
    calls = {"naive": partial(naive, network, state["bin_depth"], state["tote_depth"])}
    for dtype, policy in policies.items():
        calls[f"all actions, {dtype}"] = partial(policy.scores, state)
        calls[f"masked, {dtype}"] = partial(policy.scores, state, mask)

    def learn(call):
        for policy in policies.values():
            policy.zero_grad(set_to_none=True)
        call().logsumexp(1).sum().backward()

    products = {dtype: matrix_product(getattr(torch, dtype)) for dtype in policies}
    products_by_name = {f"matrix product, {dtype}": call for dtype, (call, _) in products.items()}
    with torch.no_grad():
        assert torch.allclose(calls["naive"](), calls["all actions, float32"](), atol=1e-4)
        row = {"forward": interleave(calls | products_by_name, repeats, warmup=1)}
    both = {name: partial(learn, call) for name, call in calls.items() if not name.startswith("all")}
    row["forward and backward"] = interleave(both, repeats, warmup=1)
    for times in list(row.values()):
        for figures in times.values():
            figures["ratio"] = times["naive"]["ms"] / figures["ms"]
    picks, places = cell.num_picks, cell.num_places
    group = cell.rotations if places <= FEW_PLACES else places * cell.rotations  # logits computed together
    needed = float(mask.unflatten(1, (-1, group)).any(2).sum(1).double().mean()) * group / cell.rotations
    for dtype, (_, work) in products.items():
        reference = work / row["forward"].pop(f"matrix product, {dtype}")["ms"]  # operations a millisecond
        row[f"GFLOPS of a matrix product, {dtype}"] = reference / 1e6
        for name, count in (("all actions", picks * places), ("masked", needed)):
            figures = row["forward"][f"{name}, {dtype}"]
            done = batch * operations(network.filters, count) / figures["ms"]
            figures["share of matrix product"] = done / reference
    row["peak MiB, forward"] = peak_memory(calls)
    row["pairs of a pick and a place, masked"] = round(needed, 2)
    return row


def main() -> None:
    use_one_core()
    torch.manual_seed(0)
    save("conv4d", {"cases": {title: measure(*case) for title, case in CASES.items()}})


if __name__ == "__main__":
    main()
