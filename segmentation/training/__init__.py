"""Training of the project's own segmentation network.

Start with `train`; `dataset` reads labelled photos, `augment` is the data augmentation. The network itself is
`segmentation.network`.
"""
