"""Height samplers, and the transform that writes tote heights into resets, in one process and in several."""

import multiprocessing

import commands  # noqa: F401, its preloaded processes start fast
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from pickplace import CellSpec, PickPlaceEnv
from pickplace.items.distributions import Kinds
from pickplace.training import collectors
from pickplace.training.curriculum import levels
from pickplace.training.curriculum.advance import NoAdvance
from pickplace.training.curriculum.curriculum import Curriculum
from pickplace.training.curriculum.sample import Current, Recent, Uniform
from pickplace.training.curriculum.transform import ToteHeightCurriculum, push_level

SAMPLERS = [  # shares of the heights 2 to 5, at level 5
    (Current(), [0, 0, 0, 1]), (Uniform(), [1 / 4] * 4), (Recent(0.25), [1 / 12] * 3 + [3 / 4]),
    (Recent(0.9), [3 / 10] * 3 + [1 / 10]), (Recent(0.0), [0, 0, 0, 1]),
]  # fmt: skip


@pytest.mark.parametrize(("sampler", "shares"), SAMPLERS)
def test_samplers_draw_each_height_with_its_share(sampler, shares):
    torch.manual_seed(0)
    heights = sampler(5, 2, 12_000)
    assert heights.dtype == torch.int64 and sampler(3, 3, 100).tolist() == [3] * 100
    assert heights.bincount(minlength=7).tolist() == pytest.approx([0, 0, *(12_000 * s for s in shares), 0], rel=0.1)
    torch.manual_seed(0)  # the global generator's, which checkpoints store
    assert torch.equal(heights, sampler(5, 2, 12_000))


def make_env(level=3, sampler=None, num_envs=6, **settings):
    curriculum = Curriculum(NoAdvance(), sampler or Current())
    curriculum.setup(CellSpec(tote_size=(4, 4, level)), Kinds([(1, 1, 1)]), 1000)
    env = PickPlaceEnv(tote_size=(4, 4, 5), num_envs=num_envs, **settings)
    any_height = levels.heights(curriculum.start, 5, 5)
    transform = ToteHeightCurriculum(curriculum.level, curriculum.sample, any_height)
    return TransformedEnv(env, Compose(transform, RewardSum(), StepCounter()))


def heights(td):
    return td["tote_height"].squeeze(-1).tolist()


@pytest.mark.parametrize("drawn", [torch.ones(5).long(), torch.ones(6), [1] * 6], ids=["few", "floats", "list"])
def test_a_sampler_that_returns_something_else_is_named(drawn):
    message = r"curriculum.sample: its levels=.*: expected whole numbers between 1 and 5 in a tensor \[6\]"
    with pytest.raises(ValueError, match=message):
        make_env(sampler=lambda level, least, count: drawn).reset()


def test_a_reset_gets_the_level_and_the_env_plays_at_it():
    env = make_env(level=3)
    check_env_specs(make_env(sampler=Uniform()))
    td = env.reset()
    assert heights(td) == [3] * 6 and td["tote_height"].dtype == torch.int64
    assert (td["tote_depth"] == 3).all()
    assert set(heights(make_env(sampler=Uniform(), num_envs=64).reset())) == {1, 2, 3}
    env.transform[0].set_level(4)
    for observation in (env.reset(), env.reset(TensorDict(batch_size=[6])), env.reset(td)):
        assert heights(observation) == [4] * 6  # whatever lies in the TensorDict
    with pytest.raises(ValueError, match="level=0: .* >= 1"):
        env.transform[0].set_level(0)
    restored = make_env(level=2)
    restored.load_state_dict(env.state_dict())
    assert heights(restored.reset()) == [4] * 6


@pytest.mark.parametrize("hidden", [False, True], ids=["whole", "select_reset_only"])
def test_a_partial_reset_leaves_running_episodes_their_height(hidden):
    env = make_env(level=3)
    td = env.reset()
    env.transform[0].set_level(5)
    mask = torch.tensor([1, 0, 0, 1, 0, 0]).bool()
    td = env.reset(td.set("_reset", mask[:, None]), select_reset_only=hidden)
    assert heights(td) == td["tote_depth"][:, 0, 0].tolist() == [5, 3, 3, 5, 3, 3]
    # The environment ignores rows that are not reset, so look at what the transform gives it.
    td = TensorDict(_reset=torch.tensor([[True], [False]]), tote_height=torch.tensor([[4], [4]]), batch_size=[2])
    assert heights(make_env(level=2).transform[0]._reset_env_preprocess(td)) == [2, 4]


@pytest.fixture
def forkserver():
    """Make TorchRL's workers children of the forkserver of ``commands``, which saves seconds."""
    method = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("forkserver", force=True)
    yield
    multiprocessing.set_start_method(method, force=True)


def slots(first, count):
    return make_env(num_envs=count, first_episode=first)


def fail(mask):
    """Return infeasible actions: every episode lasts one step."""
    return (~mask).int().argmax(-1)


@pytest.mark.parametrize("kind", ["single", "multi_sync"])
def test_push_level_reaches_every_process_which_has_its_own_slots(kind, forkserver):
    policy = TensorDictModule(fail, ["action_mask"], ["action"])
    collector = getattr(collectors, kind)(slots, policy, num_envs=4, rollout_length=6, seed=0)
    try:
        if kind == "multi_sync":
            workers = [state for name, state in collector.state_dict().items() if name.startswith("worker")]
            assert [worker["environment"]["episode"].tolist() for worker in workers] == [[0, 1], [2, 3]]
        batches = iter(collector)
        assert set(next(batches)["tote_height"].flatten().tolist()) == {3}
        push_level(collector, 5)
        batch = next(batches)
        for part in (batch, batch["next"]):  # episodes that had begun keep their height, and report it when they end
            assert part["tote_height"][:, 0].flatten().tolist() == [3] * 4
        assert set(batch["tote_height"][:, 1:].flatten().tolist()) == {5}
    finally:
        collector.shutdown()
