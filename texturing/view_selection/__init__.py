"""View selection: which photos texture each face (Waechter et al. 2014).

`step` is the step; `candidates` rates the photos of a face, `mrf` selects one photo for the detail.
"""
