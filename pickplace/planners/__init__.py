"""Planners: everything that decides where to pick, where to place and how to turn, behind one interface.

A planner is made as ``Planner(rules, ...)`` and called as ``decide(observation) -> actions``: ``observation`` is a
TensorDict of ``batch_size=[N]`` with ``bin_depth``, ``tote_depth`` and ``tote_height`` as the environment emits them,
and ``actions`` is int64 ``[N]``, flat indices.
"""

from pickplace.planners.heuristics import JointDBL, RandomFeasible, UniformRandom
from pickplace.planners.individual import IndividualHeuristic
from pickplace.planners.lookahead import Lookahead
from pickplace.planners.mcts import MCTS
from pickplace.planners.policy import PolicyPlanner

__all__ = ["MCTS", "IndividualHeuristic", "JointDBL", "Lookahead", "PolicyPlanner", "RandomFeasible", "UniformRandom"]
