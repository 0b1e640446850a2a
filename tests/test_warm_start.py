"""Warm start: what the teacher is asked, what is learnt of it, and when."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace import PickPlaceEnv
from pickplace.planners import JointDBL, RandomFeasible
from pickplace.policies import actors
from pickplace.runs.provenance import imitated_planner
from pickplace.task import items
from pickplace.training.imitation import Phase, WarmStart, imitation_loss

MODELS = {
    "outcome": lambda rules: actors.fcn_grasp(rules, mask_infeasible=True, filters=8, hidden=8),
    "grasp": lambda rules: actors.fcn_grasp(rules, mask_infeasible=False, filters=8, hidden=8),
    "flat": lambda rules: actors.fcn4d(rules, mask_infeasible=False, filters=4),
    "individual": lambda rules: actors.individual_rl(rules, mask_infeasible=False, filters=4),
    "individual_grasp": lambda rules: actors.individual_grasp(rules, mask_infeasible=False, filters=8, hidden=8),
    "individual_outcome": lambda rules: actors.individual_grasp(rules, mask_infeasible=True, filters=8, hidden=8),
}


def config(teacher="joint_dbl", frames=100, critic_frames=50, checkpoint=None, **teacher_settings):
    """A config of the group warm_start."""
    teacher = teacher and {"_target_": teacher, **teacher_settings}
    return OmegaConf.create(
        {"teacher": teacher, "checkpoint": checkpoint, "frames": frames, "critic_frames": critic_frames}
    )


def random_states(count, seed, **env):
    """An environment's rules, and observations in the middle of random episodes, with every mask."""
    env = PickPlaceEnv(num_envs=count, masks=("outcome", "action"), seed=seed, **env)
    planner = RandomFeasible(env.rules, seed)
    td = env.reset()
    for _ in range(6):
        _, td = env.step_and_maybe_reset(td.set("action", planner.decide(td)))
    return env, td


def heights_after(env, td, action):
    """What an action leaves in the tote, and its failure."""
    step = env.rules.apply(env.heights, env.tote_height, env.current_item, action)
    return step.heights, step.failure


@settings(max_examples=20)
@given(
    model=st.sampled_from(["outcome", "grasp", "flat"]),
    rotations=st.integers(1, 4),
    effector=st.sampled_from([(3, 3), (2, 3)]),
    seed=st.integers(0, 1000),
)
def test_the_choice_of_an_action_does_the_same(model, rotations, effector, seed):
    env, td = random_states(16, seed, rotations=rotations, effector_size=effector)
    policy = MODELS[model](env.rules)
    action = RandomFeasible(env.rules, seed + 1).decide(td)
    maps = td["bin_depth"], td["tote_depth"], td["tote_height"][:, 0]
    choice = policy.to_choice(action, *maps)
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        with set_exploration_type(kind):
            own = policy.to_action(choice, *maps)
        (expected, _), (got, failure) = heights_after(env, td, action), heights_after(env, td, own)
        assert torch.equal(expected, got) and not failure.any()


def test_a_pick_that_misses_is_the_choice_to_miss():
    env, td = random_states(8, 0)
    policy = MODELS["grasp"](env.rules)
    # The item is 2 cells long at most: with the effector at the far corner from it, it is missed.
    x = torch.where(env.current_item.x >= 2, 0, 4)
    action = (x * 5 + torch.where(env.current_item.y >= 2, 0, 4)) * 36 * 4
    choice = policy.to_choice(action, td["bin_depth"])
    assert torch.equal(choice == policy.classes * 36, heights_after(env, td, action)[1] == 1)
    assert (choice == policy.classes * 36).any()


@pytest.mark.parametrize("model", MODELS)
def test_what_is_taught_can_be_done_and_is_what_the_teacher_does(model):
    env, td = random_states(64, 3)
    policy = MODELS[model](env.rules)
    taught = WarmStart(config(), policy, env.rules, env.items, 0).ask(td, 0)
    known = taught >= 0
    assert known.all() if "individual" not in model else 0 < known.sum() < 64
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        own = policy.to_action(taught.clamp(min=0), td["bin_depth"], td["tote_depth"], td["tote_height"][:, 0])
    expected, got = heights_after(env, td, JointDBL(env.rules).decide(td)), heights_after(env, td, own)
    assert torch.equal(expected[0][known], got[0][known])


def test_a_teacher_that_fails_teaches_nothing():
    env, td = random_states(64, 1)
    taught = WarmStart(config("uniform", seed=0), MODELS["flat"](env.rules), env.rules, env.items, 0).ask(td, 0)
    assert (taught >= 0).sum() < 16  # few of all actions are feasible
    chosen = td["action_mask"].gather(1, taught.clamp(min=0)[:, None])[:, 0]
    assert torch.equal(chosen & (taught >= 0), taught >= 0)


def test_a_teacher_that_draws_begins_anew_with_each_iteration():
    env, td = random_states(32, 2)
    start = WarmStart(config("random", seed=0), MODELS["flat"](env.rules), env.rules, env.items, 7)
    assert torch.equal(start.ask(td, 3), start.ask(td, 3))
    assert not torch.equal(start.ask(td, 3), start.ask(td, 4))


def test_imitation_learns_the_teachers_choices():
    env, td = random_states(256, 0)
    policy = MODELS["outcome"](env.rules)
    td["taught"] = WarmStart(config(), policy, env.rules, env.items, 0).ask(td, 0)
    td["taught"][:16] = -1  # where there is no answer, nothing is learnt
    before, agreed = imitation_loss(policy, td)
    by_hand = policy(td["bin_depth"], td["tote_depth"], td["outcome_mask"]).log_softmax(-1)
    by_hand = by_hand[torch.arange(16, 256), td["taught"][16:]]
    torch.testing.assert_close(before, -by_hand.mean())
    optimizer = torch.optim.Adam(policy.parameters(), 1e-2)
    for _ in range(60):
        optimizer.zero_grad()
        loss, now_agreed = imitation_loss(policy, td)
        loss.backward()
        optimizer.step()
    assert loss < before / 2 and now_agreed > 0.7 > agreed


def test_nothing_taught_is_no_gradient():
    env, td = random_states(8, 0)
    policy = MODELS["outcome"](env.rules)
    td["taught"] = torch.full((8,), -1)
    loss, agreed = imitation_loss(policy, td)
    loss.backward()
    assert loss == 0 and agreed == 0
    assert all(not p.grad.any() for p in policy.parameters() if p.grad is not None)


def test_phases_follow_each_other():
    env, _ = random_states(1, 0)
    start = WarmStart(config(frames=100, critic_frames=50), MODELS["outcome"](env.rules), env.rules, env.items, 0)
    phases = [start.phase(frames) for frames in (0, 99, 100, 149, 150)]
    assert phases == [Phase.IMITATION, Phase.IMITATION, Phase.CRITIC, Phase.CRITIC, Phase.REWARD]
    none = WarmStart(config(None, 0, 0), MODELS["outcome"](env.rules), env.rules, env.items, 0)
    assert none.phase(0) == Phase.REWARD


def test_a_trained_policy_teaches():
    env, td = random_states(32, 5)
    cfg = config("policy", checkpoint="pretrained/r4", candidates="all")
    start = WarmStart(cfg, MODELS["grasp"](env.rules), env.rules, env.items, 0)
    assert (start.ask(td, 0) >= 0).all()


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (config(frames=-1), "warm_start.frames=-1: expected a whole number >= 0"),
        (config(critic_frames=1.5), "warm_start.critic_frames=1.5: expected a whole number >= 0"),
        (config(None), "warm_start.frames=100: nobody to imitate"),
        (config("policy", candidates="all"), "warm_start.checkpoint=null: planner=policy needs a checkpoint"),
        (config("policy", checkpoint="nowhere", candidates="all"), "nowhere"),
    ],
)
def test_bad_settings_are_refused(cfg, message):
    env, _ = random_states(1, 0)
    with pytest.raises(ValueError, match=message):
        WarmStart(cfg, MODELS["outcome"](env.rules), env.rules, items.Kinds([[1, 1, 1]]), 0)


def test_results_say_who_taught():
    assert imitated_planner({"warm_start": OmegaConf.to_container(config())}) == "joint_dbl"
    assert imitated_planner({"warm_start": OmegaConf.to_container(config(None, 0, 0))}) is None
    assert imitated_planner({}) is None  # a run of before there were warm starts
