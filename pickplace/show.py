"""Shows a page in a browser, or says where it is: ``python -m pickplace.show outputs/demo/replay.html``."""

import argparse
import os
import sys
import webbrowser
from pathlib import Path

from pickplace.config import one_sentence


def show(page: Path) -> str:
    """Open a page in a graphical browser, where there is one.

    Returns:
        A sentence for the user: what was opened, or which file to open.

    Raises:
        FileNotFoundError: if there is no such page.
    """
    if not page.is_file():
        raise FileNotFoundError(f"{page}: no such page.")
    # Without a display `webbrowser` would start a browser for terminals, which shows no 3D.
    display = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if display and webbrowser.open(page.resolve().as_uri()):
        return f"Opened {page} in your browser."
    return f"Open this file in a browser: {page.resolve()}"


def main() -> None:
    """Entry point of ``python -m pickplace.show``."""
    options = argparse.ArgumentParser(
        prog="python -m pickplace.show",
        description="Opens a page in a browser, or says which file to open where there is none.",
    )
    options.add_argument("page", type=Path, help="such as replay.html of an evaluation, or report.html of a training")
    args = options.parse_args()
    with one_sentence():
        sys.stdout.write(f"\n{show(args.page)}\n")


if __name__ == "__main__":
    main()
