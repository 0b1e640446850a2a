"""Bad values of every setting: each value works, or is refused in one short sentence that names its key."""

import copy
import functools
import math
import time
from contextlib import contextmanager
from itertools import product
from operator import getitem

import pytest
import torch
from commands import composed
from omegaconf import OmegaConf

from pickplace import CellSpec, PickPlaceEnv, Planner
from pickplace.common import errors
from pickplace.common import validate as checks
from pickplace.common.validate import excerpt
from pickplace.config.allowlist import MAX_DEPTH, MAX_NODES, MAX_TEXT, saved_form, trusted_config
from pickplace.config.composition import apply_overrides
from pickplace.config.registry import build
from pickplace.evaluation.evaluate import prepare
from pickplace.items.distributions import Kinds, Uniform
from pickplace.policies.fcn_grasp import network as footprint_fcn
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules.masks import placing_maps
from pickplace.rules.state import State
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.runs.resume import checkpoint_config
from pickplace.training import trainer
from pickplace.training.settings import check_settings
from pickplace.training.trainer import Trainer

VALUES = [None, True, "x", -1, 0, 1.5, math.inf, math.nan, 10**20, [], {}, [1, 2], "y" * 100_000]

#: Large groups. Their form in a checkpoint is not checked: the smaller groups have the same form.
LARGE_GROUPS = ("algo", "env", "items", "model")

#: Trainings that together have most leaves of ``conf/``; the keys name the groups that each one tests.
TRAININGS = {
    "env": [],
    "algo": [],
    "algo sampled": ["algo=sampled_ppo"],
    "evaluation": [],
    "items": [],
    "items mixed": ["items=mixed", "env.tote_size=[4,4,3]"],
    "items cut": ["items=cut2", "items.container=[4,4,3]", "items.sides=[1,2]", "env.tote_size=[4,4,3]"],
    "items published": ["items=published", "items.drawn={_target_:uniform}", "env.tote_size=[4,4,3]"],
    "model": [],
    "model fcn4d": ["model=fcn4d", "~model.actor.hidden", "env.tote_size=[5,5,3]"],
    "warm_start": ["warm_start=imitate", "warm_start.frames=128"],
    "planner": [],
    "curriculum threshold": ["curriculum/advance=threshold"],
    "curriculum plateau": ["curriculum=mixture", "curriculum/advance=plateau"],
    "curriculum staged": ["curriculum/advance=staged", "env.tote_size=[4,4,3]"],
    "curriculum frames": ["curriculum/advance=frames"],
    "callbacks": ["callbacks=early_stopping"],
    "collector": [],
    "logger": [],
    "seed total_frames device threads evaluation_interval checkpoint_interval progress_interval": [],
}


def resolved_config(*words, name="train"):
    """The config of a command line, without references."""
    return OmegaConf.create(OmegaConf.to_container(composed(*words, name=name), resolve=True))


def leaves(node, path=()):
    """The paths of all values, and of all parts that hold values."""
    if path:
        yield path
    for key, value in node.items() if OmegaConf.is_dict(node) else ():
        yield from leaves(value, (*path, key))


@contextmanager
def changed(cfg, path, value):
    """Put a value into a config for a while."""
    *parents, key = path
    node = functools.reduce(getitem, parents, cfg)
    before = node[key]
    node[key] = value
    yield
    node[key] = before


def share_parts(monkeypatch, tested):
    """Let trainers share the parts that the tested groups do not change, and make no collector, which is slow."""
    envs, networks, restored = {}, {}, Trainer._restored

    def build_once(place, node, **given):
        if place == "env" and not {"env", "items"} & set(tested):
            if given["masks"] not in envs:
                envs[given["masks"]] = build(place, node, **given)
            return envs[given["masks"]]
        return None if place == "collector" else build(place, node, **given)

    def restored_once(self, key, *given):
        if key not in networks or {"env", "items", "model"} & set(tested):
            networks[key] = restored(self, key, *given)
        return networks[key]

    monkeypatch.setattr(trainer, "build", build_once)
    monkeypatch.setattr(Trainer, "_restored", restored_once)
    saved_part = [key for key in tested if key not in LARGE_GROUPS]

    def saved(cfg):
        return checkpoint_config(OmegaConf.masked_copy(cfg, saved_part)) if saved_part else ({}, "")

    monkeypatch.setattr(trainer, "checkpoint_config", saved)


def check_sentence(error, key):
    text = str(error)
    assert key in text and len(text) < 500 and "\n" not in text, text
    assert not any(word in text for word in ("Traceback", "object is not", "unsupported operand")), text


@pytest.mark.parametrize("name", TRAININGS)
def test_every_leaf_of_a_training(name, tmp_path, monkeypatch):
    torch.set_num_threads(1)
    cfg = resolved_config("experiment=smoke", "threads=1", *TRAININGS[name])
    tested = [key for key in cfg if key in name.split()]
    share_parts(monkeypatch, tested)
    for path, value in product(leaves(OmegaConf.masked_copy(cfg, tested)), VALUES):
        started = time.perf_counter()
        with changed(cfg, path, value):
            try:
                if path[0] == "curriculum":
                    check_settings(cfg)
                    build("curriculum", cfg.curriculum).setup(CellSpec(tote_size=(6, 6, 3)), Kinds([(1, 1, 1)]), 512)
                    continue
                Trainer(cfg, tmp_path)
                if path[0] == "logger":
                    build("logger", cfg.logger, folder=tmp_path, frames=0, settings={}).close()
            except ValueError as error:
                check_sentence(error, str(path[-1]))
            except Exception as error:
                raise AssertionError(f"{'.'.join(path)}={excerpt(value)}: {error!r}") from error
        assert time.perf_counter() - started < 20


@pytest.mark.parametrize(
    ("name", "group"),
    [("joint_dbl", "evaluation")]
    + [(name, "planner") for name in ("corner", "individual_heuristic", "joint_dbl", "mcts", "random", "uniform")],
)
def test_every_leaf_of_an_evaluation(name, group):
    cfg = resolved_config(f"planner={name}", "device=cpu", name="evaluate")
    for path, value in product(leaves(OmegaConf.masked_copy(cfg, [group])), VALUES):
        if path in (("planner",), ("evaluation",)) or path[-1] in ("replay", "gif"):  # checked by the command
            continue
        with changed(cfg, path, value):
            try:
                prepare(cfg)
            except ValueError as error:
                check_sentence(error, path[-1])


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize(
    "key", ["num_envs", "seed", "stream", "masks", "first_episode", "episode_stride", "device", "items", "observation"]
)
def test_every_argument_of_the_environment(key, value):
    if key in ("items", "observation", "episode_stride") and value is None:
        return
    if (key, value) in (("seed", 0), ("first_episode", 0), ("masks", []), ("observation", {})):
        PickPlaceEnv(**{"num_envs": 1, key: value}).reset()
        return
    with pytest.raises(ValueError, match=f"^{key}") as caught:
        PickPlaceEnv(**{"num_envs": 1, key: value})
    check_sentence(caught.value, key)


LARGE_FCN4D = "model=fcn4d model.mask_infeasible=false env.bin_size=[30,30,1] env.tote_size=[30,30,2]"

#: Settings that are valid one by one but not together, or that would fill the memory; and words of the refusal.
LARGE = [
    ("env.bin_size=[3000,3000,1]", "bin_size=.*<= 2,000"),
    ("env.bin_size=[1999,1999,1]", "the bin has 3,996,001 cells"),
    ("env.tote_size=[1000,1000,1]", "the tote has 1,000,000 cells"),
    ("env.bin_size=[200,200,1] env.tote_size=[200,200,5]", "bin_size=.*tote_size=.*the cell has 6,400,000,000 actions"),
    ("env.gripper.size=[2000,2000]", "gripper.size=.*<= 64"),
    ("env.gripper.size=[64,64] env.tote_size=[100,100,5] env.rotations=1", "env.num_envs=256.*: .* GB"),
    (
        "env.bin_size=[250,250,1] env.gripper.size=[10,10] reach=annulus items=mixed items.width=[1,10] "
        "items.depth=[1,10]",
        "bin_size=.* positions in the bin",
    ),
    ("items=mixed items.width=[1,100000] items.depth=[1,100000]", "items.width=.* kinds of items"),
    ("env.num_envs=10000000", "env.num_envs=10000000: .*<= 32,768"),
    ("env.num_envs=32768", "env.num_envs=32768, rollout_length=8: .* GB"),
    ("algo.minibatch_size=1000000 rollout_length=64", "algo.minibatch_size=16384: .* GB"),
    ("rollout_length=1000000", r"rollout_length=1000000: .* GB; expected at most"),
    ("evaluation.batch_size=1000000 evaluation.episodes=1000000", "evaluation.batch_size=1000000: .* GB"),
    ("evaluation.episodes=10000000", "evaluation.episodes=10000000: .*<= 1,000,000"),
    ("model.actor.receptive_field=1001", "model.actor.receptive_field=1001"),
    ("model.actor.receptive_field=61", "model.actor.receptive_field=61, 11 planes: .* inputs"),
    ("model.actor.filters=100000", "model.actor.filters=100000"),
    ("model.actor.tote_clip=99999", "model.actor.tote_clip=99999"),
    ("model.actor.head_std=1e300", "model.actor.head_std"),
    ("model.critic.receptive_field=61", "model.critic.receptive_field=61"),
    ("model=fcn4d model.actor.filters=100000", "model.actor.filters=100000"),
    ("model=fcn4d env.tote_size=[64,64,5] model.critic.hidden=1024", "model.critic: the network has .* parameters"),
    ("model=typical env.tote_size=[30,30,5]", "model.actor: the network has .* parameters"),
    (f"{LARGE_FCN4D} env.num_envs=4 algo.minibatch_size=16", "algo.minibatch_size=16: .* GB"),
    (f"{LARGE_FCN4D} algo.minibatch_size=1", "env.num_envs=256: .* GB"),
    ("collector=multi_sync collector.workers=128", "collector.workers=128: .*<= 64"),
    (f"{LARGE_FCN4D} env.num_envs=4 algo=sampled_ppo algo.samples=9999", "algo.minibatch_size=32: .* GB"),
    ("algo=sampled_ppo algo.samples=0", "algo.samples=0"),
    ("algo=sampled_ppo algo.temperature=0", "algo.temperature=0"),
    ("algo.max_grad_norm=0", "algo.max_grad_norm=0"),
    ("reward_scale=0", "reward_scale=0"),
]


@pytest.mark.parametrize(("words", "message"), LARGE)
def test_what_would_fill_the_memory_is_refused_at_once(words, message, tmp_path):
    values = [word for word in words.split() if "." in word]
    cfg = apply_overrides(composed(*(word for word in words.split() if "." not in word)), values)
    started = time.perf_counter()
    with pytest.raises(ValueError, match=message) as caught:
        Trainer(cfg, tmp_path)
    assert time.perf_counter() - started < 10 and len(str(caught.value)) < 500  # a second, on an idle machine


def test_many_kinds_are_refused():
    with pytest.raises(ValueError, match=r"items.kinds: the list has 300,000 kinds of items; expected at most 100,000"):
        Kinds([[1, 1, 1]] * 300_000)


def test_a_real_cell_and_a_large_batch_are_accepted(tmp_path, monkeypatch):
    """A bin of 60x40 and a tote of 120x80 cells; the paper's cell, as a GPU trains it; and values on a fine grid."""
    sizes = {"bin_size": (60, 40, 20), "tote_size": (120, 80, 60), "effector_size": (12, 8)}
    assert CellSpec(**sizes).num_actions == 92_160_000
    env = PickPlaceEnv(items=Kinds([(4, 3, 2)]), num_envs=2, masks=("footprint",), **sizes)
    assert env.reset()["footprint_mask"].any(1).all()
    large = composed("experiment=quick", "env.num_envs=4096", "rollout_length=32", "threads=1")
    share_parts(monkeypatch, ["env"])
    with pytest.raises(ValueError, match="GB; expected at most 0.8 GB"):
        Trainer(large, tmp_path)
    Trainer(composed("experiment=afterstate", "benchmark=gopt_30", "env.num_envs=128"), tmp_path)
    monkeypatch.setenv(checks.MEMORY_VARIABLE, "40")
    Trainer(large, tmp_path)


HANDED_OVER = [
    ("algo", "policy", None), ("algo", "task", None),
    ("env", "stream", "test"), ("env", "seed", 1), ("env", "first_episode", 5), ("env", "masks", []),
    ("env", "episode_stride", 3), ("env", "device", "cpu"), ("env", "items", None), ("env", "longest_side", 2),
    ("env", "limits", None), ("model.actor", "cell", None), ("model.actor", "mask_infeasible", True),
    ("model.actor", "out_channels", 2), ("model.critic", "cell", None), ("collector", "seed", 1),
    ("collector", "num_envs", 8), ("collector", "workers", 8), ("collector", "make_env", None),
    ("planner", "policy", None), ("planner", "cell", None), ("curriculum", "level", 1), ("items", "seed", 1),
    ("warm_start.teacher", "cell", 1), ("logger", "folder", "/tmp"), ("logger", "frames", 3),
]  # fmt: skip


@pytest.mark.parametrize(("place", "key", "value"), HANDED_OVER)
def test_what_pickplace_hands_over_cannot_be_set(place, key, value, tmp_path):
    """Test the command line and a checkpoint: both are built from a config."""
    cfg = composed("experiment=smoke", "warm_start=imitate", "warm_start.frames=128", "threads=1")
    OmegaConf.set_struct(cfg, False)
    OmegaConf.select(cfg, place)[key] = value
    with pytest.raises(ValueError, match=rf"{place}.*{key}"):
        trainer = Trainer(cfg, tmp_path)
        try:
            data = trainer.build_env(num_envs=2).reset()
            trainer.warm_start.ask(data, 0)
            build("logger", cfg.logger, folder=tmp_path, frames=0, settings={})
        finally:
            trainer.collector.shutdown()


@pytest.mark.parametrize("place", ["env", "items"])
def test_unknown_settings_of_an_evaluation_are_refused(place):
    cfg = composed("planner=joint_dbl", f"+{place}.stream=train", name="evaluate")
    with pytest.raises(ValueError, match=rf"{place}.stream: there is no key 'stream'"):
        prepare(cfg)


@pytest.mark.parametrize("algo", ["a2c", "ppo"])
@pytest.mark.parametrize("zero", ["entropy_coeff", "critic_coeff", "entropy_coeff critic_coeff"])
def test_a_coefficient_of_zero(algo, zero, smoke, no_report, tmp_path):
    words = [f"algo.{key}=0" for key in zero.split()]
    smoke(tmp_path / "run", f"algo={algo}", *words, "total_frames=128", "evaluation.episodes=1")
    rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    row = dict(zip(rows[0].split(","), rows[-1].split(","), strict=True))
    assert float(row["train/entropy"]) > 0  # all are logged
    assert (float(row["train/loss_critic"]) == 0) == ("critic" in zero)


# ---------------------------------------------------------------------- the config of a checkpoint
saved_config = functools.cache(lambda: saved_form(composed("experiment=quick", "warm_start=imitate")))


def content(**values):
    return copy.deepcopy(saved_config()) | values


def nested(depth):
    node = {}
    for _ in range(depth):
        node = {"a": node}
    return node


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("model", {"mask_infeasible": True, **{f"k{n}": n for n in range(10**6)}}, f"at most {MAX_NODES:,}"),
        ("model", nested(1000), f"levels or more; expected at most {MAX_DEPTH}"),
        ("model", {"k" * 100_000: 1}, f"100,000 characters .* at most {MAX_TEXT:,}"),
        ("model", {"k": "v" * 100_000}, f"100,000 characters .* at most {MAX_TEXT:,}"),
        ("seed", [[[[0] * 100] * 100] * 100], f"at most {MAX_NODES:,}"),
    ],
)
def test_a_large_config_is_refused_before_it_is_made(key, value, message):
    for groups in ({}, {"groups": None}):
        started = time.perf_counter()
        with pytest.raises(ValueError, match=message):
            trusted_config(content(**{key: value}), **groups)
        assert time.perf_counter() - started < 10


@pytest.mark.parametrize(
    "group", ["algo", "warm_start", "curriculum", "collector", "logger", "callbacks", "planner", "other"]
)
@pytest.mark.parametrize(
    "part", [{"_target_": "theirs.Thing"}, {"x": "${oc.env:HOME}"}, nested(900), {str(n): n for n in range(10**5)}, 5]
)
def test_what_a_policy_is_not_restored_from_is_not_looked_at(group, part):
    """They cost no trust and no memory, and are not resolved."""
    cfg = trusted_config(content(**{group: part}))
    assert group not in cfg and cfg.model.actor.filters == 96
    with pytest.raises(ValueError) if part != 5 else pytest.raises(AssertionError):
        trusted_config(content(**{group: part}), groups=None)
        raise AssertionError


@pytest.mark.parametrize("place", ["env", "items", "model"])
def test_what_a_policy_is_restored_from_needs_trust(place):
    with pytest.raises(ValueError, match=f"{place}.*theirs.Thing.*trust=theirs"):
        trusted_config(content(**{place: content()[place] | {"own": {"_target_": "theirs.Thing"}}}))


def test_references_to_other_groups_become_their_values():
    values = content()
    values["model"]["actor"]["filters"] = "${evaluation.episodes}"
    cfg = trusted_config(values)
    assert cfg.model.actor.filters == 128 and "evaluation" not in cfg
    assert OmegaConf.to_container(cfg, resolve=False)["model"]["critic"]["tote_clip"] == "${..actor.tote_clip}"


def test_loading_a_run_with_a_teacher_of_ones_own_needs_no_trust(tmp_path):
    state, facts = checkpoint.read(locate("pretrained/r4"))
    facts["config"]["warm_start"] = {"frames": 5, "teacher": {"_target_": "theirs.Teacher"}}
    facts["config"]["callbacks"] = {"stop": {"_target_": "theirs.Stop"}}
    checkpoint.write(tmp_path / "own", state, facts)
    Planner.load(tmp_path / "own")


def test_another_number_of_workers_is_refused(smoke_run, tmp_path):
    folder = locate(smoke_run, "last")
    state, facts = checkpoint.read(folder)
    cfg = OmegaConf.create(facts["config"] | {"collector": {"_target_": "multi_sync", "workers": 2}})
    lacking = "checkpoint's collector does not fit these settings: worker0.* is missing"
    with pytest.raises(ValueError, match=lacking), Trainer(cfg, tmp_path, (state, facts, folder)).running():
        pass
    cfg.collector = {"_target_": "single", "workers": 0}
    with pytest.raises(ValueError, match="collector.workers: there is no key 'workers'"):
        Trainer(cfg, tmp_path, (state, facts, folder))


# ---------------------------------------------------------------------- searches, and words
def test_a_search_that_would_fill_the_memory_is_refused():
    cell, items = CellSpec(), Uniform((1, 2), (1, 2), (1, 1))
    state = PickPlaceEnv(num_envs=300).reset()
    planner = build(
        "planner",
        {"_target_": "lookahead", "samples": 10_000},
        cell=cell, items=items, policy=FcnGrasp(cell, filters=8, hidden=8),
    )  # fmt: skip
    with pytest.raises(ValueError, match="planner.samples=10000.* GB"):
        planner.decide(state)


def test_scores_of_many_footprints_are_computed_in_parts(monkeypatch):
    policy, state = FcnGrasp(CellSpec(), filters=8, hidden=8, compute_dtype="float32"), PickPlaceEnv(num_envs=9)
    seen = state.reset()
    maps = placing_maps(policy.cell, State.from_observation(seen))
    with torch.no_grad():
        whole = policy.best_feasible(seen, maps), policy.action_log_probs(seen)
        monkeypatch.setattr(footprint_fcn, "CHUNK_BYTES", 4 * policy.network.patch.in_features * 7)
        assert policy.best_feasible(seen, maps).equal(whole[0])
        torch.testing.assert_close(policy.action_log_probs(seen), whole[1])


def test_values_and_sentences_are_short():
    for value in ("x" * 100_000, list(range(10**5)), {"a" * 10**5: "b" * 10**5}, 10**3000, object(), torch.ones(2, 2)):
        assert len(excerpt(value)) < 200 and len(excerpt(value).splitlines()) == 1
    for error in (ValueError("x" * 100_000), RuntimeError("y" * 100_000), OSError(13, "z" * 10**5, "f" * 10**5)):
        assert len(errors.sentence(error)) <= errors.MAX_LENGTH
    with pytest.raises(ValueError) as caught:
        check_settings(composed("rollout_length=" + "x" * 10_000))
    assert len(str(caught.value)) < 300
