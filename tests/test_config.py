"""Every config file composes and instantiates, every preset runs, and overrides on saved configs do what they say."""

import hydra
import pytest
import torch
from hydra import compose, initialize_config_dir
from torchrl.modules import ValueOperator

from pickplace import PickPlaceEnv
from pickplace.policies.actors import as_collection_policy, fcn_grasp
from pickplace.policies.networks.critics import Conv4dCritic, PooledCritic
from pickplace.runs import hydra_app as config
from pickplace.runs.loggers import read_csv
from pickplace.runs.registry import build
from pickplace.task.items import ItemDistribution
from pickplace.training.curriculum import Curriculum
from pickplace.training.train import make_losses, train

CONF = config.conf_dir()
TINY = [
    "env.num_envs=4", "algo.rollout_length=4", "algo.minibatch_size=8", "algo.epochs=1", "total_frames=32",
    "evaluation.episodes=2", "evaluation_interval=16", "checkpoint_interval=16", "progress_interval=16",
    "env.tote_size=[6,6,2]", "model.actor.filters=8", "model.critic.filters=8", "model.critic.hidden=8", "threads=1",
]  # fmt: skip


def options(group):
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def composed(*overrides, name="train"):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, list(overrides))


@pytest.mark.parametrize("name", options("env"))
def test_every_env(name):
    cfg = composed(f"env={name}")
    env = build("env", cfg.env, items=build("items", cfg["items"]), num_envs=2)
    assert isinstance(env, PickPlaceEnv)
    assert env.reset()["action_mask"].any(1).all()


@pytest.mark.parametrize("name", options("items"))
def test_every_item_distribution(name, tmp_path):
    table = tmp_path / "items.csv"
    table.write_text("w,d,h\n1,1,1\n2,1,1\n")
    cfg = composed(f"items={name}", *([f"items.path={table}"] if name == "recorded" else []))
    assert isinstance(build("items", cfg["items"]), ItemDistribution)


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("name", options("model"))
def test_every_model(name, masked):
    cfg, rules = composed(f"model={name}"), PickPlaceEnv(num_envs=1).rules
    policy = build("model.actor", cfg.model.actor, rules=rules, mask_infeasible=masked)
    assert policy.mask_infeasible is masked
    assert isinstance(build("model.critic", cfg.model.critic, rules=rules), Conv4dCritic | PooledCritic)


@pytest.mark.parametrize("name", options("curriculum"))
def test_every_curriculum(name):
    assert isinstance(build("curriculum", composed(f"curriculum={name}").curriculum), Curriculum)


@pytest.mark.parametrize("name", options("logger"))
def test_every_logger(name, tmp_path):
    if name not in ("csv", "none"):
        pytest.importorskip(name)
    logger = build("logger", composed(f"logger={name}").logger, folder=tmp_path, frames=0)
    logger.log({"train/occupancy": 0.5}, 10)
    logger.close()
    kept = read_csv(tmp_path / "metrics.csv") if name != "none" else []
    assert kept == [{"frames": 10, "train/occupancy": 0.5}][: name != "none"]


@pytest.mark.parametrize("name", options("planner"))
def test_every_planner(name):
    env = PickPlaceEnv(num_envs=3)
    quick = {"mcts": ["planner.simulations=20"], "lookahead": ["planner.samples=2", "planner.rounds=1"]}
    cfg, kwargs = composed(f"planner={name}", *quick.get(name, []), name="evaluate"), {}
    if name in ("mcts", "lookahead"):
        kwargs["items"] = env.items
    if name in ("policy", "lookahead"):
        model = composed().model.actor
        kwargs["policy"] = build("model.actor", model, rules=env.rules, mask_infeasible=True)
    observation = env.reset()
    action = build("planner", cfg.planner, rules=env.rules, **kwargs).decide(observation)
    assert ((action >= 0) & (action < env.rules.num_actions)).all()
    if name not in ("uniform", "individual_heuristic", "mcts"):
        assert observation["action_mask"].gather(1, action[:, None]).all()


@pytest.mark.parametrize("group", ["algo", "collector", "evaluation"])
def test_every_other_group(group):
    for name in options(group):
        cfg = composed(f"{group}={name}")
        for target in [value for key, value in cfg[group].items() if key == "_target_"]:
            assert callable(hydra.utils.get_object(target))


@pytest.mark.parametrize("name", options("experiment"))
def test_every_preset_runs(name, tmp_path):
    extra = {"smoke": ["env.tote_size=[4,4,1]"], "mixed": ["env.tote_size=[7,7,3]"]}.get(name, [])
    occupancy = train(composed(f"experiment={name}", *TINY, *extra), tmp_path)
    assert 0 <= occupancy <= 1
    assert [row["frames"] for row in read_csv(tmp_path / "metrics.csv")] == [16, 32]
    assert {path.name for path in tmp_path.iterdir()} == {
        ".lock",
        "checkpoints",
        "learning_curve.png",
        "metrics.csv",
        "report.html",
    }


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("model", options("model"))
def test_every_model_trains_with_and_without_a_mask(model, masked, tmp_path):
    overrides = [f"model={model}", f"algo.mask_infeasible={masked}", "curriculum=none", *TINY, "env.rotations=3"]
    assert 0 <= train(composed(*overrides), tmp_path) <= 1


@pytest.mark.parametrize("name", [*options("planner"), "none"])
def test_any_planner_can_be_imitated(name, tmp_path):
    settings = {
        "mcts": ["warm_start.teacher.simulations=20"],
        "lookahead": ["warm_start.teacher.samples=2", "warm_start.teacher.rounds=1"],
    }
    follows = ["warm_start.checkpoint=pretrained/r4"] if name in ("policy", "lookahead") else []
    phases = [f"warm_start.{key}=16" for key in ("frames", "critic_frames")] if name != "none" else []
    overrides = [f"warm_start={name}", *settings.get(name, []), *follows, *phases, *TINY]
    cfg = composed("curriculum=none", *overrides, "total_frames=48")
    assert 0 <= train(cfg, tmp_path) <= 1
    rows = read_csv(tmp_path / "metrics.csv")
    assert ["train/agreement" in row for row in rows] == [name != "none", False, False]


def test_a2c_trains_through_the_same_loop(tmp_path):
    cfg = composed("algo=a2c", "model=fcn_grasp", "curriculum=none", *TINY)
    assert 0 <= train(cfg, tmp_path) <= 1
    assert (cfg.algo.loss, cfg.algo.gamma) == ("a2c", composed().algo.gamma)


def test_ppo_begins_where_a2c_is():
    """At the policy that collected the data the ratio is 1, and the clipped objective has the gradient of A2C's."""
    env = PickPlaceEnv(num_envs=16, masks=("outcome",))
    policy = fcn_grasp(env.rules, True, head_std=1.0)
    critic = ValueOperator(PooledCritic(), ["bin_depth", "tote_depth"])
    with torch.no_grad():
        data = env.rollout(4, as_collection_policy(policy), break_when_any_done=False).reshape(-1)
    gradients = {}
    for algo in ("ppo", "a2c"):
        cfg = composed(f"algo={algo}", "algo.normalize_advantage=false").algo
        advantage, loss = make_losses(cfg, policy, critic)
        with torch.no_grad():
            advantage(data)
        policy.zero_grad()
        loss(data)["loss_objective"].backward()
        gradients[algo] = torch.cat(
            [parameter.grad.flatten() for parameter in loss.parameters() if parameter.grad is not None]
        )
    assert gradients["ppo"].abs().max() > 0
    torch.testing.assert_close(gradients["ppo"], gradients["a2c"])


def test_presets_change_the_training_config():
    assert composed("experiment=smoke").total_frames == 512
    assert composed("experiment=quick", "total_frames=7").total_frames == 7
    paper = composed("experiment=paper")
    assert (paper.algo.lr, paper.algo.gamma, paper.algo.rollout_length, paper.env.num_envs) == (2.5e-4, 0.99, 32, 16)
    assert (paper.algo.critic_coeff, paper.algo.entropy_coeff, paper.algo.mask_infeasible) == (0.005, 0.002, False)
    assert paper.curriculum.advance.frames_per_level == 5_000_000


def test_a_preset_combines_with_any_curriculum():
    for name in options("curriculum"):
        composed("experiment=quick", "env.tote_size=[6,6,10]", f"curriculum={name}", "algo.gamma=0.97", "seed=3")


def test_overrides_on_a_saved_config():
    saved = composed("experiment=smoke")
    changed = config.apply_overrides(saved, ["algo.gamma=0.9", "total_frames=99", "env.tote_size=[7,7,2]"])
    assert (changed.algo.gamma, changed.total_frames, changed.env.tote_size) == (0.9, 99, [7, 7, 2])
    assert saved.algo.gamma == 0.99
    other = composed("items=tall")["items"]
    swapped = config.apply_overrides(saved, ["items=tall", "items.height=[1,2]"], {"items": other})
    assert swapped["items"].height == [1, 2]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo.gama=0.9", "there is no key 'gama' in algo; did you mean 'gamma'?"),
        ("curriculum=paper", "the checkpoint's config group 'curriculum' cannot be exchanged"),
        ("curriculum/advance=frames", "cannot be exchanged"),
        ("nothing.at.all=1", "there is no key 'nothing' in the config"),
    ],
)
def test_refused_overrides_on_a_saved_config(override, message):
    with pytest.raises(ValueError) as error:
        config.apply_overrides(composed("experiment=smoke"), [override])
    assert message in str(error.value)


@pytest.mark.parametrize("part", ["advance", "sample"])
@pytest.mark.parametrize("composition", options("curriculum"))
def test_the_parts_of_every_curriculum_can_be_exchanged(composition, part):
    for name in options(f"curriculum/{part}"):
        cfg = composed(f"curriculum={composition}", f"curriculum/{part}={name}")
        build("curriculum", cfg.curriculum).setup(1, 5, 10**9)
