"""Compiled work: ``torch.compile``, and CUDA graphs, which a GPU repeats without Python (config group ``compile``)."""

import logging
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

from pickplace.common.capture import capturing
from pickplace.common.validate import flag, one_of, or_null, refuse_if

#: A function of tensors by name. All tensors of a captured one are detached; its shapes are fixed.
Work = Callable[[dict[str, Tensor]], dict[str, Tensor]]

#: Modes of ``torch.compile`` without graphs of its own.
MODES = ("default", "max-autotune-no-cudagraphs")


@dataclass(frozen=True)
class CompileSettings:
    """How the work of a training is compiled; the names are those of TorchRL's own trainings.

    Args:
        compile: whether the acting policy and the gradient step go through ``torch.compile``.
        compile_mode: its mode.
        cudagraphs: whether a GPU captures the environment's step, the acting policy and the gradient step as CUDA
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
        return CapturedWork(work, what) if self.cudagraphs else work


NO_COMPILE = CompileSettings()


class CapturedWork:
    """Work that a GPU captures in its third call, and then repeats; calls with other shapes run as they are.

    The first call makes constants, and the second one checks the work. On a CPU all calls run as they are.

    Args:
        work: the work.
        what: its name in errors.

    Raises:
        ValueError: in the second call, if the work cannot be captured because it reads results back.
    """

    def __init__(self, work: Work, what: str):
        self.work, self.what = work, what
        self.calls, self.graph = 0, work
        self.kinds: dict[str, tuple[torch.Size, torch.dtype]] = {}  # shape and type of each input

    def __call__(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        kinds = {key: (value.shape, value.dtype) for key, value in inputs.items()}
        if not self.kinds:
            self.kinds, self.graph = kinds, self._make_graph(next(iter(inputs.values())).device)
        with capturing():
            if kinds != self.kinds:
                return self.work(inputs)
            self.calls += 1
            ordered = {key: inputs[key] for key in self.kinds}  # the graph's inputs have places, not names
            if self.calls != 2:
                return self.graph(ordered)
            with CaptureChecker() as found:
                result = self.graph(ordered)
        places = "; ".join(dict.fromkeys(found.places))
        message = f"{self.what} looks at results while it runs ({places}); expected compile=none."
        refuse_if(places, f"compile.cudagraphs=true: {message}")
        return result

    def _make_graph(self, device: torch.device) -> Work:
        if device.type == "cpu":
            return self.work
        torch.cuda.set_device(device)  # the graph's streams are there
        os.environ.setdefault("EXCLUDE_TD_FROM_PYTREE", "1")  # else CudaGraphModule warns that it sees to it
        logging.getLogger("tensordict").setLevel(logging.WARNING)  # it reports each graph
        # The work runs twice with the same inputs when it is captured, so it must not change their dict.
        return CudaGraphModule(lambda inputs: self.work({**inputs}), warmup=3)


class CaptureChecker(TorchDispatchMode):
    """Finds operations that a CUDA graph cannot hold: those that read results back, or whose shapes depend on data.

    On a CPU, calls of ``tolist`` and ``numpy`` go unnoticed. On a GPU they are found, as they copy to the CPU.

    Attributes:
        places: the operations, each with the line of pickplace or of the user that called it.
    """

    FORBIDDEN = (
        "_local_scalar_dense", "nonzero", "masked_select", "masked_scatter", "_unique", "_unique2", "unique_dim",
        "unique_consecutive", "repeat_interleave.Tensor", "lift_fresh", "equal", "multinomial", "bincount",
    )  # fmt: skip
    INDEXED = ("index.Tensor", "index_put", "index_put_")

    def __init__(self):
        super().__init__()
        self.places: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.name().removeprefix("aten::")
        bad = name in self.FORBIDDEN
        if name in self.INDEXED:
            bad = any(index is not None and index.dtype == torch.bool for index in args[1])
        if name == "_to_copy" and (device := (kwargs or {}).get("device")) is not None:
            bad = torch.device(device).type != args[0].device.type
        if name == "copy_":
            bad = args[0].device.type != args[1].device.type
        if bad:
            self.places.append(f"{name} in {_own_line()}")
        return function(*args, **(kwargs or {}))


def _own_line() -> str:
    """Return the innermost line that is running and belongs to pickplace, or to the user."""
    others = [Path(module.__path__[0]) for module in (torch, tensordict, torchrl)] + [Path(__file__)]
    frames = [(Path(frame.filename), frame.lineno) for frame in traceback.extract_stack()]
    own = [frame for frame in frames if not any(other in (frame[0], *frame[0].parents) for other in others)]
    return f"{own[-1][0].name}:{own[-1][1]}" if own else "the backward pass"  # it has a thread of its own on a GPU
