"""What a checkpoint's config may make: pickplace's own, each in its place, and what a user says he trusts."""

import json
import os
import subprocess
import sys

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from pickplace import Planner
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.allowlist import (
    TRAINED_WITH,
    own_modules,
    refuse_foreign_targets,
    saved_form,
    trust_needed,
    trusted,
)
from pickplace.runs.resume import refuse_links, resumed_config
from pickplace.training.settings import checkpoint_config

SHIPPED = config.PACKAGE / "pretrained" / "r4"


def composed(*overrides):
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        return compose("train", list(overrides))


def changed(**values):
    """The config of a training with values put into it, by their places with ``__`` for the dots."""
    content = saved_form(composed("experiment=quick"))
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
    (tmp_path / "mine.py").write_text(
        "import os\nfrom torch import load, nn\nfrom os import system\nclass Net(nn.Module): ...\ndef make(): ...\n"
        "VALUE = 5\n"
    )
    package = tmp_path / "mypkg"
    package.mkdir()
    (package / "__init__.py").write_text("from mypkg.nets import Net\n")
    (package / "nets.py").write_text("from torch import load\nclass Net: ...\n")
    (package / "__main__.py").write_text("raise SystemExit('it was run')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in ("mine", "mypkg", "mypkg.nets"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    "target",
    [
        "os.system", "pickplace.runs.checkpoint.shutil.rmtree", "builtins.eval", "pickplace", None, 5,
        "pickplace.evaluation.export.export", "pickplace.runs.checkpoint.write", "${planner._target_}", ["os.system"], "",
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", ["env", "model.actor", "curriculum.advance", "collector"])
def test_foreign_targets_are_refused(target, place):
    node = {"_target_": target}
    for key in reversed(place.split(".")):
        node = {key: node}
    with pytest.raises(ValueError, match="checkpoint is refused; expected one of pickplace"):
        refuse_foreign_targets(node)


@pytest.mark.parametrize(
    "node",
    [
        {"model": {"actor": {"hidden": {"_target_": "pickplace.task.items.Kinds"}}}},
        {"items": {"kinds": [[{"_target_": "pickplace.task.items.Kinds"}]]}},
        {"_target_": "pickplace.task.items.Kinds"},
        {"model": [{"_target_": "pickplace.policies.actors.fcn4d"}]},
    ],
)
def test_targets_in_other_places_are_refused(node):
    with pytest.raises(ValueError, match="expected none in this place"):
        refuse_foreign_targets(node)


def test_our_own_configs_are_accepted():
    groups = ("env", "items", "model", "curriculum", "curriculum/advance", "curriculum/sample", "collector", "logger")
    for group in (*groups, "warm_start"):
        folder = config.conf_dir() / group
        for path in folder.glob("*.yaml"):
            values = ["items.path=items.csv"] if path.stem == "recorded" else []
            cfg = composed(f"{group}={path.stem}", *values)
            assert trusted(saved_form(cfg)).env == cfg.env


EVIL = json.dumps({"_target_": "torch.load", "f": "evil.pt", "weights_only": False})
HIDDEN = {
    "a resolver": {"model__actor__filters": "${oc.env:HOME}"},
    "a resolver whose name is a reference": {"model__actor": "${${k}:${s}}", "k": "oc.create", "s": EVIL},
    "one in a value": {"model__actor__filters": "${${k}:${s}}", "k": "oc.create", "s": EVIL},
    "one in text": {"items__path": "data/${oc.env:HOME}"},
    "a reference in text": {"items__path": "data/${seed}"},
    "an escaped reference": {"items__path": "\\${seed}"},
    "a reference to what may be made elsewhere": {"model__actor__filters": "${logger}"},
    "a reference to what may not be made": {"model__actor__filters": "${evil}", "evil": {"_target_": "os.system"}},
    "a reference to a part": {"model__actor__filters": "${algo}"},
    "a list of parts": {"model__actor__filters": "${parts}", "parts": [[1], [2]]},
    "a reference as what is made": {"model__actor___target_": "${evil}", "evil": "os.system"},
    "a reference to a reference": {"model__actor__filters": "${a}", "a": "${seed}"},
    "a reference through a reference": {"model__actor__filters": "${a.seed}", "a": "${env}"},
    "a long text": {"model__actor__filters": "${text}", "text": "x" * 1001},
    "a long list": {"model__actor__filters": "${many}", "many": list(range(101))},
    "copies of copies": {f"a{n}": {"x": f"${{a{n - 1}}}", "y": f"${{a{n - 1}}}"} for n in range(1, 60)} | {"a0": {}},
    "a circle": {"model__actor__filters": "${model.actor.filters}"},
    "nothing there": {"model__actor__filters": "${nowhere}"},
}


@pytest.mark.parametrize("name", HIDDEN)
def test_what_interpolations_hide_is_refused(name):
    with pytest.raises(ValueError, match="refused|cannot be read"):
        trusted(changed(**HIDDEN[name]))


def test_references_to_values_follow_what_they_lead_to():
    content = changed(model__actor__filters="${seed}", items__kinds="${algo.kinds}", algo__kinds=[1, 2], seed=32)
    cfg = trusted(content)
    assert cfg.model.actor.filters == 32 and cfg["items"].kinds == [1, 2]


@pytest.mark.parametrize("command", ["load", "evaluate", "resume"])
def test_a_checkpoint_that_hides_a_pickle_runs_nothing(command, tmp_path):
    """With a whole checksum: nothing but its config is bad."""
    folder = tmp_path / "run" / "checkpoints" / "last"
    folder.mkdir(parents=True)
    (folder / checkpoint.TENSORS).write_bytes((SHIPPED / checkpoint.TENSORS).read_bytes())
    facts = json.loads((SHIPPED / checkpoint.FACTS).read_text())
    (tmp_path / "evil.pt").write_bytes(f"cos\nsystem\n(S'touch {tmp_path}/pwned'\ntR.".encode())
    actor = {**facts["config"]["model"]["actor"], "filters": json.loads(EVIL) | {"f": str(tmp_path / "evil.pt")}}
    facts["config"] |= {"k": "oc.create", "s": json.dumps(actor)}
    facts["config"]["model"]["actor"] = "${${k}:${s}}"
    facts |= {"curriculum": {}, "iteration": 1, "best": 0.5, "latest": {}}
    (folder / checkpoint.FACTS).write_text(json.dumps(facts))
    if command == "load":
        with pytest.raises(ValueError, match="no resolver"):
            Planner.load(folder)
    else:
        module, key = {"evaluate": ("evaluation.evaluate", "checkpoint"), "resume": ("training.train", "resume")}[command]
        words = [sys.executable, "-m", f"pickplace.{module}", f"{key}={folder}"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 2 and "no resolver" in done.stderr
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("target", "trust"),
    [
        ("mine.Net", ["mine"]), ("mine.make", "mine"), ("mypkg.nets.Net", ["mine", "mypkg.nets"]),
        ("mypkg.Net", ["mypkg"]),
    ],
)  # fmt: skip
def test_what_a_trusted_module_defines_may_be_made_anywhere(target, trust, mine):
    trusted(changed(model__actor___target_=target, model__actor__part={"_target_": target}), trust)


@pytest.mark.parametrize(
    "target",
    [
        "mine.os.system", "mine.system", "mine.load", "mine.nn", "mine.VALUE", "mine", "mine.", "mine. Net",
        "mine..Net", "mine.Missing", "mine.__setattr__", "mine.${evil}", "mines.Net", "mypkg.nets.Net",
        "mypkg.nets", "mypkg.__main__", "mypkg.nets.load", "os.system", "torch.load", "", None, 5, ["mine.Net"],
    ],
)  # fmt: skip
def test_trust_goes_no_further_than_what_its_modules_define(target, mine):
    with pytest.raises(ValueError, match="checkpoint is refused"):
        trusted(changed(model__actor___target_=target, evil="load"), ["mine", "mypkg"])


def test_a_trusted_module_that_is_not_there(mine):
    with pytest.raises(ValueError, match="trust=nowhere: it cannot be imported .*; expected it on PYTHONPATH"):
        trusted(changed(model__actor___target_="nowhere.Net"), ["nowhere"])


def test_the_refusal_says_what_to_type():
    with pytest.raises(ValueError, match=r"if mypkg\.nets is yours, say trust=mypkg\.nets \(--trust mypkg\.nets to"):
        trusted(changed(model__actor___target_="mypkg.nets.Net"))
    with pytest.raises(ValueError, match=r"expected one of [^;]*\.$"):  # nobody should trust these
        trusted(changed(model__actor___target_="os.system"))


@pytest.mark.parametrize(
    "trust",
    ["os", ["mine", "subprocess"], ["builtins"], "pickplace", "torch", "hydra.utils", 5, [3], "a b", [""], {"a": 1}],
)
def test_trust_in_what_is_nobodys_own_is_refused(trust):
    with pytest.raises(ValueError, match="trust=.*: expected names of modules of your own"):
        own_modules(trust)


def test_names_of_modules():
    assert own_modules(None) == own_modules([]) == ()
    assert own_modules("mine") == ("mine",) and own_modules(OmegaConf.create(["mine", "my.nets"])) == (
        "mine",
        "my.nets",
    )


def test_what_is_saved(monkeypatch):
    """References stay, resolvers are worked out, and trust is not handed on."""
    monkeypatch.setenv("DATA", "/data")
    path = "items.path='${oc.env:DATA}/items.csv'"
    cfg = composed("items=recorded", path, "total_frames=${seed}", "seed=7", "trust=[mine]", "+algo.part=${evaluation}")
    saved = saved_form(cfg)
    assert saved["items"]["path"] == "/data/items.csv" and saved["total_frames"] == "${seed}" and saved["trust"] == []
    assert saved["algo"]["part"]["stream"] == "validation"
    assert saved["model"]["critic"]["tote_clip"] == "${..actor.tote_clip}"
    assert trusted(saved).total_frames == 7


def test_what_to_say_to_load_a_run_again():
    assert trust_needed(saved_form(composed())) == ()
    changes = {"model__actor___target_": "my.nets.Net", "items___target_": "mine.Items"}
    changes["algo__more"] = [{"_target_": "mine.Items"}, {"_target_": "torch.nn.ReLU"}]
    assert trust_needed(changed(**changes)) == ("mine", "my.nets")


def test_references_that_double_at_every_step_are_refused_at_once():
    """OmegaConf would follow 2^35 of them."""
    steps = {"p0": "${Z}", "q0": "${Y}", "Z": {}, "Y": {}}
    for i in range(1, 36):
        steps |= {f"p{i}": f"${{q{i - 1}.x{i - 1}}}", f"q{i}": f"${{p{i - 1}.x{i - 1}}}"}
    for i in range(35):
        steps["Z"][f"x{i}"], steps["Y"][f"x{i}"] = f"${{q{i}}}", f"${{p{i}}}"
    with pytest.raises(ValueError, match="expected a reference to"):
        trusted(changed(**steps, a="${p35}"))


def test_parts_of_pickplace_within_what_is_trusted(mine):
    inner = {"_target_": "pickplace.task.items.Kinds", "kinds": [[1, 1, 1]]}
    trusted(changed(items={"_target_": "mine.make", "base": inner}), ["mine"])
    with pytest.raises(ValueError, match="items.base._target_='os.system'"):
        trusted(changed(items={"_target_": "mine.make", "base": {"_target_": "os.system"}}), ["mine"])


def test_nobody_is_told_to_trust_an_installed_package():
    with pytest.raises(ValueError, match=r"expected one of [^;]*\.$"):
        trusted(changed(model__actor___target_="sympy.sympify"))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("env__bin_size", [10**6, 10**6, 1]), ("env__tote_size", [6, 6, 10**6]), ("env__effector_size", [1e9, 3]),
        ("env__num_envs", 10**9), ("collector__workers", 4096),
    ],
)  # fmt: skip
def test_numbers_that_would_take_all_memory_are_refused(place, value):
    with pytest.raises(ValueError, match=f"{place.replace('__', '.')}=.*: the checkpoint is refused; expected at most"):
        trusted(changed(**{place: value}))


@pytest.mark.parametrize("seed", ["\x1b[31m", None, True, 1.5])
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(ValueError, match="seed"):
        trusted(changed(seed=seed))


@pytest.mark.parametrize(
    ("key", "value", "harmless"),
    [
        ("collector.address", "ray://192.0.2.1:1", "local"),
        ("logger.uri", "http://192.0.2.1", "null"),
        ("logger.offline", False, "true"),
    ],
)
def test_a_checkpoint_reaches_other_machines_only_if_the_user_says_so_again(key, value, harmless):
    content = changed(**{key.replace(".", "__"): value})
    facts = {"config": content, "curriculum": {}, "frames": 5, "iteration": 1, "best": 0.5, "latest": {}}
    with pytest.raises(ValueError, match=f"{key}={value}: the checkpoint would reach out .* or {key}={harmless}"):
        resumed_config("run", facts, [])
    assert OmegaConf.select(resumed_config("run", facts, [f"{key}={harmless}"]), key) != value
    _, again = checkpoint_config(OmegaConf.create(content))  # what a stopped run prints is enough
    assert OmegaConf.select(resumed_config("run", facts, again.split()), key) == value


@pytest.mark.parametrize(
    "name", ["train.log", ".metrics.csv.new", "report.html", "checkpoints/best", ".hydra/x", "pipe"]
)
def test_a_run_folder_with_links_is_not_resumed(name, tmp_path):
    for folder in ("run/checkpoints", "run/.hydra"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "run" / "metrics.csv").write_text("frames\n")
    refuse_links(tmp_path / "run")
    if name == "pipe":
        os.mkfifo(tmp_path / "run" / name)
    else:
        (tmp_path / "run" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match=f"{name}: a link or no regular file"):
        refuse_links(tmp_path / "run")


def test_notes_of_a_run_are_read_as_they_stand(tmp_path, monkeypatch):
    monkeypatch.setenv("MY_SECRET", "secret")
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text("- seed=1\n- a='${oc.env:MY_SECRET}'\n- [nested]\n- 5\n")
    assert config.begun_with(tmp_path) == ["seed=1", "a='${oc.env:MY_SECRET}'"]
    assert config.begun_with(tmp_path / "nowhere") == []


def test_errors_hold_nothing_that_a_terminal_obeys():
    assert config.sentence(ValueError("bad \x1b[31m key\x07")) == "bad \\x1b[31m key\\x07"


@pytest.mark.parametrize("key", TRAINED_WITH)
def test_a_config_that_no_training_wrote(key):
    content = changed()
    *parents, last = key.split(".")
    node = content
    for parent in parents:
        node = node[parent]
    del node[last]
    with pytest.raises(ValueError, match=f"no {key}"):
        trusted(content)
