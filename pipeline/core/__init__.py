"""The core: value types, the definition of a step, the cache of results, errors, plugins.

Begin with `types` (clouds, meshes, cameras, tiles), then `step` (definition of a step) and `cache` (results on disk).
`plugins` finds backends and formats by their file names; `sandbox` runs native code in a child process.
"""
