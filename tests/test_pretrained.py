"""The weights that the package ships do what their cards say."""

import json
import subprocess
import sys

import pytest
from safetensors import safe_open

from pickplace.evaluation import evaluate
from pickplace.evaluation.export import CARD, asks_critic
from pickplace.runs import checkpoint

CARDS = sorted(checkpoint.PRETRAINED.glob(f"*/{CARD}"))


def test_there_are_weights():
    assert "r4" in {card.parent.name for card in CARDS}


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.parent.name)
def test_card_is_reproduced(path, tmp_path, monkeypatch):
    card = json.loads(path.read_text())
    claimed = card["evaluations"][0]
    settings = [f"env.{key}={claimed['env'][key]}".replace(" ", "") for key in ("tote_size", "rotations")]
    settings += [f"evaluation.{key}={claimed[key]}" for key in ("episodes", "seed", "stream")]
    settings += [f"planner.candidates={claimed['candidates']}", "evaluation.latency_decisions=0", "threads=1"]
    monkeypatch.setattr(
        sys, "argv", ["pickplace-evaluate", f"checkpoint={card['name']}", f"hydra.run.dir={tmp_path}", *settings]
    )
    evaluate.main()
    result = json.loads((tmp_path / "evaluation.json").read_text())
    # Another machine's arithmetic may decide a tie in another way, and an episode then goes on differently.
    assert result["occupancy"]["mean"] == pytest.approx(claimed["occupancy"]["mean"], abs=0.003)
    for key in ("trained", "mask_in_training", "mask_at_decision", "env", "items"):
        assert result[key] == claimed[key]


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.parent.name)
def test_card_tells_what_the_weights_are(path):
    card, (state, facts) = json.loads(path.read_text()), checkpoint.read(path.parent)
    assert card["config"] == facts["config"] and card["name"] == f"pretrained/{path.parent.name}"
    assert card["trained"] == {key: facts.get(key, facts["config"].get(key)) for key in ("frames", "seed", "commit")}
    assert not card["trained"]["commit"].endswith("+")  # trained from a clean checkout
    with safe_open(path.parent / checkpoint.TENSORS, "pt") as tensors:
        expected = {"critic", "policy"} if asks_critic(facts["config"]) else {"policy"}
        assert {key.split("|")[0] for key in tensors.keys()} == expected == set(state)  # noqa: SIM118


def test_export_refuses_an_evaluation_of_something_else(tmp_path):
    wrong = tmp_path / "evaluation.json"
    wrong.write_text(json.dumps({"trained": {"frames": 1, "seed": 0, "commit": None}}))
    command = [sys.executable, "-m", "pickplace.evaluation.export", "pretrained/r4", str(tmp_path / "out"), str(wrong)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2 and "it evaluates a policy of" in result.stderr and result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()
