"""The pages say what is there: quoted files, settings, links and examples."""

import contextlib
import importlib.util
import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pickplace import Planner
from pickplace import cli as commands
from pickplace.evaluation import evaluate, export
from pickplace.robot import json_lines as plan
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.registry import build
from pickplace.training import train

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
EXAMPLES = DOCS / "examples"
PAGES = sorted([*DOCS.glob("*.md"), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))])
BLOCK = re.compile(r"^```(\w*)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
EVALUATION = ["evaluation.episodes=3", "evaluation.latency_decisions=0", "evaluation.replay=0", "threads=1"]
TRAINING = ["env.num_envs=8", "total_frames=64", "evaluation.episodes=4", "threads=1"]


def name(path):
    return path.name


def blocks(page, language):
    return [body for kind, title, body in BLOCK.findall(page.read_text()) if kind == language and not title]


def load(path):
    """A script in docs/ as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


# ---------------------------------------------------------------------- pages
@pytest.mark.parametrize("page", PAGES, ids=name)
def test_quoted_files_are_the_files(page):
    for _, title, body in BLOCK.findall(page.read_text()):
        if title:
            assert body == (DOCS / title).read_text(), title


def test_every_file_of_the_new_examples_is_quoted_or_named():
    text = "".join(page.read_text() for page in PAGES)
    for path in EXAMPLES.rglob("*.*"):
        if "__pycache__" not in path.parts:
            assert str(path.relative_to(DOCS)) in text, path


def slug(heading):
    """The anchor of a heading, as code hosts make it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    text = BLOCK.sub("", page.read_text())
    for target in re.findall(r"\]\(([^()\s]+)\)", text):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", file.read_text()), re.MULTILINE)
            assert anchor in map(slug, headings), f"{page.name}: {target}"


@pytest.mark.parametrize("page", [*DOCS.glob("*.md"), ROOT / "CONTRIBUTING.md"], ids=name)
def test_every_page_can_be_found(page):
    site = (ROOT / ".ci" / "mkdocs.yml").read_text()
    assert f": {page.name.lower()}\n" in site
    if page.name != "index.md":
        assert f"{page.name})" in (DOCS / "index.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_make_targets_exist(page):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(), re.MULTILINE)) <= targets


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_python_blocks_run(page, monkeypatch, tmp_path):
    """One after the other, each page in one namespace, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for body in blocks(page, "python"):
        exec(compile(body, page.name, "exec"), namespace)


def commands_of(page):
    """The commands of a page that are ours: what is called, and its words."""
    for body in blocks(page, "sh"):
        for line in body.splitlines():
            words = re.sub(r"\s#.*", "", line).split()
            while words and "=" in words[0]:
                words.pop(0)
            if words[:2] == ["python", "-m"] and words[2] in (
                "pickplace.training.train",
                "pickplace.evaluation.evaluate",
            ):
                yield words[2].removeprefix("pickplace."), words[3:]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_command_composes(page, monkeypatch):
    """No command names a group, an option or a key that is not there."""
    from hydra import compose, initialize_config_dir

    for command, words in commands_of(page):
        folder = config.conf_dir()
        overrides = [word for word in words if word != "-m"]
        assert "--config-dir" not in overrides[1:], "Hydra takes its flags before the settings, or after all of them"
        if "--config-dir" in overrides:
            at = overrides.index("--config-dir")
            folder_of_user = ROOT / overrides[at + 1]
            del overrides[at : at + 2]
            if not folder_of_user.is_dir():  # README's `mine`
                continue
            overrides.append(f"hydra.searchpath=[file://{folder_of_user}]")
        follows = any(word.startswith(("checkpoint=", "resume=")) for word in overrides)
        overrides = [word for word in overrides if not (follows and word.startswith(("model.", "algo.")))]
        plain = [word.split(",")[0] if "[" not in word and "," in word else word for word in overrides]
        with initialize_config_dir(str(folder), version_base="1.3"):
            compose(command, plain)


def test_the_site_builds(tmp_path):
    """Strictly, where its tools are installed: a broken link fails, and so does anything fetched from elsewhere."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings_handlers.python")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--config-file", ".ci/mkdocs.yml"]
    command += ["--site-dir", str(tmp_path / "site")]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    html = (tmp_path / "site" / "api.html").read_text()
    assert "Observation space" in html and ":class:<code>" not in html
    assert (tmp_path / "site" / "overview.html").is_file() and (tmp_path / "site" / "concepts.svg").is_file()


# ---------------------------------------------------------------------- reference and drawings
@pytest.fixture(scope="module")
def reference():
    return load(DOCS / "reference.py")


def test_reference_is_what_the_configs_say(reference):
    assert reference.PAGE.read_text() == reference.page(), "out of date: python docs/reference.py"


def test_every_key_has_a_comment(reference):
    files = reference.everything()
    for file in files.values():
        assert file.text, f"conf/{file.group}/{file.name}.yaml: no comment at its top"
        for key in file.settings:
            assert reference.meaning(key, file, files), f"conf/{file.group}/{file.name}.yaml: {key} has no comment"


def test_reference_knows_every_file_and_key(reference):
    text = reference.PAGE.read_text()
    for path in config.conf_dir().rglob("*.yaml"):
        group = str(path.parent.relative_to(config.conf_dir()))
        assert group == "." or f"### `{group}={path.stem}`" in text
    for key in ("seed", "env.tote_size", "algo.gamma", "curriculum.advance.stages", "planner.candidates", "compare"):
        assert f"| `{key}` |" in text


def test_the_drawing_of_the_concepts_is_true():
    load(DOCS / "concepts.py").draw()  # asserts that one grip collides and the other succeeds


# ---------------------------------------------------------------------- examples
@pytest.fixture
def run(monkeypatch, tmp_path):
    """A command with an example's folder, in this process, from the root of the checkout."""
    monkeypatch.chdir(ROOT)

    def call(command, example, *arguments, folder="out"):
        monkeypatch.syspath_prepend(str(EXAMPLES / example))
        words = ["--config-dir", str(EXAMPLES / example), *arguments, f"hydra.run.dir={tmp_path / folder}"]
        monkeypatch.setattr(sys, "argv", [f"pickplace-{command}", *words])
        threads = torch.get_num_threads()
        try:
            {"train": train.main, "evaluate": evaluate.main}[command]()
        finally:
            logging.root.handlers.clear()
            torch.set_num_threads(threads)
        return tmp_path / folder

    return call


def result(folder):
    return json.loads((folder / "evaluation.json").read_text())


def test_own_planner(run):
    ours = result(run("evaluate", "own_planner", "planner=corner", *EVALUATION))
    assert ours["planner"] == "corner" and set(ours["failures"]) == {"stuck"} and ours["occupancy"]["mean"] > 0.8
    assert ours["planner_settings"] == {"height_weight": 10}


def test_own_model(run):
    folder = run("train", "own_model", "model=mlp", "model.actor.hidden=8", *TRAINING)
    given = [f"checkpoint={folder}", "trust=own_model"]
    ours = result(run("evaluate", "own_model", *given, *EVALUATION, folder="evaluation"))
    assert ours["planner"] == "policy" and set(ours["failures"]) == {"stuck"}


def test_a_module_is_trusted_by_who_loads_a_run_and_by_nobody_else(run, monkeypatch, capsys, tmp_path):
    folder = run("train", "own_model", "model=mlp", "model.actor.hidden=8", "trust=own_model", *TRAINING)

    def resume(*words):
        monkeypatch.setattr(sys, "argv", ["pickplace-train", f"resume={folder}", "total_frames=128", *words])
        train.main()

    for trust in ([], ["trust=[own_models,model]"]):
        with pytest.raises(SystemExit):
            resume(*trust)
        assert "'own_model.Mlp': the checkpoint is refused" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            run("evaluate", "own_model", f"checkpoint={folder}", *trust, folder="refused")
        assert "'own_model.Mlp': the checkpoint is refused" in capsys.readouterr().err
    resume("trust=[own_model]")
    assert checkpoint.read(checkpoint.locate(folder, prefer="last"))[1]["frames"] == 128
    with pytest.raises(ValueError, match=r"own_model\.Mlp"):
        Planner.load(folder)
    bin_depth, tote_depth = np.zeros((5, 5)), np.full((6, 6), 5)
    bin_depth[2, 2] = 1
    assert Planner.load(folder, trust=["own_model"]).plan(bin_depth, tote_depth).status == "ok"
    np.save(tmp_path / "bin.npy", bin_depth)
    np.save(tmp_path / "tote.npy", tote_depth)
    maps = ["--bin", str(tmp_path / "bin.npy"), "--tote", str(tmp_path / "tote.npy")]
    plan.run(plan.parser().parse_args([str(folder), *maps, "--trust", "own_model"]))
    assert '"status": "ok"' in capsys.readouterr().out


def test_a_teacher_of_a_trusted_module(run, capsys):
    teacher = run("train", "own_model", "model=mlp", "model.actor.hidden=8", *TRAINING)
    taught = [
        "warm_start=imitate",
        "planner@warm_start.teacher=policy",
        f"warm_start.checkpoint={teacher}",
        "warm_start.frames=64",
        *TRAINING,
    ]
    with pytest.raises(SystemExit):
        run("train", "own_model", *taught, folder="refused")
    assert "if own_model is yours, say trust=own_model" in capsys.readouterr().err
    run("train", "own_model", *taught, "trust=own_model", folder="taught")


def test_own_items(run):
    folder = run("train", "own_items", "items=batches", *TRAINING, "model.actor.filters=8", "env.tote_size=[4,4,2]")
    given = [f"checkpoint={folder}", "trust=own_items"]
    ours = result(run("evaluate", "own_items", *given, *EVALUATION, folder="evaluation"))
    assert ours["items"]["run"] == 3 and ours["env"]["tote_size"] == [4, 4, 2]


def test_own_items_come_in_batches(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES / "own_items"))
    from own_items import Batches

    steps = torch.arange(300)
    items = Batches([[1, 1, 1], [2, 1, 1], [1, 2, 1]], run=3)
    item = items.sample("train", torch.tensor(0), torch.zeros_like(steps), steps, (5, 5, 1))
    sizes = torch.stack([item.w, item.d], 1).view(100, 3, 2)
    assert (sizes == sizes[:, :1]).all() and len(sizes[:, 0].unique(dim=0)) == 3
    assert len(torch.stack([item.x, item.y], 1).unique(dim=0)) > 10
    with pytest.raises(ValueError, match="items.run=0"):
        Batches([[1, 1, 1]], run=0)


def test_recorded_items(run):
    ours = result(run("evaluate", "recorded_items", "items=morning", "planner=joint_dbl", *EVALUATION))
    assert ours["items"]["loop"] is True and ours["occupancy"]["mean"] > 0.8


@pytest.mark.parametrize(("name", "levels"), [("ramp", (2, 4)), ("careful", (2, 4))])
def test_own_curriculum(name, levels, monkeypatch):
    from hydra import compose, initialize_config_dir

    search = f"hydra.searchpath=[file://{EXAMPLES / 'own_curriculum'}]"
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        curriculum = build("curriculum", compose("train", [search, f"curriculum={name}"]).curriculum)
    curriculum.setup(1, 4, 400_000)
    assert (curriculum.level, curriculum.end) == levels and curriculum.check_budget(400_000) is None
    well = torch.full((200,), 0.9)
    seen = []
    for frames in range(0, 200_001, 50_000):
        shares = 0.5 * well if frames == 100_000 else well
        curriculum.update(torch.full((200,), curriculum.level), shares, frames)
        seen.append(curriculum.level)
    assert seen == {"ramp": [2, 3, 3, 3, 4], "careful": [3, 4, 3, 4, 4]}[name]


# ---------------------------------------------------------------------- commands
@pytest.mark.parametrize(
    ("main", "words"),
    [
        (commands.train, ["experiment=quick", "resume=", "docs/reference.md", "  gamma: 0.99", "Groups"]),
        (commands.evaluate, ["checkpoint=", "planner=joint_dbl", "compare=", "docs/reference.md", "Groups"]),
        (plan.main, ["--bin", "--tote", "JSON", "docs/robot.md"]),
        (export.main, ["card", "evaluation.json"]),
    ],
    ids=["train", "evaluate", "plan", "export"],
)
def test_help_says_what_to_do(main, words, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["command", "--help"])
    with contextlib.suppress(SystemExit):
        main()
    shown = capsys.readouterr().out
    for word in words:
        assert word in shown
    assert max(map(len, shown.splitlines())) <= 120
    assert not any(tmp_path.iterdir())


def test_hooks_fetch_nothing():
    import yaml

    hooks = yaml.safe_load((ROOT / ".ci" / "pre-commit.yaml").read_text())
    assert {repo["repo"] for repo in hooks["repos"]} == {"local"}


def test_the_robot_page_shows_what_the_planner_says():
    """The answer that docs/robot.md prints is the one that the process gives."""
    text = (DOCS / "robot.md").read_text()
    request, answer = re.findall(r"^(\{\"id\": 1.*\})$", text, re.MULTILINE)
    asked, told = json.loads(request), json.loads(answer)
    del asked["id"], told["id"]
    assert json.loads(json.dumps(Planner.load("pretrained/r4").plan(**asked, alternatives=0).as_dict())) == told
