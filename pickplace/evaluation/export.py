"""Turns a training checkpoint into weights that the package ships: ``pretrained/<name>``, with a card.

``python -m pickplace.evaluation.export outputs/cpu pickplace/pretrained/r4 outputs/evaluation/evaluation.json ...``
"""

import argparse
import json
from pathlib import Path

from pickplace.runs import checkpoint
from pickplace.runs.errors import one_sentence

CARD = "card.json"


def export(source, folder: Path, evaluations: list[Path]) -> None:
    """Write the networks of a checkpoint, without what only training needs, and its card.

    Args:
        source: a run folder or a checkpoint.
        folder: where the weights go; an older version is replaced.
        evaluations: ``evaluation.json`` files of this very checkpoint.

    Raises:
        ValueError: for a checkpoint or an evaluation that cannot be read, or that do not belong together.
    """
    state, facts = checkpoint.read(checkpoint.locate(source))
    trained = {"frames": facts["frames"], "seed": facts["config"]["seed"], "commit": facts["commit"]}
    results = []
    for path in evaluations:
        try:
            result = json.loads(Path(path).read_text())
            theirs = result["trained"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected an evaluation.json of a trained policy ({error}).") from error
        if theirs != trained:
            raise ValueError(f"{path}: it evaluates a policy of {theirs}, expected {trained}.")
        results.append({**result, "checkpoint": f"pretrained/{folder.name}"})
    kept = {key: facts[key] for key in ("frames", "config", "versions", "commit")}
    # What lookahead may ask is kept; fcn4d's critic is tied to one tote, and larger than the policy.
    networks = ("policy", "critic") if asks_critic(facts["config"]) else ("policy",)
    checkpoint.write(folder, {key: state[key] for key in networks}, kept)
    card = {"name": f"pretrained/{folder.name}", "trained": trained, "versions": facts["versions"]}
    card |= {"config": facts["config"], "evaluations": results}
    (folder / CARD).write_text(json.dumps(card, indent=1) + "\n")


def asks_critic(cfg: dict) -> bool:
    """Does ``planner=lookahead`` serve the policy of a checkpoint with this config?"""
    return cfg["model"]["actor"]["_target_"] == "fcn_grasp"


def main() -> None:
    """Entry point of ``python -m pickplace.evaluation.export``."""
    options = argparse.ArgumentParser(
        prog="python -m pickplace.evaluation.export",
        description="Turns a training checkpoint into weights that the package ships, with a card that says how they "
        "were trained and what they reach: card.json, from each evaluation.json. What only training needs is left out.",
    )
    options.add_argument("checkpoint", help="a run folder or a checkpoint")
    options.add_argument("folder", type=Path, help="where the weights go, pickplace/pretrained/<name>")
    options.add_argument("evaluations", type=Path, nargs="+", help="evaluation.json files of this checkpoint")
    args = options.parse_args()
    with one_sentence():
        export(args.checkpoint, args.folder, args.evaluations)


if __name__ == "__main__":
    main()
