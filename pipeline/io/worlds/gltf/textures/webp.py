"""WebP textures (`EXT_texture_webp`): smaller than JPEG; read by browsers, Cesium, Blender."""

from __future__ import annotations

from scan2sim.pipeline.core.types import U8

MIME, EXTENSION = "image/webp", "EXT_texture_webp"
PROGRAMS: tuple[str, ...] = ()


def encode(page: U8, quality: int) -> bytes:
    """See `pipeline.io.worlds.gltf.textures.Texture`."""
    import cv2

    return bytes(cv2.imencode(".webp", page[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])[1])
