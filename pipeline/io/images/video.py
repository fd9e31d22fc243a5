"""H.264 video encoder (MP4), frame by frame, with PyAV."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any, Self

from scan2sim.pipeline.core.errors import UnavailableError, from_os_error
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import U8

TICKS_PER_SECOND = 90_000
"""Time base of the video."""
CODEC = "libx264"


def check_encoder(what: str = "a video") -> None:
    """Check that H.264 can be encoded here; `what` needs it.

    Raises:
        UnavailableError: PyAV isn't installed, or its FFmpeg was built without libx264.
    """
    require(what, "av")
    import av

    try:
        av.codec.Codec(CODEC, "w")
    except ValueError:  # PyAV's UnknownCodecError
        raise UnavailableError(
            what,
            f"needs the encoder {CODEC}, which the FFmpeg of this PyAV doesn't have",
            "Install PyAV's own build: pip install --force-reinstall --only-binary av av",
        ) from None


class Encoder:
    """Writes frames with `add`, then `close`; the file exists from the start and is complete after `close`."""

    def __init__(
        self,
        file: Path,
        size: tuple[int, int],
        fps: float,
        *,
        bitrate: float | None = None,
        container: dict[str, str] | None = None,
        **options: str,
    ) -> None:
        """Create the file.

        Args:
            file: MP4 file, whatever its suffix.
            size: width and height, both even.
            fps: nominal frame rate, which rate control assumes.
            bitrate: target bit rate, bits per second.
            container: options of the MP4 muxer.
            options: options of libx264: preset, crf, threads.

        Raises:
            UnavailableError: PyAV isn't installed, or has no libx264.
            SpaceError: the file isn't writable.
        """
        check_encoder()
        import av

        self.count, self.file, self._last = 0, file, -1
        try:
            self._container: Any = av.open(str(file.absolute()), "w", format="mp4", options=container or {})
        except OSError as error:
            raise from_os_error(error, file) from error
        stream: Any = self._container.add_stream(CODEC, rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        if bitrate is not None:
            stream.bit_rate = round(bitrate)
        stream.time_base = stream.codec_context.time_base = Fraction(1, TICKS_PER_SECOND)
        stream.codec_context.options = options
        self._stream, self._frame = stream, av.VideoFrame

    def add(self, picture: U8, time: float) -> None:
        """Encode a frame, (H * 3 / 2, W) as converted by `cv2.COLOR_BGR2YUV_I420`, shown from `time` (seconds) on.

        Raises:
            SpaceError: the disk is full.
        """
        frame = self._frame.from_ndarray(picture, format="yuv420p")
        self._last = max(self._last + 1, round(time * TICKS_PER_SECOND))
        frame.pts, frame.time_base = self._last, Fraction(1, TICKS_PER_SECOND)
        self.count += 1
        self._mux(frame)

    def close(self) -> None:
        """Flush the encoder and finish the file."""
        if self._container is None:
            return
        self._mux(None)
        container, self._container = self._container, None
        try:
            container.close()
        except OSError as error:
            raise from_os_error(error, self.file) from error

    def _mux(self, frame: Any) -> None:
        try:
            self._container.mux(self._stream.encode(frame))
        except OSError as error:
            raise from_os_error(error, self.file) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
