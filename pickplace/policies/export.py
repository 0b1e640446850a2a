"""The ``pickplace-export`` command: the scoring network of a checkpoint as an ONNX file."""

import argparse

from pickplace.common.errors import Parser, one_sentence, write_output
from pickplace.common.interrupts import import_quietly


def main() -> None:
    """Entry point of ``pickplace-export``."""
    with one_sentence():
        arguments = parser().parse_args()
        export = import_quietly("pickplace.policies.onnx_model").export_onnx
        sizes = {} if arguments.rotations is None else {"rotations": arguments.rotations}
        differences = export(arguments.checkpoint, arguments.file, arguments.trust, **sizes)
        totes = ", ".join(f"{wide}x{deep}" for wide, deep in differences)
        write_output(
            f"{arguments.file}: onnxruntime agrees with torch at totes of {totes} cells; greatest difference "
            f"{max(differences.values()):.1e} of the greatest score.\n"
        )


def parser() -> argparse.ArgumentParser:
    return Parser(
        prog="pickplace-export",
        description="Export the scoring network of a checkpoint to ONNX, for batches, bins and totes of any size, and "
        "check it with onnxruntime at three tote sizes that the export has not seen.",
        epilog="Inputs, outputs and metadata of the file: docs/service.md",
        options={
            "checkpoint": {"help": "a run folder, a checkpoint, or pretrained/<name>"},
            "file": {"help": "the ONNX file to write"},
            "--rotations": {
                "type": int, "metavar": "R", "help": "quarter turns to choose from; default: as trained",
            },
            "--trust": {
                "action": "append", "metavar": "MODULE", "default": [],
                "help": "your own module whose classes the checkpoint's config may name; may be repeated",
            },
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
