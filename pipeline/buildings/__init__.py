"""Buildings: facades above the scanner's field of view, and roofs of airborne clouds.

Begin with `facade_completion` (walls extended where rays and photos support it); `facade_stereo` is plane-sweep stereo,
`roof_outlines` the straight outlines of roofs. The steps are `pipeline.steps.facades` and `pipeline.steps.walls`.
"""
