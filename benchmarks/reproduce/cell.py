"""Evaluates one cell in a process of its own: python benchmarks/reproduce/cell.py MINUTES override ...

As ``pickplace.evaluation.evaluate``, but within a budget. Where the first steps say that all episodes fit one by one, they
are played as ``evaluation.batch_size`` says; else in batches until the time is up, where a batch is faster and ends in
time, or one by one; where one alone would take twice the budget, none, and that time is the result.
"""

import json
import logging
import sys
import time

import torch
from omegaconf import DictConfig

from pickplace.evaluation.evaluate import evaluate, prepare
from pickplace.runs import hydra_app as config
from pickplace.runs.registry import build

log = logging.getLogger(__name__)

BATCH = 20  # episodes side by side where not all fit: on a wide tote a tenth to two fifths of the time of one by one


@torch.no_grad()
def seconds_a_step(make_env, planner, episodes: int, steps: int) -> float:
    """CPU seconds of a decision and its step, for that many episodes together."""
    env = make_env(0, episodes)
    observation = env.reset()
    began = time.process_time()
    for _ in range(steps):
        _, observation = env.step_and_maybe_reset(observation.set("action", planner.decide(observation)))
    return (time.process_time() - began) / steps


def fitting_batch(alone: float, together: float, seconds: float) -> tuple[int, float]:
    """How many episodes to play side by side where not all fit, and the seconds at which the last batch may begin.

    Args:
        alone: seconds to fill one tote.
        together: seconds to fill as many as a batch has.
        seconds: the budget.
    """
    if together < seconds and together < BATCH * alone / 2:
        return BATCH, seconds - together
    return 1, seconds


def main() -> None:
    seconds = 60 * float(sys.argv.pop(1))

    def task(cfg: DictConfig, run_dir):
        began = time.process_time()
        make_env, planner, _ = prepare(cfg.copy())
        rules, items = make_env(0, 1).rules, build("items", cfg["items"])
        decisions = rules.num_places * rules.tote_size[2] / float(items.sizes.prod(1).double().mean())  # fill a tote
        seconds_a_step(make_env, planner, 1, 1)  # warms up
        step = seconds_a_step(make_env, planner, 1, 3)
        alone = decisions * step
        pilot = {"latency_ms": {"cpu_mean": 1e3 * step}, "seconds_a_filled_episode": alone}
        (run_dir / "pilot.json").write_text(json.dumps(pilot))
        if alone > 2 * seconds:
            log.info("attempted only: to fill one tote would take %.1f hours", alone / 3600)
            return
        until = seconds
        if alone * cfg.evaluation.episodes > seconds:
            step = seconds_a_step(make_env, planner, BATCH, 1)
            if step < 1:  # of which warming up is a part
                step = seconds_a_step(make_env, planner, BATCH, 3)
            cfg.evaluation.batch_size, until = fitting_batch(alone, decisions * step, seconds)
        make_env, planner, facts = prepare(cfg)  # anew: the pilot's decisions have drawn from the planner's generator
        result, _ = evaluate(cfg, make_env, planner, facts, until=began + until)
        result["batch_size"] = cfg.evaluation.batch_size
        (run_dir / "evaluation.json").write_text(json.dumps(result))

    config.command("evaluate", task, from_checkpoint=("model",))


if __name__ == "__main__":
    main()
