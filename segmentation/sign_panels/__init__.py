"""Sign panels from photos: triangulated from detections, outlines fitted, attached to their poles.

Begin with `triangulate`; the step is `segmentation.steps.signs`.
"""
