"""Confidence intervals and paired differences, against figures computed by hand."""

import pytest
import torch

from pickplace.evaluation.result import confidence95, paired_difference, proportion95


def test_confidence_interval_by_hand():
    # Mean 0.8; deviations -0.1, 0, 0, 0.1: variance 0.02 / 3, standard error sqrt(0.02 / 3 / 4) = 0.0408248;
    # Student's t with 3 degrees of freedom at 97.5%: 3.182446.
    interval = confidence95(torch.tensor([0.7, 0.8, 0.8, 0.9], dtype=torch.float64))
    assert interval == pytest.approx((0.8 - 0.129923, 0.8 + 0.129923), abs=1e-6)
    assert confidence95(torch.tensor([0.5] * 5)) == (0.5, 0.5)
    assert confidence95(torch.tensor([0.5])) == (0.0, 1.0)
    assert confidence95(torch.tensor([0.5]), least=-1.0) == (-1.0, 1.0)
    assert confidence95(torch.tensor([1.0, 1.0, 0.96]))[1] == 1.0  # 1.044 is no occupancy
    assert confidence95(torch.tensor([0.0, 0.0, 0.04]))[0] == 0.0
    low, high = confidence95(torch.tensor([0.01, -0.01, 0.01]), least=-1.0)
    assert -1 < low < 0 < high


def test_interval_of_a_share_by_hand():
    """At 0 of n the upper limit u has (1 - u)^n = 0.025; the middle value is from tables of Clopper and Pearson."""
    assert proportion95(0, 20) == pytest.approx((0.0, 1 - 0.025 ** (1 / 20)))
    assert proportion95(20, 20) == pytest.approx((0.025 ** (1 / 20), 1.0))
    assert proportion95(3, 10) == pytest.approx((0.0667, 0.6525), abs=1e-4)


def test_paired_difference_by_hand():
    ours = {"occupancy": {"per_episode": [0.9, 0.7, 0.9, 0.7]}}
    theirs = {"planner": "random", "occupancy": {"per_episode": [0.8, 0.8, 0.8, 0.6]}}
    # Differences 0.1, -0.1, 0.1, 0.1: mean 0.05, standard error 0.05.
    found = paired_difference(ours, theirs)
    assert found["against"] == "random" and found["mean"] == pytest.approx(0.05)
    assert found["ci95"] == pytest.approx([0.05 - 0.159122, 0.05 + 0.159122], abs=1e-6)
