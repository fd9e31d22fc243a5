"""Baking: photos to the pixels of texture pages.

Begin with `bands` (a page, band by band); `blend_numba` and `blend_torch` are the kernels for CPU and GPU.
"""
