"""Photos: decoders by format, colour management, EXIF metadata, video encoding.

Start reading at `image` (any photo as 8-bit sRGB); `decoders/` has one file per library.
"""
