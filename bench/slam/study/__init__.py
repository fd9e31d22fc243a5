"""The study of compression (5G-ERA D3.2, tables 4 and 5): errors of a path by resolution, bit rate and frame rate."""
