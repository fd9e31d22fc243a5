"""Splats on an NVIDIA GPU: gsplat's CUDA kernels (Ye et al., "gsplat", JMLR 2025), and torch."""

from __future__ import annotations

from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.types import F32
from scan2sim.texturing.splats.backends import Scene, cpu

NEEDS = ("torch", "gsplat")
EXTRA = "splats-gpu"
RANK = 0
DEVICE = "cuda"
WITHOUT = "or set splats.backend=cpu"


def unavailable() -> Unavailable | None:
    """No GPU, or no kernels: gsplat compiles them when they are first used, for minutes."""
    import torch

    if not torch.cuda.is_available():
        return Unavailable("finds no GPU with CUDA", "Install a torch that finds it, " + WITHOUT)
    try:
        from gsplat.cuda import _backend
    except (ImportError, OSError, RuntimeError) as error:
        last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        return Unavailable(f"can't compile gsplat's kernels ({last})", "Install the CUDA toolkit of torch, " + WITHOUT)
    if _backend._C is None:
        return Unavailable("has no kernels, as CUDA's compiler nvcc is missing", "Install the CUDA toolkit, " + WITHOUT)
    return None


def description() -> str:
    """What renders, for the log."""
    import gsplat
    import torch

    return f"by gsplat {gsplat.__version__} on {torch.cuda.get_device_name()}"


def scene(parameters: F32) -> Scene:
    """Copy splats (N, 14) to the GPU."""
    if not len(parameters):  # gsplat can't render none
        return cpu.scene(parameters)
    import gsplat

    from scan2sim.texturing.splats.gpu_rasterizer import GpuScene

    return GpuScene(parameters, DEVICE, gsplat)
