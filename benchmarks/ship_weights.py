"""Write a training's checkpoint as weights that the package ships: ``pretrained/<name>``, with a card.

python benchmarks/ship_weights.py outputs/cpu pickplace/pretrained/r4 outputs/evaluation/evaluation.json ...
"""

import json
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from pickplace.common.errors import Parser, one_sentence
from pickplace.common.files import read_text
from pickplace.config.allowlist import trusted_config
from pickplace.config.registry import build, find
from pickplace.policies.restore import build_cell
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate

CARD = "card.json"


def export(source, folder: Path, evaluations: list[Path]) -> None:
    """Write the networks of a checkpoint, without the state that only training needs, and its card.

    Args:
        source: a run folder or a checkpoint.
        folder: folder for the weights; an older version is replaced.
        evaluations: ``evaluation.json`` files of exactly this checkpoint.

    Raises:
        ValueError: for a checkpoint or an evaluation that cannot be read, or that do not belong together.
    """
    state, facts = checkpoint.read(locate(source))
    trained = {"frames": facts["frames"], "seed": facts["config"]["seed"], "commit": facts["commit"]}
    results = []
    for path in evaluations:
        try:
            result = json.loads(read_text(path))
            found = result["trained"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected an evaluation.json of a trained policy ({error}).") from error
        if found != trained:
            raise ValueError(f"{path}: it evaluates a policy of {found}, expected {trained}.")
        results.append({**result, "items": without_folder(result["items"]), "checkpoint": f"pretrained/{folder.name}"})
    facts["config"]["items"] = without_folder(facts["config"]["items"])
    networks = ("policy", "critic") if critic_serves_any_tote(trusted_config(facts["config"])) else ("policy",)
    kept = {key: facts[key] for key in ("frames", "config", "versions", "commit")}
    checkpoint.write(folder, {key: state[key] for key in networks}, kept)
    card = {"name": f"pretrained/{folder.name}", "trained": trained, "versions": facts["versions"]}
    card |= {"config": facts["config"], "evaluations": results}
    (folder / CARD).write_text(json.dumps(card, indent=1) + "\n")


def without_folder(items: dict) -> dict:
    """Return the config of items; if these are of a file, with its name alone: each user has their own copy."""
    return items | ({"path": Path(items["path"]).name} if items.get("path") else {})


def critic_serves_any_tote(cfg: DictConfig) -> bool:
    """Return whether the critic of a checkpoint's config also serves other totes, such as for ``planner=lookahead``.

    Other critics are tied to the training's tote and larger than the policy, or are the policy's own network.
    """
    env: Any = OmegaConf.to_container(cfg.env, resolve=True)
    cell = build_cell(env, reach=None)  # the file of a table of reach may be missing here
    if cfg.model.critic is None:
        return False
    for key in ("actor", "critic"):
        find(f"model.{key}", cfg.model[key]._target_)  # imports it, which the device "meta" does not allow
    with torch.device("meta"):
        return getattr(build("model.critic", cfg.model.critic, cell=cell), "any_size", False)


def main() -> None:
    options = Parser(
        description="Write a training's checkpoint as weights that the package ships, with a card (card.json) that "
        "holds the config of the training and the evaluations. What only training needs is left out.",
    )
    options.add_argument("checkpoint", help="a run folder or a checkpoint")
    options.add_argument("folder", type=Path, help="where the weights go, pickplace/pretrained/<name>")
    options.add_argument("evaluations", type=Path, nargs="+", help="evaluation.json files of this checkpoint")
    args = options.parse_args()
    with one_sentence():
        export(args.checkpoint, args.folder, args.evaluations)


if __name__ == "__main__":
    main()
