"""The promises of docs/determinism.md that no other test keeps."""

import shutil

import pytest
import torch
from commands import after_batch, assert_same, evaluated
from omegaconf import OmegaConf
from torch import nn

from pickplace import PickPlaceEnv, Planner, Scene
from pickplace.config.allowlist import trusted_config
from pickplace.evaluation.play import RESULTS, play
from pickplace.planners.heuristics import RandomFeasible
from pickplace.planners.lookahead import Lookahead
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.base import MASKED, ActionPolicy
from pickplace.policies.restore import restore_policy
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.runs.loggers import read_csv
from pickplace.training.train import resume_run


def test_the_same_training_twice(smoke, tmp_path, no_report):
    """For PPO see test_resume: a run that is killed equals one that is not."""
    settings = ["algo=a2c", "curriculum=mixture", "warm_start=imitate", "planner@warm_start.teacher=random"]
    quick = ["total_frames=384", "warm_start.frames=128", "evaluation.episodes=2", "seed=3"]
    for name in "ab":
        smoke(tmp_path / name, *quick, *settings)
    assert_same(tmp_path / "a", tmp_path / "b")


def test_the_number_of_validations_changes_nothing_that_is_trained(smoke, tmp_path, no_report):
    """Without an interval there are 20."""
    small = [
        "env.num_envs=4",
        "rollout_length=4",
        "algo.minibatch_size=16",
        "evaluation.episodes=1",
        "curriculum=mixture",
    ]
    trained = {}
    for name, interval in (("often", "null"), ("once", 400)):
        smoke(tmp_path / name, *small, f"evaluation_interval={interval}", "total_frames=400", "checkpoint_interval=400")
        tensors = checkpoint.flatten(checkpoint.read(tmp_path / name / "checkpoints/last")[0])[0]
        rows = read_csv(tmp_path / name / "metrics.csv")
        metrics = [{key: row[key] for key in row if key.partition("/")[0] not in ("eval", "time")} for row in rows]
        trained[name] = {key: value.tolist() for key, value in tensors.items()}, metrics
        assert sum("eval/occupancy" in row for row in rows) == {"often": 20, "once": 1}[name]
    assert trained["often"] == trained["once"]


class Noisy(ActionPolicy):
    """Scores with dropout, and with a mean of all that it saw in training."""

    def __init__(self, cell, mask_infeasible, rate=0.5):
        super().__init__(cell, mask_infeasible)
        self.network = nn.Sequential(nn.Linear(cell.num_places, cell.num_actions), nn.Dropout(rate))
        self.frozen = nn.Dropout().eval()
        self.register_buffer("mean", torch.zeros(cell.num_places))
        self.register_buffer("calls", torch.tensor(0))

    def action_scores(self, observation, mask=None):
        depth = observation["tote_depth"].flatten(1)
        if self.training:
            self.calls += 1
            self.mean += (depth.mean(0) - self.mean) / self.calls
        scores = self.network(depth - self.mean)
        return scores if mask is None else torch.where(mask, scores, MASKED)


NOISY = [
    "~model.actor", "+model.actor={_target_: test_determinism.Noisy}", "~model.critic",
    "+model.critic={_target_: pooled, filters: 8, hidden: 8}", "total_frames=512", "checkpoint_interval=128",
]  # fmt: skip


def test_a_policy_with_dropout_and_running_means_resumes_exactly(smoke, tmp_path, no_report):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    with after_batch(2, lambda _: shutil.copytree(whole, killed)):
        smoke(whole, *NOISY)
    resume_run([f"resume={killed}", "trust=test_determinism"])
    assert_same(whole, killed)


def test_a_validation_plays_what_an_evaluation_plays(smoke, tmp_path, no_report):
    """Without dropout, and without learning means of what it sees. What the policy itself has frozen stays so."""
    found = []

    def validate(trainer):
        calls = int(trainer.policy.calls)
        found.extend(trainer.validate().occupancy.tolist() for _ in range(2))
        assert calls == int(trainer.policy.calls) and trainer.policy.network.training
        assert not trainer.policy.frozen.training

    with after_batch(4, validate):
        smoke(tmp_path / "run", *NOISY)
    given = ["evaluation.stream=validation", "evaluation.episodes=8", "threads=1", "trust=test_determinism"]
    last = f"checkpoint={tmp_path}/run/checkpoints/last"
    played = evaluated(tmp_path / "played", last, *given)["occupancy"]["per_episode"]
    assert found[0] == found[1] == pytest.approx(played)


def make_env(first, count):
    return PickPlaceEnv(tote_size=(4, 4, 1), num_envs=count, stream="test", first_episode=first, masks=())


def test_the_same_evaluation_twice_and_a_policy_s_in_any_batch():
    """For mcts see test_mcts."""
    env = make_env(0, 1)
    state, facts = checkpoint.read(locate("pretrained/r4"))
    cfg = trusted_config(facts["config"])
    policy = restore_policy(cfg, env.cell, state["policy"], OmegaConf.to_container(cfg.env, resolve=True))
    policy_planner = PolicyPlanner(env.cell, policy)
    for make_planner, episodes, *batch_sizes in (
        (lambda: RandomFeasible(env.cell), 4, 4, 4),
        (lambda: Lookahead(env.cell, policy, env.items, samples=2, rounds=1), 2, 2, 2),
        # Without AVX-512, sums of floats depend on the batch, and so does which of two equal footprints wins.
        (lambda: policy_planner, 8, *((1, 3) if torch.backends.cpu.get_cpu_capability() == "AVX512" else (8,)), 8),
    ):
        first, *others = (play(make_env, make_planner(), episodes, batch_size) for batch_size in batch_sizes)
        for other in others:
            assert all(torch.equal(getattr(first, name), getattr(other, name)) for name in RESULTS)


def test_a_plan_depends_on_its_own_maps_alone():
    generator, maps = torch.Generator().manual_seed(0), []
    for w, d in 3 * [(1, 1), (2, 1), (1, 2), (2, 2)]:
        item = torch.zeros(5, 5)
        item[1 : 1 + w, 2 : 2 + d] = 1
        maps.append((item, torch.randint(0, 6, (6, 6), generator=generator)))
    planner = Planner.load("pretrained/r4")
    forwards = [planner.plan(Scene.from_maps(*pair)) for pair in maps]
    torch.manual_seed(99)
    assert forwards == [planner.plan(Scene.from_maps(*pair)) for pair in reversed(maps)][::-1]
