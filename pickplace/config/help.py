"""The answer to ``--help``: what the command does, its groups and keys, and the flags."""

import re
from textwrap import fill, indent

from omegaconf import DictConfig

from pickplace.config.words import conf_dir, group_options, search_words

#: Meaning of each config group, in one line.
GROUPS = {
    "algo": "how the policy learns from a batch of frames",
    "benchmark": "the cell, the items and the episodes of a published benchmark",
    "callbacks": "what a training calls, such as early stopping; several as callbacks=[a,b]",
    "collector": "the processes that play the episodes of a training",
    "compile": "whether the work of a training is compiled, or captured on a GPU",
    "curriculum": "from easy to hard: the levels of a training, such as tote heights",
    "curriculum/advance": "when the next level begins",
    "curriculum/sample": "the levels that are played, up to the current one",
    "env": "the cell: bin, tote, end effector, rotations, stability rule, observation",
    "evaluation": "the episodes on which a policy is judged",
    "experiment": "a preset: options and values for a whole training",
    "gripper": "the end effector, and which grips hold; without it, that of env",
    "items": "the items that come into the bin: sizes and frequencies",
    "logger": "where metrics are written",
    "model": "the networks: what scores the actions, and what estimates values",
    "physics": "whether a physics engine carries out the plans",
    "planner": "what decides where to pick, where to place and how to turn",
    "reach": "where the robot can reach; without it, that of env",
    "support": "the stability rule; without it, that of env",
    "warm_start": "what a training begins with: a planner to imitate, or weights",
}

FLAGS = """\
  --cfg job             show all keys with their values; --cfg job -p env: those of a group
  --multirun, -m        train or evaluate once for each combination of values: seed=0,1,2
  --config-dir FOLDER   find options of your own there, such as FOLDER/items/mine.yaml; may be repeated
  --help, -h            show this text
  --hydra-help          explain all flags of Hydra, which reads the command line
"""


def help_text(config_name: str, cfg: DictConfig) -> str:
    """Return the answer to ``--help``.

    Args:
        config_name: the file in ``conf/`` whose keys are listed, with their comments.
        cfg: its config, with the node ``hydra``.
    """
    groups, search = "", search_words(cfg.hydra.overrides.hydra)
    for group, choice in sorted(cfg.hydra.runtime.choices.items()):
        if not group.startswith("hydra/"):
            default, options = f"{group}={choice or 'null'}", fill(", ".join(group_options(group, search)), 100)
            groups += f"  {default:<32} {GROUPS.get(group, '')}\n{indent(options, ' ' * 6)}\n"
    keys = re.findall(r"^\w+:.*#.*\n", (conf_dir() / f"{config_name}.yaml").read_text(), re.MULTILINE)
    return (
        f"{cfg.hydra.help.header}\nGroups: the default, what it is for, and the options (group=option)\n{groups}\n"
        f"Keys outside the groups, with their defaults (key=value)\n{indent(''.join(keys), '  ')}\n"
        f"Flags\n{FLAGS}\n{cfg.hydra.help.footer}"
    )
