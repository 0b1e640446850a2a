"""The 4D convolutional policy against a naive 4D convolution, and the promises of its docstrings."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import CellSpec
from pickplace.policies.base import MASKED
from pickplace.policies.critics import Conv4d
from pickplace.policies.depth import clip_depth
from pickplace.policies.fcn4d import network as conv4d
from pickplace.policies.fcn4d import policy as fcn4d
from pickplace.policies.fcn4d.network import Conv4dNet, clip_and_pad
from pickplace.policies.fcn4d.policy import Fcn4d, Typical

SIZES = [  # bin, tote, R, clips, floor
    ((5, 5), (6, 6), 4, (1.0, 5.0), None),
    ((3, 4), (5, 2), 1, (1.0, 3.0), -1.0),
    ((2, 5), (3, 7), 3, (None, None), None),
    ((1, 1), (4, 6), 2, (0.5, 2.5), -0.5),
    ((6, 2), (1, 5), 2, (2.0, None), 0.0),
]


def assert_close(ours, expected, tolerance=1e-5):
    torch.testing.assert_close(ours, expected, rtol=tolerance, atol=tolerance)


def depths(bin_size, tote_size, batch=3, dtype=torch.float32):
    """Return bin and tote maps with values on both sides of the clips."""
    generator = torch.Generator().manual_seed(0)
    bins = torch.randint(0, 4, (batch, *bin_size), generator=generator)
    totes = torch.randint(0, 11, (batch, *tote_size), generator=generator)
    return bins.to(dtype), totes.to(dtype)


def network(rotations=2, filters=5, **options):
    torch.manual_seed(0)
    return Conv4dNet(rotations, filters, **{"head_std": None, **options})


def convolve4d(x, weight, bias):
    """Return a valid 4D convolution, a sum over the kernel's taps: ``[N, C, a, b, c, d]`` to ``[N, O, ...]``."""
    sides = [n - k + 1 for n, k in zip(x.shape[2:], weight.shape[2:], strict=True)]
    out = bias.view(1, -1, 1, 1, 1, 1)
    for tap in itertools.product(*map(range, weight.shape[2:])):
        window = x[(..., *(slice(t, t + side) for t, side in zip(tap, sides, strict=True)))]
        out = out + torch.einsum("nc...,oc->no...", window, weight[(..., *tap)])
    return out


def naive_map(depth, limit, floor, padding):
    """Return maps clipped by eq. 4, then floored, then padded by two cells."""
    most = depth.amax((1, 2), keepdim=True)
    if limit is not None:
        depth = torch.where(most > limit, depth - (most - limit), depth)
    depth = depth if floor is None else depth.clamp(min=floor)
    padded = torch.full([len(depth), *(side + 4 for side in depth.shape[1:])], padding, dtype=depth.dtype)
    padded[:, 2:-2, 2:-2] = depth
    return padded


def naive(model, bins, totes):
    """Return logits by the paper's description, on an explicit two-channel 4D tensor."""
    bins = naive_map(bins, model.bin_clip, model.floor, -1.0)[:, :, :, None, None]
    totes = naive_map(totes, model.tote_clip, model.floor, 0.0)[:, None, None]
    x = torch.stack(torch.broadcast_tensors(bins, totes), dim=1)
    x = convolve4d(x, model.first.weight, model.first.bias).relu()
    x = convolve4d(x, model.second.weight, model.second.bias).relu()
    logits = convolve4d(x, model.head.weight, model.head.bias).movedim(1, -1)
    return logits.flatten(1)


@pytest.mark.parametrize(("bin_size", "tote_size", "rotations", "clips", "floor"), SIZES)
def test_equals_the_naive_4d_convolution(bin_size, tote_size, rotations, clips, floor):
    """And the same weights serve other sizes."""
    model = network(rotations, bin_clip=clips[0], tote_clip=clips[1], floor=floor)
    for maps in (depths(bin_size, tote_size), depths((4, 7), (3, 8), batch=1)):
        logits = naive(model, *maps)
        assert logits.shape[1] == maps[0][0].numel() * maps[1][0].numel() * rotations
        assert_close(model(*maps), logits)


def test_gradients_equal_the_naive_ones():
    model = network(3).double()
    maps = [m.requires_grad_() for m in depths((3, 4), (5, 3), dtype=torch.float64)]
    inputs, output = [*maps, *model.parameters()], model(*maps)
    direction = torch.randn(output.shape, generator=torch.Generator().manual_seed(1), dtype=output.dtype)
    expected = torch.autograd.grad(naive(model, *maps), inputs, direction)
    for ours, wanted in zip(torch.autograd.grad(output, inputs, direction), expected, strict=True):
        assert_close(ours, wanted, 1e-9)


def test_bfloat16_is_close_and_keeps_float32_outside():
    exact, rough = network(4, 16), network(4, 16, compute_dtype="bfloat16")
    maps = depths((5, 5), (6, 6))
    want, got = exact(*maps), rough(*maps)
    assert got.dtype == torch.float32
    assert (got - want).abs().max() < 0.02 * want.abs().max()
    for output in (want, got):
        output.square().sum().backward()
    for a, b in zip(rough.parameters(), exact.parameters(), strict=True):
        assert a.grad.dtype == torch.float32 and (a.grad - b.grad).norm() < 0.05 * b.grad.norm()


@pytest.mark.parametrize("chunk_bytes", [1, 60_000, 300_000])
def test_chunks_change_nothing(chunk_bytes):
    whole, pieces = network(), network(chunk_bytes=chunk_bytes)
    maps = depths((4, 3), (5, 6), batch=7)
    with torch.no_grad():
        assert_close(pieces._logits_by_chunks(*pieces._prepare(*maps)).flatten(1), whole(*maps))


sides = st.integers(1, 14)


@settings(max_examples=40, deadline=None)
@given(bin_size=st.tuples(sides, sides), tote_size=st.tuples(sides, sides), batch=st.integers(1, 5), data=st.data())
def test_tiles_equal_the_naive_4d_convolution(bin_size, tote_size, batch, data):
    """By minimal filtering, which acts on a CPU; in float64, so that an error is no rounding."""
    model = network(2, 3).double()
    maps = depths(bin_size, tote_size, batch, torch.float64)
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(conv4d, "FEW_TILES", 1)
        patch.setattr(conv4d, "TILE_BYTES", data.draw(st.sampled_from((1, 2**15, 2**23))))
        assert model._uses_tiles(*model._prepare(*maps))
        assert_close(model(*maps), naive(model, *maps), 1e-10)


def test_no_tiles_in_low_precision():
    maps = depths((5, 5), (6, 6), batch=8)
    with torch.no_grad():
        for dtype in (torch.bfloat16, torch.float16):
            assert not (model := network().to(dtype))._uses_tiles(*model._prepare(*maps))
        model = network()
        assert model._uses_tiles(*model._prepare(*maps))
        with torch.autocast("cpu", torch.bfloat16):
            assert not model._uses_tiles(*model._prepare(*maps))


@pytest.mark.parametrize(("unit", "by_tiles"), [("avx512_bf16", True), ("amx_bf16", False), ("bf16", False)])
def test_tiles_in_float32_beat_vectors_of_bfloat16(monkeypatch, unit, by_tiles):
    """With ``auto`` only. Alone and in a batch, a state has the same logits."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {unit: True}, raising=False)
    maps, model, low = depths((5, 5), (6, 6), batch=8), network(compute_dtype="auto"), network(compute_dtype="bfloat16")
    with torch.no_grad():
        assert model._uses_tiles(*model._prepare(*maps)) is by_tiles
        assert not low._uses_tiles(*low._prepare(*maps))
        if by_tiles:
            assert_close(model(*maps), network()(*maps))
            assert_close(torch.cat([model(*(each[row : row + 1] for each in maps)) for row in range(8)]), model(*maps))


def test_rounding_of_tiles_is_small():
    model, maps = network(4, 64), depths((5, 5), (6, 6), batch=8)
    with torch.no_grad():
        got, want = model(*maps), naive(model.double(), *(m.double() for m in maps))
    assert (got - want).abs().max() < 2e-5 * want.abs().max()


def test_given_pick_cells_select_their_part():
    model, maps = network(3), depths((4, 5), (3, 6), batch=4)
    pick, each = torch.tensor([0, 7, 19, 11]), torch.arange(4)
    assert_close(model(*maps, pick), model(*maps).unflatten(1, (20, -1))[each, pick])


def test_any_leading_dimensions_and_integer_depths():
    model, critic = network(), Conv4d(CellSpec(bin_size=(4, 3, 1), tote_size=(5, 6, 5)), filters=4, hidden=8)
    bins, totes = depths((4, 3), (5, 6), batch=6, dtype=torch.int64)
    flat, values = model(bins, totes), critic(bins, totes)
    two = [m.unflatten(0, (2, 3)) for m in (bins, totes)]
    assert_close(model(*two), flat.unflatten(0, (2, 3)))
    assert_close(critic(*two), values.unflatten(0, (2, 3)))
    assert_close(model(bins[0], totes[0]), flat[0])
    assert_close(model(*two, torch.zeros(2, 3, dtype=torch.int64)).flatten(0, 1), flat[:, :60])
    assert_close(model(bins[0], totes[0], torch.tensor(0)), flat[0, :60])
    assert_close(critic(bins[0], totes[0]), values[0])


def test_critic_equals_its_layers_one_after_the_other():
    """It takes each different bin once. Values and gradients are those of all bins."""
    torch.manual_seed(0)
    critic, every = Conv4d(CellSpec(), filters=4, hidden=8).double(), torch.randint(0, 3, (40, 5, 5)).double()
    bins, totes = every[torch.randint(0, 3, (40,))], torch.randint(0, 6, (40, 6, 6)).double()

    def plain() -> torch.Tensor:
        left = torch.stack((totes.mean((1, 2)), totes.amax((1, 2))), dim=1) / 5
        bin_maps, tote_maps = clip_and_pad(bins, 1, None, -1.0)[:, None], clip_and_pad(totes, 5, None, 0.0)[:, None]
        return critic.value(torch.cat((critic.bin_layers(bin_maps), critic.tote_layers(tote_maps), left), dim=1))

    results = []
    for values in (critic(bins, totes), plain()):
        weighted = (values[:, 0] * torch.arange(40)).sum()
        results.append([values.detach(), *torch.autograd.grad(weighted, list(critic.parameters()))])
    for got, want in zip(*results, strict=True):
        assert_close(got, want)


def test_depth_clipping():
    """It makes the tote's height irrelevant to the policy, but not to the critic."""
    bins, totes = depths((5, 5), (6, 6))
    totes[:, 0, 0] = 10.0  # an empty column
    clipped, raw, critic = network(), network(tote_clip=None), Conv4d(CellSpec(), filters=4, hidden=16)
    assert_close(clipped(bins, totes + 20), clipped(bins, totes))
    for sees in (raw, critic):
        assert not torch.allclose(sees(bins, totes + 20), sees(bins, totes))
    depth = torch.tensor([[[7.0, 3.0], [0.0, 6.5]], [[2.0, 1.0], [0.0, 5.0]]])
    assert_close(clip_depth(depth, 5.0), torch.tensor([[[5.0, 1.0], [-2.0, 4.5]], [[2.0, 1.0], [0.0, 5.0]]]))
    assert clip_depth(depth, 5.0, floor=-1.0).min() == -1
    assert_close(clip_depth(depth, None), depth)
    assert clip_depth(depth, None, floor=2.0).min() == 2
    assert clip_and_pad(depth, None, None, -1.0).shape == (2, 6, 6)


def test_initialisation():
    model, small = network(4, 64), network(4, 64, head_std=0.01)
    bound = 1 / math.sqrt(64 * 81)
    assert 0.99 * bound < model.second.weight.abs().max() <= bound and model.second.bias.abs().max() <= bound
    assert model.first.weight.shape == (64, 2, 3, 3, 3, 3) and model.first.weight.abs().max() <= 1 / math.sqrt(2 * 81)
    assert small.head.weight.std().item() == pytest.approx(0.01, rel=0.2) and not small.head.bias.any()
    assert small(*depths((5, 5), (6, 6), batch=1)).softmax(-1).max() < 1.5 / 3600


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: network(compute_dtype="float16"), "model.actor.compute_dtype='float16': expected 'auto' or"),
        (lambda: network(filters=0), "model.actor.filters=0"),
        (lambda: Conv4d(CellSpec(), filters=0), "model.critic.filters=0"),
        (lambda: Conv4d(CellSpec(), hidden=1.5), "model.critic.hidden=1.5"),
        (lambda: Conv4d(CellSpec())(*depths((5, 5), (7, 6))), r"tote_depth: got \[7, 6\], expected \[6, 6\]"),
    ],
)
def test_bad_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("rotations", [1, 3, 4])
@pytest.mark.parametrize("empty_row", [False, True])
@pytest.mark.parametrize("few_places", [0, 64])
def test_a_masked_policy_computes_only_what_it_needs_and_the_same(rotations, empty_row, few_places, monkeypatch):
    """With a mask, picks or pairs that allow nothing are left out: values and gradients stay as with all of them."""
    monkeypatch.setattr(fcn4d, "FEW_PLACES", few_places)
    cell = CellSpec(bin_size=(4, 5, 1), tote_size=(5, 6, 3), rotations=rotations)
    torch.manual_seed(0)
    policy = Fcn4d(cell, True, filters=6, head_std=0.3)
    maps = {"bin_depth": torch.randint(0, 2, (7, 4, 5)).float(), "tote_depth": torch.randint(0, 4, (7, 5, 6)).float()}
    mask, weights = torch.rand(7, cell.num_actions) < 0.01, torch.rand(7, cell.num_actions)
    if empty_row:
        mask[3] = False
    logits, whole = policy.logits({**maps, "action_mask": mask}), policy.action_scores(maps)
    assert_close(logits[mask], whole[mask])
    assert (logits[~mask] == MASKED).all()
    gradients = [
        torch.autograd.grad((torch.where(mask, values, 0.0) * weights).sum(), list(policy.parameters()))
        for values in (logits, whole)
    ]
    for ours, expected in zip(*gradients, strict=True):
        assert_close(ours, expected, 1e-4)


def test_typical_is_fcn4d_and_one_fully_connected_layer(monkeypatch):
    policy = Typical(CellSpec(bin_size=(3, 3, 1), tote_size=(4, 4, 2)), filters=8)
    maps = torch.randint(0, 2, (5, 3, 3)).float(), torch.randint(0, 3, (5, 4, 4)).float()
    wanted = policy.network(*maps) @ policy.join.weight.T + policy.join.bias
    assert_close(policy.logits({"bin_depth": maps[0], "tote_depth": maps[1]}), wanted)

    def refuse(*_):
        raise RuntimeError("can't allocate memory")

    monkeypatch.setattr(torch.nn, "Linear", refuse)
    with pytest.raises(ValueError, match=r"90,000\^2 weights, 32.4 GB.* smaller env.tote_size"):
        Typical(CellSpec(tote_size=(30, 30, 5)), filters=8)
