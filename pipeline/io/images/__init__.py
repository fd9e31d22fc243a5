"""Photos: decoders by format, colour management, EXIF metadata, video encoding.

Begin with `image` (any photo as 8-bit sRGB); `decoders/` holds one file for each library.
"""
