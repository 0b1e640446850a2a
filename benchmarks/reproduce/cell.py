"""Evaluates one cell in a process of its own: python benchmarks/reproduce/cell.py MINUTES override ...

As ``pickplace.evaluate``, but within a budget. Where the time of a decision says that all episodes fit, they are played
side by side; else one after the other until the time is up; where one alone would take twice the budget, none, and that
time is the result.
"""

import json
import logging
import sys
import time

from omegaconf import DictConfig

from pickplace import config
from pickplace.evaluate import decision_latency, evaluate, prepare

log = logging.getLogger(__name__)


def main() -> None:
    seconds = 60 * float(sys.argv.pop(1))

    def task(cfg: DictConfig, run_dir):
        until = time.process_time() + seconds
        make_env, planner, _ = prepare(cfg.copy())
        rules, items = make_env(0, 1).rules, config.instantiate(cfg["items"])
        began = time.process_time()
        decision_latency(make_env, planner, 3)
        decision = (time.process_time() - began) / 4  # of CPU time; the first one warms up
        episode = decision * rules.num_places * rules.tote_size[2] / float(items.sizes.prod(1).double().mean())
        pilot = {"latency_ms": {"cpu_mean": 1e3 * decision}, "seconds_a_filled_episode": episode}
        (run_dir / "pilot.json").write_text(json.dumps(pilot))
        if episode > 2 * seconds:
            log.info("attempted only: to fill one tote would take %.1f hours", episode / 3600)
            return
        if episode * cfg.evaluation.episodes > seconds:
            cfg.evaluation.batch_size = 1
        make_env, planner, facts = prepare(cfg)  # anew: the pilot's decisions have drawn from the planner's generator
        result, _ = evaluate(cfg, make_env, planner, facts, until=until)
        result["batch_size"] = cfg.evaluation.batch_size
        (run_dir / "evaluation.json").write_text(json.dumps(result))

    config.command("evaluate", task, from_checkpoint=("model",))


if __name__ == "__main__":
    main()
