"""Page of the site with all settings, from the comments in conf/. To print it: python .ci/reference.py"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from pickplace.config.help import GROUPS

CONF = Path(__file__).resolve().parent.parent / "conf"
PRESETS = ("benchmark", "experiment")  # groups whose options set keys of others
COMMANDS = {"train": "pickplace-train", "evaluate": "pickplace-evaluate"}

INTRODUCTION = """\
# Reference of the settings

Every setting of `pickplace-train` and `pickplace-evaluate`, with its default. A setting is changed on the command line
as `key=value`, such as `algo.lr=1e-3`, and a group as `group=option`, such as `items=mixed`. Lengths are in cells.
*Frames* are environment steps, summed over all slots. A whole number may also be written `100_000` or `1e5`.
"""


@dataclass
class Setting:
    """One key of a config file: its default, as written in the file, and its comment."""

    default: str
    comment: str


@dataclass
class ConfigFile:
    """The content of one yaml file."""

    group: str  # "", "env", "curriculum/advance", ...
    name: str
    text: str  # the comment at its top
    bases: list[str]  # options of the same group that it builds on
    parts: dict[str, str]  # options of other groups that it is composed of
    settings: dict[str, Setting] = field(default_factory=dict)  # by dotted keys, as on the command line


def read(path: Path) -> ConfigFile:
    """Return a config file with its comments."""
    source = path.read_text()
    lines = source.splitlines()
    top = []
    for line in lines:
        if not line.startswith("#"):
            break
        top.append(line.lstrip("# "))
    top = [line for line in top if not line.startswith("@package")]
    group = str(path.parent.relative_to(CONF)).replace(".", "")
    bases, parts = [], {}
    for entry in (yaml.safe_load(source) or {}).get("defaults", []):
        if isinstance(entry, dict):
            parts |= {
                key.removeprefix("override ").split("@")[0]: "null" if option is None else option
                for key, option in entry.items()
            }
        elif entry != "_self_":
            bases.append(entry)
    top = [f"`{line}`." if line.startswith("pickplace-") else line for line in top]
    file = ConfigFile(group, path.stem, " ".join(top), bases, parts)
    place = "env" if source.startswith("# @package env\n") else group
    prefix = "" if place in ("", *PRESETS) else place.replace("/", ".") + "."
    _collect(yaml.compose(source), lines, prefix, file.settings)
    return file


def _collect(node, lines: list[str], prefix: str, settings: dict[str, Setting]) -> None:
    """Add the keys of a yaml mapping, and of the mappings in it."""
    for key, value in node.value:
        if key.value in ("defaults", "_target_") or (prefix == "" and key.value == "hydra"):
            continue
        if isinstance(value, yaml.MappingNode):
            if _is_list_of_objects(value):  # such as env.observation
                comment = lines[key.end_mark.line].partition("#")[2].strip()
                settings[prefix + key.value] = Setting(", ".join(name.value for name, _ in value.value), comment)
            _collect(value, lines, f"{prefix}{key.value}.", settings)
            continue
        block = isinstance(value, yaml.SequenceNode) and not value.flow_style
        line = key.end_mark.line
        if block:
            default = yaml.safe_dump(yaml.safe_load("\n".join(lines[line + 1 : value.end_mark.line])), width=1000)
            default = yaml.safe_dump(yaml.safe_load(default), default_flow_style=True, width=1000).strip()
            after = ""
        else:
            default = lines[line][value.start_mark.column : value.end_mark.column]
            after = lines[line][value.end_mark.column :].lstrip(" }")
            after = after if after.startswith("#") else ""  # the next key of a mapping in one line
        words = [after]
        for following in lines[line + 1 :]:  # a comment that goes on
            if not following.lstrip().startswith("#"):
                break
            words.append(following.strip())
        settings[prefix + key.value] = Setting(default, " ".join(word.lstrip("# ") for word in words).strip())


def _is_list_of_objects(node) -> bool:
    """Return whether each value of a yaml mapping names what it makes, and has no settings."""
    return all(
        isinstance(value, yaml.MappingNode) and [key.value for key, _ in value.value] == ["_target_"]
        for _, value in node.value
    )


def options(group: str) -> list[str]:
    """Return the options of a group."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def everything() -> dict[tuple[str, str], ConfigFile]:
    """Return every config file by group and name, the default option of each group first."""
    files = [read(path) for path in sorted(CONF.rglob("*.yaml"))]
    chosen = {**read(CONF / "evaluate.yaml").parts, **read(CONF / "train.yaml").parts}
    files.sort(key=lambda file: (file.group, file.name != chosen.get(file.group)))
    return {(file.group, file.name): file for file in files}


def meaning(key: str, file: ConfigFile, files: dict) -> str:
    """Return the comment of a setting: from its file, the file that it builds on, or any option of the group."""
    if key in file.settings and file.settings[key].comment:
        return file.settings[key].comment
    for base in file.bases:
        if comment := meaning(key, files[file.group, base], files):
            return comment
    if file.group not in PRESETS:
        return ""
    found = (other.settings[key].comment for other in files.values() if key in other.settings)
    return next((comment for comment in found if comment), "")


def table(file: ConfigFile, files: dict) -> list[str]:
    """Return the settings of a file as a table."""
    if not file.settings:
        return []
    rows = ["| key | default | meaning |", "|---|---|---|"]
    for key, setting in file.settings.items():
        cells = (f"`{key}`", f"`{setting.default}`", meaning(key, file, files))
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return ["", *rows]


def page() -> str:
    """Return the whole page."""
    files = everything()
    out = [INTRODUCTION]
    for name, command in COMMANDS.items():
        file = files["", name]
        out += [f"## `{command}`", "", f"{file.text}", "", "| group | default | options |", "|---|---|---|"]
        for group, option in file.parts.items():
            out.append(f"| `{group}` | `{option}` | {', '.join(f'`{other}`' for other in options(group))} |")
        out += [*table(file, files), ""]
    groups = list(dict.fromkeys(group for group, _ in files if group not in ("", *PRESETS)))
    for group in [*groups, *PRESETS]:
        out += [f"## `{group}`", "", f"Purpose: {GROUPS[group]}.", ""]
        for file in (file for file in files.values() if file.group == group):
            out += [f"### `{group}={file.name}`", "", file.text]
            bases = [f"`{group}={base}`" for base in file.bases]
            bases += [f"`{other.lstrip('/')}={option}`" for other, option in file.parts.items()]
            if bases:
                out += ["", f"Builds on {', '.join(bases)}."]
            out += [*table(file, files), ""]
    return "\n".join(out).rstrip() + "\n"


if __name__ == "__main__":
    sys.stdout.write(page())
