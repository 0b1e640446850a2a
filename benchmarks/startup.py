"""Time of an import and of ``--help``, from the start of the process: python benchmarks/startup.py"""

import subprocess
import sys
from functools import partial

from common import console_command, interleave, save

COMMANDS = {
    "import pickplace": [sys.executable, "-c", "import pickplace"],
    "pickplace-train --help": [console_command("pickplace-train"), "--help"],
}


def main() -> None:
    run = partial(subprocess.run, check=True, stdout=subprocess.DEVNULL)
    calls = {name: partial(run, command) for name, command in COMMANDS.items()}
    save("startup", {"rows": interleave(calls, repeats=10)})


if __name__ == "__main__":
    main()
