"""``report.html``: a training run on one page."""

import base64
import io
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from statistics import fmean

from omegaconf import DictConfig, OmegaConf

from pickplace.common.files import replaced_file
from pickplace.rules.cell import CellSpec
from pickplace.runs.folder import REPORT, changed_values, noted_command
from pickplace.runs.locate import read_facts
from pickplace.runs.loggers import read_csv
from pickplace.training.curriculum.curriculum import Curriculum
from pickplace.views.figures import failure_mix, played_levels
from pickplace.views.replay import fill_template, page
from pickplace.views.scene import draw_scene, item_colours


def write_report(
    run_dir: Path,
    cfg: DictConfig,
    best: float,
    episodes,
    cell: CellSpec,
    facts: dict,
    curriculum: Curriculum,
    ended: str,
) -> None:
    """Write ``report.html``: the fullest tote, curves, tables, the best and the worst episode, and the command that
    repeats the run.

    Args:
        run_dir: the run folder, with ``metrics.csv`` and ``learning_curve.png``.
        cfg: the composed config.
        best: occupancy of ``checkpoints/best``, by the settings of now.
        episodes: the last validation, an :class:`pickplace.evaluation.play.Episodes` with recordings.
        cell: the sizes.
        facts: versions and commit.
        curriculum: the curriculum, for the names of its levels.
        ended: reason why a callback has ended the training; empty: none has.

    Raises:
        OSError: naming the report, if it cannot be written.
    """
    rows, level_name, tote = read_csv(run_dir / "metrics.csv"), curriculum.level_name, io.BytesIO()
    validations = [row for row in rows if "eval/occupancy" in row]
    saved = read_facts(run_dir)
    after = f", after {saved['frames']:,} frames" if saved else ""
    ordered = sorted(episodes.recordings, key=lambda recording: -recording.occupancy)
    draw_scene(ordered[0], cell, item_colours(ordered[0].boxes)).savefig(tote, dpi=100)
    mix = failure_mix(rows)
    # A rule that draws each episode's level has reached those that were played.
    reached = played_levels(rows) if curriculum.weights else []
    reached = reached or [int(row["curriculum/level"]) for row in rows]
    policy, sizes = str(cfg.model.actor._target_).rpartition(".")[2], "x".join(map(str, cell.tote_size))
    command = shlex.join(["pickplace-train", *noted_command(run_dir)])
    if changed := changed_values(run_dir, cfg):
        command += f"\n\nChanged when it was resumed: {', '.join(changed)}"
    tiles = [
        (f"{best:.4f}", f"best validation{after} (checkpoints/best)"),
        (f"{episodes.occupancy.mean():.4f}", f"last validation, {len(episodes.occupancy)} episodes of the full task"),
        (f"{episodes.occupancy.min():.4f}", "its worst episode"),
        (f"{max(reached)} of {curriculum.end}", f"highest {level_name} reached"),
    ]
    replay = f"{cfg.evaluation.stream} stream, seed {cfg.evaluation.seed}"
    parts = {
        "title": escape(f"Training {policy} for a {sizes} tote"),
        "subtitle": escape(
            f"R={cell.rotations}, {rows[-1]['frames']:,} frames, seed {cfg.seed}, "
            f"mask in training: {'yes' if cfg.model.mask_infeasible else 'no'}, K={cfg.planner.candidates}"
        ),
        "ended": f"<p>Ended before {cfg.total_frames:,} frames: {escape(ended)}.</p>" if ended else "",
        "tiles": "".join(f"<div><b>{value}</b><span>{text}</span></div>" for value, text in tiles),
        "tote": _picture("The tote at its fullest, and its height map", tote.getvalue()),
        "curve": _picture("Occupancy and levels over frames", (run_dir / "learning_curve.png").read_bytes()),
        "failures": f"<h2>How training episodes ended</h2>{_picture('Share of each over frames', mix)}" if mix else "",
        "tables": validation_table(validations, level_name) + level_table(rows, level_name, curriculum.given or ()),
        "command": escape(command),
        "config": escape(OmegaConf.to_yaml(cfg, resolve=True)),
        "versions": escape("\n".join(f"{name}: {value}" for name, value in facts.items())),
        "replay": escape(page(ordered, cell, replay, at_end=True)),
    }
    with replaced_file(run_dir / REPORT) as new:
        new.write_text(fill_template("report.html", **parts), encoding="utf-8")


def _picture(text: str, content: bytes) -> str:
    return f'<img alt="{text}" src="data:image/png;base64,{base64.b64encode(content).decode()}">'


def _table(head: tuple, rows: list[tuple]) -> str:
    lines = ["".join(f"<td>{value}</td>" for value in row) for row in rows]
    lines.insert(0, "".join(f"<th>{name}</th>" for name in head))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def validation_table(rows: list[dict], level_name: str) -> str:
    """An HTML table of up to 12 of the rows with a validation, at equal distances, and the last one."""
    lines = [
        (
            f"{row['frames']:,}",
            f"{row['eval/occupancy']:.4f}",
            f"{row['eval/ci95_low']:.4f} to {row['eval/ci95_high']:.4f}",
            int(row["curriculum/level"]),
        )
        for row in rows[: -1 : -(-len(rows) // 12)] + rows[-1:]
    ]
    return _table(("frames", "validation", "95% interval", f"{level_name} in training"), lines)


def level_table(rows: list[dict], level_name: str, settings: Sequence[Mapping] = ()) -> str:
    """An HTML table of the training occupancy at each level, a mean over the last 20 batches in which an episode of it
    ended.

    Args:
        rows: of ``metrics.csv``.
        level_name: name of a level.
        settings: settings of each level, from number 1 on, if the config lists them.
    """
    lines: list[tuple] = []
    words = [str(level)[1:-1].replace("'", "") or "the full task" for level in map(dict, settings)]
    for level in played_levels(rows):
        key = f"curriculum/occupancy_at_{level}"
        seen = [row for row in rows if key in row]
        mean = fmean(row[key] for row in seen[-20:])
        frames = f"{seen[0]['frames']:,} to {seen[-1]['frames']:,}"
        lines.append((level, f"{mean:.4f}", frames, *map(escape, words[level - 1 : level])))
    head = (level_name, "training occupancy when last trained", "frames", *["sets"][: len(words)])
    return "<br>" + _table(head, lines) if lines else ""
