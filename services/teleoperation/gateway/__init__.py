"""The gateway: who is connected, who may drive which vehicle, certificates, audit.

Begin with `server`; `fleet` decides, `pki` issues certificates.
"""
