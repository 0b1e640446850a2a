"""``report.html``: a training run on one page."""

import base64
import io
import re
import shlex
from html import escape
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from pickplace.common.files import replaced_file
from pickplace.rules.cell import CellSpec
from pickplace.runs.folder import REPORT, changed_values, noted_command
from pickplace.runs.loggers import read_csv
from pickplace.views.figures import failure_mix
from pickplace.views.replay import ASSETS, page


def write_report(
    run_dir: Path, cfg: DictConfig, episodes, cell: CellSpec, facts: dict, levels: tuple[str, int]
) -> None:
    """Write ``report.html``: curves, tables, the worst and the best episode, and the command that repeats the run.

    Args:
        run_dir: the run folder, with ``metrics.csv`` and ``learning_curve.png``.
        cfg: the composed config.
        episodes: the last validation, an :class:`pickplace.evaluation.play.Episodes` with recordings.
        cell: the sizes.
        facts: versions and commit.
        levels: what a level of the curriculum is, and the number of the last one.

    Raises:
        OSError: naming the report, if it cannot be written.
    """
    rows, failures = read_csv(run_dir / "metrics.csv"), io.BytesIO()
    failure_mix(run_dir / "metrics.csv", failures)
    best = max((row for row in rows if "eval/occupancy" in row), key=lambda row: row["eval/occupancy"])
    ordered = sorted(episodes.recordings, key=lambda recording: recording.occupancy)
    policy, sizes = str(cfg.model.actor._target_).rpartition(".")[2], "x".join(map(str, cell.tote_size))
    command = shlex.join(["pickplace-train", *noted_command(run_dir)])
    if changed := changed_values(run_dir, cfg):
        command += f"\n\nChanged when it was resumed: {', '.join(changed)}"
    tiles = [
        (f"{best['eval/occupancy']:.4f}", f"best validation, after {best['frames']:,} frames (checkpoints/best)"),
        (f"{episodes.occupancy.mean():.4f}", f"last validation, {len(episodes.occupancy)} episodes at full height"),
        (f"{episodes.occupancy.min():.4f}", "its worst episode"),
        (f"{int(rows[-1]['curriculum/level'])} of {levels[1]}", f"{levels[0]} reached"),
    ]
    parts = {
        "title": escape(f"Training {policy} for a {sizes} tote"),
        "subtitle": escape(
            f"R={cell.rotations}, {rows[-1]['frames']:,} frames, seed {cfg.seed}, "
            f"mask in training: {'yes' if cfg.model.mask_infeasible else 'no'}, K={cfg.planner.candidates}"
        ),
        "tiles": "".join(f"<div><b>{value}</b><span>{text}</span></div>" for value, text in tiles),
        "curve": base64.b64encode((run_dir / "learning_curve.png").read_bytes()).decode(),
        "failures": base64.b64encode(failures.getvalue()).decode(),
        "tables": validation_table(rows, levels[0]) + level_table(rows, levels[0]),
        "command": escape(command),
        "config": escape(OmegaConf.to_yaml(cfg, resolve=True)),
        "versions": escape("\n".join(f"{name}: {value}" for name, value in facts.items())),
        "replay": escape(page(ordered, cell, f"{cfg.evaluation.stream} stream, seed {cfg.evaluation.seed}")),
    }
    template = (ASSETS / "report.html").read_text(encoding="utf-8")
    with replaced_file(run_dir / REPORT) as new:
        # In one pass, so that no content is taken for a placeholder.
        new.write_text(re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], template), encoding="utf-8")


def _table(head: tuple, rows: list[tuple]) -> str:
    lines = ["".join(f"<td>{value}</td>" for value in row) for row in rows]
    lines.insert(0, "".join(f"<th>{name}</th>" for name in head))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def validation_table(rows: list[dict], level_name: str) -> str:
    """An HTML table of some 12 of the validations, and the last one."""
    found = [
        (
            f"{row['frames']:,}",
            f"{row['eval/occupancy']:.4f}",
            f"{row['eval/ci95_low']:.4f} to {row['eval/ci95_high']:.4f}",
            int(row["curriculum/level"]),
        )
        for row in rows
        if "eval/occupancy" in row
    ]
    return _table(
        ("frames", "validation", "95% interval", f"{level_name} in training"),
        found[: -1 : max(1, len(found) // 12)] + found[-1:],
    )


def level_table(rows: list[dict], level_name: str) -> str:
    """An HTML table of the training occupancy at each level, a mean over the last 20 batches in which an episode of it
    ended."""
    levels = sorted({int(key.rpartition("_")[2]) for row in rows for key in row if "curriculum/occupancy_at_" in key})
    lines = []
    for level in levels:
        seen = [row for row in rows if f"curriculum/occupancy_at_{level}" in row]
        values = [row[f"curriculum/occupancy_at_{level}"] for row in seen[-20:]]
        lines.append((level, f"{sum(values) / len(values):.4f}", f"{seen[0]['frames']:,} to {seen[-1]['frames']:,}"))
    head = (level_name, "training occupancy when last trained", "frames")
    return "<br>" + _table(head, lines) if lines else ""
