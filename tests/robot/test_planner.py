"""The planner for a robot cell, against the oracle, plane geometry, and what a depth camera may deliver."""

import json
from collections import Counter
from math import cos, radians, sin

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from oracle import Oracle, Rules
from tensordict import TensorDict
from untrained import untrained_policy, write_checkpoint

from pickplace import CellSpec, DepthMapError, Failure, Planner
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.fcn4d import ActionPolicy
from pickplace.policies.restore import restore_policy
from pickplace.runs import checkpoint

EMPTY = np.full((6, 6), 5)
ITEM = np.zeros((5, 5), dtype=np.int64)
ITEM[1:3, 2] = 1


@pytest.fixture(scope="module")
def planner():
    return Planner(CellSpec(), untrained_policy(CellSpec()))


@st.composite
def cells_and_states(draw):
    """A cell of some sizes with an item in the bin and a tote that is partly filled."""
    effector = draw(st.tuples(st.integers(1, 4), st.integers(1, 4)))
    bin_size = draw(st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(1, 2)))
    tote_size = draw(st.tuples(st.integers(3, 6), st.integers(3, 6), st.integers(2, 5)))
    cell = CellSpec(
        bin_size, tote_size, effector, draw(st.integers(1, 4)), draw(st.sampled_from(["contain", "overlap"]))
    )
    w, d = (draw(st.integers(1, min(3, side))) for side in bin_size[:2])
    h = draw(st.integers(1, 2))
    x, y = draw(st.integers(0, bin_size[0] - w)), draw(st.integers(0, bin_size[1] - d))
    bin_depth = np.zeros(bin_size[:2], dtype=np.int64)
    bin_depth[x : x + w, y : y + d] = h
    heights = draw(st.lists(st.integers(0, tote_size[2]), min_size=2, max_size=2))
    seed = draw(st.integers(0, 1000))
    low = np.random.default_rng(seed).choice(heights, size=tote_size[:2])
    return cell, bin_depth, tote_size[2] - low


def oracle_of(cell, bin_depth, tote_depth, tote_height):
    x, y = (int(index.min()) for index in bin_depth.nonzero())
    w, d = (int(index.max() - index.min()) + 1 for index in bin_depth.nonzero())
    rules = Rules(cell.bin_size, cell.tote_size, cell.effector_size, cell.rotations, cell.pick_rule)
    heights = (tote_height - tote_depth).tolist()
    return Oracle(rules, tote_height, (w, d, int(bin_depth.max())), (x, y), heights)


@settings(max_examples=40)
@given(cells_and_states(), st.sampled_from(["all", 1, 7]), st.booleans(), st.integers(0, 5))
def test_plans_agree_with_the_oracle_and_with_plane_geometry(problem, candidates, mask, seed):
    cell, bin_depth, tote_depth = problem
    height = cell.tote_size[2]
    policy = untrained_policy(cell, mask, seed)
    planner = Planner(cell, policy, candidates)
    result = planner.plan(bin_depth, tote_depth, alternatives=6)
    oracle = oracle_of(cell, bin_depth, tote_depth, height)
    codes = [oracle.try_action(action)[0] for action in range(cell.num_actions)]
    assert result.item == dict(zip("xywdh", (*oracle.position, *oracle.item), strict=True))
    assert result.occupancy_before == pytest.approx((height - tote_depth).sum() / tote_depth.size / height)

    # The same decision as the planner that evaluation uses.
    observation = TensorDict(
        {"bin_depth": torch.tensor(bin_depth)[None].float(), "tote_depth": torch.tensor(tote_depth)[None].float(),
         "tote_height": torch.tensor([[height]])}, [1],
    )  # fmt: skip
    action = int(PolicyPlanner(cell, policy, candidates).decide(observation))
    feasible = 0 in codes
    empty = oracle_of(cell, bin_depth, np.full_like(tote_depth, height), height)
    elsewhere = any(empty.try_action(other)[0] == 0 for other in range(cell.num_actions))
    nothing = "stuck" if elsewhere else "impossible"
    assert result.status == (nothing if not feasible else "ok" if codes[action] == 0 else "rejected")
    assert result.action == (action if result.status == "ok" else None)

    # Alternatives: simulated as the oracle does, best first, the chosen one the first that would succeed.
    for other in result.alternatives:
        code = codes[other.action]
        assert other.rejected == (Failure(code).name.lower() if code else None)
        (pick, place, rotation) = oracle.rules.split(other.action)
        assert (other.pick_cell, other.place_cell, other.rotation_degrees) == (pick, place, 90 * rotation)
    shares = [other.probability for other in result.alternatives]
    assert all(0 <= share <= 1 + 1e-5 for share in shares)
    assert all(a >= b for a, b in zip(shares[:6], shares[1:6], strict=False))
    assert [other.chosen for other in result.alternatives].count(True) == (result.status == "ok")
    good = [other for other in result.alternatives if other.rejected is None]
    if result.status == "ok":
        chosen = next(other for other in good if other.chosen)
        assert chosen.action == result.action
        assert chosen.probability == pytest.approx(good[0].probability, rel=1e-5)

    if not feasible:
        assert result.reasons == {Failure(code).name.lower(): count for code, count in Counter(codes).items()}
        assert result.occupancy_after == result.occupancy_before
    else:
        assert result.reasons is None
    if result.status != "ok":
        assert result.pick is result.place is result.drop_height is result.rotation_degrees is None
        return

    # Turning the item about the end effector's centre, as a robot would, leaves it where the oracle says.
    after = np.array(oracle.try_action(result.action)[1])
    changed = np.argwhere(after != height - tote_depth)
    landed = (changed.min(0) + changed.max(0) + 1) / 2
    w, d, h = oracle.item
    angle = radians(result.rotation_degrees)
    arm = np.array(oracle.position) + np.array([w, d]) / 2 - np.array(result.pick.center[:2])
    turned = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]]) @ arm
    assert np.allclose(np.array(result.place.center[:2]) + turned, landed)
    top = after[tuple(changed[0])]
    assert result.pick.center[2] == h and result.place.center[2] == top and result.drop_height == top - h
    assert result.occupancy_after == pytest.approx(result.occupancy_before + w * d * h / tote_depth.size / height)


@pytest.mark.parametrize("height_unit", [1.0, 0.5])
def test_every_length_is_in_metres(height_unit):
    """Lengths along x and y are multiples of the cell's side, heights of the height unit."""
    cell = CellSpec(height_unit=height_unit)
    planner = Planner(cell, untrained_policy(cell))
    low = EMPTY - 2  # something two units high lies everywhere
    plain = planner.plan(ITEM, low)
    noise = np.random.default_rng(0).uniform(-0.24, 0.24, (2, 6, 6))
    unit = 0.05 * height_unit
    metric = planner.plan(
        (ITEM + noise[0, :5, :5]) * unit, torch.from_numpy((low + noise[1]) * unit), 5.02 * unit, cell_size=0.05
    )
    assert metric.action == plain.action and metric.status == "ok"
    assert plain.drop_height == 2 and metric.drop_height == pytest.approx(2 * unit)
    for pose, other in ((plain.pick, metric.pick), (plain.place, metric.place)):
        assert other.cell == pose.cell
        assert other.center == pytest.approx(np.multiply(pose.center, [0.05, 0.05, unit]))
    assert json.loads(json.dumps(metric.as_dict()))["place"]["cell"] == list(metric.place.cell)
    assert (metric.item["h"], metric.occupancy_before) == (1, pytest.approx(0.4))


def test_errors_name_the_height_unit():
    cell = CellSpec(height_unit=0.5)
    planner = Planner(cell, untrained_policy(cell))
    good = {"bin_depth": ITEM * 0.025, "tote_depth": EMPTY * 0.025, "cell_size": 0.05, "tolerance": 0.1}
    for bad, message in (
        ({"tote_depth": EMPTY * 0.025 + 0.01}, "got 5.4 height units (0.135 m), expected a whole number of height"),
        ({"tote_height": 0.13}, "expected a whole number of height units, 1 to 1048575, within 0.1, in metres"),
        ({"tote_depth": EMPTY * 0.05}, "got 10 height units (0.25 m), expected 0 to 5 height units"),
    ):
        with pytest.raises(DepthMapError) as caught:
            planner.plan(**{**good, **bad})
        assert message in str(caught.value)


def test_only_rounding_goes_beyond_the_tolerance(planner):
    high = np.where(ITEM, 3, 0)
    exact = planner.plan(high, EMPTY, tolerance=0)
    assert 0.15 / 0.05 != 3 and planner.plan(high * 0.05, EMPTY * 0.05, 5 * 0.05, 0.05, 0).action == exact.action
    deep = (EMPTY * 0 + 117).astype(np.float32) * np.float32(0.05)
    assert planner.plan(high * 0.05, deep, 200 * 0.05, 0.05, 0).status == "ok"
    with pytest.raises(DepthMapError, match="within 0"):
        planner.plan(high * 1.00001, EMPTY, tolerance=0)


def test_stuck_in_this_tote_or_in_any(planner):
    """A robot that is told to bring an empty tote must not be told so for ever."""
    full = planner.plan(ITEM, np.zeros((6, 6)))
    assert full.status == "stuck" and sum(full.reasons.values()) == planner.cell.num_actions
    long = np.zeros((5, 5))
    long[:4, 1] = 1  # an end effector of 3x3 does not cover it
    assert planner.plan(long, EMPTY).status == planner.plan(long, np.zeros((6, 6))).status == "impossible"
    assert planner.plan(ITEM * 6, EMPTY).status == "impossible"
    assert planner.plan(ITEM * 6, EMPTY + 1, tote_height=6).status == "ok"


def test_maps_of_other_kinds(planner):
    plain = planner.plan(ITEM, EMPTY)
    for make in (
        lambda a: torch.tensor(a, dtype=torch.bfloat16),
        lambda a: torch.tensor(a, dtype=torch.float32, requires_grad=True),
        lambda a: np.ma.masked_array(a, mask=False),
        lambda a: np.asfortranarray(a.astype(">u2")),
    ):
        assert planner.plan(make(ITEM), make(EMPTY)) == plain


def test_tote_height_of_the_moment(planner):
    low = planner.plan(ITEM, EMPTY - 3, tote_height=2)
    assert low.occupancy_after == pytest.approx(2 / 72)
    with pytest.raises(DepthMapError, match=r"tote_depth\[0, 0\]: got 5 cells, expected 0 to 2 cells"):
        planner.plan(ITEM, EMPTY, tote_height=2)


def test_four_dimensional_policy_plans_too():
    cell = CellSpec(rotations=3)
    result = Planner(cell, ActionPolicy(cell, filters=4).eval()).plan(ITEM, EMPTY, alternatives=3)
    assert result.status == "ok" and result.rotation_degrees in (0, 90, 180)
    assert len(result.alternatives) in (3, 4) and sum(other.chosen for other in result.alternatives) == 1


def changed(array, cell, value, dtype=float):
    array = array.astype(dtype)
    array[cell] = value
    return array


TWO_ITEMS = changed(ITEM, (4, 4), 1)
BAD = [
    ({"bin_depth": ITEM[:4]}, "bin_depth: got shape [4, 5], expected [5, 5]"),
    ({"bin_depth": ITEM[None]}, "bin_depth: got shape [1, 5, 5], expected [5, 5]"),
    ({"bin_depth": []}, "bin_depth: got shape [0]"),
    ({"bin_depth": None}, "bin_depth: got shape []"),
    ({"bin_depth": [[1, 2], [3]]}, "bin_depth: expected an array of 5x5 numbers"),
    ({"bin_depth": ITEM.astype(str)}, "bin_depth: got values of type"),
    ({"bin_depth": ITEM.astype(bool)}, "bin_depth: got values of type bool"),
    ({"bin_depth": ITEM.astype(complex)}, "bin_depth: got values of type complex"),
    ({"bin_depth": np.zeros((5, 5))}, "bin_depth: got no cell above 0, expected one item"),
    ({"bin_depth": TWO_ITEMS}, "bin_depth[1, 3]: got 0 cells, expected 1: one cuboid"),
    ({"bin_depth": changed(ITEM, (2, 2), 2)}, "bin_depth[1, 2]: got 1 cells, expected 2: one cuboid"),
    ({"bin_depth": changed(ITEM, (0, 0), np.nan)}, "bin_depth[0, 0]: got nan cells"),
    ({"bin_depth": changed(ITEM, (0, 0), np.inf)}, "bin_depth[0, 0]: got inf cells"),
    ({"bin_depth": changed(ITEM, (4, 0), -1)}, "bin_depth[4, 0]: got -1 cells, expected 0 to"),
    ({"bin_depth": changed(ITEM, (1, 2), 1.3)}, "bin_depth[1, 2]: got 1.3 cells, expected a whole number of cells"),
    ({"bin_depth": np.ma.masked_equal(ITEM, 1)}, "bin_depth[1, 2]: got a masked value, expected a measured one."),
    ({"tote_depth": np.ma.masked_array(EMPTY, EMPTY > 0)}, "tote_depth[0, 0]: got a masked value"),
    ({"tote_depth": EMPTY.T[:, :5]}, "tote_depth: got shape [6, 5], expected [6, 6]"),
    ({"tote_depth": changed(EMPTY, (3, 1), 6)}, "tote_depth[3, 1]: got 6 cells, expected 0 to 5 cells"),
    ({"tote_depth": changed(EMPTY, (3, 1), -1)}, "tote_depth[3, 1]: got -1 cells"),
    ({"tote_depth": EMPTY * 0.05 + 0.02, "bin_depth": ITEM * 0.05, "cell_size": 0.05},
     "tote_depth[0, 0]: got 5.4 cells (0.27 m), expected a whole number of cells, within 0.25"),
    ({"cell_size": 0}, "cell_size=0: expected a length in metres, 1e-6 to 1e6"),
    ({"cell_size": "5cm"}, "cell_size='5cm': expected a length"),
    ({"cell_size": float("nan")}, "cell_size=nan"),
    ({"cell_size": b"1"}, "cell_size=b'1': expected a length"),
    ({"cell_size": np.True_}, "cell_size=np.True_" if np.__version__ >= "2" else "cell_size=True"),
    ({"cell_size": 1e-320}, "cell_size=1e-320: expected a length in metres, 1e-6 to 1e6"),
    ({"tote_height": 0}, "tote_height=0: expected a whole number of cells, 1 to 1048575"),
    ({"tote_height": 4.5}, "tote_height=4.5"),
    ({"tote_height": 10**400}, "tote_height=1000"),
    ({"tote_height": True}, "tote_height=True"),
    ({"tote_height": [5]}, "tote_height=[5]"),
    ({"tolerance": 0.5}, "tolerance=0.5: expected a number of cells >= 0 and < 0.5"),
    ({"alternatives": -1}, "alternatives=-1: expected a whole number >= 0"),
    ({"alternatives": 2.0}, "alternatives=2.0"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "message"), BAD)
@pytest.mark.filterwarnings("error")
def test_bad_maps_are_refused_in_one_sentence(planner, given, message):
    with pytest.raises(DepthMapError) as caught:
        planner.plan(**{"bin_depth": ITEM, "tote_depth": EMPTY, **given})
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_load(tmp_path):
    shipped = Planner.load("pretrained/r4", tote_size=(8, 7, 9), candidates=10)
    assert shipped.cell.tote_size == (8, 7, 9) and shipped.cell.bin_size == (5, 5, 1)
    assert shipped.plan(ITEM, np.full((8, 7), 9)).status == "ok"
    for sizes, message in [
        ({"tote_sizes": 1}, "tote_sizes=1: expected one of bin_size"),
        ({"rotations": 5}, "rotations=5"),
        ({"effector_size": (0, 3)}, "effector_size"),
        ({"candidates": 0}, "candidates=0"),
    ]:
        with pytest.raises(ValueError, match=message):
            Planner.load("pretrained/r4", **sizes)
    with pytest.raises(ValueError, match="pretrained/r9.*expected .*pretrained/r4"):
        Planner.load("pretrained/r9")
    with pytest.raises(ValueError, match="path=None: expected a run folder"):
        Planner.load(None)


def test_a_policy_without_a_mask_serves_end_effectors_as_long_as_its_own():
    turned = Planner.load("pretrained/unmasked", effector_size=(2, 3), tote_size=(7, 8, 5))
    assert turned.plan(ITEM, np.full((7, 8), 5)).status == "ok"
    with pytest.raises(ValueError, match=r"env.effector_size=\[4, 4\]: the checkpoint was trained with \[3, 3\], and"):
        Planner.load("pretrained/unmasked", effector_size=(4, 4))
    state, facts = checkpoint.read(checkpoint.locate("pretrained/unmasked"))
    del state["policy"]["miss"]  # what is damaged is not said to be of another size
    cfg = OmegaConf.create(facts["config"])
    with pytest.raises(ValueError, match="policy.*miss"):
        restore_policy(cfg, CellSpec(tote_size=(9, 9, 5)), state["policy"], {"rotations": 4, "tote_size": [6, 6, 5]})


def test_load_of_a_policy_whose_grasps_depend_on_the_items(tmp_path):
    """With ``pick_rule=overlap`` and no mask the number of grasp classes follows from the longest item in training."""
    cell = CellSpec(tote_size=(5, 5, 2), pick_rule="overlap", longest_side=2)
    overrides = ["env.pick_rule=overlap", "algo.mask_infeasible=false", "env.tote_size=[5,5,2]"]
    loaded = Planner.load(write_checkpoint(tmp_path / "it", cell, *overrides))
    assert loaded.plan(ITEM, np.full((5, 5), 2)).status == "ok"
    with pytest.raises(
        DepthMapError, match="the item is 3 cells long, longer than any in training; expected at most 2"
    ):
        loaded.plan(changed(ITEM, (3, 2), 1), np.full((5, 5), 2))
