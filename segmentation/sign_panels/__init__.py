"""Sign panels from photos: triangulated from detections, outlines fitted, attached to their poles.

Start with `triangulate`; the pipeline step is `segmentation.steps.signs`.
"""
