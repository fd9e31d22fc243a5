"""RTSP camera with H.264 for tests: `/usr/bin/python3 rtsp_camera.py PORT GREY` (Debian's GStreamer)."""

from __future__ import annotations

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402


def main(port: str, grey: str) -> None:
    """Serve images of a uniform grey at rtsp://127.0.0.1:PORT/camera, 25 per second, 2 Mbit/s."""
    Gst.init(None)
    colour = f"0xff{int(grey):02x}{int(grey):02x}{int(grey):02x}"
    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(
        f"( videotestsrc is-live=true pattern=solid-color foreground-color={colour}"
        " ! video/x-raw,format=I420,width=640,height=480,framerate=25/1"
        " ! x264enc tune=zerolatency bitrate=2000 key-int-max=25 ! rtph264pay name=pay0 pt=96 )"
    )
    factory.set_shared(True)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(port)
    server.get_mount_points().add_factory("/camera", factory)
    server.attach(None)
    print("serves", flush=True)
    GLib.MainLoop().run()


if __name__ == "__main__":
    main(*sys.argv[1:])
