"""Give the commands random bad input: python tests/long/fuzz.py [cases] [seed]

Five kinds of input take turns: config leaves, checkpoint leaves, maps, JSON lines and command lines. Each case runs in
a process of its own, and must end within 20 s, with at most 1.5 GB of memory: with success, or with exit code 2 and one
sentence. A training or an evaluation that has begun, and that the input only makes long, counts as a success; it is
ended. Plans are checked by the rules. Cases that break this are printed, and make the exit code 1.
"""

import copy
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf

TESTS = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(TESTS))

from commands import composed  # noqa: E402

from pickplace import CellSpec, Planner, Scene, State, cli  # noqa: E402
from pickplace.evaluation import evaluate  # noqa: E402, F401
from pickplace.policies.fcn_grasp.policy import FcnGrasp  # noqa: E402
from pickplace.rules.item import read_items  # noqa: E402
from pickplace.rules.masks import action_mask, footprint_mask, placing_maps  # noqa: E402
from pickplace.rules.state import EMPTY, surface_from  # noqa: E402
from pickplace.rules.step import apply  # noqa: E402
from pickplace.runs import checkpoint  # noqa: E402
from pickplace.serve.request import answer  # noqa: E402
from pickplace.training import train  # noqa: E402

SECONDS, BYTES = 20, 1.5e9
#: Printed by a training and by an evaluation when they have begun.
BEGUN = ("frames to train", "episodes to play")
SMOKE = ["experiment=smoke", "threads=1", "total_frames=256", "evaluation.episodes=2"]
DEFAULTS = {"tote_height": None, "cell_size": None, "accuracy": 0.003, "clearance": 0.005, "alternatives": 3}
REQUEST_KEYS = ("id", "bin_depth", "items", "tote_depth", "accuracy", "clearance", "more", *DEFAULTS)
#: Values in place of good ones.
VALUES = [
    None, True, False, 0, -0.0, -1, 0.5, 2, 7, 1e-320, 1e308, -1e308, 2**31, 2**53 + 1, 2**63, 2**64, 10**400, "", "x",
    "6", "\ud800", "\u0000", "\x1b[31m", "x" * 100_000, [], {}, [[]], [[1, 2], [3]], {"a": 1}, 0.24999999999, 1048575,
    1_000, 3_000, 65_536, 1_000_000, float("inf"), float("nan"), [3_000, 3_000, 1], [1_000, 1_000], [0, 1], "${seed}",
    "${oc.env:HOME}", "pickplace.items.distributions.Kinds", "os.system", "/proc/kmsg", "../x", ["a"] * 1_000,
]  # fmt: skip
#: Texts in place of a digit of a JSON line, which json.dumps would not write.
TEXTS = ["NaN", "-Infinity", "1e999", "9" * 4299, "9" * 5000, "[" * 900, "[" * 200_000, "1.", "00", "{}"]
WORDS = [
    "", "=", "+", "~", "++", "env", "env.", ".", "model", "model=", "=1", "[", "{", "${", "'", '"', "\\", ",", "..",
    "*", "seed", "null", "-m", "--cfg", "job", "--config-dir", "/nowhere", "hydra.run.dir", "resume", "checkpoint",
    "1e999", "curriculum/advance", "plateau", "callbacks", "planner", "mcts", "compare", "\n", "é", "\x00", "\x1b",
    "x" * 50_000,
]  # fmt: skip
DTYPES = (None, None, None, float, "f4", "f2", "i1", "u1", "u8", bool, complex, object, "U3", "M8[s]")


def bad_value(draw: random.Random, good=None):
    """Return a value in place of a good one; of a number often a multiple, which may only be too large."""
    if isinstance(good, (int, float)) and not isinstance(good, bool) and draw.random() < 0.7:
        return good * draw.choice((-1, 0, 2, 3, 3, 10, 10, 30, 100, 1_000, 10_000, 10**6, 10**9))
    return copy.deepcopy(draw.choice(VALUES))  # it may be damaged further


def places(tree, path: tuple = ()) -> list[tuple]:
    """Return the paths of all values in nested dicts and lists."""
    found = [path] if path else []
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        found += places(value, (*path, key))
    return found


def replace(tree, path: tuple, value) -> None:
    for key in path[:-1]:
        tree = tree[key]
    tree[path[-1]] = value


def run_command(name: str, words: list[str]) -> None:
    sys.argv = [f"pickplace-{name}", *words]
    getattr(cli, name)()


# ------------------------------------------------------------------ config leaves and command lines
def config_leaf(draw: random.Random, folder: Path) -> None:
    """Train or evaluate with one to three values of the config replaced, by groups drawn at random, too."""
    name = draw.choice(("train", "train", "evaluate"))
    words = [*SMOKE, f"model={draw.choice(('fcn_grasp', 'fcn4d', 'individual_rl', 'typical'))}"]
    words += [f"algo={draw.choice(('ppo', 'a2c'))}", f"curriculum={draw.choice(('adaptive', 'mixture', 'none'))}"]
    words += ["env.tote_size=[5,5,2]"]
    if name == "evaluate":
        planner = draw.choice(("joint_dbl", "mcts", "random", "corner", "lookahead"))
        words = [f"planner={planner}", "evaluation.episodes=2", "threads=1", "env.tote_size=[5,5,2]"]
    cfg = OmegaConf.to_container(composed(*words, name=name), resolve=True)
    paths = [path for path in places(cfg) if not isinstance(_at(cfg, path), dict) or draw.random() < 0.1]
    for _ in range(draw.choice((1, 1, 2, 3))):
        path = draw.choice(paths)
        key, value = ".".join(map(str, path)), bad_value(draw, _at(cfg, path))
        text = value if isinstance(value, str) else json.dumps(value).replace('"', "'").replace("Infinity", ".inf")
        words.append(f"{draw.choices(('', '+', '++'), (8, 1, 2))[0]}{key}={text}")
    report(words)
    run_command(name, [*words, f"hydra.run.dir={folder}/run"])


def command_line(draw: random.Random, folder: Path) -> None:
    """Run a command with one to four random words."""
    name = draw.choice(("train", "evaluate", "plan"))
    words = ["".join(draw.choices(WORDS, k=draw.randint(1, 4))) for _ in range(draw.randint(1, 4))]
    words = [word.replace("\x00", "") if draw.random() < 0.9 else word for word in words]
    report([name, *words])
    small = [] if name == "plan" else [*(SMOKE if name == "train" else ["planner=random", "evaluation.episodes=2"])]
    run_command(name, [*small, *words])


# ------------------------------------------------------------------ checkpoints
def checkpoint_leaf(draw: random.Random, folder: Path) -> None:
    """Resume, evaluate or plan with a checkpoint in which values, tensors or bytes are changed."""
    run = folder / "run"
    shutil.copytree(os.environ["FUZZ_RUN"], run)
    place = run / "checkpoints" / draw.choice(("best", "last"))
    state, facts = checkpoint.read(place)
    kind = draw.random()
    if kind < 0.5:
        part = draw.choice(("config", "config", None))
        path = draw.choice(places(facts[part] if part else facts))
        value = bad_value(draw, _at(facts[part] if part else facts, path))
        report([str(part), str(path), repr(value)[:80]])
        replace(facts[part] if part else facts, path, value)
        if draw.random() < 0.2:
            facts[draw.choice(("config", "more"))] = {str(n): n for n in range(draw.choice((10, 200_000)))}
    elif kind < 0.9:
        path = draw.choice([path for path in places(state) if not isinstance(_at(state, path), dict)])
        value = _at(state, path)
        if isinstance(value, torch.Tensor) and value.numel():
            value = _damaged_tensor(draw, value.clone())
        else:
            value = draw.choice((None, -1, 2**62, 0.5, "x", torch.zeros(3)))
        report([str(path), repr(value)[:80]])
        replace(state, path, value)
    if kind < 0.9:
        try:
            checkpoint.write(place, state, facts)
        except (TypeError, ValueError, UnicodeEncodeError):  # not JSON: no training could have written it
            return
    else:
        file = place / draw.choice(("state.json", "state.safetensors"))
        blob = bytearray(file.read_bytes())
        for _ in range(draw.choice((1, 5, 50))):
            blob[draw.randrange(len(blob))] = draw.randrange(256)
        file.write_bytes(blob[: draw.choice((len(blob), len(blob) // 2))])
    use = draw.choice(("train", "evaluate", "plan"))
    if use == "train":
        run_command("train", [f"resume={place}", "total_frames=512"])
    elif use == "evaluate":
        words = [f"checkpoint={place}", "evaluation.episodes=2", "threads=1", f"hydra.run.dir={folder}/evaluation"]
        run_command("evaluate", words)
    else:
        plan_maps(draw, folder, str(place), [])


def _at(tree, path: tuple):
    for key in path:
        tree = tree[key]
    return tree


def _damaged_tensor(draw: random.Random, tensor: torch.Tensor) -> torch.Tensor:
    change = draw.randrange(4)
    if change == 0:
        return tensor.flatten()[: max(1, tensor.numel() // 2)]
    if change == 1:
        return tensor.to(draw.choice((torch.float64, torch.int32, torch.bool, torch.complex64)))
    number = draw.choice((-1, 0, 7, 127, 2**31 - 1, float("nan"), float("inf"), 1e30))
    if not tensor.is_floating_point():
        number = 1 if tensor.dtype == torch.bool else min(number if abs(number) < 2**31 else -9, 127)
        number = 9 if number != number else int(number) % 256 if tensor.dtype == torch.uint8 else int(number)
    tensor.view(-1)[draw.randrange(tensor.numel())] = number
    return tensor


# ------------------------------------------------------------------ requests to the robot's planner
def maps(draw: random.Random, folder: Path) -> None:
    """Plan with damaged maps: as files for ``pickplace-plan``, or as arrays in Python."""
    request = damage(draw, good_request(draw, CellSpec()))
    report([repr(request)[:300]])
    if draw.random() < 0.5:
        flags = draw.choice(([], [], ["--accuracy", "0.7"], ["--cell-size", "-1"], ["--tote-height", "1e9"]))
        plan_maps(draw, folder, "pretrained/r4", flags, request)
        return
    values = {key: as_array(draw, request.get(key)) for key in ("bin_depth", "tote_depth")}
    cell = CellSpec()
    planner = Planner(cell, FcnGrasp(cell, filters=8, hidden=8).eval())
    given = {key: request[key] for key in DEFAULTS if key in request}
    alternatives = {"alternatives": given.pop("alternatives")} if "alternatives" in given else {}
    try:
        plan = planner.plan(Scene.from_maps(**values, **given), **alternatives)
    except ValueError as error:
        raise SystemExit(_sentence(str(error))) from None
    json.dumps(plan.as_dict(), allow_nan=False)


def plan_maps(draw: random.Random, folder: Path, place: str, flags: list[str], request: dict | None = None) -> None:
    """Run ``pickplace-plan`` on two files."""
    request = request or good_request(draw, CellSpec(tote_size=(4, 4, 1)))
    words = [place, "--threads", "1", *flags]
    for key, flag in (("bin_depth", "--bin"), ("tote_depth", "--tote")):
        file = folder / f"{key}.npy"
        try:
            np.save(file, as_array(draw, request.get(key)))
        except (ValueError, TypeError, OverflowError):
            file.write_text(repr(request.get(key))[:10_000], errors="replace")
        if draw.random() < 0.2:
            blob = bytearray(file.read_bytes())
            blob[draw.randrange(min(200, len(blob)))] = draw.randrange(256)
            file.write_bytes(blob)
        words += [flag, str(file)]
    run_command("plan", words)


def json_line(draw: random.Random, folder: Path) -> None:
    """Answer a damaged line, and check the answer."""
    cell = draw.choice((
        CellSpec(),
        CellSpec((4, 6, 2), (5, 7, 6), effector_size=(2, 3), rotations=2),
        CellSpec((3, 3, 1), (4, 4, 3), effector_size=(1, 1), rotations=1, pick_rule="overlap"),
    ))  # fmt: skip
    policy = FcnGrasp(cell, filters=8, hidden=8).eval()
    planner = Planner(policy.cell, policy, draw.choice(("all", 5)))
    line = line_of(draw, damage(draw, good_request(draw, cell)))
    report([cell.describe(), repr(line[:300])])
    _, reply, _ = answer(planner, line, DEFAULTS)
    text = json.dumps(reply, allow_nan=False)
    assert "\n" not in text and json.loads(text).keys() == reply.keys()
    if "error" in reply:
        assert set(reply) <= {"id", "error"}
        raise SystemExit(_sentence(reply["error"]))
    request = json.loads(line)
    if request.get("cell_size"):
        return  # in metres; tests/robot/test_measured.py checks those
    rim = round(request.get("tote_height") or planner.cell.tote_size[2])
    depths = (np.round(np.array(request[key], dtype=float)).astype(int) for key in ("bin_depth", "tote_depth"))
    bin_depth, tote_depth = (torch.from_numpy(values)[None] for values in depths)
    item = read_items(bin_depth.float())
    check_plan(planner.cell, State(surface_from(rim - tote_depth), torch.tensor([rim]), item), reply)


def check_plan(cell: CellSpec, state: State, plan: dict) -> None:
    """Check a plan's status and effect by the rules."""
    feasible = action_mask(cell, placing_maps(cell, state))[0]
    if plan["status"] in ("ok", "rejected"):
        assert feasible.any()
    else:
        empty = state._replace(surface=torch.full_like(state.surface, EMPTY))
        fits_empty = footprint_mask(cell, placing_maps(cell, empty)).any()
        assert not feasible.any() and plan["status"] == ("stuck" if fits_empty else "impossible")
    if plan["status"] == "ok":
        assert feasible[plan["action"]]
        assert int(apply(cell, state, torch.tensor([plan["action"]])).failure) == 0
        gain = (plan["occupancy_after"] - plan["occupancy_before"]) * int(state.tote_height) * cell.num_places
        assert abs(gain - int(state.items.volume)) < 1e-6


def good_request(draw: random.Random, cell: CellSpec) -> dict:
    """Return a request as a camera would send it."""
    (bin_w, bin_d, _), (tote_w, tote_d, rim) = cell.bin_size, cell.tote_size
    w, d, h = (draw.randint(1, 3) for _ in range(3))
    x, y = draw.randint(0, bin_w - w), draw.randint(0, bin_d - d)
    bin_depth = np.zeros((bin_w, bin_d), dtype=int)
    bin_depth[x : x + w, y : y + d] = h
    tote_depth = [[draw.randint(0, rim) for _ in range(tote_d)] for _ in range(tote_w)]
    return {"bin_depth": bin_depth.tolist(), "tote_depth": tote_depth}


def damage(draw: random.Random, request: dict) -> dict:
    """Replace, remove or change up to four parts of a request."""
    for _ in range(draw.choice((0, 1, 1, 1, 2, 4))):
        key, kind = draw.choice(REQUEST_KEYS), draw.random()
        rows = request.get(key)
        if kind < 0.15:
            request.pop(key, None)
        elif kind < 0.5 or not isinstance(rows, list) or not rows:
            request[key] = bad_value(draw)
        elif kind < 0.6:
            request[key] = rows[:-1] if draw.random() < 0.5 else [*rows, rows[0]]
        elif isinstance(row := draw.choice(rows), list) and row:
            index = draw.randrange(len(row))
            changed = isinstance(row[index], int) and draw.random() < 0.5
            row[index] = row[index] + draw.choice((-1, 1, 0.2, 0.3)) if changed else bad_value(draw)
        else:
            rows[draw.randrange(len(rows))] = bad_value(draw)
    return request


def line_of(draw: random.Random, request: dict) -> bytes:
    """Return a request as a line, sometimes with wrong text, encoding or bytes."""
    text = json.dumps(request)
    if draw.random() < 0.2:
        index = draw.choice([index for index, letter in enumerate(text) if letter in "0123456789"] or [0])
        text = text[:index] + draw.choice(TEXTS) + text[index + 1 :]
    line = text.encode(draw.choice(("utf-8", "utf-8", "utf-8", "utf-16", "latin-1")))
    for _ in range(draw.choice((0, 0, 0, 1, 3))):
        index = draw.randrange(len(line) + 1)
        other = bytes([draw.randrange(256)]) + line[index + 1 :]
        shorter, repeated = line[index + draw.randint(1, 9) :], line[max(0, index - 20) :]
        line = line[:index] + draw.choice((other, shorter, b"", repeated))
    return line


def as_array(draw: random.Random, value):
    """Return the value as an array of some type, sometimes turned or with odd numbers; as it is if numpy refuses."""
    kind = draw.choice(DTYPES)
    try:
        with np.errstate(all="ignore"):
            value = np.array(value, dtype=kind)
            if value.ndim and draw.random() < 0.3:
                value = draw.choice((value.T, value[None], value[..., ::-1]))
            if value.dtype.kind == "f" and value.size and draw.random() < 0.2:
                value.flat[draw.randrange(value.size)] = draw.choice((float("nan"), float("inf"), -0.0))
    except (ValueError, TypeError, OverflowError):
        pass
    return value


# ------------------------------------------------------------------ the run
KINDS = {
    "config leaf": config_leaf,
    "checkpoint leaf": checkpoint_leaf,
    "map": maps,
    "JSON line": json_line,
    "command line": command_line,
}


def report(words: list[str]) -> None:
    """Note what a case does, for its message."""
    Path("case.txt").write_text(" ".join(word[:200] for word in words), errors="backslashreplace")


def _sentence(text: str) -> str:
    return f"error: {text}"


def run_case(kind: str, seed: str) -> tuple[str, str]:
    """Run a case in a process of its own; return its outcome, and what is wrong with it, or an empty text."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        if not (child := os.fork()):
            _child(kind, seed, folder)
        end = time.monotonic() + SECONDS
        while not (ended := os.wait4(child, os.WNOHANG))[0] and time.monotonic() < end:
            time.sleep(0.01)
        late = not ended[0]
        if late:
            os.killpg(child, signal.SIGKILL)
            ended = os.wait4(child, 0)
        code, used = os.waitstatus_to_exitcode(ended[1]), ended[2].ru_maxrss * 1024
        out, err, case = (
            (folder / file).read_text(errors="replace") if (folder / file).exists() else ""
            for file in ("stdout", "stderr", "case.txt")
        )
        long_run = late and any(words in out for words in BEGUN)
        said = code == 2 and err.rpartition("\n")[0].rpartition("\n")[2].startswith("error: ") and len(err) < 3_000
        wrong = ""
        if "Traceback" in err or "HYDRA_FULL_ERROR" in err:
            wrong = "a traceback"
        elif late and not long_run:
            wrong = f"more than {SECONDS} s"
        elif used > BYTES:
            wrong = f"{used / 1e9:.2f} GB"
        elif not late and code not in (0, 130) and not said:
            wrong = f"exit code {code} without a sentence"
        elif any(not letter.isprintable() for letter in err.replace("\n", "")):
            wrong = "control characters"
        outcome = "long" if long_run else "refused" if said else "accepted"
        return outcome, wrong and f"{kind}, seed {seed}: {wrong}: {case[:600]}\n{err[-1500:]}"


def _child(kind: str, seed: str, folder: Path) -> None:
    """Run the case and end this process."""
    os.setsid()
    os.chdir(folder)
    for number, file in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(folder / file, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    code = 0
    try:
        torch.manual_seed(0)
        KINDS[kind](random.Random(seed), folder)
    except SystemExit as exit:
        if isinstance(exit.code, str):
            sys.stderr.write(f"{exit.code}\n")
        code = exit.code if isinstance(exit.code, int) else 2 if exit.code else 0
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main() -> None:
    given = sys.argv[1:]
    cases, seed = (int(word) for word in given + ["3000", "0"][len(given) :])
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    counts: Counter = Counter()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FUZZ_RUN"] = f"{folder}/run"
        if not (child := os.fork()):  # this process must not use torch, or its children could not
            run = Path(folder) / "run"
            run.mkdir()
            train.train(composed(*SMOKE), run)
            os._exit(0)
        os.waitpid(child, 0)
        for number in range(cases):
            kind = list(KINDS)[number % len(KINDS)]
            outcome, wrong = run_case(kind, f"{seed}-{number}")
            counts[kind, "wrong" if wrong else outcome] += 1
            if wrong:
                sys.stdout.write(f"{wrong}\n")
                sys.stdout.flush()
    for (kind, outcome), count in sorted(counts.items()):
        sys.stdout.write(f"{kind:16} {outcome:9} {count:5}\n")
    sys.exit(any(outcome == "wrong" for _, outcome in counts))


if __name__ == "__main__":
    main()
