"""CUDA graphs emulated on a CPU, under the code of ``CudaGraphModule``.

Capturing notes the ATen operations and undoes what they did. Replaying repeats them on the same tensors. So work that
depends on Python, on a tensor that was replaced, or on results, differs from work that is not captured.
"""

from contextlib import nullcontext
from types import SimpleNamespace

import tensordict.nn.cudagraphs as cudagraphs
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pickplace.common import graphs


def tensors_of(value) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, torch.Tensor)]


class Graph:
    """The operations of a capture: function, arguments, and the new tensors of each result (None: a view)."""

    replays = 0

    def __init__(self):
        self.operations: list[tuple] = []

    @torch.no_grad()
    def replay(self) -> None:
        Graph.replays += 1
        for function, args, kwargs, kept in self.operations:
            for old, new in zip(kept, results_of(function, function(*args, **kwargs)), strict=True):
                for target, source in zip(old or (), tensors_of(new) if old else (), strict=True):
                    target.copy_(source)


def results_of(function, result) -> list:
    """Return the results of an ATen operation, one for each that its schema declares."""
    count = len(function._schema.returns)
    return [result] if count == 1 else [*result] if count else []


class Capture(TorchDispatchMode):
    """Notes operations, and undoes what they wrote into tensors that existed before."""

    def __init__(self, graph: Graph):
        super().__init__()
        self.graph, self.before, self.made = graph, {}, set()

    def __enter__(self):
        self.generator = torch.get_rng_state()
        return super().__enter__()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs, schema = kwargs or {}, function._schema
        given = [*zip(args, schema.arguments, strict=False)]
        given += [(kwargs[each.name], each) for each in schema.arguments if each.name in kwargs]
        for value, argument in given:
            if argument.alias_info and argument.alias_info.is_write:
                for storage in (tensor.untyped_storage() for tensor in tensors_of(value)):
                    if storage._cdata not in self.made:
                        self.before.setdefault(storage._cdata, (storage, storage.clone()))
        result = function(*args, **kwargs)
        assert function.name() not in ("aten::_local_scalar_dense", "aten::nonzero"), "the work reads results back"
        pairs = zip(schema.returns, results_of(function, result), strict=True)
        kept = [tensors_of(part) if declared.alias_info is None else None for declared, part in pairs]
        self.made.update(tensor.untyped_storage()._cdata for part in kept for tensor in part or ())
        self.graph.operations.append((function, args, kwargs, kept))
        return result

    def __exit__(self, *error):
        left = super().__exit__(*error)
        for storage, copy in self.before.values():
            storage.copy_(copy)
        torch.set_rng_state(self.generator)
        return left


class EmulatedTorch:
    """``torch`` with a ``cuda`` on the CPU."""

    def __init__(self):
        stream = SimpleNamespace(wait_stream=lambda other: None)
        self.cuda = SimpleNamespace(
            is_available=lambda: True, Stream=lambda device=None: stream, current_stream=lambda device=None: stream,
            stream=lambda each: nullcontext(), synchronize=lambda device=None: None, CUDAGraph=Graph,
            graph=lambda graph, stream=None: Capture(graph),
        )  # fmt: skip

    def __getattr__(self, name):
        return getattr(torch, name)


def emulate(monkeypatch) -> None:
    """Let captured work go through ``CudaGraphModule`` on the CPU, for a test."""
    emulated, make = EmulatedTorch(), graphs.CapturedWork._make_graph
    monkeypatch.setattr(cudagraphs, "torch", emulated)
    monkeypatch.setattr(graphs.torch.cuda, "set_device", lambda device: None)
    clone = classmethod(lambda cls, x: x.clone() if isinstance(x, torch.Tensor) else x)
    monkeypatch.setattr(cudagraphs.CudaGraphModule, "_check_device_and_clone", clone)
    monkeypatch.setattr(
        graphs.CapturedWork, "_make_graph", lambda self, device: make(self, SimpleNamespace(type="cuda"))
    )
    Graph.replays = 0
