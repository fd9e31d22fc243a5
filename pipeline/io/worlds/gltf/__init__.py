"""Parts of the glTF files that `pipeline/io/worlds/glb.py` writes: buffers, textures, geometry, metadata."""
