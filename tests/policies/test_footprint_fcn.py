"""The network of ``fcn_grasp`` and its critic, against plain convolutions and by hand."""

import itertools
from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import late_state

from pickplace import CellSpec, Item
from pickplace.items.distributions import Kinds, Uniform
from pickplace.policies.base import MAP_KEYS, MASKED, as_collection_policy
from pickplace.policies.critics import Pooled
from pickplace.policies.depth import ScoredItems
from pickplace.policies.dtypes import matrix_dtype
from pickplace.policies.fcn_grasp.network import FootprintFcn
from pickplace.policies.fcn_grasp.policy import FcnGrasp, UnmaskedFcnGrasp
from pickplace.policies.footprints import every_footprint
from pickplace.rules.item import item_from_depth, read_items
from pickplace.runs import checkpoint

FLOAT = {"head_std": 1.0, "compute_dtype": "float32"}


def random_maps(seed, batch, bin_size, tote_size):
    """Return depth maps with one box in each bin."""
    generator = torch.Generator().manual_seed(seed)
    bins = torch.zeros(batch, *bin_size)
    for one in bins:
        x, y = (int(torch.randint(0, side, (), generator=generator)) for side in bin_size)
        one[x : x + 2, y : y + 1 + x % 3] = float(torch.randint(1, 5, (), generator=generator))
    totes = torch.randint(0, 8, (batch, *tote_size), generator=generator).float()
    return bins, totes, torch.randint(0, 2, totes.shape, generator=generator).float()


def every_score(network, bins, totes, bearing, footprint_turns):
    """Return the network's scores of all footprints, ``[N, footprint_turns, W_T, D_T, out_channels]``."""
    row, footprint = every_footprint(totes, footprint_turns)
    contents = ScoredItems(read_items(bins), torch.zeros_like(row))
    scores = network.footprint_scores(bins, totes, bearing, row, footprint, contents)
    return scores.view(len(totes), footprint_turns, *totes.shape[1:], -1)


def by_hand(network, item, tote_depth, bearing, quarter_turned, x, y):
    """Return the network's scores of one footprint of one problem, read cell by cell off the maps."""
    side, reach, (w, d, h) = network.receptive_field, network.reach, item
    wide, long = tote_depth.shape

    def at(i, j):
        """Return the cell at (i, j) along the item's own axes from the footprint's corner; None outside the tote."""
        cell = (x + j, y + i) if quarter_turned else (x + i, y + j)
        return cell if 0 <= cell[0] < wide and 0 <= cell[1] < long else None

    def depth(i, j):
        return None if at(i, j) is None else int(tote_depth[at(i, j)])

    first = [side // 2 - (size - 1) // 2 for size in (w, d)]
    rest = min(depth(i, j) for i in range(w) for j in range(d))
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
    counts = ((rest - h + 1, network.headroom_bins), (clipped, network.depth_range))
    ones += [max(0, min(value, most - 1)) for value, most in counts]
    weight, out = network.patch.weight.unflatten(1, (-1, network.planes)), network.patch.bias
    patch = itertools.product(*(range(-begin, side - begin) for begin in first))
    for position, cell in enumerate(at(*corner) for corner in patch):
        if cell is not None and not bearing[cell]:
            out = out + network.weak[:, position]
    for position, plane in enumerate(ones):
        if plane is not None:
            out = out + weight[:, position, plane]
    return network.head(F.relu(network.hidden(F.relu(out))))


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    field=st.sampled_from([3, 5, 7]),
    tote=st.tuples(st.integers(3, 7), st.integers(3, 6)),
    sizes=st.tuples(st.integers(1, 4), st.integers(1, 6), st.integers(1, 3), st.integers(1, 4)),
    headroom_bins=st.sampled_from([None, 1, 3, 12]),
    deeper=st.sampled_from([0, 0, 100, 900_000]),
)
def test_it_sees_what_a_person_would_read_off_the_maps(seed, field, tote, sizes, headroom_bins, deeper):
    clip, levels, reach, items = sizes
    torch.manual_seed(seed)
    network = FootprintFcn(3, 8, field, 6, clip, levels, reach, items, headroom_bins=headroom_bins, **FLOAT)
    network.weak.data.normal_()
    bins, totes, bearing = random_maps(seed, 2, (4, 6), tote)
    totes += deeper  # depths are kept in 16 bits
    scores = every_score(network, bins, totes, bearing, 2)
    assert scores.shape == (2, 2, *tote, 3)
    item, found, expected = item_from_depth(bins), [], []
    for n, quarter_turned in itertools.product(range(2), range(2)):
        w, d, h = (int(part[n]) for part in item[2:5])
        wide, deep = (d, w) if quarter_turned else (w, d)
        for x, y in itertools.product(range(tote[0] - wide + 1), range(tote[1] - deep + 1)):
            expected.append(by_hand(network, (w, d, h), totes[n], bearing[n], quarter_turned, x, y))
            found.append(scores[n, quarter_turned, x, y])
    torch.testing.assert_close(torch.stack(found), torch.stack(expected), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rotations", [1, 2, 4])
def test_only_what_the_mask_allows_is_computed_and_it_is_the_same(rotations, monkeypatch):
    env, state = late_state(tote_size=(7, 5, 3), rotations=rotations, masks=("action", "footprint"))
    policy, mask = FcnGrasp(env.cell, **FLOAT), state["footprint_mask"]
    asked, at = [], policy.network.footprint_scores
    monkeypatch.setattr(policy.network, "footprint_scores", lambda *args: asked.append(len(args[3])) or at(*args))
    logits = policy.logits(state)
    assert asked == [int(mask.sum())] and asked[0] < mask.numel()
    everywhere = every_score(policy.network, *(state[key] for key in MAP_KEYS), env.cell.footprint_turns).flatten(1)
    torch.testing.assert_close(logits, torch.where(mask, everywhere, MASKED))
    logits.logsumexp(1).sum().backward()
    unused = [name for name, parameter in policy.named_parameters() if parameter.grad is None]
    assert unused == ["network.rest_of_bin"]  # an extra gradient of zeros would change the norm that clipping sees
    assert (policy.footprint_logits(state, torch.zeros_like(mask)) == MASKED).all()


@pytest.mark.parametrize("bias", [-1e30, -1e12, 1e30])
def test_no_score_is_so_bad_that_what_the_mask_forbids_is_chosen(bias):
    env, state = late_state(tote_size=(4, 4, 3), num_envs=64, masks=("action", "footprint"))
    policy = FcnGrasp(env.cell, **FLOAT)
    policy.network.head.bias.data.fill_(bias)
    chosen = as_collection_policy(policy)(state.clone())
    assert state["action_mask"].gather(1, chosen["action"][:, None]).all()
    assert chosen["log_prob"].isfinite().all()


@pytest.mark.parametrize("effector", [(3, 3), (2, 3), (3, 1)])
@pytest.mark.parametrize("rotations", [1, 4])
def test_without_a_mask_every_grasp_has_the_score_of_its_footprint(rotations, effector):
    """Choices of the unmasked policy against the network's scores, footprint by footprint and offset by offset."""
    items = Kinds([[1, 1, 1]]) if effector == (3, 1) else None
    sizes = {"tote_size": (4, 5, 2), "rotations": rotations, "effector_size": effector}
    env, state = late_state(1, num_envs=3, items=items, **sizes)
    policy, count = UnmaskedFcnGrasp(env.cell, filters=8, **FLOAT), env.cell.num_offsets
    policy.outside.data.fill_(7.0)
    logits = policy.class_scores(state).flatten(1)
    scores = every_score(policy.network, *(state[key] for key in MAP_KEYS), env.cell.footprint_turns)
    for quarter_turned in range(env.cell.footprint_turns):
        _, _, ref_x, ref_y, _ = env.cell.effector(quarter_turned)
        for ox, oy, x, y in itertools.product(range(count), range(count), range(4), range(5)):
            fx, fy = x - ref_x + ox, y - ref_y + oy
            got = logits[:, ((quarter_turned * count + ox) * count + oy) * 20 + x * 5 + y]
            if 0 <= fx < 4 and 0 <= fy < 5:
                along, across = (oy, ox) if quarter_turned else (ox, oy)
                torch.testing.assert_close(got, scores[:, quarter_turned, fx, fy, along * count + across])
            else:
                assert (got == 7.0).all()


@pytest.mark.parametrize(("num_envs", "least", "most"), [(1, 1, 64), (40, 65, 4096), (300, 4097, 10**6)])
def test_bfloat16_is_close_and_any_number_of_rows_will_do(num_envs, least, most):
    env, state = late_state(4, num_envs=num_envs, masks=("action", "footprint"), seed=0)
    torch.manual_seed(1)
    exact = FcnGrasp(env.cell, **FLOAT)
    rough = FcnGrasp(env.cell, **{**FLOAT, "compute_dtype": "bfloat16"})
    rough.load_state_dict(exact.state_dict())
    wanted, got = exact.logits(state), rough.logits(state)
    count = int(state["footprint_mask"].sum())
    assert least <= count <= most and count % 64 and got.dtype == torch.float32
    assert (wanted - got).abs().max() < 0.05 * wanted[wanted > MASKED].std() + 0.05


@pytest.mark.parametrize(("able", "expected"), [({"amx_bf16": True}, torch.bfloat16), ({}, torch.float32)])
def test_the_fastest_type_of_matrix_products(able, expected, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: able, raising=False)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: not able)
    assert matrix_dtype("auto", "cpu") == expected  # whatever a GPU beside it can do
    assert matrix_dtype("auto", "cuda") != expected
    assert matrix_dtype("float32", "cpu") == torch.float32


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    field=st.sampled_from([1, 3, 5]),
    tote=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    level=st.sampled_from([1, 1, 2]),
    stride=st.sampled_from([1, 1, 2, 3]),
)
def test_the_critic_adds_up_what_each_column_will_hold(seed, field, tote, level, stride):
    generator = torch.Generator().manual_seed(seed)
    coarse = {"level": level, "stride": stride, "compute_dtype": "float32"}
    critic = Pooled(CellSpec(), 4, field, 6, tote_clip=2, depth_range=4, item_range=3, **coarse)
    for parameter in critic.parameters():
        parameter.requires_grad_(False).normal_(generator=generator)
    bins, totes, bearing = random_maps(seed, 2, (4, 6), tote)
    item, half = item_from_depth(bins), field // 2
    for n in range(2):
        shift, total = max(float(totes[n].max()) / level - 2, 0), 0.0
        code = torch.zeros(9)
        for part, size in enumerate((item.w[n], item.d[n], max(item.h[n] // level, 1))):
            code[part * 3 + min(int(size), 3) - 1] = 1
        for x, y in itertools.product(range(0, tote[0], stride), range(0, tote[1], stride)):
            room = float(totes[n, x, y]) / level / 5
            out = critic.around.bias + critic.item(code) + room * critic.room
            for i, j in itertools.product(range(-half, half + 1), repeat=2):
                if 0 <= x + i < tote[0] and 0 <= y + j < tote[1]:
                    plane = int(max(0, min(2 - (float(totes[n, x + i, y + j]) / level - shift), 3)))
                    out = out + critic.around.weight[:, plane, i + half, j + half]
                    if not bearing[n, x + i, y + j]:
                        out = out + critic.weak[:, 0, i + half, j + half]
            share, more = critic.head(F.relu(critic.hidden(F.relu(out))))
            total += (share * room + more / 5).item()
        assert float(critic(bins, totes, bearing)[n]) == pytest.approx(total, rel=1e-4, abs=1e-4)
    several = critic(*(maps[:, None] for maps in (bins, totes, bearing)))  # any leading dimensions
    torch.testing.assert_close(several, critic(bins, totes, bearing).view(2, 1, 1), rtol=1e-4, atol=1e-4)


def test_the_critic_sees_the_mean_of_several_items():
    critic = Pooled(CellSpec(), 4, 3, 6, compute_dtype="float32").requires_grad_(False)
    for parameter in critic.parameters():
        parameter.normal_()
    bins, totes, bearing = random_maps(3, 2, (4, 6), (5, 5))
    one = item_from_depth(bins).cuboids[:, None]
    torch.testing.assert_close(critic(bins, totes, bearing, one), critic(bins, totes, bearing))
    both = torch.cat([one, one.flip(0), torch.zeros_like(one)], 1)  # of an empty place it sees nothing
    code = critic._item_code(Item.from_table(both))
    each = [critic._item_code(Item.from_table(part[:, None])) for part in both.unbind(1)[:2]]
    torch.testing.assert_close(code, (each[0] + each[1]) / 2)
    several = critic(bins, totes, bearing, both)
    assert not torch.allclose(several, critic(bins, totes, bearing))


def test_the_policy_sees_the_mean_of_the_other_items():
    """Its pairs are scored by item and footprint; what the others do is learned from zero, and needs several items."""
    sizes = {"items": Uniform(), "tote_size": (6, 6, 6), "bin_size": (7, 7, 1), "masks": ("footprint", "action")}
    env, state = late_state(bin_items=3, **sizes)
    alone = FcnGrasp(replace(env.cell, bin_items=1), **FLOAT)
    policy = checkpoint.restore(lambda: FcnGrasp(env.cell, **FLOAT), alone.state_dict(), "policy")
    places = env.cell.num_footprints
    for number in range(3):  # as if each item lay alone
        one = state.exclude("items", "bin_labels")
        one["bin_depth"] = torch.where(state["bin_labels"] == number + 1, state["bin_depth"], 0.0)
        one["footprint_mask"] = state["footprint_mask"].unflatten(1, (3, -1))[:, number]
        expected = policy.logits(state)[:, number * places : (number + 1) * places]
        torch.testing.assert_close(alone.logits(one), expected)
    policy.network.rest_of_bin.data.normal_()
    changed = policy.logits(state)
    swapped = state.clone().set("items", state["items"][:, [0, 2, 1]])  # the order of the others is nothing to it
    swapped["footprint_mask"] = state["footprint_mask"].unflatten(1, (3, -1))[:, [0, 2, 1]].flatten(1)
    torch.testing.assert_close(policy.logits(swapped)[:, :places], changed[:, :places])
    contents = ScoredItems(Item.from_table(state["items"]), torch.zeros(1, dtype=torch.int64))
    code = contents.rest_code(torch.tensor([0]), 3)
    by_hand = torch.zeros(9)
    others = [item for item in state["items"][0, 1:].tolist() if item[4]]
    for item in others:
        for part, size in enumerate(item[2:]):
            by_hand[part * 3 + min(size, 3) - 1] += 1 / len(others)
    torch.testing.assert_close(code[0], by_hand)
    again = checkpoint.restore(lambda: FcnGrasp(alone.cell, **FLOAT), policy.state_dict(), "policy")
    torch.testing.assert_close(again.logits(one), alone.logits(one))  # one item has no others


@pytest.mark.parametrize("key", ["network.weak", "network.patch.bias"])
def test_weights_that_lack_a_tensor_are_refused(key):
    cell = CellSpec()
    lacking = {name: value for name, value in FcnGrasp(cell, **FLOAT).state_dict().items() if name != key}
    with pytest.raises(checkpoint.CheckpointError, match=f"{key} is missing"):
        checkpoint.restore(lambda: FcnGrasp(cell, **FLOAT), lacking, "policy")


@pytest.mark.parametrize("make", [FootprintFcn, partial(Pooled, CellSpec())])
@pytest.mark.parametrize(
    ("key", "values", "expected"),
    [
        *((key, (0, -1, 2.5, True, "4"), "a whole number >= 1") for key in ("filters", "hidden", "tote_clip")),
        *((key, (0, 2.5), "a whole number >= 1") for key in ("depth_range", "item_range")),
        ("receptive_field", (4, 0, 3.5), "an odd number"),
        ("compute_dtype", ("half",), "'auto' or 'float32' or 'bfloat16'"),
    ],
)
def test_bad_settings_are_refused(make, key, values, expected):
    for value in values:
        with pytest.raises(ValueError, match=rf"{key}={value!r}: expected {expected}"):
            make(**{key: value})


def test_bad_settings_of_the_actor_are_refused():
    for key, value in (("reach", 0), ("headroom_bins", 0), ("head_std", -1), ("receptive_field", 1)):
        with pytest.raises(ValueError, match=rf"model.actor.{key}={value}: expected"):
            FcnGrasp(CellSpec(), **{key: value})
