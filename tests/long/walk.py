"""Follow README and docs line by line in a fresh clone and a fresh virtual environment, as three newcomers would.

python tests/long/walk.py [researcher] [engineer] [contributor]

Every command of a page runs as printed, plus settings at its end that make it small. The first one that fails ends the
walk.
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

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUN_PYTHON = ("docs/robot.md",)  # pages whose Python blocks are run; test_docs.py runs the others
SKIPPED = ("git clone", "cd ", "make install", "pip install")

#: Settings that make a command small, by how it begins.
SMALL = {
    "pickplace-train resume=": "",
    "pickplace-train": "total_frames=512 env.num_envs=8 evaluation.episodes=4 threads=1",
    "pickplace-evaluate": "evaluation.episodes=4 evaluation.latency_decisions=0 threads=1",
    "make demo": 'ARGS="evaluation.episodes=2 threads=1"',
    "make train": 'RUN=outputs/made ARGS="total_frames=2048 evaluation.episodes=4 threads=1"',
    "make test": 'ARGS="tests/task"',
}

TRAINED = ("checkpoints/best/state.safetensors", "metrics.csv", "report.html", "learning_curve.png")
EVALUATED = ("evaluation.json", "evaluation.md", "replay.html", "tote.png")


class PageError(Exception):
    """A page promises something that does not happen."""


def report(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def make_small(line: str) -> str:
    """Return a command of a page without its comment, with settings at its end that make it small."""
    command = re.sub(r"\s+#.*", "", line).strip()
    program = re.sub(r"^(\w+=\S+ )+", "", command)
    for start, settings in SMALL.items():
        if program.startswith(start):
            if "total_frames=" in command and not settings:
                settings = "total_frames=1024"
            return f"{command} {settings}".strip()
    return command


class Walk:
    """A clone with its own environment.

    Args:
        clone: folder of the clone.
        python: interpreter from which the environment is made.
    """

    def __init__(self, clone: Path, python: str):
        self.clone = clone
        kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
        path = f"{clone / '.venv/bin'}{os.pathsep}{os.environ['PATH']}"
        self.environment = {**kept, "PATH": path, "OMP_NUM_THREADS": "1", "PYTHON": python}

    def run(self, command: str, page: str = "", typed: str | None = None) -> str:
        """Run a command in the clone and return its output.

        Raises:
            PageError: if it fails.
        """
        began = time.monotonic()
        report(f"  $ {command}")
        done = subprocess.run(
            ["bash", "-ec", command], cwd=self.clone, env=self.environment, input=typed,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        if done.returncode:
            raise PageError(f"{page}: {command}\nended with {done.returncode}:\n{done.stdout[-3000:]}")
        report(f"    {time.monotonic() - began:.0f} s")
        return done.stdout

    def follow(self, page: str, section: str | None = None) -> None:
        """Run the commands of a page or of one section, and write the files whose first line names them."""
        report(f" {page}{f', {section}' if section else ''}")
        text = (self.clone / page).read_text()
        if section is not None:
            if f"\n## {section}\n" not in text:
                raise PageError(f"{page}: there is no section {section!r}.")
            text = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
        commands = 0
        for language, body in BLOCK.findall(text):
            if named := re.match(r"# (mine/\S+)\n", body):
                path = self.clone / named[1]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(body)
            elif language == "python" and page in RUN_PYTHON:
                self.run("python -", page, typed=body)
            elif language == "sh" and body.startswith("$ "):
                self.follow_dialogue(body, page)
            elif language == "sh":
                for line in body.splitlines():
                    if line.strip() and not line.startswith(("#", *SKIPPED)):
                        self.run(make_small(line), page)
            commands += language in ("sh", "python")
        if not commands:
            raise PageError(f"{page}: expected commands, found none.")

    def follow_dialogue(self, body: str, page: str) -> None:
        """Run a command, type the page's requests and compare the answers."""
        command, *lines = body.splitlines()
        answers = self.run(command.removeprefix("$ "), page, typed="\n".join(lines[::2]) + "\n").splitlines()
        if list(map(json.loads, answers)) != list(map(json.loads, lines[1::2])):
            raise PageError(f"{page}: {command}\nanswered {answers}")

    def expect(self, folder: str, names: tuple[str, ...]) -> None:
        """Check that files exist which the pages promise."""
        for name in names:
            if not (self.clone / folder / name).is_file():
                raise PageError(f"{folder}: there is no {name}.")


def researcher(walk: Walk) -> None:
    """Reads the README, and wants another curriculum."""
    walk.follow("README.md")
    walk.expect("outputs/demo", EVALUATED)
    walk.expect("outputs/made", TRAINED)
    walk.follow("docs/curriculum.md")
    header = next((walk.clone / "outputs/train").glob("*/metrics.csv")).read_text().splitlines()[0]
    for metric in ("curriculum/level", "curriculum/progress", "curriculum/frames_at_level"):
        if metric not in header:
            raise PageError(f"docs/curriculum.md: metrics.csv has no {metric}.")


def engineer(walk: Walk) -> None:
    """Has depth maps and the items of a plant."""
    walk.follow("docs/robot.md")
    walk.follow("docs/train_your_own.md")
    for run in ("kinds", "ranges", "recorded", "morning", "own"):
        walk.expect(f"outputs/{run}", TRAINED)
    walk.expect("outputs/own_policy", EVALUATED)
    if "minus joint_dbl" not in (walk.clone / "outputs/own_policy/evaluation.md").read_text():
        raise PageError("docs/train_your_own.md: the table has no paired difference.")


def contributor(walk: Walk) -> None:
    """Moves the planner of docs/examples into the package."""
    walk.follow("CONTRIBUTING.md", "Set up")
    walk.follow("docs/extending.md")
    example = walk.clone / "docs/examples/own_planner"
    config = next((example / "planner").glob("*.yaml"))
    name, text = config.stem, config.read_text()
    target = re.search(r"_target_: own_planner\.(\w+)", text)
    (walk.clone / f"pickplace/planners/{name}.py").write_text((example / "own_planner.py").read_text())
    (walk.clone / f"conf/planner/{config.name}").write_text(text.replace(target[0], f"_target_: {name}"))
    registry = walk.clone / "pickplace/runs/registry.py"
    line = f'PLANNERS = {{\n    "{name}": "pickplace.planners.{name}.{target[1]}",'
    registry.write_text(registry.read_text().replace("PLANNERS = {", line, 1))
    for command in (
        "make format",
        "python docs/reference.py",
        "git add --all",
        "git -c user.name=New -c user.email=new@example.org commit --quiet -m 'Add a planner'",  # runs the hooks
        "make lint",
        f"make test ARGS='-k \"{name} or reference or comment\"'",
        f"pickplace-evaluate planner={name} {SMALL['pickplace-evaluate']}",
    ):
        walk.run(command, "CONTRIBUTING.md")


WALKERS = {walker.__name__: walker for walker in (researcher, engineer, contributor)}


def borrow_packages(walk: Walk, folder: Path, python: str) -> None:
    """Make an environment that takes its packages from another one, to try this script without installing them."""
    walk.run(f"{python} -m venv .venv")
    packages = next(folder.glob("lib/python*/site-packages"))
    (next((walk.clone / ".venv").glob("lib/python*/site-packages")) / "borrowed.pth").write_text(f"{packages}\n")
    for script in (folder / "bin").iterdir():
        if not (walk.clone / ".venv/bin" / script.name).exists() and "pickplace" not in script.name:
            (walk.clone / ".venv/bin" / script.name).symlink_to(script)
    walk.run("pip install --quiet --no-deps -e . && touch .venv/.installed")


def main() -> int:
    """Follow the pages and say where it ended."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("who", nargs="*", help=f"any of {', '.join(WALKERS)}; default: all of them")
    options.add_argument("--python", default=sys.executable, help="interpreter for the virtual environment")
    options.add_argument("--borrow", type=Path, metavar="VENV", help="take installed packages from there")
    options.add_argument("--keep", action="store_true", help="keep the clone and print its folder")
    args = options.parse_args()
    if unknown := set(args.who) - set(WALKERS):
        options.error(f"{min(unknown)}: expected any of {', '.join(WALKERS)}.")
    folder, began = Path(tempfile.mkdtemp(prefix="walk-")), time.monotonic()
    walk = Walk(folder / "pickplace", args.python)
    try:
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(walk.clone)], check=True)
        if args.borrow:
            borrow_packages(walk, args.borrow.resolve(), args.python)
        else:
            walk.run("make install")
        for name in args.who or WALKERS:
            report(f"{name}: {WALKERS[name].__doc__}")
            WALKERS[name](walk)
    except PageError as error:
        report(f"FAILED at {error}")
        return 1
    finally:
        if args.keep:
            report(f"The clone is in {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    report(f"Finished after {(time.monotonic() - began) / 60:.0f} minutes.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
