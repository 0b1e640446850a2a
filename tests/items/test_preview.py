"""A preview: what is seen is what arrives later, it changes nothing else, and planning with it is exact."""

import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from pickplace import PickPlaceEnv, State
from pickplace.items.arrival import refill
from pickplace.items.cut import Cut
from pickplace.items.distributions import Kinds, Recorded, Uniform
from pickplace.items.orders import Orders
from pickplace.planners import lookahead, mcts
from pickplace.planners.heuristics import RandomFeasible
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules.bin import admit_coming_items
from pickplace.rules.grasps import footprint_index
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.state import REFILLS
from pickplace.rules.step import apply, put_down

CELL = {"tote_size": (4, 4, 4), "gripper": Overlap((1, 1)), "rotations": 2, "support": "half"}
KINDS = [(1, 1, 1), (2, 1, 1), (1, 2, 2), (3, 2, 1)]
ROWS = [(1, 1, 1), (2, 3, 1), (1, 2, 2), (2, 2, 1), (3, 1, 1)]
HANDLING = {"turns": [[0, 1], [0], [1], None], "grams": [5, 20, 1, 7], "max_load": [40, None, 90, None]}
#: Columns of an item that a preview shows before it has a place: sizes, turns, mass and greatest load.
SHOWN = [2, 3, 4, 6, 7, 8]


def write(folder, name, head, lines):
    path = Path(folder, name)
    path.write_text("\n".join([head, *(",".join(map(str, line)) for line in lines)]))
    return path


def orders(folder):
    lines = [(n, *(10 * side for side in ROWS[(n * k + k) % 5]), 1 + k) for n in range(40) for k in range(3 + n % 6)]
    return Orders(write(folder, "orders.csv", "order,length/mm,width/mm,height/mm,weight/kg", lines), 0.01)


def placed(folder):
    lines = [(*row, n % 3, n % 2) for n, row in enumerate(ROWS)]
    return Recorded(write(folder, "placed.csv", "w,d,h,x,y", lines), loop=True)


#: Item distributions, of which some end, and settings that they need.
SOURCES = {
    "kinds": (lambda _: Kinds(KINDS), {}),
    "uniform": (lambda _: Uniform((1, 3), (1, 3), (1, 2)), {}),
    "handling": (lambda _: Kinds(KINDS, **HANDLING), {"handling": True}),
    "mixes": (lambda _: Kinds(KINDS).mixed([{"weights": [0, 0, 1, 1]}]), {"varies": ("item_mix", "rotations")}),
    "cut": (lambda _: Cut([4, 4, 4], [1, 3]), {}),
    "orders": (orders, {"stream": "validation"}),
    "recorded": (lambda folder: Recorded(write(folder, "rows.csv", "w,d,h", ROWS)), {}),
    "placed": (placed, {}),
}


class Slots:
    """Environments side by side, of which one has no preview: it tells what arrives, and what nothing may change."""

    def __init__(self, source, preview, seed, **sizes):
        with tempfile.TemporaryDirectory() as folder:
            items, needed = SOURCES[source][0](folder), SOURCES[source][1]
        self.settings = {**CELL, **needed, **sizes, "items": items, "num_envs": 3, "seed": seed}
        self.preview, self.varies = preview, needed.get("varies", ())
        self.plain, self.seen = PickPlaceEnv(**self.settings), self.make_seen()
        self.planner, self.draw = RandomFeasible(self.plain.cell, seed=seed), torch.Generator().manual_seed(seed)
        self.arrived: dict[tuple[int, int], tuple[list[int], bool]] = {}  # by episode and number; whether it lay alone
        self.previews: list[tuple[int, int, int, list[list[int]]]] = []  # episode, items so far, p of it, what is seen

    def make_seen(self):
        varies = (*self.varies, "preview") if self.varies else ()
        return PickPlaceEnv(**{**self.settings, "varies": varies}, preview=self.preview)

    def reset(self, rows):
        """Reset rows; where episodes differ, to settings that are drawn."""
        entries = {"_reset": rows[:, None]}
        if self.varies:
            mix, shown = (torch.randint(0, most, (3, 1), generator=self.draw) for most in (2, self.preview + 1))
            flags = torch.tensor([[True, False], [True, True]])[torch.randint(0, 2, (3,), generator=self.draw)]
            entries |= {"item_mix": mix, "rotations": flags, "preview": shown}
        self.plain.reset(TensorDict({key: part for key, part in entries.items() if key != "preview"}, [3]))
        self.seen.reset(TensorDict(entries, [3]))
        self.note([[]] * 3, rows.tolist(), [0] * 3)

    def note(self, left, rows, before):
        """Note what has arrived in bins where ``left`` was left, and what is seen now."""
        shown = self.seen.preview.tolist() if self.varies else [self.preview] * 3
        for row, (episode, count) in enumerate(
            zip(self.plain.episode.tolist(), self.plain.arrived.tolist(), strict=True)
        ):
            table = [item for item in self.plain.item[row].tolist() if item[4]]
            for place, item in enumerate(table[len(left[row]) :] if rows[row] else ()):
                self.arrived[episode, before[row] + place] = item, len(left[row]) + place == 0
            self.previews.append((episode, count, shown[row], self.seen.coming[row].tolist()))

    def step(self):
        """Take an action in both, and return the state that the preview shows before, the action, and what follows."""
        observation, plain = self.seen._observation(), self.plain._observation()
        assert all(torch.equal(plain[key], observation[key]) for key in plain.keys())  # noqa: SIM118
        action, items = self.planner.decide(plain), self.plain.state.items
        taken, before = apply(self.plain.cell, self.plain.state, action).taken.tolist(), self.plain.arrived.tolist()
        left = [[item for n, item in enumerate(bin_) if n != taken[row] and item[4]]
                for row, bin_ in enumerate(items.table.tolist())]  # fmt: skip
        after = self.plain.step(plain.set("action", action))["next"]
        after = self.seen.step(observation.set("action", action))["next"]
        self.note(left, (after["failure"] != 1).flatten().tolist(), before)
        return State.from_observation(observation), action, after


@settings(max_examples=10)
@given(
    st.sampled_from([*SOURCES]), st.sampled_from([1, 3]), st.sampled_from(REFILLS), st.integers(1, 7),
    st.integers(0, 999),
)  # fmt: skip
def test_what_is_seen_is_what_arrives(source, bin_items, refill, preview, seed):
    """In that order, over whole episodes, across resets and a saved state; all else is as without a preview."""
    slots = Slots(source, preview, seed, bin_items=bin_items, refill=refill, bin_size=(6, 5, 1))
    slots.reset(torch.ones(3, dtype=torch.bool))
    for number in range(14):
        _, _, after = slots.step()
        if number == 5:
            saved, slots.seen = slots.seen.state_dict(), slots.make_seen()
            slots.seen.load_state_dict(saved)
        if (done := after["done"][:, 0]).any():
            slots.reset(done)
    total, stream = {}, slots.plain.stream
    for episode in {episode for episode, *_ in slots.previews}:
        address = (torch.tensor([value]) for value in (seed, episode))
        total[episode] = int(slots.plain.items.num_items(stream, *address)) or 10**9
    seen = 0
    for episode, count, shown, rows in slots.previews:
        for place, row in enumerate(rows):
            assert any(row) == (row[4] > 0) == (place < shown and count + place < total[episode])
            if row[4] and (episode, count + place) in slots.arrived:
                item, was_alone = slots.arrived[episode, count + place]
                assert [row[n] for n in SHOWN] == [item[n] for n in SHOWN]
                assert not was_alone or row == item
                seen += 1
    assert seen or slots.varies


@settings(max_examples=8)
@given(st.sampled_from(["kinds", "uniform", "handling", "mixes", "cut", "orders", "recorded"]),
       st.sampled_from([1, 3]), st.sampled_from(REFILLS), st.integers(0, 999))  # fmt: skip
def test_the_state_after_a_placement_is_known(source, bin_items, refill, seed):
    """All of it with one item in the bin. Of several, in a bin with room for all, the items and their order."""
    slots = Slots(
        source, 4, seed, bin_items=bin_items, refill=refill, bin_size=(6, 5, 1) if bin_items == 1 else (12, 12, 1)
    )
    slots.reset(torch.ones(3, dtype=torch.bool))
    for _ in range(8):
        before, action, after = slots.step()
        cell, step = slots.seen.cell, apply(slots.seen.cell, before, action)
        x, y, w, _ = step.footprint.unbind(-1)
        footprint = footprint_index(cell.tote_size, (w != step.item.w).long(), x, y)
        expected, real = (
            admit_coming_items(cell, put_down(cell, before, step.taken * cell.num_footprints + footprint)[0])[0],
            State.from_observation(after),
        )
        known = before.coming.exists.sum(1) - expected.coming.exists.sum(1)  # that have arrived
        for row in range(3):
            enough = expected.coming.exists[row, 0] or (before.coming.exists[row, -1] == 0 and not slots.varies)
            if step.failure[row] or not enough:
                continue
            assert torch.equal(expected.surface[row], real.surface[row])
            columns = [*range(5), *SHOWN[3:]] if bin_items == 1 else SHOWN
            for ours, theirs in ((expected.items, real.items), (expected.coming, real.coming)):
                ours, theirs = (part.table[row][part.exists[row]][:, columns] for part in (ours, theirs))
                assert torch.equal(ours, theirs[: len(ours)])
            assert int(real.items.exists[row].sum()) == int(expected.items.exists[row].sum())
            rest = before.coming.table[row, int(known[row]) :]
            assert torch.equal(expected.coming.table[row, : len(rest)], rest)
            if expected.pile is not None:
                assert all(
                    torch.equal(*(part[row] for part in pair)) for pair in zip(expected.pile, real.pile, strict=True)
                )
        if (done := after["done"][:, 0]).any():
            slots.reset(done)


@pytest.mark.parametrize("search", [lookahead, mcts])
def test_a_search_imagines_whole_batches(search, monkeypatch):
    """Of which the preview shows a part."""
    env, bins = PickPlaceEnv(num_envs=1, bin_items=3, bin_size=(12, 12, 1), refill="batch", preview=1), []
    data = env.reset()
    for _ in range(2):
        data = env.step(data.set("action", data["action_mask"].int().argmax(1)))["next"]
    assert env.state.items.exists.sum() == 1
    monkeypatch.setattr(search, "refill", lambda *args: bins.append(refill(*args)) or bins[-1])
    if search is mcts:
        planner = mcts.MCTS(env.cell, env.items, 2, True)
    else:
        policy = FcnGrasp(env.cell, filters=8, hidden=8)
        planner = lookahead.Lookahead(env.cell, policy, env.items, samples=2, rounds=1)
    planner.decide(data)
    assert (bins[0][0].exists.sum(1) == 3).all()
