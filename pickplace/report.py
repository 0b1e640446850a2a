"""Figures and tables of a run."""
from pathlib import Path
def learning_curve(metrics: Path, figure: Path) -> None:
    pass
