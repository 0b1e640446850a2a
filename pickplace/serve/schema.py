"""OpenAPI schemas of requests and plans: units, frames and examples."""

import inspect
import re
from dataclasses import fields

from pydantic import TypeAdapter

from pickplace.robot.box import Box
from pickplace.robot.planner import Alternative, Plan
from pickplace.robot.problem import Pose
from pickplace.serve.request import PlanRequest

GRID = {"bin_depth": [[0] * 5, [0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0] * 5, [0] * 5], "tote_depth": [[5] * 6] * 6}
METRES = {
    "items": [{"x": 0.1, "y": 0.12, "w": 0.09, "d": 0.04, "h": 0.05, "yaw": 20}],
    "tote_depth": [[0.25] * 6] * 6,
    "cell_size": 0.05,
}

FRAME = (
    "The origin is the outer corner of cell (0, 0) on the inner floor; x runs along the first axis of the map, y along "
    "the second, z upwards."
)


def request_schema() -> dict[str, dict]:
    """Return the schemas of a request and of its parts, by name."""
    schema = TypeAdapter(PlanRequest).json_schema(ref_template="#/components/schemas/{model}")
    parts = schema.pop("$defs", {})
    for key in fields(PlanRequest):
        schema["properties"][key.name]["description"] = key.metadata["description"]
    schema |= {"examples": [GRID, METRES], "required": ["tote_depth"], "additionalProperties": False}
    return {**parts, "PlanRequest": schema}


def with_comments(schemas: dict[str, dict]) -> None:
    """Describe each field of a plan by its comment; the reference in the docs is made from the same comments."""
    for part in (Plan, Pose, Alternative, Box):
        schema = schemas[part.__name__]
        schema["description"] = " ".join(f"{inspect.getdoc(part)} {FRAME}".replace("``", "").split())
        for key, text in comments(part).items():
            schema["properties"][key]["description"] = text


def comments(part: type) -> dict[str, str]:
    """Return the ``#:`` comments of a dataclass, before or behind its fields, by the fields' names."""
    found: dict[str, str] = {}
    before: list[str] = []
    for line in inspect.getsource(part).splitlines():
        if alone := re.fullmatch(r"\s+#: (.*)", line):
            before.append(alone[1])
        elif declared := re.match(r"    (\w+): [^#]*(?:#: (.*))?$", line):
            text = " ".join([*before, *([declared[2]] if declared[2] else [])])
            found |= {declared[1]: re.sub(r":attr:`(?:Plan\.)?(\w+)`", r"\1", text).replace("``", "")} if text else {}
            before = []
    return found
