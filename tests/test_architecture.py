"""The dependencies between the packages of pickplace, and the greatest length of a module."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import pickplace

ROOT = Path(pickplace.__file__).parent
#: A package may import itself and the packages that follow it.
ROOMS = (
    "cli", "serve", "training", "algorithms", "evaluation", "robot", "physics", "views", "planners", "policies", "envs",
    "runs", "config", "items", "rules", "common",
)  # fmt: skip
MODULES = {
    ".".join(("pickplace", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
    if path != ROOT / "__init__.py"
}


def imports(own: str) -> set[str]:
    """Return the other modules of pickplace that a module imports, at its top or in a function."""
    found, path = set(), MODULES[own]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            module = next((part for part in (name, name.rpartition(".")[0]) if part in MODULES), None)
            assert module or not name.startswith("pickplace.") or hasattr(pickplace, name.split(".")[1]), name
            found |= {module} - {None, own}
    return found


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_its_own_room_and_those_below_and_is_short(module):
    allowed = ROOMS[ROOMS.index(module.split(".")[1]) :]
    assert [name for name in imports(module) if name.split(".")[1] not in allowed] == []
    assert len(MODULES[module].read_text().splitlines()) < 400


def test_no_module_imports_itself_in_a_circle():
    TopologicalSorter({module: imports(module) for module in MODULES}).prepare()


def test_the_rules_need_torch_alone():
    """``rules/`` imports no other library for numbers, training or configs."""
    for module, path in MODULES.items():
        if module.startswith("pickplace.rules."):
            nodes = list(ast.walk(ast.parse(path.read_text())))
            names = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
            names |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
            roots = {name.split(".")[0] for name in names}
            assert not roots & {"torchrl", "hydra", "omegaconf", "gymnasium", "numpy", "scipy", "matplotlib"}, module


def test_the_protocol_of_planners_knows_the_rules_only():
    assert {name.split(".")[1] for name in imports("pickplace.planners.base")} <= {"rules", "common"}
    assert "omegaconf" not in MODULES["pickplace.planners.base"].read_text()
