"""Commands, code and links in README and docs work as they are printed."""

import functools
import importlib
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import pickplace
from pickplace import Planner, Scene
from pickplace.config.composition import compose_job
from pickplace.config.registry import build
from pickplace.config.words import config_files
from pickplace.evaluation import pack_command
from pickplace.physics import command as physics
from pickplace.policies import export
from pickplace.policies.restore import build_cell
from pickplace.serve import json_lines, serve

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))])
BLOCK = re.compile(r"^```(\w*)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PARSERS = {
    "plan": json_lines.parser,
    "physics": physics.parser,
    "serve": serve.parser,
    "export": export.parser,
    "pack": pack_command.parser,
}
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@each_page
def test_quoted_files_paths_links_and_make_targets_exist(page):
    text = page.read_text()
    assert [title for _, title, body in BLOCK.findall(text) if title and body != (DOCS / title).read_text()] == []
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE)) <= set(targets)
    paths = re.findall(r"\b(?:tests|pickplace|benchmarks|docs)/[\w/]+\.py\b", text)
    assert [path for path in paths if not (ROOT / path).is_file()] == []
    for target in re.findall(r"\]\(([^()\s]+)\)", BLOCK.sub("", text)):
        if "://" not in target:
            path, _, anchor = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            assert file.exists(), target
            headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", file.read_text()), re.MULTILINE) if anchor else []
            anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert not anchor or anchor in anchors, target


def test_the_site_and_the_index_list_every_page():
    site, index = (ROOT / ".ci/mkdocs.yml").read_text(), (DOCS / "index.md").read_text()
    for page in [*DOCS.glob("*.md"), ROOT / "CONTRIBUTING.md"]:
        assert f": {page.name.lower()}\n" in site and (page.name == "index.md" or f"{page.name})" in index), page.name


@each_page
def test_python_blocks_run(page, monkeypatch, tmp_path):
    """Run them in one namespace for each page, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    body = "\n".join(body for kind, title, body in BLOCK.findall(page.read_text()) if kind == "python" and not title)
    exec(compile(body, page.name, "exec"), {})


@pytest.fixture
def reference(monkeypatch):
    """Make the page of all settings."""
    monkeypatch.syspath_prepend(str(ROOT / ".ci"))
    return importlib.import_module("reference")


def commands_of(text):
    """Yield our commands on a page, in blocks and in text: the PYTHONPATH, the command, its words."""
    lines = [line for kind, _, body in BLOCK.findall(text) if kind == "sh" for line in body.splitlines()]
    for line in lines + re.findall(r"`(pickplace-[^`]+)`", BLOCK.sub("", text)):
        words = shlex.split(line.removeprefix("$ "), comments=True)
        path = words.pop(0).partition("=")[2] if words and words[0].startswith("PYTHONPATH=") else ""
        placeholders = any("..." in word or "<" in word or word == "--help" for word in words)
        if words[1:] and words[0].startswith("pickplace-") and not placeholders:
            yield path, words[0].removeprefix("pickplace-"), words[1:]


@functools.cache
def check_command(command, search, words, is_new):
    """Compose the config of a command, and check that a new training's curriculum can reach its end."""
    with config_files():
        _, cfg = compose_job(command, [*search, *words])
    if command == "train" and is_new:
        if (own := cfg["items"].get("path")) and not (ROOT / own).is_file():  # a reader's file
            cfg["items"]["path"] = str(DOCS / "examples" / "orders" / "orders.csv")
        items, curriculum = build("items", cfg["items"]), build("curriculum", cfg.curriculum)
        curriculum.setup(build_cell(OmegaConf.to_container(cfg.env, resolve=True)), items, cfg.total_frames)
        assert curriculum.check_budget(cfg.total_frames, 2048) is None, words


def run_of_sweep(word, number):
    """Return an override of one run of a sweep."""
    override = OverridesParser.create().parse_override(word)
    if not override.is_sweep_override():
        return word
    return f"{override.get_key_element()}={list(override.sweep_string_iterator())[number]}"


@each_page
def test_commands_compose_and_reach_their_last_height(page, monkeypatch):
    compose_commands(page.read_text(), monkeypatch)


def test_commands_in_comments_of_the_settings_compose(reference, monkeypatch):
    compose_commands(reference.page(), monkeypatch)


def compose_commands(text, monkeypatch):
    for path, command, words in commands_of(text):
        if command in PARSERS:
            PARSERS[command]().parse_args(words)
            continue
        monkeypatch.syspath_prepend(str(ROOT / path))
        search = ()
        if "--config-dir" in words:
            at = words.index("--config-dir")
            search = (f"hydra.searchpath=[file://{ROOT / words[at + 1]}]",)
            del words[at : at + 2]
        is_new = not any(word.startswith(("checkpoint=", "resume=")) for word in words)
        left_out = "-m$|hydra[./].*(sweeper|launcher|run[.]dir)|.*=tag" + "|model[.]|items[.]|algo[.]" * (not is_new)
        words = [word for word in words if not re.match(left_out, word)]
        for end in (0, -1):  # the first and the last run of a sweep
            chosen = [run_of_sweep(word, end) for word in words]
            check_command(command, search, tuple(chosen), is_new)


def test_the_page_of_the_python_interface_has_every_public_name():
    rows = re.findall(r"\[(\**)`(\w+)`\**\]\(\.\./([\w/]+)\.py\)", (DOCS / "api.md").read_text())
    for _, name, path in rows:
        found = getattr(importlib.import_module(path.replace("/", ".")), name)
        assert found.__module__ == path.replace("/", ".") and found.__doc__, name
    public = {name for bold, name, _ in rows if bold}
    assert public == set(pickplace.__all__) - {"__version__"} and len(rows) == len({name for _, name, _ in rows})


def test_the_site_builds(tmp_path):
    """Build the site strictly, if its tools are installed: a broken link or content from elsewhere is an error."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings_handlers.python")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--config-file", ".ci/mkdocs.yml"]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [*command, "--site-dir", str(tmp_path)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    html = (tmp_path / "api.html").read_text()
    assert "Observation space" in html and ":class:<code>" not in html and "::: " not in html
    assert (tmp_path / "overview.html").is_file() and (tmp_path / "concepts.svg").is_file()


def test_the_reference_has_every_option_and_every_key_has_a_comment(reference):
    files, page = reference.everything(), reference.page()
    for file in files.values():
        assert file.text and (file.group == "" or f"### `{file.group}={file.name}`" in page), file
        for key in file.settings:
            assert reference.meaning(key, file, files), f"conf/{file.group}/{file.name}.yaml: {key} has no comment"


def test_the_drawing_of_the_concepts_agrees_with_the_rules(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    importlib.import_module("concepts").draw()  # asserts that one grip collides and the other succeeds


def test_the_drawing_of_the_robots_frames_shows_a_plan(monkeypatch):
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    names = runpy.run_path(str(DOCS / "robot_frames.py"))
    assert names["plan"].status == "ok" and names["plan"].pick.yaw == pytest.approx(names["item"].yaw)


def test_the_page_of_the_service_shows_the_planners_answer():
    request, answer = re.findall(r"^(\{\"id\": 1.*\})$", (DOCS / "service.md").read_text(), re.MULTILINE)
    asked, told = ({key: value for key, value in json.loads(line).items() if key != "id"} for line in (request, answer))
    plan = Planner.load("pretrained/r4").plan(Scene.from_maps(**asked), alternatives=0)
    assert json.loads(json.dumps(plan.as_dict())) == told
