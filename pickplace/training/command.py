"""The ``pickplace-train`` command: it checks its command line, then imports torch."""

import logging
import sys

from omegaconf import DictConfig, OmegaConf

from pickplace.common.errors import one_sentence
from pickplace.common.interrupts import import_quietly
from pickplace.common.validate import refuse_any
from pickplace.config.hydra_app import Command
from pickplace.runs import folder
from pickplace.runs.locate import locate, read_facts
from pickplace.runs.resume import resumed_config, resumed_place
from pickplace.training.curriculum.keys import check_keys
from pickplace.training.sweep import summarize


def main() -> None:
    """Entry point of ``pickplace-train``."""
    overrides = [item for item in sys.argv[1:] if not item.startswith("-")]
    if any(item.startswith("resume=") and item not in ("resume=", "resume=null") for item in overrides):
        with one_sentence():
            place, words = resumed_place(overrides)
            refuse_any(
                (word for word in sys.argv[1:] if word.lstrip("+").startswith(("-", "hydra."))),
                lambda word: (
                    f"{word}: a resumed run keeps its folder and its checkpoint's config; expected values such as "
                    f"total_frames=... beside resume={place}, or a new run with warm_start.weights={place}."
                ),
            )
            if facts := read_facts(locate(place, "last")):  # refuse bad overrides before torch is imported
                logging.disable(logging.WARNING)  # the training itself warns
                try:
                    resumed_config(place, facts, words)
                finally:
                    logging.disable(logging.NOTSET)
            import_quietly("pickplace.training.train").resume_run(overrides)
    else:
        Command("train", "pickplace.training.train.train", folder, check=check, after_sweep=summarize)()


def check(cfg: DictConfig) -> None:
    """Refuse misspelt keys of levels, like those of other settings, before torch is imported."""
    kind, levels = (OmegaConf.select(cfg, f"curriculum.{key}") for key in ("_target_", "levels"))
    if kind == "curriculum" and OmegaConf.is_list(levels) and all(map(OmegaConf.is_dict, levels)):
        check_keys(levels)
