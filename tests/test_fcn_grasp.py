"""The network of ``fcn_grasp`` and its critic, against plain convolutions and by hand."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import PickPlaceEnv
from pickplace.geometry import Rules
from pickplace.models.actors import MASKED, fcn_grasp
from pickplace.models.critics import DepthCritic
from pickplace.models.fcn_grasp import ItemConditionedFcn


def random_state(generator, batch, bin_size, tote_size):
    """Depth maps with one box in each bin."""
    bins = torch.zeros(batch, *bin_size)
    for one in bins:
        x, y = (int(torch.randint(0, side, (), generator=generator)) for side in bin_size)
        one[x : x + 2, y : y + 1 + x % 3] = float(torch.randint(1, 5, (), generator=generator))
    return bins, torch.randint(-2, 8, (batch, *tote_size), generator=generator).float()


def by_convolution(network, bin_depth, tote_depth):
    """What the network computes, cell by cell planes and ``conv2d``."""
    clip, levels, sizes = network.tote_clip, network.depth_range, network.item_range
    planes = torch.zeros(len(tote_depth), levels, *tote_depth.shape[1:])
    codes = torch.zeros(len(tote_depth), 3 * sizes)
    for n, tote in enumerate(tote_depth):
        shift = max(float(tote.max()) - clip, 0)
        for x, column in enumerate(tote):
            for y, depth in enumerate(column):
                planes[n, min(max(round(clip - (float(depth) - shift)), 0), levels - 1), x, y] = 1
        filled = bin_depth[n].nonzero()
        lengths = (filled.amax(0) - filled.amin(0) + 1).tolist()
        for part, length in enumerate([*lengths, int(bin_depth[n].max())]):
            codes[n, part * sizes + min(length, sizes) - 1] = 1
    side, weight = network.receptive_field, network.patch.weight
    kernel = weight[:, : levels * side**2].unflatten(1, (levels, side, side))
    from_item = codes @ weight[:, levels * side**2 :].T + network.patch.bias
    x = F.relu(F.conv2d(planes, kernel, padding=side // 2) + from_item[:, :, None, None])
    for layer in (network.hidden, network.head):
        x = F.conv2d(x if layer is network.hidden else F.relu(x), layer.weight[:, :, None, None], layer.bias)
    return x


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    field=st.sampled_from([3, 5, 7]),
    tote=st.tuples(st.integers(1, 7), st.integers(1, 7)),
    sizes=st.tuples(st.integers(1, 4), st.integers(1, 6), st.integers(1, 4)),
)
def test_it_is_a_convolution(seed, field, tote, sizes):
    generator = torch.Generator().manual_seed(seed)
    clip, levels, items = sizes
    network = ItemConditionedFcn(3, 8, field, 6, clip, levels, items, head_std=1.0)
    bins, totes = random_state(generator, 3, (4, 6), tote)
    torch.testing.assert_close(network(bins, totes), by_convolution(network, bins, totes), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rotations", [1, 2, 4])
def test_only_what_the_mask_allows_is_computed_and_it_is_the_same(rotations, monkeypatch):
    env = PickPlaceEnv(tote_size=(7, 5, 3), rotations=rotations, num_envs=12, masks=("action", "outcome"))
    state = env.rollout(6, break_when_any_done=False)[:, -1]["next"]
    policy = fcn_grasp(env.rules, True, head_std=1.0)
    bins, totes, mask = (state[key] for key in ("bin_depth", "tote_depth", "outcome_mask"))
    asked = []
    at = policy.network.at
    monkeypatch.setattr(policy.network, "at", lambda *args: asked.append(len(args[2])) or at(*args))
    logits = policy(bins, totes, mask)
    some = mask.unflatten(1, (env.rules.parities, -1)).any(1)
    assert asked == [int(some.sum())] and asked[0] < some.numel()
    everywhere = policy.network(bins, totes)[:, : env.rules.parities].flatten(1)
    torch.testing.assert_close(logits, torch.where(mask, everywhere, MASKED))
    logits.logsumexp(1).sum().backward()
    assert all(parameter.grad is not None for parameter in policy.parameters())


def test_nothing_allowed_anywhere_gives_no_logit():
    rules = Rules()
    nothing = torch.zeros(2, rules.num_outcomes, dtype=torch.bool)
    logits = fcn_grasp(rules, True)(torch.zeros(2, 5, 5), torch.ones(2, 6, 6), nothing)
    assert (logits == MASKED).all()


def test_the_critic_sees_the_tote_the_item_and_the_room_left():
    rules, generator = Rules(tote_size=(4, 3, 9)), torch.Generator().manual_seed(0)
    critic = DepthCritic(rules, tote_clip=2)
    bins, totes = random_state(generator, 6, (5, 5), (4, 3))
    values = critic(bins, totes)
    assert values.shape == (6, 1)
    torch.testing.assert_close(critic(bins.view(2, 3, 5, 5), totes.view(2, 3, 4, 3)), values.view(2, 3, 1))
    other = totes.clone()
    other[:, 0, 0] -= 1
    for changed in ((bins.roll(1, 0), totes), (bins, other), (bins, totes + 1)):
        assert not torch.isclose(critic(*changed), values).all()
    moved = bins.roll((1, 1), (1, 2))  # where the item lies is not its affair, unless it is cut
    whole = (bins[:, -1] == 0).all(1) & (bins[:, :, -1] == 0).all(1)
    torch.testing.assert_close(critic(moved, totes)[whole], values[whole])


@pytest.mark.parametrize("key", ["filters", "hidden", "tote_clip", "depth_range", "item_range"])
def test_bad_widths_are_refused(key):
    for make in (lambda **kw: ItemConditionedFcn(1, **kw), lambda **kw: DepthCritic(Rules(), **kw)):
        for value in (0, -1, 2.5, True, "4"):
            with pytest.raises(ValueError, match=rf"{key}={value!r}: expected a whole number >= 1"):
                make(**{key: value})
