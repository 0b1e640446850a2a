"""How long a user waits for an import or for --help: python benchmarks/startup.py"""

import subprocess
import sys
from pathlib import Path

from common import interleave, save

COMMANDS = {
    "import pickplace": [sys.executable, "-c", "import pickplace"],
    "pickplace-train --help": [str(Path(sys.executable).with_name("pickplace-train")), "--help"],
}


def main() -> None:
    calls = {
        name: lambda command=command: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for name, command in COMMANDS.items()
    }
    save("startup", {"rows": interleave(calls, repeats=10)})


if __name__ == "__main__":
    main()
