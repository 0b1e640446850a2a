"""Episodes: every one is played to its end and counted, and nothing but the question changes the answer."""

from types import SimpleNamespace

import pytest
import torch

from pickplace import Failure, PickPlaceEnv, State
from pickplace.evaluation import play as module
from pickplace.evaluation.play import decision_latency, play
from pickplace.items.distributions import Recorded
from pickplace.planners.heuristics import JointDBL, RandomFeasible
from pickplace.rules.masks import action_mask, placing_maps


def make_env(first, count, **settings):
    settings = {"tote_size": (4, 4, 2), "stream": "test", "seed": 1, "masks": (), **settings}
    return PickPlaceEnv(num_envs=count, first_episode=first, **settings)


CELL = make_env(0, 1).cell


def test_every_episode_is_played_to_its_end_and_counted_once():
    result = play(make_env, RandomFeasible(CELL), 7, 3)
    for name in (*module.RESULTS, "recordings"):
        assert len(getattr(result, name)) == (0 if name == "recordings" else 7)
    assert (result.failure == Failure.STUCK).all()  # a planner that knows the feasible actions ends no other way
    assert (result.items_placed > 0).all() and 0 < result.feasible_share < 1
    # Each placement is a decision; after the last one the environment itself finds that nothing is feasible.
    assert result.decisions == int(result.items_placed.sum())


class Fussy(JointDBL):
    """Fails on purpose at items of 2x2 at one edge of the bin: its episodes last from one step to many."""

    def decide(self, observation):
        state = State.from_observation(observation)
        infeasible = action_mask(self.cell, placing_maps(self.cell, state)).int().argmin(1)
        refused = ((state.items.w * state.items.d == 4) & (state.items.x == 0))[:, 0]
        return torch.where(refused, infeasible, super().decide(observation))


def test_batch_size_does_not_change_the_episodes():
    expected = play(make_env, Fussy(CELL), 12, 1, record=range(4))  # one at a time: no slot waits
    # A slot that ends at once ends again, uncounted, while the longest one plays on.
    assert expected.items_placed.min() == 0 and expected.items_placed.max() > 3
    assert len(set(expected.failure.tolist())) > 1
    for batch_size in (3, 100):
        result = play(make_env, Fussy(CELL), 12, batch_size, record=range(4))
        for name in module.RESULTS:
            assert torch.equal(getattr(result, name), getattr(expected, name)), name
        assert result.recordings == expected.recordings and len(result.recordings) == 4
        assert result.decisions == expected.decisions
        assert result.feasible_share == pytest.approx(expected.feasible_share)


def test_a_recorded_stream_that_ends_is_no_failure(tmp_path):
    path = tmp_path / "items.csv"
    path.write_text("w,d,h\n1,1,1\n2,1,1\n")
    result = play(lambda *a: make_env(*a, items=Recorded(str(path))), JointDBL(CELL), 2, 2)
    assert result.failure.tolist() == [Failure.NONE] * 2
    assert result.items_placed.tolist() == [2, 2] and result.occupancy.tolist() == [3 / 32] * 2


def test_latencies_are_quantiles_in_milliseconds(monkeypatch):
    readings = [reading for number, cost in enumerate((0.002, 0.002, 0.009)) for reading in (number, number + cost)]
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=iter(readings).__next__))
    found = decision_latency(make_env, JointDBL(CELL), 3)
    assert found == pytest.approx({"p50": 2.0, "p95": 8.3})
    assert decision_latency(make_env, JointDBL(CELL), 0) is None
