"""The 4D convolutional policy against a naive 4D convolution, and the promises of its docstrings."""

import itertools
import math

import pytest
import torch

from pickplace.policies.actors import MASKED, FlatPolicy, typical
from pickplace.policies.networks.conv4d import Conv4dCritic, Conv4dPolicy
from pickplace.policies.networks.depth import clip_depth, pad_depth
from pickplace.task.geometry import Rules

SIZES = [  # bin, tote, R, clips, floor
    ((5, 5), (6, 6), 4, (1.0, 5.0), None),
    ((3, 4), (5, 2), 1, (1.0, 3.0), -1.0),
    ((2, 5), (3, 7), 3, (None, None), None),
    ((1, 1), (4, 6), 2, (0.5, 2.5), -0.5),
    ((6, 2), (1, 5), 2, (2.0, None), 0.0),
]


def depths(bin_size, tote_size, batch=3, seed=0, dtype=torch.float32):
    """Bin and tote maps with values on both sides of the clips."""
    gen = torch.Generator().manual_seed(seed)
    bins = torch.randint(0, 4, (batch, *bin_size), generator=gen)
    totes = torch.randint(0, 11, (batch, *tote_size), generator=gen)
    return bins.to(dtype), totes.to(dtype)


def policy(rotations=2, filters=5, **options):
    torch.manual_seed(0)
    return Conv4dPolicy(rotations, filters, **{"head_std": None, **options})


def convolve4d(x, weight, bias):
    """Valid 4D convolution, a sum over the kernel's taps: ``[N, C, a, b, c, d]`` to ``[N, O, ...]``."""
    sides = [n - k + 1 for n, k in zip(x.shape[2:], weight.shape[2:], strict=True)]
    out = bias.view(1, -1, 1, 1, 1, 1)
    for tap in itertools.product(*map(range, weight.shape[2:])):
        window = x[(..., *(slice(t, t + side) for t, side in zip(tap, sides, strict=True)))]
        out = out + torch.einsum("nc...,oc->no...", window, weight[(..., *tap)])
    return out


def naive_map(depth, limit, floor, padding):
    rows = []
    for one in depth:
        if limit is not None and one.max() > limit:
            one = one - (one.max() - limit)
        if floor is not None:
            one = torch.where(one < floor, torch.full_like(one, floor), one)
        padded = torch.full([side + 4 for side in one.shape], padding, dtype=one.dtype)
        padded[2:-2, 2:-2] = one
        rows.append(padded)
    return torch.stack(rows)


def naive(model, bins, totes):
    """Logits and features by the paper's description, on an explicit two-channel 4D tensor."""
    bins = naive_map(bins, model.bin_clip, model.floor, -1.0)[:, :, :, None, None]
    totes = naive_map(totes, model.tote_clip, model.floor, 0.0)[:, None, None]
    x = torch.stack(torch.broadcast_tensors(bins, totes), dim=1)
    x = convolve4d(x, model.first.weight, model.first.bias).relu()
    x = convolve4d(x, model.second.weight, model.second.bias).relu()
    logits = convolve4d(x, model.head.weight, model.head.bias).movedim(1, -1)
    return logits.flatten(1), x.movedim(1, -1).flatten(3, 4).flatten(1, 2)


@pytest.mark.parametrize(("bin_size", "tote_size", "rotations", "clips", "floor"), SIZES)
def test_equals_the_naive_4d_convolution(bin_size, tote_size, rotations, clips, floor):
    model = policy(rotations, bin_clip=clips[0], tote_clip=clips[1], floor=floor)
    bins, totes = depths(bin_size, tote_size)
    logits, features = naive(model, bins, totes)
    assert logits.shape == (3, math.prod(bin_size) * math.prod(tote_size) * rotations)
    torch.testing.assert_close(model(bins, totes), logits, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(model.features(bins, totes), features, rtol=1e-5, atol=1e-5)


def test_the_same_weights_serve_other_sizes():
    model = policy()
    for bin_size, tote_size in [((5, 5), (6, 6)), ((5, 5), (11, 8)), ((4, 7), (3, 3))]:
        bins, totes = depths(bin_size, tote_size, batch=1)
        torch.testing.assert_close(model(bins, totes), naive(model, bins, totes)[0], rtol=1e-5, atol=1e-5)


def test_gradients_equal_the_naive_ones():
    model = policy(3).double()
    bins, totes = (m.requires_grad_() for m in depths((3, 4), (5, 3), dtype=torch.float64))
    inputs = [bins, totes, *model.parameters()]
    output, expected = model(bins, totes), naive(model, bins, totes)[0]
    direction = torch.randn(output.shape, generator=torch.Generator().manual_seed(1), dtype=output.dtype)
    got = torch.autograd.grad(output, inputs, direction)
    want = torch.autograd.grad(expected, inputs, direction)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_bfloat16_is_close_and_keeps_float32_outside():
    exact, rough = policy(4, 16), policy(4, 16, compute_dtype="bfloat16")
    bins, totes = depths((5, 5), (6, 6))
    want, got = exact(bins, totes), rough(bins, totes)
    assert got.dtype == torch.float32
    assert rough.features(bins, totes).dtype == torch.float32
    assert (got - want).abs().max() < 0.02 * want.abs().max()
    for output in (want, got):
        output.square().sum().backward()
    for a, b in zip(rough.parameters(), exact.parameters(), strict=True):
        assert a.grad.dtype == torch.float32
        assert (a.grad - b.grad).norm() < 0.05 * b.grad.norm()


@pytest.mark.parametrize("chunk_bytes", [1, 60_000, 300_000])
def test_chunks_change_nothing(chunk_bytes):
    whole, pieces = policy(), policy(chunk_bytes=chunk_bytes)
    bins, totes = depths((4, 3), (5, 6), batch=7)
    with torch.no_grad():
        for a, b in ((pieces, whole), (pieces.features, whole.features)):
            torch.testing.assert_close(a(bins, totes), b(bins, totes), rtol=1e-5, atol=1e-5)


def test_given_pick_cells_select_their_part():
    model = policy(3)
    bins, totes = depths((4, 5), (3, 6), batch=4)
    pick, each = torch.tensor([0, 7, 19, 11]), torch.arange(4)
    logits = model(bins, totes).unflatten(1, (20, -1))[each, pick]
    torch.testing.assert_close(model(bins, totes, pick), logits, rtol=1e-5, atol=1e-5)
    features = model.features(bins, totes)[each, pick]
    torch.testing.assert_close(model.features(bins, totes, pick), features, rtol=1e-5, atol=1e-5)


def test_any_leading_dimensions_and_integer_depths():
    model, critic = policy(), Conv4dCritic((4, 3, 1), (5, 6, 5), filters=4, hidden=8)
    bins, totes = depths((4, 3), (5, 6), batch=6, dtype=torch.int64)
    flat, values = model(bins, totes), critic(bins, totes)
    two = [m.unflatten(0, (2, 3)) for m in (bins, totes)]
    torch.testing.assert_close(model(*two), flat.unflatten(0, (2, 3)))
    torch.testing.assert_close(critic(*two), values.unflatten(0, (2, 3)))
    torch.testing.assert_close(model(bins[0], totes[0]), flat[0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(model(*two, torch.zeros(2, 3, dtype=torch.int64)).flatten(0, 1), flat[:, :60])
    torch.testing.assert_close(model(bins[0], totes[0], torch.tensor(0)), flat[0, :60], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(critic(bins[0], totes[0]), values[0])


def test_depth_clipping_makes_the_tote_height_irrelevant():
    bins, totes = depths((5, 5), (6, 6))
    totes[:, 0, 0] = 10.0  # an empty column
    clipped, raw = policy(), policy(tote_clip=None)
    torch.testing.assert_close(clipped(bins, totes + 20), clipped(bins, totes))
    assert not torch.allclose(raw(bins, totes + 20), raw(bins, totes))


def test_clip_depth_is_per_map_and_shifts():
    depth = torch.tensor([[[7.0, 3.0], [0.0, 6.5]], [[2.0, 1.0], [0.0, 5.0]]])
    clipped = clip_depth(depth, 5.0)
    torch.testing.assert_close(clipped[0], torch.tensor([[5.0, 1.0], [-2.0, 4.5]]))
    torch.testing.assert_close(clipped[1], depth[1])
    assert clip_depth(depth, 5.0, floor=-1.0).min() == -1
    torch.testing.assert_close(clip_depth(depth, None), depth)
    assert clip_depth(depth, None, floor=2.0).min() == 2
    assert pad_depth(depth, 2, -1.0).shape == (2, 6, 6)


def test_initialisation():
    model = policy(4, 64)
    bound = 1 / math.sqrt(64 * 81)
    assert 0.99 * bound < model.second.weight.abs().max() <= bound
    assert model.second.bias.abs().max() <= bound
    assert model.first.weight.shape == (64, 2, 3, 3, 3, 3)
    assert model.first.weight.abs().max() <= 1 / math.sqrt(2 * 81)
    small = policy(4, 64, head_std=0.01)
    assert small.head.weight.std().item() == pytest.approx(0.01, rel=0.2)
    assert not small.head.bias.any()
    bins, totes = depths((5, 5), (6, 6), batch=1)
    assert small(bins, totes).softmax(-1).max() < 1.5 / 3600
    with pytest.raises(ValueError, match="compute_dtype"):
        policy(compute_dtype="float16")


def test_critic_sees_what_clipping_hides_and_refuses_other_sizes():
    torch.manual_seed(0)
    critic = Conv4dCritic((5, 5, 1), (6, 6, 5), filters=4, hidden=16)
    bins, totes = depths((5, 5), (6, 6))
    totes[:, 0, 0] = 10.0
    values = critic(bins, totes)
    assert values.shape == (3, 1)
    assert not torch.allclose(critic(bins, totes + 20), values)
    values.sum().backward()
    assert all(p.grad is not None for p in critic.parameters())
    with pytest.raises(ValueError, match="tote"):
        critic(bins, depths((5, 5), (7, 6))[1])


@pytest.mark.parametrize("rotations", [1, 3, 4])
@pytest.mark.parametrize("empty_row", [False, True])
def test_masked_policy_computes_only_what_it_needs_and_the_same(rotations, empty_row):
    """With a mask, pick cells that allow nothing are left out: values and gradients stay as with all of them."""
    rules = Rules(bin_size=(4, 5, 1), tote_size=(5, 6, 3), rotations=rotations)
    torch.manual_seed(0)
    policy = FlatPolicy(rules, True, filters=6, head_std=0.3)
    bins, totes = torch.randint(0, 2, (7, 4, 5)).float(), torch.randint(0, 4, (7, 5, 6)).float()
    mask = torch.rand(7, rules.num_actions) < 0.01
    if empty_row:
        mask[3] = False
    weights = torch.rand(7, rules.num_actions)

    def gradients(logits):
        policy.zero_grad()
        (torch.where(mask, logits, 0.0) * weights).sum().backward()
        return [parameter.grad.clone() for parameter in policy.parameters()]

    logits = policy(bins, totes, mask)
    whole = policy(bins, totes)
    assert torch.allclose(logits[mask], whole[mask], atol=1e-5) and (logits[~mask] == MASKED).all()
    for ours, expected in zip(gradients(policy(bins, totes, mask)), gradients(policy(bins, totes)), strict=True):
        assert torch.allclose(ours, expected, atol=1e-4)


def test_typical_is_fcn4d_and_one_fully_connected_layer():
    rules = Rules(bin_size=(3, 3, 1), tote_size=(4, 4, 2))
    policy = typical(rules, mask_infeasible=False, filters=8)
    maps = torch.randint(0, 2, (5, 3, 3)).float(), torch.randint(0, 3, (5, 4, 4)).float()
    before = policy.network(*maps)
    wanted = before @ policy.join.weight.T + policy.join.bias
    torch.testing.assert_close(policy(*maps), wanted)


def test_a_typical_network_that_memory_does_not_hold(monkeypatch):
    def refuse(*_):
        raise RuntimeError("can't allocate memory")

    monkeypatch.setattr(torch.nn, "Linear", refuse)
    with pytest.raises(ValueError, match=r"90,000\^2 weights, 32.4 GB.* smaller env.tote_size"):
        typical(Rules(tote_size=(30, 30, 5)), mask_infeasible=False, filters=8)
