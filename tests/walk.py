"""A newcomer's walk: three people follow README and docs line by line in a fresh clone and a fresh virtual environment.

``python tests/walk.py [researcher] [engineer] [contributor]``. Every command of their pages is run as it stands there,
but for settings at its end that make it small. The first one that fails ends the walk.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)

#: What makes a command small, by how it begins. Sizes, items and everything else stay as the page has them.
SMALL = {
    "pickplace-train resume=": "",
    "pickplace-train": "total_frames=512 env.num_envs=8 evaluation.episodes=4 threads=1",
    "pickplace-evaluate": "evaluation.episodes=4 evaluation.latency_decisions=0 threads=1",
    "make demo": 'ARGS="evaluation.episodes=2 threads=1"',
    "make train": 'RUN=outputs/made ARGS="total_frames=2048 evaluation.episodes=4 threads=1"',
    "make test": 'ARGS="tests/test_geometry.py"',
}

TRAINED = ["checkpoints/best/state.safetensors", "metrics.csv", "report.html", "learning_curve.png"]
EVALUATED = ["evaluation.json", "evaluation.md", "replay.html", "tote.png"]


class Stumble(Exception):
    """The page said one thing, and another one happened."""


class Walk:
    """A clone, its environment, and what is done in it."""

    def __init__(self, clone: Path, python: str):
        self.clone = clone
        self.environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
        self.environment |= {"PATH": f"{clone / '.venv/bin'}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
        self.environment |= {"PYTHON": python}

    def run(self, command: str, where: str = "", given: str | None = None) -> str:
        """What a command prints.

        Raises:
            Stumble: if it fails.
        """
        began = time.monotonic()
        tell(f"  $ {command}")
        done = subprocess.run(
            ["bash", "-ec", command], cwd=self.clone, env=self.environment, input=given,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        if done.returncode:
            raise Stumble(f"{where}: {command}\nended with {done.returncode}:\n{done.stdout[-3000:]}")
        tell(f"    {time.monotonic() - began:.0f} s")
        return done.stdout

    def blocks(self, page: str, section: str | None = None) -> list[tuple[str, str]]:
        """Language and text of the code blocks of a page, or of one of its sections."""
        text = (self.clone / page).read_text()
        if section is not None:
            if f"\n## {section}\n" not in text:
                raise Stumble(f"{page}: there is no section {section!r}.")
            text = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
        return BLOCK.findall(text)

    def follow(self, page: str, section: str | None = None) -> None:
        """Do all that a page says: shell and Python blocks in their order, and files whose first line names them."""
        tell(f" {page}{f', {section}' if section else ''}")
        done = 0
        for language, body in self.blocks(page, section):
            named = re.match(r"# (mine/\S+)\n", body)
            if named:
                path = self.clone / named[1]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(body)
            elif language == "python" and page == "docs/robot.md":
                self.run("python -", page, given=body)
            elif language == "sh" and body.startswith("$ "):
                self.talk(body, page)
            elif language == "sh":
                for line in body.splitlines():
                    if line.strip() and not line.startswith("#"):
                        self.run(small(line), page)
            done += language in ("sh", "python")
        if not done:
            raise Stumble(f"{page}: nothing to do there; expected commands.")

    def talk(self, body: str, page: str) -> None:
        """A command, what is typed into it, and what it answers, line by line."""
        command, *lines = body.splitlines()
        typed, expected = lines[::2], lines[1::2]
        answers = self.run(command.removeprefix("$ "), page, given="\n".join(typed) + "\n").splitlines()
        if list(map(json.loads, answers)) != list(map(json.loads, expected)):
            raise Stumble(f"{page}: {command}\nanswered {answers}")

    def expect(self, folder: str, names: list[str]) -> None:
        """Files that the pages promise."""
        for name in names:
            if not (self.clone / folder / name).is_file():
                raise Stumble(f"{folder}: there is no {name}.")

    def write(self, path: str, text: str) -> None:
        """A file of the walker's own."""
        (self.clone / path).write_text(text)

    def edit(self, path: str, old: str, new: str) -> None:
        """A change of a file."""
        text = (self.clone / path).read_text()
        if text.count(old) != 1:
            raise Stumble(f"{path}: {old!r} is there {text.count(old)} times; expected once.")
        self.write(path, text.replace(old, new))


def small(line: str) -> str:
    """A command of a page without its comment, made small by settings at its end."""
    command = re.sub(r"\s+#.*", "", line).strip()
    begin = re.sub(r"^(\w+=\S+ )+", "", command)
    for start, settings in SMALL.items():
        if begin.startswith(start):
            if "total_frames=" in command and not settings:
                settings = "total_frames=1024"
            return f"{command} {settings}".strip()
    return command


def researcher(walk: Walk) -> None:
    """Wants another curriculum."""
    walk.follow("README.md", "Try it")
    walk.expect("outputs/demo", EVALUATED)
    walk.expect("outputs/made", TRAINED)
    walk.follow("README.md", "Train, resume, sweep")
    walk.follow("docs/curriculum.md")
    header = (walk.clone / "outputs/mine/metrics.csv").read_text().splitlines()[0]
    for metric in ("curriculum/level", "curriculum/progress", "curriculum/frames_at_level"):
        if metric not in header:
            raise Stumble(f"docs/curriculum.md: metrics.csv has no {metric}.")
    if len(list((walk.clone / "outputs/sweep").glob("*/*/report.html"))) != 12:
        raise Stumble("README.md, docs/curriculum.md: the sweeps did not leave nine and three runs.")


def engineer(walk: Walk) -> None:
    """Has depth maps, and items of a plant."""
    walk.follow("docs/robot.md")
    walk.follow("docs/train_your_own.md")
    for run in ("kinds", "ranges", "recorded", "morning", "own"):
        walk.expect(f"outputs/{run}", TRAINED)
    walk.expect("outputs/own_policy", EVALUATED)
    if "minus joint_dbl" not in (walk.clone / "outputs/own_policy/evaluation.md").read_text():
        raise Stumble("docs/train_your_own.md: the table has no paired difference.")


def contributor(walk: Walk) -> None:
    """Brings a planner in, as CONTRIBUTING.md says."""
    walk.follow("CONTRIBUTING.md", "Set up")
    walk.follow("docs/extending.md")
    tell(" CONTRIBUTING.md, Add a planner")
    example = walk.clone / "docs/examples/own_planner"
    walk.write("pickplace/planners/soft_dbl.py", (example / "own_planner.py").read_text())
    config = (example / "planner/soft_dbl.yaml").read_text()
    walk.write("conf/planner/soft_dbl.yaml", config.replace("own_planner.SoftDBL", "soft_dbl"))
    added = 'PLANNERS = {\n    "soft_dbl": "pickplace.planners.soft_dbl.SoftDBL",\n'
    walk.edit("pickplace/runs/registry.py", "PLANNERS = {\n", added)
    walk.run("make format")
    walk.run("python docs/reference.py")
    walk.run("git add --all")
    walk.run("git -c user.name=New -c user.email=new@example.org commit --quiet -m 'Add planner soft_dbl'", "the hooks")
    walk.run("make lint")
    walk.run("make test ARGS='tests/test_config.py tests/test_docs.py -k \"soft_dbl or reference\"'")
    walk.run("pickplace-evaluate planner=soft_dbl " + SMALL["pickplace-evaluate"])


WALKERS = {walker.__name__: walker for walker in (researcher, engineer, contributor)}


def tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def borrow(walk: Walk, folder: Path, python: str) -> None:
    """An environment that takes its packages from another one, to try this script without installing them again."""
    walk.run(f"{python} -m venv .venv")
    packages = next(folder.glob("lib/python*/site-packages"))
    (next((walk.clone / ".venv").glob("lib/python*/site-packages")) / "borrowed.pth").write_text(f"{packages}\n")
    for script in (folder / "bin").iterdir():
        if not (walk.clone / ".venv/bin" / script.name).exists() and "pickplace" not in script.name:
            (walk.clone / ".venv/bin" / script.name).symlink_to(script)
    walk.run("pip install --quiet --no-deps -e . && touch .venv/.installed")


def main() -> int:
    """Walk, and say where it ended."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("who", nargs="*", help=f"any of {', '.join(WALKERS)}; default: all of them")
    options.add_argument("--python", default=sys.executable, help="what the virtual environment is made with")
    options.add_argument("--borrow", type=Path, metavar="VENV", help="take installed packages from there")
    options.add_argument("--keep", action="store_true", help="leave the clone, and say where it is")
    args = options.parse_args()
    if unknown := set(args.who) - set(WALKERS):
        options.error(f"{min(unknown)}: expected any of {', '.join(WALKERS)}.")
    folder, began = Path(tempfile.mkdtemp(prefix="walk-")), time.monotonic()
    try:
        walk = Walk(folder / "pickplace", args.python)
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(walk.clone)], check=True)
        if args.borrow:
            borrow(walk, args.borrow.resolve(), args.python)
        else:
            walk.run("make install")
        for name in args.who or WALKERS:
            tell(f"{name}: {WALKERS[name].__doc__}")
            WALKERS[name](walk)
    except Stumble as stumble:
        tell(f"STUMBLED at {stumble}")
        return 1
    finally:
        if args.keep:
            tell(f"The clone is in {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    tell(f"Arrived after {(time.monotonic() - began) / 60:.0f} minutes.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
