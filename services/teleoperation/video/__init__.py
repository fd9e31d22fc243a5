"""Video from the vehicle: capture, RTP packets, SRTP, rate control, and the jitter buffer of the station.

Begin with `capture` (vehicle) and `jitter_buffer` (station). Codecs are in `encoders/`, sources in `cameras/`.
"""
