"""Khronos' glTF validator: no errors or warnings in GLBs of splats. It doesn't know `KHR_gaussian_splatting` itself."""

from __future__ import annotations

from tests.fakes.consumers.gltf_validator import check, missing

__all__ = ["FORMAT", "check", "missing"]

FORMAT = "splats"
