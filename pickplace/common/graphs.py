"""Compiled work: ``torch.compile``, and CUDA graphs, which a GPU repeats without Python (config group ``compile``)."""

import os
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tensordict
import torch
import torchrl
from tensordict.nn import CudaGraphModule
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pickplace.common.recording import recording
from pickplace.common.validate import flag, one_of, or_null, refuse_if

#: A function of tensors by name. All tensors of a recorded one are detached; its shapes are fixed.
Work = Callable[[dict[str, Tensor]], dict[str, Tensor]]

#: Modes of ``torch.compile``.
MODES = ("default", "reduce-overhead", "max-autotune", "max-autotune-no-cudagraphs")


@dataclass(frozen=True)
class Compile:
    """How the work of a training is compiled; the names are those of TorchRL's own trainings.

    Args:
        compile: whether the acting policy and the gradient step go through ``torch.compile``.
        compile_mode: its mode.
        cudagraphs: whether a GPU records the environment's step, the acting policy and the gradient step as CUDA
            graphs. On a CPU the same code runs, with the same fixed shapes, but without graphs.

    Raises:
        ValueError: naming the key, for another value.
    """

    compile: bool = False
    compile_mode: str | None = None
    cudagraphs: bool = False

    def __post_init__(self):
        flag("compile.compile", self.compile)
        or_null(one_of, "compile.compile_mode", self.compile_mode, MODES)
        flag("compile.cudagraphs", self.cudagraphs)

    def network(self, work: Work, what: str) -> Work:
        """Return the compiled form of work that is mostly a network's; ``what`` names it in errors."""
        return self.steps(torch.compile(work, mode=self.compile_mode) if self.compile else work, what)

    def steps(self, work: Work, what: str) -> Work:
        """Return the compiled form of work of many small steps, which ``torch.compile`` would take minutes to read."""
        return Recorded(work, what) if self.cudagraphs else work


PLAIN = Compile()


class Recorded:
    """Work that a GPU records in its third call, and then repeats; calls with other shapes run as they are.

    The first call makes constants, and the second one checks the work. On a CPU all calls run as they are.

    Args:
        work: the work.
        what: its name in errors.

    Raises:
        ValueError: in the second call, if the work cannot be recorded because it reads results back.
    """

    def __init__(self, work: Work, what: str):
        self.work, self.what = work, what
        self.graph = work
        if torch.cuda.is_available():
            os.environ.setdefault("EXCLUDE_TD_FROM_PYTREE", "1")  # else CudaGraphModule warns that it sees to it
            self.graph = CudaGraphModule(work, warmup=3)
        self.calls, self.shapes = 0, dict[str, torch.Size]()

    def __call__(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        shapes = {key: value.shape for key, value in inputs.items()}
        self.shapes = self.shapes or shapes
        with recording():
            if shapes != self.shapes:
                return self.work(inputs)
            self.calls += 1
            if self.calls != 2:
                return self.graph(inputs)
            with ReadsBack() as found:
                result = self.graph(inputs)
        places = "; ".join(dict.fromkeys(found.places))
        message = f"{self.what} looks at results while it runs ({places}); expected compile=none."
        refuse_if(places, f"compile.cudagraphs=true: {message}")
        return result


class ReadsBack(TorchDispatchMode):
    """Finds operations that a CUDA graph cannot hold: those that read results back, or whose shapes depend on data.

    Attributes:
        places: the operations, each with the line of pickplace that called it.
    """

    FORBIDDEN = (
        "aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::_unique2", "aten::unique_dim",
        "aten::repeat_interleave.Tensor", "aten::lift_fresh",
    )  # fmt: skip
    INDEXED = ("aten::index.Tensor", "aten::index_put", "aten::index_put_")

    def __init__(self):
        super().__init__()
        self.places: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.name()
        bad = name in self.FORBIDDEN
        if name in self.INDEXED:
            bad = any(index is not None and index.dtype == torch.bool for index in args[1])
        if name == "aten::_to_copy" and (device := (kwargs or {}).get("device")) is not None:
            bad = torch.device(device).type != args[0].device.type
        if bad:
            self.places.append(f"{name.removeprefix('aten::')} in {_own_line()}")
        return function(*args, **(kwargs or {}))


def _own_line() -> str:
    """Return the innermost line that is running and belongs to pickplace, or to the user."""
    others = [Path(module.__path__[0]) for module in (torch, tensordict, torchrl)] + [Path(__file__)]
    frames = [(Path(frame.filename), frame.lineno) for frame in traceback.extract_stack()]
    own = [frame for frame in frames if not any(other in (frame[0], *frame[0].parents) for other in others)]
    path, line = own[-1]
    return f"{path.name}:{line}"
