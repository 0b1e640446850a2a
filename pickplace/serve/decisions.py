"""The decision log: every request with its plan, one line of JSON each, and the planner that made them; its replay.

The first line of a service has ``start``: versions, planner, checkpoint and its checksum, and the cell. The lines after
it have ``time``, ``seconds``, ``request``, completed by the default settings, and ``reply``.
"""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pickplace.common.errors import sentence
from pickplace.common.files import MAX_BYTES, read_text
from pickplace.common.validate import excerpt, refuse_if
from pickplace.serve.deadline import Deadline
from pickplace.serve.options import read_planner
from pickplace.serve.request import MAX_DEADLINE, Answer, PlanRequest, solve

if TYPE_CHECKING:
    from pickplace.robot.planner import Planner


class DecisionLog:
    """A file to which lines are appended. Each is written at once, and the file may be moved away meanwhile.

    Args:
        path: the file.
        start: facts of the service, see :func:`service_facts`.

    Raises:
        OSError: if it cannot be written.
    """

    def __init__(self, path: str, start: dict):
        self._path, self._start, self._is_new = Path(path).absolute(), start, True
        self._append()

    def add(self, request: PlanRequest | None, reply: dict, seconds: float) -> None:
        """Append a request with all its settings (None if it could not be read) and its answer."""
        given = request and {key: value for key, value in vars(request).items() if value is not None}
        self._append({"time": time.time(), "seconds": round(seconds, 6), "request": given, "reply": reply})

    def _append(self, line: dict | None = None) -> None:
        with self._path.open("ab+") as file:
            size, lines = file.tell(), []
            if self._is_new or size == 0:  # each file names the planner of its plans
                lines.append(json.dumps({"start": self._start, "time": time.time()}))
            if line is not None:
                lines.append(json.dumps(line, default=vars))  # `default` is for boxes
            file.seek(max(0, size - 1))
            is_torn = file.read(1) not in (b"", b"\n")  # by a crash or a full disk
            file.write(("\n" * is_torn + "".join(f"{each}\n" for each in lines)).encode())
            self._is_new = False


def service_facts(planner: "Planner", args) -> dict[str, Any]:
    """Return the facts from which :func:`replay` makes the planner of a command line again."""
    from pickplace.policies.restore import cell_settings  # here, so that --help does not wait for torch
    from pickplace.runs.locate import read_facts
    from pickplace.runs.provenance import commit, versions

    sha256 = None if args.checkpoint is None else read_facts(args.checkpoint)["sha256"]
    return {
        "versions": versions(), "commit": commit(), "checkpoint": args.checkpoint, "sha256": sha256,
        "planner": read_planner(args.planner), "candidates": args.candidates, "cell": cell_settings(planner.cell),
    }  # fmt: skip


def replay(path: str, make) -> tuple[int, list[str]]:
    """Plan all requests of a decision log again.

    Args:
        path: the log.
        make: makes a planner from the value of ``start``.

    Returns:
        The number of equal plans, and a sentence for each plan that differs, and for each torn line. Requests without a
        plan are left out, such as those that passed their deadline.

    Raises:
        ValueError: naming the file and the line, for a line that no service wrote, or a planner that cannot be made
            again.
    """
    same, differing, planner = 0, [], None
    for number, line in _lines(path):
        place = f"{path}, line {number}"
        if isinstance(line, str):
            refuse_if(planner is None, f"{place}: {line}")
            differing.append(f"{place}: {line}")
            continue
        try:
            if "start" in line:
                planner = make(line["start"])
            elif planner is None:
                raise ValueError("expected a line with the key start before it.")
            elif "status" in line["reply"]:
                found, before = json.loads(_again(planner, line).text), line["reply"]
                same += found == before
                if changed := [key for key in {**before, **found} if before.get(key) != found.get(key)]:
                    key = next((key for key in ("error", "status", "action") if key in changed), changed[0])
                    differing.append(f"{place}: {key} is {excerpt(found.get(key))}, was {excerpt(before.get(key))}.")
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise ValueError(f"{place}: {sentence(error)}") from error
    return same, differing


def _again(planner: "Planner", line: dict) -> Answer:
    """Answer the request of a line again."""
    beginning = {key: line["reply"][key] for key in ("id",) if key in line["reply"]}
    return solve(planner, PlanRequest.parse(line["request"], {}), beginning, Deadline(MAX_DEADLINE))


def _lines(path: str) -> Iterator[tuple[int, dict | str]]:
    """Yield each line with its number; a sentence in place of one that is no object."""
    for number, text in enumerate(read_text(path, MAX_BYTES).splitlines(), 1):
        try:
            line = json.loads(text)
            refuse_if(not isinstance(line, dict), f"got {type(line).__name__}")
            yield number, line
        except (ValueError, RecursionError) as error:
            yield number, f"expected an object in JSON ({error})."
