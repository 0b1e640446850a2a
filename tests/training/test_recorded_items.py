"""Training on a recorded stream, which truncates episodes."""

import torch

from pickplace.training import trainer
from pickplace.training.ppo import make_losses


def test_a_learner_expects_nothing_after_the_end_of_a_recording(smoke, tmp_path, monkeypatch):
    """Nothing more comes, and no critic learns the value of an empty bin."""
    batches = []

    def recording(*args):
        advantage, loss = make_losses(*args)
        return lambda batch: batches.append(advantage(batch).clone()), loss

    monkeypatch.setattr(trainer, "make_losses", recording)
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n2,1,1\n")
    quick = ["env.tote_size=[5,5,1]", "total_frames=128", "evaluation.episodes=1", "logger=none"]
    smoke(tmp_path / "run", "items=recorded", f"items.path={tmp_path}/items.csv", *quick)
    ended, target = (torch.cat([b[key].flatten() for b in batches]) for key in (("next", "truncated"), "value_target"))
    assert ended.sum() > 20
    torch.testing.assert_close(target[ended], torch.full_like(target[ended], 2 * 0.25))  # 2 cells, by reward_scale
