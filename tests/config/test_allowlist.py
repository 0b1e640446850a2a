"""Classes that a checkpoint's config may name: pickplace's own, each in its place, and those a user trusts."""

import copy
import functools
import itertools
import json
import sys

import pytest
from commands import composed, options
from omegaconf import OmegaConf

from pickplace import Planner
from pickplace.config.allowlist import REQUIRED_KEYS, modules_to_trust, own_modules, saved_form, trusted_config
from pickplace.runs import checkpoint
from pickplace.runs.locate import PRETRAINED

SHIPPED = PRETRAINED / "r4"
original = functools.cache(lambda: saved_form(composed("experiment=quick")))


def changed(**values):
    """The config of a training with values put into it, by their places with ``__`` for the dots."""
    content = copy.deepcopy(original())
    for place, value in values.items():
        *parents, last = place.split("__")
        node = content
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = value
    return content


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A module and a package of a user's, ``mine`` and ``mypkg``, which import things that must not be called."""
    files = {
        "mine.py": "import os\nfrom torch import load\nfrom os import system\nclass Net: ...\ndef make(): ...\nV = 5\n",
        "mypkg/__init__.py": "from mypkg.nets import Net\n",
        "mypkg/nets.py": "from torch import load\nclass Net: ...\n",
        "mypkg/__main__.py": "raise SystemExit('it was run')\n",
    }
    (tmp_path / "mypkg").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in ("mine", "mypkg", "mypkg.nets"):
        sys.modules.pop(name, None)


FOREIGN = [
    "os.system", "pickplace.runs.checkpoint.shutil.rmtree", "builtins.eval", "pickplace", None, 5, "", ["os.system"],
    "pickplace.evaluation.play.play", "pickplace.items.distributions.Kinds", "joint_dbl", "items/kinds",
]  # fmt: skip


@pytest.mark.parametrize("place", ["env", "model.actor", "curriculum.advance", "collector"])
@pytest.mark.parametrize("target", FOREIGN)
def test_foreign_targets_are_refused(target, place):
    with pytest.raises(ValueError, match=rf"{place}\._target_=.*: the checkpoint is refused; expected one of \w+"):
        trusted_config(changed(**{f"{place}._target_".replace(".", "__"): target}), groups=None)


@pytest.mark.parametrize(
    ("place", "node"),
    [
        ("model__actor__hidden", {"_target_": "kinds"}), ("model__actor__hidden", {"_target_": "items/kinds"}),
        ("items__kinds", [[{"_target_": "kinds"}]]), ("_target_", "kinds"), ("model", [{"_target_": "fcn4d"}]),
    ],
)  # fmt: skip
def test_targets_in_other_places_are_refused(place, node):
    with pytest.raises(ValueError, match="expected none in this place"):
        trusted_config(changed(**{place: node}), groups=None)


def test_our_own_configs_are_accepted():
    groups = ("env", "items", "model", "curriculum", "curriculum/advance", "curriculum/sample", "collector", "logger")
    groups += ("warm_start",)
    for names in itertools.zip_longest(*map(options, groups)):
        choices = [f"{group}={name}" for group, name in zip(groups, names, strict=True) if name]
        path = ["items.path=items.csv"] if {"items=recorded", "items=orders"} & {*choices} else []
        drawn = ["items.drawn={_target_:cut}"] if "items=published" in choices else []
        cfg = composed(*choices, *path, *drawn)
        assert trusted_config(saved_form(cfg)).env == cfg.env


EVIL = json.dumps({"_target_": "torch.load", "f": "evil.pt", "weights_only": False})
FILTERS = "model__actor__filters"
HIDDEN = {
    "a resolver": {FILTERS: "${oc.env:HOME}"},
    "a resolver whose name is a reference": {"model__actor": "${${k}:${s}}", "k": "oc.create", "s": EVIL},
    "one in a value": {FILTERS: "${${k}:${s}}", "k": "oc.create", "s": EVIL},
    "one in text": {"items__path": "data/${oc.env:HOME}"},
    "an escaped reference": {"items__path": "\\${seed}"},
    "a reference to what may be made elsewhere": {FILTERS: "${logger}"},
    "a reference to what may not be made": {FILTERS: "${evil}", "evil": {"_target_": "os.system"}},
    "a reference to a part": {FILTERS: "${algo}"},
    "a list of parts": {FILTERS: "${parts}", "parts": [[1], [2]]},
    "a reference as what is made": {"model__actor___target_": "${evil}", "evil": "os.system"},
    "a reference through a reference": {FILTERS: "${a.seed}", "a": "${env}"},
    "a long text": {FILTERS: "${text}", "text": "x" * 1001},
    "a long list": {FILTERS: "${many}", "many": list(range(101))},
    "copies of copies": {f"a{n}": {"x": f"${{a{n - 1}}}", "y": f"${{a{n - 1}}}"} for n in range(1, 60)} | {"a0": {}},
    "a circle": {FILTERS: "${model.actor.filters}"},
    "nothing there": {FILTERS: "${nowhere}"},
}


@pytest.mark.parametrize("name", HIDDEN)
def test_what_interpolations_hide_is_refused(name):
    words = "refused; expected (no interpolation but a reference to a number|one of fcn_grasp)"
    with pytest.raises(ValueError, match=words):
        trusted_config(changed(**HIDDEN[name]), groups=None)


def test_references_to_values_follow_what_they_lead_to():
    cfg = trusted_config(changed(**{FILTERS: "${seed}"}, items__kinds="${algo.kinds}", algo__kinds=[1, 2], seed=32))
    assert cfg.model.actor.filters == 32 and cfg["items"].kinds == [1, 2]


@pytest.mark.parametrize("command", ["load", "evaluate", "resume"])
def test_a_checkpoint_that_hides_a_pickle_runs_nothing(command, run, tmp_path):
    """With a right checksum: nothing but its config is bad."""
    folder = tmp_path / "run" / "checkpoints" / "last"
    folder.mkdir(parents=True)
    (folder / checkpoint.TENSORS).write_bytes((SHIPPED / checkpoint.TENSORS).read_bytes())
    facts = json.loads((SHIPPED / checkpoint.FACTS).read_text())
    (tmp_path / "evil.pt").write_bytes(f"cos\nsystem\n(S'touch {tmp_path}/pwned'\ntR.".encode())
    actor = {**facts["config"]["model"]["actor"], "filters": json.loads(EVIL) | {"f": str(tmp_path / "evil.pt")}}
    facts["config"] |= {"k": "oc.create", "s": json.dumps(actor)}
    facts["config"]["model"]["actor"] = "${${k}:${s}}"
    facts |= {"curriculum": {}, "iteration": 1, "best": 0.5, "latest": {}, "callbacks": {}, "ended": ""}
    (folder / checkpoint.FACTS).write_text(json.dumps(facts))
    if command == "load":
        with pytest.raises(ValueError, match="no interpolation"):
            Planner.load(folder)
    else:
        name, key = {"evaluate": ("evaluate", "checkpoint"), "resume": ("train", "resume")}[command]
        code, _, err = run(name, f"{key}={folder}")
        assert code == 2 and "no interpolation" in err
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("target", "trust"),
    [
        ("mine.Net", ["mine"]),
        ("mine.make", "mine"),
        ("mypkg.nets.Net", ["mine", "mypkg.nets"]),
        ("mypkg.Net", ["mypkg"]),
    ],
)
def test_what_a_trusted_module_defines_may_be_made_anywhere(target, trust, mine):
    trusted_config(changed(model__actor___target_=target, model__actor__part={"_target_": target}), trust)


@pytest.mark.parametrize(
    "target",
    [
        "mine.os.system", "mine.system", "mine.load", "mine.V", "mine", "mine.", "mine. Net",
        "mine..Net", "mine.Missing", "mine.__setattr__", "mine.${evil}", "mines.Net", "mypkg.nets.Net",
        "mypkg.nets", "mypkg.__main__", "mypkg.nets.load", "os.system", "torch.load", "", None, 5, ["mine.Net"],
    ],
)  # fmt: skip
def test_trust_goes_no_further_than_what_its_modules_define(target, mine):
    with pytest.raises(ValueError, match="checkpoint is refused"):
        trusted_config(changed(model__actor___target_=target, evil="load"), ["mine", "mypkg"])


def test_parts_of_pickplace_within_what_is_trusted(mine):
    inner = {"_target_": "items/kinds", "kinds": [[1, 1, 1]]}
    trusted_config(changed(items={"_target_": "mine.make", "base": inner}), ["mine"])
    for target in ("os.system", "torch.load", "kinds", "item/kinds"):
        with pytest.raises(ValueError, match=f"items.base._target_='{target}'.*such as items/kinds"):
            trusted_config(changed(items={"_target_": "mine.make", "base": {"_target_": target}}), ["mine"])


def test_the_refusal_says_what_to_type():
    with pytest.raises(ValueError, match=r"if mypkg\.nets is yours, say trust=mypkg\.nets \(--trust mypkg\.nets to"):
        trusted_config(changed(model__actor___target_="mypkg.nets.Net"))
    with pytest.raises(ValueError, match="trust=nowhere: it cannot be imported .*; expected it on PYTHONPATH"):
        trusted_config(changed(model__actor___target_="nowhere.Net"), ["nowhere"])
    for target in ("os.system", "sympy.sympify"):  # nobody should trust these
        with pytest.raises(ValueError, match=r"expected one of [^;]*\.$"):
            trusted_config(changed(model__actor___target_=target))


@pytest.mark.parametrize(
    "trust", ["os", ["mine", "subprocess"], ["builtins"], "pickplace", "torch", "hydra.utils", 5, [3], "a b", [""]]
)
def test_trust_in_what_is_nobodys_own_is_refused(trust):
    with pytest.raises(ValueError, match="trust=.*: expected names of modules of your own"):
        own_modules(trust)


def test_what_is_saved(monkeypatch):
    """References stay, resolvers are resolved, and trust is not saved."""
    monkeypatch.setenv("DATA", "/data")
    path = "items.path='${oc.env:DATA}/items.csv'"
    cfg = composed("items=recorded", path, "total_frames=${seed}", "seed=7", "trust=[mine]", "+algo.part=${evaluation}")
    saved = saved_form(cfg)
    assert saved["items"]["path"] == "/data/items.csv" and saved["total_frames"] == "${seed}" and saved["trust"] == []
    assert saved["algo"]["part"]["stream"] == "validation"
    assert saved["model"]["critic"]["tote_clip"] == "${..actor.tote_clip}"
    assert trusted_config(saved, groups=None).total_frames == 7


def test_modules_to_trust():
    assert own_modules(None) == own_modules([]) == ()
    assert own_modules("mine") == ("mine",) and own_modules(OmegaConf.create(["mine", "a.b"])) == ("mine", "a.b")
    assert modules_to_trust(original()) == ()
    changes = {"model__actor___target_": "my.nets.Net", "items___target_": "mine.Items"}
    changes["algo__more"] = [{"_target_": "mine.Items"}, {"_target_": "torch.nn.ReLU"}, {"_target_": "items/kinds"}]
    assert modules_to_trust(changed(**changes)) == ("mine", "my.nets")


@pytest.mark.parametrize("key", REQUIRED_KEYS)
def test_a_config_that_no_training_wrote(key):
    with pytest.raises(ValueError, match=f"no {key}|{key}=None"):
        trusted_config(changed(**{key.replace(".", "__"): None}))
    with pytest.raises(ValueError, match="seed='x': .* expected a whole number"):
        trusted_config(changed(seed="x"))
