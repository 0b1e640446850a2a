"""The weights that the package ships reproduce their cards, and how weights are exported."""

import json
import sys
from statistics import mean

import pytest
import ship_weights as export
import torch
from commands import evaluated
from safetensors import safe_open

from pickplace.config.allowlist import trusted_config
from pickplace.runs import checkpoint
from pickplace.runs.locate import PRETRAINED

CARDS = sorted(PRETRAINED.glob(f"*/{export.CARD}"))
EPISODES = 8
POLICY_ALONE = (
    "paper", "mixed", "warehouse", "gopt_rs", "gopt_buffer", "cdrl_rs", "cut1", "cut2", "plate_3x3", "plate_5x5",
    "orders",
)  # fmt: skip
#: The networks of r4, gopt_rs, cut1 and mixed with other weights, or on a finer grid.
LIKE_OTHERS = ("r1", "r3", "gopt_buffer", "cdrl_rs", "cut2", "warehouse", "plate_3x3")
each_card = pytest.mark.parametrize("path", CARDS, ids=lambda path: path.parent.name)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.parent.name, marks=[pytest.mark.slow] * (path.parent.name in LIKE_OTHERS))
        for path in CARDS
        if not json.loads(path.read_text())["config"]["items"].get("path")  # else a user's own file
    ],
)
def test_card_is_reproduced(path, tmp_path):
    card = json.loads(path.read_text())
    claimed = card["evaluations"][0]
    settings = [f"env.{key}={claimed['env'][key]}".replace(" ", "") for key in ("tote_size", "rotations")]
    settings += [f"evaluation.{key}={claimed[key]}" for key in ("seed", "stream")]
    settings += [f"planner.candidates={claimed['candidates']}", f"evaluation.episodes={EPISODES}", "threads=1"]
    settings += ["evaluation.latency_decisions=0", "evaluation.replay=0"]
    result = evaluated(tmp_path / "result", f"checkpoint={card['name']}", *settings)
    for key in ("planner", "trained", "mask_in_training", "mask_at_decision", "warm_start", "env", "items"):
        assert result[key] == claimed[key]
    found, expected = (r["occupancy"]["per_episode"][:EPISODES] for r in (result, claimed))
    # Exactly; but another processor may decide a tie in another way, and that episode then goes on differently. One
    # without the instructions of the processors that measured, AVX-512, does so more often.
    most = 1 if torch.backends.cpu.get_cpu_capability() == "AVX512" else EPISODES // 2
    assert sum(a != b for a, b in zip(found, expected, strict=True)) <= most, (found, expected)
    assert abs(mean(found) - mean(expected)) < 0.03


@each_card
def test_card_describes_the_weights(path):
    card, (state, facts) = json.loads(path.read_text()), checkpoint.read(path.parent)
    assert card["config"] == facts["config"] and card["name"] == f"pretrained/{path.parent.name}"
    assert card["trained"] == {key: facts.get(key, facts["config"].get(key)) for key in ("frames", "seed", "commit")}
    assert not card["trained"]["commit"].endswith("+")  # trained from a clean checkout
    with safe_open(path.parent / checkpoint.TENSORS, "pt") as tensors:
        expected = {"policy"} if path.parent.name in POLICY_ALONE else {"critic", "policy"}
        assert {key.split("|")[0] for key in tensors.keys()} == expected == set(state)  # noqa: SIM118
    assert export.critic_serves_any_tote(trusted_config(facts["config"])) == ("critic" in expected)


def test_export(tmp_path, monkeypatch, capsys):
    shipped = PRETRAINED / "r4"
    card = json.loads((shipped / export.CARD).read_text())
    right, wrong = tmp_path / "right.json", tmp_path / "wrong.json"
    right.write_text(json.dumps(card["evaluations"][0]))
    wrong.write_text(json.dumps({"trained": {"frames": 1, "seed": 0, "commit": None}}))

    def call(*evaluations):
        words = ["pretrained/r4", tmp_path / "r4", *evaluations]
        monkeypatch.setattr(sys, "argv", ["export", *map(str, words)])
        export.main()

    with pytest.raises(SystemExit, match="2"):
        call(right, wrong)
    err = capsys.readouterr().err
    assert "it evaluates a policy of" in err and err.count("\n") == 1 and not (tmp_path / "r4").exists()
    call(right)
    assert json.loads((tmp_path / "r4" / export.CARD).read_text()) == {**card, "evaluations": card["evaluations"][:1]}
    for name in (checkpoint.TENSORS, checkpoint.FACTS):
        assert (tmp_path / "r4" / name).read_bytes() == (shipped / name).read_bytes()
