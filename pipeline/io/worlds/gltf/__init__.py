"""What glTF files are made of, which `pipeline/io/worlds/glb.py` writes: buffers, textures, geometry, metadata."""
