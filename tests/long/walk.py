"""Run the commands of README and docs in a fresh clone with a fresh virtual environment.

python tests/long/walk.py [page ...]

Every command of a page's ``sh`` blocks runs as printed, plus settings at its end that make it small. The first one that
fails ends the walk. What ``tests/test_docs.py`` checks (Python blocks, dialogues with ``pickplace-plan``) is left out.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = ("README.md", "docs/curriculum.md", "docs/service.md", "docs/train_your_own.md", "docs/extending.md")
RUN_PYTHON = "docs/service.md"  # its Python writes the files that its commands read
LEFT_OUT = (
    "#", "git clone", "cd ", "make install", "pip install", ". ",
    "pickplace-serve", "PICKPLACE_TOKEN=", "curl ", "pickplace-export",  # a server does not end; the rest needs extras
)  # fmt: skip

#: Settings that make a command small, by how it begins; the first one that fits.
SMALL = {
    "pickplace-train resume=": "",
    "pickplace-train": "total_frames=512 env.num_envs=8 evaluation.episodes=4 threads=1",
    "pickplace-evaluate": "evaluation.episodes=4 evaluation.latency_decisions=0 threads=1",
    "make demo": 'DEMO=outputs/demo ARGS="evaluation.episodes=2 threads=1"',
    "make train": 'RUN=outputs/made ARGS="total_frames=2048 evaluation.episodes=4 threads=1"',
    "make test": 'ARGS="tests/rules"',
}

#: Files of which the pages speak.
EXPECTED = {
    "README.md": ("outputs/demo/replay.html", "outputs/made/report.html", "outputs/made/evaluation/tote.png"),
    "docs/train_your_own.md": ("outputs/own/checkpoints/best", "outputs/own_policy/evaluation.md"),
}


def make_small(line: str) -> str:
    """Return a command of a page without its comment, with settings at its end that make it small."""
    command = re.sub(r"\s+#.*", "", line).strip()
    program = re.sub(r"^(\w+=\S+ )+", "", command)
    settings = next((SMALL[start] for start in SMALL if program.startswith(start)), "")
    if " resume=" in command and "total_frames=" in command:
        settings = "total_frames=1024"
    return f"{command} {settings}".strip()


def commands_of(page: str, text: str) -> list[tuple[str, str]]:
    """Return the commands of a page, and what is typed into each."""
    found = []
    for language, body in BLOCK.findall(text):
        if language == "python" and page == RUN_PYTHON:
            found.append(("python -", body))
        elif language == "sh" and not body.startswith("$ "):
            lines = [line for line in body.splitlines() if line.strip() and not line.startswith(LEFT_OUT)]
            found += [(make_small(line), "") for line in lines]
    return found


def run(command: str, clone: Path, environment: dict[str, str], typed: str = "") -> None:
    """Run a command in the clone; exit with its output if it fails."""
    began = time.monotonic()
    sys.stdout.write(f"  $ {command}\n")
    sys.stdout.flush()
    done = subprocess.run(
        ["bash", "-ec", command], cwd=clone, env=environment, input=typed, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{command}\nended with {done.returncode}:\n{done.stdout[-3000:]}")
    sys.stdout.write(f"    {time.monotonic() - began:.0f} s\n")


def walk(page: str, clone: Path, environment: dict[str, str]) -> None:
    """Run the commands of a page, and look for the files of which it speaks."""
    sys.stdout.write(f" {page}\n")
    found = commands_of(page, (clone / page).read_text())
    if not found:
        sys.exit(f"{page}: expected commands, found none.")
    for command, typed in found:
        run(command, clone, environment, typed)
    for name in EXPECTED.get(page, ()):
        if not (clone / name).exists():
            sys.exit(f"{page}: there is no {name}.")


def main() -> None:
    """Follow the pages."""
    with tempfile.TemporaryDirectory(prefix="walk-") as folder:
        clone = Path(folder) / "pickplace"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
        path = f"{clone / '.venv/bin'}{os.pathsep}{os.environ['PATH']}"
        environment |= {"PATH": path, "OMP_NUM_THREADS": "1", "PYTHON": sys.executable}
        run("make install", clone, environment)
        for page in sys.argv[1:] or PAGES:
            walk(page, clone, environment)


if __name__ == "__main__":
    main()
