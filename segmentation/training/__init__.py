"""Training of the project's own segmentation network.

Begin with `train`; `dataset` reads labelled photos, `augment` varies them. The network itself is
`segmentation.network`.
"""
