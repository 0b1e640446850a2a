"""Change the code at random places, one at a time, and see whether the tests notice.

python tests/long/mutations.py [--count 40] [--seed 0] [--list]

The places and the changes are drawn from the operators of cosmic-ray (``pip install 'cosmic-ray>=8.3,<9'``), in a copy
of the checkout. The tests that mirror a changed file run first, then all. Lines whose change nobody could see are left
out: texts of errors, types, and sizes of caches.
"""

import argparse
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parents[2]
#: Folders and files that are changed, and the tests that run first.
TARGETS = {
    "pickplace/rules": ("tests/rules", "tests/envs", "tests/robot"),
    "pickplace/algorithms": ("tests/algorithms", "tests/training"),
    "pickplace/runs/resume.py": ("tests/runs", "tests/training"),
    "pickplace/config/allowlist.py": ("tests/config", "tests/test_bad_files.py"),
}
#: A line with one of these is not changed.
LEFT_OUT = ("raise ", 'f"', "lru_cache", "->", "import ", "@", "TypeVar", "Literal", "isinstance(", "MAX_", "_BYTES")
#: Changes that no result shows: pieces of a line, and of the operator's name.
SAME_RESULT = (
    ("", "BitAnd_Mul"),  # of masks
    ("", "BitOr_Add"),  # of masks
    ("cell.footprint_turns == 2", "Eq_GtE"),  # it is 1 or 2
    ("== 1", "Eq_LtE"),  # of counts, which are at least 1
    ("packed, slots =", ""),  # how many flags are copied at once
    ("max_side < MIN_SIDE", ""),  # which of two ways is taken
    ("self.side <= 64", "NumberReplacer"),  # both types are exact about there
    ("advantage > 0", "Gt_GtE"),  # either weight of zero
    *(("Resting(z < FAR,", change) for change in ("Lt_IsNot", "Lt_LtE", "Lt_NotEq")),  # outside, it is too high, too
    ("min(margins) < 0", "Lt_LtE"),  # nothing is cut then
    ('row["rotation"] or 0', "NumberReplacer"),  # a bin has one turn, the first and the last
    ("DIRECTIONS = ", ""),  # the margin makes up for what lies between two of them
)
#: Operators that change what any run sees at once, or that most often change nothing.
DULL = ("RemoveDecorator", "ExceptionReplacer", "VariableInserter", "VariableReplacer")


class Mutation(NamedTuple):
    """A change of one place: the file, its line, an operator and which of its places it is."""

    path: str
    line: int
    operator: str
    occurrence: int


def places(path: Path) -> Iterator[Mutation]:
    """Yield all changes of a file."""
    lines, nodes = path.read_text().splitlines(), list(ast_nodes(get_ast_from_path(path)))
    for name in sorted(operator_names()):
        if any(dull in name for dull in DULL):
            continue
        operator = get_operator(name)()
        found = (position for node in nodes for position in operator.mutation_positions(node))
        for occurrence, (start, _) in enumerate(found):
            text = lines[start[0] - 1]
            if "strict=True" in text and "TrueWithFalse" in name:  # lengths that are equal anyway
                continue
            if any(piece in text and change in name for piece, change in SAME_RESULT):
                continue
            if not any(word in text for word in LEFT_OUT) and not text.lstrip().startswith(("#", '"', "'")):
                yield Mutation(str(path.relative_to(ROOT)), start[0], name, occurrence)


def draw(count: int, seed: int) -> list[Mutation]:
    """Return changes, each of another line, drawn evenly over the lines.

    A line's text decides, so that the draw of a seed stays nearly the same when other lines change.
    """
    by_line: dict[str, list[Mutation]] = {}
    for target in TARGETS:
        for path in sorted((ROOT / target).rglob("*.py")) if (ROOT / target).is_dir() else [ROOT / target]:
            lines = path.read_text().splitlines()
            for mutation in places(path):
                by_line.setdefault(f"{seed} {mutation.path} {lines[mutation.line - 1]}", []).append(mutation)
    drawn = sorted(by_line, key=lambda line: hashlib.sha256(line.encode()).digest())[:count]
    return [random.Random(line).choice(by_line[line]) for line in drawn]


def run_tests(copy: Path, words: list[str]) -> bool:
    """Return whether the tests pass."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n",
        "logical",
        "--timeout",
        "600",
        "-p",
        "no:cacheprovider",
    ]
    variables = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [*command, *words], cwd=copy, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    return done.returncode == 0


def is_caught(mutation: Mutation, copy: Path) -> bool:
    """Return whether a test fails in a copy of the checkout with one change; the copy is as before afterwards."""
    path = copy / mutation.path
    source = path.read_text()
    changed = mutate_code(source, get_operator(mutation.operator)(), mutation.occurrence)
    assert changed is not None and changed != source, mutation
    first = next(list(tests) for target, tests in TARGETS.items() if mutation.path.startswith(target))
    path.write_text(changed)
    try:
        return not run_tests(copy, [name for name in first if (copy / name).exists()]) or not run_tests(copy, [])
    finally:
        path.write_text(source)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40, help="number of changes")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--list", action="store_true", help="list the changes only")
    given = parser.parse_args()
    survived = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "copy")
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "outputs", "__pycache__"))
        (copy / "outputs").mkdir()
        if not given.list and not run_tests(copy, []):
            sys.exit("The tests fail without a change, too; nothing was tried.")
        for mutation in draw(given.count, given.seed):
            line = (ROOT / mutation.path).read_text().splitlines()[mutation.line - 1].strip()
            caught = given.list or is_caught(mutation, copy)
            survived += not caught
            verdict = "" if given.list else "caught    " if caught else "SURVIVED  "
            operator = mutation.operator.removeprefix("core/")
            sys.stdout.write(f"{verdict}{mutation.path}:{mutation.line} {operator}\n          {line}\n")
            sys.stdout.flush()
    sys.exit(1 if survived else 0)


if __name__ == "__main__":
    main()
