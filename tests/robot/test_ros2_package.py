"""The files of the ROS packages in docs/examples/ros2: manifests, build, parameters, launch file and README."""

import ast
import re
import runpy
import sys
from configparser import ConfigParser
from types import ModuleType

import pytest
import ros_stand_ins as ros
import setuptools
import yaml
from catkin_pkg.package import parse_package

import pickplace

PACKAGES = ("pickplace_interfaces", "pickplace_ros")
README = (ros.ROS / "README.md").read_text()
#: The ROS package of a Python module, where its name is another; pip installs the others, see the manifest.
PACKAGE_OF = {"tf2_ros": "tf2_ros_py"}
FROM_PIP = {"pickplace", "numpy", "scipy"}


@pytest.fixture(scope="module")
def modules():
    with ros.installed() as found:
        yield found


@pytest.mark.parametrize("name", PACKAGES)
def test_the_manifest_is_valid(name):
    """By the tool that colcon and rosdep read manifests with."""
    said = []
    package = parse_package(str(ros.ROS / name), warnings=said)
    assert said == [] and (package.name, package.package_format) == (name, 3)
    assert package.version == pickplace.__version__ and package.licenses == ["MIT"]
    assert package.get_build_type() == {"pickplace_interfaces": "ament_cmake", "pickplace_ros": "ament_python"}[name]


def imported(path):
    """Return the top packages that a module imports, but for those of Python."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    return {name.partition(".")[0] for name in names} - set(sys.stdlib_module_names)


def test_what_the_node_and_its_launch_file_import_is_declared():
    paths = [*ros.PACKAGE.glob("pickplace_ros/*.py"), *ros.PACKAGE.glob("launch/*.py")]
    used = {PACKAGE_OF.get(name, name) for path in paths for name in imported(path)} - FROM_PIP - {"pickplace_ros"}
    package = parse_package(str(ros.PACKAGE))
    assert used == {depend.name for depend in package.exec_depends} and len(paths) == 6


def test_the_build_makes_every_interface_and_finds_what_they_use():
    build = (ros.INTERFACES / "CMakeLists.txt").read_text()
    files = sorted(
        str(path.relative_to(ros.INTERFACES)) for kind in ("msg", "action") for path in ros.INTERFACES.glob(f"{kind}/*")
    )
    assert re.findall(r'"(\w+/\w+\.\w+)"', build) == files and "project(pickplace_interfaces)" in build
    text = "".join((ros.INTERFACES / file).read_text() for file in files)
    used = set(re.findall(r"^(\w+)/\w+", text, re.MULTILINE)) - {"pickplace_interfaces"}
    assert set(re.search(r"DEPENDENCIES ([\w ]+)", build)[1].split()) == used
    found = set(re.findall(r"find_package\((\w+) REQUIRED\)", build))
    package = parse_package(str(ros.INTERFACES))
    assert found == used | {depend.name for depend in package.buildtool_depends}
    assert {depend.name for depend in package.build_depends} == used | {"action_msgs"}
    assert [group.name for group in package.member_of_groups] == ["rosidl_interface_packages"]


def test_setup_installs_files_that_exist(monkeypatch, modules):
    given = {}
    monkeypatch.setattr(setuptools, "setup", lambda **arguments: given.update(arguments))
    monkeypatch.chdir(ros.PACKAGE)
    runpy.run_path("setup.py")
    installed = dict(given["data_files"])
    assert all((ros.PACKAGE / file).is_file() for files in installed.values() for file in files)
    assert installed["share/ament_index/resource_index/packages"] == ["resource/pickplace_ros"]
    assert installed["share/pickplace_ros"] == ["package.xml"]
    shipped = {
        str(path.relative_to(ros.PACKAGE))
        for folder in ("launch", "config")
        for path in ros.PACKAGE.glob(f"{folder}/*.*")
    }
    assert shipped <= {file for files in installed.values() for file in files}
    package = parse_package(str(ros.PACKAGE))
    assert (given["name"], given["version"], given["packages"]) == (package.name, package.version, [package.name])
    (script,) = given["entry_points"]["console_scripts"]
    assert script == "pickplace_node = pickplace_ros.node:main" and callable(modules.node.main)
    config = ConfigParser()
    config.read("setup.cfg")
    assert {config["develop"]["script_dir"], config["install"]["install_scripts"]} == {"$base/lib/pickplace_ros"}


def test_the_launch_file_starts_the_node_with_its_parameters_and_topics(monkeypatch, modules):
    def record(**names):
        return {name: lambda *given, kind=name, **more: (kind, *given, more) for name in names}

    for module, content in {
        "ament_index_python.packages": {"get_package_share_directory": lambda name: str(ros.ROS / name)},
        "launch": {"LaunchDescription": list},
        "launch.actions": record(DeclareLaunchArgument=1),
        "launch.substitutions": record(LaunchConfiguration=1),
        "launch_ros.actions": record(Node=1),
    }.items():
        stand_in = ModuleType(module)
        vars(stand_in).update(content)
        monkeypatch.setitem(sys.modules, module, stand_in)
    described = runpy.run_path(str(ros.PACKAGE / "launch" / "pickplace.launch.py"))["generate_launch_description"]()
    *arguments, (kind, node) = described
    defaults = {name: more["default_value"] for _, name, more in arguments}
    assert defaults.pop("params_file") == str(ros.PACKAGE / "config" / "cell.yaml")
    assert (kind, node["package"], node["executable"]) == ("Node", "pickplace_ros", "pickplace_node")
    assert node["parameters"] == [("LaunchConfiguration", "params_file", {})]
    monkeypatch.setattr(ros.Node, "given", {"checkpoint": "", "planner": "joint_dbl"})
    topics = set(modules.node.PickPlaceNode().subscribers)
    assert {topic for topic, _ in node["remappings"]} == topics == set(defaults.values())
    assert {value[1] for _, value in node["remappings"]} == set(defaults)


def read_parameters():
    return yaml.safe_load((ros.PACKAGE / "config" / "cell.yaml").read_text())["/**"]["ros__parameters"]


def test_the_file_with_parameters_starts_the_node(monkeypatch, modules):
    monkeypatch.setattr(ros.Node, "given", read_parameters())
    node = modules.node.PickPlaceNode()
    assert set(read_parameters()) <= set(node.descriptors)
    cell = node.planner.cell
    assert (cell.bin_size, cell.tote_size, node.settings["placement_error"]) == ((5, 5, 1), (6, 6, 5), 0.003)
    assert (node.settings["planner"], node.settings["tote_height"], node.settings["longest_age"]) == (None, None, 0)


def test_every_parameter_is_described_and_numbers_have_a_range(monkeypatch, modules):
    monkeypatch.setattr(ros.Node, "given", {"checkpoint": "", "planner": "joint_dbl"})
    node, settings = modules.node.PickPlaceNode(), modules.parameters.PARAMETERS
    assert list(node.descriptors) == list(settings)
    for name, descriptor in node.descriptors.items():
        assert descriptor.name == name and descriptor.description and descriptor.read_only
        ranges = len(descriptor.floating_point_range), len(descriptor.integer_range)
        assert ranges == (isinstance(settings[name].default, float), isinstance(settings[name].default, int)), name


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cell_size": 1}, "Wrong parameter type, parameter 'cell_size' is int."),
        ({"accuracy": 0.2}, "Parameter accuracy out of range."),
        ({"rotations": 5}, "Parameter rotations out of range."),
        ({"placement_error": 0.006}, "placement_error=0.006: expected at most clearance=0.005 m, which the item keeps"),
        ({"tote_size": [6, 6]}, "tote_size=[6, 6]: expected 3 whole numbers"),
        ({"gripper": "claw"}, "gripper=claw: [Errno 2] No such file or directory: 'claw'; expected cup_array, "),
        ({"support": "cell.yaml"}, "support=cell.yaml: "),
        ({"checkpoint": "pretrained/none"}, "checkpoint='pretrained/none': the package ships no such weights"),
        ({"checkpoint": "", "planner": ""}, "checkpoint: missing; expected a checkpoint, or planner joint_dbl"),
        ({"planner": "best"}, "planner._target_=best: there is no such class or function"),
        ({"checkpoint": "pretrained/r4", "device": "tpu"}, "device="),
        ({"bin_frame": ""}, "bin_frame: empty; expected frame whose origin is the corner of the bin's cell (0, 0)."),
    ],
)
def test_a_parameter_that_cannot_be_used_ends_the_node_with_one_sentence(monkeypatch, modules, given, said):
    monkeypatch.setattr(ros.Node, "given", {"checkpoint": "", "planner": "joint_dbl"} | given)
    with pytest.raises(SystemExit) as stop:
        modules.node.main()
    text = str(stop.value.code).removeprefix("pickplace_node: ")
    assert text.startswith(said) and "\n" not in text and "--" not in text, text
    assert sys.modules["rclpy"].state.pop() == "down"


def test_the_planner_has_the_parts_that_the_parameters_name(monkeypatch, modules):
    given = {"checkpoint": "", "planner": "joint_dbl", "gripper": "cup_round", "support": "hull", "rotations": 2}
    monkeypatch.setattr(ros.Node, "given", {**given, "bin_size": [8, 8, 2]})
    cell = modules.node.PickPlaceNode().planner.cell
    assert (cell.gripper.size, type(cell.support).__name__, cell.rotations) == ((7, 7), "Hull", 2) and cell.bin_size[
        0
    ] == 8


def test_the_planner_has_planned_before_the_first_goal(monkeypatch, modules):
    planned = []
    monkeypatch.setattr(modules.parameters, "plan_once", planned.append)
    monkeypatch.setattr(ros.Node, "given", {"checkpoint": "", "planner": "joint_dbl"})
    node = modules.node.PickPlaceNode()
    assert planned == [node.planner]


def test_the_node_runs_until_ctrl_c(monkeypatch, modules):
    monkeypatch.setattr(ros.Node, "given", {"checkpoint": "", "planner": "joint_dbl"})
    modules.node.main()
    assert sys.modules["rclpy"].state.pop() == "down"


def table(heading):
    """Return the rows of the first table below a heading of the README, as lists of cells."""
    part = README.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("|").split(" | ") for line in part.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_the_readme_lists_topics_and_services(monkeypatch, modules):
    monkeypatch.setattr(ros.Node, "given", {"checkpoint": "", "planner": "joint_dbl"})
    node = modules.node.PickPlaceNode()
    topics = [name for row in table("Topics") for name in re.findall(r"`([\w/]+)`", row[0])]
    published = ["/pickplace/plan", "/pickplace/pick", "/pickplace/place"]
    assert sorted(topics) == sorted([*node.subscribers, *published])
    services = [row[0].strip("`").replace("/pickplace/", "~/") for row in table("Services")]
    assert services == list(node.services) and node.node_name == "pickplace"
    outcomes = [
        name for name in vars(ros.message_class("pickplace_interfaces/msg/ComputePlan_Result")) if name.isupper()
    ]
    assert all(f"`{name}`" in README for name in outcomes if name not in ("NAME", "KINDS"))


def test_the_links_of_the_readme_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)(?:#[\w-]+)?\)", README):
        assert (ros.ROS / target).resolve().exists(), target
