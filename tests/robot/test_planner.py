"""The planner for a robot cell, against the oracle, plane geometry, and what a depth camera may deliver."""

import io
import json
import sys
from collections import Counter
from math import cos, radians, sin

import hydra
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from oracle import Oracle
from oracle import Rules as OracleRules
from tensordict import TensorDict

from pickplace import DepthMapError, Failure, Planner, Rules
from pickplace.planners import PolicyPlanner
from pickplace.planners.policy import restore_policy
from pickplace.policies.actors import fcn4d, fcn_grasp
from pickplace.robot import json_lines as plan
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.registry import build

EMPTY = np.full((6, 6), 5)
ITEM = np.zeros((5, 5), dtype=np.int64)
ITEM[1:3, 2] = 1


def make_planner(rules=None, candidates="all", mask=True, seed=0):
    """A planner with an untrained policy that prefers some actions clearly."""
    rules = rules or Rules()
    torch.manual_seed(seed)
    return Planner(rules, fcn_grasp(rules, mask, filters=8, hidden=8, head_std=1.0).eval(), candidates)


@pytest.fixture(scope="module")
def planner():
    return make_planner()


@st.composite
def cells_and_states(draw):
    """A cell of some sizes with an item in the bin and a tote that is partly filled."""
    effector = draw(st.tuples(st.integers(1, 4), st.integers(1, 4)))
    bin_size = draw(st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(1, 2)))
    tote_size = draw(st.tuples(st.integers(3, 6), st.integers(3, 6), st.integers(2, 5)))
    rules = Rules(bin_size, tote_size, effector, draw(st.integers(1, 4)), draw(st.sampled_from(["contain", "overlap"])))
    w, d = (draw(st.integers(1, min(3, side))) for side in bin_size[:2])
    h = draw(st.integers(1, 2))
    x, y = draw(st.integers(0, bin_size[0] - w)), draw(st.integers(0, bin_size[1] - d))
    bin_depth = np.zeros(bin_size[:2], dtype=np.int64)
    bin_depth[x : x + w, y : y + d] = h
    heights = draw(st.lists(st.integers(0, tote_size[2]), min_size=2, max_size=2))
    seed = draw(st.integers(0, 1000))
    low = np.random.default_rng(seed).choice(heights, size=tote_size[:2])
    return rules, bin_depth, tote_size[2] - low


def oracle_of(rules, bin_depth, tote_depth, tote_height):
    x, y = (int(index.min()) for index in bin_depth.nonzero())
    w, d = (int(index.max() - index.min()) + 1 for index in bin_depth.nonzero())
    own = OracleRules(rules.bin_size, rules.tote_size, rules.effector_size, rules.rotations, rules.pick_rule)
    heights = (tote_height - tote_depth).tolist()
    return Oracle(own, tote_height, (w, d, int(bin_depth.max())), (x, y), heights)


@settings(max_examples=60)
@given(cells_and_states(), st.sampled_from(["all", 1, 7]), st.booleans(), st.integers(0, 5))
def test_plans_agree_with_the_oracle_and_with_plane_geometry(cell, candidates, mask, seed):
    rules, bin_depth, tote_depth = cell
    height = rules.tote_size[2]
    planner = make_planner(rules, candidates, mask, seed)
    result = planner.plan(bin_depth, tote_depth, alternatives=6)
    oracle = oracle_of(rules, bin_depth, tote_depth, height)
    codes = [oracle.try_action(action)[0] for action in range(rules.num_actions)]
    assert result.item == {
        "x": oracle.position[0],
        "y": oracle.position[1],
        **dict(zip("wdh", oracle.item, strict=True)),
    }
    assert result.occupancy_before == pytest.approx((height - tote_depth).sum() / tote_depth.size / height)

    # The same decision as the planner that evaluation uses.
    observation = TensorDict(
        {"bin_depth": torch.tensor(bin_depth)[None].float(), "tote_depth": torch.tensor(tote_depth)[None].float(),
         "tote_height": torch.tensor([[height]])}, [1],
    )  # fmt: skip
    action = int(PolicyPlanner(rules, planner._planner.policy, candidates).decide(observation))
    feasible = 0 in codes
    empty = oracle_of(rules, bin_depth, np.full_like(tote_depth, height), height)
    elsewhere = any(empty.try_action(other)[0] == 0 for other in range(rules.num_actions))
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


def test_metres_and_noise_within_the_tolerance_change_nothing(planner):
    plain = planner.plan(ITEM, EMPTY)
    noise = np.random.default_rng(0).uniform(-0.24, 0.24, (2, 6, 6))
    metric = planner.plan(
        (ITEM + noise[0, :5, :5]) * 0.05, torch.from_numpy((EMPTY + noise[1]) * 0.05), tote_height=0.251, cell_size=0.05
    )
    assert metric.action == plain.action and metric.status == "ok"
    assert metric.pick.center == pytest.approx([0.05 * value for value in plain.pick.center])
    assert metric.place.center == pytest.approx([0.05 * value for value in plain.place.center])
    assert metric.pick.cell == plain.pick.cell
    assert json.loads(json.dumps(metric.as_dict()))["place"]["cell"] == list(metric.place.cell)


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
    assert full.status == "stuck" and sum(full.reasons.values()) == planner.rules.num_actions
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
    rules = Rules(rotations=3)
    policy = fcn4d(rules, False, filters=4).eval()
    result = Planner(rules, policy).plan(ITEM, EMPTY, alternatives=3)
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
    assert shipped.rules.tote_size == (8, 7, 9) and shipped.rules.bin_size == (5, 5, 1)
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
        restore_policy(cfg, Rules(tote_size=(9, 9, 5)), state["policy"], {"rotations": 4, "tote_size": [6, 6, 5]})


# ---------------------------------------------------------------------- pickplace-plan
@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Run ``pickplace-plan`` in this process, in an empty folder; returns exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments, lines=b""):
        monkeypatch.setattr(sys, "argv", ["pickplace-plan", *map(str, arguments)])
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(lines)))
        code = 0
        try:
            plan.main()
        except SystemExit as exit:
            code = exit.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def test_command_plans_from_files(command, tmp_path):
    np.save(tmp_path / "bin.npy", ITEM * 0.05)
    np.save(tmp_path / "tote.npy", EMPTY * 0.05)
    arguments = ["pretrained/r4", "--bin", "bin.npy", "--tote", "tote.npy", "--cell-size", 0.05, "--time"]
    code, out, err = command(*arguments, "--candidates", 10, "--threads", 1)
    result = json.loads(out)
    assert code == 0 and result["status"] == "ok" and result["item"] == {"x": 1, "y": 2, "w": 2, "d": 1, "h": 1}
    assert err.startswith("planned in ") and err.endswith(" ms\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere"),
        (
            ["pretrained/none"],
            "expected pretrained/fcn4d, pretrained/mixed, pretrained/r1, pretrained/r3, pretrained/r4, "
            "pretrained/unmasked",
        ),
        (["pretrained/r4", "--bin", "bin.npy"], "--tote: no file"),
        (["pretrained/r4", "--bin", "bin.npy", "--tote", "missing.npy"], "missing.npy: cannot be read"),
        (["pretrained/r4", "--bin", "bin.npy", "--tote", "pickle.npy"], "pickle.npy: cannot be read"),
        (["pretrained/r4", "--bin", "bin.npy", "--tote", "bin.npy"], "tote_depth: got shape [5, 5]"),
        (["pretrained/r4", "--candidates", "some"], "candidates='some'"),
        (["pretrained/r4", "--threads", "0"], "--threads=0"),
        (["pretrained/r4", "--rotations", "7"], "rotations=7"),
        (["pretrained/r4", "--device", "tpu"], "tpu"),
    ],
)
def test_command_refuses_in_one_sentence(command, tmp_path, arguments, message):
    np.save(tmp_path / "bin.npy", ITEM)
    np.save(tmp_path / "pickle.npy", np.array([{}]), allow_pickle=True)
    code, out, err = command(*arguments)
    assert code == 2 and out == ""
    assert err.startswith("error: ") and err.count("\n") == 1 and message in err


def test_command_answers_json_lines_and_survives_bad_ones(command):
    good = {"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist(), "alternatives": 0}
    requests = [
        json.dumps({"id": "a", **good}).encode(),
        b"",
        b"not json",
        b"\xff\xfe",
        b"[" * 100_000,
        b"[1, 2]",
        json.dumps({"id": 7, "tote_depth": good["tote_depth"]}).encode(),
        json.dumps({"id": 8, **good, "tote": 1}).encode(),
        json.dumps({"id": 9, **good, "bin_depth": [[0.0] * 5] * 5}).encode(),
        json.dumps({"id": 10, **good, "tote_height": float("nan")}).encode(),
        json.dumps({"id": 11, **good, "tote_depth": [[0] * 6] * 6}).encode(),
        json.dumps({"id": {"b": 1}, **good}).encode(),
    ]
    code, out, err = command("pretrained/r4", lines=b"\n".join(requests))
    replies = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and err == "" and len(replies) == len(requests) - 1
    errors = [
        None, "not JSON", "utf-8", "recursion", "got list", "bin_depth: missing", "there is no such key", "one item",
        "NaN", None, None,
    ]  # fmt: skip
    for reply, expected in zip(replies, errors, strict=True):
        assert ("error" in reply) == (expected is not None), reply
        assert expected is None or expected in reply["error"]
    assert [reply.get("id") for reply in replies] == ["a", None, None, None, None, 7, 8, 9, None, 11, {"b": 1}]
    assert replies[-2]["status"] == "stuck" and sum(replies[-2]["reasons"].values()) == 3600
    assert {**replies[0], "id": 0} == {**replies[-1], "id": 0} and replies[0]["status"] == "ok"


def test_load_of_a_policy_whose_grasps_depend_on_the_items(tmp_path):
    """With ``pick_rule=overlap`` and no mask the number of grasp classes follows from the longest item in training."""
    overrides = ["experiment=smoke", "env.pick_rule=overlap", "algo.mask_infeasible=false", "env.tote_size=[5,5,2]"]
    with hydra.initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        cfg = hydra.compose("train", overrides)
    rules = Rules(tote_size=(5, 5, 2), pick_rule="overlap", longest_side=2)
    policy = build("model.actor", cfg.model.actor, rules=rules, mask_infeasible=False)
    facts = {"frames": 0, "config": OmegaConf.to_container(cfg), "commit": None}
    checkpoint.write(tmp_path / "it", {"policy": policy.state_dict()}, facts)
    loaded = Planner.load(tmp_path / "it")
    assert loaded.plan(ITEM, np.full((5, 5), 2)).status == "ok"
    with pytest.raises(DepthMapError, match="the item is longer than any in training, expected at most 2"):
        loaded.plan(changed(ITEM, (3, 2), 1), np.full((5, 5), 2))


def test_every_length_is_in_metres(planner):
    low = EMPTY - 2  # something two cells high lies everywhere
    plain, metric = planner.plan(ITEM, low), planner.plan(ITEM * 0.05, low * 0.05, cell_size=0.05)
    assert plain.drop_height == 2 and metric.drop_height == pytest.approx(0.1)
    for pose, other in ((plain.pick, metric.pick), (plain.place, metric.place)):
        assert other.cell == pose.cell and other.center == pytest.approx([0.05 * length for length in pose.center])


def test_command_hands_every_option_on(command, tmp_path):
    item = np.zeros((5, 4))
    item[1:3, 2] = 1.1
    np.save(tmp_path / "bin.npy", item)
    np.save(tmp_path / "tote.npy", np.full((7, 6), 4.0))
    arguments = ["pretrained/r4", "--bin", "bin.npy", "--tote", "tote.npy"]
    arguments += ["--bin-size", 5, 4, 1, "--tote-size", 7, 6, 9, "--effector-size", 2, 2, "--rotations", 1]
    code, out, err = command(*arguments, "--tote-height", 4, "--alternatives", 1)
    assert code == 0, err
    plan = json.loads(out)
    assert plan["status"] == "ok" and plan["rotation_degrees"] == 0 and len(plan["alternatives"]) == 1
    assert plan["occupancy_after"] == pytest.approx(2 / (7 * 6 * 4))
    assert plan["pick"]["center"][:2] == pytest.approx([2, 2.5], abs=0.5)  # an effector of two cells covers both
    assert "within 0.05" in command(*arguments, "--tote-height", 4, "--tolerance", 0.05)[2]


def test_a_request_has_the_last_word(command):
    """Over what the command line says for all."""
    plain = {"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist()}
    metric = {"bin_depth": (ITEM * 0.05).tolist(), "tote_depth": (EMPTY * 0.05).tolist(), "cell_size": 0.05}
    low = {"bin_depth": ITEM.tolist(), "tote_depth": (EMPTY - 3).tolist(), "tote_height": 2, "alternatives": 2}
    lines = "\n".join(json.dumps(request) for request in (plain, metric, low)).encode()
    code, out, err = command("pretrained/r4", "--cell-size", 1, "--alternatives", 0, lines=lines)
    replies = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and [reply.get("status") for reply in replies] == ["ok"] * 3, err
    assert replies[1]["pick"]["center"] == pytest.approx([0.05 * length for length in replies[0]["pick"]["center"]])
    assert replies[2]["occupancy_after"] == pytest.approx(2 / 72)
    assert [bool(reply["alternatives"]) for reply in replies] == [False, False, True]
