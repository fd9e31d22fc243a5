"""The gateway: connected vehicles and stations, the pairs that drive, certificates, audit trail.

Begin with `server`; `fleet` decides which station drives which vehicle, `pki` issues certificates.
"""
