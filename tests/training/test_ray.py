"""The collector for a Ray cluster, on one of this machine; skipped without Ray."""

import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from pickplace import PickPlaceEnv
from pickplace.common.errors import WorkerDied
from pickplace.runs import checkpoint
from pickplace.runs.loggers import read_csv
from pickplace.training import collectors
from pickplace.training.curriculum.levels import heights
from pickplace.training.curriculum.sample import Current
from pickplace.training.curriculum.transform import ToteHeightCurriculum, push_level


@pytest.fixture(scope="module")
def local_ray():
    """A Ray of this machine, which the collectors find and leave running."""
    ray = pytest.importorskip("ray")
    path = {"env_vars": {"PYTHONPATH": str(Path(__file__).parent)}}  # the workers import from the tests, too
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="warning", runtime_env=path)
    yield ray
    ray.shutdown()


def drawing_policy():
    """Draws among the feasible actions, by the generator of its process; takes the first once its weight is 1."""

    class Draw(torch.nn.Module):  # in here, so that workers get the class itself
        def __init__(self):
            super().__init__()
            self.first = torch.nn.Parameter(torch.zeros(1))

        def forward(self, mask):
            drawn = torch.multinomial(mask.float(), 1)[:, 0]
            return torch.where(self.first > 0, mask.int().argmax(-1), drawn)

    return TensorDictModule(Draw(), ["action_mask"], ["action"])


def ray_collector():
    def build(first_episode, num_envs):
        env = PickPlaceEnv(tote_size=(4, 4, 5), num_envs=num_envs)
        return TransformedEnv(env, Compose(ToteHeightCurriculum(3, Current(), heights(1, 5, 5))))

    return collectors.ray(build, drawing_policy(), num_envs=4, rollout_length=6, seed=0)


def test_ray_workers_follow_the_curriculum_go_on_exactly_and_are_missed(local_ray):
    collector = ray_collector()
    batches = iter(collector)
    first = next(batches)
    assert first.shape == (4, 6) and set(first["tote_height"].flatten().tolist()) == {3}
    assert not torch.equal(first["action"][:2], first["action"][2:])  # each worker draws its own
    push_level(collector, 5)
    saved = checkpoint.unflatten(*checkpoint.flatten(collector.state_dict()))
    batch = next(batches)
    assert set(batch["tote_height"].flatten().tolist()) == {3, 5}  # episodes that had begun keep their height
    weights = TensorDict.from_module(collector.policy).data.clone()
    collector.update_policy_weights_(weights.apply(torch.ones_like))
    latest = next(batches)
    assert torch.equal(latest["action"], latest["action_mask"].int().argmax(-1))
    local_ray.kill(collector.remote_collectors[0])
    with pytest.raises(WorkerDied, match="a Ray worker of the collector has died"):
        next(batches)
    collector.shutdown()

    collector = ray_collector()
    collector.load_state_dict(checkpoint.matching_state(saved, collector.state_dict(), "collector"))
    again = next(iter(collector))
    collector.shutdown()
    for key in ("action", "tote_height", ("next", "reward"), ("next", "done")):
        assert torch.equal(batch[key], again[key]), key


def test_a_training_collects_with_ray(smoke, local_ray, tmp_path):
    overrides = ["env.tote_size=[5,5,3]", "curriculum=mixture", "curriculum.advance.occupancy=0.3"]
    smoke(tmp_path / "run", "collector=ray", "total_frames=512", "curriculum.advance.window=10", *overrides)
    rows = read_csv(tmp_path / "run" / "metrics.csv")
    assert [row["frames"] for row in rows] == [128, 256, 384, 512]
    assert rows[0]["curriculum/level"] == 1 < rows[-1]["curriculum/level"]
    assert "curriculum/occupancy_at_2" in rows[-1]  # the workers have followed


def test_a_missing_ray_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match="ray is missing; pip install"):
        collectors.ray(None, torch.nn.Linear(1, 1), num_envs=4, rollout_length=1, seed=0)
