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
    able = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return torch.bfloat16 if any(able.get(key) for key in ("amx_bf16", "avx512_bf16", "bf16")) else torch.float32
