"""Every class that a config file names is in the registry, and is made of that file's settings."""

import itertools

import pytest
from commands import composed, options
from omegaconf import OmegaConf

from pickplace import CellSpec, PickPlaceEnv
from pickplace.config.registry import REGISTRY, accepted_arguments, build, find, names_at
from pickplace.config.words import conf_dir
from pickplace.items.distributions import ItemDistribution, Kinds
from pickplace.training.curriculum.curriculum import Curriculum


def test_every_name_leads_to_a_class_or_function():
    for place, names in REGISTRY.items():
        for name, path in names.items():
            found = find(place, name)
            assert path.endswith(f".{found.__name__}") and found.__doc__, name


def test_every_config_file_names_what_is_in_the_registry():
    used = set()

    def visit(place, node, path):
        if not isinstance(node, dict):
            return
        if target := node.get("_target_"):
            names = names_at(place)
            assert target in names, (path, place)
            used.update((key, target) for key in REGISTRY if REGISTRY[key] is names)
        for key, value in node.items():
            visit(f"{place}.{key}".strip("."), value, path)

    for path in conf_dir().rglob("*.yaml"):
        content = OmegaConf.to_container(OmegaConf.load(path))
        if path.name not in ("train.yaml", "evaluate.yaml"):  # these two configure Hydra itself, see below
            group = ".".join(path.parent.relative_to(conf_dir()).parts)
            in_env = path.read_text().startswith("# @package env\n")
            visit("env" if in_env else "" if group in ("benchmark", "experiment") else group, content, path)
    assert {(place, name) for place, names in REGISTRY.items() for name in names} == used
    assert "_target_: pickplace" not in "".join(path.read_text() for path in conf_dir().rglob("*.yaml"))


@pytest.mark.parametrize(
    ("place", "node", "words"),
    [
        ("planner", {"_target_": "joint_dlb"}, "planner._target_=joint_dlb: .* did you mean 'joint_dbl'"),
        ("planner", {"_target_": "greedy"}, "expected one of policy, lookahead, .* or the dotted path"),
        ("planner", {"_target_": "nowhere.Net"}, "No module named 'nowhere'"),
        ("planner", {"_target_": "os.nothing"}, "no attribute 'nothing'"),
        ("planner", {"_target_": None}, "planner._target_=None: there is no such"),
        ("planner", {"_target_": ["joint_dbl"]}, "there is no such"),
        ("planner", {"_target_": "random", "sed": 1}, "planner.sed: there is no key .* did you mean 'seed'"),
        ("planner", {"_target_": "random", "seed": "one"}, "planner.seed='one': expected a whole number"),
        ("items", {"_target_": "kinds"}, "items._target_=kinds: 'kinds' missing; expected a value"),
        ("curriculum", {"_target_": "curriculum", "advance": {"_target_": "frames", "x": 1}}, "curriculum.advance.x: "),
        ("items", {"_target_": "test_registry.Wrapped", "base": {"_target_": "kinds"}}, "items.base._target_=kinds"),
        ("items", {"_target_": "test_registry.open_settings", "b": 1}, "items.b: there.*expected one of a"),
    ],
)  # fmt: skip
def test_a_wrong_name_or_setting_is_one_sentence(place, node, words):
    kwargs = {"cell": PickPlaceEnv(num_envs=1).cell} if place == "planner" else {}
    with pytest.raises(ValueError, match=words) as caught:
        build(place, OmegaConf.create(node), **kwargs)
    assert "\n" not in str(caught.value)


class Wrapped:
    def __init__(self, base, factor=1):
        self.base, self.factor = base, factor

    @property
    def settings(self):
        return self.factor


def open_settings(first=None, **settings):
    return settings


open_settings.settings = ("a",)


def test_a_class_of_the_user_s_and_the_parts_within_it():
    inner = {"_target_": "items/kinds", "kinds": [[1, 1, 1]]}
    node = {"_target_": "test_registry.Wrapped", "base": inner, "factor": "${two}"}
    made = build("items", OmegaConf.create({"two": 2, "items": node})["items"])
    assert isinstance(made, Wrapped) and isinstance(made.base, ItemDistribution) and made.factor == 2
    assert build("items", {"_target_": "test_registry.open_settings", "a": [{"b": 1}]}) == {"a": [{"b": 1}]}


def test_accepted_arguments():
    assert accepted_arguments(Wrapped) == ["base", "factor"]
    assert accepted_arguments(open_settings) == ["a"]
    assert accepted_arguments(lambda **settings: None) is None
    assert accepted_arguments(type("Plain", (), {})) == []
    assert "rotations" in accepted_arguments(PickPlaceEnv)


def test_every_env_and_item_distribution(tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n2,1,1\n")
    for name in options("items"):
        words = [f"items.path={tmp_path}/items.csv"] if name == "recorded" else []
        if name == "published":
            words = ["items.drawn={_target_:uniform}", "items.end=null"]
        if name == "orders":
            (tmp_path / "orders.csv").write_text("order,l,w,h,kg\n1,9,9,9,1\n2,8,8,8,1\n3,7,7,7,1\n")
            words = [f"items.path={tmp_path}/orders.csv", "items.cell_size=0.05", "items.height_unit=1"]
        assert isinstance(build("items", composed(f"+items={name}", *words, name=None)["items"]), ItemDistribution)
    items = build("items", composed()["items"])
    for name in options("env"):
        env = build("env", {**composed(f"+env={name}", name=None).env, "num_envs": 2}, items=items)
        assert isinstance(env, PickPlaceEnv) and env.reset()["action_mask"].any(1).all()


def test_every_curriculum_and_every_exchange_of_its_parts():
    """Every advance rule and every sampler, with some curriculum each."""
    parts = [options("curriculum/advance"), options("curriculum/sample"), options("curriculum")]
    longest = max(map(len, parts))
    for advance, sample, name in itertools.islice(zip(*map(itertools.cycle, parts), strict=True), longest):
        words = [f"+curriculum={name}", f"curriculum/advance={advance}", f"curriculum/sample={sample}"]
        curriculum = build("curriculum", composed(*words, name=None).curriculum)
        curriculum.setup(CellSpec(bin_items=10, preview=9), Kinds([(1, 1, 1)]), 10**9)
    for name in options("curriculum"):
        assert isinstance(build("curriculum", composed(f"+curriculum={name}", name=None).curriculum), Curriculum)
