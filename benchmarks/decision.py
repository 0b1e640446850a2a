"""Measure the time of one decision on one core: python benchmarks/decision.py

A decision includes feasibility and candidates, at batch 1, with ``R=4``, in states from the middle of episodes. The
networks are those of the configs, with fresh weights.
"""

from functools import partial

import torch
from common import interleave, save, use_one_core

from pickplace import PickPlaceEnv
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate.policy import AfterstateFcn
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.policy import FcnGrasp

TOTES = ((6, 6, 5), (10, 10, 10), (30, 30, 10))
#: Policies, each with numbers of candidates. Values know feasible actions only.
POLICIES = {
    "fcn_grasp": (FcnGrasp, (10, "all")),
    "fcn4d": (partial(Fcn4d, mask_infeasible=True, compute_dtype="auto"), (10, "all")),
    "afterstate_fcn": (partial(AfterstateFcn, all_views=True), ("all",)),
}


def deciders(tote_size) -> dict:
    """Return a function that makes one decision, for each policy and number of candidates."""
    env = PickPlaceEnv(tote_size=tote_size, support="half", num_envs=1)
    state = env.rollout(tote_size[0] ** 2 // 2, break_when_any_done=False)[:, -1]["next"]
    calls = {}
    for name, (make, numbers) in POLICIES.items():
        policy = make(env.cell).eval()
        for candidates in numbers:
            calls[f"{name}, K={candidates}"] = partial(PolicyPlanner(env.cell, policy, candidates).decide, state)
    return calls


def main() -> None:
    use_one_core()
    torch.manual_seed(0)
    calls = {"x".join(map(str, tote)): deciders(tote) for tote in TOTES}
    flat = {(tote, name): call for tote, each in calls.items() for name, call in each.items()}
    times = interleave(flat, repeats=40)
    rows = {name: {tote: times[tote, name] for tote in calls} for name in next(iter(calls.values()))}
    first, *_, last = calls
    for row in rows.values():
        row["growth"] = row[last]["ms"] / row[first]["ms"]
    area = TOTES[-1][0] * TOTES[-1][1] / (TOTES[0][0] * TOTES[0][1])
    save("decision", {"area grows by": area, "rows": rows})


if __name__ == "__main__":
    main()
