"""Scoring networks as ONNX models: export, and the check by onnxruntime."""

import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.export import Dim

import pickplace
from pickplace.common.files import replaced_file
from pickplace.common.validate import refuse_if, short_text
from pickplace.policies.base import ScoresAnySize
from pickplace.policies.restore import TrainedPolicy, cell_settings, load_policy

TOLERANCE = 5e-5  # greatest difference between onnxruntime and torch, as a share of the greatest score
#: Numbers of cells by which the totes, and the bins, of each check are larger than in training.
CHECKS = (((1, 4), (0, 0)), ((3, 0), (0, 0)), ((7, 5), (1, 2)))
ENVS, STEPS = 3, 8  # each check has ENVS * STEPS problems at most
MAX_FOOTPRINTS = 2_000  # of all problems of a check, if these are more than one: on a fine grid each takes seconds

N = Dim("N")


class Scores(torch.nn.Module):
    """:meth:`ScoresAnySize.unmasked_scores` as a module: one argument for each entry of the observation.

    Args:
        policy: scores bins and totes of any size.
        keys: the entries that it reads, in order.
    """

    def __init__(self, policy: ScoresAnySize, keys: Sequence[str]):
        super().__init__()
        self.policy, self.keys = policy, keys

    def forward(self, *entries: Tensor) -> Tensor:
        return self.policy.unmasked_scores(dict(zip(self.keys, entries, strict=True)))


def export_onnx(checkpoint, path, trust: Sequence[str] = (), **sizes) -> dict[tuple[int, ...], float]:
    """Write the scoring network of a checkpoint as an ONNX model, if onnxruntime agrees with torch about it.

    Its inputs are entries of the observation, by their names; its output ``logits``, float32 ``[N, scores]``, has the
    unmasked score of every footprint, or of every flat action. The metadata has the formula of an index. Matrix
    products are computed in float32.

    Args:
        checkpoint, trust, **sizes: see :func:`~pickplace.policies.restore.load_policy`, as for errors.
        path: the file to write; an old one is replaced when the check has passed.

    Returns:
        For each tote ``(W_T, D_T)`` of the check the greatest difference, as a share of the greatest score.

    Raises:
        ValueError: for a policy that scores one size only, a missing extra, or a difference above :data:`TOLERANCE`.
        OSError: if the file cannot be written.
    """
    try:
        import onnx  # noqa: F401
        import onnxruntime
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ValueError(f"pickplace-export: {error.name} is missing; pip install 'pickplace[onnx]'.") from error
    path = Path(path)
    refuse_if(path.is_dir() or not path.parent.is_dir(), f"{path}: expected a file in a folder that exists.")
    trained = _load(checkpoint, trust, **sizes)
    policy, cell = trained.policy, trained.cell
    if not isinstance(policy, ScoresAnySize):
        raise ValueError(
            f"{short_text(checkpoint)}: {type(policy).__name__} has no scores for totes of any size; expected "
            "model=fcn_grasp that was trained with a mask, model=fcn4d, or model=afterstate_fcn."
        )
    keys = [key for key in policy.in_keys if not key.endswith("_mask")]
    model = _convert(Scores(policy, keys).eval(), keys, _observations(trained, keys, 1), shapes_of(policy))
    model.model.metadata_props.update({
        "pickplace": pickplace.__version__,
        "checkpoint": str(checkpoint),
        "policy": type(policy).__name__,
        "cell": json.dumps(cell_settings(cell) | {"reach": None}),  # scores do not depend on it
        "index": policy.score_index,
    })  # fmt: skip
    differences: dict[tuple[int, ...], float] = {}
    with replaced_file(path) as new:
        model.save(new)
        session = onnxruntime.InferenceSession(new, providers=["CPUExecutionProvider"])
        for more_tote, more_bin in CHECKS:
            more_bin = more_bin if policy.any_bin else (0, 0)
            grown = {
                key: (*(side + more for side, more in zip(size, step, strict=False)), size[2])
                for key, size, step in (("tote_size", cell.tote_size, more_tote), ("bin_size", cell.bin_size, more_bin))
            }
            other = _load(checkpoint, trust, **{**sizes, **grown})
            asked = _some_problems(_observations(other, keys, STEPS), MAX_FOOTPRINTS // other.cell.num_choices)
            with torch.no_grad():
                expected = Scores(other.policy, keys)(*asked)
            found = session.run(None, {key: entry.numpy() for key, entry in zip(keys, asked, strict=True)})[0]
            difference = (torch.from_numpy(found) - expected).abs().max() / expected.abs().max().clamp(min=1)
            wide, deep, _ = other.cell.tote_size
            refuse_if(
                not difference <= TOLERANCE,  # nan, too
                f"{path}: at a tote of {wide}x{deep} cells onnxruntime and torch differ by {difference:.1e} of the "
                f"greatest score; expected at most {TOLERANCE:g}. Nothing was written.",
            )
            differences[wide, deep] = float(difference)
    return differences


def _load(checkpoint, trust: Sequence[str], **sizes) -> TrainedPolicy:
    """Return a policy that computes in float32."""
    trained = load_policy(checkpoint, trust=trust, **sizes)
    for module in trained.modules():
        if hasattr(module, "compute_dtype"):
            module.compute_dtype = "float32"
    return trained


def _observations(trained: TrainedPolicy, keys: Sequence[str], steps: int) -> list[Tensor]:
    """Return entries of the observations in the first steps of some episodes, ``[N, ...]`` each."""
    env = trained.make_env(num_envs=ENVS, stream="validation")
    seen = env.rollout(steps, trained, break_when_any_done=False).reshape(-1)
    return [seen[key].contiguous() for key in keys]


def _some_problems(entries: list[Tensor], count: int) -> list[Tensor]:
    """Return evenly spaced problems, at least one and at most all; among them the last, usually with a full tote."""
    most = len(entries[0])
    rows = torch.linspace(-1, most - 1, max(1, min(count, most)) + 1)[1:].long()
    return [entry[rows] for entry in entries]


def shapes_of(policy: ScoresAnySize) -> dict[str, tuple]:
    """Return the shapes of the model's inputs, in which a :class:`Dim` may have any size. The export infers those of
    a user's own terms."""
    tote = Dim("W_T", min=policy.least_tote), Dim("D_T", min=policy.least_tote)
    bins = (Dim("W_B"), Dim("D_B")) if policy.any_bin else (Dim.STATIC, Dim.STATIC)
    return {
        "bin_depth": (N, *bins), "tote_depth": (N, *tote), "tote_bearing": (N, *tote), "tote_height": (N, Dim.STATIC),
        "items": (N, Dim("M"), Dim.STATIC), "coming": (N, Dim("p"), Dim.STATIC),
    }  # fmt: skip


def _convert(scores: Scores, keys: Sequence[str], seen: list[Tensor], known: dict[str, tuple]):
    """Return the ``torch.onnx.ONNXProgram`` of scores."""
    shapes = tuple(
        dict(enumerate(known.get(key, (N, *[Dim.AUTO] * (entry.dim() - 1)))))
        for key, entry in zip(keys, seen, strict=True)
    )
    with torch.no_grad():  # fills the tables that the rules keep: tables from a trace would spoil later decisions
        scores(*(entry[:1] for entry in seen))
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    try:
        logger.setLevel(logging.ERROR)  # it reports operators of packages that are not used
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.onnx.export(
                scores, tuple(seen), input_names=list(keys), output_names=["logits"],
                dynamic_shapes=(shapes,), dynamo=True, verbose=False,
            )  # fmt: skip
    finally:
        logger.setLevel(before)
