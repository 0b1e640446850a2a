"""Dtypes of the matrix products in networks; parameters stay float32."""

import torch

DTYPES = ("auto", "float32", "bfloat16")


def matrix_dtype(name: str, device: str) -> torch.dtype:
    """Return the dtype of matrix products on a type of device; ``"auto"``: the fastest one there.

    A processor without units for bfloat16 takes up to 40 times as long with it.
    """
    if name != "auto":
        return getattr(torch, name)
    if device == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    return torch.bfloat16 if has_matrix_unit() or _is_cpu_able("avx512_bf16") else torch.float32


def has_matrix_unit() -> bool:
    """Return whether the CPU has units for matrices of bfloat16, and not only for vectors, as AVX-512 has."""
    return _is_cpu_able("amx_bf16") or _is_cpu_able("bf16")


def _is_cpu_able(key: str) -> bool:
    return hasattr(torch.cpu, "get_capabilities") and bool(torch.cpu.get_capabilities().get(key))
