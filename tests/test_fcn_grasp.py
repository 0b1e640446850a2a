"""The network of ``fcn_grasp`` and its critic, against plain convolutions and by hand."""

import itertools

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import PickPlaceEnv
from pickplace.policies.actors import MASKED, as_collection_policy, fcn_grasp
from pickplace.policies.networks.critics import PooledCritic
from pickplace.policies.networks.footprint_fcn import FootprintFcn, matrix_dtype
from pickplace.task.geometry import Rules
from pickplace.task.items import Kinds


def random_state(generator, batch, bin_size, tote_size):
    """Depth maps with one box in each bin."""
    bins = torch.zeros(batch, *bin_size)
    for one in bins:
        x, y = (int(torch.randint(0, side, (), generator=generator)) for side in bin_size)
        one[x : x + 2, y : y + 1 + x % 3] = float(torch.randint(1, 5, (), generator=generator))
    return bins, torch.randint(-2, 8, (batch, *tote_size), generator=generator).float()


def by_hand(network, bin_depth, tote_depth, parity, x, y):
    """The network's scores of one footprint of one problem, read cell by cell off the depth maps."""
    side, reach = network.receptive_field, network.reach
    filled = bin_depth.nonzero()
    w, d = (filled.amax(0) - filled.amin(0) + 1).tolist()
    h = int(bin_depth.max())
    wide, long = tote_depth.shape

    def depth(i, j):
        """At (i, j) along the item's own axes from the footprint's corner; None outside the tote."""
        cell = (x + j, y + i) if parity else (x + i, y + j)
        return int(tote_depth[cell]) if 0 <= cell[0] < wide and 0 <= cell[1] < long else None

    first = [side // 2 - (size - 1) // 2 for size in (w, d)]
    below = [depth(i, j) for i in range(w) for j in range(d)]
    assert None not in below
    rest = min(below)
    ones = []  # in which plane each cell is
    for i in range(-first[0], side - first[0]):
        for j in range(-first[1], side - first[1]):
            here = depth(i, j)
            if here is None:
                ones.append(None)
            elif 0 <= i < w and 0 <= j < d:
                ones.append(2 * reach + 1 + min(here - rest, reach))
            else:
                above = (rest - h) - here  # how far the cell is above the item's top
                ones.append(max(-reach, min(above, reach)) + reach)
    shift = max(int(tote_depth.max()) - network.tote_clip, 0)
    clipped = network.tote_clip - (rest - shift)
    ones += [min(size, network.item_range) - 1 for size in (w, d, h)]
    ones += [max(0, min(v, most - 1)) for v, most in ((rest - h + 1, network.rooms), (clipped, network.depth_range))]
    weight, out = network.patch.weight.unflatten(1, (-1, network.planes)), network.patch.bias
    for position, plane in enumerate(ones):
        if plane is not None:
            out = out + weight[:, position, plane]
    return network.head(F.relu(network.hidden(F.relu(out))))


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    field=st.sampled_from([3, 5, 7]),
    tote=st.tuples(st.integers(3, 7), st.integers(3, 7)),
    sizes=st.tuples(st.integers(1, 4), st.integers(1, 6), st.integers(1, 3), st.integers(1, 4)),
    rooms=st.sampled_from([None, 1, 3, 12]),
)
def test_it_sees_what_a_person_would_read_off_the_maps(seed, field, tote, sizes, rooms):
    generator = torch.Generator().manual_seed(seed)
    clip, levels, reach, items = sizes
    options = {"head_std": 1.0, "compute_dtype": "float32", "rooms": rooms}
    network = FootprintFcn(3, 8, field, 6, clip, levels, reach, items, **options)
    bins, totes = random_state(generator, 2, (4, 6), tote)
    totes = totes.clamp(min=0)
    scores = network(bins, totes, 2)
    assert scores.shape == (2, 2, *tote, 3)
    for n in range(2):
        item = Rules.read_item(bins[n : n + 1])
        for parity, (w, d) in enumerate([(int(item.w), int(item.d)), (int(item.d), int(item.w))]):
            for x in range(tote[0] - w + 1):
                for y in range(tote[1] - d + 1):
                    expected = by_hand(network, bins[n], totes[n], parity, x, y)
                    torch.testing.assert_close(scores[n, parity, x, y], expected, rtol=1e-4, atol=1e-4)


def test_turning_the_whole_problem_turns_the_scores():
    """What is seen does not depend on which way the tote is laid: a transposed problem has transposed scores."""
    generator = torch.Generator().manual_seed(0)
    network = FootprintFcn(2, 8, 5, head_std=1.0, compute_dtype="float32")
    bins, totes = random_state(generator, 8, (5, 5), (6, 4))
    item = Rules.read_item(bins)
    scores = network(bins, totes, 2)
    across = network(bins, totes.transpose(1, 2).contiguous(), 2)
    for n in range(8):
        w, d = int(item.w[n]), int(item.d[n])
        ours, theirs = scores[n, 0, : 7 - w, : 5 - d], across[n, 1, : 5 - d, : 7 - w]
        torch.testing.assert_close(ours, theirs.transpose(0, 1))


def test_only_differences_count_far_from_the_rim():
    """Two cells more below everything change nothing but the room above, which ends to be told apart."""
    generator = torch.Generator().manual_seed(1)
    network = FootprintFcn(1, 8, 5, tote_clip=2, depth_range=4, head_std=1.0, compute_dtype="float32")
    bins, totes = random_state(generator, 8, (5, 5), (6, 6))
    totes = totes.clamp(min=0) + 8
    inside = (slice(None), slice(None), slice(0, 4), slice(0, 4))
    torch.testing.assert_close(network(bins, totes, 2)[inside], network(bins, totes + 2, 2)[inside])


def test_very_deep_totes():
    """Depths are kept in 16 bits, whatever the tote."""
    generator = torch.Generator().manual_seed(2)
    network = FootprintFcn(1, 8, 5, head_std=1.0, compute_dtype="float32")
    bins, totes = random_state(generator, 4, (5, 5), (6, 6))
    totes = totes.clamp(min=0) + 100
    inside = (slice(None), slice(None), slice(0, 4), slice(0, 4))
    torch.testing.assert_close(network(bins, totes, 2)[inside], network(bins, totes + 900_000, 2)[inside])


@pytest.mark.parametrize("rotations", [1, 2, 4])
def test_only_what_the_mask_allows_is_computed_and_it_is_the_same(rotations, monkeypatch):
    env = PickPlaceEnv(tote_size=(7, 5, 3), rotations=rotations, num_envs=12, masks=("action", "outcome"))
    state = env.rollout(6, break_when_any_done=False)[:, -1]["next"]
    policy = fcn_grasp(env.rules, True, head_std=1.0, compute_dtype="float32")
    bins, totes, mask = (state[key] for key in ("bin_depth", "tote_depth", "outcome_mask"))
    asked = []
    at = policy.network.at
    monkeypatch.setattr(policy.network, "at", lambda *args: asked.append(len(args[2])) or at(*args))
    logits = policy(bins, totes, mask)
    assert asked == [int(mask.sum())] and asked[0] < mask.numel()
    everywhere = policy.network(bins, totes, env.rules.parities).flatten(1)
    torch.testing.assert_close(logits, torch.where(mask, everywhere, MASKED))
    logits.logsumexp(1).sum().backward()
    assert all(parameter.grad is not None for parameter in policy.parameters())


@pytest.mark.parametrize("bias", [-1e30, -1e12, 1e30])
def test_no_score_is_so_bad_that_what_the_mask_forbids_is_chosen(bias):
    env = PickPlaceEnv(tote_size=(4, 4, 3), num_envs=64, masks=("action", "outcome"))
    state = env.reset()
    policy = fcn_grasp(env.rules, True, head_std=1.0, compute_dtype="float32")
    policy.network.head.bias.data.fill_(bias)
    chosen = as_collection_policy(policy)(state)
    assert state["action_mask"].gather(1, chosen["action"][:, None]).all()
    assert chosen["log_prob"].isfinite().all()


@pytest.mark.parametrize("effector", [(3, 3), (2, 3), (3, 1)])
@pytest.mark.parametrize("rotations", [1, 4])
def test_without_a_mask_every_grasp_has_the_score_of_its_footprint(rotations, effector):
    """Choices of the unmasked policy against the network's scores, footprint by footprint and offset by offset."""
    items = Kinds([[1, 1, 1]]) if effector == (3, 1) else None
    env = PickPlaceEnv(tote_size=(4, 5, 2), rotations=rotations, effector_size=effector, num_envs=3, items=items)
    rules, state = env.rules, env.reset()
    policy = fcn_grasp(rules, False, filters=8, head_std=1.0, compute_dtype="float32")
    policy.outside.data.fill_(7.0)
    logits, _, _ = policy._choices(state["bin_depth"], state["tote_depth"])
    scores = policy.network(state["bin_depth"], state["tote_depth"], rules.parities)
    count = rules.num_offsets
    for parity, (_, _, ref_x, ref_y) in enumerate(rules.effectors):
        for ox, oy, x, y in itertools.product(range(count), range(count), range(4), range(5)):
            fx, fy = x - ref_x + ox, y - ref_y + oy
            got = logits[:, ((parity * count + ox) * count + oy) * 20 + x * 5 + y]
            if 0 <= fx < 4 and 0 <= fy < 5:
                along, across = (oy, ox) if parity else (ox, oy)
                torch.testing.assert_close(got, scores[:, parity, fx, fy, along * count + across])
            else:
                assert (got == 7.0).all()


@pytest.mark.parametrize(("num_envs", "least", "most"), [(1, 1, 64), (40, 65, 4096), (300, 4097, 10**6)])
def test_bfloat16_is_close_and_any_number_of_rows_will_do(num_envs, least, most, monkeypatch):
    torch.manual_seed(1)
    env = PickPlaceEnv(num_envs=num_envs, masks=("outcome",))
    state = env.rollout(4, break_when_any_done=False)[:, -1]
    exact = fcn_grasp(env.rules, True, head_std=1.0, compute_dtype="float32")
    rough = fcn_grasp(env.rules, True, head_std=1.0, compute_dtype="bfloat16")
    rough.load_state_dict(exact.state_dict())
    wanted, got = (policy(*(state[key] for key in policy.in_keys)) for policy in (exact, rough))
    count = int(state["outcome_mask"].sum())
    assert least <= count <= most and count % 64 and got.dtype == torch.float32
    assert (wanted - got).abs().max() < 0.05 * wanted[wanted > MASKED].std() + 0.05
    for able, expected in (({"amx_bf16": True}, torch.bfloat16), ({}, torch.float32)):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda able=able: able, raising=False)
        monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda able=able: not able)
        assert matrix_dtype("auto", "cpu") == expected  # whatever a GPU beside it can do
        assert matrix_dtype("auto", "cuda") != expected
        assert matrix_dtype("float32", "cpu") == torch.float32


def test_nothing_allowed_anywhere_gives_no_logit():
    rules = Rules()
    nothing = torch.zeros(2, rules.num_outcomes, dtype=torch.bool)
    logits = fcn_grasp(rules, True)(torch.zeros(2, 5, 5), torch.ones(2, 6, 6), nothing)
    assert (logits == MASKED).all()


@settings(max_examples=15)
@given(
    seed=st.integers(0, 10**6), field=st.sampled_from([1, 3, 5]), tote=st.tuples(st.integers(1, 6), st.integers(1, 6))
)
def test_the_critic_adds_up_what_each_column_will_hold(seed, field, tote):
    generator = torch.Generator().manual_seed(seed)
    critic = PooledCritic(4, field, 6, tote_clip=2, depth_range=4, item_range=3, compute_dtype="float32")
    for parameter in critic.parameters():
        parameter.data.normal_(generator=generator)
    bins, totes = random_state(generator, 2, (4, 6), tote)
    item, half = Rules.read_item(bins), field // 2
    for n in range(2):
        shift, total = max(int(totes[n].max()) - 2, 0), 0.0
        code = torch.zeros(9)
        for part, size in enumerate((item.w[n], item.d[n], item.h[n])):
            code[part * 3 + min(int(size), 3) - 1] = 1
        for x, y in itertools.product(range(tote[0]), range(tote[1])):
            room = float(totes[n, x, y]) / 5
            out = critic.around.bias + critic.item(code) + room * critic.room
            for i, j in itertools.product(range(-half, half + 1), repeat=2):
                if 0 <= x + i < tote[0] and 0 <= y + j < tote[1]:
                    level = max(0, min(2 - (int(totes[n, x + i, y + j]) - shift), 3))
                    out = out + critic.around.weight[:, level, i + half, j + half]
            share, more = critic.head(F.relu(critic.hidden(F.relu(out))))
            total += (share * room + more / 5).item()
        assert float(critic(bins, totes)[n]) == pytest.approx(total, rel=1e-4, abs=1e-4)


def test_the_critic_takes_any_leading_dimensions():
    generator = torch.Generator().manual_seed(0)
    bins, totes = random_state(generator, 6, (5, 5), (4, 3))
    critic = PooledCritic()
    values = critic(bins, totes)
    assert values.shape == (6, 1)
    torch.testing.assert_close(critic(bins.view(2, 3, 5, 5), totes.view(2, 3, 4, 3)), values.view(2, 3, 1))


@pytest.mark.parametrize("key", ["filters", "hidden", "tote_clip", "depth_range", "item_range"])
def test_bad_widths_are_refused(key):
    for make in (FootprintFcn, PooledCritic):
        for value in (0, -1, 2.5, True, "4"):
            with pytest.raises(ValueError, match=rf"{key}={value!r}: expected a whole number >= 1"):
                make(**{key: value})


@pytest.mark.parametrize("make", [FootprintFcn, PooledCritic])
def test_bad_fields_and_types_are_refused(make):
    with pytest.raises(ValueError, match=r"receptive_field=4: expected an odd number"):
        make(receptive_field=4)
    with pytest.raises(ValueError, match=r"compute_dtype='half': expected 'auto', 'float32' or 'bfloat16'"):
        make(compute_dtype="half")
