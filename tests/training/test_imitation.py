"""Warm start: what the teacher is asked, what is learnt from it, and when."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace import PickPlaceEnv
from pickplace.planners.heuristics import JointDBL, RandomFeasible
from pickplace.policies.fcn4d import ActionPolicy
from pickplace.policies.fcn_grasp import fcn_grasp
from pickplace.policies.individual import IndividualRlPolicy, individual_grasp
from pickplace.runs.provenance import imitated_planner
from pickplace.task.transition import apply
from pickplace.training.imitation import Phase, WarmStart, imitation_loss

MODELS = {
    "footprint": (fcn_grasp, True, {"filters": 8, "hidden": 8}),
    "grasp": (fcn_grasp, False, {"filters": 8, "hidden": 8}),
    "flat": (ActionPolicy, False, {"filters": 4}),
    "individual": (IndividualRlPolicy, False, {"filters": 4}),
    "individual_grasp": (individual_grasp, False, {"filters": 8, "hidden": 8}),
    "individual_footprint": (individual_grasp, True, {"filters": 8, "hidden": 8}),
}


def model(name, env):
    make, masked, network = MODELS[name]
    return make(env.cell, mask_infeasible=masked, **network)


def config(teacher="joint_dbl", frames=100, critic_frames=50, checkpoint=None, **teacher_settings):
    """A config of the group warm_start."""
    teacher = teacher and {"_target_": teacher, **teacher_settings}
    return OmegaConf.create(
        {"teacher": teacher, "checkpoint": checkpoint, "frames": frames, "critic_frames": critic_frames}
    )


def warm_start(cfg, policy, env, seed=0):
    return WarmStart(cfg, policy, env.cell, env.items, env.terms, seed)


def random_states(count, seed, **env):
    """An environment, and its observations in the middle of random episodes, with every mask."""
    env = PickPlaceEnv(num_envs=count, masks=("footprint", "action"), seed=seed, **env)
    planner, td = RandomFeasible(env.cell, seed), env.reset()
    for _ in range(6):
        _, td = env.step_and_maybe_reset(td.set("action", planner.decide(td)))
    return env, td


def result(env, action):
    """The tote's heights after an action, and its failure."""
    step = apply(env.cell, env.state, action)
    return step.heights, step.failure


@settings(max_examples=20)
@given(
    name=st.sampled_from(["footprint", "grasp", "flat"]),
    rotations=st.integers(1, 4),
    effector=st.sampled_from([(3, 3), (2, 3)]),
    seed=st.integers(0, 1000),
)
def test_the_choice_of_an_action_has_the_same_result(name, rotations, effector, seed):
    env, td = random_states(16, seed, rotations=rotations, effector_size=effector)
    policy, action = model(name, env), RandomFeasible(env.cell, seed + 1).decide(td)
    choice = policy.to_choice(action, td)
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        with set_exploration_type(kind):
            own = policy.to_action(choice, td)
        (expected, _), (got, failure) = result(env, action), result(env, own)
        assert torch.equal(expected, got) and not failure.any()


def test_a_pick_that_misses_is_the_choice_to_miss():
    env, td = random_states(8, 0)
    policy = model("grasp", env)
    # The item is 2 cells long at most: with the effector at the far corner from it, it is missed.
    x = torch.where(env.current_item.x >= 2, 0, 4)
    action = (x * 5 + torch.where(env.current_item.y >= 2, 0, 4)) * 36 * 4
    missed = policy.to_choice(action, td) == policy.classes * 36
    assert torch.equal(missed, result(env, action)[1] == 1) and missed.any()


@pytest.mark.parametrize("name", MODELS)
def test_the_policy_can_do_what_is_taught_as_the_teacher_does(name):
    env, td = random_states(64, 3)
    policy = model(name, env)
    taught = warm_start(config(), policy, env).ask(td, 0)
    known = taught >= 0
    assert known.all() if "individual" not in name else 0 < known.sum() < 64
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        own = policy.to_action(taught.clamp(min=0), td)
    assert torch.equal(result(env, JointDBL(env.cell).decide(td))[0][known], result(env, own)[0][known])


def test_teachers_that_fail_draw_or_are_trained():
    env, td = random_states(64, 1)
    flat, grasp = model("flat", env), model("grasp", env)
    # Few of all actions are feasible, and only these are taught.
    taught = warm_start(config("uniform", seed=0), flat, env).ask(td, 0)
    chosen = td["action_mask"].gather(1, taught.clamp(min=0)[:, None])[:, 0]
    assert (taught >= 0).sum() < 16 and chosen[taught >= 0].all()
    # A teacher that draws begins anew with each iteration.
    random = warm_start(config("random", seed=0), flat, env, seed=7)
    assert torch.equal(random.ask(td, 3), random.ask(td, 3))
    assert not torch.equal(random.ask(td, 3), random.ask(td, 4))
    trained = config("policy", checkpoint="pretrained/r4", candidates="all")
    assert (warm_start(trained, grasp, env).ask(td, 0) >= 0).all()


def test_imitation_learns_the_teachers_choices():
    env, td = random_states(256, 0)
    policy = model("footprint", env)
    td["taught"] = torch.full((256,), -1)
    loss, agreed = imitation_loss(policy, td)
    loss.backward()  # nothing is taught: no gradient
    assert loss == agreed == 0 and not any(p.grad.any() for p in policy.parameters() if p.grad is not None)
    td["taught"][16:] = warm_start(config(), policy, env).ask(td, 0)[16:]
    before, agreed = imitation_loss(policy, td)
    by_hand = policy.logits(td).log_softmax(-1)
    torch.testing.assert_close(before, -by_hand[torch.arange(16, 256), td["taught"][16:]].mean())
    optimizer = torch.optim.Adam(policy.parameters(), 1e-2)
    for _ in range(60):
        optimizer.zero_grad()
        loss, now_agreed = imitation_loss(policy, td)
        loss.backward()
        optimizer.step()
    assert loss < before / 2 and now_agreed > 0.7 > agreed


def test_phases_follow_each_other():
    env = PickPlaceEnv(num_envs=1)
    start = warm_start(config(frames=100, critic_frames=50), model("footprint", env), env)
    phases = [start.phase(frames) for frames in (0, 99, 100, 149, 150)]
    assert phases == [Phase.IMITATION, Phase.IMITATION, Phase.CRITIC, Phase.CRITIC, Phase.REWARD]
    assert warm_start(config(None, 0, 0), model("footprint", env), env).phase(0) == Phase.REWARD


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (config(frames=-1), "warm_start.frames=-1: expected a whole number >= 0"),
        (config(critic_frames=1.5), "warm_start.critic_frames=1.5: expected a whole number >= 0"),
        (config(None), "warm_start.frames=100: there is no teacher; expected warm_start=imitate"),
        (config("policy", candidates="all"), "warm_start.checkpoint=null: planner=policy needs a checkpoint"),
        (config("policy", checkpoint="nowhere", candidates="all"), "nowhere"),
    ],
)
def test_bad_settings_are_refused(cfg, message):
    env = PickPlaceEnv(num_envs=1)
    with pytest.raises(ValueError, match=message):
        warm_start(cfg, model("footprint", env), env)


def test_results_name_the_teacher():
    assert imitated_planner({"warm_start": OmegaConf.to_container(config())}) == "JointDBL"
    assert imitated_planner({"warm_start": OmegaConf.to_container(config(None, 0, 0))}) is None
    assert imitated_planner({}) is None
