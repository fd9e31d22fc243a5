"""What glTF files are made of, which `pipeline/io/glb.py` writes: buffers, textures, geometry, metadata."""
