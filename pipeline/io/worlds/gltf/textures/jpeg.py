"""JPEG textures: read by every program."""

from __future__ import annotations

from scan2sim.pipeline.core.types import U8

MIME, EXTENSION = "image/jpeg", ""
PROGRAMS: tuple[str, ...] = ()


def encode(page: U8, quality: int) -> bytes:
    """See `pipeline.io.worlds.gltf.textures.Texture`."""
    import cv2

    return bytes(cv2.imencode(".jpg", page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
