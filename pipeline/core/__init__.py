"""The core: value types, what a step is, the cache of results, errors, plugins.

Begin with `types` (clouds, meshes, cameras, tiles), then `step` (what a step is) and `cache` (where results are kept).
`plugins` finds backends and formats by their file names; `sandbox` runs native code in a child process.
"""
