"""View selection: which photos texture each face (Waechter et al. 2014).

`step` is the pipeline step; `candidates` rates the photos of each face, `mrf` selects one photo for the detail.
"""
