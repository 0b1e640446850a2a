"""Warm start: what the teacher is asked, what is learnt from it, and when."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from commands import composed
from omegaconf import OmegaConf
from problems import late_state
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace import PickPlaceEnv
from pickplace.algorithms.base import BatchPosition
from pickplace.algorithms.imitation import Imitation, WarmStart, imitation_loss
from pickplace.config.registry import PLANNERS
from pickplace.planners.heuristics import JointDBL
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.policy import fcn_grasp
from pickplace.policies.individual.policy import IndividualRl, individual_grasp
from pickplace.rules.step import apply
from pickplace.runs import checkpoint
from pickplace.runs.provenance import first_steps
from pickplace.training.settings import check_settings

FCN = {"filters": 8, "hidden": 8}
MODELS = {  # constructor, mask_infeasible, sizes
    "footprint": (fcn_grasp, True, FCN), "grasp": (fcn_grasp, False, FCN),
    "flat": (Fcn4d, False, {"filters": 4}), "individual": (IndividualRl, False, {"filters": 4}),
    "individual_grasp": (individual_grasp, False, FCN), "individual_footprint": (individual_grasp, True, FCN),
}  # fmt: skip


def config(teacher="joint_dbl", frames=100, critic_frames=50, checkpoint=None, **settings):
    """Return a config of the group warm_start."""
    teacher = teacher and {"_target_": teacher, **settings}
    numbers = {"frames": frames, "critic_frames": critic_frames}
    return OmegaConf.create({"teacher": teacher, "checkpoint": checkpoint, **numbers})


def warm_start(cfg, name="footprint", env=None, seed=0):
    """Return a warm start and its policy."""
    env = env or PickPlaceEnv(num_envs=1)
    make, masked, sizes = MODELS[name]
    policy = make(env.cell, mask_infeasible=masked, **sizes)
    return WarmStart(cfg, policy, env, seed), policy


@pytest.fixture(scope="module")
def states():
    """An environment in the middle of random episodes, and its observations."""
    return late_state(7, num_envs=64, masks=("footprint", "action"))


@pytest.mark.parametrize("name", MODELS)
def test_the_policy_can_do_what_is_taught_as_the_teacher_does(name, states):
    env, td = states
    start, policy = warm_start(config(), name, env)
    taught = start.ask(td, 0)
    known = taught >= 0
    assert known.all() if "individual" not in name else 0 < known.sum() < 64
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        own = policy.to_action(taught.clamp(min=0), td)
    theirs, ours = (apply(env.cell, env.state, action).surface for action in (JointDBL(env.cell).decide(td), own))
    assert torch.equal(theirs[known], ours[known])


@pytest.mark.parametrize("name", ["footprint", "flat"])
def test_of_several_items_the_taught_one_is_learnt(name):
    env, td = late_state(5, num_envs=32, masks=("footprint", "corner", "action"), bin_items=3, bin_size=(7, 7, 1))
    start, policy = warm_start(config(), name, env)
    taught = start.ask(td, 0)
    known = taught >= 0
    assert known.all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        own = policy.to_action(taught, td)
    ours, theirs = (apply(env.cell, env.state, action) for action in (own, JointDBL(env.cell).decide(td)))
    assert torch.equal(ours.taken, theirs.taken) and torch.equal(ours.footprint, theirs.footprint)
    assert ours.taken.unique().numel() == 3


def test_a_teacher_s_network_is_where_the_training_is(states, monkeypatch):
    """Wherever its own training was."""
    read = checkpoint.read

    def read_from_a_gpu(place):
        state, facts = read(place)
        return state, {**facts, "config": {**facts["config"], "device": "cuda:7"}}

    monkeypatch.setattr(checkpoint, "read", read_from_a_gpu)
    trained, _ = warm_start(config("policy", checkpoint="pretrained/r4", candidates="all"), "grasp", states[0])
    assert (trained.ask(states[1], 0) >= 0).all()


def test_teachers_that_fail_draw_or_are_trained(states):
    env, td = states
    # Few of all actions are feasible, and only these are taught.
    taught = warm_start(config("uniform", seed=0), "flat", env)[0].ask(td, 0)
    chosen = td["action_mask"].gather(1, taught.clamp(min=0)[:, None])[:, 0]
    assert (taught >= 0).sum() < 16 and chosen[taught >= 0].all()
    # A teacher that draws begins anew with each iteration.
    random, _ = warm_start(config("random", seed=0), "flat", env, seed=7)
    assert torch.equal(random.ask(td, 3), random.ask(td, 3))
    assert not torch.equal(random.ask(td, 3), random.ask(td, 4))
    trained, _ = warm_start(config("policy", checkpoint="pretrained/r4", candidates="all"), "grasp", env)
    assert (trained.ask(td, 0) >= 0).all()


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_teaches_by_its_name(name, states):
    fast = {"mcts": ["simulations=8"], "lookahead": ["samples=2", "candidates=2", "rounds=1"]}.get(name, [])
    words = [f"warm_start.teacher.{word}" for word in fast]
    checkpoint = {"policy": "r4", "lookahead": "r4", "beam": "mixed"}.get(name)
    words += [f"warm_start.checkpoint=pretrained/{checkpoint}"] if checkpoint else []
    cfg = composed("warm_start=imitate", f"planner@warm_start.teacher={name}", *words).warm_start
    taught = warm_start(cfg, env=states[0])[0].ask(states[1], 0)
    assert first_steps({"warm_start": dict(cfg)})["warm_start"] == name and (taught >= 0).any()


@pytest.mark.parametrize("settings", [{}, {"seed": 0}])
def test_an_own_teacher_that_draws_gets_a_seed_of_each_batch(settings, states, monkeypatch):
    """Whether or not its config names a seed; so a resumed training draws the same, and no two batches do."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "docs/examples/own_planner"))
    ask = warm_start(config("own_planner.SoftDBL", temperature=1.0, **settings), env=states[0], seed=7)[0].ask
    own = warm_start(config("own_planner.SoftDBL", temperature=1.0, **settings), env=states[0], seed=6)[0].ask
    assert torch.equal(ask(states[1], 3), ask(states[1], 3)) and torch.equal(ask(states[1], 3), own(states[1], 4))
    assert not torch.equal(ask(states[1], 3), ask(states[1], 4))


def test_references_in_the_settings_of_a_teacher_are_followed(states, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "docs/examples/own_planner"))
    start, _ = warm_start(config("own_planner.SoftDBL", temperature="${frames}"), env=states[0])
    assert start._make_teacher(0).temperature == 100


def test_imitation_learns_the_teachers_choices(states):
    env, td = states[0], states[1].clone()
    start, policy = warm_start(config(), env=env)
    td["taught"] = torch.full((64,), -1)
    loss, agreed = imitation_loss(policy, td)
    loss.backward()  # nothing is taught: no gradient
    assert loss == agreed == 0 and not any(p.grad.any() for p in policy.parameters() if p.grad is not None)
    td["taught"][16:] = start.ask(td, 0)[16:]
    before, agreed = imitation_loss(policy, td)
    by_hand = policy.logits(td).log_softmax(-1)
    torch.testing.assert_close(before, -by_hand[torch.arange(16, 64), td["taught"][16:]].mean())
    optimizer = torch.optim.Adam(policy.parameters(), 1e-2)
    for _ in range(40):
        optimizer.zero_grad()
        loss, now_agreed = imitation_loss(policy, td)
        loss.backward()
        optimizer.step()
    assert loss < before / 2 and now_agreed > 0.7 > agreed


def test_phases_follow_each_other():
    """The teacher is asked, then the critic learns alone, then the algorithm learns as without a teacher."""
    inner = SimpleNamespace(
        next_keys=(), learn=lambda batch, position: "reward", prepare=lambda batch, position: batch.reshape(-1)
    )
    inner.descend = lambda data, position, objective: "imitation" if "taught" in data else "critic"
    imitation = Imitation(inner, warm_start(config(frames=100, critic_frames=50))[0])
    imitation.warm_start.ask = lambda data, iteration: torch.zeros(len(data))
    sent = [BatchPosition(frames, 0, 1, 0) for frames in (0, 99, 100, 149, 150)]
    phases = [imitation.learn(TensorDict({}, [2, 3]), position) for position in sent]
    assert phases == ["imitation", "imitation", "critic", "critic", "reward"]


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (config(None), "warm_start.frames=100: expected 0 without a teacher, or warm_start=imitate"),
        (config("own_planner.Nothing"), "warm_start.teacher._target_=own_planner.Nothing: there is no such"),
        (config("policy", candidates="all"), "warm_start.checkpoint=null: planner=policy needs a checkpoint"),
        (
            config("policy", checkpoint="nowhere", candidates="all"),
            r"warm_start.checkpoint='.*nowhere': no checkpoint there",
        ),
        (
            config(checkpoint="pretrained/r4"),
            "warm_start.checkpoint='pretrained/r4': expected null, or warm_start.frames above 0 and",
        ),
        (
            config("policy", frames=0, checkpoint="pretrained/r4", candidates="all"),
            "warm_start.checkpoint='pretrained/r4': expected null, or warm_start.frames above 0 and",
        ),
    ],
)
def test_a_teacher_that_cannot_be_made_is_refused(cfg, message):
    with pytest.raises(ValueError, match=message):
        warm_start(cfg)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("frames=-1", "warm_start.frames=-1: expected a whole number >= 0"),
        ("critic_frames=1.5", "warm_start.critic_frames=1.5: expected a whole number >= 0"),
        ("teacher=mcts", "warm_start.teacher='mcts': expected the settings of an object"),
    ],
)
def test_bad_settings_are_refused(word, message):
    with pytest.raises(ValueError, match=message):
        check_settings(composed(f"warm_start.{word}"))


def test_results_name_the_teacher():
    found = [first_steps({"warm_start": dict(cfg)})["warm_start"] for cfg in (config(), config(None, 0, 0))]
    assert found == ["joint_dbl", None] and first_steps({}) == {"warm_start": None, "first_weights": None}
